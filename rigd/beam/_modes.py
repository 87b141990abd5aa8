"""Modes of the damped beam: clamped–free eigenvalues and shapes, complex poles, participation.

G is a sum over the modes of the undamped clamped–free beam, which fractional damping does not
couple::

    G = sum_i a_i² P Q k_i⁴ / (Q k_i⁴ + P),   P = rho s² + c_v s^lambda,  Q = EI (1 + zeta s^alpha)

with ``k_i = z_i / L``, ``1 + cos z_i cosh z_i = 0`` and ``a_i² = 4 L³ / z_i⁴``. Each mode's poles
are the zeros of ``Q k_i⁴ + P`` on the principal sheet of the powers.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.beam._model import Beam, Damping

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complexfloating]

_HOMOTOPY_STEP_COUNTS = (8, 64)
"""Numbers of steps in which damping grows from zero while poles are followed.

The larger number is used for beams for which the smaller one loses a pole."""

SAME_ROOT_TOLERANCE = 0.05
"""Largest relative distance between an expected and a found root of the same mode.

Neighbouring modes differ by much more."""

_MAX_ARGUMENT_EXCESS_RAD = 1e-9
"""Largest accepted excess of a pole's argument over pi in rad, which rounding can cause."""


@dataclass(frozen=True, slots=True)
class Mode:
    """One mode of the beam with locked hub (clamped–free)."""

    number: int
    """Mode number from 1, in the order of the clamped–free eigenvalues."""
    poles_rad_s: tuple[complex, complex]
    """The mode's conjugate pair of poles (positive frequency first), or two real poles (slow one
    first)."""
    frequency_hz: float
    """Frequency of the mode's free decay, ``|Im p| / 2 pi``, or 0 if it is over-damped."""
    natural_frequency_rad_s: float
    """Natural frequency of the mode, ``sqrt(p_1 p_2)``."""
    damping_ratio: float
    """Damping ratio of the mode, ``-(p_1 + p_2) / (2 sqrt(p_1 p_2))``; above 1 if over-damped."""


def clamped_free_eigenvalues(mode_count: int) -> RealArray:
    """Return the first positive roots z_i of ``1 + cos z cosh z = 0``, shape (mode_count,).

    References
    ----------
    L. Meirovitch, Fundamentals of Vibrations, McGraw-Hill.

    Examples
    --------
    >>> from rigd.beam import clamped_free_eigenvalues
    >>> print(clamped_free_eigenvalues(3).round(6))
    [1.875104 4.694091 7.854757]
    """
    return _cached_eigenvalues(mode_count).copy()


@cache
def _cached_eigenvalues(mode_count: int) -> RealArray:
    """Return the first clamped–free eigenvalues as a cached array that must not be changed."""
    i = np.arange(1, mode_count + 1)
    asymptotic_root = (i - 0.5) * np.pi
    sech_sign = np.where(i % 2 == 1, 1.0, -1.0)
    # With z = (i - 1/2) pi + d the equation is sin d = ±sech z: no growing term, small d.
    d = np.zeros(mode_count)
    for _ in range(8):
        decay = np.exp(-(asymptotic_root + d))
        sech = 2 * decay / (1 + decay * decay)
        tanh = (1 - decay * decay) / (1 + decay * decay)
        d -= (np.sin(d) - sech_sign * sech) / (np.cos(d) + sech_sign * sech * tanh)
    return asymptotic_root + d


def undamped_frequencies_rad_s(beam: Beam, mode_count: int) -> RealArray:
    """Return the first natural frequencies of the undamped beam in rad/s, shape (mode_count,).

    Parameters
    ----------
    beam
        Uniform beam on a locked hub.
    mode_count
        Number of modes, from the first on.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, undamped_frequencies_rad_s
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> print((undamped_frequencies_rad_s(beam, 3) / (2 * np.pi)).round(3))
    [ 2.554 16.005 44.816]
    """
    z = clamped_free_eigenvalues(mode_count)
    frequencies_rad_s: RealArray = z * z / (beam.length_m**2 * np.sqrt(beam.density_over_stiffness))
    return frequencies_rad_s


