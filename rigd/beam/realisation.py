"""State-space realisations of the exact model: beam alone, and beam on a motor.

A realisation is a finite-dimensional approximation of Eq. 25 that runs in real time. Poles and
direct terms approximate the coupling torque per angular acceleration, ``G(s) / s²``::

    G(s) ≈ s² [ sum_i r_i / (s - p_i) + D ] + V s + K

The poles are one complex pair per clamped–free mode, equal to the exact poles, and a fixed ladder
of real poles for the branch cut of the fractional orders. Only the residues and the direct terms
are fitted: one linear least-squares problem with relative errors as residuals. V and K are needed
because the branch point at s = 0 makes G fall slower than s² there. D, V and K are constrained to
be non-negative, and the fit has a small weight beyond its band: an approximation can be accurate in
the band without being passive, and motor and beam together are then unstable.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigd.beam._model import Beam, Damping
from rigd.beam._modes import clamped_free_eigenvalues
from rigd.beam._plant import Plant
from rigd.errors import UserError

ERROR_BAND_HZ = (0.05, 100.0)
"""Frequency band in Hz over which `Realisation.relative_error` is the largest error.

It is the band of the paper's chirp and an octave above."""

MAX_GROWTH_PER_S = 1e-2
"""Largest accepted growth rate (1/s) of a frictionless motor with the realised beam attached.

Zero would exclude the undamped beam, whose poles lie on the imaginary axis except for rounding and
the fit's error."""

_HIGHEST_MODE_HZ = 1200.0
"""Frequency in Hz up to which a realisation includes the beam's modes."""
_MAX_MODES = 300
"""Largest number of modes that a realisation may have; more indicate wrong units of the beam."""
_MAX_MODAL_DAMPING_RATIO = 0.8
"""Damping ratio from which a pole pair above the fitted band is omitted.

With the real poles next to it, it would only allow huge residues that cancel in the band."""
_BRANCH_CUT_POLES_RAD_S = -(10.0 ** (np.arange(-6, 14) / 3.0))
"""Real poles in rad/s that approximate the branch cut of the fractional orders, three a decade."""
_FIT_BAND_HZ = (0.02, 500.0)
"""Frequency band in Hz in which the fit of the residues has the weight 1."""
_TAIL_BAND_HZ = (1e-4, 1080.0)
"""Lowest and highest frequency in Hz of the fit's grid outside `_FIT_BAND_HZ`."""
_FIT_TAIL_WEIGHT = 1e-3
"""Weight of the fit outside `_FIT_BAND_HZ`; it makes unstable realisations unlikely."""
_MIN_RELATIVE_ROOT_DISTANCE = 3e-7
"""Smallest distance of a fitted frequency from a pole or zero, relative to the frequency."""
_MAX_RELATIVE_OUTPUT_ERROR = 3e-3
"""Largest accepted relative error (rms) of an additional output of a realisation."""
_SINGULAR_VALUE_CUTOFF = 1e-10
"""Relative singular value below which the least-squares fit drops a combination of poles.

Such combinations would gain the last digit in the band with huge residues that cancel there and
nowhere else."""


RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complexfloating]


class RealisationError(UserError, ValueError):
    """The damped beam has no stable state space with the requested error."""


@dataclass(frozen=True, slots=True, eq=False)
class Realisation:
    """State space of the beam: motor angle θ as input, coupling torque Γ as output.

    The equations are ``x' = a x + b θ''`` and ``Γ = c x + D θ'' + V θ' + K θ``.

    `a` is block diagonal: 2 × 2 blocks for the complex pairs, then the real poles.
    """

    a: RealArray
    """State matrix, shape (n, n), in 1/s."""
    b: RealArray
    """Input vector of the angular acceleration, shape (n,), dimensionless."""
    c: RealArray
    """Output vector of the torque, shape (n,), in N·m."""
    direct_inertia_kg_m2: float
    """Torque per angular acceleration that bypasses the states (D), not negative."""
    direct_viscosity_nm_s_per_rad: float
    """Torque per angular velocity that bypasses the states (V), not negative."""
    direct_stiffness_nm_per_rad: float
    """Torque per angle that bypasses the states (K), not negative."""
    relative_error: float
    """Largest ``|realised - exact| / |exact|`` of the transfer function from 0.05 to 100 Hz."""
    poles_rad_s: ComplexArray
    """Poles, shape (m,): of each conjugate pair the one with positive imaginary part, then the
    real poles."""
    mode_indices: NDArray[np.intp]
    """Index of each pole's mode, shape (m,), from 0; -1 for a pole of the branch cut."""

    def transfer(self, s: ArrayLike) -> ComplexArray:
        """Return the realisation's coupling torque per motor angle at `s` (rad/s), in N·m/rad."""
        s_points = np.asarray(s, dtype=np.complex128)
        basis_columns = _basis_functions(s_points.ravel(), self.poles_rad_s)
        direct_terms = (
            self.direct_inertia_kg_m2,
            self.direct_viscosity_nm_s_per_rad,
            self.direct_stiffness_nm_per_rad,
        )
        g: ComplexArray = basis_columns @ np.concatenate([self.c, direct_terms])
        return g.reshape(s_points.shape)


