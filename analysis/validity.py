"""Validity of a record: the largest slope of the antenna's tip, and the linear model's error there.

The plan of a session predicts the slope, and its file states it (``predicted_peak_tip_slope_rad``).
If the file does not state it, it is computed from the measured angle with the beam and damping that
were estimated from the record.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from rigd.beam.tip import linear_model_error, tip_motion
from rigd.session import Validity

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from rigd.beam import Beam, Damping

_KEY: Final = "predicted_peak_tip_slope_rad"


def stated_validity(metadata: Mapping[str, str]) -> Validity:
    """Return the stated validity of a file; unknown if it states none.

    Parameters
    ----------
    metadata : mapping of str to str
        Metadata ``session`` of the file.
    """
    try:
        slope_rad = float(metadata.get(_KEY, "nan"))
    except ValueError:
        slope_rad = math.nan
    return _of_slope(slope_rad)


def record_validity(
    metadata: Mapping[str, str],
    angle_rad: NDArray[np.float64],
    rate_hz: float,
    *models: tuple[Beam, Damping],
) -> Validity:
    """Return the validity of a record: the stated one, else from the measured angle.

    Parameters
    ----------
    metadata : mapping of str to str
        Metadata ``session`` of the file.
    angle_rad : ndarray, shape (n,)
        Measured angle at consecutive ticks.
    rate_hz : float
        Ticks a second.
    *models : tuple of Beam and Damping
        Estimated from the record, of which the largest slope counts; without any, a file that
        states nothing leaves it unknown.
    """
    stated = stated_validity(metadata)
    if stated.predicted_peak_tip_slope_rad is not None:
        return stated
    with np.errstate(all="ignore"):  # an estimate that does not suit may overflow: then unknown
        return worst(
            _of_slope(tip_motion(beam, damping, angle_rad, rate_hz).slope_rad)
            for beam, damping in models
        )


def worst(validities: Iterable[Validity]) -> Validity:
    """Return the combined validity of several records; unknown if any of them is unknown.

    Parameters
    ----------
    validities : iterable of Validity
    """
    slopes = [each.predicted_peak_tip_slope_rad for each in validities]
    known = [slope for slope in slopes if slope is not None]
    return _of_slope(max(known)) if known and len(known) == len(slopes) else Validity()


def _of_slope(slope_rad: float) -> Validity:
    if not 0.0 <= slope_rad < math.inf:
        return Validity()
    error = linear_model_error(slope_rad)
    return Validity(slope_rad, error) if math.isfinite(error) else Validity()
