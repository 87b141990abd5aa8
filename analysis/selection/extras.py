"""Candidates on a uniform beam with one thing more: elastic clamp, tip mass, filter or clock.

Each shifts modes a little, as freeing the modes' stiffness does with more parameters, or a
fractional order. It is fitted only where a Gauss-Newton step from the beam without it promises
something.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from analysis.selection.candidate import Candidate
from analysis.selection.restart import adapted
from analysis.structures import STRUCTURES
from analysis.whole_record.plant import EXTRAS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from analysis.selection.candidates import Field
    from analysis.selection.refit import Refit
    from analysis.whole_record import Plant

_STRUCTURES: Final = tuple(STRUCTURES[name] for name in ("VI", "VII", "III"))
_PROMISING: Final = 10.0
"""Deviance that a step must promise: BIC asks 9.5 for a parameter in a record like the paper's."""

_FEW: Final = 8
_MANY: Final = 40
_HOPELESS: Final = 50.0
"""Deviance behind the best after a few steps, from which a structure is not followed further."""

_FIRST_CONSTANT_S: Final = 3e-4
_SECOND_CONSTANT_S: Final = 6e-4
"""Where the search for a filter starts: at 0 its effect would be that of a delay, and no step would
lead anywhere. Corners at 530 and 265 Hz."""

_ROUND_CLOCKS: Final = (2e-5, -2e-5, 6e-5, -6e-5, 1.2e-4, -1.2e-4)
"""Differences of the clocks from which a search starts anew where what is left is large."""

_LARGE: Final = 2.0
"""Sum of squares over its expectation."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """The best candidate of one kind of rig.

    Attributes
    ----------
    candidate : Candidate
    behind : float
        Its BIC above the lowest of all.
    """

    candidate: Candidate
    behind: float

    @property
    def kind(self) -> str:
        """One of `EXTRAS`, "modes free", or "" for the uniform beam and nothing beside it."""
        return _kind(self.candidate)


def explanations(field: Field, within: float) -> tuple[Explanation, ...]:
    """Kinds of rig whose best candidate has a BIC less than so much above the lowest.

    Parameters
    ----------
    field : Field
    within : float

    Returns
    -------
    tuple of Explanation
        The best first.
    """
    best: dict[str, Explanation] = {}
    for candidate in field.candidates:
        behind = candidate.bic - field.best.bic
        if behind < within:
            best.setdefault(_kind(candidate), Explanation(candidate, behind))
    return tuple(best.values())


def _kind(candidate: Candidate) -> str:
    return "".join(candidate.extras) or ("" if candidate.uniform else "modes free")


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
    for start in _promising(field, lead):
        found += _fitted(field, start, bare)
    if not found:
        return field
    every = (*field.candidates, *found)
    ranked = tuple(sorted(every, key=lambda candidate: candidate.bic))
    return replace(field, candidates=ranked).cross_checked()


def _promising(field: Field, lead: Candidate) -> Iterator[Refit]:
    """Yield searches with one extra each that may be worth going on with."""
    values, cost = lead.values, lead.fit.cost
    needed = cost * math.exp(-_PROMISING / values)
    for name in EXTRAS:
        first = min(
            (
                _begun(field, lead, name, start)
                for start in _starts(name, lead, cost > _LARGE * values)
            ),
            key=lambda refit: refit.promised_cost,
        )
        if first.promised_cost < needed:
            yield first


def _starts(name: str, lead: Candidate, large: bool) -> Iterator[Plant]:
    """Plants from which the search for an extra starts."""
    plant = lead.fit.plant
    if name == "filter_time_constant_s":
        yield replace(
            plant,
            filter_time_constant_s=plant.filter_time_constant_s + _FIRST_CONSTANT_S,
            delay_s=plant.delay_s - _FIRST_CONSTANT_S,
        )
    elif name == "second_order_filter_time_constant_s":
        before = plant.second_order_filter_time_constant_s
        yield replace(
            plant,
            second_order_filter_time_constant_s=before + _SECOND_CONSTANT_S,
            delay_s=plant.delay_s - 2**0.5 * _SECOND_CONSTANT_S,
        )
    else:
        yield plant
        if name == "clock_rate_difference" and large:
            for difference in _ROUND_CLOCKS:
                yield replace(plant, clock_rate_difference=difference)


def _begun(field: Field, lead: Candidate, name: str, start: Plant) -> Refit:
    """Look from a start."""
    unknowns = field.unknowns(STRUCTURES["VI"], uniform=True, extras=(name,))
    x = adapted(unknowns, start, lead.structure)
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
            own = field.unknowns(structure, True, extras)
            first = field.descent(own, adapted(own, plant, unknowns.structure), _FEW)
            if first.promised_cost > most:
                continue
            found = field.descent(own, first.x, _MANY)
        else:
            found = refit
        candidate = Candidate(structure, True, found.fit(), len(field.columns), extras)
        if candidate.bic < bare[structure.name].bic:
            yield candidate