@dataclass(frozen=True, slots=True, eq=False)
class StateOutput:
    """Response of the beam to the motor angle, written as an output of a realisation's states.

    The output is ``c x + D θ'' + V θ' + K θ``, with the states x of a `Realisation`.
    """

    c: RealArray
    """Output vector, shape (n,), in the response's unit."""
    output_per_acceleration: float
    """Output per angular acceleration that bypasses the states (D)."""
    output_per_velocity: float
    """Output per angular velocity that bypasses the states (V)."""
    output_per_angle: float
    """Output per angle that bypasses the states (K)."""


def state_output(
    realisation: Realisation,
    response: Callable[[NDArray[np.complex128]], ComplexArray],
    *,
    has_inertial_term: bool,
    response_floor: float = 0.0,
) -> StateOutput:
    """Fit another response of the beam, such as its base shear, to the states of a realisation.

    Parameters
    ----------
    realisation
        State space of the same beam.
    response
        Function that returns the response per motor angle at an array of s (rad/s), in the shape
        of s. It must have the poles of the coupling torque.
    has_inertial_term
        Whether the response may have a term proportional to the angular acceleration (D).
    response_floor
        Size of the response below which its error is relative to this size.

    Returns
    -------
    StateOutput
        Output vector and direct terms.

    Raises
    ------
    RealisationError
        If the relative error exceeds 0.3 % (rms) between 0.02 and 500 Hz.
    """
    poles = realisation.poles_rad_s
    omega, point_weights = _fit_grid(poles[poles.imag > 0])
    is_far = _far_from_poles_and_zeros(omega, poles, np.zeros(0, dtype=np.complex128))
    s = (1j * omega[is_far]).astype(np.complex128)
    point_weights = point_weights[is_far]
    exact_response = response(s)
    basis_columns = _basis_functions(s, poles)
    fitted_columns = np.arange(basis_columns.shape[1])
    if not has_inertial_term:
        fitted_columns = np.delete(fitted_columns, -3)
    response_size = np.abs(exact_response) + response_floor
    weighted_columns = basis_columns[:, fitted_columns] * (point_weights / response_size)[:, None]
    real_equations = np.concatenate([weighted_columns.real, weighted_columns.imag])
    column_scale = np.linalg.norm(real_equations, axis=0)
    weighted_response = exact_response * point_weights / response_size
    fit_target = np.concatenate([weighted_response.real, weighted_response.imag])
    output_coefficients = np.zeros(basis_columns.shape[1])
    output_coefficients[fitted_columns] = (
        np.linalg.lstsq(real_equations / column_scale, fit_target, rcond=_SINGULAR_VALUE_CUTOFF)[0]
        / column_scale
    )
    # The rms, not the largest error, since a response has zeros of its own.
    is_within_band = point_weights == 1
    relative_residual = ((basis_columns @ output_coefficients - exact_response) / response_size)[
        is_within_band
    ]
    rms_error = float(np.sqrt(np.mean(np.abs(relative_residual) ** 2)))
    if not rms_error <= _MAX_RELATIVE_OUTPUT_ERROR:
        raise RealisationError(
            f"A response of the beam is realised with a relative error of {rms_error:.1e} (rms); "
            f"{_MAX_RELATIVE_OUTPUT_ERROR:.1e} is accepted."
        )
    inertia, viscosity, stiffness = output_coefficients[-3:].tolist()
    return StateOutput(output_coefficients[:-3], inertia, viscosity, stiffness)


