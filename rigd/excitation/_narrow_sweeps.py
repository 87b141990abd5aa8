"""Narrow sweeps over the modes of a beam: their bands, amplitudes and times.

A table of modes determines the bands, the rig's limits determine the amplitude in each band, and
the information on the damping determines the time in each band. It is the Fisher information of the
exact model (`rigd.beam`) on the damping's parameters, from the torque with white noise of any size,
with density, stiffness, delay and tool inertia free as well. A band that is swept slowly gives
information in proportion to the time spent there, so the times follow from the information of each
band per second.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import pi
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Final, Protocol

import numpy as np
from annotated_types import doc
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError
from pydantic_core import ErrorDetails

from rigd.beam import (
    GRADIENT_NAMES,
    Beam,
    Damping,
    transfer_and_gradient,
    undamped_frequencies_rad_s,
)
from rigd.beam.tip import SMALL_TIP_SLOPE_RAD
from rigd.documents import DocumentError, read_json
from rigd.excitation._options import RestS, RingDownS, documented
from rigd.excitation._signals import (
    MAX_PLANNED_LIMIT_FRACTION,
    Excitation,
    ExcitationError,
    assemble_excitation,
    lay_out_segments,
    require_frequency,
    require_positive,
    require_within_turn,
)

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_MAX_AMPLITUDE_REDUCTIONS: Final = 8
"""Largest number of times that the amplitude of a sweep is reduced to stay within the limits."""
_LIMIT_FRACTION_TOLERANCE: Final = 1.005
"""Factor by which a sweep may still exceed its fraction of the limits after the last reduction."""

MIN_BAND_TIME_FRACTION: Final = 0.5
"""Shortest time of a band, relative to its time in an equal division: no mode is left out."""

SAME_MODE_FREQUENCY_RATIO: Final = 1.1
"""Largest ratio of two frequencies that belong to one mode. Fits of one record differ by less in a
mode's frequency; the frequencies of a slender beam's modes differ by more."""


# Table of modes

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
"""Type of a finite number above 0 in a document."""
_NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
"""Type of a finite number of at least 0 in a document."""


class _ModeEntry(BaseModel):
    """Mode of one fit in the JSON document of an analysis.

    A value is None if the fit has none, and the frequency is 0 Hz if the mode does not oscillate.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    frequency_hz: _NotNegative | None
    damping_ratio: _Positive | None
    frequency_std_hz: _NotNegative | None = None
    estimator: str | None = None

    @property
    def oscillates(self) -> bool:
        """Whether the mode has a frequency above 0 Hz and a damping ratio."""
        return bool(self.frequency_hz) and self.damping_ratio is not None


class _HeadlineValue(BaseModel):
    """Value with its standard deviation in the main results of an analysis."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    value: _NotNegative | None
    std: _NotNegative | None = None


class _HeadlineMode(BaseModel):
    """Mode in the main results of an analysis, with frequency in Hz and damping ratio."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    frequency_hz: _HeadlineValue
    damping_ratio: _HeadlineValue

    @property
    def entry(self) -> _ModeEntry:
        """Pooled frequency and damping ratio with standard deviations, like those of one fit."""
        return _ModeEntry(
            frequency_hz=self.frequency_hz.value,
            damping_ratio=self.damping_ratio.value or None,
            frequency_std_hz=self.frequency_hz.std,
        )


class _Headline(BaseModel):
    """Main results of an analysis of one record or of a campaign: its list of modes."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    modes: Annotated[list[_HeadlineMode], FailFast()] = []


class _AnalysisDocument(BaseModel):
    """JSON document of an analysis, reduced to the keys from which modes are read."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    headlines: Annotated[list[_Headline], FailFast()] = []
    modes: Annotated[list[_ModeEntry], FailFast()]  # the errors of a million take gigabytes


@dataclass(frozen=True, slots=True)
class FoundMode:
    """Mode of a beam, estimated by one fit or as the median of several fits."""

    frequency_hz: float
    """Frequency of the free decay in Hz."""
    damping_ratio: float
    """Damping ratio, as a fraction of critical damping."""
    uncertainty_hz: float
    """Uncertainty of the frequency in Hz: two standard deviations, stated or from the scatter of
    the fits."""


