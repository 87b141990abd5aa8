"""Conversion of a session's samples to the record of one touch for the estimator."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rigd.session.layout import WRENCH_FIELDS
from rigd.touch._free_motion import TouchRecord

HISTORY_S: Final = 1.5
"""Time before a detection that an estimate uses."""
CONTACT_S: Final = 0.8
"""Time after a detection for which the beam of a search may still touch the obstacle."""
PREVIEW_S: Final = 0.025
"""Time after a detection for the advance search of the position."""
FIRST_S: Final = 0.05
"""Time after a detection that the first estimate uses."""
FINAL_S: Final = 0.2
"""Time after a detection that the last estimate uses."""


def around_touch(
    samples: NDArray[np.void], tick: int, rate_hz: float, free_from: int = 0
) -> NDArray[np.void]:
    """Return the samples of an estimate: 1.5 s before the detection, 0.2 s after it.

    Parameters
    ----------
    samples
        Shape (n,), with a field ``tick``.
    tick
        Tick of the detection.
    rate_hz
        Ticks a second.
    free_from
        Tick before which the beam was in contact: nothing earlier is used.
    """
    ticks = samples["tick"].astype(np.int64)
    first = max(tick - round(HISTORY_S * rate_hz), free_from)
    last = tick + round(FINAL_S * rate_hz)
    return samples[(ticks >= first) & (ticks <= last)]


def touch_record(
    samples: NDArray[np.void],
    tick: int,
    rate_hz: float,
    shear_projection: Sequence[float] | None,
) -> TouchRecord:
    """Return the record around a detection for the estimator, with missed ticks interpolated.

    Parameters
    ----------
    samples
        Shape (n,) of `rigd.session.layout.SAMPLE_DTYPE`, in the order of their ticks.
    tick
        Tick of the detection.
    rate_hz
        Ticks a second.
    shear_projection
        Base shear = projection · wrench; None: it is not measured.
    """
    ticks = samples["tick"].astype(np.int64)
    every = np.arange(ticks[0], ticks[-1] + 1)

    def filled(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.interp(every, ticks, values)

    return TouchRecord(
        rate_hz,
        filled(samples["angle_rad"]),
        filled(samples["coupling_torque_nm"]),
        None if shear_projection is None else filled(base_shear_n(samples, shear_projection)),
        int(tick - ticks[0]),
    )


def base_shear_n(
    samples: NDArray[np.void], shear_projection: Sequence[float]
) -> NDArray[np.float64]:
    """Return the base shear of samples, shape (n,).

    Parameters
    ----------
    samples
        Shape (n,) of `rigd.session.layout.SAMPLE_DTYPE`.
    shear_projection
        Six numbers: base shear = projection · wrench.
    """
    wrench = np.array([samples[axis] for axis in WRENCH_FIELDS])
    shear: NDArray[np.float64] = np.array(shear_projection) @ wrench
    return shear
