"""Nonlinear stiffness and damping (dependent on the deflection): torque, and a search for them.

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

from analysis.identify._candidates import INTEGER_INTERNAL_ORDER
from analysis.identify._data import fast_length
from analysis.identify._predictor import torque_channel_response
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

ForceKind = Literal["cubic stiffness", "quadratic stiffness", "quadratic drag"]
"""Kind of a nonlinear restoring force."""

FORCE_KINDS: Final[tuple[ForceKind, ...]] = (
    "cubic stiffness",
    "quadratic stiffness",
    "quadratic drag",
)
"""All kinds of nonlinear restoring forces that are tested."""

_OVERSAMPLING: Final = 3
"""Factor by which the sampling rate is raised to compute a nonlinear force. The band ends at 0.4 of
the rate, so harmonics up to three times its end do not alias into the band."""

_PADDED_LENGTH_RATIO: Final = 1.5
"""Length of the padded Fourier transforms relative to the record."""

_WRAPPED_DECAY_EXPONENT: Final = 9.0
"""Product of the damping rate sigma and the padded duration: the response that wraps around is
attenuated by its exponential."""

_MAX_SUBSTITUTIONS: Final = 12
"""Maximum number of substitutions that compute the motion of a mode with its nonlinear force."""

_FORCE_TOLERANCE: Final = 1e-3
"""Relative change of a nonlinear force below which the repeated substitution has converged."""


@dataclass(frozen=True, slots=True)
class NonlinearTerm:
    """Nonlinear restoring force of one kind on one mode.

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
    """Computes the torque spectra of nonlinear restoring forces of unit size on single modes.

    Parameters
    ----------
    comparison : Comparison
        Record, reduced to the band.
    plant : Plant
        Linear plant.
    """

    __slots__ = (
        "_comparison",
        "_growth",
        "_inertia_and_external",
        "_length",
        "_plant",
        "_s",
        "_samples",
    )

    def __init__(self, comparison: Comparison, plant: Plant) -> None:
        n, rate_hz = comparison.angle_rad.size, comparison.decimation.rate_hz
        self._comparison, self._plant, self._samples = comparison, plant, n
        self._length = fast_length(int(np.ceil(_PADDED_LENGTH_RATIO * n)))
        # On s = sigma + j omega the part that wraps around has decayed: see `TorquePredictor`.
        sigma = _WRAPPED_DECAY_EXPONENT * rate_hz / self._length
        bins = np.arange(self._length // 2 + 1)
        self._s = sigma + 2j * np.pi * rate_hz / self._length * bins
        fine_time_s = np.arange(_OVERSAMPLING * n) / (_OVERSAMPLING * rate_hz)
        self._growth = np.exp(sigma * fine_time_s)
        damping, density_over_stiffness = plant.damping, plant.beam.density_over_stiffness
        self._inertia_and_external = (
            density_over_stiffness * self._s**2 + damping.gamma * self._s**damping.lambda_
        )

    def column(self, term: NonlinearTerm, size: float = 0.0) -> NDArray[np.complex128]:
        """Return the torque spectrum of a force divided by its `size`, shape (K,), in N·m.

        It is not finite if the repeated substitution diverges: the force is then too large.

        Parameters
        ----------
        term : Term
            Kind and mode of the force.
        size : float
            Size e of the force for which the motion of the mode is computed; 0 for the first order.
        """
        k, stiffness = self._modal_stiffness(term.mode)
        dynamic_stiffness = self._inertia_and_external + stiffness
        angle = self._comparison.angle_rad
        decaying_angle = angle / self._growth[::_OVERSAMPLING]
        linear_motion = (
            -self._inertia_and_external
            / dynamic_stiffness
            * np.fft.rfft(decaying_angle, self._length)
        )
        force = self._force_transform(term.kind, linear_motion, linear_motion)
        if size:
            motion_per_force = -size * k / dynamic_stiffness
            with np.errstate(over="ignore", invalid="ignore"):
                for _ in range(_MAX_SUBSTITUTIONS):
                    new_force = self._force_transform(
                        term.kind, linear_motion + motion_per_force * force, linear_motion
                    )
                    change, force_norm = (
                        np.linalg.norm(new_force - force),
                        np.linalg.norm(new_force),
                    )
                    force = new_force
                    if not np.isfinite(force_norm):
                        return np.full(self._comparison.frequency_hz.size, np.nan + 0j)
                    if change < _FORCE_TOLERANCE * force_norm:
                        break
        beam = self._plant.beam
        scale = float(participation(beam, term.mode)[-1]) * beam.bending_stiffness_n_m2
        torque = (
            -scale
            * k
            * self._inertia_and_external
            / dynamic_stiffness
            * force
            * torque_channel_response(self._plant, self._s)
        )
        in_time = np.fft.irfft(torque, self._length)[: self._samples]
        in_time *= self._growth[::_OVERSAMPLING]
        spectrum: NDArray[np.complex128] = self._comparison.spectrum(
            in_time[self._comparison.retained]
        )
        return spectrum

    def _modal_stiffness(self, mode: int) -> tuple[float, NDArray[np.complex128]]:
        """Return k⁴ of a mode in 1/m⁴, and k⁴ with internal damping at each s."""
        plant = self._plant
        stiffness = float(clamped_free_eigenvalues(mode)[-1] / plant.beam.length_m) ** 4
        damped_stiffness = stiffness * (1 + plant.damping.zeta * self._s**plant.damping.alpha)
        return stiffness, damped_stiffness.astype(np.complex128)

    def _force_transform(
        self, kind: ForceKind, motion: NDArray[np.complex128], linear_motion: NDArray[np.complex128]
    ) -> NDArray[np.complex128]:
        """Return the transform of n for a motion of a mode, shape (length // 2 + 1,).

        The linear motion determines the largest deflection R and the largest speed V.
        """
        if kind == "quadratic drag":
            speed = self._oversampled_values(motion * self._s)
            largest_speed = np.abs(self._oversampled_values(linear_motion * self._s)).max()
            frequency_rad_s = largest_speed / np.abs(self._oversampled_values(linear_motion)).max()
            n = 2 * speed * np.abs(speed) / (largest_speed * frequency_rad_s)
        else:
            deflection = self._oversampled_values(motion)
            largest = np.abs(self._oversampled_values(linear_motion)).max()
            exponent = 3 if kind == "cubic stiffness" else 2
            n = deflection**exponent / largest ** (exponent - 1)
        n /= self._growth
        spectrum = np.fft.rfft(n, _OVERSAMPLING * self._length)[: self._s.size]
        return spectrum / _OVERSAMPLING

    def _oversampled_values(self, spectrum: NDArray[np.complex128]) -> NDArray[np.float64]:
        """Return the oversampled time series of a spectrum over the record."""
        decayed_values = np.fft.irfft(_OVERSAMPLING * spectrum, _OVERSAMPLING * self._length)
        values: NDArray[np.float64] = decayed_values[: self._growth.size] * self._growth
        return values


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

_MIN_EXPLAINED_FRACTION: Final = 0.5
"""Minimum fraction of the cost beyond noise that nonlinear forces must explain. Otherwise the
residual has another cause."""


@dataclass(frozen=True, slots=True)
class NonlinearForce:
    """Estimated nonlinear restoring force.

    Attributes
    ----------
    term : Term
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
    candidate_set: CandidateSet, modes: tuple[int, ...]
) -> tuple[CandidateSet, tuple[NonlinearForce, ...]]:
    """Add significant nonlinear forces one by one, and refit all candidates with them.

    A mode whose stiffness rises resembles a mode of another frequency, or a fractional order. If
    the best candidate has a fractional order, the search also starts from candidates without one.
    Even then such a force leaves a trace in the residual of the best candidate, and without that
    trace nothing is tested. `modes` are the visible modes. Return the candidates with the forces,
    or the given candidates and no forces.
    """
    best = candidate_set.best
    best_refit = candidate_set.refit(best)
    if (
        _deviance_reduction(
            best, best_refit.cost, _best_first_order_force(candidate_set, best_refit, modes, [])[1]
        )
        < _MIN_PREDICTED_DEVIANCE_REDUCTION
    ):
        return candidate_set, ()
    for start_candidate in _start_candidates(candidate_set):
        with_forces, forces = _add_forces(candidate_set, start_candidate, modes)
        if (
            forces
            and with_forces.bic < candidate_set.bic - BIC_DECISIVE
            and _forces_explain_residual(candidate_set, with_forces)
        ):
            return with_forces, forces
    return candidate_set, ()


def _start_candidates(candidate_set: CandidateSet) -> tuple[Candidate, ...]:
    """Return the candidates that the search for forces starts from: simpler ones, then the best."""
    best = candidate_set.best
    if "alpha" not in best.structure.free:
        return (best,)
    return (*(c for c in candidate_set.candidates if c.structure in INTEGER_INTERNAL_ORDER), best)


def _add_forces(
    candidate_set: CandidateSet, start_candidate: Candidate, modes: tuple[int, ...]
) -> tuple[CandidateSet, tuple[NonlinearForce, ...]]:
    """Add significant forces to one candidate one by one, then refit all candidates with them."""
    terms: list[NonlinearTerm] = []
    sizes = std = np.zeros(0)
    best = candidate_set.best
    refit = candidate_set.refit(start_candidate)
    while len(terms) < _MAX_FORCES:
        term, cost = _best_first_order_force(candidate_set, refit, modes, terms)
        deviance_above_best = _deviance_reduction(best, cost, best.fit.cost)
        if (
            term is None
            or _deviance_reduction(best, refit.cost, cost) < _MIN_DEVIANCE_REDUCTION
            or deviance_above_best > _GIVE_UP_DEVIANCE
        ):
            break
        fitted = _fit_with_forces(candidate_set, refit, [*terms, term], np.append(sizes, 0.0))
        if (
            fitted is None
            or _deviance_reduction(best, refit.cost, fitted[0].cost) < _MIN_DEVIANCE_REDUCTION
        ):
            break
        terms.append(term)
        refit, sizes, std = fitted
    if not terms:
        return candidate_set, ()
    with_forces = candidate_set.refit_with_effect_spectra(refit.columns, refit.residual_noise())
    forces = zip(terms, sizes.tolist(), std.tolist(), strict=True)
    return with_forces, tuple(NonlinearForce(term, size, s) for term, size, s in forces)


def _deviance_reduction(candidate: Candidate, cost_before: float, cost_after: float) -> float:
    """Return the reduction of the deviance between two costs of a candidate."""
    return candidate.values * math.log(cost_before / cost_after)


def _best_first_order_force(
    candidate_set: CandidateSet,
    refit: Refit,
    modes: tuple[int, ...],
    excluded_terms: list[NonlinearTerm],
) -> tuple[NonlinearTerm | None, float]:
    """Return the force with the largest cost reduction to first order, and the cost with it.

    Forces in `excluded_terms` are not considered.
    """
    forces = NonlinearForceSpectra(candidate_set.comparison, refit.plant)
    # If drag on the whole beam is significant, drag on a single mode is not tested.
    kinds = (
        FORCE_KINDS
        if candidate_set.drag is None
        else tuple(k for k in FORCE_KINDS if k != "quadratic drag")
    )
    terms = [NonlinearTerm(kind, mode) for kind in kinds for mode in modes]
    terms = [term for term in terms if term not in excluded_terms]
    if not terms:
        return None, refit.cost
    cost_reductions = refit.cost_reduction_by_spectrum(
        np.array([forces.column(term) for term in terms])
    )
    best_index = int(np.argmax(cost_reductions))
    return terms[best_index], max(
        refit.cost - float(cost_reductions[best_index]), 1e-3 * refit.cost
    )


def _fit_with_forces(
    candidate_set: CandidateSet,
    refit: Refit,
    terms: list[NonlinearTerm],
    sizes: NDArray[np.float64],
) -> tuple[Refit, NDArray[np.float64], NDArray[np.float64]] | None:
    """Fit a plant with the given forces, starting from given sizes of the forces.

    The torque spectra of the forces are updated with the sizes. Return the fit, the sizes and their
    standard deviations, or None if a size is so large that its torque cannot be computed.
    """
    std = np.zeros(sizes.size)
    for _ in range(_MAX_SIZE_ITERATIONS):
        forces = NonlinearForceSpectra(candidate_set.comparison, refit.plant)
        spectra = [forces.column(term, e) for term, e in zip(terms, sizes.tolist(), strict=True)]
        if not np.isfinite(spectra).all():
            return None
        columns = np.concatenate([candidate_set.columns, spectra])
        refit = Refit.descend(
            candidate_set.comparison,
            refit.objective.unknowns,
            refit.x,
            candidate_set.noise,
            columns,
        )
        last_sizes = sizes
        sizes, std = (values[len(candidate_set.columns) :] for values in refit.amplitudes())
        if np.all(
            np.abs(sizes - last_sizes)
            < np.maximum(0.3 * std, _RELATIVE_SIZE_TOLERANCE * np.abs(sizes))
        ):
            break
    return refit, sizes, std


def _forces_explain_residual(linear_set: CandidateSet, set_with_forces: CandidateSet) -> bool:
    """Return whether the forces explain half of the residual beyond noise, or leave only noise."""
    power = np.abs(linear_set.best.fit.residual) ** 2
    excess_without = linear_set.best.fit.cost - linear_set.best.fit.degrees_of_freedom
    largest_by_chance = SIGNIFICANT_STD * math.sqrt(2 * power.size * 2)
    excess_with = set_with_forces.best.fit.cost - set_with_forces.best.fit.degrees_of_freedom
    return excess_with < max(_MIN_EXPLAINED_FRACTION * excess_without, largest_by_chance)
