"""Drag of still air on a thin beam: the force along the beam, and its effect on the modes.

Each length of a round beam of diameter d that moves across the air at the speed v is held back by
the quasi-steady force per metre ``-rho_air/2 C_D d |v| v`` (Morison's drag term). The
beam enters by the product `C_D d` (in m) only; for a constant coefficient it is one number.

The force is evaluated at the points of a Gauss-Legendre rule along the beam, whose weights convert
it into the forces on each mode and the root.

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
"""Dry air at 20 °C and 1013 hPa has 1.204. In a laboratory at another temperature or height it
differs by a few per cent, with the same relative error of C_D d."""


@dataclass(frozen=True, slots=True, eq=False)
class DragGrid:
    """Points along the beam, and the modes that transmit the force to the root."""

    x_m: Real
    """Distance from the motor's axis, shape (g,)."""
    weight_m: Real
    """Length of beam per point, shape (g,)."""
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
            Number of modes.
        points
            Number of points of the Gauss-Legendre rule. The force is smooth except for kinks where
            the speed changes its sign along the beam.
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
        """Matrix from force per metre at the points to modal forces, (n, g), dimensionless."""
        length_m = self.weight_m.sum()
        projection: Real = self.shapes * self.weight_m / length_m
        return projection

    @property
    def to_moment(self) -> Real:
        """Row from force per metre at the points to its moment about the axis, (g,), in m²."""
        moment: Real = self.x_m * self.weight_m
        return moment
