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

from rigd.beam._model import Beam, Damping, TransferGrid
from rigd.beam._modes import clamped_free_eigenvalues
from rigd.beam._tip_mass import LoadedBeam
from rigd.errors import UserError

ERROR_BAND_HZ = (0.05, 100.0)
"""Band in which a realisation states its error: the paper's chirp and an octave above."""

MAX_GROWTH_PER_S = 1e-2
"""Limit of the growth of a frictionless motor with the beam attached. Zero would exclude the
undamped beam, whose poles lie on the imaginary axis except for rounding and the fit's error."""

_MODES_UP_TO_HZ = 1200.0
_MOST_MODES = 300
_HEAVY_DAMPING = 0.8
"""Damping ratio from which a pair beyond the band is left out: with the real poles next to it, it
would only allow huge residues that cancel in the band."""
_CUT_POLES = -(10.0 ** (np.arange(-6, 14) / 3.0))
_FIT_BAND_HZ = (0.02, 500.0)
_TAIL_HZ = (1e-4, 1080.0)
_TAIL_WEIGHT = 1e-3
_CLOSEST = 3e-7
_MAX_OUTPUT_ERROR = 3e-3
_RCOND = 1e-10
"""Excludes combinations of columns that would gain the last digit in the band with huge residues
that cancel there and nowhere else."""


Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating]


class RealisationError(UserError, ValueError):
    """The damping cannot be realised with the requested error, or not stably."""


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
    """D, not negative."""
    direct_viscosity_nm_s_per_rad: float
    """V, not negative."""
    direct_stiffness_nm_per_rad: float
    """K, not negative."""
    relative_error: float
    """Largest ``|realised - exact| / |exact|`` between 0.05 and 100 Hz."""
    poles_rad_s: Complex
    """(m,): the pole in the upper half plane of each conjugate pair, then the real ones."""
    modes: NDArray[np.intp]
    """(m,): mode of each pole, the first is 0; -1: a pole of the branch cut."""

    def transfer(self, s: ArrayLike) -> Complex:
        """Return G(s) of the realisation, in N·m/rad, in the shape of `s` (rad/s)."""
        points = np.asarray(s, dtype=np.complex128)
        columns = _basis(points.ravel(), self.poles_rad_s)
        direct = (
            self.direct_inertia_kg_m2,
            self.direct_viscosity_nm_s_per_rad,
            self.direct_stiffness_nm_per_rad,
        )
        g: Complex = columns @ np.concatenate([self.c, direct])
        return g.reshape(points.shape)


@dataclass(frozen=True, slots=True, eq=False)
class StateOutput:
    """Another response to the root's angle, as an output of a realisation's states.

    It is ``c x + D θ'' + V θ' + K θ``, as the torque of a `Realisation`.
    """

    c: Real
    """(n,), in the response's unit."""
    per_acceleration: float
    """D."""
    per_velocity: float
    """V."""
    per_angle: float
    """K."""


def state_output(
    realisation: Realisation,
    response: Callable[[NDArray[np.complex128]], Complex],
    *,
    inertial: bool,
    small: float = 0.0,
) -> StateOutput:
    """Fit a response of the beam, such as its base shear, as an output of its realisation.

    Parameters
    ----------
    realisation
        The beam's.
    response
        Response to the angle of the root, from s (rad/s) to an array of its shape. It must have the
        poles of the torque.
    inertial
        Whether it may have a part proportional to the angular acceleration (D).
    small
        Size of the response below which its error is relative to this size.

    Raises
    ------
    RealisationError
        If the relative error exceeds 0.3 % (rms) between 0.02 and 500 Hz.
    """
    poles = realisation.poles_rad_s
    omega, weight = _fit_grid(poles[poles.imag > 0])
    apart = _apart(omega, poles, np.zeros(0, dtype=np.complex128))
    s = (1j * omega[apart]).astype(np.complex128)
    weight = weight[apart]
    exact = response(s)
    columns = _basis(s, poles)
    used = np.arange(columns.shape[1])
    if not inertial:
        used = np.delete(used, -3)
    size = np.abs(exact) + small
    matrix = columns[:, used] * (weight / size)[:, None]
    rows = np.concatenate([matrix.real, matrix.imag])
    scale = np.linalg.norm(rows, axis=0)
    weighted = exact * weight / size
    target = np.concatenate([weighted.real, weighted.imag])
    coefficients = np.zeros(columns.shape[1])
    coefficients[used] = np.linalg.lstsq(rows / scale, target, rcond=_RCOND)[0] / scale
    # The mean, not the largest error, since a response has zeros of its own.
    in_band = weight == 1
    left = ((columns @ coefficients - exact) / size)[in_band]
    error = float(np.sqrt(np.mean(np.abs(left) ** 2)))
    if not error <= _MAX_OUTPUT_ERROR:
        raise RealisationError(
            f"A response of the beam is realised with a relative error of {error:.1e} (rms); "
            f"{_MAX_OUTPUT_ERROR:.1e} is accepted."
        )
    inertia, viscosity, stiffness = coefficients[-3:].tolist()
    return StateOutput(coefficients[:-3], inertia, viscosity, stiffness)


