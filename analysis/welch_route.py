"""The paper's route from a record to models: Welch estimate, twelve fits, indices, modes, peaks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.fit_frf import FitError, FrfFit, fit_many
from analysis.indices import (
    Indices,
    Peak,
    PeakDeviation,
    fit_indices,
    peak_deviation,
    resonant_peaks,
)
from analysis.model import FrequencyResponseModel
from analysis.structures import STRUCTURES
from analysis.unknowns import undamped_frequencies_rad_s
from analysis.weights import WeightingError
from rigd.beam import modes
from rigd.spectral import (
    PAPER_NFFT,
    PAPER_OVERLAP,
    PAPER_SEGMENT_LENGTH,
    FrequencyResponse,
    SpectralError,
    fft_response,
    segment_count,
    segment_lengths,
    welch_response,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from analysis.record import Record
    from rigd.beam import Beam, Mode

PAPER_RATE_HZ: Final = 1000.0
PAPER_SEGMENTS: Final = 8
PAPER_OVERLAP_FRACTION: Final = 0.15
PAPER_BAND_HZ: Final = (0.5875, 50.0)
PAPER_TYPES: Final = ("I", "II", "III", "IV", "V", "VI")
PAPER_WEIGHTINGS: Final = ("const", "omega")
MODES: Final = 3


class RouteError(ValueError):
    """A record from which the estimate asked for cannot be made."""


class SettingsError(RouteError):
    """Settings that make no sense, or none for this record's rate."""


@dataclass(frozen=True, slots=True)
class WelchSettings:
    """How the frequency response is estimated and what is fitted to it.

    Attributes
    ----------
    estimator : {"h1", "h2", "hv", "fft"}
        "fft" is the ratio of two transforms of the whole record.
    segment_length, overlap, nfft : int, optional
        In samples; None takes the paper's durations at the record's rate, or with a segment given
        15 % of it as overlap and a transform no shorter than it.
    band_hz : tuple of float
        First and last frequency fitted, both included.
    types : tuple of str
        Names of `analysis.structures.STRUCTURES`.
    weightings : tuple of str
        Names that `analysis.weights.weights` knows.
    """

    estimator: Literal["h1", "h2", "hv", "fft"] = "h1"
    segment_length: int | None = None
    overlap: int | None = None
    nfft: int | None = None
    band_hz: tuple[float, float] = PAPER_BAND_HZ
    types: tuple[str, ...] = PAPER_TYPES
    weightings: tuple[str, ...] = PAPER_WEIGHTINGS

    def at_rate(self, rate_hz: float) -> WelchSettings:
        """Fill in what was left open: the paper's durations, in samples at this rate."""
        scale = rate_hz / PAPER_RATE_HZ
        length, overlap, nfft = self.segment_length, self.overlap, self.nfft
        if overlap is None:
            overlap = round(
                PAPER_OVERLAP * scale if length is None else PAPER_OVERLAP_FRACTION * length
            )
        if length is None:
            length = round(PAPER_SEGMENT_LENGTH * scale)
        if nfft is None:
            nfft = max(round(PAPER_NFFT * scale), length)
        return replace(self, segment_length=length, overlap=overlap, nfft=nfft)


@dataclass(frozen=True, slots=True)
class FittedModel:
    """One fit with all that is said of it.

    Attributes
    ----------
    fit : FrfFit
    response : ndarray of complex, shape (n,)
        The model with the tool's inertia on the bins that were fitted, in N·m/rad.
    indices : Indices
    modes : tuple of Mode
        Of the beam alone, from its poles; empty where damping is so strong that one has none.
    peaks : tuple of Peak or None
        Resonant peaks of `response`, mode by mode.
    deviations : tuple of PeakDeviation or None
        From the measured peaks; None where either has no peak.
    """

    fit: FrfFit
    response: NDArray[np.complex128]
    indices: Indices
    modes: tuple[Mode, ...]
    peaks: tuple[Peak | None, ...]
    deviations: tuple[PeakDeviation | None, ...]


