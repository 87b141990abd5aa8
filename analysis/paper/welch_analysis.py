"""Welch method of the reference paper: Welch's estimate of a record, twelve fits, and indices.

Each of six structures is fitted with two weightings. The indices are the distances between measured
and fitted response, Eqs. (28) to (30), and the deviations of their resonant peaks, Eqs. (31) and
(32). The predicted torque can be compared in the time domain, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from analysis.models import STRUCTURES, WeightingError, weights
from analysis.paper._estimate import (
    FrequencyResponseError,
    SettingsError,
    estimate,
    estimate_warnings,
)
from analysis.paper._fit import FitError, FrfFit, fit_many
from rigd.beam import (
    CausalTransform,
    Plant,
    ResponseGrid,
    modes,
    transfer,
    undamped_frequencies_rad_s,
)

if TYPE_CHECKING:
    from analysis.models import WelchSettings
    from analysis.record import Record
    from rigd.beam import Beam, Damping, Mode
    from rigd.spectral import FrequencyResponse, Segmentation


# Indices


@dataclass(frozen=True, slots=True)
class FitIndices:
    """Fit indices: distances between a measured and a modelled frequency response.

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
    measured_response: NDArray[np.complex128],
    model_response: NDArray[np.complex128],
) -> FitIndices:
    """Return the fit indices of a model (Eqs. 28 to 30), from the deviations ``|G - Ĝ|``.

    Parameters
    ----------
    omega_rad_s : ndarray, shape (n,)
        Angular frequencies, positive.
    measured_response, model_response : ndarray of complex, shape (n,)
        Measured and modelled response in N·m/rad.

    References
    ----------
    Fractional-Order Models of Damping Phenomena in a Flexible Sensing Antenna Used for Haptic Robot
    Navigation, Eqs. 28 to 30.
    """
    absolute_deviation = np.abs(measured_response - model_response)
    squared_deviation = absolute_deviation**2
    return FitIndices(
        mse=float(squared_deviation.mean()),
        wmse=float(weights(omega_rad_s, "omega") @ squared_deviation),
        md=float(absolute_deviation.max()),
    )


# Resonant peaks


@dataclass(frozen=True, slots=True)
class Peak:
    """Resonant peak of a frequency response: the bin of the largest magnitude near a mode."""

    frequency_hz: float
    """Frequency of the bin in Hz."""
    magnitude_db: float
    """Magnitude at the bin, in dB relative to one unit of the response."""


@dataclass(frozen=True, slots=True)
class PeakDeviation:
    """Deviation between measured and modelled resonant peak: a term of Eqs. (31) and (32)."""

    frequency_rad_s: float
    """Magnitude of the difference in frequency, in rad/s."""
    magnitude_db: float
    """Magnitude of the difference in magnitude, in dB."""


def resonant_peaks(
    frequency_hz: NDArray[np.float64],
    response: NDArray[np.complex128],
    mode_hz: NDArray[np.float64],
) -> tuple[Peak | None, ...]:
    """Return the resonant peak of a response near each given mode, without interpolation of bins.

    Parameters
    ----------
    frequency_hz : ndarray, shape (n,)
        Frequencies of the bins: positive, increasing.
    response : ndarray of complex, shape (n,)
        Frequency response.
    mode_hz : ndarray, shape (m,)
        Approximate mode frequencies, increasing, such as the undamped ones. The peak of a mode is
        searched between the geometric means with the neighbouring modes.

    Returns
    -------
    tuple of Peak or None, length m
        Peak of each mode. None if no bin between these limits is a local maximum, because of
        strong damping, or because the mode lies outside the band.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.paper.welch_analysis import resonant_peaks
    >>> frequency_hz = np.linspace(1, 4, 301)
    >>> response = 1 / (2.5**2 - frequency_hz**2 + 0.05j * frequency_hz)
    >>> (peak,) = resonant_peaks(frequency_hz, response, np.array([2.5]))
    >>> print(f"{peak.frequency_hz:.2f} Hz, {peak.magnitude_db:.1f} dB")
    2.50 Hz, 18.1 dB
    """
    magnitude = np.abs(response)
    border_frequency_ratios = np.sqrt(mode_hz[1:] / mode_hz[:-1])
    # The peak of a single mode is searched within half an octave on either side.
    first_ratio, last_ratio = (
        (border_frequency_ratios[0], border_frequency_ratios[-1])
        if border_frequency_ratios.size
        else (np.sqrt(2.0), np.sqrt(2.0))
    )
    lower_borders_hz = mode_hz / np.concatenate(([first_ratio], border_frequency_ratios))
    upper_borders_hz = mode_hz * np.concatenate((border_frequency_ratios, [last_ratio]))
    inner_magnitude = magnitude[1:-1]
    local_maximum_bins = 1 + np.flatnonzero(
        (inner_magnitude > magnitude[:-2]) & (inner_magnitude >= magnitude[2:])
    )
    peaks_of_modes: list[Peak | None] = []
    for low, end_bin in zip(lower_borders_hz, upper_borders_hz, strict=True):
        candidate_bins = local_maximum_bins[
            (frequency_hz[local_maximum_bins] >= low)
            & (frequency_hz[local_maximum_bins] <= end_bin)
        ]
        if candidate_bins.size == 0:
            peaks_of_modes.append(None)
            continue
        largest_peak_bin = candidate_bins[np.argmax(magnitude[candidate_bins])]
        peaks_of_modes.append(
            Peak(
                float(frequency_hz[largest_peak_bin]),
                20 * float(np.log10(magnitude[largest_peak_bin])),
            )
        )
    return tuple(peaks_of_modes)