def _basis(s: Complex, poles: Complex) -> Complex:
    """Return the columns whose combination with ``c, D, V, K`` is G: shape (len(s), n + 3)."""
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


def realise(
    beam: Beam,
    damping: Damping,
    *,
    max_relative_error: float = 1e-3,
    tip_mass_kg: float = 0.0,
    root_compliance_rad_per_nm: float = 0.0,
    stiffness_offsets: tuple[float, ...] = (),
    modes_of: Beam | None = None,
) -> Realisation:
    """Return a state space of the beam that runs in real time.

    Parameters
    ----------
    beam, damping
        Parameters of the exact model.
    tip_mass_kg, root_compliance_rad_per_nm
        Point mass at its tip, and rotation of its clamp per torque.
    stiffness_offsets
        Relative differences of the stiffness of modes 2, 3, … from the uniform beam's.
    max_relative_error
        Largest acceptable relative error over `ERROR_BAND_HZ`.
    modes_of
        A slightly stiffer or softer beam whose modes determine the realised ones, so that both
        realisations have the same number of states. None: the beam itself.

    Raises
    ------
    RealisationError
        If the error is larger (the message states it); if the realisation would make a
        frictionless motor unstable; if the exact beam itself is not passive: negative
        coefficients, orders outside 0…2; if the beam has more than 300 modes to realise; or if it
        does not have the modes of `modes_of`.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.beam import Beam, Damping, transfer
    >>> from rigd.beam.realisation import realise
    >>> beam = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.0903)
    >>> damping = Damping(zeta=7e-5, alpha=0.9)
    >>> realisation = realise(beam, damping)
    >>> s = 2j * np.pi * np.geomspace(0.1, 50, 200)
    >>> error = np.abs(realisation.transfer(s) / transfer(s, beam, damping) - 1)
    >>> bool(error.max() < 1e-3)
    True
    """
    _check_passive(damping)
    loaded = LoadedBeam(beam, damping, tip_mass_kg, root_compliance_rad_per_nm, stiffness_offsets)
    poles, modes = _poles(loaded, beam if modes_of is None else modes_of)
    zeros = _zeros(loaded)
    landmarks = np.concatenate([poles[poles.imag > 0], zeros])

    omega, weight = _fit_grid(landmarks)
    apart = _apart(omega, poles, zeros)
    s = 1j * omega[apart]
    exact = _exact(loaded, s)
    scale = weight[apart] / exact
    coefficients = _fit(_basis(s, poles) * scale[:, None], weight[apart].astype(np.complex128))

    error = _relative_error(loaded, poles, zeros, coefficients)
    if not error <= max_relative_error:
        raise RealisationError(
            f"{damping} on {beam} is realised with a relative error of {error:.1e} between "
            f"{ERROR_BAND_HZ[0]:g} and {ERROR_BAND_HZ[1]:g} Hz; {max_relative_error:.1e} was "
            "requested."
        )
    realisation = _state_space(poles, modes, coefficients, error)
    growth = _growth_on_frictionless_motor(realisation, beam)
    if growth > MAX_GROWTH_PER_S:
        raise RealisationError(
            f"{damping} on {beam} is realised with a relative error of {error:.1e}, but a motor "
            f"without friction would be unstable with it (growth {growth:.1e} 1/s)."
        )
    return realisation


