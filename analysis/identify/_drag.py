"""Air drag on the beam: its significance, its size C_D d, and damping ratios at several amplitudes.

The drag law of the whole beam has one coefficient, or two if C_D falls with the speed. A fit
without drag yields a fractional order, a delay, deviating mode frequencies and a wrong density
instead, because drag damps each mode in proportion to its speed.

In free vibration of one mode, with the tip moving by ``A sin(omega t)``, a force per metre
``rho_air/2 C v^p`` dissipates in each cycle as much energy as linear damping of the ratio::

    rho_air/2 C (A omega)^(p - 1) m_p kappa_p / (2 rho omega)

Here rho is the mass per length, ``m_p`` the mean of ``2 |sin|^(p + 1)``, ``kappa_p`` the mean of
``|psi|^(p + 1)`` over that of ``psi²`` along the beam, and psi the mode shape with 1 at the tip.
This ratio adds to the damping ratio of the beam without air.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._candidate import DragEstimate
from analysis.identify._refit import MISSED_MINIMUM_COST_FRACTION, Refit
from analysis.identify.drag_torque import (
    HALF_AIR_DENSITY_KG_PER_M3,
    DragError,
    DragLaw,
)
from analysis.models import STRUCTURES
from analysis.statistics import NORMAL_95
from rigd.beam import mode_shape

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._candidate import Candidate
    from analysis.identify._candidates import CandidateSet
    from analysis.identify._comparison import Comparison
    from analysis.identify._modal_model import ModalEstimate
    from analysis.identify.noise import NoiseSpectrum
    from analysis.models import Structure
    from rigd.beam import Plant


# Search for drag

_TESTED_STRUCTURES: Final = ("III", "VI", "VII")
"""Names of the structures with which drag is tested: those with internal and external damping."""

_FIRST_ORDER_PREDICTION_BIC_MARGIN: Final = 6.0
"""Amount by which the predicted BIC with drag may exceed the lowest BIC for drag to be fitted. The
prediction is of first order, and has an error."""

_MAX_DRAG_COMPUTATIONS: Final = 15
"""Maximum number of computations of the drag torque in a fit."""

_SHORT_DESCENT_EVALUATIONS: Final = 12
"""Maximum number of evaluations of a descent before the drag torque is recomputed."""

_EVALUATIONS_BEFORE_GIVING_UP: Final = 4
"""Number of evaluations after which the descent of a structure with drag ends if its cost is still
far above that of the best structure."""

_LONG_DESCENT_EVALUATIONS: Final = 40
"""Maximum number of evaluations of a descent that continues a promising short descent."""

_GIVE_UP_DEVIANCE: Final = 50.0
"""Deviance, relative to that of the converged structure, above which the descent of another
structure with drag ends early."""

_DRAG_COST_TOLERANCE: Final = 2.0
"""Predicted reduction of the cost below which the drag torque is not recomputed."""

_ROUGH_DRAG_COST_TOLERANCE: Final = 500.0
"""Predicted reduction of the cost below which the drag torque is not recomputed in the first, rough
fit.

The fits of all structures still take the last step (`_fit_all_structures`). The two coefficients of
a drag law and external damping can compensate each other along a flat direction. With a smaller
tolerance, each recomputation then predicted another step of half a standard deviation, away from
the true value, for ten rounds and more of a second each."""

_STAGNATION_COST_REDUCTION: Final = 20.0
"""Predicted reduction of the cost below which a fit with drag may end if it stagnates: if the step
before reduced the cost by no more than twice as much.

Where external damping has vanished or acts as an inertia, each step along its order predicts a
reduction that the recomputed drag does not confirm."""

_FIRST_FITTED_STRUCTURE: Final = "III"
"""Structure of the first fit with drag: both dampings with order 1."""

_FREEST_STRUCTURE: Final = "VI"
"""Structure with both dampings and free orders."""

_MIN_DRAG_STD_FOR_CONSTANT_LAW: Final = 0.1
"""Relative standard deviation of C_D d above which the drag law is a constant.

