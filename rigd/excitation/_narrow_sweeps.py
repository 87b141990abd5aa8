"""Narrow sweeps over the modes of a beam: their bands, amplitudes and times.

A table of modes gives the bands. The rig's limits give the amplitude in each, and the information
on the damping gives the time in each. That is measured by the Fisher
information of the exact model (`rigd.beam`): information from the torque, with white noise of any
size on it, on the damping's parameters, with density, stiffness, delay and tool inertia free as
well. A band that is swept slowly gives information in proportion to the time spent there, so the
times follow from the information of each band per second.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import pi
from pathlib import Path
from statistics import median
from typing import Annotated, Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError
from pydantic_core import ErrorDetails

from rigd.beam import PARAMETERS, Beam, Damping, transfer_and_gradient, undamped_frequencies_rad_s
from rigd.beam.tip import SMALL_SLOPE_RAD
from rigd.documents import DocumentError, read_json
from rigd.excitation._signals import (
    LIMIT_FRACTION,
    Excitation,
    ExcitationError,
    assemble,
    frequency,
    lay_out_segments,
    positive,
    within_a_turn,
)

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

_EASINGS: Final = 8
_CLOSE_ENOUGH: Final = 1.005

LEAST_TIME_FRACTION: Final = 0.5
"""Least time of a band, as a fraction of an equal division: no mode is left out."""

SAME_MODE: Final = 1.1
"""Fits of one record differ by less than this factor in a mode's frequency; the frequencies of a
slender beam differ by more."""


# Table of modes

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class _Entry(BaseModel):
    """Mode of one fit; null where the fit has none, 0 Hz where it does not oscillate."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    frequency_hz: _NotNegative | None
    damping_ratio: _Positive | None
    frequency_std_hz: _NotNegative | None = None
    estimator: str | None = None

    @property
    def oscillates(self) -> bool:
        return bool(self.frequency_hz) and self.damping_ratio is not None


class _Number(BaseModel):
    """Number of a headline."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    value: _NotNegative | None
    std: _NotNegative | None = None


class _HeadlineMode(BaseModel):
    """Mode of a headline: of the modal model where the record shows it."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    frequency_hz: _Number
    damping_ratio: _Number

    @property
    def entry(self) -> _Entry:
        """Return it in the form of one fit's mode."""
        return _Entry(
            frequency_hz=self.frequency_hz.value,
            damping_ratio=self.damping_ratio.value or None,
            frequency_std_hz=self.frequency_hz.std,
        )


class _Headline(BaseModel):
    """Main results that an analysis reports of one record or of a campaign."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    modes: Annotated[list[_HeadlineMode], FailFast()] = []


class _Document(BaseModel):
    """The part of the analyser's document that is used here."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    headlines: Annotated[list[_Headline], FailFast()] = []
    modes: Annotated[list[_Entry], FailFast()]  # the errors of a million take gigabytes


@dataclass(frozen=True, slots=True)
class FoundMode:
    """A mode, from one fit or from several."""

    frequency_hz: float
    damping_ratio: float
    uncertainty_hz: float
    """Uncertainty of the frequency: two standard deviations, stated or from the fits' scatter."""


def read_modes(path: str | Path) -> tuple[FoundMode, ...]:
    """Read the modes, lowest frequency first.

    Parameters
    ----------
    path
        JSON with the key ``modes``: a list of objects with ``frequency_hz`` (Hz, of the free decay)
        and ``damping_ratio``, and optionally ``frequency_std_hz``. Other keys are ignored. Where
        several fits found a mode, their medians are used; fits of the estimator ``record`` have
        priority over others. Modes of ``headlines``, those of the modal model, replace all these.

    Raises
    ------
    ExcitationError
        If the file cannot be read or has an invalid value.
    """
    path = Path(path)
    try:
        document = _Document.model_validate(_read_json(path))
    except ValidationError as error:
        complaint = _complaint(error.errors(include_url=False, include_context=False)[0])
        raise ExcitationError(f"{path}: {complaint}") from None
    reported = [mode.entry for headline in document.headlines for mode in headline.modes]
    entries = [entry for entry in reported or document.modes if entry.oscillates]
    of_records = [entry for entry in entries if entry.estimator == "record"]
    modes = tuple(_merged(group) for group in _groups(of_records or entries))
    if not modes:
        raise ExcitationError(
            f"{path}: modes has no mode that oscillates; take the document of an analysis that "
            "found one (analyze session.mcap --json fits.json)."
        )
    return modes