def _check_passive(damping: Damping) -> None:
    values = (damping.zeta, damping.gamma, damping.alpha, damping.lambda_)
    if not all(value >= 0 for value in values) or not max(damping.alpha, damping.lambda_) < 2:
        raise RealisationError(
            f"{damping} describes a beam that creates energy: zeta and gamma must not be negative, "
            "alpha and lambda must lie between 0 and 2."
        )


def _exact(loaded: LoadedBeam, s: Complex) -> Complex:
    """Return the transfer function of the exact beam, in the shape of s."""
    if loaded.plain:
        return TransferGrid(s).evaluate(loaded.beam, loaded.damping)
    return loaded.transfer(np.asarray(s, dtype=np.complex128))


def _poles(loaded: LoadedBeam, modes_of: Beam) -> tuple[Complex, NDArray[np.intp]]:
    """Return poles up to 1.2 kHz, upper half plane first, then real ones; and their modes."""
    reach = (2 * np.pi * _MODES_UP_TO_HZ) ** 2 * modes_of.density_over_stiffness
    # Damping may lower the highest modes, so a few more are computed than the undamped count.
    count = int(1.25 * reach**0.25 * modes_of.length_m / np.pi) + 3
    if count > _MOST_MODES:
        raise RealisationError(
            f"{modes_of} has some {count} modes below {_MODES_UP_TO_HZ:g} Hz, more than the "
            f"{_MOST_MODES} that are realised; check the units of its length, density and "
            "stiffness."
        )
    eigenvalues = clamped_free_eigenvalues(count)
    pairs = loaded.poles(eigenvalues)
    if modes_of == loaded.beam:
        chosen = _realised(pairs)
    else:
        chosen = _realised(replace(loaded, beam=modes_of).poles(eigenvalues))
    oscillating = pairs[:, 0].imag > 0
    # A pair may have ceased, or begun, to oscillate; one pole alone cannot.
    if np.isnan(pairs[chosen]).any() or (oscillating & (chosen.sum(axis=1) == 1)).any():
        raise RealisationError(
            f"{loaded.beam} with {loaded.damping} does not have the modes of {modes_of}."
        )
    upper = np.flatnonzero(oscillating & chosen[:, 0])
    over_damped = chosen & ~oscillating[:, None]
    cut = np.full(_CUT_POLES.size, -1)
    return (
        np.concatenate([pairs[upper, 0], pairs[over_damped], _CUT_POLES]),
        np.concatenate([upper, np.nonzero(over_damped)[0], cut]),
    )


def _realised(pairs: Complex) -> NDArray[np.bool_]:
    """Return which poles of the modes are realised, in the shape of `pairs`."""
    oscillating = pairs[:, 0].imag > 0
    numbers = np.flatnonzero(oscillating)
    upper = pairs[numbers, 0]
    in_band = np.abs(upper) < 2 * np.pi * _FIT_BAND_HZ[1]
    light = in_band | (-upper.real < _HEAVY_DAMPING * np.abs(upper))
    numbers, upper = numbers[light], upper[light]
    beyond = np.flatnonzero(upper.imag > 2 * np.pi * _MODES_UP_TO_HZ)
    numbers = numbers[: beyond[0] + 1] if beyond.size else numbers
    chosen = ~oscillating[:, None] & (np.abs(pairs) < 2 * np.pi * _MODES_UP_TO_HZ)
    chosen[numbers] = True
    return chosen


def _zeros(loaded: LoadedBeam) -> Complex:
    """Return the zeros of G up to the end of the fit's band: the pinned–free beam's modes."""
    beam = loaded.beam
    reach = (2 * np.pi * _FIT_BAND_HZ[1]) ** 2 * beam.density_over_stiffness
    count = int(reach**0.25 * beam.length_m / np.pi) + 1
    z = np.pi * np.arange(1.25, count + 1)  # of tan z = tanh z, within 4e-4
    zeros = loaded.zeros(z)[:, 0]
    upper: Complex = zeros[zeros.imag > 0]
    return upper


