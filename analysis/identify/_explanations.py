"""Simple causes of modes that deviate from a uniform beam; they are hypotheses, not facts.

Each is fitted to the modal constants with the seven parameters of the beam, at exact geometry. A
dozen constants admit several causes, so none of those that explain them is established.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.identify._altered_beam import Alteration, mode_terms
from analysis.identify._causes import CAUSES, RELAXATION
from analysis.identify._finding import Finding
from analysis.identify.uniform_beam import REFUSED_BELOW, ConstantsProblem
from analysis.statistics import chi_square_p_value

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from analysis.identify._altered_beam import ModeTerms
    from analysis.identify._causes import Cause
    from analysis.identify._modal_model import ModalEstimate
    from analysis.identify._plant import Plant
    from analysis.identify._step_in_time import Step
    from analysis.identify.uniform_beam import UniformBeamTest

_TOLERANCES: Final = (0.03, 1e-3, 0.0)
"""Tolerances of all constants, one after the other.

Frequencies are known so well that without any the way to a minimum would be long and narrow."""

_HOPELESS: Final = 6.0
"""Chi-square a degree of freedom, with a tolerance, from which a cause is given up."""

_STEP: Final = 1e-6
"""Steps of unknowns, for derivatives; those of a cause relative to their scale."""

_MANY: Final = 12
_LONGEST: Final = 1.0
"""Step in any unknown, relative to its scale."""

_RISE: Final = 10.0
"""Factor by which chi-square may rise in a step."""

_HALVINGS: Final = 3
_CLOSE: Final = 0.02
"""Least predicted reduction of chi-square in a step, relative to chi-square or 1."""

_RELUCTANCE: Final = 1e-3
"""Regularization: an unknown without effect stays, a determined one moves all the same."""

_NEAR: Final = 6.0
"""Chi-square above the best from which a cause is not named unless its p-value is `_GOOD`."""

_GOOD: Final = 0.05
_MOST_NAMED: Final = 5


@dataclass(frozen=True, slots=True)
class CauseFit:
    """Fit of one cause to the modal constants.

    Attributes
    ----------
    name : str
        Kind of cause.
    words : str
        Cause and size in words, for sentences.
    size : float
        In `unit`.
    unit : str
    chi_square, p_value : float
        Misfit of the modal constants with it, and the probability of a larger one by chance.
    plant : Plant or None
        Plant with this cause, if a `Plant` can represent it.
    """

    name: str
    words: str
    size: float
    unit: str
    chi_square: float
    p_value: float
    plant: Plant | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the fit as `json.dumps` takes it."""
        return {
            "name": self.name,
            "size": self.size,
            "unit": self.unit,
            "chi_square": self.chi_square,
            "p_value": self.p_value,
        }