def _read_json(path: Path) -> Any:  # noqa: ANN401 - any JSON value
    try:
        return read_json(path)
    except DocumentError as error:
        raise ExcitationError(
            f"{path}: {error}; write one with analyze session.mcap --json fits.json."
        ) from error


def _complaint(detail: ErrorDetails) -> str:
    """Describe one invalid value, in one sentence with a remedy."""
    where = ""
    for part in detail["loc"]:
        where += f"[{part}]" if isinstance(part, int) else f".{part}" if where else part
    if not where:
        return 'is no JSON object; it must have the key "modes".'
    if detail["type"] == "missing":
        return f"{where} is missing; give it as analyze --json writes it."
    unit = " Hz" if where.endswith("_hz") else ""
    given = json.dumps(detail["input"], default=str)
    given = given if len(given) <= 60 else f"{given[:60]}..."
    remedy = {
        "greater_than": f"must be more than 0{unit}",
        "greater_than_equal": f"must not be negative: give it in{unit}",
        "finite_number": "is not a finite number",
        "list_type": "must be a list of modes",
        "model_type": "must be an object with frequency_hz and damping_ratio",
        "string_type": "must be a text",
    }.get(detail["type"], f"must be a number{' in Hz' if unit else ''}")
    return f"{where} = {given}{unit} {remedy}."


def _groups(entries: Sequence[_Entry]) -> Iterator[list[_Entry]]:
    """Group the entries of several fits that describe one mode."""
    group: list[_Entry] = []
    for entry in sorted(entries, key=_frequency_hz):
        if group and _frequency_hz(entry) > SAME_MODE * _frequency_hz(group[0]):
            yield group
            group = []
        group.append(entry)
    if group:
        yield group


def _merged(group: Sequence[_Entry]) -> FoundMode:
    middle_hz = median(_frequency_hz(entry) for entry in group)
    stated_hz = median(entry.frequency_std_hz or 0.0 for entry in group)
    # Fits of unsuitable structures lie far off: the median of the distances tolerates them.
    between_hz = 1.4826 * median(abs(_frequency_hz(entry) - middle_hz) for entry in group)
    return FoundMode(
        frequency_hz=middle_hz,
        damping_ratio=median(entry.damping_ratio or 0.0 for entry in group),
        uncertainty_hz=2.0 * max(stated_hz, between_hz),
    )


def _frequency_hz(entry: _Entry) -> float:
    return entry.frequency_hz or 0.0


# Bands, and the time spent in each

_POINTS: Final = 64
"""Frequencies in a band at which the information is computed."""

_ROUNDS: Final = 500
_REGULARISATION: Final = 1e-12
"""Relative regularisation: few bands leave some combinations of parameters undetermined."""


class SweepRig(Protocol):
    """Interface to a rig's predicted behaviour before it moves."""

    @property
    def beam(self) -> Beam:
        """The specimen according to the profile."""

    def tracking(self, frequency_hz: Real) -> Complex:
        """Return angle over reference, in the shape of the frequencies."""

    def fraction_of_limits(self, reference_rad: Real) -> float:
        """Return the largest predicted fraction of a limit for a reference (n,)."""

    def tip_slope_rad(self, reference_rad: Real) -> float:
        """Return the largest predicted slope of the free end for a reference (n,)."""


@dataclass(frozen=True, slots=True)
class Band:
    """A narrow band that is swept linearly from its lower to its upper end."""

    mode: FoundMode
    start_hz: float
    stop_hz: float

    @classmethod
    def of_mode(cls, mode: FoundMode, widths: float) -> "Band":
        """Return the band around a mode: so many half-power widths beyond its uncertainty."""
        half_hz = widths * 2.0 * mode.damping_ratio * mode.frequency_hz + mode.uncertainty_hz
        # A sweep needs a period: strongly damped modes would begin at 0 Hz or below.
        return cls(
            mode, max(mode.frequency_hz - half_hz, 0.2 * mode.frequency_hz),
            mode.frequency_hz + half_hz,
        )  # fmt: skip

    @property
    def decay_s(self) -> float:
        """Time constant with which the mode rings up and down."""
        return 1.0 / (2.0 * pi * self.mode.frequency_hz * self.mode.damping_ratio)


