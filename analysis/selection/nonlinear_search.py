"""Which restoring forces that are not linear the record calls for, and how large they are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.selection.candidates import FREE_STIFFNESS
from analysis.selection.chance import SURE
from analysis.selection.nonlinear import KINDS, ModalForces, Term
from analysis.selection.orders import STRONG
from analysis.selection.refit import Refit, unexplained_part

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.selection.candidate import Candidate
    from analysis.selection.candidates import Field

_MOST_TERMS: Final = 2
_ROUNDS: Final = 6
_SETTLED: Final = 0.005
_GAIN: Final = SURE**2 + 2 * math.log(30)
"""Deviance that a term must save: three forces on three modes and three rounds are tried."""

_HINT: Final = 6.0
"""Deviance that the most wanted term must promise before any is tried; chance promises as much in
one record of ten."""

_HOPELESS: Final = 2000.0
"""Deviance behind the best, to first order, from which no substitution leads back."""

_EXPLAINED: Final = 0.5
"""Share of what exceeds chance that the terms must explain; else something else is there."""


@dataclass(frozen=True, slots=True)
class NonlinearForce:
    """A restoring force that is not linear.

    Attributes
    ----------
    term : Term
    size : float
        Share of the stiffness at the largest deflection, or damping ratio at the largest speed.
    std : float
    """

    term: Term
    size: float
    std: float


def nonlinear_forces(
    field: Field, modes: tuple[int, ...]
) -> tuple[Field, tuple[NonlinearForce, ...]]:
    """Add forces one by one while each saves far more than chance would; fit all anew with them.

    A mode whose stiffness rises looks much like one that lies elsewhere, or like a fractional
    order. Where the best candidate has these, the search also starts from those without. But even
    then such a force leaves its trace, by which the best would gain; without one nothing is tried.

    Parameters
    ----------
    field : Field
        Without such forces.
    modes : tuple of int
        Modes that the record shows.

    Returns
    -------
    field : Field
        The one given, if there is nothing.
    forces : tuple of NonlinearForce
    """
    best = field.best
    here = field.refit(best.structure, best.uniform, best.fit.plant, extras=best.extras)
    if _gain(best, here.cost, _most_wanted(field, here, modes, [])[1]) < _HINT:
        return field, ()
    for lead in _leads(field):
        found, forces = _added(field, lead, modes)
        if forces and found.bic < field.bic - STRONG and _explain(field, found):
            return found, forces
    return field, ()


def _leads(field: Field) -> tuple[Candidate, ...]:
    """Candidates to start from: the best, and before it those that are simpler."""
    best = field.best
    if best.uniform and "alpha" not in best.structure.free:
        return (best,)
    simple = (
        c
        for c in field.candidates
        if c.uniform and c.extras == best.extras and c.structure in FREE_STIFFNESS
    )
    return (*simple, best)


def _added(
    field: Field, lead: Candidate, modes: tuple[int, ...]
) -> tuple[Field, tuple[NonlinearForce, ...]]:
    """Add forces to one candidate, then to all."""
    terms: list[Term] = []
    sizes = std = np.zeros(0)
    best = field.best
    here = field.refit(lead.structure, lead.uniform, lead.fit.plant, extras=lead.extras)
    while len(terms) < _MOST_TERMS:
        term, cost = _most_wanted(field, here, modes, terms)
        behind = _gain(best, cost, best.fit.cost)
        if term is None or _gain(best, here.cost, cost) < _GAIN or behind > _HOPELESS:
            break
        tried = _with_terms(field, here, [*terms, term], np.append(sizes, 0.0))
        if tried is None or _gain(best, here.cost, tried[0].cost) < _GAIN:
            break
        terms.append(term)
        here, sizes, std = tried
    if not terms:
        return field, ()
    every = field.with_columns(here.columns, here.noise_here())
    forces = zip(terms, sizes.tolist(), std.tolist(), strict=True)
    return every, tuple(NonlinearForce(term, size, s) for term, size, s in forces)


def _gain(candidate: Candidate, before: float, after: float) -> float:
    """Deviance saved between two sums of squares."""
    return candidate.values * math.log(before / after)


def _most_wanted(
    field: Field, refit: Refit, modes: tuple[int, ...], taken: list[Term]
) -> tuple[Term | None, float]:
    """Find the term that to first order saves most, and the cost with it."""
    projected = refit.objective.project(refit.objective.linearise(refit.x), field.noise.weight)
    forces = ModalForces(field.comparison, refit.plant)
    # Air that brakes the whole beam has been found already, and no mode is braked by itself.
    kinds = KINDS if field.drag is None else tuple(k for k in KINDS if k != "quadratic drag")
    terms = [Term(kind, mode) for kind in kinds for mode in modes]
    terms = [term for term in terms if term not in taken]
    if not terms:
        return None, projected.cost
    at = refit.objective.linearise(refit.x)
    known = np.concatenate([projected.jacobian, at.columns * field.noise.weight])
    every = np.array([forces.column(term) for term in terms], dtype=np.complex128)
    columns = unexplained_part(every * field.noise.weight, known)
    squares = np.sum(np.abs(columns) ** 2, axis=1)
    along = (columns.conj() @ projected.residual).real
    saved = along**2 / np.maximum(squares, np.finfo(float).tiny)
    most = int(np.argmax(saved))
    return terms[most], max(projected.cost - float(saved[most]), 1e-3 * projected.cost)


def _with_terms(
    field: Field, refit: Refit, terms: list[Term], sizes: NDArray[np.float64]
) -> tuple[Refit, NDArray[np.float64], NDArray[np.float64]] | None:
    """Fit with the columns of these terms, at the sizes that they turn out to have.

    None if these are larger than the columns are known for.
    """
    std = np.zeros(sizes.size)
    for _ in range(_ROUNDS):
        forces = ModalForces(field.comparison, refit.plant)
        of_terms = [forces.column(term, e) for term, e in zip(terms, sizes.tolist(), strict=True)]
        if not np.isfinite(of_terms).all():
            return None
        columns = np.concatenate([field.columns, of_terms])
        refit = Refit.descend(
            field.comparison, refit.objective.unknowns, refit.x, field.noise, columns
        )
        before = sizes
        sizes, std = (values[len(field.columns) :] for values in refit.amplitudes())
        if np.all(np.abs(sizes - before) < np.maximum(0.3 * std, _SETTLED * np.abs(sizes))):
            break
    return refit, sizes, std


def _explain(without: Field, within: Field) -> bool:
    """Whether the forces explain what the linear beam left, or at least half of it."""
    power = np.abs(without.best.fit.residual) ** 2
    before = without.best.fit.cost - without.best.fit.degrees_of_freedom
    chance = SURE * math.sqrt(2 * power.size * 2)
    after = within.best.fit.cost - within.best.fit.degrees_of_freedom
    return after < max(_EXPLAINED * before, chance)