def _basis_functions(s: ComplexArray, poles: ComplexArray) -> ComplexArray:
    """Return the functions of s whose sum, weighted by ``c, D, V, K``, is the torque per angle.

    The shape is (len(s), n + 3), for n states.
    """
    upper_poles, real_poles = poles[poles.imag > 0], poles[poles.imag == 0].real
    s2 = (s * s)[:, None]
    basis_columns = np.empty(
        (s.size, 2 * upper_poles.size + real_poles.size + 3), dtype=np.complex128
    )
    shifted_s = s[:, None] - upper_poles.real
    determinant = shifted_s * shifted_s + upper_poles.imag**2
    basis_columns[:, 0 : 2 * upper_poles.size : 2] = s2 * shifted_s / determinant
    basis_columns[:, 1 : 2 * upper_poles.size : 2] = -s2 * upper_poles.imag / determinant
    basis_columns[:, 2 * upper_poles.size : -3] = s2 / (s[:, None] - real_poles)
    basis_columns[:, -3] = s2[:, 0]
    basis_columns[:, -2] = s
    basis_columns[:, -1] = 1
    return basis_columns


def realise(
    plant: Plant, *, max_relative_error: float = 1e-3, mode_selection_beam: Beam | None = None
) -> Realisation:
    """Fit a finite-dimensional state space to the exact model of the beam.

    Parameters
    ----------
    plant
        Beam with its damping and ends. The torque channel is not used.
    max_relative_error
        Largest acceptable relative error over `ERROR_BAND_HZ`.
    mode_selection_beam
        A slightly stiffer or softer beam whose modes determine the realised ones, so that both
        realisations have the same number of states. None: the beam itself.

    Raises
    ------
    RealisationError
        If the error is larger (the message states it); if the realisation would make a
        frictionless motor unstable; if the exact beam itself is not passive: negative
        coefficients, orders outside 0…2; if the beam has more than 300 modes to realise; or if it
        does not have the modes of `mode_selection_beam`.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, Damping, Plant
    >>> from rigd.beam.realisation import realise
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> plant = Plant(beam, Damping(zeta=7e-5, alpha=0.9))
    >>> realisation = realise(plant)
    >>> s = 2j * np.pi * np.geomspace(0.1, 50, 200)
    >>> error = np.abs(realisation.transfer(s) / plant.transfer(s) - 1)
    >>> bool(error.max() < 1e-3)
    True
    """
    beam, damping = plant.beam, plant.damping
    _check_passive(damping)
    poles, modes = _realised_poles(
        plant, beam if mode_selection_beam is None else mode_selection_beam
    )
    zeros = _zeros_in_band(plant)
    poles_and_zeros = np.concatenate([poles[poles.imag > 0], zeros])

    omega, point_weights = _fit_grid(poles_and_zeros)
    is_far = _far_from_poles_and_zeros(omega, poles, zeros)
    s = 1j * omega[is_far]
    exact_response = plant.transfer(s)
    relative_weight = point_weights[is_far] / exact_response
    output_coefficients = _fit_coefficients(
        _basis_functions(s, poles) * relative_weight[:, None],
        point_weights[is_far].astype(np.complex128),
    )

    relative_error = _relative_error(plant, poles, zeros, output_coefficients)
    if not relative_error <= max_relative_error:
        raise RealisationError(
            f"{damping} on {beam} is realised with a relative error of {relative_error:.1e} "
            f"between {ERROR_BAND_HZ[0]:g} and {ERROR_BAND_HZ[1]:g} Hz; {max_relative_error:.1e} "
            "was requested."
        )
    realisation = _build_realisation(poles, modes, output_coefficients, relative_error)
    growth_per_s = _growth_on_frictionless_motor(realisation, beam)
    if growth_per_s > MAX_GROWTH_PER_S:
        raise RealisationError(
            f"{damping} on {beam} is realised with a relative error of {relative_error:.1e}, but a "
            f"motor without friction would be unstable with it (growth {growth_per_s:.1e} 1/s)."
        )
    return realisation