def time_fractions(bands: Sequence[Band], amplitudes_rad: Sequence[float], rig: SweepRig) -> Real:
    """Return the time fractions of the bands that determine the damping most precisely.

    They minimise the geometric mean of the standard deviations of the damping's parameters, with
    all other parameters free, by multiplicative steps (D. M. Titterington, 1976; for criteria
    other than the determinant S. D. Silvey, D. M. Titterington and B. Torsney, 1978).

    Parameters
    ----------
    bands, amplitudes_rad
        Bands, and the amplitude of the reference in each.
    rig
        Gives the angle for a reference.

    Returns
    -------
    ndarray, shape (len(bands),)
        Fractions with the sum 1.
    """
    damping = damping_of([band.mode for band in bands], rig.beam)
    rates, wanted = _information_rates(bands, amplitudes_rad, rig, damping)
    scale = np.sqrt(np.einsum("bii->i", rates))
    rates = rates / np.outer(scale, scale)
    fractions = np.full(len(bands), 1.0 / len(bands))
    for _ in range(_ROUNDS):
        information = np.tensordot(fractions, rates, axes=1)
        covariance = np.linalg.inv(information + _REGULARISATION * np.eye(len(scale)))
        lines = covariance[:wanted]
        of_bands = np.einsum("pi,bij,pj->bp", lines, rates, lines) / np.diag(covariance)[:wanted]
        fractions = fractions * np.sqrt(of_bands.sum(axis=1))
        fractions /= fractions.sum()
    return fractions


def damping_of(modes: Sequence[FoundMode], beam: Beam) -> Damping:
    """Fit a first-order damping, internal and external, to the modes' damping ratios.

    Relative least squares of ``2 ratio = zeta omega + gamma / ((rho/EI) omega)``; no coefficient
    is negative.
    """
    omega = np.array([2.0 * pi * mode.frequency_hz for mode in modes])
    ratio = np.array([mode.damping_ratio for mode in modes])
    columns = np.stack([omega, 1.0 / (beam.density_over_stiffness * omega)]) / (2.0 * ratio)
    both = np.linalg.lstsq(columns.T, np.ones(len(modes)), rcond=None)[0]
    if (both < 0.0).any():
        alone = columns.sum(axis=1) / (columns**2).sum(axis=1)
        left = ((alone[:, None] * columns - 1.0) ** 2).sum(axis=1)
        both = np.where(np.arange(2) == np.argmin(left), alone, 0.0)
    return Damping(zeta=float(both[0]), alpha=1.0, gamma=float(both[1]), lambda_=1.0)


def _information_rates(
    bands: Sequence[Band], amplitudes_rad: Sequence[float], rig: SweepRig, damping: Damping
) -> tuple[Real, int]:
    """Return the information per second of each band, (bands, k, k), damping parameters first.

    Coefficients are relative. The order of an absent damping cannot be estimated.
    """
    factors = {"zeta": damping.zeta, "alpha": 1.0, "gamma": damping.gamma, "lambda": 1.0}
    orders = {"alpha": damping.zeta, "lambda": damping.gamma}
    names = [n for n, factor in factors.items() if factor > 0.0 and orders.get(n, 1.0) > 0.0]
    rates = []
    for band, amplitude_rad in zip(bands, amplitudes_rad, strict=True):
        frequency_hz = np.linspace(band.start_hz, band.stop_hz, _POINTS)
        s = 2j * pi * frequency_hz
        beam = _tuned(rig.beam, band.mode.frequency_hz)
        g, gradient = transfer_and_gradient(s, beam, damping, (*names, *PARAMETERS[4:]))
        gradient[: len(names)] *= np.array([factors[name] for name in names])[:, None]
        rows = np.concatenate([gradient, [-s * g, s * s]])
        rows *= amplitude_rad * rig.tracking(frequency_hz)
        rates.append((rows.conj() @ rows.T).real / _POINTS)
    return np.array(rates), len(names)


