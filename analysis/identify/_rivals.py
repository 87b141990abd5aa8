"""Rigs with one thing more than a uniform beam: elastic clamp, tip mass, filter or clock.

Candidates on a uniform beam with one thing more: elastic clamp, tip mass, filter or clock.

Each shifts modes a little, as freeing the modes' stiffness does with more parameters, or a
fractional order. It is fitted only where a Gauss-Newton step from the beam without it promises
something.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from analysis.identify._candidates import Candidate
from analysis.identify._finding import Finding
from analysis.identify._parametrization import ln_stiffness_with_tip
from analysis.identify._plant import EXTRAS
from analysis.identify._refit import adapted
from analysis.identify._residual_tests import whiteness
from analysis.identify._verdict import STRONG
from analysis.models import STRUCTURES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from analysis.identify._candidates import Candidate, Field
    from analysis.identify._refit import Refit

_STRUCTURES: Final = tuple(STRUCTURES[name] for name in ("VI", "VII", "III"))
_PROMISING: Final = 10.0
"""Deviance that a step must promise: BIC asks 9.5 for a parameter in a record like the paper's."""

_FEW: Final = 8
_MANY: Final = 40
_HOPELESS: Final = 50.0
"""Deviance behind the best after a few steps, from which a structure is not followed further."""

_FIRST_SIZES: Final[Mapping[str, float]] = MappingProxyType(
    {
        "tip_mass_kg": 3e-3,
        "filter_time_constant_s": 0.3,
        "second_order_filter_time_constant_s": 0.6,
    }
)
"""Where the search starts for what, next to 0, does nothing that density, stiffness and delay do
not: a share of the beam's mass, and ms (corners at 530 and 265 Hz)."""

_FARTHER_CLOCKS: Final = (2.0, -2.0, 6.0, -6.0, 12.0, -12.0)
"""Differences of the clocks, in units of 1e-5, from which it starts as well if what is left is not
noise."""

_HALVINGS: Final = 20

_QUIETER: Final = 0.98
"""Share of the sum of squares left by an extra, below which the noise is estimated anew."""

_DOUBTFUL: Final = 0.01
"""Probability of a residual's shape by chance, below which a search starts from several sizes."""


def with_extras(field: Field) -> Field:
    """Add the candidates that explain more than the same structure does without an extra."""
    bare = {
        c.structure.name: c
        for c in field.candidates
        if c.uniform and not c.extras and c.structure in _STRUCTURES
    }
    lead = min(bare.values(), key=lambda c: c.fit.cost, default=None)
    if lead is None or "VI" not in bare:
        return field
    found: list[Candidate] = []
    least = field.best.fit.cost
    for start in _promising(field, lead):
        if start.promised_cost < least * math.exp(_HOPELESS / lead.values):
            found += _fitted(field, start, bare)
            least = min([least, *(candidate.fit.cost for candidate in found)])
    if not found:
        return field
    every = (*field.candidates, *found)
    ranked = tuple(sorted(every, key=lambda candidate: candidate.bic))
    freed = replace(field, candidates=ranked)
    best = freed.best
    if best.extras and best.fit.cost < _QUIETER * field.best.fit.cost:
        # Part of what was taken for noise was not.
        refit = freed.refit(best.structure, True, best.fit.plant, 1, best.extras)
        freed = freed.under(refit.noise_here())
    return freed.cross_checked()


def _promising(field: Field, lead: Candidate) -> list[Refit]:
    """Begin a search with each of the extras; give those that promise something, the best first."""
    values, cost = lead.values, lead.fit.cost
    needed = cost * math.exp(-_PROMISING / values)
    counts = field.noise.counts
    left = whiteness(lead.fit.residual[counts], field.comparison.frequency_hz[counts])
    # A uniform beam far from the record is astray; one whose modes are free has mode 1 and all
    # dampings where they are.
    doubtful = left.probability < _DOUBTFUL or left.loud
    found = []
    for name in EXTRAS:
        begun = (
            _begun(field, other, name, size)
            for other in ((lead, field.best) if doubtful else (lead,))
            for size in _starts(name, other, doubtful=doubtful)
        )
        first = min(begun, key=lambda refit: refit.promised_cost)
        if doubtful:  # what a first step promises from afar means little
            first = field.descent(first.objective.unknowns, first.x, _FEW)
        if first.promised_cost < needed:
            found.append(first)
    return sorted(found, key=lambda refit: refit.promised_cost)


