"""Drag of still air on a thin beam: the force along the beam, and its effect on the modes.

Each length of a round beam of diameter d that moves across the air at the speed v is held back by
the quasi-steady force per metre ``-rho_air/2 C_D d |v| v`` (Morison's drag term). The only property
of the beam in it is the product `C_D d` (in m), which is one number if C_D is constant.

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

RealArray = NDArray[np.float64]

AIR_DENSITY_KG_PER_M3 = 1.2
"""Density of air that the drag coefficients refer to.

Dry air at 20 °C and 1013 hPa has 1.204. In a laboratory at another temperature or height it differs
by a few per cent, with the same relative error of C_D d."""


@dataclass(frozen=True, slots=True, eq=False)
class DragGrid:
    """Quadrature points along the beam for the air's drag, with the mode shapes at the points."""

    x_m: RealArray
    """Distance of each point from the motor's axis, shape (g,)."""
    quadrature_weight_m: RealArray
    """Quadrature weight of each point, a length of beam, shape (g,)."""
    mode_shapes: RealArray
    """Mode shapes at the points, shape (n, g), each of mean square 1 over the beam."""
    shape_moment_m: RealArray
    """First moment ``b_i = ∫ x phi_i dx / L`` of each mode shape phi_i, shape (n,)."""

    @classmethod
    def along_beam(cls, beam: Beam, mode_count: int, point_count: int) -> "DragGrid":
        """Return a grid of Gauss-Legendre points along a beam.

        Parameters
        ----------
        beam
            Beam; only its length is used.
        mode_count
            Number of modes whose shapes are evaluated.
        point_count
            Number of points of the Gauss-Legendre rule. The force is smooth except for kinks where
            the speed changes its sign along the beam.
        """
        nodes, point_weights = np.polynomial.legendre.leggauss(point_count)
        x_over_length = 0.5 * (nodes + 1)
        mode_numbers = np.arange(1, mode_count + 1)
        z = clamped_free_eigenvalues(mode_count)
        return cls(
            x_m=beam.length_m * x_over_length,
            quadrature_weight_m=0.5 * beam.length_m * point_weights,
            mode_shapes=np.array(
                [mode_shape(int(mode_number), x_over_length) for mode_number in mode_numbers]
            ),
            shape_moment_m=2 * beam.length_m * (-1.0) ** (mode_numbers - 1) / z**2,
        )

    @property
    def modal_force_matrix(self) -> RealArray:
        """Matrix that converts force per metre at the points into modal forces, shape (n, g)."""
        length_m = self.quadrature_weight_m.sum()
        modal_projection: RealArray = self.mode_shapes * self.quadrature_weight_m / length_m
        return modal_projection

    @property
    def moment_weights_m2(self) -> RealArray:
        """Weights in m², shape (g,), that turn the force per metre at the points into a moment.

        The moment is about the motor's axis.
        """
        moment_weights_m2: RealArray = self.x_m * self.quadrature_weight_m
        return moment_weights_m2