def _tuned(beam: Beam, frequency_hz: float) -> Beam:
    """Change the density so that the nearest undamped mode has the given frequency.

    The profile's beam is wrong by more than the width of such a band.
    """
    omega = 2.0 * pi * frequency_hz
    modes_rad_s = undamped_frequencies_rad_s(beam, 12)
    nearest = modes_rad_s[np.argmin(np.abs(np.log(modes_rad_s / omega)))]
    return Beam(
        length_m=beam.length_m,
        density_kg_per_m=beam.density_kg_per_m * float(nearest / omega) ** 2,
        bending_stiffness_n_m2=beam.bending_stiffness_n_m2,
    )


# Sweeps


def modes(
    *,
    rate_hz: float,
    path: str | Path,
    amplitude_rad: float = 0.025,
    stop_hz: float = 50.0,
    widths: float = 1.0,
    duration_s: float = 120.0,
    rest_s: float = 1.0,
    ring_down_s: float = 15.0,
    taper_s: float = 1.0,
    tip_slope_rad: float = SMALL_SLOPE_RAD,
    rig: SweepRig | None = None,
) -> Excitation:
    """Return linear sweeps through narrow bands around modes, one after the other.

    Parameters
    ----------
    rate_hz
        Ticks a second.
    path
        JSON with the modes: see `rigd.excitation._narrow_sweeps.read_modes`.
    amplitude_rad
        Amplitude in each band; lower where the rig's limits or the slope of the tip require it.
    stop_hz
        Modes above it are left out.
    widths
        Half-power widths swept on either side of a mode, in addition to its uncertainty.
    duration_s
        Duration of all sweeps together.
    rest_s, ring_down_s
        Time before and after them.
    taper_s
        Raised-cosine fade at both ends of every sweep: angle and speed are zero at the joints.
    tip_slope_rad
        Largest slope of the beam's free end, of which the sweeps use 90 %.
    rig
        Limits the amplitudes, and divides the time by the information on the damping. None:
        equal amplitudes and times.

    Raises
    ------
    ExcitationError
        If an option is out of range or the file is invalid.
    """
    positive("amplitude_rad", amplitude_rad, "rad")
    within_a_turn("amplitude_rad", amplitude_rad)
    frequency("stop_hz", stop_hz, rate_hz)
    positive("widths", widths, "half-power widths")
    positive("taper_s", taper_s, "s")
    positive("tip_slope_rad", tip_slope_rad, "rad")
    segments = lay_out_segments(rate_hz, rest_s, duration_s, ring_down_s)
    first, end = segments["sweep"]
    bands = _bands(Path(path), stop_hz, widths, rate_hz)
    fades = 2 * round(taper_s * rate_hz)
    if fades < 2 or LEAST_TIME_FRACTION * (end - first) / len(bands) < fades:
        raise ExcitationError(
            f"duration_s = {duration_s:g} s is too short for fades of taper_s = {taper_s:g} s at "
            f"both ends of {len(bands)} sweeps; choose at least "
            f"{2.0 * taper_s * len(bands) / LEAST_TIME_FRACTION:g} s, or a taper_s from "
            f"{2 / rate_hz:g} s."
        )
    lengths = _lengths(np.full(len(bands), 1.0 / len(bands)), end - first)
    amplitudes_rad = [amplitude_rad] * len(bands)
    sweeps = [_unit_sweep(*item, fades, rate_hz) for item in zip(bands, lengths, strict=True)]
    if rig is not None:
        eased_rad = _within_limits(sweeps, amplitude_rad, tip_slope_rad, rig)
        lengths = _lengths(_at_least(time_fractions(bands, eased_rad, rig)), end - first)
        sweeps = [_unit_sweep(*item, fades, rate_hz) for item in zip(bands, lengths, strict=True)]
        amplitudes_rad = _within_limits(sweeps, amplitude_rad, tip_slope_rad, rig)
    reference_rad = np.concatenate([a * s for a, s in zip(amplitudes_rad, sweeps, strict=True)])
    parameters: dict[str, float | int | str] = {
        "file": Path(path).name,
        "amplitude_rad": max(amplitudes_rad),
        "start_hz": min(band.start_hz for band in bands),
        "stop_hz": max(band.stop_hz for band in bands),
        "widths": widths,
        "duration_s": duration_s,
        "rest_s": rest_s,
        "ring_down_s": ring_down_s,
        "taper_s": taper_s,
        "tip_slope_rad": tip_slope_rad,
        "bands": "; ".join(
            f"{band.start_hz:.6g}-{band.stop_hz:.6g} Hz, {amplitude:.4g} rad, "
            f"{ticks / rate_hz:.6g} s"
            for band, amplitude, ticks in zip(bands, amplitudes_rad, lengths, strict=True)
        ),
    }
    return assemble("modes", parameters, rate_hz, segments, reference_rad)