def read_modes(document_path: str | Path) -> tuple[FoundMode, ...]:
    """Read the modes of a beam from the JSON document of an analysis, lowest frequency first.

    The key ``modes`` is a list of objects with ``frequency_hz`` (of the free decay),
    ``damping_ratio`` and optionally ``frequency_std_hz``. If several fits found a mode, their
    medians are used. Fits of the estimator ``record`` have priority over others. Modes of
    ``headlines``, which are those of the modal model, replace all these. An unreadable file or an
    invalid value raises `ExcitationError`.
    """
    document_path = Path(document_path)
    try:
        analysis_document = _AnalysisDocument.model_validate(_read_json(document_path))
    except ValidationError as error:
        complaint_text = _describe_invalid_value(
            error.errors(include_url=False, include_context=False)[0]
        )
        raise ExcitationError(f"{document_path}: {complaint_text}") from None
    reported_entries = [
        headline_mode.entry
        for headline in analysis_document.headlines
        for headline_mode in headline.modes
    ]
    mode_entries = [
        mode_entry
        for mode_entry in reported_entries or analysis_document.modes
        if mode_entry.oscillates
    ]
    record_entries = [mode_entry for mode_entry in mode_entries if mode_entry.estimator == "record"]
    found_modes = tuple(
        _median_mode(mode_group) for mode_group in _mode_groups(record_entries or mode_entries)
    )
    if not found_modes:
        raise ExcitationError(
            f"{document_path}: modes has no mode that oscillates; use the JSON of an analysis that "
            "found one (analyze session.mcap --json fits.json)."
        )
    return found_modes


def _read_json(path: Path) -> Any:  # noqa: ANN401 - any JSON value
    """Return the content of a JSON file, or raise `ExcitationError` if it cannot be read."""
    try:
        return read_json(path)
    except DocumentError as error:
        raise ExcitationError(
            f"{path}: {error}; write one with analyze session.mcap --json fits.json."
        ) from error


def _describe_invalid_value(error_details: ErrorDetails) -> str:
    """Return a sentence that names an invalid value in a document, with a remedy."""
    document_path = ""
    for path_part in error_details["loc"]:
        document_path += (
            f"[{path_part}]"
            if isinstance(path_part, int)
            else f".{path_part}"
            if document_path
            else path_part
        )
    if not document_path:
        return 'is not a JSON object; it must have the key "modes".'
    if error_details["type"] == "missing":
        return f"{document_path} is missing; give it as analyze --json writes it."
    unit_text = " Hz" if document_path.endswith("_hz") else ""
    given_text = json.dumps(error_details["input"], default=str)
    given_text = given_text if len(given_text) <= 60 else f"{given_text[:60]}..."
    remedy_text = {
        "greater_than": f"must be more than 0{unit_text}",
        "greater_than_equal": f"must not be negative: give it in{unit_text}",
        "finite_number": "is not a finite number",
        "list_type": "must be a list of modes",
        "model_type": "must be an object with frequency_hz and damping_ratio",
        "string_type": "must be a text",
    }.get(error_details["type"], f"must be a number{' in Hz' if unit_text else ''}")
    return f"{document_path} = {given_text}{unit_text} {remedy_text}."


def _mode_groups(mode_entries: Sequence[_ModeEntry]) -> Iterator[list[_ModeEntry]]:
    """Yield lists of entries of several fits that describe the same mode, by rising frequency."""
    mode_group: list[_ModeEntry] = []
    for mode_entry in sorted(mode_entries, key=_frequency_hz):
        if mode_group and _frequency_hz(mode_entry) > SAME_MODE_FREQUENCY_RATIO * _frequency_hz(
            mode_group[0]
        ):
            yield mode_group
            mode_group = []
        mode_group.append(mode_entry)
    if mode_group:
        yield mode_group


def _median_mode(mode_entries: Sequence[_ModeEntry]) -> FoundMode:
    """Return the median of several fits' entries for one mode."""
    median_hz = median(_frequency_hz(mode_entry) for mode_entry in mode_entries)
    stated_std_hz = median(mode_entry.frequency_std_hz or 0.0 for mode_entry in mode_entries)
    # Fits of unsuitable structures lie far off: the median of the distances tolerates them.
    scatter_hz = 1.4826 * median(
        abs(_frequency_hz(mode_entry) - median_hz) for mode_entry in mode_entries
    )
    return FoundMode(
        frequency_hz=median_hz,
        damping_ratio=median(mode_entry.damping_ratio or 0.0 for mode_entry in mode_entries),
        uncertainty_hz=2.0 * max(stated_std_hz, scatter_hz),
    )


