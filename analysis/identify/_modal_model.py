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
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.identify._result import ModeEstimate

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

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
        """Return the transfer function G in N·m/rad, of the shape of `s`.

        Parameters
        ----------
        s : ndarray of complex
            Laplace variable in rad/s.
        """
        total: NDArray[np.complex128] = np.polynomial.polynomial.polyval(
            s, np.array(self.background, dtype=np.complex128)
        )
        for pole, residue in zip(self.poles_rad_s, self.residues, strict=True):
            total = total + residue / (s - pole)
            total += residue.conjugate() / (s - pole.conjugate())
        return total

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
        """Return poles, residues and background as a dictionary for `json.dumps`."""
        return {
            "poles_rad_s": [[pole.real, pole.imag] for pole in self.poles_rad_s],
            "residues": [[residue.real, residue.imag] for residue in self.residues],
            "background": list(self.background),
        }

    @classmethod
    def of_constants(
        cls, constants: NDArray[np.float64], background: Sequence[float]
    ) -> ModalModel:
        """Return the modal model with given constants.

        Parameters
        ----------
        constants : ndarray, shape (4 n,)
            `MODE_CONSTANT_NAMES` of each mode in turn, by rising frequency.
        background : sequence of float
            Coefficients b0 to b4 of the background.
        """
        rows = constants.reshape(-1, len(MODE_CONSTANT_NAMES)).tolist()
        poles, residues = [], []
        for ln_frequency, ln_ratio, ln_residue, phase_rad in rows:
            ratio = math.exp(ln_ratio)
            damped_rad_s = 2 * math.pi * math.exp(ln_frequency)
            poles.append(damped_rad_s * complex(-ratio / math.sqrt(1 - ratio * ratio), 1.0))
            residues.append(1j * cmath.rect(math.exp(ln_residue), phase_rad))
        return cls(tuple(poles), tuple(residues), tuple(background))

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> ModalModel:
        """Return the modal model from the content of a JSON document.

        Parameters
        ----------
        content : mapping
            Result of `as_json`.
        """
        return cls(
            tuple(complex(*pair) for pair in content["poles_rad_s"]),
            tuple(complex(*pair) for pair in content["residues"]),
            tuple(float(value) for value in content["background"]),
        )


@dataclass(frozen=True, slots=True)
class ModalEstimate:
    """Modal model with the covariance of its constants, of one record or of several together.

    Attributes
    ----------
    model : ModalModel
        Poles, residues and background.
    numbers : tuple of int
        Number of each mode of the model among those of the beam, from 1; 0 for a resonance that
        does not belong to the beam.
    constants : ndarray, shape (4 n,)
        `MODE_CONSTANT_NAMES` of each mode in turn; the phase is that of the residue divided by j.
    joint_covariance : ndarray, shape (4 n + 5, 4 n + 5)
        Covariance of the constants and the coefficients of the background.
    """

    model: ModalModel
    numbers: tuple[int, ...]
    constants: NDArray[np.float64]
    joint_covariance: NDArray[np.float64]

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Return the covariance of the constants of all modes, shape (4 n, 4 n)."""
        return self.joint_covariance[: self.constants.size, : self.constants.size]

    @property
    def visible(self) -> tuple[int, ...]:
        """Return the numbers of the beam modes that are visible in the data, in ascending order."""
        return tuple(sorted(number for number in self.numbers if number))

    def rows(self, numbers: Sequence[int]) -> NDArray[np.intp]:
        """Return the indices of the constants of some modes in `constants`, shape (4 m,).

        Parameters
        ----------
        numbers : sequence of int
            Numbers of m modes.
        """
        mode_indices = np.arange(len(MODE_CONSTANT_NAMES))
        indices = [
            mode_indices + mode_indices.size * self.numbers.index(number) for number in numbers
        ]
        return np.concatenate(indices) if indices else np.zeros(0, dtype=np.intp)

    def mode(self, number: int) -> ModeEstimate:
        """Return frequency and damping ratio of a mode, with their standard deviations.

        Parameters
        ----------
        number : int
            Number of the mode.
        """
        rows = self.rows([number])[:2]
        frequency_hz, ratio = np.exp(self.constants[rows]).tolist()
        relative_frequency_std, relative_ratio_std = np.sqrt(
            np.diag(self.covariance)[rows]
        ).tolist()
        return ModeEstimate(
            number,
            frequency_hz,
            frequency_hz * relative_frequency_std,
            ratio,
            ratio * relative_ratio_std,
        )

    def inertia(self, number: int) -> tuple[float, float]:
        """Return the effective inertia of a mode in kg·m², and its relative standard deviation.

        Parameters
        ----------
        number : int
            Number of the mode.
        """
        rows = self.rows([number])
        # The logarithm of the inertia is ln_residue - 3 ln_frequency, plus a constant.
        weights = np.zeros(len(MODE_CONSTANT_NAMES))
        weights[MODE_CONSTANT_NAMES.index("ln_frequency")] = -3.0
        weights[MODE_CONSTANT_NAMES.index("ln_residue")] = 1.0
        relative_std = math.sqrt(float(weights @ self.covariance[np.ix_(rows, rows)] @ weights))
        return self.model.effective_inertias_kg_m2[self.numbers.index(number)], relative_std

    def restrict_to_visible_modes(self) -> ModalEstimate:
        """Return the modal model restricted to the visible modes, with the same background."""
        rows, indices = self.rows(self.visible), [self.numbers.index(n) for n in self.visible]
        joint_rows = np.concatenate(
            [rows, self.constants.size + np.arange(BACKGROUND_COEFFICIENTS)]
        )
        return ModalEstimate(
            ModalModel(
                tuple(self.model.poles_rad_s[index] for index in indices),
                tuple(self.model.residues[index] for index in indices),
                self.model.background,
            ),
            self.visible,
            self.constants[rows],
            self.joint_covariance[np.ix_(joint_rows, joint_rows)],
        )

    def as_json(self) -> dict[str, Any]:
        """Return model, mode numbers and covariance as a dictionary for `json.dumps`."""
        names = [
            f"{name}_{k}" for k in range(1, len(self.numbers) + 1) for name in MODE_CONSTANT_NAMES
        ]
        names += [f"background_{power}" for power in range(BACKGROUND_COEFFICIENTS)]
        return {
            **self.model.as_json(),
            "modes": list(self.numbers),
            "constants": self.constants.tolist(),
            "names": names,
            "covariance": self.joint_covariance.tolist(),
        }