def peak_deviation(measured_peak: Peak, model_peak: Peak) -> PeakDeviation:
    """Return the absolute deviations of a resonant peak in frequency and in magnitude (dB).

    These are the terms ``|omega_q - omega^_q|`` and ``||G| - |Ĝ||`` of one session, which the
    reference paper averages over sessions (Eqs. 31 and 32).

    Parameters
    ----------
    measured_peak, model_peak : Peak
        Resonant peak of the same mode in the measured and in the modelled response.

    Examples
    --------
    >>> from analysis.paper.welch_analysis import Peak, peak_deviation
    >>> found = peak_deviation(Peak(2.55, -10.0), Peak(2.56, -10.4))
    >>> print(f"{found.frequency_rad_s:.4f} rad/s, {found.magnitude_db:.1f} dB")
    0.0628 rad/s, 0.4 dB
    """
    return PeakDeviation(
        frequency_rad_s=2 * np.pi * abs(measured_peak.frequency_hz - model_peak.frequency_hz),
        magnitude_db=abs(measured_peak.magnitude_db - model_peak.magnitude_db),
    )


# Torque in time

_DECAY_EXPONENT_OVER_RECORD = 2.7
"""Decay rate sigma times the duration T of the record in `modelled_torque`. Circular wrap-around is
reduced by exp(-2 sigma T), rounding errors grow by exp(sigma T)."""


def modelled_torque(record: Record, damping: Damping) -> NDArray[np.float64]:
    """Return the torque that the exact beam model predicts from a record's measured angle.

    The beam is assumed at rest before the first sample, at the angle of the segment ``rest`` or
    else at the first angle. The angle is convolved with ``G(s) + J_tool s²`` and the difference of
    the two channels' delays (`rigd.beam.CausalTransform`).

    Parameters
    ----------
    record
        Record with angle, beam, tool inertia and delays.
    damping
        Damping parameters of Eq. 25.

    Returns
    -------
    ndarray, shape (n,)
        Torque in N·m as the sensor would report it at the record's time stamps.
    """
    sample_count = len(record.angle_rad)
    padded_sample_count = 1 << (2 * sample_count - 1).bit_length()
    transform = CausalTransform(
        padded_sample_count,
        record.rate_hz,
        _DECAY_EXPONENT_OVER_RECORD * padded_sample_count / sample_count,
    )
    s = transform.s
    initial_angle_rad = (
        record.angle_rad[0] if record.rest_angle_rad is None else record.rest_angle_rad
    )
    torque_response = transfer(s, record.beam, damping) + record.tool_inertia_kg_m2 * s**2
    torque_response *= np.exp(-s * (record.torque_delay_s - record.angle_delay_s))
    return transform.convolve(record.angle_rad - initial_angle_rad, torque_response)


def band_limited(
    signal_values: NDArray[np.float64], rate_hz: float, band_hz: tuple[float, float]
) -> NDArray[np.float64]:
    """Return a signal limited to a frequency band, without delay: its spectrum is 0 elsewhere.

    Parameters
    ----------
    signal_values : ndarray, shape (n,)
        Signal.
    rate_hz
        Sampling rate.
    band_hz
        First and last frequency of the band.

    Returns
    -------
    ndarray, shape (n,)
        Filtered signal.
    """
    padded_sample_count = 1 << (2 * len(signal_values) - 1).bit_length()
    frequency_hz = np.fft.rfftfreq(padded_sample_count, 1.0 / rate_hz)
    spectrum = np.fft.rfft(signal_values, padded_sample_count)
    spectrum[(frequency_hz < band_hz[0]) | (frequency_hz > band_hz[1])] = 0.0
    return np.asarray(np.fft.irfft(spectrum, padded_sample_count)[: len(signal_values)])


