"""Drag of still air on a thin beam: where it acts, and how the modes feel it.

Each length of a round beam of diameter d that moves across the air at the speed v is held back by
the quasi-steady force per metre ``-rho_air/2 C_D d |v| v`` (Morison's drag term). The
beam enters by the product `C_D d` (in m) only; for a constant coefficient it is one number.

The force is evaluated at the points of a Gauss-Legendre rule along the beam, whose weights turn it
into what each mode and the root feel of it.

References
----------
F. M. White, Viscous Fluid Flow, 3rd ed. (2006), section 3-9: ``C_D = 1 + 10 Re^(-2/3)`` of a
cylinder across the stream.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rigd.beam._model import Beam
from rigd.beam._modes import clamped_free_eigenvalues, mode_shape

Real = NDArray[np.float64]

AIR_DENSITY_KG_PER_M3 = 1.2
"""Dry air at 20 °C and 1013 hPa has 1.204. A laboratory at another temperature or height differs by
a few per cent, by which C_D d would be off."""


@dataclass(frozen=True, slots=True, eq=False)
class DragGrid:
    """Points along the beam, and the modes that carry the force from there to the root."""

    x_m: Real
    """Distance from the motor's axis, shape (g,)."""
    weight_m: Real
    """Length of beam that each point stands for, shape (g,)."""
    shapes: Real
    """Modes at the points, shape (n, g), each of mean square 1 over the beam."""
    leverage_m: Real
    """``b_i = ∫ x phi_i dx / L`` of each mode, shape (n,)."""

    @classmethod
    def of(cls, beam: Beam, modes: int, points: int) -> "DragGrid":
        """Return the grid of a beam.

        Parameters
        ----------
        beam
        modes
            Number of modes that are followed.
        points
            Number of points of the Gauss-Legendre rule. The force is smooth but for kinks where the
            speed changes its sign along the beam.
        """
        node, weight = np.polynomial.legendre.leggauss(points)
        x = 0.5 * (node + 1)
        numbers = np.arange(1, modes + 1)
        z = clamped_free_eigenvalues(modes)
        return cls(
            x_m=beam.length_m * x,
            weight_m=0.5 * beam.length_m * weight,
            shapes=np.array([mode_shape(int(number), x) for number in numbers]),
            leverage_m=2 * beam.length_m * (-1.0) ** (numbers - 1) / z**2,
        )

    @property
    def to_modes(self) -> Real:
        """From force per metre at the points to that of each mode, shape (n, g), dimensionless."""
        length_m = self.weight_m.sum()
        shares: Real = self.shapes * self.weight_m / length_m
        return shares

    @property
    def to_moment(self) -> Real:
        """From force per metre at the points to its moment about the axis, shape (g,), in m²."""
        moment: Real = self.x_m * self.weight_m
        return moment