def _fit_grid(landmarks: Complex) -> tuple[Real, Real]:
    """Return angular frequencies and weights: the band, dense at poles and zeros, and the tails."""
    low, high = _FIT_BAND_HZ
    band = np.concatenate([np.geomspace(low, high, 200), _clusters(landmarks, 10)])
    band = band[(band >= low) & (band <= high)]
    tails = np.concatenate(
        [np.geomspace(_TAIL_HZ[0], low, 25), np.geomspace(high, _TAIL_HZ[1], 25)]
    )
    frequency = np.concatenate([band, tails])
    weight = np.concatenate([np.ones(band.size), np.full(tails.size, _TAIL_WEIGHT)])
    return 2 * np.pi * frequency, weight


def _clusters(landmarks: Complex, points: int) -> Real:
    """Return frequencies (Hz) over three half-widths on either side of each pole or zero."""
    half_width = np.maximum(-landmarks.real, 1e-4 * landmarks.imag)
    offsets = np.linspace(-3, 3, points)
    frequency: Real = (landmarks.imag[:, None] + half_width[:, None] * offsets).ravel() / (
        2 * np.pi
    )
    return frequency


def _fit(columns: Complex, target: Complex) -> Real:
    """Solve real least squares with non-negative last three unknowns (D, V, K)."""
    matrix = np.concatenate([columns.real, columns.imag])
    scale = np.linalg.norm(matrix, axis=0)
    q, r = np.linalg.qr(matrix / scale)
    rotated = q.T @ np.concatenate([target.real, target.imag])
    free = np.arange(matrix.shape[1])
    while True:
        solution = np.zeros(matrix.shape[1])
        solution[free] = np.linalg.lstsq(r[:, free], rotated, rcond=_RCOND)[0]
        direct = solution[-3:]
        if (direct >= 0).all():
            scaled: Real = solution / scale
            return scaled
        free = free[free != matrix.shape[1] - 3 + np.argmin(direct)]


def _relative_error(
    loaded: LoadedBeam, poles: Complex, zeros: Complex, coefficients: Real
) -> float:
    """Return the largest relative error over a grid several times as dense as the fit's."""
    low, high = ERROR_BAND_HZ
    landmarks = np.concatenate([poles[poles.imag > 0], zeros])
    frequency = np.concatenate([np.geomspace(low, high, 1200), _clusters(landmarks, 34)])
    omega = 2 * np.pi * frequency[(frequency >= low) & (frequency <= high)]
    s = 1j * omega[_apart(omega, poles, zeros)]
    exact = _exact(loaded, s)
    return float(np.max(np.abs(_basis(s, poles) @ coefficients / exact - 1)))


def _apart(omega: Real, poles: Complex, zeros: Complex) -> NDArray[np.bool_]:
    """Return where ω is not too close to a pole or zero for a relative error to have a meaning."""
    landmarks = np.concatenate([poles, zeros])
    distance = np.abs(1j * omega[:, None] - landmarks).min(axis=1)
    apart: NDArray[np.bool_] = distance > _CLOSEST * omega
    return apart


def _state_space(
    poles: Complex, modes: NDArray[np.intp], coefficients: Real, error: float
) -> Realisation:
    upper, real = poles[poles.imag > 0], poles[poles.imag == 0].real
    n = 2 * upper.size + real.size
    a = np.zeros((n, n))
    even = np.arange(0, 2 * upper.size, 2)
    a[even, even] = a[even + 1, even + 1] = upper.real
    a[even, even + 1] = upper.imag
    a[even + 1, even] = -upper.imag
    rest = np.arange(2 * upper.size, n)
    a[rest, rest] = real
    b = np.ones(n)
    b[even + 1] = 0.0
    inertia, viscosity, stiffness = (float(value) for value in coefficients[-3:])
    return Realisation(a, b, coefficients[:-3], inertia, viscosity, stiffness, error, poles, modes)


