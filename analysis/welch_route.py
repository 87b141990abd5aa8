"""The paper's route from a record to models: Welch estimate, twelve fits, indices, modes, peaks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.estimate import EstimateError, SettingsError, estimate, estimate_warnings
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
from analysis.weights import WeightingError
from rigd.beam import modes, undamped_frequencies_rad_s

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from analysis.record import Record
    from analysis.settings import WelchSettings
    from rigd.beam import Beam, Mode
    from rigd.spectral import FrequencyResponse, Segmentation

MODES: Final = 3
LARGEST_SHIFT: Final = 0.1
"""Of a mode's frequency against the undamped beam's: as much as a damping ratio of 0.4 makes."""


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
    followed : tuple of bool
        Mode by mode, whether it vibrates, and within `LARGEST_SHIFT` of the undamped beam's
        frequency. If not, the fit has let go of that resonance: the mode is not the antenna's.
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
    """Results for one record.

    Attributes
    ----------
    record : Record
    settings : WelchSettings
        As asked for.
    segmentation : Segmentation
        As used: the settings at the record's rate.
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
    EstimateError
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
        models.extend(_judged(fit, record.beam, response, beam_on_tool, peaks) for fit in fits)
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
    """Refuse a record in which the motor did not move, before segments and bands are discussed."""
    angles = record.angle_rad[record.angle_known]
    if record.metadata.get("excitation") == "hold":
        raise EstimateError(
            f"{record.path}: nothing was excited: the motor was held; record an excitation, such "
            "as rigd run chirp."
        )
    if angles.size == 0 or np.ptp(angles) == 0:
        raise EstimateError(
            f"{record.path}: nothing was excited: the angle never changes; check the encoder and "
            "that the motor moved."
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
    """Tell the modes that vibrate about where the undamped beam's do."""
    undamped_hz = undamped_frequencies_rad_s(beam, MODES) / (2 * np.pi)
    return tuple(
        mode.damping_ratio < 1 and abs(mode.frequency_hz / own_hz - 1) < LARGEST_SHIFT
        for mode, own_hz in zip(found, undamped_hz[: len(found)], strict=True)
    )


def _peaks(
    beam: Beam, frequency_hz: NDArray[np.float64], response: NDArray[np.complex128]
) -> tuple[Peak | None, ...]:
    """Resonant peaks near the beam's first undamped frequencies."""
    mode_hz = undamped_frequencies_rad_s(beam, MODES) / (2 * np.pi)
    return resonant_peaks(frequency_hz, response, mode_hz)
