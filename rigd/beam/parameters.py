"""The beam and its damping: the constants of Eq. 25, with units."""

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Ge, Gt, Le, Lt


@dataclass(frozen=True, slots=True)
class Beam:
    """Uniform slender beam, clamped on the motor's shaft and free at its tip."""

    length_m: Annotated[float, Gt(0)]
    density_kg_per_m: Annotated[float, Gt(0)]
    """Mass per unit of length, rho."""
    bending_stiffness_n_m2: Annotated[float, Gt(0)]
    """E I."""

    @property
    def density_over_stiffness(self) -> float:
        """``rho / (E I)`` in s²/m⁴: what the natural frequencies depend on."""
        return self.density_kg_per_m / self.bending_stiffness_n_m2

    @property
    def inertia_kg_m2(self) -> float:
        """Inertia of the rigid beam about the motor's axis, ``rho L³ / 3``."""
        return self.density_kg_per_m * self.length_m**3 / 3


@dataclass(frozen=True, slots=True)
class Damping:
    """Fractional damping: internal ``zeta s^alpha`` and external ``gamma s^lambda``.

    The internal part multiplies the stiffness by ``1 + zeta s^alpha`` (``zeta = c_d / E``, in
    s^alpha); the external part adds ``c_v s^lambda`` to ``rho s²``, with ``gamma = c_v / (E I)`` in
    s^lambda/m⁴. The defaults are the undamped beam.

    Notes
    -----
    Orders lie in (0, 2). Zero is let through because the paper's Table 2 writes it, with a zero
    coefficient, for a damping that is absent.
    """

    zeta: Annotated[float, Ge(0), Le(1)] = 0.0
    alpha: Annotated[float, Ge(0), Lt(2)] = 1.0
    gamma: Annotated[float, Ge(0)] = 0.0
    lambda_: Annotated[float, Ge(0), Lt(2)] = 1.0
