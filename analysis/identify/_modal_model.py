"""Modal model: poles and complex residues of the visible modes, and a smooth background.

With angle in and coupling torque out, of any linear constant antenna on any mount::

    G(s) = sum_k ( R_k / (s - p_k) + R_k* / (s - p_k*) ) + b0 + b1 s + b2 s² + b3 s³ + b4 s⁴

Residues are complex: external damping, a lossy clamp, a delay and the sensor's lag all turn their
phase. The background stands for the modes beyond the band, the tool's inertia and the delay. No law
of the damping is assumed, nor that the beam is uniform.

References
----------
D. J. Ewins, Modal Testing: Theory, Practice and Application, 2nd ed. (2000), ch. 2: pole-residue
form with complex modal constants.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

BACKGROUND: Final = 5
"""Coefficients of the background, b0 to b4."""

CONSTANTS: Final = ("ln_frequency", "ln_damping_ratio", "ln_residue", "residue_phase_rad")
"""Real constants of a mode, in the order of the covariance of a fit."""


@dataclass(frozen=True, slots=True)
class ModalModel:
    """Transfer function from motor angle to coupling torque by poles and residues.

    Attributes
    ----------
    poles_rad_s : tuple of complex
        Upper pole of each conjugate pair, by rising frequency.
    residues : tuple of complex
        Residue at each, in N·m/s.
    background : tuple of float
        b0 to b4, in N·m s^n/rad.
    """

    poles_rad_s: tuple[complex, ...]
    residues: tuple[complex, ...]
    background: tuple[float, ...]

    def response(self, s: NDArray[np.complexfloating[Any, Any]]) -> NDArray[np.complex128]:
        """Return G in N·m/rad, of the shape of `s`.

        Parameters
        ----------
        s : ndarray of complex
            In rad/s.
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
        """Frequencies of the free decay."""
        return tuple(pole.imag / (2 * math.pi) for pole in self.poles_rad_s)

    @property
    def damping_ratios(self) -> tuple[float, ...]:
        """Fractions of the critical damping."""
        return tuple(-pole.real / abs(pole) for pole in self.poles_rad_s)

    @property
    def effective_inertias_kg_m2(self) -> tuple[float, ...]:
        """Inertia about the motor axis that takes part in each mode.

        Those of an undamped beam add up to its moment of inertia.
        """
        return tuple(
            2 * abs(residue) / abs(pole) ** 3
            for pole, residue in zip(self.poles_rad_s, self.residues, strict=True)
        )

    def as_json(self) -> dict[str, Any]:
        """As `json.dumps` takes it."""
        return {
            "poles_rad_s": [[pole.real, pole.imag] for pole in self.poles_rad_s],
            "residues": [[residue.real, residue.imag] for residue in self.residues],
            "background": list(self.background),
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> ModalModel:
        """Read what `as_json` wrote.

        Parameters
        ----------
        content : mapping
        """
        return cls(
            tuple(complex(*pair) for pair in content["poles_rad_s"]),
            tuple(complex(*pair) for pair in content["residues"]),
            tuple(float(value) for value in content["background"]),
        )