def _growth_on_frictionless_motor(realisation: Realisation, beam: Beam) -> float:
    """Return the growth rate of the realisation on a frictionless motor as heavy as the beam.

    Without friction and with little inertia of its own such a motor is the most critical case for
    stability.
    """
    motor_and_beam = couple(realisation, motor_inertia_kg_m2=beam.inertia_kg_m2)
    return float(np.linalg.eigvals(motor_and_beam.a).real.max())


# Beam on a motor


@dataclass(frozen=True, slots=True, eq=False)
class CoupledModel:
    """``x' = a x + b τ`` of a motor that rigidly turns a beam; τ is the torque on the shaft in N·m.

    The state is angle (rad), angular velocity (rad/s), then the states of the beam. τ is the
    motor's torque minus any friction that the model does not contain.
    """

    a: Real
    """(n, n)."""
    b: Real
    """(n,)."""
    angle: Real
    """(n,) row: angle in rad."""
    velocity: Real
    """(n,) row: angular velocity in rad/s."""
    acceleration: Real
    """(n,) row: angular acceleration in rad/s², to which τ adds `acceleration_per_torque`."""
    acceleration_per_torque: float
    """In rad/(s² N·m)."""
    beam_torque: Real
    """(n,) row: Γ, the torque on the beam, in N·m; τ adds `beam_torque_per_torque`."""
    beam_torque_per_torque: float
    """Fraction of τ that reaches the beam at once."""
    sensor_torque: Real
    """(n,) row: torque of a sensor between motor and clamp, ``Γ + J_tool θ''``, in N·m."""
    sensor_torque_per_torque: float
    """Fraction of τ that passes the sensor at once."""
    sensed_torque: Real | None = None
    """(n,) row: torque after the sensor's filter, in N·m; None: it has none."""
    shear: Real = field(default_factory=lambda: np.zeros(0))
    """(n,) row: force of the motor on the beam, in N; τ adds `shear_per_torque`."""
    shear_per_torque: float = 0.0
    """In 1/m."""
    sensed_shear: Real | None = None
    """(n,) row: shear after the sensor's filter, in N; None: it has none."""


