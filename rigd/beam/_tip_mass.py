"""Transfer function of the beam with a tip mass, an elastic clamp, or modal stiffness offsets.

With ``p = rho/EI s² + gamma s^lambda``, ``c = 1 + zeta s^alpha``, ``q = z⁴ = -L⁴ p / c`` and the
mass ratio ``mu = m s² / (L EI p)``, the tip's condition ``EI c y''' = m s² y`` turns Eq. 25 into::

    G = -(EI/L) c (F + mu U) / (1 - mu F),    U = 2 z² sin z sinh z / (1 + cos z cosh z)

F as in `rigd.beam._model`. With a clamp that turns by kappa per torque on the
beam's root, the transfer function is ``G / (1 + kappa G)``.

F and U are functions of q alone; ``q d/dq`` of them needs one more, ``B = z (cos z sinh z +
sin z cosh z) / (1 + cos z cosh z)``::

    q F' = (F + U + F²) / 4,    q U' = U/2 + z² B/2 + U F/4

In a beam that is not quite uniform the stiffness k⁴ of a mode differs from the uniform beam's by
the relative offset d. The following term then replaces mode i of the sum G (`rigd.beam._modes`),
with its participation a²::

    G_i = a² EI p² c k⁴ d / ((c k⁴ (1 + d) + p) (c k⁴ + p))
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rigd.beam._model import Beam, Damping
from rigd.beam._modes import (
    clamped_free_eigenvalues,
)

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_MAX_SERIES_ARGUMENT = 40.0
"""Magnitude of q below which power series replace the closed form, which cancels there."""
_POWERS_OF_MINUS_FOUR = (-4.0) ** np.arange(10)
_SERIES_COEFFICIENTS = np.array(
    [
        [scale * _POWERS_OF_MINUS_FOUR[k] / math.factorial(4 * k + last) for k in range(10)]
        for scale, last in ((1.0, 0), (4.0, 3), (4.0, 2), (2.0, 1))
    ]
).T
_SERIES_COEFFICIENTS[0, 0] += 1.0
"""Coefficients of power series in q, shape (powers, 4).

The first column is ``1 + cos z cosh z``, the others are the numerators of F, U and z² B over q."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadedResponse:
    """Coupling torque per motor angle of the beam with a tip mass, and its derivatives.

    All arrays have the shape of s. Each derivative holds the other two of c, p and the tip mass
    constant, and the bending stiffness and length as well.
    """

    response: ComplexArray
    """Coupling torque per motor angle in N·m/rad."""
    slope_by_elastic_factor: ComplexArray
    """Derivative of the response with respect to the elastic factor c."""
    slope_by_inertial_factor: ComplexArray
    """Derivative of the response with respect to the inertial factor p."""
    slope_by_mass: ComplexArray
    """Derivative of the response with respect to the tip mass, in N·m/(rad kg)."""


def loaded_response(
    s_squared: ComplexArray,
    elastic_factor: ComplexArray,
    inertial_factor: ComplexArray,
    beam: Beam,
    tip_mass_kg: float,
) -> LoadedResponse:
    """Return the coupling torque per angle of a rigidly clamped beam with a tip mass.

    `s_squared` is the square of the Laplace variable in rad²/s², not 0. The inertial factor p
    already contains the density.
    """
    stiffness_n_m2, length_m = beam.bending_stiffness_n_m2, beam.length_m
    f, u, f_slope, u_slope = _response_functions(-(length_m**4) * inertial_factor / elastic_factor)
    ratio_per_mass = s_squared / (length_m * stiffness_n_m2 * inertial_factor)
    mass_ratio = tip_mass_kg * ratio_per_mass
    inverse_factor = 1 / (1 - mass_ratio * f)
    loaded_function = (f + mass_ratio * u) * inverse_factor
    slope_by_ratio = (u + loaded_function * f) * inverse_factor
    loaded_slope = (
        f_slope + mass_ratio * u_slope + mass_ratio * loaded_function * f_slope
    ) * inverse_factor
    minus_stiffness_per_length = -stiffness_n_m2 / length_m
    return LoadedResponse(
        response=minus_stiffness_per_length * elastic_factor * loaded_function,
        slope_by_elastic_factor=minus_stiffness_per_length * (loaded_function - loaded_slope),
        slope_by_inertial_factor=minus_stiffness_per_length
        * elastic_factor
        / inertial_factor
        * (loaded_slope - mass_ratio * slope_by_ratio),
        slope_by_mass=minus_stiffness_per_length * elastic_factor * ratio_per_mass * slope_by_ratio,
    )