_RELATIVE_ENVELOPE_HALF_WIDTH: Final = 0.1
"""Half width of the band in which an envelope is computed, relative to its centre frequency."""


def largest_oscillation_time_s(
    signal_values: NDArray[np.float64], rate_hz: float, frequency_hz: float
) -> float:
    """Return the time at which a signal's oscillation near a frequency is largest.

    Parameters
    ----------
    signal_values : ndarray, shape (n,)
        Signal.
    rate_hz : float
        Sampling rate.
    frequency_hz : float
        Centre frequency of the band.

    Returns
    -------
    float
        Time in seconds after the first value.

    Examples
    --------
    >>> import numpy as np
    >>> from analysis.paper.welch_analysis import largest_oscillation_time_s
    >>> t = np.arange(10_000) / 1000
    >>> values = np.exp(-((t - 4) ** 2)) * np.sin(2 * np.pi * 5 * t)
    >>> print(f"{largest_oscillation_time_s(values, 1000, 5.0):.2f} s")
    4.00 s
    """
    padded_sample_count = 1 << (len(signal_values) - 1).bit_length()
    frequencies_hz = np.fft.rfftfreq(padded_sample_count, 1.0 / rate_hz)
    in_band = np.abs(frequencies_hz / frequency_hz - 1.0) <= _RELATIVE_ENVELOPE_HALF_WIDTH
    analytic_signal = np.zeros(padded_sample_count, dtype=np.complex128)
    analytic_signal[: len(frequencies_hz)][in_band] = np.fft.rfft(
        signal_values, padded_sample_count
    )[in_band]
    envelope = np.abs(np.fft.ifft(analytic_signal)[: len(signal_values)])
    return float(np.argmax(envelope)) / rate_hz


# Analysis of a record

EVALUATED_MODE_COUNT: Final = 3
"""Number of modes whose peaks and poles are evaluated."""

LARGEST_FREQUENCY_SHIFT: Final = 0.1
"""Largest relative difference between the frequencies of a fitted mode and of the undamped beam's
mode. A damping ratio of 0.4 causes such a difference."""


@dataclass(frozen=True, slots=True)
class FittedModel:
    """Fit of one structure and weighting, with its indices, modes and peaks.

    Attributes
    ----------
    fit : FrfFit
        Fit of the structure with the weighting.
    response : ndarray of complex, shape (n,)
        Response of the model, with the tool inertia, at the fitted bins, in N·m/rad.
    indices : FitIndices
        Distances from the measured response.
    modes : tuple of Mode
        Modes of the beam without tool inertia, from its poles; empty if strong damping leaves a
        mode without a pole.
    are_near_undamped : tuple of bool
        Whether each mode's frequency is within `LARGEST_FREQUENCY_SHIFT` of the undamped beam's. If
        not, the fit does not describe that resonance of the antenna.
    peaks : tuple of Peak or None
        Resonant peaks of `response`, one for each mode.
    deviations : tuple of PeakDeviation or None
        Deviation of each peak from the measured one; None if either response has no peak.
    """

    fit: FrfFit
    response: NDArray[np.complex128]
    indices: FitIndices
    modes: tuple[Mode, ...]
    are_near_undamped: tuple[bool, ...]
    peaks: tuple[Peak | None, ...]
    deviations: tuple[PeakDeviation | None, ...]