def _frequency_hz(mode_entry: _ModeEntry) -> float:
    """Return the frequency of a mode's entry in Hz, or 0 if it has none."""
    return mode_entry.frequency_hz or 0.0


# Bands, and the time spent in each

_FREQUENCIES_PER_BAND: Final = 64
"""Number of frequencies in a band at which the information is computed."""

_TIME_DIVISION_STEPS: Final = 500
"""Number of multiplicative steps in the search for the best division of the time."""
_INFORMATION_REGULARISATION: Final = 1e-12
"""Relative regularisation of the information matrix, since few bands leave some combinations of
parameters undetermined."""


class SweepRig(Protocol):
    """Interface to a rig's predicted behaviour, for which narrow sweeps are planned."""

    @property
    def beam(self) -> Beam:
        """Beam of the rig's profile."""

    def tracking_response(self, frequency_hz: RealArray) -> ComplexArray:
        """Return the frequency response from reference to angle at some frequencies in Hz."""

    def fraction_of_limits(self, reference_rad: RealArray) -> float:
        """Return the largest fraction of a limit that a reference in rad is predicted to use."""

    def tip_slope_rad(self, reference_rad: RealArray) -> float:
        """Return the largest predicted slope in rad of the beam's free end for a reference."""


@dataclass(frozen=True, slots=True)
class Band:
    """Narrow band of frequencies around a mode, which is swept linearly upwards."""

    mode: FoundMode
    """Mode in the band."""
    start_hz: float
    """Lower end of the band in Hz."""
    stop_hz: float
    """Upper end of the band in Hz."""

    @classmethod
    def around_mode(cls, found_mode: FoundMode, half_power_widths: float) -> "Band":
        """Return the band of frequencies to be swept around a mode.

        On either side it extends by the uncertainty of the frequency and by a number of half-power
        widths.
        """
        half_width_hz = (
            half_power_widths * 2.0 * found_mode.damping_ratio * found_mode.frequency_hz
            + found_mode.uncertainty_hz
        )
        # A sweep needs a period: strongly damped modes would begin at 0 Hz or below.
        return cls(
            found_mode, max(found_mode.frequency_hz - half_width_hz, 0.2 * found_mode.frequency_hz),
            found_mode.frequency_hz + half_width_hz,
        )  # fmt: skip

    @property
    def decay_s(self) -> float:
        """Time constant in s with which the mode in the band rings up and decays."""
        return 1.0 / (2.0 * pi * self.mode.frequency_hz * self.mode.damping_ratio)


def time_fractions(
    sweep_bands: Sequence[Band], amplitudes_rad: Sequence[float], rig: SweepRig
) -> RealArray:
    """Return the fraction of the sweep's time for each band that measures damping most precisely.

    The geometric mean of the standard deviations of the damping's parameters is minimised, with all
    other parameters free, by multiplicative steps (D. M. Titterington, 1976; for criteria other
    than the determinant S. D. Silvey, D. M. Titterington and B. Torsney, 1978).
    """
    beam_damping = first_order_damping([band.mode for band in sweep_bands], rig.beam)
    information_rates, damping_count = _information_rates(
        sweep_bands, amplitudes_rad, rig, beam_damping
    )
    parameter_norms = np.sqrt(np.einsum("bii->i", information_rates))
    information_rates = information_rates / np.outer(parameter_norms, parameter_norms)
    band_time_fractions = np.full(len(sweep_bands), 1.0 / len(sweep_bands))
    for _ in range(_TIME_DIVISION_STEPS):
        information = np.tensordot(band_time_fractions, information_rates, axes=1)
        covariance = np.linalg.inv(
            information + _INFORMATION_REGULARISATION * np.eye(len(parameter_norms))
        )
        gain_directions = covariance[:damping_count]
        precision_gains = (
            np.einsum("pi,bij,pj->bp", gain_directions, information_rates, gain_directions)
            / np.diag(covariance)[:damping_count]
        )
        band_time_fractions = band_time_fractions * np.sqrt(precision_gains.sum(axis=1))
        band_time_fractions /= band_time_fractions.sum()
    return band_time_fractions


