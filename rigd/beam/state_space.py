"""The beam as a state space: what a realisation is, apart from how it is found."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]


@dataclass(frozen=True, slots=True, eq=False)
class Realisation:
    """State space ``x' = a x + b θ''``, ``Γ = c x + D θ'' + V θ' + K θ`` for G = Γ/θ.

    `a` is block diagonal: 2 × 2 blocks for the complex pairs, then the real poles.
    """

    a: Real
    """(n, n) in 1/s."""
    b: Real
    """(n,), dimensionless."""
    c: Real
    """(n,) in N·m."""
    direct_inertia_kg_m2: float
    direct_viscosity_nm_s_per_rad: float
    direct_stiffness_nm_per_rad: float
    relative_error: float
    """Largest ``|realised - exact| / |exact|`` between 0.05 and 100 Hz."""
    poles_rad_s: Complex
    """(m,): of a conjugate pair the one in the upper half plane, then the real ones."""

    def transfer(self, s: ArrayLike) -> Complex:
        """G(s) as realised, in N·m/rad, of the shape of `s` (rad/s)."""
        points = np.asarray(s, dtype=np.complex128)
        columns = basis(points.ravel(), self.poles_rad_s)
        direct = (
            self.direct_inertia_kg_m2,
            self.direct_viscosity_nm_s_per_rad,
            self.direct_stiffness_nm_per_rad,
        )
        g: Complex = columns @ np.concatenate([self.c, direct])
        return g.reshape(points.shape)


def basis(s: Complex, poles: Complex) -> Complex:
    """Columns whose combination with ``c, D, V, K`` is G: shape (len(s), n + 3)."""
    upper, real = poles[poles.imag > 0], poles[poles.imag == 0].real
    s2 = (s * s)[:, None]
    columns = np.empty((s.size, 2 * upper.size + real.size + 3), dtype=np.complex128)
    shifted = s[:, None] - upper.real
    determinant = shifted * shifted + upper.imag**2
    columns[:, 0 : 2 * upper.size : 2] = s2 * shifted / determinant
    columns[:, 1 : 2 * upper.size : 2] = -s2 * upper.imag / determinant
    columns[:, 2 * upper.size : -3] = s2 / (s[:, None] - real)
    columns[:, -3] = s2[:, 0]
    columns[:, -2] = s
    columns[:, -1] = 1
    return columns
