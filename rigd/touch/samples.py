"""Selection and conversion of a session's samples to the record of one touch."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rigd.session.layout import WRENCH_FIELDS
from rigd.touch._free_motion import TouchRecord

RECORD_BEFORE_DETECTION_S: Final = 1.5
"""Time in s before a detection from which on samples are used for an estimate."""
MAX_CONTACT_S: Final = 0.8
"""Longest assumed duration in s of the contact after a detection."""
PREVIEW_SEARCH_S: Final = 0.025
"""Time in s after a detection up to which the preliminary search of the position uses samples."""
FIRST_ESTIMATE_S: Final = 0.05
"""Time in s after a detection up to which the first estimate uses samples."""
FINAL_ESTIMATE_S: Final = 0.2
"""Time in s after a detection up to which the last estimate uses samples."""


def around_touch(
    samples: NDArray[np.void], tick: int, rate_hz: float, first_free_tick: int = 0
) -> NDArray[np.void]:
    """Return the samples from 1.5 s before the detection of a touch to 0.2 s after it.

    Parameters
    ----------
    samples
        Samples of a session with a field ``tick``, shape (n,).
    tick
        Tick of the detection.
    rate_hz
        Ticks a second.
    first_free_tick
        Earliest tick whose sample may be used, because the beam was in contact before it.
    """
    sample_ticks = samples["tick"].astype(np.int64)
    first_tick = max(tick - round(RECORD_BEFORE_DETECTION_S * rate_hz), first_free_tick)
    last_tick = tick + round(FINAL_ESTIMATE_S * rate_hz)
    return samples[(sample_ticks >= first_tick) & (sample_ticks <= last_tick)]


def touch_record(
    samples: NDArray[np.void],
    tick: int,
    rate_hz: float,
    shear_projection: Sequence[float] | None,
) -> TouchRecord:
    """Return the record of angle, torque and shear around a touch, with missed ticks interpolated.

    Parameters
    ----------
    samples
        Samples of `rigd.session.layout.SAMPLE_DTYPE` in the order of their ticks, shape (n,).
    tick
        Tick of the detection.
    rate_hz
        Ticks a second.
    shear_projection
        Coefficients of the base shear, shear = projection · wrench; None: it is not measured.
    """
    sample_ticks = samples["tick"].astype(np.int64)
    all_ticks = np.arange(sample_ticks[0], sample_ticks[-1] + 1)

    def interpolate_samples(sample_values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.interp(all_ticks, sample_ticks, sample_values)

    return TouchRecord(
        rate_hz,
        interpolate_samples(samples["angle_rad"]),
        interpolate_samples(samples["coupling_torque_nm"]),
        None
        if shear_projection is None
        else interpolate_samples(base_shear_n(samples, shear_projection)),
        int(tick - sample_ticks[0]),
    )


def base_shear_n(
    samples: NDArray[np.void], shear_projection: Sequence[float]
) -> NDArray[np.float64]:
    """Return the base shear in N of each sample, shape (n,).

    Parameters
    ----------
    samples
        Samples of `rigd.session.layout.SAMPLE_DTYPE`, shape (n,).
    shear_projection
        Six coefficients of the base shear, shear = projection · wrench.
    """
    wrench_rows = np.array([samples[axis_name] for axis_name in WRENCH_FIELDS])
    shear_n: NDArray[np.float64] = np.array(shear_projection) @ wrench_rows
    return shear_n