def first_order_damping(modes: Sequence[FoundMode], beam: Beam) -> Damping:
    """Return the internal and external damping of order 1 that fits the modes' damping ratios best.

    It minimises the squared relative errors of ``2 ratio = zeta omega + gamma / ((rho/EI) omega)``,
    with coefficients that are not negative.
    """
    mode_rad_s = np.array([2.0 * pi * found_mode.frequency_hz for found_mode in modes])
    damping_ratios = np.array([found_mode.damping_ratio for found_mode in modes])
    scaled_columns = np.stack([mode_rad_s, 1.0 / (beam.density_over_stiffness * mode_rad_s)]) / (
        2.0 * damping_ratios
    )
    coefficients = np.linalg.lstsq(scaled_columns.T, np.ones(len(modes)), rcond=None)[0]
    if (coefficients < 0.0).any():
        single_coefficients = scaled_columns.sum(axis=1) / (scaled_columns**2).sum(axis=1)
        squared_errors = ((single_coefficients[:, None] * scaled_columns - 1.0) ** 2).sum(axis=1)
        coefficients = np.where(np.arange(2) == np.argmin(squared_errors), single_coefficients, 0.0)
    return Damping(
        zeta=float(coefficients[0]), alpha=1.0, gamma=float(coefficients[1]), lambda_=1.0
    )


def _information_rates(
    sweep_bands: Sequence[Band], amplitudes_rad: Sequence[float], rig: SweepRig, damping: Damping
) -> tuple[RealArray, int]:
    """Return the Fisher information per second of each band, and the number of damping parameters.

    The information has the shape (bands, k, k), with the damping's parameters first. That on
    coefficients is on their relative changes. The order of an absent damping is not a parameter.
    """
    damping_factors = {"zeta": damping.zeta, "alpha": 1.0, "gamma": damping.gamma, "lambda": 1.0}
    coefficients_by_order = {"alpha": damping.zeta, "lambda": damping.gamma}
    parameter_names = [
        n
        for n, damping_factor in damping_factors.items()
        if damping_factor > 0.0 and coefficients_by_order.get(n, 1.0) > 0.0
    ]
    information_rates = []
    for sweep_band, amplitude_rad in zip(sweep_bands, amplitudes_rad, strict=True):
        frequency_hz = np.linspace(sweep_band.start_hz, sweep_band.stop_hz, _FREQUENCIES_PER_BAND)
        s = 2j * pi * frequency_hz
        band_beam = _beam_with_mode(rig.beam, sweep_band.mode.frequency_hz)
        g, gradient = transfer_and_gradient(
            s, band_beam, damping, (*parameter_names, *GRADIENT_NAMES[4:])
        )
        gradient[: len(parameter_names)] *= np.array(
            [damping_factors[parameter_name] for parameter_name in parameter_names]
        )[:, None]
        whitened_rows = np.concatenate([gradient, [-s * g, s * s]])
        whitened_rows *= amplitude_rad * rig.tracking_response(frequency_hz)
        information_rates.append(
            (whitened_rows.conj() @ whitened_rows.T).real / _FREQUENCIES_PER_BAND
        )
    return np.array(information_rates), len(parameter_names)


def _beam_with_mode(beam: Beam, frequency_hz: float) -> Beam:
    """Return the beam with a density such that its mode nearest to a frequency has this frequency.

    It is needed because the profile's frequencies may be wrong by more than the width of a band.
    """
    target_mode_rad_s = 2.0 * pi * frequency_hz
    beam_mode_frequencies_rad_s = undamped_frequencies_rad_s(beam, 12)
    nearest_mode_rad_s = beam_mode_frequencies_rad_s[
        np.argmin(np.abs(np.log(beam_mode_frequencies_rad_s / target_mode_rad_s)))
    ]
    return Beam(
        length_m=beam.length_m,
        density_kg_per_m=beam.density_kg_per_m * float(nearest_mode_rad_s / target_mode_rad_s) ** 2,
        bending_stiffness_n_m2=beam.bending_stiffness_n_m2,
    )


# Sweeps