def mode_shape(mode_number: int, x_over_length: ArrayLike) -> RealArray:
    """Return a mode shape of the clamped–free beam, normalised to the mean square 1.

    Its value at the tip is 2. It is computed without growing exponentials, so high modes are as
    accurate as low ones.

    Parameters
    ----------
    mode_number
        Number of the mode, from 1.
    x_over_length
        Positions along the beam, 0 (axis) to 1 (tip), of any shape.

    References
    ----------
    L. Meirovitch, Fundamentals of Vibrations, McGraw-Hill.

    Examples
    --------
    >>> from rigd.beam import mode_shape
    >>> print(mode_shape(2, [0.25, 0.5, 1.0]).round(4))
    [-0.8345 -1.4273  2.    ]
    """
    z = float(clamped_free_eigenvalues(mode_number)[-1])
    x = z * np.asarray(x_over_length, dtype=np.float64)
    cosine, sine, decay = np.cos(z), np.sin(z), np.exp(-z)
    scaled_sinh_plus_sin = 1 - decay * decay + 2 * decay * sine  # (sinh z + sin z) 2 exp(-z)
    one_minus_sigma = 2 * decay * (sine - cosine - decay) / scaled_sinh_plus_sin
    growing_part = (np.exp(x - z) - np.exp(-x - z)) * (sine - cosine - decay) / scaled_sinh_plus_sin
    shape_sign = 1.0 if mode_number % 2 == 1 else -1.0
    mode_values: RealArray = shape_sign * (
        np.exp(-x) - np.cos(x) + (1 - one_minus_sigma) * np.sin(x) + growing_part
    )
    return mode_values


def mode_shape_mean(mode_count: int) -> RealArray:
    """Return the mean of each of the first mode shapes over the beam, shape (mode_count,).

    Parameters
    ----------
    mode_count
        Number of modes, from the first on.

    Examples
    --------
    >>> from rigd.beam import mode_shape_mean
    >>> print(mode_shape_mean(3).round(4))
    [ 0.783  -0.4339  0.2544]
    """
    shape_means: RealArray = (
        2
        * (-1.0) ** np.arange(mode_count)
        * root_shear_ratio(mode_count)
        / clamped_free_eigenvalues(mode_count)
    )
    return shape_means


def root_shear_ratio(mode_count: int) -> RealArray:
    """Return ``-phi'''(0) / (k phi''(0))`` of the first mode shapes phi, shape (mode_count,).

    It relates the shear force at the motor's axis to the bending moment there. A mode of mean
    square 1 and wave number k has the curvature ``phi''(0) = 2 k² (-1)^(i - 1)``.

    Parameters
    ----------
    mode_count
        Number of modes, from the first on.

    Examples
    --------
    >>> from rigd.beam import root_shear_ratio
    >>> print(root_shear_ratio(3).round(4))
    [0.7341 1.0185 0.9992]
    """
    z = clamped_free_eigenvalues(mode_count)
    decay = np.exp(-z)
    scaled_sinh_plus_sin = 1 - decay * decay + 2 * decay * np.sin(z)  # (sinh z + sin z) 2 exp(-z)
    shear_ratios: RealArray = (1 + decay * decay + 2 * decay * np.cos(z)) / scaled_sinh_plus_sin
    return shear_ratios


def participation(beam: Beam, mode_count: int) -> RealArray:
    """Return the participation factors of the first `mode_count` modes in m³, shape (mode_count,).

    The factor ``a_i² = 4 L³ / z_i⁴`` times rho is the mode's part of the rigid beam's moment of
    inertia: the sum of all factors is L³/3.

    Parameters
    ----------
    beam
        Beam; only its length is used.
    mode_count
        Number of modes, from the first on.

    Examples
    --------
    >>> from rigd.beam import Beam, participation
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> fraction = participation(beam, 3) / (beam.length_m**3 / 3)
    >>> print(fraction.round(4))
    [0.9707 0.0247 0.0032]
    """
    participation_factors_m3: RealArray = (
        4 * beam.length_m**3 / clamped_free_eigenvalues(mode_count) ** 4
    )
    return participation_factors_m3


def poles(beam: Beam, damping: Damping, mode_count: int) -> ComplexArray:
    """Return the poles of the first `mode_count` modes, shape (mode_count, 2), in rad/s.

    A row has a conjugate pair (positive frequency first), or two real poles (slow one first) where
    integer-order damping exceeds critical damping.

    Parameters
    ----------
    beam, damping
        Parameters of the exact model.
    mode_count
        Number of modes, from the first on.

    Raises
    ------
    ArithmeticError
        If a mode has no pole on the principal sheet: damping is very strong, with one order above 1
        and the other below.

    Examples
    --------
    >>> from rigd.beam import Beam, Damping, poles
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> print(poles(beam, Damping(zeta=1e-4), 2).round(3))
    [[-0.013 +16.047j -0.013 -16.047j]
     [-0.506+100.563j -0.506-100.563j]]
    """
    pole_pairs = poles_for_eigenvalues(clamped_free_eigenvalues(mode_count), beam, damping)
    modes_without_pole = np.flatnonzero(np.isnan(pole_pairs[:, 0]))
    if modes_without_pole.size:
        raise ArithmeticError(
            f"Mode {modes_without_pole[0] + 1} has no pole on the principal sheet with {damping}."
        )
    return pole_pairs


