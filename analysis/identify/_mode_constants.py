"""Modal constants of a uniform or altered beam, and their derivatives by its parameters.

The pole of a mode is the root of its dynamic stiffness D(s) (`analysis.identify._altered_beam`).
The residue of the torque is ``j L³ EI F² / D'(s)``, with the modal force F per rotation of the
motor.

Each mode is computed with Python numbers: arrays of so few numbers would take five times as long.
"""

from __future__ import annotations

import cmath
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._modal_model import MODE_CONSTANT_NAMES

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from analysis.identify._altered_beam import ModeTerms

_MAX_NEWTON_ITERATIONS: Final = 6
"""Largest number of Newton iterations for a pole."""

_MAX_LAST_NEWTON_STEP: Final = 1e-7
"""Relative step at which the Newton iterations end. The remaining error is about its square."""

_NAN_CONSTANTS: Final = (math.nan,) * len(MODE_CONSTANT_NAMES)
"""Constants of a mode without pole."""


class BeamVibration:
    """Poles and residues of n modes of a beam.

    `parameters` are the values of `analysis.identify.uniform_beam.PARAMETERS`, those in
    `LOGARITHMIC_PARAMETERS` as logarithms, and `mode_terms` the Galerkin coefficients of the modes.
    `lag_denominators` are the lags of the torque channel as in
    `rigd.beam.Plant.filter_denominators`, and `start_poles_rad_s` approximate poles.
    """

    __slots__ = ("_modes",)

    def __init__(
        self,
        parameters: Sequence[float],
        mode_terms: ModeTerms,
        length_m: float,
        lag_denominators: Sequence[tuple[float, float]],
        start_poles_rad_s: Sequence[complex],
    ) -> None:
        self._modes: list[_Mode | None] = []
        for coefficients, near in zip(
            mode_terms.coefficients_by_mode(), start_poles_rad_s, strict=True
        ):
            try:
                mode = _Mode(parameters, mode_terms, coefficients, length_m, lag_denominators, near)
            except (ArithmeticError, ValueError):  # the iterations end at no pole
                mode = None
            self._modes.append(mode)

    def constants(self) -> NDArray[np.float64]:
        """Return `MODE_CONSTANT_NAMES` of all modes, shape (4 n,); NaN for a mode without pole."""
        return np.array(
            [mode.constants if mode else _NAN_CONSTANTS for mode in self._modes]
        ).ravel()

    def constant_slopes(self) -> NDArray[np.float64]:
        """Return the derivatives of the constants by the parameters, shape (4 n, 7).

        Every mode must have a pole.
        """
        return np.array([row for mode in self._modes if mode for row in mode.constant_slopes()])