@documented
def modes(
    *,
    rate_hz: Annotated[float, doc("Ticks a second.")],
    path: Annotated[
        str | Path,
        doc("JSON with the modes: see `rigd.excitation._narrow_sweeps.read_modes`."),
    ],
    amplitude_rad: Annotated[
        float,
        doc(
            "Amplitude in each band. It is lower if the rig's limits or the slope of the tip "
            "require it."
        ),
    ] = 0.025,
    stop_hz: Annotated[float, doc("Highest frequency of a mode that is swept.")] = 50.0,
    widths: Annotated[
        float,
        doc(
            "Number of half-power widths swept on either side of a mode, in addition to the "
            "uncertainty of its frequency."
        ),
    ] = 1.0,
    duration_s: Annotated[float, doc("Total duration of all sweeps in s.")] = 120.0,
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 15.0,
    taper_s: Annotated[
        float,
        doc(
            "Duration in s of the raised-cosine fade at both ends of every sweep, so that angle "
            "and speed are zero where two sweeps meet."
        ),
    ] = 1.0,
    tip_slope_rad: Annotated[
        float,
        doc("Largest slope of the beam's free end, of which the sweeps use 90 %."),
    ] = SMALL_TIP_SLOPE_RAD,
    rig: Annotated[
        SweepRig | None,
        doc(
            "Rig whose limits determine the amplitudes, and whose beam determines the times by "
            "the information on the damping; None: equal amplitudes and times."
        ),
    ] = None,
) -> Excitation:
    """Return an excitation with a linear sweep through a narrow band around each mode.

    Raises
    ------
    ExcitationError
        If an option is out of range or the file is invalid.
    """
    require_positive("amplitude_rad", amplitude_rad, "rad")
    require_within_turn("amplitude_rad", amplitude_rad)
    require_frequency("stop_hz", stop_hz, rate_hz)
    require_positive("widths", widths, "half-power widths")
    require_positive("taper_s", taper_s, "s")
    require_positive("tip_slope_rad", tip_slope_rad, "rad")
    segments = lay_out_segments(rate_hz, rest_s, duration_s, ring_down_s)
    sweep_begin, sweep_end = segments["sweep"]
    sweep_bands = _read_bands(Path(path), stop_hz, widths, rate_hz)
    fade_ticks = 2 * round(taper_s * rate_hz)
    if (
        fade_ticks < 2
        or MIN_BAND_TIME_FRACTION * (sweep_end - sweep_begin) / len(sweep_bands) < fade_ticks
    ):
        raise ExcitationError(
            f"duration_s = {duration_s:g} s is too short for fades of taper_s = {taper_s:g} s at "
            f"both ends of {len(sweep_bands)} sweeps; choose at least "
            f"{2.0 * taper_s * len(sweep_bands) / MIN_BAND_TIME_FRACTION:g} s, or a taper_s from "
            f"{2 / rate_hz:g} s."
        )
    sweep_ticks = _divide_ticks(
        np.full(len(sweep_bands), 1.0 / len(sweep_bands)), sweep_end - sweep_begin
    )
    amplitudes_rad = [amplitude_rad] * len(sweep_bands)
    unit_sweeps = [
        _unit_sweep(*band_and_ticks, fade_ticks, rate_hz)
        for band_and_ticks in zip(sweep_bands, sweep_ticks, strict=True)
    ]
    if rig is not None:
        reduced_amplitudes_rad = _admissible_amplitudes(
            unit_sweeps, amplitude_rad, tip_slope_rad, rig
        )
        sweep_ticks = _divide_ticks(
            _raise_to_min_fraction(time_fractions(sweep_bands, reduced_amplitudes_rad, rig)),
            sweep_end - sweep_begin,
        )
        unit_sweeps = [
            _unit_sweep(*band_and_ticks, fade_ticks, rate_hz)
            for band_and_ticks in zip(sweep_bands, sweep_ticks, strict=True)
        ]
        amplitudes_rad = _admissible_amplitudes(unit_sweeps, amplitude_rad, tip_slope_rad, rig)
    reference_rad = np.concatenate(
        [a * s for a, s in zip(amplitudes_rad, unit_sweeps, strict=True)]
    )
    parameters: dict[str, float | int | str] = {
        "file": Path(path).name,
        "amplitude_rad": max(amplitudes_rad),
        "start_hz": min(band.start_hz for band in sweep_bands),
        "stop_hz": max(band.stop_hz for band in sweep_bands),
        "widths": widths,
        "duration_s": duration_s,
        "rest_s": rest_s,
        "ring_down_s": ring_down_s,
        "taper_s": taper_s,
        "tip_slope_rad": tip_slope_rad,
        "bands": "; ".join(
            f"{band.start_hz:.6g}-{band.stop_hz:.6g} Hz, {band_amplitude:.4g} rad, "
            f"{ticks / rate_hz:.6g} s"
            for band, band_amplitude, ticks in zip(
                sweep_bands, amplitudes_rad, sweep_ticks, strict=True
            )
        ),
    }
    return assemble_excitation("modes", parameters, rate_hz, segments, reference_rad)