def poles_for_eigenvalues(
    z: RealArray, beam: Beam, damping: Damping, expected_roots_rad_s: ComplexArray | None = None
) -> ComplexArray:
    """Return the pole pair of each mode from its eigenvalue z, shape (len(z), 2), in rad/s.

    The poles are the roots of ``Q (z/L)⁴ + P = 0``, ordered as in `poles`. If z are the roots of
    ``tan z = tanh z`` instead of the clamped–free eigenvalues, the function returns the zeros of G.
    A row is NaN if there is no root on the principal sheet.

    Parameters
    ----------
    z
        Clamped–free eigenvalues, or roots of ``tan z = tanh z``, shape (m,).
    beam, damping
        Parameters of the exact model.
    expected_roots_rad_s
        Expected roots in the upper half plane, shape (m,). If all of them are within the relative
        distance `SAME_ROOT_TOLERANCE` of the true roots, the search starts from them, which is ten
        times faster than a start from the roots of the undamped beam.
    """
    omega_squared = (z / beam.length_m) ** 4 / beam.density_over_stiffness
    external_coefficient = damping.gamma / beam.density_over_stiffness
    internal_is_first_order = damping.zeta == 0 or damping.alpha == 1
    external_is_first_order = damping.gamma == 0 or damping.lambda_ == 1
    if internal_is_first_order and external_is_first_order:
        return _second_order_poles(
            omega_squared, external_coefficient + damping.zeta * omega_squared
        )
    if expected_roots_rad_s is not None and bool((expected_roots_rad_s.imag > 0).all()):
        start_log_poles = np.log(expected_roots_rad_s)
        log_poles = _newton_roots(
            start_log_poles, omega_squared, external_coefficient, damping.zeta, damping
        )
        if bool((np.abs(log_poles - start_log_poles) < SAME_ROOT_TOLERANCE).all()):
            upper_poles = np.exp(log_poles)
            return np.stack([upper_poles, upper_poles.conj()], axis=1)
    for step_count in _HOMOTOPY_STEP_COUNTS:
        upper_poles = _poles_by_continuation(
            omega_squared, external_coefficient, damping, step_count
        )
        has_no_pole = np.isnan(upper_poles)
        if not has_no_pole.any():
            break
    else:
        upper_poles[has_no_pole] = _poles_by_search(
            omega_squared[has_no_pole], external_coefficient, damping
        )
    return np.stack([upper_poles, upper_poles.conj()], axis=1)


def pole_gradient(
    pole_rad_s: complex,
    k4_per_m4: float,
    beam: Beam,
    damping: Damping,
    gradient_parameters: Sequence[str],
) -> ComplexArray:
    """Return the derivatives of a mode's pole with respect to k parameters, shape (k,).

    The derivatives follow by implicit differentiation of the mode's characteristic equation
    ``rho/EI s² + gamma s^lambda + k⁴ (1 + zeta s^alpha) = 0``, where k = z/L is the mode's wave
    number. A parameter of `rigd.beam.GRADIENT_NAMES` that does not affect the pole has the
    derivative 0.
    """
    s, density_ratio = complex(pole_rad_s), beam.density_over_stiffness
    log_s = np.log(s)
    internal_term = k4_per_m4 * np.exp(damping.alpha * log_s)
    external_term = np.exp(damping.lambda_ * log_s)
    equation_slope = (
        2 * density_ratio * s
        + damping.gamma * damping.lambda_ * external_term / s
        + damping.zeta * damping.alpha * internal_term / s
    )
    derivatives: dict[str, complex] = {
        "zeta": internal_term,
        "alpha": damping.zeta * log_s * internal_term,
        "gamma": external_term,
        "lambda": damping.gamma * log_s * external_term,
        "ln_density_over_stiffness": density_ratio * s * s,
    }
    return np.array(
        [
            -derivatives.get(parameter_name, 0.0) / equation_slope
            for parameter_name in gradient_parameters
        ],
        dtype=np.complex128,
    )


def modes(beam: Beam, damping: Damping, mode_count: int) -> tuple[Mode, ...]:
    """Return the first `mode_count` modes of the damped beam.

    Parameters
    ----------
    beam, damping
        Parameters of the exact model.
    mode_count
        Number of modes, from the first on.

    Raises
    ------
    ArithmeticError
        If a mode has no pole on the principal sheet.

    Examples
    --------
    >>> from rigd.beam import Beam, Damping, modes
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> for mode in modes(beam, Damping(zeta=7e-5, alpha=0.9), 2):
    ...     print(f"{mode.frequency_hz:.3f} Hz, damping ratio {mode.damping_ratio:.2%}")
    2.554 Hz, damping ratio 0.04%
    16.011 Hz, damping ratio 0.22%
    """
    mode_list = []
    for i, (first_pole, second_pole) in enumerate(poles(beam, damping, mode_count)):
        natural_rad_s = float(np.sqrt((first_pole * second_pole).real))
        mode_list.append(
            Mode(
                number=i + 1,
                poles_rad_s=(complex(first_pole), complex(second_pole)),
                frequency_hz=float(abs(first_pole.imag) / (2 * np.pi)),
                natural_frequency_rad_s=natural_rad_s,
                damping_ratio=float((-first_pole - second_pole).real / (2 * natural_rad_s)),
            )
        )
    return tuple(mode_list)