def _check_passive(damping: Damping) -> None:
    """Raise RealisationError if the damping is such that the beam creates energy."""
    damping_values = (damping.zeta, damping.gamma, damping.alpha, damping.lambda_)
    if (
        not all(damping_value >= 0 for damping_value in damping_values)
        or not max(damping.alpha, damping.lambda_) < 2
    ):
        raise RealisationError(
            f"{damping} describes a beam that creates energy: zeta and gamma must not be negative, "
            "alpha and lambda must lie between 0 and 2."
        )


def _realised_poles(
    plant: Plant, mode_selection_beam: Beam
) -> tuple[ComplexArray, NDArray[np.intp]]:
    """Return the realisation's poles in rad/s and the index of each pole's mode.

    The poles up to 1.2 kHz are ordered as in `Realisation.poles_rad_s`; `mode_selection_beam` is
    the beam that determines which modes are included.
    """
    highest_k_fourth = (
        2 * np.pi * _HIGHEST_MODE_HZ
    ) ** 2 * mode_selection_beam.density_over_stiffness
    # Damping may lower the highest modes, so a few more are computed than the undamped count.
    mode_count = int(1.25 * highest_k_fourth**0.25 * mode_selection_beam.length_m / np.pi) + 3
    if mode_count > _MAX_MODES:
        raise RealisationError(
            f"{mode_selection_beam} has about {mode_count} modes below {_HIGHEST_MODE_HZ:g} Hz, "
            f"more than the {_MAX_MODES} that are realised; check the units of its length, density "
            "and stiffness."
        )
    eigenvalues = clamped_free_eigenvalues(mode_count)
    pole_pairs = plant.poles(eigenvalues)
    if mode_selection_beam == plant.beam:
        is_selected = _select_poles(pole_pairs)
    else:
        is_selected = _select_poles(replace(plant, beam=mode_selection_beam).poles(eigenvalues))
    is_oscillating = pole_pairs[:, 0].imag > 0
    # A pair may have ceased, or begun, to oscillate; one pole alone cannot.
    if (
        np.isnan(pole_pairs[is_selected]).any()
        or (is_oscillating & (is_selected.sum(axis=1) == 1)).any()
    ):
        raise RealisationError(
            f"{plant.beam} with {plant.damping} does not have the modes of {mode_selection_beam}."
        )
    oscillating_modes = np.flatnonzero(is_oscillating & is_selected[:, 0])
    is_over_damped = is_selected & ~is_oscillating[:, None]
    branch_cut_modes = np.full(_BRANCH_CUT_POLES_RAD_S.size, -1)
    return (
        np.concatenate(
            [pole_pairs[oscillating_modes, 0], pole_pairs[is_over_damped], _BRANCH_CUT_POLES_RAD_S]
        ),
        np.concatenate([oscillating_modes, np.nonzero(is_over_damped)[0], branch_cut_modes]),
    )


def _select_poles(pole_pairs: ComplexArray) -> NDArray[np.bool_]:
    """Return a mask of the modal poles in the state space, in the shape of `pole_pairs`."""
    is_oscillating = pole_pairs[:, 0].imag > 0
    mode_indices = np.flatnonzero(is_oscillating)
    upper_poles = pole_pairs[mode_indices, 0]
    is_within_band = np.abs(upper_poles) < 2 * np.pi * _FIT_BAND_HZ[1]
    is_lightly_damped = is_within_band | (
        -upper_poles.real < _MAX_MODAL_DAMPING_RATIO * np.abs(upper_poles)
    )
    mode_indices, upper_poles = mode_indices[is_lightly_damped], upper_poles[is_lightly_damped]
    indices_above_band = np.flatnonzero(upper_poles.imag > 2 * np.pi * _HIGHEST_MODE_HZ)
    mode_indices = (
        mode_indices[: indices_above_band[0] + 1] if indices_above_band.size else mode_indices
    )
    is_selected = ~is_oscillating[:, None] & (np.abs(pole_pairs) < 2 * np.pi * _HIGHEST_MODE_HZ)
    is_selected[mode_indices] = True
    return is_selected