def add_stiffness_offsets(
    uniform_response: LoadedResponse,
    elastic_factor: ComplexArray,
    inertial_factor: ComplexArray,
    beam: Beam,
    stiffness_offsets: tuple[float, ...],
) -> LoadedResponse:
    """Return the torque per angle with the stiffness offsets of modes 2, 3, … included.

    Offsets are relative to the stiffness of the uniform beam. The factors c and p are given at the
    s of the uniform response.
    """
    length_m, stiffness_n_m2 = beam.length_m, beam.bending_stiffness_n_m2
    total_response, slope_by_elastic_factor, slope_by_inertial_factor = np.zeros(
        (3, *np.shape(elastic_factor)), dtype=np.complex128
    )
    z = clamped_free_eigenvalues(1 + len(stiffness_offsets))[1:]
    for k4, offset in zip((z / length_m) ** 4, stiffness_offsets, strict=True):
        # a² EI k⁴, with the participation a² = 4 L³ / z⁴
        mode_weight, relative_mode_stiffness = 4 * stiffness_n_m2 / length_m, 1 + offset
        uniform_mode_response = 1 / (elastic_factor * k4 + inertial_factor)
        offset_mode_response = 1 / (elastic_factor * k4 * relative_mode_stiffness + inertial_factor)
        total_response += (
            mode_weight
            * inertial_factor**2
            * elastic_factor
            * offset
            * uniform_mode_response
            * offset_mode_response
        )
        slope_by_elastic_factor += (
            mode_weight
            * inertial_factor**2
            * (relative_mode_stiffness * offset_mode_response**2 - uniform_mode_response**2)
        )
        slope_by_inertial_factor += (
            mode_weight
            * elastic_factor**2
            * k4
            * ((relative_mode_stiffness * offset_mode_response) ** 2 - uniform_mode_response**2)
        )
    return replace(
        uniform_response,
        response=uniform_response.response + total_response,
        slope_by_elastic_factor=uniform_response.slope_by_elastic_factor + slope_by_elastic_factor,
        slope_by_inertial_factor=uniform_response.slope_by_inertial_factor
        + slope_by_inertial_factor,
    )


DerivativeFunctions = dict[str, Callable[[], ComplexArray]]
"""Map from a parameter's name to a function that computes the derivative of the response."""


def differentiated_response(
    log_s: ComplexArray,
    s_squared: ComplexArray,
    beam: Beam,
    damping: Damping,
    tip_mass_kg: float,
    stiffness_offsets: tuple[float, ...] = (),
) -> tuple[LoadedResponse, DerivativeFunctions]:
    """Return the torque per angle of a rigidly clamped beam with a tip mass, and its derivatives.

    The Laplace variable is not 0. The derivatives are functions by the names of
    `rigd.beam.GRADIENT_NAMES` and ``tip_mass_kg``; there is none for the stiffness offsets, which
    are as in `rigd.beam.Plant`.
    """
    s_alpha = np.exp(damping.alpha * log_s).astype(np.complex128)
    s_lambda = np.exp(damping.lambda_ * log_s).astype(np.complex128)
    inertial_term = beam.density_over_stiffness * s_squared
    elastic_factor, inertial_factor = (
        1 + damping.zeta * s_alpha,
        inertial_term + damping.gamma * s_lambda,
    )
    response = loaded_response(s_squared, elastic_factor, inertial_factor, beam, tip_mass_kg)
    if stiffness_offsets:
        response = add_stiffness_offsets(
            response, elastic_factor, inertial_factor, beam, stiffness_offsets
        )
    return response, {
        "zeta": lambda: response.slope_by_elastic_factor * s_alpha,
        "alpha": lambda: response.slope_by_elastic_factor * (damping.zeta * log_s * s_alpha),
        "gamma": lambda: response.slope_by_inertial_factor * s_lambda,
        "lambda": lambda: response.slope_by_inertial_factor * (damping.gamma * log_s * s_lambda),
        "ln_density_over_stiffness": lambda: response.slope_by_inertial_factor * inertial_term,
        "ln_stiffness": lambda: response.response - tip_mass_kg * response.slope_by_mass,
        "tip_mass_kg": lambda: response.slope_by_mass,
    }