def explanations(
    fit: ModalEstimate, nominal: Plant, tilt_deg: float | None = None
) -> tuple[CauseFit, ...]:
    """Return the causes that explain the modes, each alone; the best first.

    Parameters
    ----------
    fit : ModalEstimate
    nominal : Plant
        Rig and specimen as the file states them; with a mass at the tip, if it states one.
    tilt_deg : float, optional
        Inclination of the plane of motion along the beam at rest as the file states it.
    """
    modes = fit.visible
    if not modes:
        return ()
    problem = ConstantsProblem(fit, modes, nominal, tilt_deg=tilt_deg)
    found = problem.minima()[0].x
    straight = problem.starts()[len(problem.starts()) // 2]
    without = np.where(np.arange(found.size) == 0, problem.lower, straight)
    explained_by: dict[str, CauseFit] = {}
    for cause in CAUSES:
        bases = (found, straight, without) if cause.name == RELAXATION else (found, straight)
        explained = _explained(problem, cause, bases)
        if explained is None:
            continue
        # One of each name, and no general cause where a special case of it suffices.
        simpler = [explained_by[name].chi_square for name in cause.special if name in explained_by]
        margin = _NEAR
        if cause.name in explained_by:
            simpler, margin = [explained_by[cause.name].chi_square], 0.0
        if not simpler or explained.chi_square < min(simpler) - margin:
            explained_by[cause.name] = explained
    least = min((each.chi_square for each in explained_by.values()), default=0.0)
    named = [
        each
        for each in explained_by.values()
        if each.p_value >= _GOOD or each.chi_square <= least + _NEAR
    ]
    named.sort(key=lambda each: -each.p_value)
    return tuple(named[:_MOST_NAMED])


def _explained(
    problem: ConstantsProblem, cause: Cause, bases: Sequence[NDArray[np.float64]]
) -> CauseFit | None:
    """Fit one cause; return None if it is not tested, explains nothing or is not plausible."""
    count = problem.lower.size
    freedom = problem.compared - count - len(cause.lower)
    if freedom <= 0:
        return None
    begun = [(*_CauseSearch(problem, cause, x).begun(), x) for x in bases]
    for _, start, x in sorted(begun, key=lambda each: each[0]):
        cost, y = _fitted(problem, cause, x, start, freedom)
        p_value = float(chi_square_p_value(cost, freedom))
        if p_value >= REFUSED_BELOW:
            break
    else:
        return None
    own = y[count:]
    rests = (own <= cause.lower) | (own >= cause.upper)
    rests[1:] &= own[1:] != 0  # a loss may be none
    if rests.any():
        return None
    plant = problem.plant(y[:count])
    size, unit, words = cause.described(own.tolist(), plant.beam)
    return CauseFit(
        name=cause.name,
        words=words,
        size=size,
        unit=unit,
        chi_square=cost,
        p_value=p_value,
        plant=cause.plant(own.tolist(), plant) if cause.plant else None,
    )


def _fitted(
    problem: ConstantsProblem,
    cause: Cause,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    freedom: int,
) -> tuple[float, NDArray[np.float64]]:
    """Descend from y, first with a tolerance; return chi-square and unknowns."""
    cost = math.inf
    for tolerance in _TOLERANCES:
        cost, y = _CauseSearch(problem, cause, x, tolerance).descended(y)
        if cost > _HOPELESS * freedom:
            break
    return cost, y


class _CauseSearch:
    """Search for beam and cause, with one tolerance.

    Parameters
    ----------
    problem : ConstantsProblem
    cause : Cause
    x : ndarray, shape (7,)
        Unknowns of the beam without the cause. An absent damping stays absent.
    tolerance : float
        Standard deviation of every constant, in addition to the uncertainty of the record.
    """

    def __init__(
        self,
        problem: ConstantsProblem,
        cause: Cause,
        x: NDArray[np.float64],
        tolerance: float = _TOLERANCES[0],
    ) -> None:
        self._problem, self._cause, self._x = problem, cause, x
        self._plain = mode_terms(Alteration(), problem.nominal.beam, problem.modes)
        self._lower = np.concatenate([problem.lower, cause.lower])
        upper = np.where(x <= problem.lower, problem.lower, problem.upper)
        self._upper = np.concatenate([upper, cause.upper])
        own = np.max(np.abs([cause.lower, cause.upper]), axis=0)
        self._scale = np.concatenate([np.ones(x.size), own])
        covariance = problem.covariance + tolerance**2 * np.eye(problem.compared)
        self._whitener = np.linalg.inv(np.linalg.cholesky(covariance))

    def begun(self) -> tuple[float, NDArray[np.float64]]:
        """Return the best point one step of the beam's unknowns away from a start of the cause."""
        x, rows = self._x, None
        low, high = (ends[: x.size] - x for ends in (self._lower, self._upper))
        found = []
        for start in self._cause.starts:
            y = np.concatenate([x, start])
            terms = self._terms(y)
            if rows is None:
                _, rows = self._slopes(y)
            step = _step(self._whitened(x[None], terms)[0], rows, low, high)[0]
            there = self._whitened((x + step)[None], terms)[0]
            found.append((float(there @ there), np.concatenate([x + step, start])))
        return min(found, key=lambda pair: pair[0])

    def descended(self, y: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Take Gauss-Newton steps; return the least chi-square and its unknowns.

        Steps are not shortened as a rule, also where chi-square rises a little: along a curved flat
        direction it rises first and then falls further.
        """
        scale, least, best = self._scale, math.inf, y
        for _ in range(_MANY):
            deviation, rows = self._jacobian(y)
            cost = float(deviation @ deviation)
            if cost < least:
                least, best = cost, y
            step, predicted = _step(
                deviation,
                rows * scale[:, None],
                (self._lower - y) / scale,
                (self._upper - y) / scale,
            )
            if cost - predicted < _CLOSE * max(cost, 1.0):
                break
            step = step * scale * min(1.0, _LONGEST / float(np.abs(step).max()))
            for _ in range(_HALVINGS):
                there = self._deviations(np.clip(y + step, self._lower, self._upper))
                if there @ there < _RISE * cost:
                    break
                step /= 2
            y = np.clip(y + step, self._lower, self._upper)
        return least, best

    def _terms(self, y: NDArray[np.float64]) -> ModeTerms:
        x, own = y[: self._x.size], y[self._x.size :].tolist()
        beam = self._problem.plant(x).beam
        altered = self._cause.altered(self._problem.stated, own, beam)
        if altered.same_shapes(Alteration()):
            return replace(self._plain, alteration=altered)
        terms = mode_terms(altered, beam, self._problem.modes)
        # The mass of a cause is a fraction of the beam's: shapes stay the same while that varies.
        return terms if self._problem.stated.lumps else replace(terms, density_kg_per_m=None)

    def _whitened(self, x: NDArray[np.float64], terms: ModeTerms) -> NDArray[np.float64]:
        """Return the deviations of beams, (m, 7), with one cause: (m, 4 n)."""
        off = self._problem.differences(x, terms)
        found: NDArray[np.float64] = np.nan_to_num(off @ self._whitener.T, nan=1e6)
        return found

    def _deviations(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        found: NDArray[np.float64] = self._whitened(y[None, : self._x.size], self._terms(y))[0]
        return found

    def _slopes(self, y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the deviations and their derivatives by the beam's unknowns."""
        count = self._x.size
        steps = np.concatenate([np.zeros((1, count)), _STEP * np.eye(count)])
        every = self._whitened(y[:count] + steps, self._terms(y))
        return every[0], (every[1:] - every[0]) / _STEP

    def _jacobian(self, y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the deviations and their derivatives by all unknowns."""
        deviation, rows = self._slopes(y)
        steps = _STEP * np.diag(self._scale)[self._x.size :]
        own_rows = [(self._deviations(y + step) - deviation) / step.sum() for step in steps]
        return deviation, np.concatenate([rows, own_rows])


def _step(
    deviation: NDArray[np.float64],
    rows: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Return the Gauss-Newton step within limits, and the chi-square that it predicts.

    The deviations themselves are solved by least squares: frequencies are known a thousand times
    better than residues, and normal equations would square that.
    """
    step, moving = np.zeros(len(rows)), np.arange(len(rows))
    while moving.size:
        step[moving] = 0.0
        left = deviation + step @ rows
        matrix = np.concatenate([rows[moving].T, _RELUCTANCE * np.eye(moving.size)])
        target = np.concatenate([-left, np.zeros(moving.size)])
        wanted, *_ = np.linalg.lstsq(matrix, target)
        step[moving] = np.clip(wanted, low[moving], high[moving])
        beyond = step[moving] != wanted
        if not beyond.any():
            break
        moving = moving[~beyond]
    left = deviation + step @ rows
    return step, float(left @ left)


# Words


def finding(test: UniformBeamTest, found: Sequence[CauseFit], step: Step | None = None) -> Finding:
    """Return the finding that names the causes of the modes.

    Parameters
    ----------
    test : UniformBeamTest
        Test that refused the plain uniform beam.
    found : sequence of CauseFit
        As `explanations` gives them.
    step : Step, optional
        Step of the stiffness, as `step_score` finds it.
    """
    named = [each.words for each in found]
    if step is not None and step.named:
        named.append(step.words)
    refused = f"A plain uniform beam does not predict the modes ({test.summary.chance})."
    if not named:
        return Finding(
            kind="rival explanations",
            sentence=(
                f"{refused} None of the simple causes tried explains them alone: tilt, a mass at "
                "the tip or elsewhere, an uneven or tapered beam, a soft or lossy clamp, a filter "
                "or resonance of the sensor, a relaxation of the material."
            ),
            remedy="Check the beam and its clamp for several of these at once.",
        )
    if len(named) == 1:
        sentence = f"{refused} This would: {named[0]}. It is not established by this record."
    else:
        sentence = (
            f"{refused} Each of these alone would: {'; '.join(named)}. None is established by this "
            "record."
        )
    return Finding(
        kind="rival explanations",
        sentence=sentence,
        remedy="Weigh, measure or change one of them, state it in the file, and sweep again.",
    )
