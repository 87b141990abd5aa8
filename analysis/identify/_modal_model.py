"""Modal model: poles and complex residues of the visible modes, and a smooth background.

It describes the coupling torque as a function of the angle for any linear time-invariant antenna on
any mount::

    G(s) = sum_k ( R_k / (s - p_k) + R_k* / (s - p_k*) ) + b0 + b1 s + b2 s² + b3 s³ + b4 s⁴

The residues are complex, since external damping, a lossy clamp, a delay and the sensor's lag all
change their phase. The background represents the modes beyond the band, the tool's inertia and the
delay. The model assumes neither a law of the damping nor a uniform beam.

References
----------
D. J. Ewins, Modal Testing: Theory, Practice and Application, 2nd ed. (2000), ch. 2: pole-residue
form with complex modal constants.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.identify._estimates import ModeEstimate
from rigd.beam import Beam, Damping, clamped_free_eigenvalues, participation

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from rigd.beam import Plant

BACKGROUND_COEFFICIENTS: Final = 5
"""Number of coefficients of the background polynomial, b0 to b4."""

MODE_CONSTANT_NAMES: Final = ("ln_frequency", "ln_damping_ratio", "ln_residue", "residue_phase_rad")
"""Names of the four real constants of a mode, in the order of the covariance of a fit."""


@dataclass(frozen=True, slots=True)
class ModalModel:
    """Transfer function from motor angle to coupling torque, by poles and residues.

    Attributes
    ----------
    poles_rad_s : tuple of complex
        Upper pole of each conjugate pair, by rising frequency.
    residues : tuple of complex
        Residue at each of these poles, in N·m/s.
    background : tuple of float
        Coefficients b0 to b4 of the background polynomial, in N·m s^n/rad.
    """

    poles_rad_s: tuple[complex, ...]
    residues: tuple[complex, ...]
    background: tuple[float, ...]

    def response(self, s: NDArray[np.complexfloating[Any, Any]]) -> NDArray[np.complex128]:
        """Return the transfer function from motor angle to torque in N·m/rad, of the shape of `s`.

        Parameters
        ----------
        s : ndarray of complex
            Laplace variable in rad/s.
        """
        total_response: NDArray[np.complex128] = np.polynomial.polynomial.polyval(
            s, np.array(self.background, dtype=np.complex128)
        )
        for pole, residue in zip(self.poles_rad_s, self.residues, strict=True):
            total_response = total_response + residue / (s - pole)
            total_response += residue.conjugate() / (s - pole.conjugate())
        return total_response

    @property
    def frequencies_hz(self) -> tuple[float, ...]:
        """Return the damped natural frequencies of the modes, in Hz."""
        return tuple(pole.imag / (2 * math.pi) for pole in self.poles_rad_s)

    @property
    def damping_ratios(self) -> tuple[float, ...]:
        """Return the damping ratios of the modes (fractions of the critical damping)."""
        return tuple(-pole.real / abs(pole) for pole in self.poles_rad_s)

    @property
    def effective_inertias_kg_m2(self) -> tuple[float, ...]:
        """Return the effective inertia of each mode about the motor axis.

        The inertias of all modes of an undamped beam add up to its moment of inertia.
        """
        return tuple(
            2 * abs(residue) / abs(pole) ** 3
            for pole, residue in zip(self.poles_rad_s, self.residues, strict=True)
        )

    def as_json(self) -> dict[str, Any]:
        """Return poles, residues and background of the model as a dictionary for `json.dumps`."""
        return {
            "poles_rad_s": [[pole.real, pole.imag] for pole in self.poles_rad_s],
            "residues": [[residue.real, residue.imag] for residue in self.residues],
            "background": list(self.background),
        }

    @classmethod
    def from_constants(
        cls, constants: NDArray[np.float64], background: Sequence[float]
    ) -> ModalModel:
        """Return the modal model with given mode constants and background coefficients.

        Parameters
        ----------
        constants : ndarray, shape (4 n,)
            `MODE_CONSTANT_NAMES` of each mode in turn, by rising frequency.
        background : sequence of float
            Coefficients b0 to b4 of the background.
        """
        mode_constants = constants.reshape(-1, len(MODE_CONSTANT_NAMES)).tolist()
        poles, residues = [], []
        for ln_frequency, ln_damping_ratio, ln_residue, phase_rad in mode_constants:
            damping_ratio = math.exp(ln_damping_ratio)
            damped_frequency_rad_s = 2 * math.pi * math.exp(ln_frequency)
            poles.append(
                damped_frequency_rad_s
                * complex(-damping_ratio / math.sqrt(1 - damping_ratio * damping_ratio), 1.0)
            )
            residues.append(1j * cmath.rect(math.exp(ln_residue), phase_rad))
        return cls(tuple(poles), tuple(residues), tuple(background))

    @classmethod
    def from_json(cls, json_content: Mapping[str, Any]) -> ModalModel:
        """Return the modal model that `as_json` wrote to a JSON document.

        Parameters
        ----------
        json_content : mapping
            Result of `as_json`.
        """
        return cls(
            tuple(complex(*number_pair) for number_pair in json_content["poles_rad_s"]),
            tuple(complex(*number_pair) for number_pair in json_content["residues"]),
            tuple(float(coefficient) for coefficient in json_content["background"]),
        )


@dataclass(frozen=True, slots=True)
class ModalEstimate:
    """Modal model with the covariance of its constants, of one record or of several together.

    Attributes
    ----------
    model : ModalModel
        Poles, residues and background.
    mode_numbers : tuple of int
        Number of each mode of the model among those of the beam, from 1; 0 for a resonance that
        does not belong to the beam.
    mode_constants : ndarray, shape (4 n,)
        `MODE_CONSTANT_NAMES` of each mode in turn; the phase is that of the residue divided by j.
    joint_covariance : ndarray, shape (4 n + 5, 4 n + 5)
        Covariance of the constants and the coefficients of the background.
    """

    model: ModalModel
    mode_numbers: tuple[int, ...]
    mode_constants: NDArray[np.float64]
    joint_covariance: NDArray[np.float64]

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Return the covariance of the constants of all modes, shape (4 n, 4 n)."""
        return self.joint_covariance[: self.mode_constants.size, : self.mode_constants.size]

    @property
    def visible_mode_numbers(self) -> tuple[int, ...]:
        """Return the numbers of the beam modes that are visible in the data, in ascending order."""
        return tuple(sorted(number for number in self.mode_numbers if number))

    @property
    def poles_rad_s(self) -> dict[int, complex]:
        """Return the upper pole of each mode of the beam in rad/s, by mode number."""
        return {
            number: pole
            for number, pole in zip(self.mode_numbers, self.model.poles_rad_s, strict=True)
            if number
        }

    def residue(self, mode_number: int) -> complex:
        """Return the residue at the upper pole of a mode, in N·m/s."""
        return self.model.residues[self.mode_numbers.index(mode_number)]

    def constant_indices(self, mode_numbers: Sequence[int]) -> NDArray[np.intp]:
        """Return the indices of the constants of some modes in `mode_constants`, shape (4 m,).

        Parameters
        ----------
        mode_numbers : sequence of int
            Numbers of m modes.
        """
        offsets_in_mode = np.arange(len(MODE_CONSTANT_NAMES))
        constant_indices = [
            offsets_in_mode + offsets_in_mode.size * self.mode_numbers.index(mode_number)
            for mode_number in mode_numbers
        ]
        return np.concatenate(constant_indices) if constant_indices else np.zeros(0, dtype=np.intp)

    def mode(self, mode_number: int) -> ModeEstimate:
        """Return frequency (Hz) and damping ratio of a mode, with their standard deviations.

        Parameters
        ----------
        mode_number : int
            Number of the mode.
        """
        constant_indices = self.constant_indices([mode_number])[:2]
        frequency_hz, damping_ratio = np.exp(self.mode_constants[constant_indices]).tolist()
        relative_frequency_std, relative_ratio_std = np.sqrt(
            np.diag(self.covariance)[constant_indices]
        ).tolist()
        return ModeEstimate(
            mode_number,
            frequency_hz,
            frequency_hz * relative_frequency_std,
            damping_ratio,
            damping_ratio * relative_ratio_std,
        )

    def effective_inertia(self, mode_number: int) -> tuple[float, float]:
        """Return the effective inertia of a mode in kg·m², and its relative standard deviation.

        Parameters
        ----------
        mode_number : int
            Number of the mode.
        """
        constant_indices = self.constant_indices([mode_number])
        # The logarithm of the inertia is ln_residue - 3 ln_frequency, plus a constant.
        ln_inertia_weights = np.zeros(len(MODE_CONSTANT_NAMES))
        ln_inertia_weights[MODE_CONSTANT_NAMES.index("ln_frequency")] = -3.0
        ln_inertia_weights[MODE_CONSTANT_NAMES.index("ln_residue")] = 1.0
        relative_std = math.sqrt(
            float(
                ln_inertia_weights
                @ self.covariance[np.ix_(constant_indices, constant_indices)]
                @ ln_inertia_weights
            )
        )
        return self.model.effective_inertias_kg_m2[
            self.mode_numbers.index(mode_number)
        ], relative_std

    def uniform_plant(self, nominal_plant: Plant) -> Plant:
        """Return a rig whose uniform beam has the inertias and frequencies of the modes on average.

        The highest mode determines the damping. Return `nominal_plant` if no mode is visible.

        Parameters
        ----------
        nominal_plant : Plant
            Rig and specimen as the file states them.
        """
        mode_numbers, length_m = self.visible_mode_numbers, nominal_plant.beam.length_m
        if not mode_numbers:
            return nominal_plant
        inertia_per_density = participation(nominal_plant.beam, mode_numbers[-1])
        eigenvalues = clamped_free_eigenvalues(mode_numbers[-1])
        ln_density, ln_stiffness = np.mean(
            [
                (
                    ln_density := math.log(
                        self.effective_inertia(n)[0] / inertia_per_density[n - 1]
                    ),
                    ln_density
                    + 2 * math.log(abs(self.poles_rad_s[n]))
                    - 4 * math.log(eigenvalues[n - 1] / length_m),
                )
                for n in mode_numbers
            ],
            axis=0,
        ).tolist()
        highest_pole = self.poles_rad_s[mode_numbers[-1]]
        return replace(
            nominal_plant,
            beam=Beam(length_m, math.exp(ln_density), math.exp(ln_stiffness)),
            damping=Damping(zeta=-2 * highest_pole.real / abs(highest_pole) ** 2),
        )

    def restrict_to_visible_modes(self) -> ModalEstimate:
        """Return the modal model restricted to the visible modes, with the same background."""
        constant_indices, mode_indices = (
            self.constant_indices(self.visible_mode_numbers),
            [self.mode_numbers.index(n) for n in self.visible_mode_numbers],
        )
        joint_indices = np.concatenate(
            [constant_indices, self.mode_constants.size + np.arange(BACKGROUND_COEFFICIENTS)]
        )
        return ModalEstimate(
            ModalModel(
                tuple(self.model.poles_rad_s[mode_index] for mode_index in mode_indices),
                tuple(self.model.residues[mode_index] for mode_index in mode_indices),
                self.model.background,
            ),
            self.visible_mode_numbers,
            self.mode_constants[constant_indices],
            self.joint_covariance[np.ix_(joint_indices, joint_indices)],
        )

    def as_json(self) -> dict[str, Any]:
        """Return model, mode numbers and covariance as a dictionary for `json.dumps`."""
        constant_names = [
            f"{constant_name}_{k}"
            for k in range(1, len(self.mode_numbers) + 1)
            for constant_name in MODE_CONSTANT_NAMES
        ]
        constant_names += [
            f"background_{background_power}" for background_power in range(BACKGROUND_COEFFICIENTS)
        ]
        return {
            **self.model.as_json(),
            "modes": list(self.mode_numbers),
            "constants": self.mode_constants.tolist(),
            "names": constant_names,
            "covariance": self.joint_covariance.tolist(),
        }
