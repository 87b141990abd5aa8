"""Least-squares fit of a uniform beam to the modal constants of a record.

A uniform beam with internal and external damping predicts frequency, damping ratio and residue of
every mode from seven parameters.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._altered_beam import BeamDeviations, galerkin_mode_terms
from analysis.identify._modal_model import MODE_CONSTANT_NAMES
from analysis.identify._mode_constants import BeamVibration
from analysis.optimizer import ConstantBounds, NormalEquations, descend
from rigd.beam import (
    BEAM_PARAMETERS,
    DAMPING_PARAMETERS,
    Beam,
    Damping,
    clamped_free_eigenvalues,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from analysis.identify._altered_beam import ModeTerms
    from analysis.identify._modal_model import ModalEstimate
    from analysis.optimizer import Minimum
    from rigd.beam import Plant

PARAMETERS: Final = (*DAMPING_PARAMETERS, *BEAM_PARAMETERS, "delay_s")
"""Names of the seven uniform-beam parameters that determine the modal constants."""

_START_ORDERS: Final = (0.4, 1.0, 1.6)
"""Values of alpha and lambda at which the descents start."""

ORDER_RANGE: Final = (0.02, 1.98)
"""Smallest and largest value of alpha and lambda in the search."""

_LN_LOSS_RANGE: Final = (-18.0, 2.0)
"""Range of the logarithm of a damping's loss, relative to stiffness or inertia at its reference
mode."""

_LN_BEAM_HALF_RANGE: Final = 2.0
"""Largest change of ln(rho/EI) and of ln(EI) from the start of the search."""

_DELAY_UNIT_S: Final = 0.01
"""Delay in seconds at which the delay unknown is 1."""

_DELAY_UNKNOWN_LIMIT: Final = 1.0
"""Largest magnitude of the delay unknown, in units of `_DELAY_UNIT_S`."""

_MODE_SHAPE_UPDATE_COUNT: Final = 4
"""Number of times that the mode shapes of a loaded or tilted beam are recomputed for the fitted
beam."""

_RESIDUAL_WITHOUT_POLE: Final = 1e6
"""Whitened residual of every constant if a mode has no pole."""

_COST_TOLERANCE: Final = 1e-4
"""Relative tolerance of chi-square at which a descent ends."""

_MAX_EVALUATIONS: Final = 80
"""Largest number of evaluations of chi-square in one descent."""

INTEGRAL_TOLERANCE_RATIO: Final = 3
"""Relative tolerance of residues, and of damping ratios if the beam is not uniform, over that of
the frequencies. They are integrals over a mode's shape, which vary more than its frequency."""

_MAX_CURVATURE_OF_IDLE_UNKNOWN: Final = 1e-4
"""Second derivative of chi-square by an unknown below which the unknown has no effect."""