def _zeros_in_band(plant: Plant) -> ComplexArray:
    """Return the zeros of G in rad/s up to 500 Hz, which are poles of the pinned–free beam."""
    beam = plant.beam
    highest_k_fourth = (2 * np.pi * _FIT_BAND_HZ[1]) ** 2 * beam.density_over_stiffness
    zero_count = int(highest_k_fourth**0.25 * beam.length_m / np.pi) + 1
    z = np.pi * np.arange(1.25, zero_count + 1)  # of tan z = tanh z, within 4e-4
    zeros = plant.zeros(z)[:, 0]
    upper_zeros: ComplexArray = zeros[zeros.imag > 0]
    return upper_zeros


def _fit_grid(poles_and_zeros: ComplexArray) -> tuple[RealArray, RealArray]:
    """Return the angular frequencies (rad/s) of the fit, and the weight of each in the fit.

    The grid covers the fit's band, where it is dense near `poles_and_zeros`, and both tails.
    """
    lowest_hz, highest_hz = _FIT_BAND_HZ
    band_hz = np.concatenate(
        [np.geomspace(lowest_hz, highest_hz, 200), _grid_around(poles_and_zeros, 10)]
    )
    band_hz = band_hz[(band_hz >= lowest_hz) & (band_hz <= highest_hz)]
    tails_hz = np.concatenate(
        [
            np.geomspace(_TAIL_BAND_HZ[0], lowest_hz, 25),
            np.geomspace(highest_hz, _TAIL_BAND_HZ[1], 25),
        ]
    )
    frequency_hz = np.concatenate([band_hz, tails_hz])
    point_weights = np.concatenate(
        [np.ones(band_hz.size), np.full(tails_hz.size, _FIT_TAIL_WEIGHT)]
    )
    return 2 * np.pi * frequency_hz, point_weights


def _grid_around(poles_and_zeros: ComplexArray, points_per_root: int) -> RealArray:
    """Return a grid of frequencies (Hz) within three half-widths of each pole or zero."""
    half_width = np.maximum(-poles_and_zeros.real, 1e-4 * poles_and_zeros.imag)
    width_offsets = np.linspace(-3, 3, points_per_root)
    frequency_hz: RealArray = (
        poles_and_zeros.imag[:, None] + half_width[:, None] * width_offsets
    ).ravel() / (2 * np.pi)
    return frequency_hz


def _fit_coefficients(equation_columns: ComplexArray, equation_target: ComplexArray) -> RealArray:
    """Return the real least-squares solution whose last three unknowns (D, V, K) are not negative.

    The equations ``columns @ solution = target`` are complex.
    """
    real_columns = np.concatenate([equation_columns.real, equation_columns.imag])
    column_scale = np.linalg.norm(real_columns, axis=0)
    q, r = np.linalg.qr(real_columns / column_scale)
    rotated_target = q.T @ np.concatenate([equation_target.real, equation_target.imag])
    unconstrained_columns = np.arange(real_columns.shape[1])
    while True:
        scaled_solution = np.zeros(real_columns.shape[1])
        scaled_solution[unconstrained_columns] = np.linalg.lstsq(
            r[:, unconstrained_columns], rotated_target, rcond=_SINGULAR_VALUE_CUTOFF
        )[0]
        direct_terms = scaled_solution[-3:]
        if (direct_terms >= 0).all():
            solution: RealArray = scaled_solution / column_scale
            return solution
        unconstrained_columns = unconstrained_columns[
            unconstrained_columns != real_columns.shape[1] - 3 + np.argmin(direct_terms)
        ]


def _relative_error(
    plant: Plant, poles: ComplexArray, zeros: ComplexArray, coefficients: RealArray
) -> float:
    """Return the realisation's largest relative error on a grid denser than that of the fit."""
    lowest_hz, highest_hz = ERROR_BAND_HZ
    poles_and_zeros = np.concatenate([poles[poles.imag > 0], zeros])
    frequency_hz = np.concatenate(
        [np.geomspace(lowest_hz, highest_hz, 1200), _grid_around(poles_and_zeros, 34)]
    )
    omega = 2 * np.pi * frequency_hz[(frequency_hz >= lowest_hz) & (frequency_hz <= highest_hz)]
    s = 1j * omega[_far_from_poles_and_zeros(omega, poles, zeros)]
    exact_response = plant.transfer(s)
    return float(np.max(np.abs(_basis_functions(s, poles) @ coefficients / exact_response - 1)))