def uniform_tip_response(
    beam: Beam, damping: Damping, s: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return the tip's displacement in m/rad and its slope per motor angle, in the shape of `s`.

    `s` is the Laplace variable in rad/s, not 0.
    """
    external_term = damping.gamma * s**damping.lambda_
    internal_factor = 1 + damping.zeta * s**damping.alpha
    wave_number_fourth = -(beam.density_over_stiffness * s * s + external_term) / internal_factor
    z = beam.length_m * np.sqrt(np.sqrt(wave_number_fourth))
    # Numerators and denominator over exp(z - j sign z): nothing overflows.
    imaginary_sign = np.where(z.imag < 0, -1.0, 1.0)
    rotation, decay = np.exp(1j * imaginary_sign * z), np.exp(-z)
    a, b = decay * decay, rotation * rotation
    reciprocal = 1 / (4 * rotation * decay + (1 + b) * (1 + a))
    sines = 2 * rotation * (1 - a) + 2j * imaginary_sign * decay * (1 - b)
    cosines = 2 * rotation * (1 + a) + 2 * decay * (1 + b)
    displacement: ComplexArray = beam.length_m * sines * reciprocal / z
    tip_slope: ComplexArray = cosines * reciprocal
    return displacement, tip_slope


def _response_functions(
    q: ComplexArray,
) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
    """Return the loaded beam's dimensionless functions F and U at `q`, and q F' and q U'."""
    q = np.asarray(q, dtype=np.complex128)
    f, u, b = np.empty((3, *q.shape), dtype=np.complex128)
    is_small = np.abs(q) < _MAX_SERIES_ARGUMENT
    if is_small.any():
        small_q = q[is_small]
        series_divisor, *series_numerators = np.polynomial.polynomial.polyval(
            small_q, _SERIES_COEFFICIENTS
        )
        for out, series_numerator in zip((f, u, b), series_numerators, strict=True):
            out[is_small] = small_q * series_numerator / series_divisor
    if not is_small.all():
        for out, function_values in zip(
            (f, u, b), _functions_at_large_q(q[~is_small]), strict=True
        ):
            out[~is_small] = function_values
    return f, u, 0.25 * (f + u + f * f), 0.5 * (u + b) + 0.25 * u * f


def _functions_at_large_q(q: ComplexArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return F, U and z² B at large `q`, computed from decaying exponentials only."""
    # F, U and B are real functions of q: values below the real axis mirror those above it.
    lower_half_plane = q.imag < 0
    z = np.sqrt(np.sqrt(np.where(lower_half_plane, q.conj(), q)))
    decay, rotation = np.exp(-z), np.exp(1j * z)
    a, b = decay * decay, rotation * rotation
    reciprocal = 1 / (4 * decay * rotation + (1 + a) * (1 + b))
    sine, cosine = 1j * (1 - b) * (1 + a), (1 + b) * (1 - a)
    upper_half_values = (
        z * (sine - cosine) * reciprocal,
        2j * z**2 * (1 - a) * (1 - b) * reciprocal,
        z**3 * (sine + cosine) * reciprocal,
    )
    scaled_f, scaled_u, scaled_b = (
        np.where(lower_half_plane, function_values.conj(), function_values)
        for function_values in upper_half_values
    )
    return scaled_f, scaled_u, scaled_b
