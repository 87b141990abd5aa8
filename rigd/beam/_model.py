"""Parameters of the beam, and its exact transfer function from motor angle to coupling torque.

With ``c = 1 + zeta s^alpha`` and ``q = (beta L)^4 = -L^4 (rho/EI s² + gamma s^lambda) / c``, the
transfer function (Eq. 25 of the paper) reads ``G = -(EI/L) c F(q)`` where, for ``z = q^(1/4)``::

    F = z (sin z cosh z - cos z sinh z) / (1 + cos z cosh z)

F is a function of q alone (it is even in z), so no branch of the fourth root matters. As written it
cancels at low frequency and overflows at high frequency; two other forms are used instead:

* ``|q| < 40``: ``F = q N(q) / D(q)`` with N and D entire, ten terms of their power series;
* beyond: numerator and denominator divided by ``exp(z - j sg z) / 4``, ``sg = sign(Im z)``, which
  leaves only decaying exponentials.

Derivatives with respect to the parameters are computed along with G.

The in-line formula of the paper for ``beta^4`` seems to multiply the external damping by ``rho/EI``
too; the equation printed before it, the definition of gamma and Table 4 contradict that.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import factorial
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le, Lt
from numpy.typing import ArrayLike, NDArray

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class Beam:
    """Uniform slender beam, clamped on the motor's shaft and free at its tip.

    Examples
    --------
    >>> from rigd.beam import Beam
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> print(f"{beam.inertia_kg_m2:.3e} kg·m²")
    1.475e-03 kg·m²
    """

    length_m: Annotated[float, Gt(0)]
    """Length of the beam from the motor's axis to the tip."""
    density_kg_per_m: Annotated[float, Gt(0)]
    """Mass of the beam per unit of length, rho."""
    bending_stiffness_n_m2: Annotated[float, Gt(0)]
    """Bending stiffness of the beam, E I."""

    @property
    def density_over_stiffness(self) -> float:
        """Ratio ``rho / (E I)`` in s²/m⁴, which determines the beam's natural frequencies."""
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
    Orders lie in (0, 2). Zero is allowed because the paper's Table 2 uses it, with a zero
    coefficient, for an absent damping.
    """

    zeta: Annotated[float, Ge(0), Le(1)] = 0.0
    """Coefficient of the internal damping, in s^alpha."""
    alpha: Annotated[float, Ge(0), Lt(2)] = 1.0
    """Fractional order of the internal damping."""
    gamma: Annotated[float, Ge(0)] = 0.0
    """Coefficient of the external damping, in s^lambda/m⁴."""
    lambda_: Annotated[float, Ge(0), Lt(2)] = 1.0
    """Fractional order of the external damping."""

    def internal_loss_factor(self, omega_rad_s: float) -> float:
        """Return the loss factor of the internal damping at an angular frequency in rad/s."""
        return float(self.zeta * omega_rad_s**self.alpha * np.sin(self.alpha * np.pi / 2))


# Transfer function

GRADIENT_NAMES = ("zeta", "alpha", "gamma", "lambda", "ln_density_over_stiffness", "ln_stiffness")
"""Names of the parameters by which the transfer function G can be differentiated.

Each derivative holds the other five parameters constant."""

_FREQUENCIES_PER_BLOCK = 2048
"""Number of frequencies evaluated at once.