def _second_order_poles(omega_squared: RealArray, damping_rate: RealArray) -> ComplexArray:
    """Return the two roots in rad/s of ``s² + damping_rate s + omega_squared``, shape (n, 2)."""
    minus_half_rate = -0.5 * damping_rate
    first_roots = minus_half_rate + np.sqrt(
        (minus_half_rate * minus_half_rate - omega_squared).astype(np.complex128)
    )
    second_roots = first_roots.conj()
    is_over_damped = minus_half_rate * minus_half_rate > omega_squared
    fast_poles = minus_half_rate - np.sqrt(
        np.maximum(minus_half_rate * minus_half_rate - omega_squared, 0.0)
    )
    second_roots[is_over_damped] = fast_poles[is_over_damped]
    first_roots[is_over_damped] = (
        omega_squared[is_over_damped] / fast_poles[is_over_damped]
    )  # no cancellation
    return np.stack([first_roots, second_roots], axis=1)


def _poles_by_continuation(
    omega_squared: RealArray, external_coefficient: float, damping: Damping, step_count: int
) -> ComplexArray:
    """Return the modes' poles in the upper half plane, followed from the undamped ones.

    Damping grows from zero in `step_count` steps. A pole is NaN where the path was lost or has
    left the principal sheet.
    """
    log_s: ComplexArray = 0.5 * np.log(omega_squared) + 0.5j * np.pi
    for fraction in (np.arange(1, step_count + 1) / step_count) ** 2:
        log_s = _newton_roots(
            log_s, omega_squared, fraction * external_coefficient, fraction * damping.zeta, damping
        )
    poles: ComplexArray = np.exp(log_s)
    return poles


def _poles_by_search(
    omega_squared: RealArray, external_coefficient: float, damping: Damping
) -> ComplexArray:
    """Search for the modes' poles in the upper half plane by Newton's method from many starts.

    Most starts are near the branch cut: near critical damping of almost first order a pole turns
    along the cut so sharply that no reasonable step follows it. The result is NaN where no start
    leads to a pole on the principal sheet.
    """
    start_angles_rad = np.pi * np.array([0.7, 0.9, 0.98, 0.999])
    start_offsets: ComplexArray = np.add.outer(
        1j * start_angles_rad, np.linspace(-6, 6, 49)
    ).ravel()
    log_s: ComplexArray = 0.5 * np.log(omega_squared)[:, None] + start_offsets
    log_s = _newton_roots(
        log_s, omega_squared[:, None], external_coefficient, damping.zeta, damping
    )
    has_converged = ~np.isnan(log_s)
    first_converged_index = np.argmax(has_converged, axis=1)[:, None]
    poles: ComplexArray = np.exp(np.take_along_axis(log_s, first_converged_index, axis=1)[:, 0])
    return poles


def _newton_roots(
    log_s: ComplexArray,
    omega_squared: RealArray,
    external_coefficient: float,
    zeta: float,
    damping: Damping,
) -> ComplexArray:
    """Return ln s of the roots s of the characteristic equation, found by Newton's method.

    The unknown is ln s: in ln s a pole moves almost linearly, and a pole off the principal sheet
    has an argument beyond pi. The result is NaN where no root is found in the upper half of the
    principal sheet.
    """
    with np.errstate(all="ignore"):  # a diverging start overflows
        for _ in range(40):
            inertial_term = np.exp(2 * log_s)
            external_term = external_coefficient * np.exp(damping.lambda_ * log_s)
            internal_term = zeta * omega_squared * np.exp(damping.alpha * log_s)
            equation_residual = inertial_term + external_term + internal_term + omega_squared
            residual_slope = (
                2 * inertial_term + damping.lambda_ * external_term + damping.alpha * internal_term
            )
            newton_step = equation_residual / residual_slope
            log_s = log_s - newton_step
            if not (np.abs(newton_step) > 1e-12).any():  # nor where one is NaN
                break
        residual_scale = (
            np.abs(inertial_term) + np.abs(external_term) + np.abs(internal_term) + omega_squared
        )
        is_on_principal_sheet = (log_s.imag > 0) & (log_s.imag < np.pi + _MAX_ARGUMENT_EXCESS_RAD)
        is_solution = np.abs(equation_residual) < 1e-9 * residual_scale
        return np.where(is_solution & is_on_principal_sheet, log_s, np.nan + 0j)
