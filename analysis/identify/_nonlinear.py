"""Nonlinear stiffness and damping: torque, and search for their forces in a record.

The angle drives the motion r of mode i relative to its root. A further restoring force n acts on
it::

    p r + k⁴ (c r + n) = -p angle        p = rho/EI s² + gamma s^lambda,  c = 1 + zeta s^alpha
    torque added = -a² EI p k⁴ n / (p + c k⁴)

With the largest deflection R and the largest speed V that the mode reaches, n is one of

* ``n = e r³ / R²``: stiffness that rises by the fraction e at R; acts at one and three times the
  drive's frequency (odd harmonics);
* ``n = e r² / R``: stiffness that differs from side to side; even harmonics;
* ``n = 2 e r'|r'| / (omega V)``: drag that grows with the square of the speed, as in air; the
  damping ratio rises by e at V.

To first order in e these are torques of known form and unknown size. Where e is not small, r is the
motion of the mode with the force, found by repeated substitution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from analysis.identify._candidates import INTERNAL_ORDER_ONE_STRUCTURES
from analysis.identify._refit import Refit
from analysis.identify.residual_tests import SIGNIFICANT_STD
from analysis.statistics import BIC_DECISIVE
from rigd.beam import CausalTransform, clamped_free_eigenvalues, participation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._candidate import Candidate
    from analysis.identify._candidates import CandidateSet
    from analysis.identify._comparison import Comparison
    from rigd.beam import Plant


# Torque by a force

ForceKind = Literal["cubic stiffness", "quadratic stiffness", "quadratic drag"]
"""Kind of a nonlinear restoring force."""

FORCE_KINDS: Final[tuple[ForceKind, ...]] = (
    "cubic stiffness",
    "quadratic stiffness",
    "quadratic drag",
)
"""All kinds of nonlinear restoring forces that are tested."""

_DEFLECTION_EXPONENTS: Final = {"cubic stiffness": 3, "quadratic stiffness": 2}
"""Exponent of the deflection in each force that depends on it."""

_FORCE_OVERSAMPLING: Final = 3
"""Factor by which the sampling rate is raised to compute a nonlinear force. The band ends at 0.4 of
the rate, so harmonics up to three times its end do not alias into the band."""

_TRANSFORM_PADDING_RATIO: Final = 1.5
"""Length of the transforms over that of the record."""

_TRANSFORM_DECAY_EXPONENT: Final = 9.0
"""Decay exponent of the `CausalTransform`. It is large because repeated substitution accumulates
what wraps round from the end of a transform to its beginning."""

_MAX_FORCE_ITERATIONS: Final = 12
"""Maximum number of substitutions that compute the motion of a mode with its nonlinear force."""

_RELATIVE_FORCE_TOLERANCE: Final = 1e-3
"""Relative change of a nonlinear force below which the repeated substitution has converged."""


@dataclass(frozen=True, slots=True)
class NonlinearTerm:
    """Kind and mode of a nonlinear restoring force of the beam.

    Attributes
    ----------
    kind : str
        Kind of the force.
    mode : int
        Mode number, from 1.
    """

    kind: ForceKind
    mode: int


class NonlinearForceSpectra:
    """Computation of torque spectra of nonlinear restoring forces of unit size on single modes."""

    __slots__ = ("_comparison", "_inertia_and_external", "_plant", "_s", "_samples", "_transform")

    def __init__(self, comparison: Comparison, plant: Plant) -> None:
        self._comparison, self._plant = comparison, plant
        self._samples = comparison.angle_rad.size
        self._transform = CausalTransform.for_record(
            self._samples,
            comparison.decimation.rate_hz,
            _TRANSFORM_PADDING_RATIO,
            _TRANSFORM_DECAY_EXPONENT,
        )
        self._s = self._transform.s
        damping, density_over_stiffness = plant.damping, plant.beam.density_over_stiffness
        self._inertia_and_external = (
            density_over_stiffness * self._s**2 + damping.gamma * self._s**damping.lambda_
        )

    def torque_spectrum(
        self, term: NonlinearTerm, force_size: float = 0.0
    ) -> NDArray[np.complex128]:
        """Return the torque spectrum of a nonlinear force per unit of its size, in N·m, shape (K,).

        It is not finite if the repeated substitution diverges: the force is then too large. The
        motion of the mode is computed for a force of size `force_size`, and to first order for 0.
        """
        k, damped_stiffness = self._modal_stiffness(term.mode)
        dynamic_stiffness = self._inertia_and_external + damped_stiffness
        linear_motion = (
            -self._inertia_and_external
            / dynamic_stiffness
            * self._transform.forward(self._comparison.angle_rad)
        )
        force_scale = self._force_scale(term.kind, linear_motion)
        force_transform = self._force_transform(term.kind, linear_motion, force_scale)
        if force_size:
            motion_per_force = -force_size * k / dynamic_stiffness
            with np.errstate(over="ignore", invalid="ignore"):
                for _ in range(_MAX_FORCE_ITERATIONS):
                    new_force_transform = self._force_transform(
                        term.kind, linear_motion + motion_per_force * force_transform, force_scale
                    )
                    force_change, force_norm = (
                        np.linalg.norm(new_force_transform - force_transform),
                        np.linalg.norm(new_force_transform),
                    )
                    force_transform = new_force_transform
                    if not np.isfinite(force_norm):
                        return np.full(self._comparison.frequency_hz.size, np.nan + 0j)
                    if force_change < _RELATIVE_FORCE_TOLERANCE * force_norm:
                        break
        plant_beam = self._plant.beam
        torque_scale = (
            float(participation(plant_beam, term.mode)[-1]) * plant_beam.bending_stiffness_n_m2
        )
        torque_transform = (
            -torque_scale
            * k
            * self._inertia_and_external
            / dynamic_stiffness
            * force_transform
            * self._plant.channel_response(self._s)
        )
        torque_spectrum: NDArray[np.complex128] = self._comparison.spectrum(
            self._transform.inverse(torque_transform, self._comparison.retained_samples)
        )
        return torque_spectrum

    def _modal_stiffness(self, mode_number: int) -> tuple[float, NDArray[np.complex128]]:
        """Return k⁴ of a mode (wavenumber k) in 1/m⁴, and k⁴ with internal damping at each s."""
        plant = self._plant
        wavenumber_fourth_power = (
            float(clamped_free_eigenvalues(mode_number)[-1] / plant.beam.length_m) ** 4
        )
        damped_stiffness = wavenumber_fourth_power * (
            1 + plant.damping.zeta * self._s**plant.damping.alpha
        )
        return wavenumber_fourth_power, damped_stiffness.astype(np.complex128)

    def _force_scale(
        self, force_kind: ForceKind, linear_motion_transform: NDArray[np.complex128]
    ) -> float:
        """Return the constant factor of a nonlinear force of unit size, such as ``1 / R²``.

        It depends on the largest deflection R and the largest speed V of the mode, which are those
        of its linear motion.
        """
        largest_deflection = np.abs(self._oversampled_values(linear_motion_transform)).max()
        if force_kind == "quadratic drag":
            modal_speed = self._oversampled_values(linear_motion_transform * self._s)
            return float(2 * largest_deflection / np.abs(modal_speed).max() ** 2)
        return float(1 / largest_deflection ** (_DEFLECTION_EXPONENTS[force_kind] - 1))

    def _force_transform(
        self,
        force_kind: ForceKind,
        motion_transform: NDArray[np.complex128],
        force_scale: float,
    ) -> NDArray[np.complex128]:
        """Return the transform of a nonlinear force of unit size, shape (length // 2 + 1,).

        `motion_transform` is the transform of the motion of the mode, which determines the force.
        """
        if force_kind == "quadratic drag":
            modal_speed = self._oversampled_values(motion_transform * self._s)
            force_values = modal_speed * np.abs(modal_speed)
        else:
            deflection = self._oversampled_values(motion_transform)
            force_values = deflection ** _DEFLECTION_EXPONENTS[force_kind]
        return force_scale * self._transform.forward(force_values, oversampling=_FORCE_OVERSAMPLING)

    def _oversampled_values(self, motion_transform: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return the inverse of a mode's Laplace transform as an oversampled time series."""
        return self._transform.inverse(
            motion_transform, _FORCE_OVERSAMPLING * self._samples, oversampling=_FORCE_OVERSAMPLING
        )


# Search

_MAX_FORCES: Final = 2
"""Maximum number of nonlinear forces in a fit."""

_MAX_SIZE_ITERATIONS: Final = 6
"""Maximum number of fits that determine the sizes of nonlinear forces."""

_RELATIVE_SIZE_TOLERANCE: Final = 0.005
"""Relative change of the size of a nonlinear force below which it has converged."""

_MIN_DEVIANCE_REDUCTION: Final = SIGNIFICANT_STD**2 + 2 * math.log(30)
"""Minimum reduction of the deviance by a nonlinear force. It accounts for the test of three forces
on three modes in three rounds."""

_MIN_PREDICTED_DEVIANCE_REDUCTION: Final = 6.0
"""Minimum predicted reduction of the deviance by the best nonlinear force for which forces are
fitted. Chance reaches it in one record of ten."""

_GIVE_UP_DEVIANCE: Final = 2000.0
"""Deviance, relative to that of the best candidate, above which a force is not fitted: the
first-order prediction is then too far off for repeated substitution to make up for it."""

_MIN_EXPLAINED_EXCESS_FRACTION: Final = 0.5
"""Minimum fraction of the cost beyond noise that nonlinear forces must explain. Otherwise the
residual has another cause."""


@dataclass(frozen=True, slots=True)
class NonlinearForce:
    """Estimated nonlinear restoring force of one mode of the beam.

    Attributes
    ----------
    term : NonlinearTerm
        Kind and mode of the force.
    size : float
        Change of the stiffness at the largest deflection, as a fraction, or change of the damping
        ratio at the largest speed.
    std : float
        Standard deviation of `size`.
    """

    term: NonlinearTerm
    size: float
    std: float


def add_nonlinear_forces(
    candidate_set: CandidateSet, mode_numbers: tuple[int, ...]
) -> tuple[CandidateSet, tuple[NonlinearForce, ...]]:
    """Return the candidate set refitted with significant nonlinear forces, and the forces.

    The forces are added one by one to the visible `mode_numbers`. Return the given candidates and
    no forces if none is significant.

    A mode whose stiffness rises resembles a mode of another frequency, or a fractional order. If
    the best candidate has a fractional order, the search also starts from candidates without one.
    Even then such a force leaves a trace in the residual of the best candidate. Without that trace
    nothing is tested.
    """
    best_candidate = candidate_set.best
    best_refit = candidate_set.refit(best_candidate)
    if (
        _deviance_reduction(
            best_candidate,
            best_refit.cost,
            _best_first_order_force(candidate_set, best_refit, mode_numbers, [])[1],
        )
        < _MIN_PREDICTED_DEVIANCE_REDUCTION
    ):
        return candidate_set, ()
    for start_candidate in _start_candidates(candidate_set):
        with_forces, forces = _add_forces(candidate_set, start_candidate, mode_numbers)
        if (
            forces
            and with_forces.bic < candidate_set.bic - BIC_DECISIVE
            and _forces_explain_residual(candidate_set, with_forces)
        ):
            return with_forces, forces
    return candidate_set, ()


def _start_candidates(candidate_set: CandidateSet) -> tuple[Candidate, ...]:
    """Return the candidates from which the search for nonlinear forces starts.

    The best candidate comes last. If its internal order is free, the candidates with the internal
    order 1 precede it.
    """
    best_candidate = candidate_set.best
    if "alpha" not in best_candidate.structure.free:
        return (best_candidate,)
    return (
        *(c for c in candidate_set.candidates if c.structure in INTERNAL_ORDER_ONE_STRUCTURES),
        best_candidate,
    )


def _add_forces(
    candidate_set: CandidateSet, start_candidate: Candidate, mode_numbers: tuple[int, ...]
) -> tuple[CandidateSet, tuple[NonlinearForce, ...]]:
    """Return the candidate set refitted with the nonlinear forces of one candidate, and the forces.

    Significant forces are added to that candidate one by one.
    """
    found_terms: list[NonlinearTerm] = []
    force_sizes = force_stds = np.zeros(0)
    best_candidate = candidate_set.best
    refit = candidate_set.refit(start_candidate)
    while len(found_terms) < _MAX_FORCES:
        best_term, cost_with_term = _best_first_order_force(
            candidate_set, refit, mode_numbers, found_terms
        )
        deviance_above_best = _deviance_reduction(
            best_candidate, cost_with_term, best_candidate.fit.cost
        )
        if (
            best_term is None
            or _deviance_reduction(best_candidate, refit.cost, cost_with_term)
            < _MIN_DEVIANCE_REDUCTION
            or deviance_above_best > _GIVE_UP_DEVIANCE
        ):
            break
        fit_with_term = _fit_with_forces(
            candidate_set, refit, [*found_terms, best_term], np.append(force_sizes, 0.0)
        )
        if (
            fit_with_term is None
            or _deviance_reduction(best_candidate, refit.cost, fit_with_term[0].cost)
            < _MIN_DEVIANCE_REDUCTION
        ):
            break
        found_terms.append(best_term)
        refit, force_sizes, force_stds = fit_with_term
    if not found_terms:
        return candidate_set, ()
    candidate_set_with_forces = candidate_set.refit_with_effect_spectra(
        refit.effect_spectra, refit.residual_noise()
    )
    forces = zip(found_terms, force_sizes.tolist(), force_stds.tolist(), strict=True)
    return candidate_set_with_forces, tuple(
        NonlinearForce(best_term, force_size, s) for best_term, force_size, s in forces
    )


def _deviance_reduction(candidate: Candidate, cost_before: float, cost_after: float) -> float:
    """Return by how much the deviance of a candidate falls from one cost to another."""
    return candidate.compared_value_count * math.log(cost_before / cost_after)


def _best_first_order_force(
    candidate_set: CandidateSet,
    refit: Refit,
    mode_numbers: tuple[int, ...],
    excluded_terms: list[NonlinearTerm],
) -> tuple[NonlinearTerm | None, float]:
    """Return the nonlinear force that reduces the cost most, and the cost with it.

    Both are predicted to first order. Forces in `excluded_terms` are not considered. The force is
    None if there is no other.
    """
    force_spectra = NonlinearForceSpectra(candidate_set.comparison, refit.plant)
    # If drag on the whole beam is significant, drag on a single mode is not tested.
    tested_kinds = (
        FORCE_KINDS
        if candidate_set.drag is None
        else tuple(k for k in FORCE_KINDS if k != "quadratic drag")
    )
    tested_terms = [
        NonlinearTerm(force_kind, mode_number)
        for force_kind in tested_kinds
        for mode_number in mode_numbers
    ]
    tested_terms = [force_term for force_term in tested_terms if force_term not in excluded_terms]
    if not tested_terms:
        return None, refit.cost
    cost_reductions = refit.cost_reduction_by_spectrum(
        np.array([force_spectra.torque_spectrum(force_term) for force_term in tested_terms])
    )
    best_index = int(np.argmax(cost_reductions))
    return tested_terms[best_index], max(
        refit.cost - float(cost_reductions[best_index]), 1e-3 * refit.cost
    )


def _fit_with_forces(
    candidate_set: CandidateSet,
    refit: Refit,
    force_terms: list[NonlinearTerm],
    force_sizes: NDArray[np.float64],
) -> tuple[Refit, NDArray[np.float64], NDArray[np.float64]] | None:
    """Fit a plant with the given forces, starting from given sizes of the forces.

    The torque spectra of the forces are updated with the sizes. Return the fit, the sizes and their
    standard deviations, or None if a size is so large that its torque cannot be computed.
    """
    force_stds = np.zeros(force_sizes.size)
    for _ in range(_MAX_SIZE_ITERATIONS):
        force_spectra = NonlinearForceSpectra(candidate_set.comparison, refit.plant)
        spectra = [
            force_spectra.torque_spectrum(force_term, e)
            for force_term, e in zip(force_terms, force_sizes.tolist(), strict=True)
        ]
        if not np.isfinite(spectra).all():
            return None
        torque_spectra = np.concatenate([candidate_set.effect_spectra, spectra])
        refit = Refit.descend(
            candidate_set.comparison,
            refit.objective.unknowns,
            refit.x,
            candidate_set.noise,
            torque_spectra,
        )
        last_force_sizes = force_sizes
        force_sizes, force_stds = (
            force_values[len(candidate_set.effect_spectra) :] for force_values in refit.amplitudes()
        )
        if np.all(
            np.abs(force_sizes - last_force_sizes)
            < np.maximum(0.3 * force_stds, _RELATIVE_SIZE_TOLERANCE * np.abs(force_sizes))
        ):
            break
    return refit, force_sizes, force_stds


def _forces_explain_residual(
    linear_candidate_set: CandidateSet, candidate_set_with_forces: CandidateSet
) -> bool:
    """Return whether nonlinear forces explain half of the residual beyond noise.

    Return True also if they leave only noise.
    """
    residual_power = np.abs(linear_candidate_set.best.fit.residual) ** 2
    excess_cost_without_forces = (
        linear_candidate_set.best.fit.cost - linear_candidate_set.best.fit.degrees_of_freedom
    )
    largest_excess_by_chance = SIGNIFICANT_STD * math.sqrt(2 * residual_power.size * 2)
    excess_cost_with_forces = (
        candidate_set_with_forces.best.fit.cost
        - candidate_set_with_forces.best.fit.degrees_of_freedom
    )
    return excess_cost_with_forces < max(
        _MIN_EXPLAINED_EXCESS_FRACTION * excess_cost_without_forces, largest_excess_by_chance
    )
