"""Candidate set of a record: all structures fitted under one noise spectrum, ranked by BIC."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._candidate import FAR_BEHIND, Candidate
from analysis.identify._channel_checks import wrong_scale
from analysis.identify._comparison import Comparison
from analysis.identify._fit import fit_record, refit_record
from analysis.identify._leakage import without_leakage
from analysis.identify._plant import free_settings
from analysis.identify._refit import FEW, MANY, MISSED, Refit
from analysis.identify._search import RENEWALS
from analysis.identify.parametrization import Unknowns
from analysis.identify.residual_tests import whiteness
from analysis.models import COEFFICIENT_OF, PARAMETERS, STRUCTURES

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from analysis.identify._data import Measurement
    from analysis.identify._drag import DragEstimate
    from analysis.identify._finding import Finding
    from analysis.identify._plant import Plant, Setting
    from analysis.identify._result import RecordAnalysis, RecordFit
    from analysis.identify.noise import NoiseSpectrum
    from analysis.models import Structure


INTEGER_INTERNAL: Final = (STRUCTURES["III"], STRUCTURES["VII"])
"""Structures of both dampings whose material has an integer order."""

_DISMISSED: Final = 10.0
"""Difference of BIC by which orders that are freed must be better for the noise to be estimated
again."""

_SHOWS: Final = 4.0
"""Deviance reduction that a damping needs to stay in the freest structure: with less it moves no
other parameter by more than two standard deviations, and only makes them uncertain."""

_CERTAIN: Final = 5.0
"""Size of a damping, in its standard deviations, from which it shows in any case."""

_FREEST: Final = STRUCTURES["VI"]
_ONE_DAMPING: Final = (STRUCTURES["IV"], STRUCTURES["V"])
_INTEGER: Final = STRUCTURES["VII"]

_A_STEP: Final = 3
"""Evaluations that bring such a candidate next to it."""

_CROSS_CHECKS: Final = 3
_NEARLY: Final = 1e-3


@dataclass(frozen=True, slots=True)
class CandidateSet:
    """All candidates on one record, with the data that another fit needs.

    Attributes
    ----------
    comparison : Comparison
    noise : Noise
        Noise under which all of them were fitted.
    free : tuple of str
        Settings that are free.
    candidates : tuple of Candidate
        The lowest BIC first.
    columns : ndarray of complex, shape (c, K)
        Spectra that all of them include in addition to the linear beam.
    drag : DragEstimate, optional
        Air drag, if the record shows it; all candidates then include it.
    misread : tuple of Finding
        Findings of a wrong sign or unit, which invalidates every number; usually empty.
    """

    comparison: Comparison
    noise: NoiseSpectrum
    free: tuple[Setting, ...]
    candidates: tuple[Candidate, ...]
    columns: NDArray[np.complex128]
    drag: DragEstimate | None = None
    misread: tuple[Finding, ...] = ()

    @classmethod
    def of(
        cls,
        measurement: Measurement,
        fixed: tuple[Setting, ...],
        band_hz: tuple[float, float],
    ) -> CandidateSet:
        """Fit every structure on a uniform beam; only the freest one if a sign or unit is wrong.

        Raises
        ------
        MeasurementError
            The record cannot be used.
        """
        if misread := tuple(wrong_scale(Comparison.of(measurement, band_hz))):
            # No beam explains such a record: one structure shows what remains as well as all.
            return replace(cls.of_freest(measurement, fixed, band_hz), misread=misread)
        candidate_set = cls._uniform(fit_record(measurement, fixed=fixed, band_hz=band_hz), fixed)
        return candidate_set._without_leakage()

    @classmethod
    def from_earlier(
        cls,
        earlier: Sequence[Candidate],
        measurement: Measurement,
        fixed: tuple[Setting, ...],
        band_hz: tuple[float, float],
    ) -> CandidateSet | None:
        """Fit the candidates of an earlier part of the record again, each from its last estimate.

        Parameters
        ----------
        earlier : sequence of Candidate
            The lowest BIC first.
        measurement : Measurement
        fixed : tuple of str
        band_hz : tuple of float

        Returns
        -------
        CandidateSet or None
            None if the residual of the first exceeds the noise: then a search is needed.

        Raises
        ------
        MeasurementError
            The record cannot be used.
        """
        first, *others = earlier
        if first.columns:
            return None  # what was not linear is searched for again, in all of the record
        unknowns = Unknowns.of(first.structure, measurement.nominal, free_settings(fixed))
        found = refit_record(measurement, unknowns, first.fit.plant, band_hz=band_hz)
        if found is None:
            return None
        candidate_set = cls._fitted(found, fixed, (replace(first, fit=found.fits[0]),))
        before = replace(candidate_set, candidates=tuple(earlier))
        every = (before._refitted(candidate_set, c, MANY) for c in others)
        candidate_set = (
            candidate_set.ranked((*candidate_set.candidates, *every))
            ._without_leakage()
            .cross_checked()
        )
        return candidate_set._renewed()

    @classmethod
    def of_freest(
        cls,
        measurement: Measurement,
        fixed: tuple[Setting, ...],
        band_hz: tuple[float, float],
        additional: tuple[Structure, ...] = (),
    ) -> CandidateSet:
        """Fit the structure with every order free, and some additional ones, on a uniform beam.

        Raises
        ------
        MeasurementError
            The record cannot be used.
        """
        structures = (_FREEST, *additional)
        return cls._uniform(
            fit_record(measurement, structures, fixed=fixed, band_hz=band_hz), fixed
        )

    @classmethod
    def _uniform(cls, uniform: RecordAnalysis, fixed: tuple[Setting, ...]) -> CandidateSet:
        """Return the candidates of fits to a uniform beam."""
        return cls._fitted(uniform, fixed, (Candidate(fit.structure, fit) for fit in uniform.fits))

    @classmethod
    def _fitted(
        cls, analysis: RecordAnalysis, fixed: tuple[Setting, ...], candidates: Iterable[Candidate]
    ) -> CandidateSet:
        """Return a set with given fits as its candidates."""
        comparison = analysis.comparison
        return cls(
            comparison=comparison,
            noise=analysis.noise,
            free=free_settings(fixed),
            candidates=_ranked(candidates),
            columns=np.zeros((0, comparison.frequency_hz.size), dtype=np.complex128),
        )

    @property
    def best(self) -> Candidate:
        """Return the first candidate: the lowest BIC, unless `led_by` put another first."""
        return self.candidates[0]

    @property
    def freest(self) -> Candidate:
        """Return the freest structure that the record supports, without insignificant dampings.

        All orders are free, so its intervals are valid whichever simpler structure is the true one.
        The intervals of the lowest BIC are valid only if that structure is true. If no structure
        was fitted with free orders, this is the best one.
        """
        alike = {c.structure.name: c for c in self.candidates}
        freest = alike.get(_FREEST.name)
        if freest is None:
            return self.best
        lesser = [alike[s.name] for s in _ONE_DAMPING if s.name in alike]
        least = min(lesser, key=lambda c: c.deviance, default=freest)
        return least if least.deviance - freest.deviance < _SHOWS else freest

    def led_by(self, candidate: Candidate) -> CandidateSet:
        """Return the set with one candidate first: the one whose numbers are reported."""
        others = (c for c in self.candidates if c is not candidate)
        return replace(self, candidates=(candidate, *others))

    @property
    def likeliest(self) -> RecordFit:
        """Return the candidate with the lowest sum of squares, whatever its parameters."""
        return min((candidate.fit for candidate in self.candidates), key=lambda fit: fit.cost)

    @property
    def bic(self) -> float:
        """Return the lowest BIC; it is comparable between sets with different noise."""
        return self.best.bic + 2 * float(np.sum(np.log(self.noise.power[self.noise.counts])))

    def unknowns(self, structure: Structure) -> Unknowns:
        """Return the search space of a structure on this record."""
        return Unknowns.of(structure, self.comparison.measurement.nominal, self.free)

    def refit(self, candidate: Candidate, max_evaluations: int = MANY) -> Refit:
        """Descend from the estimate of a candidate."""
        return self.descent_from(candidate.fit.plant, candidate.structure, max_evaluations)

    def descent_from(
        self, plant: Plant, structure: Structure, max_evaluations: int = MANY
    ) -> Refit:
        """Descend from a plant with a structure."""
        unknowns = self.unknowns(structure)
        return self.descent(unknowns, unknowns.vector(plant), max_evaluations)

    def descent(
        self, unknowns: Unknowns, start: NDArray[np.float64], max_evaluations: int
    ) -> Refit:
        """Descend from a vector of unknowns."""
        return Refit.descend(
            self.comparison,
            unknowns,
            start,
            self.noise,
            self.columns,
            max_evaluations=max_evaluations,
        )

    def _renewed(self) -> CandidateSet:
        """Re-estimate the angle that follows the reference; `self` after convergence."""
        candidate_set = self
        for _ in range(RENEWALS):
            best = candidate_set.best
            comparison = candidate_set.comparison.renewed(best.fit.plant, candidate_set.noise)
            if comparison is candidate_set.comparison:
                break
            alone = replace(candidate_set, comparison=comparison, candidates=(best,))
            noise = alone.refit(best, FEW).noise_here()
            alone = replace(alone, noise=noise)
            candidate_set = replace(alone, candidates=(alone.refit(best, FEW).candidate(),))
        if candidate_set is self:
            return self
        # The others from where they were: they have seen their best's noise only.
        others = (c for c in self.candidates if c is not self.best)
        every = (self._refitted(candidate_set, c, MANY) for c in others)
        return candidate_set.ranked((*candidate_set.candidates, *every)).cross_checked()

    def _without_leakage(self) -> CandidateSet:
        """Exclude the bins that a disturbance beyond the band leaks into."""
        noise = without_leakage(self.noise, self.comparison, self.likeliest)
        return self.under(noise) if noise is not self.noise else self

    def under(self, noise: NoiseSpectrum) -> CandidateSet:
        """Fit again under a slightly different noise spectrum."""
        other = replace(self, noise=noise)
        return other.ranked(self._refitted(other, c, FEW) for c in self.candidates)

    def _refitted(self, other: CandidateSet, c: Candidate, max_evaluations: int) -> Candidate:
        """Fit a candidate in a slightly different set; only roughly if its BIC is far higher."""
        behind = c.bic - min(each.bic for each in self.candidates)
        return other.refit(c, max_evaluations if behind < FAR_BEHIND else _A_STEP).candidate()

    def cross_checked(self) -> CandidateSet:
        """Start each candidate from the best one: a search may miss a flat minimum."""
        candidate_set = self
        for _ in range(_CROSS_CHECKS):
            best = candidate_set.best
            candidate_set = candidate_set.ranked(
                c if c is best else candidate_set._from_plant(c, best.fit.plant)
                for c in candidate_set.candidates
            )
            if candidate_set.best is best:
                break
        return candidate_set

    def restarted_from(self, plant: Plant) -> CandidateSet:
        """Start each candidate from a plant that another search found."""
        return self.ranked(self._from_plant(c, plant) for c in self.candidates).cross_checked()

    def _from_plant(self, candidate: Candidate, plant: Plant) -> Candidate:
        """Fit a candidate from the plant of another, unless that has other dampings."""
        structure, damping = candidate.structure, plant.damping
        if (damping.zeta and not structure.internal) or (damping.gamma and not structure.external):
            return candidate
        outlook = self.descent_from(plant, structure, 1)
        least = candidate.fit.cost * (1 - MISSED)
        if outlook.predicted_cost > least:
            return candidate
        first = outlook.further(FEW)
        if first.cost > candidate.fit.cost * (1 + _NEARLY):
            return candidate
        found = first.further(MANY)
        return candidate if found.cost > least else found.candidate()

    def with_special_cases(self) -> CandidateSet:
        """Fit special cases of the freest structure from its estimate, if they may be better.

        An internal damping whose order is near 2 is an inertia. It has a minimum of its own, and
        the search for the freest structure may take it for the lowest; from an order of 1 this
        minimum does not exist. An insignificant damping is left out, as in `freest`.
        """
        fit = next(each.fit for each in self.candidates if each.structure is _FREEST)
        low, high = fit.interval["alpha"] or (math.inf, -math.inf)
        doubtful = [_INTEGER] if not low <= 1 <= high else []
        doubtful += _may_lack_one(fit)
        found = (self.descent_from(fit.plant, structure).candidate() for structure in doubtful)
        candidate_set = self.ranked((*self.candidates, *found)).cross_checked()
        return candidate_set.led_by(candidate_set.freest)

    def with_both_dampings(self, candidate: Candidate) -> tuple[RecordFit, bool]:
        """Fit a candidate with the damping that it lacks, for the uncertainty of its modes.

        An insignificant damping may still exist, and the damping ratio of a mode is the sum of
        both. If the mode was excited for less time than it rings, this dominates its uncertainty.
        So the other damping is estimated as well, with order 1. A damping whose order is at the
        edge of its range is an inertia or a stiffness, and counts as absent, too.

        Returns
        -------
        fit : RecordFit
            The fit of the candidate itself if it lacks none.
        bounded : bool
            Whether the other damping would have to be negative. It is then one standard
            deviation, and the fit is not a minimum.
        """
        structure, own = candidate.structure, candidate.fit
        absent = [
            (order, coefficient)
            for order, coefficient in COEFFICIENT_OF.items()
            if not structure.has(coefficient) or order in own.at_bounds
        ]
        if len(absent) != 1:
            return own, False
        ((order, coefficient),) = absent
        fixed = {name: value for name, value in structure.fixed.items() if structure.has(name)}
        fixed[order] = 1.0  # type: ignore[index]
        free = tuple(name for name in PARAMETERS if name not in fixed)
        both = replace(structure, free=free, fixed=fixed)
        unknowns = self.unknowns(both)
        index = unknowns.names.index(coefficient)
        little = self.descent(unknowns, unknowns.vector(own.plant), 1)
        growth = 1 + float(little.predicted_step[index])  # linear in the loss, not in its logarithm
        if growth > 1:
            start = little.x.copy()
            start[index] += math.log(growth)
            found = self.descent(unknowns, start, MANY)
            if found.x[index] > little.x[index]:
                return found.fit(), False
        scaled, scale = little.equations.scaled_hessian()
        spread = np.linalg.inv(scaled + 1e-12 * np.eye(scale.size))[index, index] ** 0.5
        x = little.x.copy()
        x[index] += max(math.log(spread / scale[index]), 0.0)
        return self.descent(unknowns, x, 1).fit(), True

    def with_orders_free(self) -> CandidateSet:
        """Fit the structures with free orders, unless they have been fitted."""
        best = self.best
        alike = {c.structure.name: c.fit for c in self.candidates}
        found: list[Refit] = []
        added: list[Candidate] = []

        def fitted(structure: Structure) -> RecordFit:
            found.append(self.descent_from(best.fit.plant, structure))
            added.append(found[-1].candidate())
            return added[-1].fit

        freest = alike.get(_FREEST.name) or fitted(_FREEST)
        for structure in _may_lack_one(freest):
            if structure.name not in alike:
                fitted(structure)
        if not found:
            return self
        freed = self.ranked((*self.candidates, *added))
        if freed.best.bic > best.bic - _DISMISSED:
            return freed.cross_checked()
        return freed.under(min(found, key=lambda refit: refit.cost).noise_here())

    def with_effect(self, columns: NDArray[np.complex128]) -> CandidateSet:
        """Fit all with spectra of unknown size, under the noise estimated from the new residual."""
        every = np.concatenate([self.columns, columns])
        best = replace(self, columns=every).refit(self.best)
        return self.with_columns(every, best.noise_here())

    def with_columns(self, columns: NDArray[np.complex128], noise: NoiseSpectrum) -> CandidateSet:
        """Fit all again with columns of nonlinear effects in addition to the beam."""
        other = replace(self, columns=columns, noise=noise)
        return other.ranked(other.refit(c).candidate() for c in self.candidates).cross_checked()

    def ranked(self, candidates: Iterable[Candidate]) -> CandidateSet:
        """Return the set with these candidates, the lowest BIC first."""
        return replace(self, candidates=_ranked(candidates))

    def all_but_white(self, fit: RecordFit) -> bool:
        """Return whether chance exceeds the residual of a fit in one record of 100."""
        counts = self.noise.counts
        return whiteness(fit.residual[counts], self.comparison.frequency_hz[counts]).all_but_white


def _may_lack_one(fit: RecordFit) -> list[Structure]:
    """Return the structures without one of the dampings that is not clearly significant."""
    additional = zip(_ONE_DAMPING, (fit.external, fit.internal), strict=True)
    return [
        structure
        for structure, other in additional
        if other is None or other.value < _CERTAIN * other.std
    ]


def _ranked(candidates: Iterable[Candidate]) -> tuple[Candidate, ...]:
    return tuple(sorted(candidates, key=lambda candidate: candidate.bic))
