"""Welch method of the reference paper: Welch's estimate of a record, twelve fits, and indices.

Each of six structures is fitted with two weightings. The indices are the distances between measured
and fitted response, Eqs. (28) to (30), and the deviations of their resonant peaks, Eqs. (31) and
(32); the predicted torque is compared in the time domain as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from analysis.models import STRUCTURES, FrequencyResponseModel, WeightingError, weights
from analysis.paper._estimate import (
    FrequencyResponseError,
    SettingsError,
    estimate,
    estimate_warnings,
)
from analysis.paper._fit import FitError, FrfFit, fit_many
from rigd.beam import modes, transfer, undamped_frequencies_rad_s

if TYPE_CHECKING:
    from collections.abc import Callable

    from analysis.models import WelchSettings
    from analysis.record import Record
    from rigd.beam import Beam, Damping, Mode
    from rigd.spectral import FrequencyResponse, Segmentation


# Indices


@dataclass(frozen=True, slots=True)
class Indices:
    """Distance between two frequency responses of a torque to an angle.

    Attributes
    ----------
    mse : float
        Mean square error, Eq. (28), in (N·m/rad)².
    wmse : float
        Mean square error weighted with 1/omega, Eq. (29), in (N·m/rad)².
    md : float
        Maximum deviation, Eq. (30), in N·m/rad.
    """

    mse: float
    wmse: float
    md: float


def fit_indices(
    omega_rad_s: NDArray[np.float64],
    measured: NDArray[np.complex128],
    model: NDArray[np.complex128],
) -> Indices:
    """Evaluate Eqs. (28) to (30) on complex deviations ``|G - Ĝ|``, all of shape (n,).

    Parameters
    ----------
    omega_rad_s : ndarray, shape (n,)
        Angular frequencies, positive.
    measured, model : ndarray of complex, shape (n,)
        Responses in N·m/rad.

    References
    ----------
    Fractional-Order Models of Damping Phenomena in a Flexible Sensing Antenna Used for Haptic Robot
    Navigation, Eqs. 28 to 30.
    """
    deviation = np.abs(measured - model)
    square = deviation**2
    return Indices(
        mse=float(square.mean()),
        wmse=float(weights(omega_rad_s, "omega") @ square),
        md=float(deviation.max()),
    )


# Resonant peaks


@dataclass(frozen=True, slots=True)
class Peak:
    """A resonant peak: the bin where the magnitude is largest, and the magnitude there."""

    frequency_hz: float
    """Frequency of the bin."""
    magnitude_db: float
    """In dB re 1 unit of the response."""


@dataclass(frozen=True, slots=True)
class PeakDeviation:
    """One session's term of Eqs. (31) and (32) for one mode."""

    frequency_rad_s: float
    magnitude_db: float


def resonant_peaks(
    frequency_hz: NDArray[np.float64],
    response: NDArray[np.complex128],
    mode_hz: NDArray[np.float64],
) -> tuple[Peak | None, ...]:
    """Return the resonant peaks on the bins, as in the reference paper (not interpolated).

    Parameters
    ----------
    frequency_hz : ndarray, shape (n,)
        Positive, increasing.
    response : ndarray of complex, shape (n,)
    mode_hz : ndarray, shape (m,)
        Approximate mode frequencies, increasing: a peak is searched between the geometric means of
        neighbours, and as far beyond the first and last. The undamped frequencies suffice.

    Returns
    -------
    tuple of Peak or None, length m
        None where no bin between those limits is a local maximum: the mode is damped away, or
        lies outside the band. In dB re 1 unit of the response.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.paper import resonant_peaks
    >>> frequency_hz = np.linspace(1, 4, 301)
    >>> response = 1 / (2.5**2 - frequency_hz**2 + 0.05j * frequency_hz)
    >>> (peak,) = resonant_peaks(frequency_hz, response, np.array([2.5]))
    >>> print(f"{peak.frequency_hz:.2f} Hz, {peak.magnitude_db:.1f} dB")
    2.50 Hz, 18.1 dB
    """
    magnitude = np.abs(response)
    ratio = np.sqrt(mode_hz[1:] / mode_hz[:-1])
    # A single mode is searched within half an octave.
    first, last = (ratio[0], ratio[-1]) if ratio.size else (np.sqrt(2.0), np.sqrt(2.0))
    lower = mode_hz / np.concatenate(([first], ratio))
    upper = mode_hz * np.concatenate((ratio, [last]))
    inner = magnitude[1:-1]
    summits = 1 + np.flatnonzero((inner > magnitude[:-2]) & (inner >= magnitude[2:]))
    peaks: list[Peak | None] = []
    for low, high in zip(lower, upper, strict=True):
        candidates = summits[(frequency_hz[summits] >= low) & (frequency_hz[summits] <= high)]
        if candidates.size == 0:
            peaks.append(None)
            continue
        best = candidates[np.argmax(magnitude[candidates])]
        peaks.append(Peak(float(frequency_hz[best]), 20 * float(np.log10(magnitude[best]))))
    return tuple(peaks)


