"""Candidates for one record: all structures fitted under one noise spectrum, ranked by BIC."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._candidate import HOPELESS_BIC_DIFFERENCE, Candidate, DragEstimate
from analysis.identify._channel_checks import sign_and_unit_findings
from analysis.identify._comparison import Comparison
from analysis.identify._fit import fit_record, refit_record
from analysis.identify._leakage import without_leakage
from analysis.identify._refit import (
    DESCENT_EVALUATIONS,
    MISSED_MINIMUM_COST_FRACTION,
    REFIT_EVALUATIONS,
    Refit,
)
from analysis.identify._search import MAX_ANGLE_REESTIMATES
from analysis.identify._settings import free_settings
from analysis.identify.parametrization import Unknowns
from analysis.identify.residual_tests import whiteness
from analysis.models import STRUCTURES
from rigd.beam import COEFFICIENT_OF

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from analysis.identify._data import Measurement
    from analysis.identify._finding import Finding
    from analysis.identify._result import RecordAnalysis, RecordFit
    from analysis.identify._settings import Setting
    from analysis.identify.noise import NoiseSpectrum
    from analysis.models import Structure
    from rigd.beam import Plant


INTERNAL_ORDER_ONE_STRUCTURES: Final = (STRUCTURES["III"], STRUCTURES["VII"])
"""Structures with internal and external damping whose internal damping has order 1."""

_MIN_BIC_REDUCTION_FOR_NEW_NOISE: Final = 10.0
"""Minimum reduction of the BIC, by structures with free orders, for which the noise spectrum is
estimated again."""

_MIN_DEVIANCE_OF_DAMPING: Final = 4.0
"""Minimum reduction of the deviance by an internal or external damping in the freest structure. A
damping with a smaller reduction is omitted: it moves no other parameter by more than two
standard deviations, and only makes the others uncertain."""

_CERTAIN_DAMPING_STD_RATIO: Final = 5.0
"""Ratio of a damping coefficient to its standard deviation above which the damping is certainly
significant, so that no structure without it is fitted."""

_FREEST_STRUCTURE: Final = STRUCTURES["VI"]
"""Structure with internal and external damping, both of free order."""

_SINGLE_DAMPING_STRUCTURES: Final = (STRUCTURES["IV"], STRUCTURES["V"])
"""Structures with only internal or only external damping, of free order."""

_INTEGER_ORDER_STRUCTURE: Final = STRUCTURES["VII"]
"""Structure with internal and external damping whose internal damping has order 1."""

_ROUGH_FIT_EVALUATIONS: Final = 3
"""Maximum number of evaluations in a descent for a candidate whose BIC is far above the lowest BIC.
"""

_MAX_CROSS_CHECK_ROUNDS: Final = 3
"""Maximum number of rounds in which all candidates are restarted from the best candidate."""

_CONTINUATION_COST_TOLERANCE: Final = 1e-3
"""Relative excess of the cost, after a short descent from another plant, up to which the descent is
continued; it is relative to the present cost of the candidate."""


@dataclass(frozen=True, slots=True)
class CandidateSet:
    """All candidates (fits of one damping structure each) for one record.

    The set also contains the data that a further fit needs.

    Attributes
    ----------
    comparison : Comparison
        Record, reduced to the band.
    noise : NoiseSpectrum
        Noise under which all candidates were fitted.
    free_settings : tuple of str
        Settings that are estimated.
    candidates : tuple of Candidate
        Candidates by rising BIC.
    effect_spectra : ndarray of complex, shape (c, K)
        Torque spectra, with free amplitudes, that all candidates include in addition to the linear
        beam.
    drag : DragEstimate, optional
        Air drag, if it is significant; all candidates then include it.
    misread_findings : tuple of Finding
        Findings of a wrong sign or unit, which invalidates every number; usually empty.
    """

    comparison: Comparison
    noise: NoiseSpectrum
    free_settings: tuple[Setting, ...]
    candidates: tuple[Candidate, ...]
    effect_spectra: NDArray[np.complex128]
    drag: DragEstimate | None = None
    misread_findings: tuple[Finding, ...] = ()

    @classmethod
    def from_measurement(
        cls,
        measurement: Measurement,
        fixed_settings: tuple[Setting, ...],
        band_hz: tuple[float, float],
    ) -> CandidateSet:
        """Fit every damping structure to a record, on a uniform beam; return the candidate set.

        If a sign or unit of the record is wrong, only the freest structure is fitted. Raise
        `MeasurementError` if the record cannot be used.
        """
        if misread_findings := tuple(
            sign_and_unit_findings(Comparison.from_measurement(measurement, band_hz))
        ):
            # No beam explains such a record, so all structures leave much the same residual.
            return replace(
                cls.fit_freest_structure(measurement, fixed_settings, band_hz),
                misread_findings=misread_findings,
            )
        candidate_set = cls._from_uniform_beam(
            fit_record(measurement, fixed_settings=fixed_settings, band_hz=band_hz), fixed_settings
        )
        return candidate_set._exclude_leakage()

    @classmethod
    def refit_from_earlier(
        cls,
        earlier_candidates: Sequence[Candidate],
        measurement: Measurement,
        fixed_settings: tuple[Setting, ...],
        band_hz: tuple[float, float],
    ) -> CandidateSet | None:
        """Refit candidates that were fitted to the beginning of a record to the longer record.

        Each descent starts from the earlier estimate of the candidate. Return None if the residual
        of the first candidate exceeds the noise: then a full search is needed. The earlier
        candidates are in the order of rising BIC. Settings in `fixed_settings` stay at the values
        the file states. Raise `MeasurementError` if the record cannot be used.
        """
        first_candidate, *other_candidates = earlier_candidates
        unknowns = Unknowns.for_structure(
            first_candidate.structure, measurement.nominal_plant, free_settings(fixed_settings)
        )
        analysis = refit_record(measurement, unknowns, first_candidate.fit.plant, band_hz=band_hz)
        if analysis is None:
            return None
        candidate_set = cls._from_analysis(
            analysis, fixed_settings, (replace(first_candidate, fit=analysis.fits[0]),)
        )
        earlier_candidate_set = replace(candidate_set, candidates=tuple(earlier_candidates))
        refitted_candidates = (
            earlier_candidate_set._refit_candidate_in(candidate_set, c, DESCENT_EVALUATIONS)
            for c in other_candidates
        )
        candidate_set = (
            candidate_set.with_candidates((*candidate_set.candidates, *refitted_candidates))
            ._exclude_leakage()
            .cross_check()
        )
        return candidate_set._update_coherent_angle()

    @classmethod
    def fit_freest_structure(
        cls,
        measurement: Measurement,
        fixed_settings: tuple[Setting, ...],
        band_hz: tuple[float, float],
        additional_structures: tuple[Structure, ...] = (),
    ) -> CandidateSet:
        """Fit the damping structure with free orders, and the `additional_structures`, to a record.

        The beam is uniform. Raise `MeasurementError` if the record cannot be used.
        """
        structures = (_FREEST_STRUCTURE, *additional_structures)
        return cls._from_uniform_beam(
            fit_record(measurement, structures, fixed_settings=fixed_settings, band_hz=band_hz),
            fixed_settings,
        )

    @classmethod
    def _from_uniform_beam(
        cls, uniform_analysis: RecordAnalysis, fixed_settings: tuple[Setting, ...]
    ) -> CandidateSet:
        """Return the candidate set of an analysis that fitted structures on a uniform beam."""
        return cls._from_analysis(
            uniform_analysis,
            fixed_settings,
            (Candidate(fit.structure, fit) for fit in uniform_analysis.fits),
        )

    @classmethod
    def _from_analysis(
        cls,
        analysis: RecordAnalysis,
        fixed_settings: tuple[Setting, ...],
        candidates: Iterable[Candidate],
    ) -> CandidateSet:
        """Return a set of given candidates, with the record and noise of an analysis."""
        comparison = analysis.comparison
        return cls(
            comparison=comparison,
            noise=analysis.noise,
            free_settings=free_settings(fixed_settings),
            candidates=_sorted_by_bic(candidates),
            effect_spectra=np.zeros((0, comparison.frequency_hz.size), dtype=np.complex128),
        )

    @property
    def best(self) -> Candidate:
        """Return the first candidate, whose numbers are reported.

        It has the lowest BIC unless `with_leading_candidate` moved another one to the front.
        """
        return self.candidates[0]

    @property
    def freest(self) -> Candidate:
        """Return the candidate with the freest significant damping structure.

        This is internal and external damping, both of free order, or only one of them if the other
        is insignificant. Since all orders are free, its intervals are valid whichever simpler
        structure is the true one. The intervals of the candidate with the lowest BIC are valid only
        if its structure is true. If no structure was fitted with free orders, return the best
        candidate.
        """
        candidates_by_structure = {c.structure.name: c for c in self.candidates}
        freest_candidate = candidates_by_structure.get(_FREEST_STRUCTURE.name)
        if freest_candidate is None:
            return self.best
        single_damping_candidates = [
            candidates_by_structure[s.name]
            for s in _SINGLE_DAMPING_STRUCTURES
            if s.name in candidates_by_structure
        ]
        best_single_damping_candidate = min(
            single_damping_candidates, key=lambda c: c.deviance, default=freest_candidate
        )
        return (
            best_single_damping_candidate
            if best_single_damping_candidate.deviance - freest_candidate.deviance
            < _MIN_DEVIANCE_OF_DAMPING
            else freest_candidate
        )

    def with_leading_candidate(self, candidate: Candidate) -> CandidateSet:
        """Return the set with one candidate moved to the front, so that it is reported."""
        other_candidates = (c for c in self.candidates if c is not candidate)
        return replace(self, candidates=(candidate, *other_candidates))

    @property
    def likeliest_fit(self) -> RecordFit:
        """Return the candidates' fit with the lowest cost, a sum of squared whitened residuals."""
        return min((candidate.fit for candidate in self.candidates), key=lambda fit: fit.cost)

    @property
    def bic(self) -> float:
        """Return the lowest BIC of the candidates.

        It includes the level of the noise, and so is comparable between candidate sets with
        different noise.
        """
        return self.best.bic + 2 * float(np.sum(np.log(self.noise.power[self.noise.is_compared])))

    def unknowns(self, structure: Structure) -> Unknowns:
        """Return the unknown parameters that a fit of a damping structure to this record varies."""
        return Unknowns.for_structure(
            structure, self.comparison.measurement.nominal_plant, self.free_settings
        )

    def refit(self, candidate: Candidate, max_evaluations: int = DESCENT_EVALUATIONS) -> Refit:
        """Return the minimum of the cost that a descent reaches from a candidate's estimate."""
        return self.descend_from_plant(candidate.fit.plant, candidate.structure, max_evaluations)

    def descend_from_plant(
        self, plant: Plant, structure: Structure, max_evaluations: int = DESCENT_EVALUATIONS
    ) -> Refit:
        """Return the minimum of the cost that a descent reaches from a plant's parameters.

        The damping `structure` determines which parameters are free.
        """
        unknowns = self.unknowns(structure)
        return self.descend_from_vector(unknowns, unknowns.vector(plant), max_evaluations)

    def descend_from_vector(
        self, unknowns: Unknowns, start_vector: NDArray[np.float64], max_evaluations: int
    ) -> Refit:
        """Return the minimum of the cost that a descent reaches from a vector of unknowns."""
        return Refit.descend(
            self.comparison,
            unknowns,
            start_vector,
            self.noise,
            self.effect_spectra,
            max_evaluations=max_evaluations,
        )

    def _update_coherent_angle(self) -> CandidateSet:
        """Re-estimate the part of the motor angle that follows the reference, and refit the set.

        Return `self` if this part has converged.
        """
        candidate_set = self
        for _ in range(MAX_ANGLE_REESTIMATES):
            best_candidate = candidate_set.best
            comparison = candidate_set.comparison.with_reestimated_angle(
                best_candidate.fit.plant, candidate_set.noise
            )
            if comparison is candidate_set.comparison:
                break
            set_with_best_candidate = replace(
                candidate_set, comparison=comparison, candidates=(best_candidate,)
            )
            noise = set_with_best_candidate.refit(
                best_candidate, REFIT_EVALUATIONS
            ).residual_noise()
            set_with_best_candidate = replace(set_with_best_candidate, noise=noise)
            candidate_set = replace(
                set_with_best_candidate,
                candidates=(
                    set_with_best_candidate.refit(best_candidate, REFIT_EVALUATIONS).candidate(),
                ),
            )
        if candidate_set is self:
            return self
        # The other candidates start from their former minima, under the new noise.
        other_candidates = (
            candidate for candidate in self.candidates if candidate is not self.best
        )
        refitted_candidates = (
            self._refit_candidate_in(candidate_set, candidate, DESCENT_EVALUATIONS)
            for candidate in other_candidates
        )
        return candidate_set.with_candidates(
            (*candidate_set.candidates, *refitted_candidates)
        ).cross_check()

    def _exclude_leakage(self) -> CandidateSet:
        """Refit all candidates without the bins into which a disturbance outside the band leaks."""
        noise = without_leakage(self.noise, self.comparison, self.likeliest_fit)
        return self.refit_under_noise(noise) if noise is not self.noise else self

    def refit_under_noise(self, noise: NoiseSpectrum) -> CandidateSet:
        """Return the set with all candidates refitted under a slightly different noise spectrum."""
        new_candidate_set = replace(self, noise=noise)
        return new_candidate_set.with_candidates(
            self._refit_candidate_in(new_candidate_set, c, REFIT_EVALUATIONS)
            for c in self.candidates
        )

    def _refit_candidate_in(
        self, new_candidate_set: CandidateSet, candidate: Candidate, max_evaluations: int
    ) -> Candidate:
        """Return a candidate refitted with the record, noise and effects of another set.

        A candidate whose BIC is far above the lowest one is fitted only roughly.
        """
        bic_difference = candidate.bic - min(
            candidate_of_set.bic for candidate_of_set in self.candidates
        )
        return new_candidate_set.refit(
            candidate,
            max_evaluations if bic_difference < HOPELESS_BIC_DIFFERENCE else _ROUGH_FIT_EVALUATIONS,
        ).candidate()

    def cross_check(self) -> CandidateSet:
        """Refit each candidate from the plant of the best one, until the best one stays the best.

        The earlier search for a candidate may have missed a flat minimum.
        """
        candidate_set = self
        for _ in range(_MAX_CROSS_CHECK_ROUNDS):
            best_candidate = candidate_set.best
            candidate_set = candidate_set.with_candidates(
                c
                if c is best_candidate
                else candidate_set._refit_from_plant(c, best_candidate.fit.plant)
                for c in candidate_set.candidates
            )
            if candidate_set.best is best_candidate:
                break
        return candidate_set

    def restart_from_plant(self, plant: Plant) -> CandidateSet:
        """Refit each candidate from a plant that another search found; keep the better fits."""
        return self.with_candidates(
            self._refit_from_plant(c, plant) for c in self.candidates
        ).cross_check()

    def _refit_from_plant(self, candidate: Candidate, plant: Plant) -> Candidate:
        """Return the better of a candidate and its refit that starts from another plant.

        The candidate is unchanged if the plant has a damping that its structure lacks.
        """
        structure, damping = candidate.structure, plant.damping
        if (damping.zeta and not structure.has_internal_damping) or (
            damping.gamma and not structure.has_external_damping
        ):
            return candidate
        start_refit = self.descend_from_plant(plant, structure, 1)
        cost_to_beat = candidate.fit.cost * (1 - MISSED_MINIMUM_COST_FRACTION)
        if start_refit.predicted_cost > cost_to_beat:
            return candidate
        first_descent = start_refit.continue_descent(REFIT_EVALUATIONS)
        if first_descent.cost > candidate.fit.cost * (1 + _CONTINUATION_COST_TOLERANCE):
            return candidate
        new_minimum = first_descent.continue_descent(DESCENT_EVALUATIONS)
        return candidate if new_minimum.cost > cost_to_beat else new_minimum.candidate()

    def fit_special_cases(self) -> CandidateSet:
        """Add fits of special cases of the freest structure, which start from its estimate.

        The special cases have an internal damping of order 1, or lack an insignificant damping. An
        internal damping with an order near 2 acts as an inertia. It has a separate minimum, which
        the search for the freest structure may mistake for the lowest one. A search from an order
        of 1 avoids that minimum.
        """
        fit = next(
            candidate.fit
            for candidate in self.candidates
            if candidate.structure is _FREEST_STRUCTURE
        )
        low_alpha, high_alpha = fit.interval["alpha"] or (math.inf, -math.inf)
        special_cases = [_INTEGER_ORDER_STRUCTURE] if not low_alpha <= 1 <= high_alpha else []
        special_cases += _single_damping_structures(fit)
        fitted_candidates = (
            self.descend_from_plant(fit.plant, structure).candidate() for structure in special_cases
        )
        candidate_set = self.with_candidates((*self.candidates, *fitted_candidates)).cross_check()
        return candidate_set.with_leading_candidate(candidate_set.freest)

    def fit_with_both_dampings(self, candidate: Candidate) -> tuple[RecordFit, bool]:
        """Return a candidate refitted with both internal and external damping.

        A damping that is missing because it is insignificant may still exist, and adds to the
        damping ratio of each mode. For a mode that was excited for less time than it rings, it is
        the main uncertainty of the damping ratio. So the missing damping is estimated with order 1.
        A damping whose order is at the limit of its range acts as an inertia or a stiffness. It
        counts as missing, too.

        Return also whether the best coefficient of the added damping is negative. The coefficient
        is then set to one standard deviation, and the fit is not a minimum. If no damping or both
        are missing, the fit is the candidate's own.
        """
        structure, own_fit = candidate.structure, candidate.fit
        absent_dampings = [
            (order, coefficient)
            for order, coefficient in COEFFICIENT_OF.items()
            if not structure.has_damping_of(coefficient) or order in own_fit.at_bounds
        ]
        if len(absent_dampings) != 1:
            return own_fit, False
        ((order, coefficient),) = absent_dampings
        fixed_values = {
            parameter_name: fixed_value
            for parameter_name, fixed_value in structure.fixed.items()
            if structure.has_damping_of(parameter_name)
        }
        fixed_values[order] = 1.0
        structure_with_both_dampings = replace(structure, fixed=fixed_values)
        unknowns = self.unknowns(structure_with_both_dampings)
        coefficient_index = unknowns.names.index(coefficient)
        start_refit = self.descend_from_vector(unknowns, unknowns.vector(own_fit.plant), 1)
        # The predicted step of the logarithm is taken as linear in the coefficient itself.
        predicted_growth_factor = 1 + float(start_refit.predicted_step[coefficient_index])
        if predicted_growth_factor > 1:
            start_vector = start_refit.x.copy()
            start_vector[coefficient_index] += math.log(predicted_growth_factor)
            refit_at_minimum = self.descend_from_vector(unknowns, start_vector, DESCENT_EVALUATIONS)
            if refit_at_minimum.x[coefficient_index] > start_refit.x[coefficient_index]:
                return refit_at_minimum.fit(), False
        scaled_hessian, unknown_scale = start_refit.equations.scaled_hessian()
        scaled_std = (
            np.linalg.inv(scaled_hessian + 1e-12 * np.eye(unknown_scale.size))[
                coefficient_index, coefficient_index
            ]
            ** 0.5
        )
        x = start_refit.x.copy()
        x[coefficient_index] += max(math.log(scaled_std / unknown_scale[coefficient_index]), 0.0)
        return self.descend_from_vector(unknowns, x, 1).fit(), True

    def fit_with_free_orders(self) -> CandidateSet:
        """Return the set with the structures of free damping orders fitted, if they are missing."""
        best_candidate = self.best
        fits_by_structure = {c.structure.name: c.fit for c in self.candidates}
        refits: list[Refit] = []
        added_candidates: list[Candidate] = []

        def fit_structure(structure: Structure) -> RecordFit:
            refits.append(self.descend_from_plant(best_candidate.fit.plant, structure))
            added_candidates.append(refits[-1].candidate())
            return added_candidates[-1].fit

        freest_fit = fits_by_structure.get(_FREEST_STRUCTURE.name) or fit_structure(
            _FREEST_STRUCTURE
        )
        for structure in _single_damping_structures(freest_fit):
            if structure.name not in fits_by_structure:
                fit_structure(structure)
        if not refits:
            return self
        new_candidate_set = self.with_candidates((*self.candidates, *added_candidates))
        if new_candidate_set.best.bic > best_candidate.bic - _MIN_BIC_REDUCTION_FOR_NEW_NOISE:
            return new_candidate_set.cross_check()
        return new_candidate_set.refit_under_noise(
            min(refits, key=lambda refit: refit.cost).residual_noise()
        )

    def refit_with_additional_effect(self, effect_spectra: NDArray[np.complex128]) -> CandidateSet:
        """Return the set refitted with additional torque spectra, each of free amplitude.

        The noise is estimated again from the residual of the best candidate with these spectra.
        """
        all_spectra = np.concatenate([self.effect_spectra, effect_spectra])
        best_refit = replace(self, effect_spectra=all_spectra).refit(self.best)
        return self.refit_with_effect_spectra(all_spectra, best_refit.residual_noise())

    def refit_with_effect_spectra(
        self, effect_spectra: NDArray[np.complex128], noise: NoiseSpectrum
    ) -> CandidateSet:
        """Refit all candidates with given torque spectra of free amplitude, under a given noise.

        The spectra are those of effects in addition to the linear beam. They replace the
        `effect_spectra` of the set.
        """
        new_candidate_set = replace(self, effect_spectra=effect_spectra, noise=noise)
        return new_candidate_set.with_candidates(
            new_candidate_set.refit(c).candidate() for c in self.candidates
        ).cross_check()

    def with_candidates(self, candidates: Iterable[Candidate]) -> CandidateSet:
        """Return the set with its candidates replaced by the given ones, sorted by rising BIC."""
        return replace(self, candidates=_sorted_by_bic(candidates))

    def is_nearly_white(self, fit: RecordFit) -> bool:
        """Return whether the torque residual of a fit is white noise at the 1 % level."""
        is_compared = self.noise.is_compared
        return whiteness(
            fit.residual[is_compared], self.comparison.frequency_hz[is_compared]
        ).is_nearly_white


def _single_damping_structures(fit: RecordFit) -> list[Structure]:
    """Return the structures of one damping, if the other damping is insignificant in a fit."""
    structures_with_absent_dampings = zip(
        _SINGLE_DAMPING_STRUCTURES, (fit.external, fit.internal), strict=True
    )
    return [
        structure
        for structure, missing_damping in structures_with_absent_dampings
        if missing_damping is None
        or missing_damping.value < _CERTAIN_DAMPING_STD_RATIO * missing_damping.std
    ]


def _sorted_by_bic(candidates: Iterable[Candidate]) -> tuple[Candidate, ...]:
    """Return the candidates sorted by rising BIC."""
    return tuple(sorted(candidates, key=lambda candidate: candidate.bic))
