"""Nonlinear stiffness and damping (dependent on the deflection): torque, and a search for them.

Mode i, relative to its root, is driven by the angle; a further restoring force n acts on it::

    p r + k⁴ (c r + n) = -p angle        p = rho/EI s² + gamma s^lambda,  c = 1 + zeta s^alpha
    torque added = -a² EI p k⁴ n / (p + c k⁴)

with, relative to the largest deflection R and the largest speed V that the mode reaches,

* ``n = e r³ / R²``: stiffness that rises by the fraction e at R; acts at once and three times the
  drive's frequency (odd harmonics);
* ``n = e r² / R``: stiffness that differs from side to side; even harmonics;
* ``n = 2 e r'|r'| / (omega V)``: drag that grows with the square of the speed, as of air; the
  damping ratio rises by e at V.

To first order in e these are columns of known shape and unknown size. Where e is not small, r is
that of the mode with the force: found by repeated substitution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.identify._candidates import INTEGER_INTERNAL_ORDER
from analysis.identify._data import fast_length
from analysis.identify._predictor import torque_channel
from analysis.identify._refit import Refit
from analysis.identify.residual_tests import SIGNIFICANT_STD
from analysis.identify.verdict import BIC_DECISIVE
from rigd.beam import clamped_free_eigenvalues, participation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._candidate import Candidate
    from analysis.identify._candidates import CandidateSet
    from analysis.identify._comparison import Comparison
    from analysis.identify._plant import Plant


# Torque by a force

Kind = Literal["cubic stiffness", "quadratic stiffness", "quadratic drag"]
KINDS: Final[tuple[Kind, ...]] = ("cubic stiffness", "quadratic stiffness", "quadratic drag")

_OVERSAMPLING: Final = 3
"""The band ends at 0.4 of the rate: up to three times its end nothing folds back into it."""

_PADDED: Final = 1.5
_DECAY: Final = 9.0
_SUBSTITUTIONS: Final = 12
_CONVERGED: Final = 1e-3


@dataclass(frozen=True, slots=True)
class Term:
    """One nonlinear restoring force of one mode."""

    kind: Kind
    mode: int


class ModalForces:
    """Torque columns of a record by restoring forces of unit size.

    Parameters
    ----------
    comparison : Comparison
    plant : Plant
        Linear plant.
    """

    __slots__ = ("_comparison", "_growth", "_length", "_p", "_plant", "_s", "_samples")

    def __init__(self, comparison: Comparison, plant: Plant) -> None:
        n, rate_hz = comparison.angle_rad.size, comparison.decimation.rate_hz
        self._comparison, self._plant, self._samples = comparison, plant, n
        self._length = fast_length(int(np.ceil(_PADDED * n)))
        # On s = sigma + j omega what wraps round has decayed: see `TorquePredictor`.
        sigma = _DECAY * rate_hz / self._length
        bins = np.arange(self._length // 2 + 1)
        self._s = sigma + 2j * np.pi * rate_hz / self._length * bins
        fine = np.arange(_OVERSAMPLING * n) / (_OVERSAMPLING * rate_hz)
        self._growth = np.exp(sigma * fine)
        damping, ratio = plant.damping, plant.beam.density_over_stiffness
        self._p = ratio * self._s**2 + damping.gamma * self._s**damping.lambda_

    def column(self, term: Term, size: float = 0.0) -> NDArray[np.complex128]:
        """Return the spectrum, shape (K,), of the torque by a force, divided by its `size`.

        It is not finite if the repeated substitution diverges: the force is then too large.

        Parameters
        ----------
        term : Term
        size : float
            Size e at which the mode moves; 0 for the first order.
        """
        k, stiffness = self._stiffness(term.mode)
        resists = self._p + stiffness
        angle = self._comparison.angle_rad
        decayed = angle / self._growth[::_OVERSAMPLING]
        linear = -self._p / resists * np.fft.rfft(decayed, self._length)
        force = self._force(term.kind, linear, linear)
        if size:
            follows = -size * k / resists
            with np.errstate(over="ignore", invalid="ignore"):
                for _ in range(_SUBSTITUTIONS):
                    again = self._force(term.kind, linear + follows * force, linear)
                    change, most = np.linalg.norm(again - force), np.linalg.norm(again)
                    force = again
                    if not np.isfinite(most):
                        return np.full(self._comparison.frequency_hz.size, np.nan + 0j)
                    if change < _CONVERGED * most:
                        break
        beam = self._plant.beam
        scale = float(participation(beam, term.mode)[-1]) * beam.bending_stiffness_n_m2
        torque = -scale * k * self._p / resists * force * torque_channel(self._plant, self._s)
        in_time = np.fft.irfft(torque, self._length)[: self._samples]
        in_time *= self._growth[::_OVERSAMPLING]
        spectrum: NDArray[np.complex128] = self._comparison.spectrum(
            in_time[self._comparison.retained]
        )
        return spectrum

    def _stiffness(self, mode: int) -> tuple[float, NDArray[np.complex128]]:
        """Return k⁴ of a mode, and k⁴ with its damping."""
        plant = self._plant
        k = float(clamped_free_eigenvalues(mode)[-1] / plant.beam.length_m) ** 4
        damped = k * (1 + plant.damping.zeta * self._s**plant.damping.alpha)
        return k, damped.astype(np.complex128)

    def _force(
        self, kind: Kind, moved: NDArray[np.complex128], linear: NDArray[np.complex128]
    ) -> NDArray[np.complex128]:
        """Return the transform of n, shape (length // 2 + 1,); the linear motion sets R and V."""
        if kind == "quadratic drag":
            speed = self._fine(moved * self._s)
            fastest = np.abs(self._fine(linear * self._s)).max()
            middle = fastest / np.abs(self._fine(linear)).max()
            n = 2 * speed * np.abs(speed) / (fastest * middle)
        else:
            deflection = self._fine(moved)
            largest = np.abs(self._fine(linear)).max()
            power = 3 if kind == "cubic stiffness" else 2
            n = deflection**power / largest ** (power - 1)
        n /= self._growth
        spectrum = np.fft.rfft(n, _OVERSAMPLING * self._length)[: self._s.size]
        return spectrum / _OVERSAMPLING

    def _fine(self, spectrum: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return values over the record at the multiple of the rate."""
        fine = np.fft.irfft(_OVERSAMPLING * spectrum, _OVERSAMPLING * self._length)
        values: NDArray[np.float64] = fine[: self._growth.size] * self._growth
        return values


# Search

_MOST_TERMS: Final = 2
_ROUNDS: Final = 6
_SIZE_TOLERANCE: Final = 0.005
_GAIN: Final = SIGNIFICANT_STD**2 + 2 * math.log(30)
"""Deviance reduction that a term needs: three forces on three modes are tested in three rounds."""

_HINT: Final = 6.0
"""Predicted deviance reduction of the best term from which terms are tested; chance reaches it in
one record of ten."""

_HOPELESS: Final = 2000.0
"""First-order deviance above the best from which no substitution recovers."""

_EXPLAINED: Final = 0.5
"""Fraction of the squares beyond chance that the terms must explain; else there is another
cause."""


@dataclass(frozen=True, slots=True)
class NonlinearForce:
    """Estimated nonlinear restoring force.

    Attributes
    ----------
    term : Term
    size : float
        Fraction of the stiffness at the largest deflection, or damping ratio at the largest speed.
    std : float
    """

    term: Term
    size: float
    std: float


def nonlinear_forces(
    candidate_set: CandidateSet, modes: tuple[int, ...]
) -> tuple[CandidateSet, tuple[NonlinearForce, ...]]:
    """Add significant nonlinear forces one by one; refit all candidates with them.

    A mode whose stiffness rises resembles a mode at another frequency, or a fractional order. If
    the best candidate has these, the search also starts from those without. Even then such a force
    leaves a trace that would improve the best candidate; without that trace nothing is tested.
    `modes` are the visible modes. Returns the set with the forces, or the given set and no forces.
    """
    best = candidate_set.best
    here = candidate_set.refit(best)
    if _gain(best, here.cost, _best_term(candidate_set, here, modes, [])[1]) < _HINT:
        return candidate_set, ()
    for lead in _leads(candidate_set):
        found, forces = _added(candidate_set, lead, modes)
        if (
            forces
            and found.bic < candidate_set.bic - BIC_DECISIVE
            and _explain(candidate_set, found)
        ):
            return found, forces
    return candidate_set, ()


def _leads(candidate_set: CandidateSet) -> tuple[Candidate, ...]:
    """Return the candidates to start from: simpler ones, then the best."""
    best = candidate_set.best
    if "alpha" not in best.structure.free:
        return (best,)
    return (*(c for c in candidate_set.candidates if c.structure in INTEGER_INTERNAL_ORDER), best)


def _added(
    candidate_set: CandidateSet, lead: Candidate, modes: tuple[int, ...]
) -> tuple[CandidateSet, tuple[NonlinearForce, ...]]:
    """Add forces to one candidate, then to all."""
    terms: list[Term] = []
    sizes = std = np.zeros(0)
    best = candidate_set.best
    here = candidate_set.refit(lead)
    while len(terms) < _MOST_TERMS:
        term, cost = _best_term(candidate_set, here, modes, terms)
        behind = _gain(best, cost, best.fit.cost)
        if term is None or _gain(best, here.cost, cost) < _GAIN or behind > _HOPELESS:
            break
        tried = _with_terms(candidate_set, here, [*terms, term], np.append(sizes, 0.0))
        if tried is None or _gain(best, here.cost, tried[0].cost) < _GAIN:
            break
        terms.append(term)
        here, sizes, std = tried
    if not terms:
        return candidate_set, ()
    every = candidate_set.with_columns(here.columns, here.noise_here())
    forces = zip(terms, sizes.tolist(), std.tolist(), strict=True)
    return every, tuple(NonlinearForce(term, size, s) for term, size, s in forces)


def _gain(candidate: Candidate, before: float, after: float) -> float:
    """Return the reduction of deviance between two sums of squares."""
    return candidate.values * math.log(before / after)


def _best_term(
    candidate_set: CandidateSet, refit: Refit, modes: tuple[int, ...], taken: list[Term]
) -> tuple[Term | None, float]:
    """Return the term with the largest first-order reduction, and the cost with it."""
    forces = ModalForces(candidate_set.comparison, refit.plant)
    # Air that brakes the whole beam has been found already, and no mode is braked by itself.
    kinds = (
        KINDS if candidate_set.drag is None else tuple(k for k in KINDS if k != "quadratic drag")
    )
    terms = [Term(kind, mode) for kind in kinds for mode in modes]
    terms = [term for term in terms if term not in taken]
    if not terms:
        return None, refit.cost
    saved = refit.saved_by(np.array([forces.column(term) for term in terms]))
    most = int(np.argmax(saved))
    return terms[most], max(refit.cost - float(saved[most]), 1e-3 * refit.cost)


def _with_terms(
    candidate_set: CandidateSet, refit: Refit, terms: list[Term], sizes: NDArray[np.float64]
) -> tuple[Refit, NDArray[np.float64], NDArray[np.float64]] | None:
    """Fit with the columns of these terms, iterating over their sizes.

    Return None if the sizes exceed the range in which the columns are known.
    """
    std = np.zeros(sizes.size)
    for _ in range(_ROUNDS):
        forces = ModalForces(candidate_set.comparison, refit.plant)
        of_terms = [forces.column(term, e) for term, e in zip(terms, sizes.tolist(), strict=True)]
        if not np.isfinite(of_terms).all():
            return None
        columns = np.concatenate([candidate_set.columns, of_terms])
        refit = Refit.descend(
            candidate_set.comparison,
            refit.objective.unknowns,
            refit.x,
            candidate_set.noise,
            columns,
        )
        before = sizes
        sizes, std = (values[len(candidate_set.columns) :] for values in refit.amplitudes())
        if np.all(np.abs(sizes - before) < np.maximum(0.3 * std, _SIZE_TOLERANCE * np.abs(sizes))):
            break
    return refit, sizes, std


def _explain(without: CandidateSet, within: CandidateSet) -> bool:
    """Return whether the forces explain the residual of the linear beam, or at least half of it."""
    power = np.abs(without.best.fit.residual) ** 2
    before = without.best.fit.cost - without.best.fit.degrees_of_freedom
    chance = SIGNIFICANT_STD * math.sqrt(2 * power.size * 2)
    after = within.best.fit.cost - within.best.fit.degrees_of_freedom
    return after < max(_EXPLAINED * before, chance)