class UniformBeamProblem:
    """Least-squares fit of a uniform beam's parameters to the measured modal constants.

    Unknowns are the contribution of internal damping to the stiffness at the highest visible mode
    (``ln zeta omega^alpha``) and that of external damping to the inertia at the lowest
    (``ln gamma omega^lambda / (rho/EI omega²)``), which depend little on the orders; alpha and
    lambda; the logarithms of rho/EI and EI; and the delay.

    Parameters
    ----------
    modal_estimate : ModalEstimate
        Fitted modal model with the covariance of its constants.
    mode_numbers : sequence of int
        Numbers of the visible modes.
    nominal_plant : Plant
        Rig and specimen as the file states them, with the tip mass if the file states one.
    uniformity : float
        Relative standard deviation of each frequency, in addition to the noise.
    tilt_deg : float, optional
        Angle in degrees between the beam at rest and the horizontal, as the file states it;
        positive if the tip is lower than the root.
    loss_tolerance : float
        Relative standard deviation of each damping ratio, in addition to the noise.
    """

    def __init__(
        self,
        modal_estimate: ModalEstimate,
        mode_numbers: Sequence[int],
        nominal_plant: Plant,
        uniformity: float = 0.0,
        tilt_deg: float | None = None,
        loss_tolerance: float = 0.0,
    ) -> None:
        constant_indices = modal_estimate.constant_indices(mode_numbers)
        mode_count = len(mode_numbers)
        self.modes = tuple(mode_numbers)
        self.nominal = nominal_plant
        self.uniformity = uniformity
        self.measured = modal_estimate.mode_constants[constant_indices]
        tolerance_std = np.zeros((mode_count, len(MODE_CONSTANT_NAMES)))
        tolerance_std[:, MODE_CONSTANT_NAMES.index("ln_frequency")] = uniformity
        tolerance_std[:, MODE_CONSTANT_NAMES.index("ln_damping_ratio")] = loss_tolerance
        tolerance_std[:, MODE_CONSTANT_NAMES.index("ln_residue")] = (
            INTEGRAL_TOLERANCE_RATIO * uniformity
        )
        self.covariance = modal_estimate.covariance[
            np.ix_(constant_indices, constant_indices)
        ] + np.diag(tolerance_std.ravel() ** 2)
        self.constant_count = mode_count * len(MODE_CONSTANT_NAMES)
        self._whitener = np.linalg.inv(np.linalg.cholesky(self.covariance))
        length_m = nominal_plant.beam.length_m
        eigenvalues = clamped_free_eigenvalues(max(mode_numbers))[np.array(mode_numbers) - 1]
        self.stated_alteration = BeamDeviations.from_nominal_plant(nominal_plant, tilt_deg)
        self.terms = galerkin_mode_terms(self.stated_alteration, nominal_plant.beam, self.modes)
        constants_by_mode = self.measured.reshape(-1, len(MODE_CONSTANT_NAMES))
        self._omega_rad_s = 2 * np.pi * np.exp(constants_by_mode[:, 0])
        self._damping_ratios = np.exp(constants_by_mode[:, 1])
        self._measured_poles = (self._omega_rad_s * (1j - self._damping_ratios)).tolist()
        # The search starts at the mean of all modes.
        modal_masses = self.terms.mass + self.terms.point_mass
        self._ln_density_over_stiffness = float(
            np.mean(
                np.log((eigenvalues / length_m) ** 4 / modal_masses) - 2 * np.log(self._omega_rad_s)
            )
        )
        ln_stiffness = constants_by_mode[:, 2] - np.log(self._omega_rad_s) + np.log(length_m / 2)
        self._ln_stiffness = float(np.mean(ln_stiffness))
        smallest_ln_loss, largest_ln_loss = _LN_LOSS_RANGE
        self.lower = np.array(
            [
                smallest_ln_loss,
                ORDER_RANGE[0],
                smallest_ln_loss,
                ORDER_RANGE[0],
                self._ln_density_over_stiffness - _LN_BEAM_HALF_RANGE,
                self._ln_stiffness - _LN_BEAM_HALF_RANGE,
                -_DELAY_UNKNOWN_LIMIT,
            ]
        )
        self.upper = np.array(
            [
                largest_ln_loss,
                ORDER_RANGE[1],
                largest_ln_loss,
                ORDER_RANGE[1],
                self._ln_density_over_stiffness + _LN_BEAM_HALF_RANGE,
                self._ln_stiffness + _LN_BEAM_HALF_RANGE,
                _DELAY_UNKNOWN_LIMIT,
            ]
        )
        # Linear map from the unknowns to `PARAMETERS`, with those in `LOGARITHMIC_PARAMETERS` as
        # logarithms.
        ln_first_omega, ln_last_omega = (
            math.log(self._omega_rad_s[0]),
            math.log(self._omega_rad_s[-1]),
        )
        self.transform = np.eye(len(PARAMETERS))
        self.transform[0, 1] = -ln_last_omega
        self.transform[2, 3] = -ln_first_omega
        self.transform[2, 4] = 1.0
        self.transform[6, 6] = _DELAY_UNIT_S
        self._offset = np.zeros(len(PARAMETERS))
        self._offset[2] = 2 * ln_first_omega

    @cached_property
    def plain_terms(self) -> ModeTerms:
        """Return the Galerkin coefficients of the uniform beam alone."""
        return galerkin_mode_terms(BeamDeviations(), self.nominal.beam, self.modes)

    def parameters(self, vector_of_unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert unknowns, shape (..., 7), to the values of `PARAMETERS`.

        Those in `LOGARITHMIC_PARAMETERS` are returned as natural logarithms.
        """
        return vector_of_unknowns @ self.transform.T + self._offset

    def plant(self, vector_of_unknowns: NDArray[np.float64]) -> Plant:
        """Return the rig with the uniform beam and damping for a vector of unknowns, shape (7,)."""
        ln_zeta, alpha, ln_gamma, lambda_, ln_ratio, ln_stiffness, delay_s = self.parameters(
            vector_of_unknowns
        ).tolist()
        stiffness_n_m2 = math.exp(ln_stiffness)
        return replace(
            self.nominal,
            beam=Beam(
                length_m=self.nominal.beam.length_m,
                density_kg_per_m=math.exp(ln_ratio) * stiffness_n_m2,
                bending_stiffness_n_m2=stiffness_n_m2,
            ),
            damping=Damping(
                zeta=math.exp(ln_zeta), alpha=alpha, gamma=math.exp(ln_gamma), lambda_=lambda_
            ),
            delay_s=delay_s,
        )

    def constants(self, vector_of_unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Predict the modal constants of a uniform beam with n modes, shape (4 n,).

        The four constants of a mode are `MODE_CONSTANT_NAMES`. A mode without pole gives NaN.

        Parameters
        ----------
        vector_of_unknowns : ndarray of float, shape (7,)
            Vector of unknowns.
        """
        return self._vibration(vector_of_unknowns, self.terms).constants()

    def _vibration(
        self, vector_of_unknowns: NDArray[np.float64], mode_terms: ModeTerms
    ) -> BeamVibration:
        """Return poles and residues of the beam with the given Galerkin coefficients."""
        return BeamVibration(
            self.parameters(vector_of_unknowns).tolist(),
            mode_terms,
            self.nominal.beam.length_m,
            self.nominal.filter_denominators + mode_terms.deviations.torque_lag_denominators,
            self._measured_poles,
        )

    def residual_and_slopes(
        self,
        vector_of_unknowns: NDArray[np.float64],
        whitener: NDArray[np.float64],
        mode_terms: ModeTerms | None = None,
    ) -> tuple[NDArray[np.float64], Callable[[], NDArray[np.float64]]]:
        """Return predicted minus measured modal constants, whitened, and a function for slopes.

        Differences of phases are between -pi and pi. If a mode has no pole, the residual is large
        and constant.

        Parameters
        ----------
        vector_of_unknowns : ndarray of float, shape (7,)
            Vector of unknowns.
        whitener : ndarray of float, shape (4 n, 4 n)
            Matrix by which the differences are multiplied.
        mode_terms : ModeTerms, optional
            Galerkin coefficients of another beam than the one the file states.

        Returns
        -------
        residual : ndarray of float, shape (4 n,)
            Whitened differences.
        slopes : callable
            Function that returns the derivatives of the residual by the unknowns, shape (7, 4 n).
        """
        vibration = self._vibration(
            vector_of_unknowns, self.terms if mode_terms is None else mode_terms
        )
        differences = vibration.constants() - self.measured
        if np.isnan(differences).any():
            return (
                np.full(self.constant_count, _RESIDUAL_WITHOUT_POLE),
                lambda: np.zeros((vector_of_unknowns.size, self.constant_count)),
            )
        phase_differences = differences[
            MODE_CONSTANT_NAMES.index("residue_phase_rad") :: len(MODE_CONSTANT_NAMES)
        ]
        phase_differences -= 2 * np.pi * np.round(phase_differences / (2 * np.pi))
        return (
            whitener @ differences,
            lambda: (whitener @ vibration.constant_slopes() @ self.transform).T,
        )

    def equations(self, vector_of_unknowns: NDArray[np.float64]) -> NormalEquations:
        """Return chi-square at one vector of unknowns with its gradient and Gauss-Newton matrix."""
        residual, slopes = self.residual_and_slopes(vector_of_unknowns, self._whitener)
        jacobian = slopes()
        return NormalEquations(
            float(residual @ residual), jacobian @ residual, jacobian @ jacobian.T
        )

    def starts(self) -> list[NDArray[np.float64]]:
        """Return the start vectors of the descents, one for each pair of orders in `_START_ORDERS`.

        The losses of each are those that best fit the measured damping ratios.
        """
        omega_rad_s, first_rad_s, last_rad_s = (
            self._omega_rad_s,
            self._omega_rad_s[0],
            self._omega_rad_s[-1],
        )
        start_vectors = []
        for alpha, lambda_ in itertools.product(_START_ORDERS, repeat=2):
            internal_shape = (omega_rad_s / last_rad_s) ** alpha * math.sin(alpha * math.pi / 2)
            external_shape = (omega_rad_s / first_rad_s) ** lambda_ * math.sin(
                lambda_ * math.pi / 2
            )
            external_shape *= (first_rad_s / omega_rad_s) ** 2
            damping_columns = (
                np.array([internal_shape, external_shape]).T / (2 * self._damping_ratios)[:, None]
            )
            loss_fractions, *_ = np.linalg.lstsq(
                damping_columns, np.ones(omega_rad_s.size), rcond=None
            )
            largest_mode_losses = np.min(
                2 * self._damping_ratios / np.array([internal_shape, external_shape]), axis=1
            )
            ln_losses = np.log(
                np.clip(loss_fractions, 0.02 * largest_mode_losses, largest_mode_losses)
            )
            scaled_delay = self.nominal.delay_s / _DELAY_UNIT_S
            start_vectors.append(
                np.array(
                    [
                        ln_losses[0],
                        alpha,
                        ln_losses[1],
                        lambda_,
                        self._ln_density_over_stiffness,
                        self._ln_stiffness,
                        scaled_delay,
                    ]
                )
            )
        return start_vectors

    def minimize(self, vector_of_unknowns: NDArray[np.float64]) -> Minimum:
        """Minimize chi-square from one start vector, with all unknowns free."""
        return _minimize_within_bounds(self.equations, vector_of_unknowns, self.lower, self.upper)

    def minima(self) -> list[Minimum]:
        """Minimize chi-square from all start vectors. Return the minima, the lowest first."""
        minima = self._minimize_from(self.starts())
        for _ in range(
            _MODE_SHAPE_UPDATE_COUNT if self.stated_alteration != BeamDeviations() else 0
        ):
            self.terms = galerkin_mode_terms(
                self.stated_alteration, self.plant(minima[0].x).beam, self.modes
            )
            minima = self._minimize_from([minimum.x for minimum in minima])
        return minima

    def _minimize_from(self, start_vectors: Sequence[NDArray[np.float64]]) -> list[Minimum]:
        """Minimize chi-square from each start vector. Return the minima, the lowest first."""
        return sorted(
            (self.minimize(vector_of_unknowns) for vector_of_unknowns in start_vectors),
            key=lambda minimum: minimum.cost,
        )

    def minimize_without_damping(
        self, coefficient_index: int, vector_of_unknowns: NDArray[np.float64]
    ) -> Minimum:
        """Minimize chi-square with the loss of one damping fixed at its lower bound.

        This is a fit without internal or without external damping.

        Parameters
        ----------
        coefficient_index : int
            Index of the damping's coefficient in `PARAMETERS`.
        vector_of_unknowns : ndarray of float, shape (7,)
            Vector of unknowns at which the descent starts.
        """
        upper_bounds = self.upper.copy()
        upper_bounds[coefficient_index] = self.lower[coefficient_index]
        return _minimize_within_bounds(self.equations, vector_of_unknowns, self.lower, upper_bounds)

    def minimize_with_fixed(
        self, parameter_index: int, fixed_value: float, vector_of_unknowns: NDArray[np.float64]
    ) -> Minimum:
        """Minimize chi-square with one of `PARAMETERS` fixed, and return the minimum.

        Parameters
        ----------
        parameter_index : int
            Index of the fixed parameter in `PARAMETERS`.
        fixed_value : float
            Fixed value, as `parameters` returns it.
        vector_of_unknowns : ndarray of float, shape (7,)
            Vector of unknowns at which the descent starts.
        """
        # The parameter replaces the unknown that contributes to it with factor 1.
        to_transformed = np.eye(vector_of_unknowns.size)
        to_transformed[parameter_index] = (
            self.transform[parameter_index] / self.transform[parameter_index, parameter_index]
        )
        from_transformed = np.linalg.inv(to_transformed)
        lower_bounds, upper_bounds = self.lower.copy(), self.upper.copy()
        lower_bounds[parameter_index] = upper_bounds[parameter_index] = (
            fixed_value - self._offset[parameter_index]
        ) / self.transform[parameter_index, parameter_index]

        def equations(transformed_unknowns: NDArray[np.float64]) -> NormalEquations:
            """Return chi-square and its derivatives by the transformed unknowns."""
            original_equations = self.equations(from_transformed @ transformed_unknowns)
            return NormalEquations(
                original_equations.cost,
                from_transformed.T @ original_equations.gradient,
                from_transformed.T @ original_equations.hessian @ from_transformed,
            )

        constrained_minimum = _minimize_within_bounds(
            equations, to_transformed @ vector_of_unknowns, lower_bounds, upper_bounds
        )
        return replace(constrained_minimum, x=from_transformed @ constrained_minimum.x)

    def count_idle_unknowns(self, minimum: Minimum) -> int:
        """Count the unknowns that are at a bound or do not affect chi-square at a minimum.

        The order of a vanishing damping is one of them.

        Parameters
        ----------
        minimum : Minimum
            Minimum of chi-square.
        """
        chi_square_curvature = np.diag(minimum.equations.hessian)
        is_at_bound = minimum.equations.is_held_at_bound(minimum.x, self.lower, self.upper)
        return int(
            np.count_nonzero(is_at_bound | (chi_square_curvature < _MAX_CURVATURE_OF_IDLE_UNKNOWN))
        )


def _minimize_within_bounds(
    equations: Callable[[NDArray[np.float64]], NormalEquations],
    vector_of_unknowns: NDArray[np.float64],
    lower_bounds: NDArray[np.float64],
    upper_bounds: NDArray[np.float64],
) -> Minimum:
    """Minimize a sum of squares within bounds by Gauss-Newton descent."""
    return descend(
        equations,
        vector_of_unknowns,
        ConstantBounds(lower_bounds, upper_bounds),
        relative_tolerance=_COST_TOLERANCE,
        max_evaluations=_MAX_EVALUATIONS,
    )