class _Mode:
    """Pole of one mode, and the quantities at the pole that determine its residue.

    The parameters are those of `BeamVibration`, with the `mode_coefficients` of one mode.
    """

    def __init__(
        self,
        parameters: Sequence[float],
        mode_terms: ModeTerms,
        mode_coefficients: Sequence[complex],
        length_m: float,
        lag_denominators: Sequence[tuple[float, float]],
        start_pole_rad_s: complex,
    ) -> None:
        ln_zeta, alpha, ln_gamma, lambda_, ln_ratio, ln_stiffness, self._delay_s = parameters
        self._ln_coefficients, self._orders = (ln_zeta, ln_gamma), (alpha, lambda_)
        (
            self._stiffness, clamp, mass, point_mass, tension, mass_arm, point_mass_arm,
            self._external_damping_arm, tension_arm,
            arm_change_per_external_damping, arm_change_per_internal_damping,
        ) = mode_coefficients  # fmt: skip
        self._relaxation, self._lags = (
            mode_terms.deviations.relaxation_strength_and_time,
            lag_denominators,
        )
        self._ratio = math.exp(ln_ratio)
        self._point_mass: complex = 0.0  # mass that does not change with the density
        self._point_mass_arm: complex = 0.0
        if mode_terms.density_kg_per_m is not None:
            point_mass_factor = mode_terms.density_kg_per_m * math.exp(-ln_ratio - ln_stiffness)
            self._point_mass, self._point_mass_arm = point_mass, point_mass_arm = (
                point_mass_factor * point_mass,
                point_mass_factor * point_mass_arm,
            )
        self._mass = mass + point_mass
        self._tension, self._tension_arm = self._ratio * tension, self._ratio * tension_arm
        self._static_stiffness = self._stiffness + clamp + self._tension
        self._pole = s = self._find_pole(start_pole_rad_s)
        _, self._slope, self._dampings, self._inertia = self._stiffness_at(s)
        # Damping turns the mode shape, and with it the arm of the mass.
        self._arms = (
            self._inertia * arm_change_per_internal_damping / self._stiffness,
            self._inertia * arm_change_per_external_damping + self._external_damping_arm,
        )
        self._force = (
            self._inertia * (mass_arm + point_mass_arm)
            + self._dampings[0] * self._arms[0]
            + self._dampings[1] * self._arms[1]
            + self._tension_arm
        )
        channel_response = cmath.exp(-self._delay_s * s)
        for first, second in lag_denominators:
            channel_response /= 1 + s * (first + s * second)
        ln_residue = cmath.log(1j * length_m**3 * self._force**2 / self._slope * channel_response)
        self.constants = (
            math.log(s.imag / (2 * math.pi)),
            math.log(-s.real / abs(s)),
            ln_residue.real + ln_stiffness,
            ln_residue.imag,
        )

    def _find_pole(self, s: complex) -> complex:
        """Return the root of the dynamic stiffness near `s`; raise ArithmeticError without one."""
        for _ in range(_MAX_NEWTON_ITERATIONS):
            stiffness, slope, *_ = self._stiffness_at(s)
            newton_step = stiffness / slope
            s -= newton_step
            if abs(newton_step) < _MAX_LAST_NEWTON_STEP * abs(s):
                break
        if not s.real < 0 < s.imag:
            raise ArithmeticError("The mode has no pole.")
        return s

    def _stiffness_at(
        self, s: complex
    ) -> tuple[complex, complex, tuple[complex, complex], complex]:
        """Return the dynamic stiffness D, its derivative by s, and terms of D.

        The terms are those of internal and external damping, as a pair, and ``rho/EI s²``.
        """
        log_s, (alpha, lambda_) = cmath.log(s), self._orders
        internal_damping_term = (
            cmath.exp(self._ln_coefficients[0] + alpha * log_s) * self._stiffness
        )
        external_damping_term = cmath.exp(self._ln_coefficients[1] + lambda_ * log_s)
        inertia_factor = self._ratio * s * s
        mass_term = inertia_factor * self._mass
        dynamic_stiffness = (
            self._static_stiffness + internal_damping_term + external_damping_term + mass_term
        )
        stiffness_slope = (
            alpha * internal_damping_term + lambda_ * external_damping_term + 2 * mass_term
        ) / s
        strength, time_s = self._relaxation
        if strength:
            relaxation_term = strength * time_s / (1 + time_s * s) * self._stiffness
            dynamic_stiffness += relaxation_term * s
            stiffness_slope += relaxation_term / (1 + time_s * s)
        return (
            dynamic_stiffness,
            stiffness_slope,
            (internal_damping_term, external_damping_term),
            inertia_factor,
        )

    def constant_slopes(self) -> Iterator[list[float]]:
        """Yield, for each of the four constants, its derivatives by the seven parameters."""
        s, dstiffness, force, inertia = self._pole, self._slope, self._force, self._inertia
        log_s, mass = cmath.log(s), inertia * self._mass
        # Derivatives of dynamic stiffness, its slope and the force by the parameters at constant s
        derivatives_by_parameters: list[tuple[complex, complex, complex]] = []
        slope_by_s, force_by_s = 2 * mass, 2 * (force - self._tension_arm)
        for damping, order, arm in zip(self._dampings, self._orders, self._arms, strict=True):
            slope = order * damping / s
            derivatives_by_parameters += [
                (damping, slope, damping * arm),
                (damping * log_s, damping / s + slope * log_s, damping * arm * log_s),
            ]
            slope_by_s += (order - 1) * order * damping
            force_by_s += order * damping * arm
        external_damping_force = self._dampings[1] * self._external_damping_arm
        force_by_s -= 2 * external_damping_force
        point_mass_term, point_mass_force = (
            inertia * self._point_mass,
            inertia * self._point_mass_arm,
        )
        derivatives_by_parameters += [
            (
                mass - point_mass_term + self._tension,
                2 * (mass - point_mass_term) / s,
                force - external_damping_force - point_mass_force,
            ),
            (-point_mass_term, -2 * point_mass_term / s, -point_mass_force),
            (0.0, 0.0, 0.0),
        ]
        # Derivative of ln residue by s
        strength, time_s = self._relaxation
        relaxation_curvature = 2 * strength * time_s**2 / (1 + time_s * s) ** 3 * self._stiffness
        residue_by_s = (
            2 * force_by_s / (s * force)
            - (slope_by_s / (s * s) - relaxation_curvature) / dstiffness
            - self._delay_s
        )
        for first, second in self._lags:
            residue_by_s -= (first + 2 * second * s) / (1 + s * (first + s * second))
        pole_derivatives = [-stiffness / dstiffness for stiffness, *_ in derivatives_by_parameters]
        ln_residue_derivatives = [
            2 * force_change / force - slope / dstiffness + pole_derivative * residue_by_s
            for (_, slope, force_change), pole_derivative in zip(
                derivatives_by_parameters, pole_derivatives, strict=True
            )
        ]
        ln_residue_derivatives[5] += 1
        ln_residue_derivatives[6] -= s
        yield [pole_derivative.imag / s.imag for pole_derivative in pole_derivatives]
        yield [
            pole_derivative.real / s.real - (pole_derivative / s).real
            for pole_derivative in pole_derivatives
        ]
        yield [ln_residue_derivative.real for ln_residue_derivative in ln_residue_derivatives]
        yield [ln_residue_derivative.imag for ln_residue_derivative in ln_residue_derivatives]