def _far_from_poles_and_zeros(
    omega: RealArray, poles: ComplexArray, zeros: ComplexArray
) -> NDArray[np.bool_]:
    """Return a mask of the frequencies at which a relative error of the response is meaningful.

    At a pole or zero, where the exact response is infinite or zero, it is not.
    """
    poles_and_zeros = np.concatenate([poles, zeros])
    distance = np.abs(1j * omega[:, None] - poles_and_zeros).min(axis=1)
    is_far: NDArray[np.bool_] = distance > _MIN_RELATIVE_ROOT_DISTANCE * omega
    return is_far


def _build_realisation(
    poles: ComplexArray, modes: NDArray[np.intp], coefficients: RealArray, relative_error: float
) -> Realisation:
    """Build the realisation from its poles and the fitted coefficients ``c, D, V, K``."""
    upper_poles, real_poles = poles[poles.imag > 0], poles[poles.imag == 0].real
    n = 2 * upper_poles.size + real_poles.size
    a = np.zeros((n, n))
    pair_rows = np.arange(0, 2 * upper_poles.size, 2)
    a[pair_rows, pair_rows] = a[pair_rows + 1, pair_rows + 1] = upper_poles.real
    a[pair_rows, pair_rows + 1] = upper_poles.imag
    a[pair_rows + 1, pair_rows] = -upper_poles.imag
    real_pole_rows = np.arange(2 * upper_poles.size, n)
    a[real_pole_rows, real_pole_rows] = real_poles
    b = np.ones(n)
    b[pair_rows + 1] = 0.0
    inertia, viscosity, stiffness = (float(coefficient) for coefficient in coefficients[-3:])
    return Realisation(
        a, b, coefficients[:-3], inertia, viscosity, stiffness, relative_error, poles, modes
    )


def _growth_on_frictionless_motor(realisation: Realisation, beam: Beam) -> float:
    """Return the growth rate (1/s) of the realised beam on a frictionless motor.

    The motor has the inertia of the beam. Without friction and with little inertia it is the most
    critical case for stability.
    """
    motor_and_beam = couple(realisation, motor_inertia_kg_m2=beam.inertia_kg_m2)
    return float(np.linalg.eigvals(motor_and_beam.a).real.max())


# Beam on a motor


@dataclass(frozen=True, slots=True, eq=False)
class CoupledModel:
    """State space ``x' = a x + b τ`` of a motor and the beam on its shaft.

    The state is angle (rad), angular velocity (rad/s), then the states of the beam. τ is the torque
    on the shaft in N·m: the motor's torque minus any friction that the model does not contain. An
    output is its output row times the state, plus its factor times τ if the model has one.
    """

    a: RealArray
    """State matrix, shape (n, n)."""
    b: RealArray
    """Input vector of the torque on the shaft, shape (n,)."""
    angle_output_row: RealArray
    """Output row of the angle in rad, shape (n,)."""
    velocity_output_row: RealArray
    """Output row of the angular velocity in rad/s, shape (n,)."""
    acceleration_output_row: RealArray
    """Output row of the angular acceleration in rad/s², shape (n,).

    The torque on the shaft adds `acceleration_per_torque` times τ."""
    acceleration_per_torque: float
    """Angular acceleration per torque on the shaft, in rad/(s² N·m)."""
    beam_torque_output_row: RealArray
    """Output row of the torque Γ on the beam in N·m, shape (n,).

    The torque on the shaft adds `beam_torque_per_torque` times τ."""
    beam_torque_per_torque: float
    """Fraction of the shaft's torque that acts on the beam without delay."""
    sensor_torque_output_row: RealArray
    """Output row of the torque at a sensor between motor and clamp in N·m, shape (n,).

    It is ``Γ + J_tool θ''``; the torque on the shaft adds `sensor_torque_per_torque` times τ."""
    sensor_torque_per_torque: float
    """Fraction of the shaft's torque that acts on the sensor without delay."""
    sensed_torque_output_row: RealArray | None = None
    """Output row of the torque after the sensor's filter in N·m, shape (n,); None without filter.
    """
    shear_output_row: RealArray = field(default_factory=lambda: np.zeros(0))
    """Output row of the motor's force on the beam in N, shape (n,).

    The torque on the shaft adds `shear_per_torque` times τ."""
    shear_per_torque: float = 0.0
    """Force on the beam per torque on the shaft that acts without delay, in 1/m."""
    sensed_shear_output_row: RealArray | None = None
    """Output row of the shear force after the sensor's filter in N, shape (n,); None without
    filter."""


