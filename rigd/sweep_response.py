"""Frequency response of a session's sweep: running estimate, nominal model, decimation for charts.

The live view, the operator's page and the report after a session show the same curves.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rigd.beam import Beam, Damping, transfer
from rigd.documents import parse_toml
from rigd.session.layout import Status
from rigd.spectral import CurveDecimation, RunningEstimate, RunningResponse, segmentation_of
from rigd.text_table import decode_text

RealArray = npt.NDArray[np.float64]
"""Array of real numbers."""
ComplexArray = npt.NDArray[np.complex128]
"""Array of complex numbers."""

LOWEST_SHOWN_HZ: Final = 0.5
"""Lowest frequency shown. Below it the torque is lower than the sensor's noise."""
HIGHEST_SHOWN_HZ: Final = 60.0
"""Highest frequency shown: above the third mode and the band of the reference paper's chirp."""

LOW_COHERENCE: Final = 0.8
"""Coherence below which a response is drawn grey.

The random error of its magnitude is then above 0.35/√n, with n averages (J. S. Bendat and A. G.
Piersol, Random Data, 4th ed., Table 9.6)."""
_FREQUENCY_GROUP_COUNT: Final = 200
"""Number of groups of points along the frequency axis, each drawn as two points.

This is enough for the pixels of a view."""
_MODEL_STEP_HZ: Final = 0.01
"""Distance between the frequencies of the nominal model's response."""
_STALE_STATUS: Final = Status.ANGLE_STALE | Status.WRENCH_STALE
"""Status bits of a sample whose angle or wrench repeats an earlier reading."""


def sweep_ticks(segments: Mapping[str, tuple[int, int]]) -> tuple[int, int]:
    """Return the ticks (first, end) over which the frequency response of a record is estimated.

    Parameters
    ----------
    segments
        First tick and end (exclusive) of each segment by its name; one of them is the sweep.
    """
    # After its scan, the segments of a search do not sweep the band. The first of two sweeps is the
    # same as the only sweep of other chirps.
    return next(
        segments[segment_name]
        for segment_name in ("scan", "there", "sweep")
        if segment_name in segments
    )


class SweepResponse:
    """Running estimate of the frequency response from motor angle to torque in a sweep.

    The estimate uses Welch's method, with the default segments of `analyze`.

    Parameters
    ----------
    sweep_tick_range
        First tick and end (exclusive) of the sweep.
    rate_hz
        Scheduled ticks per second.
    last_hz
        Highest frequency of the estimated response.
    resolution_divisor
        Divisor of the FFT length that `analyze` uses. The FFT is never shorter than a segment.
    """

    def __init__(
        self,
        sweep_tick_range: tuple[int, int],
        rate_hz: float,
        last_hz: float,
        *,
        resolution_divisor: int = 1,
    ) -> None:
        self._first_tick, end_tick = sweep_tick_range
        sweep_sample_count = end_tick - self._first_tick
        segmentation = segmentation_of(sweep_sample_count, rate_hz)
        segmentation = replace(
            segmentation,
            nfft=max(segmentation.nfft // resolution_divisor, segmentation.segment_length),
        )
        self._running_response = RunningResponse(
            rate_hz, sweep_sample_count, last_hz=last_hz, segmentation=segmentation
        )
        self._angles_before_sweep_rad: list[npt.NDArray[np.float64]] = []
        self._rest_angle_rad: float | None = None

    def feed(self, samples: npt.NDArray[Any]) -> None:
        """Add samples (n,) of ``SAMPLE_DTYPE`` to the estimate.

        The samples are in order. Gaps are allowed.
        """
        sweep_ticks = samples["tick"].astype(np.int64) - self._first_tick
        samples_before_sweep = int(np.searchsorted(sweep_ticks, 0))
        if samples_before_sweep:
            self._angles_before_sweep_rad.append(samples["angle_rad"][:samples_before_sweep].copy())
        if samples_before_sweep == len(samples):
            return
        # A constant angle causes no torque of the beam, but would leak into the lowest bins.
        if self._rest_angle_rad is None:
            self._rest_angle_rad = float(
                np.median(np.concatenate(self._angles_before_sweep_rad or [np.zeros(1)]))
            )
            self._angles_before_sweep_rad = []
        sweep_samples = samples[samples_before_sweep:]
        # A stale reading is not a measurement: its gap is filled like any other.
        nan_if_stale = np.where(sweep_samples["status"] & _STALE_STATUS, np.nan, 1.0)
        self._running_response.feed(
            sweep_ticks[samples_before_sweep:],
            sweep_samples["angle_reference_rad"] - self._rest_angle_rad,
            (sweep_samples["angle_rad"] - self._rest_angle_rad) * nan_if_stale,
            sweep_samples["coupling_torque_nm"],
        )

    def estimate(self) -> RunningEstimate | None:
        """Return the response estimated so far; None while there are too few samples."""
        return self._running_response.estimate()


def nominal_response(
    beam: Beam, damping: Damping, tool_inertia_kg_m2: float
) -> tuple[RealArray, ComplexArray]:
    """Return the nominal frequency response from motor angle to the sensor's torque.

    Parameters
    ----------
    beam, damping
        Model of the specimen and its damping.
    tool_inertia_kg_m2
        Inertia between the sensor and the beam, about the motor's axis.

    Returns
    -------
    tuple of two arrays (n,)
        Frequencies in Hz of the band that is shown; complex response in N·m/rad.
    """
    frequency_hz = np.arange(LOWEST_SHOWN_HZ, HIGHEST_SHOWN_HZ, _MODEL_STEP_HZ)
    s = 2j * np.pi * frequency_hz
    return frequency_hz, transfer(s, beam, damping) + tool_inertia_kg_m2 * s * s


def response_decimation(frequency_hz: RealArray) -> CurveDecimation:
    """Return the object that decimates curves over frequency for the charts.

    Parameters
    ----------
    frequency_hz
        Increasing frequencies of the curves' points, shape (n,). Points outside the band of the
        charts are dropped.
    """
    return CurveDecimation.with_logarithmic_groups(
        frequency_hz, LOWEST_SHOWN_HZ, HIGHEST_SHOWN_HZ, _FREQUENCY_GROUP_COUNT
    )


def nominal_damping(profile_bytes: bytes) -> Damping | None:
    """Return the nominal damping in a profile or specimen; None if it states no usable one.

    Only the damping parameters are read, so the profile may be of any version.
    """
    try:
        damping_table = parse_toml(decode_text(profile_bytes))["beam"]["damping"]
        zeta, alpha, gamma, lambda_ = (
            float(damping_table[key]["value"]) for key in ("zeta", "alpha", "gamma", "lambda")
        )
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    # Comparisons with NaN are false.
    is_plausible = 0.0 <= zeta <= 1.0 and 0.0 <= alpha < 2.0 and 0.0 <= gamma < np.inf
    return Damping(zeta, alpha, gamma, lambda_) if is_plausible and 0.0 <= lambda_ < 2.0 else None
