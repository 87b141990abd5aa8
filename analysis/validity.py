"""Validity of the linear model for a record: the antenna's largest tip slope and its model error.

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

    from rigd.beam import Plant

_TIP_SLOPE_KEY: Final = "predicted_peak_tip_slope_rad"
"""Key of the predicted tip slope in the metadata."""


def stated_validity(metadata: Mapping[str, str]) -> Validity:
    """Return the validity of the linear model that a file states; unknown if not stated.

    Parameters
    ----------
    metadata : mapping of str to str
        Metadata ``session`` of the file.
    """
    try:
        slope_rad = float(metadata.get(_TIP_SLOPE_KEY, "nan"))
    except ValueError:
        slope_rad = math.nan
    return _validity_of_slope(slope_rad)


def record_validity(
    metadata: Mapping[str, str],
    angle_rad: NDArray[np.float64],
    rate_hz: float,
    *plants: Plant,
) -> Validity:
    """Return the validity of the linear model for a record, as stated or from the measured angle.

    Parameters
    ----------
    metadata : mapping of str to str
        Metadata ``session`` of the file.
    angle_rad : ndarray, shape (n,)
        Measured angle at consecutive ticks.
    rate_hz : float
        Ticks per second.
    *plants : Plant
        Plants estimated from the record; the largest slope among them is used. Without a plant, the
        validity is unknown unless the file states it.
    """
    stated_result = stated_validity(metadata)
    if stated_result.predicted_peak_tip_slope_rad is not None:
        return stated_result
    with np.errstate(all="ignore"):  # a wrong model may overflow, and the validity is then unknown
        return combined_validity(
            _validity_of_slope(tip_motion(plant, angle_rad, rate_hz).slope_rad) for plant in plants
        )


def combined_validity(validities: Iterable[Validity]) -> Validity:
    """Return the combined validity of several records; unknown if any of them is unknown.

    Parameters
    ----------
    validities : iterable of Validity
        Validities of the single records.
    """
    slopes_rad = [validity.predicted_peak_tip_slope_rad for validity in validities]
    known_slopes_rad = [slope_rad for slope_rad in slopes_rad if slope_rad is not None]
    return (
        _validity_of_slope(max(known_slopes_rad))
        if known_slopes_rad and len(known_slopes_rad) == len(slopes_rad)
        else Validity()
    )


def _validity_of_slope(slope_rad: float) -> Validity:
    """Return the validity at a tip slope in rad; unknown if the slope is negative or infinite."""
    if not 0.0 <= slope_rad < math.inf:
        return Validity()
    model_error = linear_model_error(slope_rad)
    return Validity(slope_rad, model_error) if math.isfinite(model_error) else Validity()