def with_filter(model: CoupledModel, corner_hz: float, order: int) -> CoupledModel:
    """Add low-pass filters of the sensor's torque and shear force to a model.

    The filters' states come last.

    Parameters
    ----------
    model
        Motor and beam.
    corner_hz
        Corner frequency of the filter.
    order
        1, or 2 (Butterworth).
    """
    n, omega = model.b.size, 2 * math.pi * corner_hz
    filter_state_count = 2 * order
    a = np.zeros((n + filter_state_count, n + filter_state_count))
    b = np.zeros(n + filter_state_count)
    a[:n, :n], b[:n] = model.a, model.b
    filtered_output_rows = (
        (n, model.sensor_torque_output_row, model.sensor_torque_per_torque),
        (n + order, model.shear_output_row, model.shear_per_torque),
    )
    for first_state_index, row, per_torque in filtered_output_rows:
        last_state_index = first_state_index + order - 1
        # x' = omega (u - x), or x' = omega y, y' = omega (u - x - sqrt(2) y)
        a[last_state_index, :n] = omega * row
        b[last_state_index] = omega * per_torque
        a[last_state_index, first_state_index] = -omega
        if order == 2:
            a[first_state_index, last_state_index] = omega
            a[last_state_index, last_state_index] = -math.sqrt(2) * omega
    zero_columns = np.zeros(filter_state_count)
    return replace(
        model,
        a=a,
        b=b,
        angle_output_row=np.append(model.angle_output_row, zero_columns),
        velocity_output_row=np.append(model.velocity_output_row, zero_columns),
        acceleration_output_row=np.append(model.acceleration_output_row, zero_columns),
        beam_torque_output_row=np.append(model.beam_torque_output_row, zero_columns),
        sensor_torque_output_row=np.append(model.sensor_torque_output_row, zero_columns),
        sensed_torque_output_row=np.eye(1, n + filter_state_count, n)[0],
        shear_output_row=np.append(model.shear_output_row, zero_columns),
        sensed_shear_output_row=np.eye(1, n + filter_state_count, n + order)[0],
    )


def couple(
    realisation: Realisation | None,
    *,
    motor_inertia_kg_m2: float,
    viscous_nm_s_per_rad: float = 0.0,
    tool_inertia_kg_m2: float = 0.0,
    shear: StateOutput | None = None,
) -> CoupledModel:
    """Return the state space of a motor with the beam and the tool inertia on its shaft.

    Parameters
    ----------
    realisation
        State space of the beam, or None for the motor and the clamp alone.
    motor_inertia_kg_m2
        Inertia of motor and gear at the output shaft.
    viscous_nm_s_per_rad
        Viscous friction at the output shaft.
    tool_inertia_kg_m2
        Inertia between sensor and beam.
    shear
        Base shear of the beam as an output of `realisation`, or None to omit the shear force.
    """
    beam_state_count = 0 if realisation is None else realisation.b.size
    n = 2 + beam_state_count
    rigid_torque = np.zeros(n)  # Γ without the term D θ''
    direct_inertia = 0.0
    a = np.zeros((n, n))
    angle_row, velocity_row = np.eye(2, n)
    if realisation is not None:
        rigid_torque[0] = realisation.direct_stiffness_nm_per_rad
        rigid_torque[1] = realisation.direct_viscosity_nm_s_per_rad
        rigid_torque[2:] = realisation.c
        direct_inertia = realisation.direct_inertia_kg_m2
        a[2:, 2:] = realisation.a

    total_inertia = motor_inertia_kg_m2 + tool_inertia_kg_m2 + direct_inertia
    acceleration_row = -(rigid_torque + viscous_nm_s_per_rad * velocity_row) / total_inertia
    a[0] = velocity_row
    a[1] = acceleration_row
    b = velocity_row / total_inertia
    if realisation is not None:
        a[2:] += np.outer(realisation.b, acceleration_row)
        b[2:] = realisation.b / total_inertia
    sensed_inertia = direct_inertia + tool_inertia_kg_m2
    shear_row, shear_per_acceleration = np.zeros(n), 0.0
    if shear is not None:
        shear_per_acceleration = shear.output_per_acceleration
        shear_row = np.concatenate([[shear.output_per_angle, shear.output_per_velocity], shear.c])
        shear_row += shear_per_acceleration * acceleration_row
    return CoupledModel(
        a=a,
        b=b,
        angle_output_row=angle_row,
        velocity_output_row=velocity_row,
        acceleration_output_row=acceleration_row,
        acceleration_per_torque=1 / total_inertia,
        beam_torque_output_row=rigid_torque + direct_inertia * acceleration_row,
        beam_torque_per_torque=direct_inertia / total_inertia,
        sensor_torque_output_row=rigid_torque + sensed_inertia * acceleration_row,
        sensor_torque_per_torque=sensed_inertia / total_inertia,
        shear_output_row=shear_row,
        shear_per_torque=shear_per_acceleration / total_inertia,
    )