The drag coefficient of a cylinder falls with the speed. A constant is wrong by up to 7 % on rods
and wires between 0.2 and 2 mm, and external damping compensates for the error. If C_D d is more
certain, the law gets its second coefficient, even if that is not significant: otherwise the
interval would be too narrow."""

_LOWEST_REPORTED_RELATIVE_SPEED: Final = 0.02
"""Lowest speed at which C_D d is reported, relative to the highest speed: below it the record
contains no information."""


def refit_with_air_drag(candidate_set: CandidateSet) -> CandidateSet:
    """Refit all candidates with air drag, if that explains the record better.

    To first order, the spectrum of a small drag predicts by how much drag reduces the cost of each
    of a few structures. Drag is fitted only if one of them could then become the best candidate. If
    drag does not improve the candidates, `candidate_set` itself is returned.
    """
    return (
        _refit_with_drag(candidate_set) if _drag_may_improve_fit(candidate_set) else candidate_set
    )


def _refit_with_drag(candidate_set: CandidateSet) -> CandidateSet:
    """Return all damping structures fitted with air drag, or the given set if its BIC is lower."""
    first_structure_candidate = next(
        (c for c in candidate_set.candidates if c.structure.name == _FIRST_FITTED_STRUCTURE), None
    )
    first_fit_start = (
        None
        if first_structure_candidate is None
        else _first_order_start(candidate_set, first_structure_candidate)
    )
    if first_fit_start is None:
        return candidate_set
    rough_fit = _converged_drag_fit(
        candidate_set,
        first_fit_start,
        STRUCTURES[_FIRST_FITTED_STRUCTURE],
        cost_tolerance=_ROUGH_DRAG_COST_TOLERANCE,
    )
    if rough_fit is None:
        return candidate_set
    # The freest structure starts from this fit: its fit without drag may be far off.
    start_comparison, next_fit_start = (
        rough_fit.objective.comparison,
        _DragFitStart.from_refit(rough_fit),
    )
    for structure_name in (_FREEST_STRUCTURE, _FIRST_FITTED_STRUCTURE):
        drag_fit = _converged_drag_fit(
            candidate_set,
            next_fit_start,
            STRUCTURES[structure_name],
            start_comparison=start_comparison,
        )
        if drag_fit is not None:
            break
        # A converged fit of the same structure is better than the rough one by far less than this.
        if _bic_under_own_noise(rough_fit) > candidate_set.bic + 2 * _ROUGH_DRAG_COST_TOLERANCE:
            return candidate_set
    else:
        return candidate_set
    candidate_set_with_drag = _fit_all_structures(candidate_set, drag_fit)
    assert candidate_set_with_drag.drag is not None
    return (
        candidate_set_with_drag
        if candidate_set_with_drag.drag.drag_m > 0
        and candidate_set_with_drag.bic < candidate_set.bic
        else candidate_set
    )


def _bic_under_own_noise(refit: Refit) -> float:
    """Return the BIC of a refit under the noise of its residual, as in `CandidateSet.bic`."""
    noise_power = refit.residual_noise().power[refit.noise.is_compared]
    parameter_count = refit.x.size + len(refit.effect_spectra)
    return float(parameter_count * math.log(2 * noise_power.size) + 2 * np.sum(np.log(noise_power)))


@dataclass(frozen=True, slots=True)
class _DragFitStart:
    """Start values of a fit with air drag: plant, damping structure, drag law and noise.

    `has_two_coefficients` states whether both coefficients of the drag law are estimated.
    """

    plant: Plant
    structure: Structure
    law: DragLaw
    noise: NoiseSpectrum
    has_two_coefficients: bool = False

    @classmethod
    def from_refit(cls, refit: Refit) -> _DragFitStart:
        """Return plant, drag law and noise at the minimum of a refit, to start the next fit."""
        structure = refit.objective.unknowns.structure
        has_two_coefficients = len(refit.effect_spectra) > 1
        return cls(
            refit.plant, structure, _law_at_minimum(refit), refit.noise, has_two_coefficients
        )


def _drag_may_improve_fit(candidate_set: CandidateSet) -> bool:
    """Return whether air drag could give some structure a lower BIC than the best candidate."""
    best_candidate = candidate_set.best
    for candidate in candidate_set.candidates:
        if candidate is not best_candidate and candidate.structure.name not in _TESTED_STRUCTURES:
            continue
        refit = candidate_set.refit(candidate, 1)
        drag_m, cost_reduction = _first_order_drag(refit)
        cost_without_drag = refit.cost
        cost_with_drag = max(cost_without_drag - cost_reduction, 1e-3 * cost_without_drag)
        deviance_reduction = candidate.compared_value_count * math.log(
            cost_without_drag / cost_with_drag
        )
        if (
            drag_m > 0
            and candidate.bic - deviance_reduction + math.log(candidate.compared_value_count)
            < best_candidate.bic + _FIRST_ORDER_PREDICTION_BIC_MARGIN
        ):
            return True
    return False


def small_drag_spectrum(
    comparison: Comparison, plant: Plant, measured_modes: ModalEstimate | None = None
) -> NDArray[np.complex128]:
    """Return the torque spectrum of a small air drag per metre of C_D d, in N·m/m, shape (1, K).

    `measured_modes` replace those of the plant, as for `DragResponse`.
    """
    drag_response = comparison.drag_response(plant, measured_modes)
    return comparison.spectrum(
        drag_response.first_order_torque()[None, comparison.retained_samples]
    )


def _first_order_drag(refit: Refit) -> tuple[float, float]:
    """Return C_D d in metres of the air drag missing from a fit, and by how much it cuts the cost.

    Both are first-order estimates, with all other parameters of the fit free.
    """
    (drag_spectrum,), residual = refit.unexplained_spectra(
        small_drag_spectrum(refit.objective.comparison, refit.plant)
    )
    squared_spectrum_norm = float(np.vdot(drag_spectrum, drag_spectrum).real)
    if squared_spectrum_norm <= 0:
        return 0.0, 0.0
    projection = float(np.vdot(drag_spectrum, residual).real)
    return -projection / squared_spectrum_norm, projection**2 / squared_spectrum_norm


def _first_order_start(candidate_set: CandidateSet, candidate: Candidate) -> _DragFitStart | None:
    """Return start values from a candidate refitted with first-order air drag.

    Return None if the drag would be negative.
    """
    drag_spectrum = small_drag_spectrum(candidate_set.comparison, candidate.fit.plant)
    refit = replace(candidate_set, effect_spectra=drag_spectrum).refit(
        candidate, _SHORT_DESCENT_EVALUATIONS
    )
    drag_m = float(refit.amplitudes()[0][0])
    return (
        _DragFitStart(refit.plant, candidate.structure, DragLaw(drag_m), candidate_set.noise)
        if drag_m > 0
        else None
    )


def _converged_drag_fit(
    candidate_set: CandidateSet,
    fit_start: _DragFitStart,
    structure: Structure,
    *,
    cost_tolerance: float = _DRAG_COST_TOLERANCE,
    start_comparison: Comparison | None = None,
) -> Refit | None:
    """Return a refit of one damping structure with air drag whose torque has converged.

    The fit starts from `fit_start`, and has converged if a further step would reduce the cost by
    less than `cost_tolerance`. `start_comparison` is the comparison with the drag of the start, if
    it has been computed. Return None if the drag is negative, is unstable or does not converge.
    """
    unknowns = candidate_set.unknowns(structure)
    vector_of_unknowns = unknowns.vector(fit_start.plant)
    law, noise, has_two_coefficients = (
        fit_start.law,
        fit_start.noise,
        fit_start.has_two_coefficients,
    )
    comparison, is_rough_fit, cost_reduction = (
        start_comparison,
        cost_tolerance > _DRAG_COST_TOLERANCE,
        math.inf,
    )
    for _ in range(_MAX_DRAG_COMPUTATIONS):
        if comparison is None:
            plant = unknowns.plant(vector_of_unknowns)
            # With drag the plant is different, and so is the torque of the incoherent angle.
            try:
                comparison = candidate_set.comparison.recompute_incoherent_torque(
                    plant
                ).remove_drag_torque(plant, law)
            except DragError:
                return None
        drag_expansion = comparison.drag
        assert drag_expansion is not None
        descend_with_drag = partial(Refit.descend, comparison, unknowns, noise=noise)
        start_refit = descend_with_drag(
            vector_of_unknowns,
            torque_spectra=drag_expansion.law_derivatives[: 1 + has_two_coefficients],
            max_evaluations=1,
        )
        refit = start_refit.continue_descent(_SHORT_DESCENT_EVALUATIONS)
        if (
            has_two_coefficients
            or is_rough_fit
            or _relative_drag_std(refit) > _MIN_DRAG_STD_FOR_CONSTANT_LAW
        ):
            last_reduction, cost_reduction = (
                cost_reduction,
                start_refit.cost - max(start_refit.predicted_cost, refit.cost),
            )
            if (
                cost_reduction < cost_tolerance
                or last_reduction / 2 < cost_reduction < _STAGNATION_COST_REDUCTION
            ):
                return start_refit
        else:
            # Not before: a second number would compensate for wrong damping of the beam.
            has_two_coefficients = True
            refit = descend_with_drag(
                refit.x,
                torque_spectra=drag_expansion.law_derivatives,
                max_evaluations=_SHORT_DESCENT_EVALUATIONS,
            )
        vector_of_unknowns, law, noise = refit.x, _law_at_minimum(refit), refit.residual_noise()
        if law.drag_at_speed_m(drag_expansion.mean_speed_m_s) <= 0:
            return None
        comparison = None
    return None


def _relative_drag_std(refit: Refit) -> float:
    """Return the relative standard deviation of C_D d in a refit whose drag law is a constant."""
    law, (_, std) = _law_at_minimum(refit), refit.amplitudes()
    return float(std[0]) / max(float(law.constant_m), float(np.finfo(float).tiny))


def _law_at_minimum(refit: Refit) -> DragLaw:
    """Return the law of air drag at the minimum of a refit.

    It is the law for which the drag torque was computed, plus the estimated change.
    """
    drag_expansion = refit.objective.comparison.drag
    assert drag_expansion is not None
    law_coefficient_changes = refit.amplitudes()[0].tolist()
    decreasing_part = drag_expansion.law.decreasing_coefficient + (
        law_coefficient_changes[1] if len(law_coefficient_changes) > 1 else 0.0
    )
    return DragLaw(drag_expansion.law.constant_m + law_coefficient_changes[0], decreasing_part)


def _fit_all_structures(candidate_set: CandidateSet, converged_fit: Refit) -> CandidateSet:
    """Fit all structures with the drag torque of a converged fit, and estimate the drag."""
    candidate_set_with_drag = replace(
        candidate_set,
        comparison=converged_fit.objective.comparison,
        effect_spectra=converged_fit.effect_spectra,
        noise=converged_fit.residual_noise(),
    )
    converged_cost = candidate_set_with_drag.descend_from_vector(
        converged_fit.objective.unknowns, converged_fit.x, 1
    ).cost
    cost_limit = converged_cost * math.exp(
        _GIVE_UP_DEVIANCE / candidate_set.best.compared_value_count
    )
    short_descents = []
    for candidate_without_drag in candidate_set.candidates:
        unknowns = candidate_set_with_drag.unknowns(candidate_without_drag.structure)
        refit = Refit.descend(
            candidate_set_with_drag.comparison,
            unknowns,
            unknowns.vector(converged_fit.plant),
            candidate_set_with_drag.noise,
            candidate_set_with_drag.effect_spectra,
            max_evaluations=_SHORT_DESCENT_EVALUATIONS,
            relative_tolerance=MISSED_MINIMUM_COST_FRACTION,
            give_up_condition=(_EVALUATIONS_BEFORE_GIVING_UP, cost_limit),
        )
        short_descents.append((refit.candidate(), refit))
    candidates = [
        refit.continue_descent(_LONG_DESCENT_EVALUATIONS).candidate()
        if refit.predicted_cost < cost_limit
        else candidate
        for candidate, refit in short_descents
    ]
    refitted_candidate_set = candidate_set_with_drag.with_candidates(candidates).cross_check()
    return replace(refitted_candidate_set, drag=_drag_estimate(refitted_candidate_set))


def _drag_estimate(candidate_set: CandidateSet) -> DragEstimate:
    """Return the estimated air drag with its uncertainty.

    It comes from a refit of the candidate with the most free damping parameters.
    """
    freest_candidate = max(candidate_set.candidates, key=lambda c: (len(c.structure.free), -c.bic))
    refit = candidate_set.refit(freest_candidate)
    law, covariance = _law_at_minimum(refit), refit.amplitude_covariance()[1]
    covariance = covariance * freest_candidate.fit.cost / freest_candidate.fit.degrees_of_freedom
    drag_expansion = refit.objective.comparison.drag
    assert drag_expansion is not None
    pivot_speed_m_s = drag_expansion.mean_speed_m_s
    law_coefficient_weights = np.ones(1)
    if len(covariance) > 1:
        pivot_coefficient_weight = max(-covariance[0, 1] / covariance[1, 1], np.finfo(float).tiny)
        top_speed_m_s = drag_expansion.top_speed_m_s
        pivot_speed_m_s = min(
            max(
                float(pivot_coefficient_weight**-1.5),
                _LOWEST_REPORTED_RELATIVE_SPEED * top_speed_m_s,
            ),
            top_speed_m_s,
        )
        law_coefficient_weights = np.array([1.0, pivot_speed_m_s ** (-2 / 3)])
    drag_m, std = (
        law.drag_at_speed_m(pivot_speed_m_s),
        math.sqrt(float(law_coefficient_weights @ covariance @ law_coefficient_weights)),
    )
    return DragEstimate(
        drag_m=drag_m,
        std_m=std,
        interval_95_m=(max(drag_m - NORMAL_95 * std, 0.0), drag_m + NORMAL_95 * std),
        pivot_speed_m_s=pivot_speed_m_s,
        law=law,
        covariance=tuple(tuple(row) for row in covariance.tolist()),
    )


# Damping of a mode against its amplitude

_REPORTED_MODE_NUMBERS: Final = (1, 2)
"""Numbers of the modes whose damping ratio is reported at several amplitudes."""

_RELATIVE_TIP_AMPLITUDES: Final = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1)
"""Amplitudes of the tip, relative to the length of the beam, at which damping ratios are reported,
up to the limit of small slopes."""

_SPEED_EXPONENTS: Final = (2.0, 4 / 3)
"""Exponents of the speed in the drag force, for the two coefficients of a `DragLaw`."""

_QUADRATURE_POINTS: Final = 64
"""Number of points of the Gauss quadrature along the beam."""


@dataclass(frozen=True, slots=True)
class DampingAtAmplitude:
    """Damping ratio of a mode in free vibration at one amplitude of the beam's tip.

    Attributes
    ----------
    mode : int
        Mode number, from 1.
    tip_amplitude_m : float
        Amplitude of the tip.
    damping_ratio, std : float
        Sum of the damping ratios by beam and air, and its standard deviation. The two uncertainties
        are added as if independent. They are anticorrelated, so this is an upper limit.
    """

    mode: int
    tip_amplitude_m: float
    damping_ratio: float
    std: float


def damping_with_amplitude(candidate_set: CandidateSet) -> tuple[DampingAtAmplitude, ...]:
    """Return the damping ratios of the first visible modes at several amplitudes of the tip.

    The result is empty if the candidates include no drag.
    """
    drag_estimate = candidate_set.drag
    if drag_estimate is None:
        return ()
    fit = candidate_set.best.fit
    law_coefficients = np.array(
        [drag_estimate.law.constant_m, drag_estimate.law.decreasing_coefficient]
    )[: len(drag_estimate.covariance)]
    covariance = np.array(drag_estimate.covariance)
    damping_estimates = []
    for mode_estimate in fit.modes:
        if mode_estimate.number not in _REPORTED_MODE_NUMBERS or mode_estimate.frequency_hz <= 0:
            continue
        for relative_amplitude in _RELATIVE_TIP_AMPLITUDES:
            tip_amplitude_m = relative_amplitude * fit.plant.beam.length_m
            damping_ratio_by_law = damping_ratio_per_law_coefficient(
                mode_estimate.number,
                2 * math.pi * mode_estimate.frequency_hz,
                tip_amplitude_m,
                fit.plant.beam.density_kg_per_m,
            )[: law_coefficients.size]
            ratio_variance = mode_estimate.damping_ratio_std**2 + float(
                damping_ratio_by_law @ covariance @ damping_ratio_by_law
            )
            damping_estimates.append(
                DampingAtAmplitude(
                    mode=mode_estimate.number,
                    tip_amplitude_m=tip_amplitude_m,
                    damping_ratio=mode_estimate.damping_ratio
                    + float(damping_ratio_by_law @ law_coefficients),
                    std=math.sqrt(ratio_variance),
                )
            )
    return tuple(damping_estimates)


def damping_ratio_per_law_coefficient(
    mode_number: int, omega_rad_s: float, tip_amplitude_m: float, density_kg_per_m: float
) -> NDArray[np.float64]:
    """Return the damping ratio due to air drag per unit of each coefficient of a `DragLaw`, (2,).

    It is that of one mode in free vibration, with a given amplitude of the tip in metres.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_QUADRATURE_POINTS)
    relative_shape = np.abs(
        mode_shape(mode_number, 0.5 * (nodes + 1)) / mode_shape(mode_number, 1.0)
    )
    tip_speed_m_s = tip_amplitude_m * omega_rad_s
    damping_ratios = []
    for speed_exponent in _SPEED_EXPONENTS:
        mean_over_time = (
            2
            / math.sqrt(math.pi)
            * math.gamma(speed_exponent / 2 + 1)
            / math.gamma(speed_exponent / 2 + 1.5)
        )
        mean_over_shape = float(weights @ relative_shape ** (speed_exponent + 1)) / float(
            weights @ relative_shape**2
        )
        damping_per_length = (
            HALF_AIR_DENSITY_KG_PER_M3
            * tip_speed_m_s ** (speed_exponent - 1)
            * mean_over_time
            * mean_over_shape
        )
        damping_ratios.append(damping_per_length / (2 * density_kg_per_m * omega_rad_s))
    return np.array(damping_ratios)