def _starts(name: str, lead: Candidate, *, doubtful: bool) -> Iterator[float]:
    """Sizes, in the extra's unknown, from which the search for it starts."""
    yield _FIRST_SIZES.get(name, 0.0)
    if doubtful and name == "clock_rate_difference":
        yield from _FARTHER_CLOCKS
    if doubtful and name == "tip_mass_kg" and lead.fit.plant.stiffness_offsets:
        yield _tip_share(lead.fit.plant.stiffness_offsets[0])


def _tip_share(offset: float) -> float:
    """Mass at the tip, relative to the beam's, that makes mode 2 so much stiffer beside mode 1."""
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        rise = ln_stiffness_with_tip(2, middle) - ln_stiffness_with_tip(1, middle)
        low, high = (middle, high) if rise < math.log1p(offset) else (low, middle)
    return (low + high) / 2


def _begun(field: Field, lead: Candidate, name: str, size: float) -> Refit:
    """Look from a start."""
    unknowns = field.unknowns(STRUCTURES["VI"], uniform=True, extras=(name,))
    x = adapted(unknowns, lead.fit.plant, lead.structure)
    x[-1] += size
    return field.descent(unknowns, x, 1)


def _fitted(field: Field, start: Refit, bare: dict[str, Candidate]) -> Iterator[Candidate]:
    """Candidates of one extra that are better than their structures are without it."""
    unknowns = start.objective.unknowns
    extras, values = unknowns.extras, field.best.values
    refit = field.descent(unknowns, start.x, _FEW)
    most = field.best.fit.cost * math.exp(_HOPELESS / values)
    if refit.promised_cost > max(most, bare["VI"].fit.cost * math.exp(-_HOPELESS / values)):
        return
    refit = field.descent(unknowns, refit.x, _MANY)
    plant = refit.plant
    for structure in _STRUCTURES:
        if structure.name not in bare:
            continue
        if structure is not unknowns.structure:
            own = field.unknowns(structure, uniform=True, extras=extras)
            first = field.descent(own, adapted(own, plant, unknowns.structure), 1)
            if first.promised_cost > most:
                continue
            first = field.descent(own, first.x, _FEW)
            if first.promised_cost > most:
                continue
            found = field.descent(own, first.x, _MANY)
        else:
            found = refit
        candidate = Candidate(structure, True, found.fit(), len(field.columns), extras)
        if candidate.bic < bare[structure.name].bic:
            yield candidate


_NORMAL_95: Final = 1.959963984540054
_MODES_FREE: Final = "modes free"


def of_rig(field: Field) -> Iterator[Finding]:
    """Find what shifts the modes, or the torque against the angle, as nothing uniform does.

    Kinds of rig are compared as `Field.freest` does it: with every order free. What explains the
    record equally well is named in one sentence, without intervals.
    """
    freest = field.freest
    others = field.other_kinds(STRONG)
    if not _beside(freest):
        yield from _beside_a_uniform_beam(others)
        return
    if not others:
        yield _alone(freest)
        return
    yield Finding(
        kind="rival explanations",
        sentence=(
            "The record is not that of a uniform beam on a rigid clamp with ideal channels; it is "
            f"explained equally well by {' or by '.join(map(_about, (freest, *others)))}."
        ),
        value=None,
        interval=None,
        unit="1",
        remedy=(
            "Check clamp, tip and signal conditioning for these; a sweep that reaches one more "
            "mode tells them apart."
        ),
    )


def _beside(candidate: Candidate) -> str:
    """One of the extras, "modes free", or "" for a uniform beam and nothing beside it."""
    return "".join(candidate.extras) or ("" if candidate.uniform else _MODES_FREE)


def _beside_a_uniform_beam(others: tuple[Candidate, ...]) -> Iterator[Finding]:
    """Name what explains the record as well as a uniform beam with its orders free does."""
    if not others:
        return
    named = [f"{_about(each)} (type {each.structure.name})" for each in others]
    yield Finding(
        kind="rival explanations",
        sentence=(
            "A uniform beam with its orders free explains the record, and so does, as well, one "
            f"with {' or with '.join(named)}. What they put elsewhere is flagged."
        ),
        value=None,
        interval=None,
        unit="1",
        remedy="A sweep that reaches one more mode tells them apart.",
    )


def _alone(candidate: Candidate) -> Finding:
    """Name what alone explains the record."""
    kind = _beside(candidate)
    if kind == _MODES_FREE:
        return _not_uniform(candidate)
    value = candidate.fit.parameters[kind]
    interval = candidate.fit.interval[kind] or (value, value)
    return _SAY[kind](value, interval)