@dataclass(frozen=True, slots=True)
class WelchAnalysis:
    """Results of the Welch method for one record.

    Attributes
    ----------
    record : Record
        Analysed record.
    settings : WelchSettings
        Requested settings.
    segmentation : Segmentation
        Segment lengths in samples at the record's sampling rate.
    response : FrequencyResponse
        Estimated response in the band, without the channels' delays.
    whole_record : FrequencyResponse
        Response estimated as the ratio of torque's to angle's Fourier transform over the whole
        record, for comparison; in the same band and without the delays.
    peaks : tuple of Peak or None
        Measured resonant peaks, one for each mode.
    models : tuple of FittedModel
        Fitted models by type, then by weighting, in the order of the settings.
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


def analyse(record: Record, settings: WelchSettings) -> WelchAnalysis:
    """Estimate the frequency response of a record and fit the models to it.

    Parameters
    ----------
    record : Record
        Record of a session.
    settings : WelchSettings
        Estimator, segments, band, types and weightings.

    Raises
    ------
    SettingsError
        The segments, the band or the weightings are not valid.
    FrequencyResponseError
        The motor did not move, or the record is too short for the segments.
    """
    _check_excitation(record)
    response_to_fit, whole_record_response = estimate(record, settings)
    measured_peaks = _mode_peaks(
        record.beam, response_to_fit.frequency_hz, response_to_fit.response
    )
    response_grid = ResponseGrid(2j * np.pi * response_to_fit.frequency_hz)
    try:
        frf_fits = fit_many(
            response_to_fit.frequency_hz,
            response_to_fit.response,
            record.beam,
            [STRUCTURES[name] for name in settings.types],
            settings.weightings,
            tool_inertia_kg_m2=record.tool_inertia_kg_m2,
        )
    except (FitError, WeightingError) as error:
        raise SettingsError(f"{record.path}: {error}") from error
    return WelchAnalysis(
        record=record,
        settings=settings,
        segmentation=settings.segmentation(record.rate_hz),
        response=response_to_fit,
        whole_record=whole_record_response,
        peaks=measured_peaks,
        models=tuple(
            _evaluate_fit(fit, record, response_to_fit, response_grid, measured_peaks)
            for fit in frf_fits
        ),
        warnings=record.warnings + estimate_warnings(record, settings, response_to_fit),
    )


def _check_excitation(record: Record) -> None:
    """Raise if the motor did not move during a record."""
    known_angles_rad = record.angle_rad[record.angle_known]
    if record.metadata.get("excitation") == "hold":
        raise FrequencyResponseError(
            f"{record.path}: nothing was excited: the motor was held; record an excitation, such "
            "as rigd run chirp."
        )
    if known_angles_rad.size == 0 or np.ptp(known_angles_rad) == 0:
        raise FrequencyResponseError(
            f"{record.path}: nothing was excited: the angle never changes; check the encoder and "
            "that the motor moved."
        )


def _evaluate_fit(
    fit: FrfFit,
    record: Record,
    measured_response: FrequencyResponse,
    response_grid: ResponseGrid,
    measured_peaks: tuple[Peak | None, ...],
) -> FittedModel:
    """Return a fitted model with its indices, modes and peaks."""
    beam = record.beam
    plant = Plant(beam, fit.damping, tool_inertia_kg_m2=record.tool_inertia_kg_m2)
    (model_response,) = response_grid.evaluate(plant)
    model_peaks = _mode_peaks(beam, measured_response.frequency_hz, model_response)
    try:
        beam_modes = modes(beam, fit.damping, EVALUATED_MODE_COUNT)
    except ArithmeticError:
        beam_modes = ()
    return FittedModel(
        fit=fit,
        response=model_response,
        indices=fit_indices(
            2 * np.pi * measured_response.frequency_hz, measured_response.response, model_response
        ),
        modes=beam_modes,
        are_near_undamped=_are_near_undamped_modes(beam_modes, beam),
        peaks=model_peaks,
        deviations=tuple(
            None
            if measured_peak is None or model_peak is None
            else peak_deviation(measured_peak, model_peak)
            for measured_peak, model_peak in zip(measured_peaks, model_peaks, strict=True)
        ),
    )


def _are_near_undamped_modes(fitted_modes: tuple[Mode, ...], beam: Beam) -> tuple[bool, ...]:
    """Return for each fitted mode whether its frequency is near the undamped beam's."""
    undamped_hz = undamped_frequencies_rad_s(beam, EVALUATED_MODE_COUNT) / (2 * np.pi)
    return tuple(
        fitted_mode.damping_ratio < 1
        and abs(fitted_mode.frequency_hz / mode_hz - 1) < LARGEST_FREQUENCY_SHIFT
        for fitted_mode, mode_hz in zip(fitted_modes, undamped_hz[: len(fitted_modes)], strict=True)
    )


def _mode_peaks(
    beam: Beam, frequency_hz: NDArray[np.float64], response: NDArray[np.complex128]
) -> tuple[Peak | None, ...]:
    """Return the resonant peaks of a response near the beam's first undamped frequencies."""
    mode_hz = undamped_frequencies_rad_s(beam, EVALUATED_MODE_COUNT) / (2 * np.pi)
    return resonant_peaks(frequency_hz, response, mode_hz)
