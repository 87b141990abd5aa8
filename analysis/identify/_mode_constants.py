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

_LAST_NEWTON_STEP: Final = 1e-7
"""Relative step at which the Newton iterations end. The remaining error is about its square."""

_NO_CONSTANTS: Final = (math.nan,) * len(MODE_CONSTANT_NAMES)
"""Constants of a mode without pole."""


class BeamVibration:
    """Poles and residues of n modes of a beam.

    `parameters` are the values of `analysis.identify.uniform_beam.PARAMETERS`, those in
    `LOGARITHMIC_PARAMETERS` as logarithms, and `terms` the Galerkin coefficients of the modes.
    `lags` are the lags of the torque channel as in `rigd.beam.Plant.filter_denominators`, and
    `expected_roots_rad_s` approximate poles.
    """

    __slots__ = ("_modes",)

    def __init__(
        self,
        parameters: Sequence[float],
        terms: ModeTerms,
        length_m: float,
        lags: Sequence[tuple[float, float]],
        expected_roots_rad_s: Sequence[complex],
    ) -> None:
        self._modes: list[_Mode | None] = []
        for coefficients, near in zip(
            terms.coefficients_by_mode(), expected_roots_rad_s, strict=True
        ):
            try:
                mode = _Mode(parameters, terms, coefficients, length_m, lags, near)
            except (ArithmeticError, ValueError):  # the iterations end at no pole
                mode = None
            self._modes.append(mode)

    def constants(self) -> NDArray[np.float64]:
        """Return `MODE_CONSTANT_NAMES` of all modes, shape (4 n,); NaN for a mode without pole."""
        return np.array([mode.constants if mode else _NO_CONSTANTS for mode in self._modes]).ravel()

    def slopes(self) -> NDArray[np.float64]:
        """Return the derivatives of the constants by the parameters, shape (4 n, 7).

        Every mode must have a pole.
        """
        return np.array([row for mode in self._modes if mode for row in mode.slopes()])


class _Mode:
    """Pole of one mode, and the quantities at the pole that determine its residue.

    The parameters are those of `BeamVibration`, with the `coefficients` of one mode.
    """

    def __init__(
        self,
        parameters: Sequence[float],
        terms: ModeTerms,
        coefficients: Sequence[complex],
        length_m: float,
        lags: Sequence[tuple[float, float]],
        expected_roots_rad_s: complex,
    ) -> None:
        ln_zeta, alpha, ln_gamma, lambda_, ln_ratio, ln_stiffness, self._delay_s = parameters
        self._ln_coefficients, self._orders = (ln_zeta, ln_gamma), (alpha, lambda_)
        (
            self._stiffness, clamp, mass, lump, tension, mass_arm, lump_arm,
            self._medium_arm, tension_arm, arm_change_by_external, arm_change_by_internal,
        ) = coefficients  # fmt: skip
        self._relaxation, self._lags = terms.deviations.relaxation_strength_and_time, lags
        self._ratio = math.exp(ln_ratio)
        self._lump: complex = 0.0  # mass that does not change with the density
        self._lump_arm: complex = 0.0
        if terms.density_kg_per_m is not None:
            lump_ratio = terms.density_kg_per_m * math.exp(-ln_ratio - ln_stiffness)
            self._lump, self._lump_arm = lump, lump_arm = lump_ratio * lump, lump_ratio * lump_arm
        self._mass = mass + lump
        self._tension, self._tension_arm = self._ratio * tension, self._ratio * tension_arm
        self._static_stiffness = self._stiffness + clamp + self._tension
        self._pole = s = self._find_pole(expected_roots_rad_s)
        _, self._slope, self._dampings, self._inertia = self._stiffness_at(s)
        # Damping turns the mode shape, and with it the arm of the mass.
        self._arms = (
            self._inertia * arm_change_by_internal / self._stiffness,
            self._inertia * arm_change_by_external + self._medium_arm,
        )
        self._force = (
            self._inertia * (mass_arm + lump_arm)
            + self._dampings[0] * self._arms[0]
            + self._dampings[1] * self._arms[1]
            + self._tension_arm
        )
        channel_response = cmath.exp(-self._delay_s * s)
        for first, second in lags:
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
            step = stiffness / slope
            s -= step
            if abs(step) < _LAST_NEWTON_STEP * abs(s):
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
        internal = cmath.exp(self._ln_coefficients[0] + alpha * log_s) * self._stiffness
        external = cmath.exp(self._ln_coefficients[1] + lambda_ * log_s)
        inertia = self._ratio * s * s
        mass = inertia * self._mass
        stiffness = self._static_stiffness + internal + external + mass
        slope = (alpha * internal + lambda_ * external + 2 * mass) / s
        strength, time_s = self._relaxation
        if strength:
            relaxation_term = strength * time_s / (1 + time_s * s) * self._stiffness
            stiffness += relaxation_term * s
            slope += relaxation_term / (1 + time_s * s)
        return stiffness, slope, (internal, external), inertia

    def slopes(self) -> Iterator[list[float]]:
        """Yield, for each of the four constants, its derivatives by the seven parameters."""
        s, dstiffness, force, inertia = self._pole, self._slope, self._force, self._inertia
        log_s, mass = cmath.log(s), inertia * self._mass
        # Derivatives of dynamic stiffness, its slope and the force by the parameters at constant s
        by_parameters: list[tuple[complex, complex, complex]] = []
        slope_by_s, force_by_s = 2 * mass, 2 * (force - self._tension_arm)
        for damping, order, arm in zip(self._dampings, self._orders, self._arms, strict=True):
            slope = order * damping / s
            by_parameters += [
                (damping, slope, damping * arm),
                (damping * log_s, damping / s + slope * log_s, damping * arm * log_s),
            ]
            slope_by_s += (order - 1) * order * damping
            force_by_s += order * damping * arm
        medium_force = self._dampings[1] * self._medium_arm
        force_by_s -= 2 * medium_force
        lump, lump_force = inertia * self._lump, inertia * self._lump_arm
        by_parameters += [
            (
                mass - lump + self._tension,
                2 * (mass - lump) / s,
                force - medium_force - lump_force,
            ),
            (-lump, -2 * lump / s, -lump_force),
            (0.0, 0.0, 0.0),
        ]
        # Derivative of ln residue by s
        strength, time_s = self._relaxation
        relaxed_slope = 2 * strength * time_s**2 / (1 + time_s * s) ** 3 * self._stiffness
        residue_by_s = (
            2 * force_by_s / (s * force)
            - (slope_by_s / (s * s) - relaxed_slope) / dstiffness
            - self._delay_s
        )
        for first, second in self._lags:
            residue_by_s -= (first + 2 * second * s) / (1 + s * (first + s * second))
        poles = [-stiffness / dstiffness for stiffness, *_ in by_parameters]
        ln_residues = [
            2 * force_change / force - slope / dstiffness + pole * residue_by_s
            for (_, slope, force_change), pole in zip(by_parameters, poles, strict=True)
        ]
        ln_residues[5] += 1
        ln_residues[6] -= s
        yield [pole.imag / s.imag for pole in poles]
        yield [pole.real / s.real - (pole / s).real for pole in poles]
        yield [ln_residue.real for ln_residue in ln_residues]
        yield [ln_residue.imag for ln_residue in ln_residues]