def peak_deviation(measured: Peak, model: Peak) -> PeakDeviation:
    """Return ``|omega_q - omega^_q|`` and ``||G| - |Ĝ||`` in dB, Eqs. (31) and (32).

    The reference paper averages them over sessions; this is the term of one session.

    Parameters
    ----------
    measured, model : Peak
        The same peak of either response.

    Examples
    --------
    >>> from analysis.paper import Peak, peak_deviation
    >>> found = peak_deviation(Peak(2.55, -10.0), Peak(2.56, -10.4))
    >>> print(f"{found.frequency_rad_s:.4f} rad/s, {found.magnitude_db:.1f} dB")
    0.0628 rad/s, 0.4 dB
    """
    return PeakDeviation(
        frequency_rad_s=2 * np.pi * abs(measured.frequency_hz - model.frequency_hz),
        magnitude_db=abs(measured.magnitude_db - model.magnitude_db),
    )


# Torque in time

_DECAY_OVER_RECORD = 2.7
"""sigma T: what wraps around shrinks by exp(-2 sigma T), rounding errors grow by exp(sigma T)."""


def modelled_torque(record: Record, damping: Damping) -> NDArray[np.float64]:
    """Return the causal response of the exact model to the whole record's measured angle.

    The beam is assumed at rest before the first sample, at the angle of the segment ``rest`` or
    else at the first angle. The record times exp(-sigma t) is padded with zeros and transformed:
    this is its transform on s = sigma + j omega, where the part that wraps around has decayed. It
    is multiplied with ``G(s) + J_tool s²`` and the difference of the two channels' delays,
    transformed back, and divided by the exponential.

    Parameters
    ----------
    record
        Its angle, beam, tool inertia and delays are used.
    damping
        Parameters of Eq. 25.

    Returns
    -------
    ndarray, shape (n,)
        Torque in N·m as the sensor would give it at the record's time stamps.
    """
    samples = len(record.angle_rad)
    padded = 1 << (2 * samples - 1).bit_length()
    duration_s = samples / record.rate_hz
    sigma = _DECAY_OVER_RECORD / duration_s
    decay = np.exp(-sigma * np.arange(samples) / record.rate_hz)
    s = sigma + 2j * np.pi * np.fft.rfftfreq(padded, 1.0 / record.rate_hz)
    origin_rad = record.angle_rad[0] if record.rest_angle_rad is None else record.rest_angle_rad
    angle = np.fft.rfft((record.angle_rad - origin_rad) * decay, padded)
    response = transfer(s, record.beam, damping) + record.tool_inertia_kg_m2 * s**2
    response *= np.exp(-s * (record.torque_delay_s - record.angle_delay_s))
    return np.asarray(np.fft.irfft(angle * response, padded)[:samples] / decay)