Temporaries that fit into the cache and below malloc's trimming threshold make 8000 points twice as
fast."""

_MAX_SERIES_ARGUMENT = 40.0
"""Magnitude of q below which F is computed from its power series."""
_SERIES_COEFFICIENTS = np.array(
    [
        [4.0 * (-4.0) ** k / factorial(4 * k + 3) for k in range(10)],
        [(-4.0) ** k / factorial(4 * k) + (k == 0) for k in range(10)],
    ]
)
"""Power series coefficients of the numerator N(q) and the denominator D(q), lowest power first."""
_SERIES_AND_SLOPE_COEFFICIENTS = np.concatenate(
    [
        _SERIES_COEFFICIENTS,
        np.pad(_SERIES_COEFFICIENTS[:, 1:] * np.arange(1.0, 10.0), ((0, 0), (0, 1))),
    ]
)
"""Power series coefficients of N(q) and D(q), then of dN/dq and dD/dq, lowest power first."""


class TransferGrid:
    """Evaluates the beam's transfer function (Eq. 25) on a fixed grid of s.

    Quantities that do not depend on the beam and its damping are computed once.

    Parameters
    ----------
    s
        Laplace variable in rad/s, any shape. Powers are principal values (cut along the negative
        real axis). Zero is allowed: an order above 0 gives ``0^order = 0``, so that G(0) = 0.
    """

    __slots__ = ("_grid_slices", "_is_zero", "_log_magnitude", "_log_s", "_s_squared", "shape")

    def __init__(self, s: ArrayLike) -> None:
        s_points = np.asarray(s, dtype=np.complex128)
        self.shape = s_points.shape
        s_points = s_points.ravel()
        self._is_zero = s_points == 0
        nonzero_s = np.where(self._is_zero, 1.0, s_points)
        self._s_squared = s_points * s_points
        self._log_s = np.log(nonzero_s)
        # On the imaginary axis, where fits live, s^order is a real power times one constant phase.
        is_on_imaginary_axis = bool(np.all((nonzero_s.real == 0) & (nonzero_s.imag > 0)))
        self._log_magnitude = np.log(nonzero_s.imag) if is_on_imaginary_axis else None
        self._grid_slices = [
            slice(i, i + _FREQUENCIES_PER_BLOCK)
            for i in range(0, s_points.size, _FREQUENCIES_PER_BLOCK)
        ]

    def evaluate(self, beam: Beam, damping: Damping) -> ComplexArray:
        """Return the coupling torque per motor angle in N·m/rad at all s of the grid.

        Parameters
        ----------
        beam, damping
            Parameters of the exact model.
        """
        g = np.empty(self._s_squared.size, dtype=np.complex128)
        for grid_slice in self._grid_slices:
            c = 1 + damping.zeta * self._power_of_s(damping.alpha, grid_slice)
            s_lambda = self._power_of_s(damping.lambda_, grid_slice)
            f = _dimensionless_response(
                self._fourth_power_of_z(beam, damping, c, s_lambda, grid_slice)
            )
            np.multiply((-beam.bending_stiffness_n_m2 / beam.length_m) * c, f, out=g[grid_slice])
        return g.reshape(self.shape)

    def evaluate_with_gradient(
        self, beam: Beam, damping: Damping, gradient_parameters: Sequence[str] = GRADIENT_NAMES[:4]
    ) -> tuple[ComplexArray, ComplexArray]:
        """Return the coupling torque per motor angle and its derivatives for given parameters.

        Parameters
        ----------
        beam, damping
            Parameters at which G is evaluated.
        gradient_parameters
            Names from `GRADIENT_NAMES`. ``ln_density_over_stiffness`` is ln(rho/EI) at constant EI,
            ``ln_stiffness`` is ln(EI) at constant rho/EI and gamma.

        Returns
        -------
        g : complex ndarray, shape of the grid
            Coupling torque per motor angle in N·m/rad.
        gradient : complex ndarray, shape ``(len(gradient_parameters), *grid shape)``
            Derivative of `g` with respect to each parameter of `gradient_parameters`.

        Raises
        ------
        ValueError
            If a name is not one of `GRADIENT_NAMES`.
        """
        unknown_names = set(gradient_parameters) - set(GRADIENT_NAMES)
        if unknown_names:
            raise ValueError(
                f"{sorted(unknown_names)} are not parameters of G: choose from {GRADIENT_NAMES}."
            )
        minus_stiffness_per_length = -beam.bending_stiffness_n_m2 / beam.length_m
        stiffness_length_cubed = beam.bending_stiffness_n_m2 * beam.length_m**3
        g = np.empty(self._s_squared.size, dtype=np.complex128)
        gradient = np.empty((len(gradient_parameters), g.size), dtype=np.complex128)
        for grid_slice in self._grid_slices:
            s_alpha = self._power_of_s(damping.alpha, grid_slice)
            s_lambda = self._power_of_s(damping.lambda_, grid_slice)
            c = 1 + damping.zeta * s_alpha
            q = self._fourth_power_of_z(beam, damping, c, s_lambda, grid_slice)
            f, f_slope, remainder = _dimensionless_response_with_slope(q)
            np.multiply(minus_stiffness_per_length * c, f, out=g[grid_slice])
            internal_term = (minus_stiffness_per_length * s_alpha) * remainder
            f_slope *= stiffness_length_cubed
            external_term = s_lambda * f_slope
            for row, parameter_name in zip(
                gradient[:, grid_slice], gradient_parameters, strict=True
            ):
                match parameter_name:
                    case "zeta":
                        row[:] = internal_term
                    case "alpha":
                        np.multiply(damping.zeta * self._log_s[grid_slice], internal_term, out=row)
                    case "gamma":
                        row[:] = external_term
                    case "lambda":
                        np.multiply(damping.gamma * self._log_s[grid_slice], external_term, out=row)
                    case "ln_density_over_stiffness":
                        inertial_term = beam.density_over_stiffness * self._s_squared[grid_slice]
                        np.multiply(inertial_term, f_slope, out=row)
                    case "ln_stiffness":
                        row[:] = g[grid_slice]
        return g.reshape(self.shape), gradient.reshape(len(gradient_parameters), *self.shape)

    def _power_of_s(self, order: float, grid_slice: slice) -> ComplexArray:
        """Return ``s^order`` at the points of s in a slice of the grid."""
        if self._log_magnitude is None:
            power = np.exp(order * self._log_s[grid_slice])
        else:
            phase = complex(np.exp(0.5j * np.pi * order))
            power = np.exp(order * self._log_magnitude[grid_slice]) * phase
        power[self._is_zero[grid_slice]] = 0.0 if order > 0 else 1.0
        return power

    def _fourth_power_of_z(
        self,
        beam: Beam,
        damping: Damping,
        c: ComplexArray,
        s_lambda: ComplexArray,
        grid_slice: slice,
    ) -> ComplexArray:
        """Return ``q = z⁴``, with z the wave number times L, in a slice of the grid."""
        inertial_term = beam.density_over_stiffness * self._s_squared[grid_slice]
        q: ComplexArray = (inertial_term + damping.gamma * s_lambda) / c
        q *= -(beam.length_m**4)
        return q


def transfer(s: ArrayLike, beam: Beam, damping: Damping) -> ComplexArray:
    """Return the transfer function from motor angle to coupling torque (Eq. 25 of the paper).

    Parameters
    ----------
    s
        Laplace variable in rad/s, of any shape.
    beam, damping
        Parameters of the exact model.

    Returns
    -------
    g : complex ndarray, shape of `s`
        Coupling torque per motor angle in N·m/rad.

    References
    ----------
    Fractional-Order Models of Damping Phenomena in a Flexible Sensing Antenna Used for Haptic Robot
    Navigation, Eq. 25.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, Damping, transfer
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> s = 2j * np.pi * np.array([1.0, 10.0])
    >>> g = transfer(s, beam, Damping(zeta=1e-4))
    >>> print(np.round(np.abs(g), 4))
    [0.0684 0.1306]
    """
    return TransferGrid(s).evaluate(beam, damping)


def transfer_and_gradient(
    s: ArrayLike,
    beam: Beam,
    damping: Damping,
    gradient_parameters: Sequence[str] = GRADIENT_NAMES[:4],
) -> tuple[ComplexArray, ComplexArray]:
    """Return the coupling torque per motor angle at `s` and its derivatives for parameters.

    Parameters
    ----------
    s
        Laplace variable in rad/s, of any shape.
    beam, damping
        Parameters of the exact model.
    gradient_parameters
        Names from `GRADIENT_NAMES`: see `TransferGrid.evaluate_with_gradient`.

    Returns
    -------
    g : complex ndarray, shape of `s`
        Coupling torque per motor angle in N·m/rad.
    gradient : complex ndarray, shape ``(len(gradient_parameters), *shape of s)``
        Derivative of `g` with respect to each parameter of `gradient_parameters`.

    Raises
    ------
    ValueError
        If a name is not one of `GRADIENT_NAMES`.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, Damping, transfer_and_gradient
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> damping = Damping(zeta=7e-5, alpha=0.9)
    >>> g, gradient = transfer_and_gradient(2j * np.pi * np.array([1.0, 2.0, 5.0]), beam, damping)
    >>> g.shape, gradient.shape
    ((3,), (4, 3))
    """
    return TransferGrid(s).evaluate_with_gradient(beam, damping, gradient_parameters)


def _evaluate_polynomials(coefficients: RealArray, x: ComplexArray) -> ComplexArray:
    """Return the values of k polynomials at n points, shape (k, n).

    `coefficients` have the shape (k, degree + 1), the lowest power first.
    """
    polynomial_sums = np.zeros((len(coefficients), x.size), dtype=np.complex128)
    for column in coefficients.T[::-1, :, None]:
        polynomial_sums *= x
        polynomial_sums += column
    return polynomial_sums


def _response_at_large_q(q: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return F(q) and ``2 z² sin z sinh z / (1 + cos z cosh z)`` at large ``q = z⁴``.

    Only decaying exponentials are used, so nothing overflows.
    """
    lower_half_plane = np.flatnonzero(q.imag < 0)
    z_squared = _first_quadrant_square_root(q.real, np.abs(q.imag))
    z = _first_quadrant_square_root(z_squared.real, z_squared.imag)
    decay = np.exp(-z)
    rotation = np.exp(1j * z)
    e = decay * rotation
    a = np.multiply(decay, decay, out=decay)
    b = np.multiply(rotation, rotation, out=rotation)
    sum_, ab = a + b, a * b
    even_part = 1 + ab
    f = (1j - 1) * (1 - ab) + (1j + 1) * (a - b)
    f *= z
    reciprocal = np.reciprocal(4 * e + (even_part + sum_))
    f *= reciprocal
    s = (even_part - sum_) * 2j
    s *= z_squared
    s *= reciprocal
    # F and S are real functions of q: the values for Im q >= 0 give the other half.
    f[lower_half_plane] = f[lower_half_plane].conj()
    s[lower_half_plane] = s[lower_half_plane].conj()
    return f, s