def with_filter(model: CoupledModel, corner_hz: float, order: int) -> CoupledModel:
    """Return the model with low-pass filters of the sensor's torque and shear.

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
    more = 2 * order
    a = np.zeros((n + more, n + more))
    b = np.zeros(n + more)
    a[:n, :n], b[:n] = model.a, model.b
    filtered = (
        (n, model.sensor_torque, model.sensor_torque_per_torque),
        (n + order, model.shear, model.shear_per_torque),
    )
    for first, row, per_torque in filtered:
        last = first + order - 1
        # x' = omega (u - x), or x' = omega y, y' = omega (u - x - sqrt(2) y)
        a[last, :n] = omega * row
        b[last] = omega * per_torque
        a[last, first] = -omega
        if order == 2:
            a[first, last] = omega
            a[last, last] = -math.sqrt(2) * omega
    none = np.zeros(more)
    return replace(
        model,
        a=a,
        b=b,
        angle=np.append(model.angle, none),
        velocity=np.append(model.velocity, none),
        acceleration=np.append(model.acceleration, none),
        beam_torque=np.append(model.beam_torque, none),
        sensor_torque=np.append(model.sensor_torque, none),
        sensed_torque=np.eye(1, n + more, n)[0],
        shear=np.append(model.shear, none),
        sensed_shear=np.eye(1, n + more, n + order)[0],
    )


def couple(
    realisation: Realisation | None,
    *,
    motor_inertia_kg_m2: float,
    viscous_nm_s_per_rad: float = 0.0,
    tool_inertia_kg_m2: float = 0.0,
    shear: StateOutput | None = None,
) -> CoupledModel:
    """Attach the beam, with the tool inertia in front of it, to a motor.

    Parameters
    ----------
    realisation
        The beam; None for the motor (and the clamp) alone.
    motor_inertia_kg_m2
        Inertia of motor and gear at the output shaft.
    viscous_nm_s_per_rad
        Viscous friction at the output shaft.
    tool_inertia_kg_m2
        Inertia between sensor and beam.
    shear
        Base shear of the beam; None leaves it out.
    """
    beam_states = 0 if realisation is None else realisation.b.size
    n = 2 + beam_states
    rigid_torque = np.zeros(n)  # Γ but for its part that is proportional to θ''
    direct_inertia = 0.0
    a = np.zeros((n, n))
    angle, velocity = np.eye(2, n)
    if realisation is not None:
        rigid_torque[0] = realisation.direct_stiffness_nm_per_rad
        rigid_torque[1] = realisation.direct_viscosity_nm_s_per_rad
        rigid_torque[2:] = realisation.c
        direct_inertia = realisation.direct_inertia_kg_m2
        a[2:, 2:] = realisation.a

    total_inertia = motor_inertia_kg_m2 + tool_inertia_kg_m2 + direct_inertia
    acceleration = -(rigid_torque + viscous_nm_s_per_rad * velocity) / total_inertia
    a[0] = velocity
    a[1] = acceleration
    b = velocity / total_inertia
    if realisation is not None:
        a[2:] += np.outer(realisation.b, acceleration)
        b[2:] = realisation.b / total_inertia
    sensed_inertia = direct_inertia + tool_inertia_kg_m2
    shear_row, shear_per_acceleration = np.zeros(n), 0.0
    if shear is not None:
        shear_per_acceleration = shear.per_acceleration
        shear_row = np.concatenate([[shear.per_angle, shear.per_velocity], shear.c])
        shear_row += shear_per_acceleration * acceleration
    return CoupledModel(
        a=a,
        b=b,
        angle=angle,
        velocity=velocity,
        acceleration=acceleration,
        acceleration_per_torque=1 / total_inertia,
        beam_torque=rigid_torque + direct_inertia * acceleration,
        beam_torque_per_torque=direct_inertia / total_inertia,
        sensor_torque=rigid_torque + sensed_inertia * acceleration,
        sensor_torque_per_torque=sensed_inertia / total_inertia,
        shear=shear_row,
        shear_per_torque=shear_per_acceleration / total_inertia,
    )


def propagator(model: CoupledModel, duration_s: float) -> tuple[Real, Real]:
    """Return phi and gamma of ``x(t + duration) = phi x(t) + gamma τ``, exact for a held τ.

    Parameters
    ----------
    model
        Motor and beam.
    duration_s
        Time for which τ is held.

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
    extended = np.zeros((n + 1, n + 1))
    extended[:n, :n] = model.a * duration_s
    extended[:n, n] = model.b * duration_s
    exponential = _expm(extended)
    return exponential[:n, :n], exponential[:n, n]


def held_inputs(model: CoupledModel, inputs: Real, duration_s: float) -> Real:
    """Return the state after inputs of 1 held over a duration, shape (n, inputs).

    Parameters
    ----------
    model
    inputs
        Effect of each on the state's derivative, shape (n, inputs).
    duration_s
    """
    n, m = inputs.shape
    extended = np.zeros((n + m, n + m))
    extended[:n, :n] = model.a * duration_s
    extended[:n, n:] = inputs * duration_s
    return _expm(extended)[:n, n:]


def _expm(matrix: Real) -> Real:
    """Return the matrix exponential by scaling and squaring with the [13/13] Padé approximant.

    Algorithm 2.3 of N. J. Higham, SIAM J. Matrix Anal. Appl. 26 (2005) 1179, without its low-order
    cases. scipy has the same, but importing it takes longer than all else a fast session starts.
    """
    norm = float(np.linalg.norm(matrix, 1))
    squarings = max(0, math.ceil(math.log2(norm / 5.37))) if norm > 0 else 0
    x = matrix / 2.0**squarings
    x2 = x @ x
    x4 = x2 @ x2
    powers = np.stack([np.eye(len(x)), x2, x4, x2 @ x4])  # of x²: 0, 1, 2, 3
    coefficient = np.cumprod([1.0] + [(13 - k) / ((26 - k) * (k + 1)) for k in range(13)])
    even, odd = (
        np.tensordot(coefficient[parity:8:2], powers, 1)
        + powers[3] @ np.tensordot(coefficient[8 + parity :: 2], powers[1:], 1)
        for parity in (0, 1)
    )
    odd = x @ odd
    result: Real = np.linalg.solve(even - odd, even + odd)
    for _ in range(squarings):
        result = result @ result
    return result