def band_limited(
    values: NDArray[np.float64], rate_hz: float, band_hz: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the values limited to a band, by a mask on their Fourier transform (no delay).

    Parameters
    ----------
    values : ndarray, shape (n,)
    rate_hz
        Sampling rate.
    band_hz
        First and last frequency that pass.

    Returns
    -------
    ndarray, shape (n,)
    """
    padded = 1 << (2 * len(values) - 1).bit_length()
    frequency_hz = np.fft.rfftfreq(padded, 1.0 / rate_hz)
    spectrum = np.fft.rfft(values, padded)
    spectrum[(frequency_hz < band_hz[0]) | (frequency_hz > band_hz[1])] = 0.0
    return np.asarray(np.fft.irfft(spectrum, padded)[: len(values)])


_NEAR: Final = 0.1
"""Half width of the band of the envelope, relative to its centre."""


def loudest_moment_s(values: NDArray[np.float64], rate_hz: float, frequency_hz: float) -> float:
    """Return the time at which the oscillation near a frequency is largest.

    Parameters
    ----------
    values : ndarray, shape (n,)
        The signal.
    rate_hz : float
        Its sampling rate.
    frequency_hz : float
        Middle of the band.

    Returns
    -------
    float
        Seconds from the first value.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.paper import loudest_moment_s
    >>> t = np.arange(10_000) / 1000
    >>> values = np.exp(-((t - 4) ** 2)) * np.sin(2 * np.pi * 5 * t)
    >>> print(f"{loudest_moment_s(values, 1000, 5.0):.2f} s")
    4.00 s
    """
    padded = 1 << (len(values) - 1).bit_length()
    frequencies_hz = np.fft.rfftfreq(padded, 1.0 / rate_hz)
    near = np.abs(frequencies_hz / frequency_hz - 1.0) <= _NEAR
    analytic = np.zeros(padded, dtype=np.complex128)
    analytic[: len(frequencies_hz)][near] = np.fft.rfft(values, padded)[near]
    envelope = np.abs(np.fft.ifft(analytic)[: len(values)])
    return float(np.argmax(envelope)) / rate_hz


# Analysis of a record

MODES: Final = 3
LARGEST_SHIFT: Final = 0.1
"""Shift of a mode's frequency from the undamped beam's: a damping ratio of 0.4 makes as much."""


@dataclass(frozen=True, slots=True)
class FittedModel:
    """One fit with its indices, modes and peaks.

    Attributes
    ----------
    fit : FrfFit
    response : ndarray of complex, shape (n,)
        The model with the tool inertia on the bins that were fitted, in N·m/rad.
    indices : Indices
    modes : tuple of Mode
        Modes of the beam alone, from its poles; empty where damping is so strong that one has none.
    followed : tuple of bool
        Mode by mode, whether it vibrates, and within `LARGEST_SHIFT` of the undamped beam's
        frequency. If not, the fit does not follow that resonance: the mode is not that of the
        antenna.
    peaks : tuple of Peak or None
        Resonant peaks of `response`, mode by mode.
    deviations : tuple of PeakDeviation or None
        From the measured peaks; None where either has no peak.
    """

    fit: FrfFit
    response: NDArray[np.complex128]
    indices: Indices
    modes: tuple[Mode, ...]
    followed: tuple[bool, ...]
    peaks: tuple[Peak | None, ...]
    deviations: tuple[PeakDeviation | None, ...]


@dataclass(frozen=True, slots=True)
class WelchAnalysis:
    """Results of the Welch method for one record.

    Attributes
    ----------
    record : Record
    settings : WelchSettings
        Requested settings.
    segmentation : Segmentation
        Segments at the record's rate.
    response : FrequencyResponse
        In the band, without the channels' delays.
    whole_record : FrequencyResponse
        Ratio of the transforms of the whole record, likewise, for comparison.
    peaks : tuple of Peak or None
        Measured resonant peaks, mode by mode.
    models : tuple of FittedModel
        By type, then by weighting, in the order of the settings.
    warnings : tuple of str
        Warnings for the analyst, including those of the record.
    """

    record: Record
    settings: WelchSettings
    segmentation: Segmentation
    response: FrequencyResponse
    whole_record: FrequencyResponse
    peaks: tuple[Peak | None, ...]
    models: tuple[FittedModel, ...]
    warnings: tuple[str, ...]


def analyse(
    record: Record,
    settings: WelchSettings,
    on_step: Callable[[str], None] = lambda _done: None,
) -> WelchAnalysis:
    """Estimate the frequency response of a record and fit the models to it.

    Parameters
    ----------
    record : Record
    settings : WelchSettings
    on_step : callable, optional
        Called with a few words after each step: the estimate, then every type.

    Raises
    ------
    SettingsError
        The segments, the band or the weightings make no sense.
    FrequencyResponseError
        Nothing was excited, or the record is too short for the segments.
    """
    _check_excited(record)
    response, whole_record = estimate(record, settings)
    on_step("frequency response")
    peaks = _peaks(record.beam, response.frequency_hz, response.response)
    beam_on_tool = FrequencyResponseModel(
        response.frequency_hz, record.beam, record.tool_inertia_kg_m2
    )
    models: list[FittedModel] = []
    for name in settings.types:
        # A type at a time, so that progress can be shown; sharing among types is not worth much.
        try:
            fits = fit_many(
                response.frequency_hz,
                response.response,
                record.beam,
                [STRUCTURES[name]],
                settings.weightings,
                tool_inertia_kg_m2=record.tool_inertia_kg_m2,
            )
        except (FitError, WeightingError) as error:
            raise SettingsError(f"{record.path}: {error}") from error
        models.extend(_evaluated(fit, record.beam, response, beam_on_tool, peaks) for fit in fits)
        on_step(f"type {name}")
    return WelchAnalysis(
        record=record,
        settings=settings,
        segmentation=settings.segmentation(record.rate_hz),
        response=response,
        whole_record=whole_record,
        peaks=peaks,
        models=tuple(models),
        warnings=record.warnings + estimate_warnings(record, settings, response),
    )


def _check_excited(record: Record) -> None:
    """Raise if the motor did not move, before the checks of segments and bands."""
    angles = record.angle_rad[record.angle_known]
    if record.metadata.get("excitation") == "hold":
        raise FrequencyResponseError(
            f"{record.path}: nothing was excited: the motor was held; record an excitation, such "
            "as rigd run chirp."
        )
    if angles.size == 0 or np.ptp(angles) == 0:
        raise FrequencyResponseError(
            f"{record.path}: nothing was excited: the angle never changes; check the encoder and "
            "that the motor moved."
        )


def _evaluated(
    fit: FrfFit,
    beam: Beam,
    measured: FrequencyResponse,
    beam_on_tool: FrequencyResponseModel,
    measured_peaks: tuple[Peak | None, ...],
) -> FittedModel:
    """Return a fitted model with all its indices."""
    response = beam_on_tool.evaluate(fit.damping)
    peaks = _peaks(beam, measured.frequency_hz, response)
    try:
        found = modes(beam, fit.damping, MODES)
    except ArithmeticError:
        found = ()
    return FittedModel(
        fit=fit,
        response=response,
        indices=fit_indices(2 * np.pi * measured.frequency_hz, measured.response, response),
        modes=found,
        followed=_followed(found, beam),
        peaks=peaks,
        deviations=tuple(
            None if seen is None or modelled is None else peak_deviation(seen, modelled)
            for seen, modelled in zip(measured_peaks, peaks, strict=True)
        ),
    )


def _followed(found: tuple[Mode, ...], beam: Beam) -> tuple[bool, ...]:
    """Return whether each mode vibrates near the frequency of the undamped beam."""
    undamped_hz = undamped_frequencies_rad_s(beam, MODES) / (2 * np.pi)
    return tuple(
        mode.damping_ratio < 1 and abs(mode.frequency_hz / own_hz - 1) < LARGEST_SHIFT
        for mode, own_hz in zip(found, undamped_hz[: len(found)], strict=True)
    )


def _peaks(
    beam: Beam, frequency_hz: NDArray[np.float64], response: NDArray[np.complex128]
) -> tuple[Peak | None, ...]:
    """Return the resonant peaks near the beam's first undamped frequencies."""
    mode_hz = undamped_frequencies_rad_s(beam, MODES) / (2 * np.pi)
    return resonant_peaks(frequency_hz, response, mode_hz)