@dataclass(frozen=True, slots=True)
class WelchAnalysis:
    """Results for one record.

    Attributes
    ----------
    record : Record
    settings : WelchSettings
        As used: nothing left open.
    response : FrequencyResponse
        In the band, without the channels' delays.
    whole_record : FrequencyResponse
        Ratio of the transforms of the whole record, likewise, for comparison.
    peaks : tuple of Peak or None
        Measured resonant peaks, mode by mode.
    models : tuple of FittedModel
        By type, then by weighting, in the order of the settings.
    warnings : tuple of str
        What an analyst should read beside the results, the record's included.
    """

    record: Record
    settings: WelchSettings
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
    RouteError
        The record is too short for the segments, or its angle does not move.
    """
    settings = settings.at_rate(record.rate_hz)
    response, whole_record = _estimates(record, settings)
    on_step("frequency response")
    mode_hz = undamped_frequencies_hz(record.beam, MODES)
    peaks = resonant_peaks(response.frequency_hz, response.response, mode_hz)
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
        models.extend(_judged(fit, record.beam, response, beam_on_tool, peaks) for fit in fits)
        on_step(f"type {name}")
    return WelchAnalysis(
        record=record,
        settings=settings,
        response=response,
        whole_record=whole_record,
        peaks=peaks,
        models=tuple(models),
        warnings=record.warnings + _warnings(record, settings, response),
    )


def _judged(
    fit: FrfFit,
    beam: Beam,
    measured: FrequencyResponse,
    beam_on_tool: FrequencyResponseModel,
    measured_peaks: tuple[Peak | None, ...],
) -> FittedModel:
    """Evaluate a fitted model and all indices of it."""
    response = beam_on_tool.evaluate(fit.damping)
    mode_hz = undamped_frequencies_hz(beam, MODES)
    peaks = resonant_peaks(measured.frequency_hz, response, mode_hz)
    try:
        found = modes(beam, fit.damping, MODES)
    except ArithmeticError:
        found = ()
    return FittedModel(
        fit=fit,
        response=response,
        indices=fit_indices(2 * np.pi * measured.frequency_hz, measured.response, response),
        modes=found,
        peaks=peaks,
        deviations=tuple(
            None if seen is None or modelled is None else peak_deviation(seen, modelled)
            for seen, modelled in zip(measured_peaks, peaks, strict=True)
        ),
    )


def undamped_frequencies_hz(beam: Beam, count: int) -> NDArray[np.float64]:
    """Clamped-free natural frequencies of the beam without damping, shape (count,)."""
    return undamped_frequencies_rad_s(beam, count) / (2 * np.pi)


def _estimates(
    record: Record, settings: WelchSettings
) -> tuple[FrequencyResponse, FrequencyResponse]:
    """Estimate to be fitted and whole-record estimate, both in the band and without delays."""
    length, overlap, nfft = _checked_lengths(record, settings)
    # A constant angle asks no torque of the beam, but would leak into the lowest bins of both.
    angle = record.angle_rad - (record.rest_angle_rad or 0.0)
    try:
        whole_record = fft_response(angle, record.torque_nm, record.rate_hz, max(nfft, len(angle)))
        if settings.estimator == "fft":
            estimate = whole_record
        else:
            estimate = welch_response(
                angle[record.sweep],
                record.torque_nm[record.sweep],
                record.rate_hz,
                segment_length=length,
                overlap=overlap,
                nfft=nfft,
                estimator=settings.estimator,
            )
    except SpectralError as error:
        raise RouteError(f"{record.path}: {error}") from error
    try:
        estimate, whole_record = (
            each.band(*settings.band_hz).without_delays(
                input_delay_s=record.angle_delay_s, output_delay_s=record.torque_delay_s
            )
            for each in (estimate, whole_record)
        )
    except SpectralError as error:
        raise SettingsError(f"{record.path}: {error}") from error
    unknown = np.flatnonzero(~np.isfinite(estimate.response))
    if unknown.size:
        raise RouteError(
            f"{record.path}: the angle has no power at {estimate.frequency_hz[unknown[0]]:g} Hz, "
            "so there is no frequency response there; choose a --band that was excited."
        )
    return estimate, whole_record


def _checked_lengths(record: Record, settings: WelchSettings) -> tuple[int, int, int]:
    """Return segment length, overlap and nfft once they and the band are known to fit."""
    length, overlap, nfft = settings.segment_length, settings.overlap, settings.nfft
    assert length is not None
    assert overlap is not None
    assert nfft is not None
    nyquist_hz = record.rate_hz / 2
    if settings.band_hz[1] > nyquist_hz:
        raise SettingsError(
            f"{record.path}: the band reaches {settings.band_hz[1]:g} Hz, but samples at "
            f"{record.rate_hz:g} Hz tell nothing beyond {nyquist_hz:g} Hz; lower --band."
        )
    if settings.estimator == "fft":
        return length, overlap, nfft
    if overlap >= length:
        raise SettingsError(
            f"The overlap of {overlap} samples must be shorter than a segment of {length}; "
            "lower --overlap."
        )
    if nfft < length:
        raise SettingsError(
            f"nfft of {nfft} samples is shorter than a segment of {length}, which is padded and "
            "never cut; raise --nfft."
        )
    samples = record.sweep_samples
    if segment_count(samples, length, overlap) == 0:
        raise RouteError(
            f"{record.path}: the sweep has {samples} samples ({samples / record.rate_hz:g} s), "
            f"fewer than one Welch segment of {length}{_remedy(samples)}"
        )
    return length, overlap, nfft


def _remedy(samples: int) -> str:
    """Say what would fit a sweep of so many samples, as the end of a sentence."""
    try:
        length, overlap = segment_lengths(samples, PAPER_SEGMENTS, PAPER_OVERLAP_FRACTION)
    except SpectralError:
        return "; that is too little for any estimate."
    return (
        f"; --segment {length} --overlap {overlap} makes {PAPER_SEGMENTS} segments of it, "
        "and --frf fft needs none."
    )


def _warnings(
    record: Record, settings: WelchSettings, response: FrequencyResponse
) -> tuple[str, ...]:
    found = []
    if settings.estimator != "fft" and response.segments < PAPER_SEGMENTS:
        found.append(
            f"Only {response.segments} Welch segment(s) of {settings.segment_length} samples fit "
            f"the sweep of {record.sweep_samples}{_remedy(record.sweep_samples)}"
        )
    stop_hz = _number(record.metadata.get("stop_hz"))
    start_hz = _number(record.metadata.get("start_hz"))
    first_hz, last_hz = settings.band_hz
    if (start_hz is not None and start_hz > first_hz) or (
        stop_hz is not None and stop_hz < last_hz
    ):
        found.append(
            f"The band {first_hz:g} to {last_hz:g} Hz reaches beyond the excitation "
            f"({record.metadata.get('start_hz')} to {record.metadata.get('stop_hz')} Hz): what "
            "was not excited is noise; narrow --band."
        )
    return tuple(found)


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None