def propagator(model: CoupledModel, duration_s: float) -> tuple[RealArray, RealArray]:
    """Return the matrices of the exact discrete-time model for a constant torque.

    ``x(t + duration_s) = phi x(t) + gamma τ`` for a torque τ that is constant during that time.

    Parameters
    ----------
    model
        Motor and beam.
    duration_s
        Time for which the torque is constant.

    Returns
    -------
    phi : (n, n)
    gamma : (n,)

    Examples
    --------
    >>> from rigd.beam.realisation import couple, propagator
    >>> motor = couple(None, motor_inertia_kg_m2=2e-3)
    >>> phi, gamma = propagator(motor, 0.1)
    >>> print(phi, gamma.round(6))
    [[1.  0.1]
     [0.  1. ]] [ 2.5 50. ]
    """
    n = model.b.size
    extended_matrix = np.zeros((n + 1, n + 1))
    extended_matrix[:n, :n] = model.a * duration_s
    extended_matrix[:n, n] = model.b * duration_s
    matrix_exponential = _matrix_exponential(extended_matrix)
    return matrix_exponential[:n, :n], matrix_exponential[:n, n]


def states_after_constant_inputs(
    model: CoupledModel, inputs: RealArray, duration_s: float
) -> RealArray:
    """Return the state that each constant unit input causes after a duration, shape (n, inputs).

    Parameters
    ----------
    model
        State space, initially at rest.
    inputs
        Effect of each input on the state's derivative, shape (n, inputs).
    duration_s
        Time for which the inputs are constant.
    """
    n, m = inputs.shape
    extended_matrix = np.zeros((n + m, n + m))
    extended_matrix[:n, :n] = model.a * duration_s
    extended_matrix[:n, n:] = inputs * duration_s
    return _matrix_exponential(extended_matrix)[:n, n:]


def _matrix_exponential(square_matrix: RealArray) -> RealArray:
    """Return the matrix exponential by scaling and squaring with the [13/13] Padé approximant.

    Algorithm 2.3 of N. J. Higham, SIAM J. Matrix Anal. Appl. 26 (2005) 1179, without its low-order
    cases. scipy has the same function, but its import takes longer than the rest of a fast start.
    """
    matrix_norm = float(np.linalg.norm(square_matrix, 1))
    squaring_count = max(0, math.ceil(math.log2(matrix_norm / 5.37))) if matrix_norm > 0 else 0
    x = square_matrix / 2.0**squaring_count
    x2 = x @ x
    x4 = x2 @ x2
    matrix_powers = np.stack([np.eye(len(x)), x2, x4, x2 @ x4])  # of x²: 0, 1, 2, 3
    pade_coefficients = np.cumprod([1.0] + [(13 - k) / ((26 - k) * (k + 1)) for k in range(13)])
    even_part, odd_part = (
        np.tensordot(pade_coefficients[parity:8:2], matrix_powers, 1)
        + matrix_powers[3] @ np.tensordot(pade_coefficients[8 + parity :: 2], matrix_powers[1:], 1)
        for parity in (0, 1)
    )
    odd_part = x @ odd_part
    matrix_exponential: RealArray = np.linalg.solve(even_part - odd_part, even_part + odd_part)
    for _ in range(squaring_count):
        matrix_exponential = matrix_exponential @ matrix_exponential
    return matrix_exponential