def _read_bands(path: Path, stop_hz: float, half_power_widths: float, rate_hz: float) -> list[Band]:
    """Read modes from a document and return their bands, that of the slowest decay first."""
    all_modes = read_modes(path)
    modes_in_band = [found_mode for found_mode in all_modes if found_mode.frequency_hz <= stop_hz]
    if not modes_in_band:
        raise ExcitationError(
            f"{path}: the lowest mode, frequency_hz = {all_modes[0].frequency_hz:g} Hz, lies "
            f"above stop_hz = {stop_hz:g} Hz; raise stop_hz."
        )
    sweep_bands = sorted(
        (Band.around_mode(found_mode, half_power_widths) for found_mode in modes_in_band),
        key=lambda sweep_band: -sweep_band.decay_s,
    )
    for sweep_band in sweep_bands:
        require_frequency(
            f"The upper end of a band of {half_power_widths:g} widths", sweep_band.stop_hz, rate_hz
        )
    return sweep_bands


def _admissible_amplitudes(
    unit_sweeps: Sequence[RealArray], amplitude_rad: float, tip_slope_rad: float, rig: SweepRig
) -> list[float]:
    """Return the amplitude of each sweep in rad, reduced where the rig's limits require it.

    Each sweep is predicted together with those before it, since a mode still rings during the next
    sweep.
    """
    amplitudes_rad = []
    earlier_sweeps_rad = np.empty(0)
    for sweep in unit_sweeps:
        reduced_amplitude_rad = amplitude_rad
        for _ in range(_MAX_AMPLITUDE_REDUCTIONS):
            sweeps_so_far_rad = np.concatenate([earlier_sweeps_rad, reduced_amplitude_rad * sweep])
            limit_fraction = max(
                rig.fraction_of_limits(sweeps_so_far_rad),
                rig.tip_slope_rad(sweeps_so_far_rad) / tip_slope_rad,
            )
            if limit_fraction <= MAX_PLANNED_LIMIT_FRACTION * _LIMIT_FRACTION_TOLERANCE:
                break
            reduced_amplitude_rad *= MAX_PLANNED_LIMIT_FRACTION / limit_fraction
        amplitudes_rad.append(reduced_amplitude_rad)
        earlier_sweeps_rad = np.concatenate([earlier_sweeps_rad, reduced_amplitude_rad * sweep])
    return amplitudes_rad


def _divide_ticks(band_fractions: RealArray, tick_count: int) -> list[int]:
    """Divide `tick_count` ticks in proportion to `band_fractions`; the sum is exact."""
    end_ticks = np.round(np.cumsum(band_fractions) * tick_count).astype(int)
    return [int(part_ticks) for part_ticks in np.diff(end_ticks, prepend=0)]


def _raise_to_min_fraction(band_fractions: RealArray) -> RealArray:
    """Return the bands' fractions of the time, each raised to the least that is allowed.

    The other fractions are reduced in proportion, so that the sum remains 1.
    """
    min_fraction = MIN_BAND_TIME_FRACTION / len(band_fractions)
    is_low = band_fractions < min_fraction
    for _ in band_fractions:
        remaining_scale = (1.0 - min_fraction * np.count_nonzero(is_low)) / band_fractions[
            ~is_low
        ].sum()
        raised_fractions = np.where(is_low, min_fraction, band_fractions * remaining_scale)
        is_low = raised_fractions <= min_fraction
    return raised_fractions


def _unit_sweep(band: Band, tick_count: int, fade_ticks: int, rate_hz: float) -> RealArray:
    """Return a sweep of amplitude 1 through a band, shape (tick_count,).

    A raised-cosine fade at either end takes half of `fade_ticks`.
    """
    duration_s = tick_count / rate_hz
    t = np.arange(tick_count) / rate_hz
    phase_rad = (
        2.0 * pi * (band.start_hz * t + (band.stop_hz - band.start_hz) * t**2 / (2 * duration_s))
    )
    edge_fraction = np.minimum(np.arange(tick_count), tick_count - np.arange(tick_count)) / (
        fade_ticks / 2
    )
    return (0.5 - 0.5 * np.cos(pi * np.minimum(edge_fraction, 1.0))) * np.sin(phase_rad)
