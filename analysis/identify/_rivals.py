"""Rival explanations on a uniform beam: elastic clamp, tip mass, torque filter, clock difference.

Each shifts modes a little, as freeing the modes' stiffness does with more parameters, or a
fractional order. It is fitted only where a Gauss-Newton step from the beam without it promises
something.
"""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._candidate import PLAIN
from analysis.identify._free_decay import mode_poles
from analysis.identify._parametrization import ln_stiffness_with_tip
from analysis.identify._plant import EXTRAS
from analysis.identify._refit import FEW, MANY
from analysis.models import STRUCTURES

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from analysis.identify._candidate import Candidate
    from analysis.identify._candidates import CandidateSet
    from analysis.identify._parametrization import Unknowns
    from analysis.identify._refit import Refit
    from analysis.identify._result import ModeEstimate

_STRUCTURES: Final = tuple(STRUCTURES[name] for name in ("VI", "VII", "III"))
_PROMISING: Final = 10.0
"""Deviance that a step must promise: BIC asks 9.5 for a parameter in a record like the paper's."""

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

_AT_ENDS: Final = ("root_compliance_rad_per_nm", "tip_mass_kg")
_POLISHED: Final = 4
_STEP: Final = 1e-5
_HALVINGS: Final = 20

_QUIETER: Final = 0.98
"""Share of the sum of squares left by an extra, below which the noise is estimated again."""


def with_extras(field: CandidateSet) -> CandidateSet:
    """Add the candidates that explain more than the same structure does without an extra."""
    freest = field.freest_of(PLAIN)
    # Without the damping that does not show: compared are kinds of rig, not what it costs to ask.
    structures = _STRUCTURES if freest is None else (*_STRUCTURES, freest.structure)
    bare = {
        c.structure.name: c
        for c in field.candidates
        if c.uniform and not c.extras and c.structure in structures
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
    freed = field.ranked((*field.candidates, *found))
    best = freed.best
    if best.extras and best.fit.cost < _QUIETER * field.best.fit.cost:
        # Part of the noise model was not noise.
        freed = freed.under(freed.refit(best, 1).noise_here())
    return freed.cross_checked()


def _promising(field: CandidateSet, lead: Candidate) -> list[Refit]:
    """Begin a search with each of the extras; give those that promise something, the best first."""
    values, cost = lead.values, lead.fit.cost
    needed = cost * math.exp(-_PROMISING / values)
    # A uniform beam far from the record is astray; one whose modes are free has mode 1 and all
    # dampings where they are.
    doubtful = not field.all_but_white(lead.fit)
    found = []
    for name in EXTRAS:
        begun = (
            _begun(field, other, name, size)
            for other in ((lead, field.best) if doubtful and name in _AT_ENDS else (lead,))
            for size in _starts(name, other, doubtful=doubtful)
        )
        first = min(begun, key=lambda refit: refit.promised_cost)
        if doubtful:  # what a first step promises from afar means little
            first = first.further(FEW)
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


def _begun(field: CandidateSet, lead: Candidate, name: str, size: float) -> Refit:
    """Look from a start."""
    unknowns = field.unknowns(STRUCTURES["VI"], uniform=True, extras=(name,))
    x = unknowns.vector(lead.fit.plant)
    x[-1] += size
    if lead.fit.plant.stiffness_offsets and name in _AT_ENDS:
        x = _at_its_modes(unknowns, x, lead.fit.modes)
    return field.descent(unknowns, x, 1)


def _at_its_modes(
    unknowns: Unknowns, start: NDArray[np.float64], modes: Sequence[ModeEstimate]
) -> NDArray[np.float64]:
    """Bring the modes to where a beam with free modes has them, by rho/EI and the extra, (k,).

    No descent would find a resonance that is off by more than it is wide. The start itself where
    that does not succeed.
    """
    wanted = {mode.number: mode.frequency_hz for mode in modes if mode.frequency_hz > 0}
    if "density_over_stiffness" not in unknowns.free or not wanted:
        return start
    places = [unknowns.names.index("density_over_stiffness"), start.size - 1]

    near: list[complex] = []

    def missed(x: NDArray[np.float64]) -> NDArray[np.float64] | None:
        poles = {pole.mode: pole for pole in mode_poles(unknowns.plant(x), max(wanted), (), near)}
        near[:] = [pole.at_rad_s for pole in poles.values()]
        if not wanted.keys() <= poles.keys():
            return None
        return np.array(
            [math.log(poles[n].at_rad_s.imag / (2 * math.pi * hz)) for n, hz in wanted.items()]
        )

    x = start.copy()
    lower, upper = unknowns.bounds
    for _ in range(_POLISHED):
        here = missed(x)
        if here is None:
            return start
        slopes = []
        for place in places:
            aside = x.copy()
            aside[place] += _STEP
            there = missed(aside)
            if there is None:
                return start
            slopes.append((there - here) / _STEP)
        x[places] -= np.linalg.lstsq(np.array(slopes).T, here)[0]
        x = np.clip(x, lower, upper)
    return x


def _fitted(field: CandidateSet, start: Refit, bare: dict[str, Candidate]) -> Iterator[Candidate]:
    """Candidates of one extra that are better than their structures are without it."""
    unknowns = start.objective.unknowns
    values = field.best.values
    refit = start.further(FEW)
    most = field.best.fit.cost * math.exp(_HOPELESS / values)
    if refit.promised_cost > max(most, bare["VI"].fit.cost * math.exp(-_HOPELESS / values)):
        return
    refit = refit.further(MANY)
    for structure in (each.structure for each in bare.values()):
        if structure is not unknowns.structure:
            first = field.descent_from(refit.plant, structure, (True, unknowns.extras), 1)
            if first.promised_cost > most:
                continue
            first = first.further(FEW)
            if first.promised_cost > most:
                continue
            candidate = first.further(MANY).candidate()
        else:
            candidate = refit.candidate()
        if candidate.bic < bare[structure.name].bic:
            yield candidate