def _bands(path: Path, stop_hz: float, widths: float, rate_hz: float) -> list[Band]:
    """Return the bands in the order of their sweeps: the slowest decay comes first."""
    found = read_modes(path)
    inside = [mode for mode in found if mode.frequency_hz <= stop_hz]
    if not inside:
        raise ExcitationError(
            f"{path}: the lowest mode, frequency_hz = {found[0].frequency_hz:g} Hz, lies above "
            f"stop_hz = {stop_hz:g} Hz; raise stop_hz."
        )
    bands = sorted((Band.of_mode(mode, widths) for mode in inside), key=lambda band: -band.decay_s)
    for band in bands:
        frequency(f"The upper end of a band of {widths:g} widths", band.stop_hz, rate_hz)
    return bands


def _within_limits(
    sweeps: Sequence[Real], amplitude_rad: float, tip_slope_rad: float, rig: SweepRig
) -> list[float]:
    """Return the amplitude of each sweep, reduced where the rig's limits require it.

    One after the other, since a mode still rings during the next sweep.
    """
    amplitudes_rad = []
    before_rad = np.empty(0)
    for sweep in sweeps:
        eased_rad = amplitude_rad
        for _ in range(_EASINGS):
            so_far_rad = np.concatenate([before_rad, eased_rad * sweep])
            fraction = max(
                rig.fraction_of_limits(so_far_rad), rig.tip_slope_rad(so_far_rad) / tip_slope_rad
            )
            if fraction <= LIMIT_FRACTION * _CLOSE_ENOUGH:
                break
            eased_rad *= LIMIT_FRACTION / fraction
        amplitudes_rad.append(eased_rad)
        before_rad = np.concatenate([before_rad, eased_rad * sweep])
    return amplitudes_rad


def _lengths(fractions: Real, ticks: int) -> list[int]:
    """Divide ticks by fractions, without losing one to rounding."""
    ends = np.round(np.cumsum(fractions) * ticks).astype(int)
    return [int(length) for length in np.diff(ends, prepend=0)]


def _at_least(fractions: Real) -> Real:
    """Raise fractions to the least one, at the cost of the others in proportion."""
    least = LEAST_TIME_FRACTION / len(fractions)
    low = fractions < least
    for _ in fractions:
        rest = (1.0 - least * np.count_nonzero(low)) / fractions[~low].sum()
        raised = np.where(low, least, fractions * rest)
        low = raised <= least
    return raised


def _unit_sweep(band: Band, ticks: int, fades: int, rate_hz: float) -> Real:
    """Return a sweep of amplitude 1, (ticks,), with raised-cosine ends of ``fades / 2`` ticks."""
    duration_s = ticks / rate_hz
    t = np.arange(ticks) / rate_hz
    phase = (
        2.0 * pi * (band.start_hz * t + (band.stop_hz - band.start_hz) * t**2 / (2 * duration_s))
    )
    edge = np.minimum(np.arange(ticks), ticks - np.arange(ticks)) / (fades / 2)
    return (0.5 - 0.5 * np.cos(pi * np.minimum(edge, 1.0))) * np.sin(phase)