def _first_quadrant_square_root(real: RealArray, imag: RealArray) -> ComplexArray:
    """Return the square root of ``real + 1j imag`` for ``imag >= 0``.

    It is as accurate as numpy's and three times as fast.
    """
    complex_root = np.empty(real.shape, dtype=np.complex128)
    complex_root.real, complex_root.imag = real, imag
    larger_part = np.sqrt(0.5 * (np.abs(complex_root) + np.abs(real)))
    smaller_part = 0.5 * imag / larger_part
    positive_real = real >= 0
    complex_root.real = np.where(positive_real, larger_part, smaller_part)
    complex_root.imag = np.where(positive_real, smaller_part, larger_part)
    return complex_root


def _dimensionless_response(q: ComplexArray) -> ComplexArray:
    """Return the beam's dimensionless response function F(q) at ``q = z⁴``."""
    f = np.empty_like(q)
    is_small = np.abs(q) < _MAX_SERIES_ARGUMENT
    if is_small.any():
        small_q = q[is_small]
        n, d = _evaluate_polynomials(_SERIES_COEFFICIENTS, small_q)
        f[is_small] = small_q * n / d
    is_large = ~is_small
    f[is_large] = _response_at_large_q(q[is_large])[0]
    return f


def _dimensionless_response_with_slope(
    q: ComplexArray,
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return the beam's response function F(q), dF/dq and ``F - q dF/dq``, without cancellation."""
    f, f_slope, remainder = np.empty((3, q.size), dtype=np.complex128)
    is_small = np.abs(q) < _MAX_SERIES_ARGUMENT
    if is_small.any():
        small_q = q[is_small]
        n, d, n_slope, d_slope = _evaluate_polynomials(_SERIES_AND_SLOPE_COEFFICIENTS, small_q)
        wronskian = n * d_slope - n_slope * d
        d_squared = d * d
        f[is_small] = small_q * n / d
        f_slope[is_small] = (n * d - small_q * wronskian) / d_squared
        remainder[is_small] = small_q * small_q * wronskian / d_squared
    is_large = ~is_small
    large_q = q[is_large]
    f_high, s_high = _response_at_large_q(large_q)
    q_times_slope = 0.25 * (f_high * (1 + f_high) + s_high)
    f[is_large] = f_high
    f_slope[is_large] = q_times_slope / large_q
    remainder[is_large] = f_high - q_times_slope
    return f, f_slope, remainder