def _about(candidate: Candidate) -> str:
    """Name one of several explanations, with its size."""
    kind = _beside(candidate)
    if kind == _MODES_FREE:
        return "modes that each have a stiffness of their own"
    value = candidate.fit.parameters[kind]
    return {
        "root_compliance_rad_per_nm": f"an elastic clamp of {_reciprocal(value):.3g} N·m/rad",
        "tip_mass_kg": f"a tip mass of {1e3 * value:.3g} g",
        "filter_time_constant_s": (
            f"a first-order low-pass filter of {_corner_hz(value):.3g} Hz in the torque channel"
        ),
        "second_order_filter_time_constant_s": (
            f"a second-order low-pass filter of {_corner_hz(value):.3g} Hz in the torque channel"
        ),
        "clock_rate_difference": f"clocks that differ in rate by {1e6 * value:+.3g} ppm",
    }[kind]


def _not_uniform(candidate: Candidate) -> Finding:
    fit = candidate.fit
    offsets = [
        f"mode {name.rsplit('_', 1)[1]} {100 * fit.parameters[name]:+.2f} %"
        f" (± {100 * _NORMAL_95 * (fit.std[name] or 0.0):.1g} %)"
        for name in fit.interval
        if name.startswith("stiffness_offset")
    ]
    return Finding(
        kind="not uniform",
        sentence=(
            "The modes do not lie where those of a uniform beam do; in stiffness, relative to "
            f"mode 1: {', '.join(offsets)}."
        ),
        value=None,
        interval=None,
        unit="1",
        remedy="Look for an added mass or a section that varies along the link.",
    )


def _elastic_clamp(value: float, interval: tuple[float, float]) -> Finding:
    stiffness = _reciprocal(value)
    low, high = (_reciprocal(end) for end in reversed(interval))
    return Finding(
        kind="elastic clamp",
        sentence=(
            f"The clamp is elastic: {stiffness:.3g} N·m/rad "
            f"({low:.3g} to {high:.3g} N·m/rad; 95 %). It was fitted beside the beam."
        ),
        value=stiffness,
        interval=(low, high),
        unit="N·m/rad",
        remedy="Tighten or stiffen the clamp, and sweep again.",
    )


def _tip_mass(value: float, interval: tuple[float, float]) -> Finding:
    low, high = interval
    return Finding(
        kind="tip mass",
        sentence=(
            f"The beam carries a mass at its tip: {1e3 * value:.3g} g ({1e3 * low:.3g} to "
            f"{1e3 * high:.3g} g; 95 %). It was fitted beside the beam."
        ),
        value=value,
        interval=interval,
        unit="kg",
        remedy="Weigh what is attached to the tip, or remove it.",
    )


def _filter(order: int) -> Callable[[float, tuple[float, float]], Finding]:
    words = "first" if order == 1 else "second"

    def say(value: float, interval: tuple[float, float]) -> Finding:
        corner_hz = _corner_hz(value)
        low, high = (_corner_hz(end) for end in reversed(interval))
        return Finding(
            kind="torque filter",
            sentence=(
                f"The torque channel has a low-pass filter of {words} order with its corner at "
                f"{corner_hz:.3g} Hz ({low:.3g} to {high:.3g} Hz; 95 %) that the file does not "
                "state. It was fitted, and is not damping."
            ),
            value=corner_hz,
            interval=(low, high),
            unit="Hz",
            remedy=(
                f"Switch the sensor's filter off, or state it in the file: torque_filter_hz = "
                f"{corner_hz:.4g}, torque_filter_order = {order}."
            ),
        )

    return say


def _clocks(value: float, interval: tuple[float, float]) -> Finding:
    low, high = interval
    return Finding(
        kind="clock rate difference",
        sentence=(
            "Angle and torque were sampled by clocks of different rates: the torque's samples are "
            f"{abs(1e6 * value):.3g} ppm {'farther apart' if value > 0 else 'closer'} than the "
            f"angle's ({1e6 * low:+.3g} to {1e6 * high:+.3g} ppm; 95 %), so the delay between the "
            "channels changes along the record. It was fitted, and is not damping."
        ),
        value=value,
        interval=interval,
        unit="1",
        remedy="Sample both channels by one clock, or correct the torque's time base.",
    )


_SAY: Final[dict[str, Callable[[float, tuple[float, float]], Finding]]] = {
    "root_compliance_rad_per_nm": _elastic_clamp,
    "tip_mass_kg": _tip_mass,
    "filter_time_constant_s": _filter(1),
    "second_order_filter_time_constant_s": _filter(2),
    "clock_rate_difference": _clocks,
}


def _reciprocal(value: float) -> float:
    return 1 / value if value > 0 else math.inf


def _corner_hz(time_constant_s: float) -> float:
    return _reciprocal(2 * math.pi * time_constant_s)
