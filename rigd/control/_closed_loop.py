"""The discrete closed loop of motor, beam, delays and controller: linear, exact at ticks.

The plant is propagated exactly for a torque that is constant between two switches. A switch is the
instant within a period at which a command takes effect after the actuation delay. Delayed
readings are the exact values of the earlier instant. Friction, quantisation, the torque limit and
noise are left out. A sensor that is read at the instant when a new torque takes effect shows the
effect of the old torque.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from math import exp, pi

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Damping, Plant, undamped_frequencies_rad_s
from rigd.beam.realisation import Realisation, realise
from rigd.control._control_law import control_law
from rigd.control._discrete_plant import DiscretePlant
from rigd.control._loop_model import LoopModel
from rigd.control._pid import ControlDesignError

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MAX_OSCILLATION_GROWTH_PER_S = 0.02
"""Largest growth rate of an oscillation of the loop in 1/s that is accepted, with a warning.

With any controller a beam of almost no damping leaves the loop slightly unstable: at a pole of
80 rad/s with damping ratios below 0.02 %, by up to 0.003 /s. At the accepted rate an oscillation
grows by 35 % over the 15 s of a ring-down, and from the noise floor by a factor of 15 in a session
of 136 s.
"""

MAX_DAMPING_REDUCTION = 0.004
"""Largest reduction of a beam mode's damping ratio by the controller.

It is checked on a beam of the same dimensions with almost no damping of its own: a loop that is
stable only through the damping to be measured is not safe, and its record shows little of the beam
near that mode. With feed-forward of the coupling torque the damping ratio of a mode falls by 0.0001
to 0.0015 (poles from 40 to 120 rad/s, gains from 0.8 to 1.2, torque readings up to 10 ms old).
Without feed-forward it falls by 0.0045 to 0.013.
"""

_LIGHT_DAMPING_RATIO = 1e-4
"""Damping ratio of the beam's first mode in the check of `MAX_DAMPING_REDUCTION`. It is not 0,
because rounding may make the realisation of an undamped beam unstable."""

_MAX_EIGENVALUE_OF_DELAY = 1e-9
"""Magnitude of an eigenvalue below which it belongs to a delay, which decays within a few ticks."""
_BLOCK_TICKS = 64  # ticks: fewer make the sequential part longer, more the products
_BLOCKS_PER_CHUNK = 4096
"""Number of blocks of ticks whose response is computed at once."""
_OUTPUT_ROWS = 5  # angle, velocity, torque without friction, reference speed, sensor torque


@dataclass(frozen=True, slots=True, eq=False)
class LoopResponse:
    """Response of the closed loop to a reference, with a value for each tick; arrays (n,)."""

    angle_rad: RealArray
    """Angle of the output shaft in rad."""
    velocity_rad_s: RealArray
    """Speed of the output shaft in rad/s."""
    torque_nm: RealArray
    """Torque command in N·m with friction compensation, without the limit of the motor."""
    coupling_torque_nm: RealArray
    """Coupling torque in N·m (beam and tool inertia), without the sensor's delay."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopOpening:
    """Signal at which the closed loop can be opened, to compute the gain of the open loop.

    The signal depends on the present state and acts on the next state. ``outer(action, reading)``
    is the part of the closed loop's state matrix that passes through the signal.
    """

    name: str
    """Name of the signal."""
    action_column: RealArray
    """Effect of one unit of the signal on the next state, shape (n,)."""
    reading_row: RealArray
    """Row vector that gives the signal from the state x, ``reading · x``; shape (n,)."""


@dataclass(frozen=True, slots=True, eq=False)
class ClosedLoop:
    """Closed loop as a discrete state space from the reference r to five quantities y.

    The equations are ``x[k+1] = a x[k] + b r[k]`` and ``y[k] = c x[k] + d r[k]``. The rows of y are
    angle (rad), velocity (rad/s), torque without friction compensation (N·m), the speed used by
    that compensation (rad/s), and the sensor's torque (N·m).
    """

    a: RealArray
    """State matrix, shape (n, n)."""
    b: RealArray
    """Input vector of the reference, shape (n,)."""
    c: RealArray
    """Output matrix, shape (5, n)."""
    d: RealArray
    """Direct effect of the reference on the outputs, shape (5,)."""
    model: LoopModel
    """Model from which the loop was computed."""
    openings: tuple[LoopOpening, ...]
    """Signals at which the loop can be opened: torque command, angle reading, torque reading."""
    poles_rad_s: ComplexArray
    """Poles of the loop in continuous time, the fastest growing (or slowest decaying) first."""
    shaft_torque_column: RealArray
    """Effect on the next state of 1 N·m on the shaft for one period, shape (n,)."""
    realisation: Realisation | None
    """State space of the beam, whose states follow angle and velocity in x; None: no beam."""

    @property
    def spectral_radius(self) -> float:
        """Largest magnitude of an eigenvalue of the state matrix; the loop is stable below 1."""
        return exp(self.growth_per_s / self.model.rate_hz)

    @property
    def growth_per_s(self) -> float:
        """Growth rate of the loop's fastest growing mode in 1/s; negative if all modes decay."""
        return float(self.poles_rad_s[0].real)

    def least_damped_pole(self) -> complex:
        """Return the pole of the closed loop with the lowest damping ratio, in rad/s."""
        return complex(min(self.poles_rad_s, key=_damping_ratio))

    def simulate(self, reference_rad: RealArray) -> LoopResponse:
        """Return the closed loop's response to a reference from rest, exact at the ticks.

        The record is divided into blocks of ticks. The response within a block is the sum of two
        matrix products: impulse response times reference, and free response times the state at the
        start of the block. Only these initial states are computed sequentially.

        Parameters
        ----------
        reference_rad
            Reference angle at each tick relative to the angle at rest, shape (n,).

        Raises
        ------
        ControlDesignError
            If the loop is unstable and the response overflows.
        """
        response = LoopResponse(*np.empty((len(fields(LoopResponse)), reference_rad.size)))
        chunk_end = 0
        for chunk in self.simulate_in_chunks(reference_rad):
            begin, chunk_end = chunk_end, chunk_end + chunk.angle_rad.size
            for response_field in fields(LoopResponse):
                getattr(response, response_field.name)[begin:chunk_end] = getattr(
                    chunk, response_field.name
                )
        return response

    def simulate_in_chunks(self, reference_rad: RealArray) -> Iterator[LoopResponse]:
        """Yield the response that `simulate` returns in consecutive chunks, which take less memory.

        Parameters
        ----------
        reference_rad
            Reference angle at each tick relative to the angle at rest, shape (n,).

        Raises
        ------
        ControlDesignError
            If the loop is unstable and the response overflows.
        """
        free_response, forced_response, state_step, reference_drive = self._block_matrices()
        block_state = np.zeros(self.b.size)
        chunk_ticks = _BLOCKS_PER_CHUNK * _BLOCK_TICKS
        for begin in range(0, reference_rad.size, chunk_ticks):
            chunk_reference_rad = reference_rad[begin : begin + chunk_ticks]
            block_count = -(-chunk_reference_rad.size // _BLOCK_TICKS)
            block_references = np.zeros((block_count, _BLOCK_TICKS))
            block_references.ravel()[: chunk_reference_rad.size] = chunk_reference_rad
            reference_effects = block_references @ reference_drive
            block_states = np.empty_like(reference_effects)
            for block_index in range(block_count):
                block_states[block_index] = block_state
                block_state = state_step @ block_state
                block_state += reference_effects[block_index]
            if not np.isfinite(block_state).all():
                raise ControlDesignError(
                    f"The closed loop is unstable and grows at {self.growth_per_s:.3g} /s: its "
                    "response cannot be computed."
                )
            output_rows = np.empty((_OUTPUT_ROWS, block_count, _BLOCK_TICKS))
            for row in range(_OUTPUT_ROWS):
                np.matmul(block_references, forced_response[row], out=output_rows[row])
                output_rows[row] += block_states @ free_response[row]
            angle_rad, velocity_rad_s, torque_nm, friction_speed_rad_s, coupling_torque_nm = (
                output_rows.reshape(_OUTPUT_ROWS, -1)[:, : chunk_reference_rad.size]
            )
            settings = self.model.settings
            friction_speed_rad_s /= settings.friction_velocity_rad_s
            np.tanh(friction_speed_rad_s, out=friction_speed_rad_s)
            friction_speed_rad_s *= settings.friction_compensation_nm
            torque_nm += friction_speed_rad_s
            yield LoopResponse(angle_rad, velocity_rad_s, torque_nm, coupling_torque_nm)

    def response(self, frequency_hz: RealArray) -> ComplexArray:
        """Return the complex frequency response from reference to angle at given frequencies.

        The result has the shape of the frequencies.
        """
        z = np.exp(2j * pi * np.atleast_1d(frequency_hz) / self.model.rate_hz)
        identity_matrix = np.eye(self.b.size)
        response_values = [
            self.c[0] @ np.linalg.solve(unit_circle_point * identity_matrix - self.a, self.b)
            + self.d[0]
            for unit_circle_point in z.ravel()
        ]
        return np.array(response_values).reshape(np.shape(frequency_hz))

    def _block_matrices(self) -> tuple[RealArray, RealArray, RealArray, RealArray]:
        """Return the matrices that compute the response of a block of L ticks.

        They are the free response (5, n, L) to the state at the start of the block, the forced
        response (5, L, L) to the reference, and the effects of this state (n, n) and of the
        reference (L, n) on the state at the start of the next block.
        """
        n = self.b.size
        free_response = np.empty((_BLOCK_TICKS, _OUTPUT_ROWS, n))  # c aⁱ
        reference_drive = np.empty((_BLOCK_TICKS, n))  # aⁱ b, turned round at the end
        free_response[0], reference_drive[0] = self.c, self.b
        matrix_power, rows_done = self.a, 1
        while rows_done < _BLOCK_TICKS:  # doubling: rows i + done from rows i
            free_response[rows_done : 2 * rows_done] = free_response[:rows_done] @ matrix_power
            reference_drive[rows_done : 2 * rows_done] = (
                reference_drive[:rows_done] @ matrix_power.T
            )
            matrix_power = matrix_power @ matrix_power
            rows_done *= 2
        impulse_response = np.empty((_OUTPUT_ROWS, _BLOCK_TICKS))
        impulse_response[:, 0] = self.d
        impulse_response[:, 1:] = reference_drive[:-1].dot(self.c.T).T
        forced_response = np.zeros((_OUTPUT_ROWS, _BLOCK_TICKS, _BLOCK_TICKS))
        for tick_number in range(_BLOCK_TICKS):
            forced_response[:, tick_number, tick_number:] = impulse_response[
                :, : _BLOCK_TICKS - tick_number
            ]
        free_response_by_row = np.ascontiguousarray(free_response.transpose(1, 2, 0))
        return (
            free_response_by_row,
            forced_response,
            np.ascontiguousarray(matrix_power),
            reference_drive[::-1].copy(),
        )


def close_loop(model: LoopModel) -> ClosedLoop:
    """Return the closed loop of a rig with the controller designed for it.

    Parameters
    ----------
    model
        Parameters of the loop, from :meth:`rigd.profile.Profile.loop_model`.

    Returns
    -------
    ClosedLoop
        Closed loop, which may be unstable: see :func:`check_stability`.

    Raises
    ------
    ControlDesignError
        If the controller cannot be designed, or a delay is too long.
    RealisationError
        If the beam's damping cannot be realised.

    Examples
    --------
    >>> from rigd.control import close_loop
    >>> from rigd.profile import load_profile
    >>> loop = close_loop(load_profile("sim").loop_model())
    >>> loop.spectral_radius < 1
    True
    """
    law = control_law(model)
    realisation = None if model.plant is None else realise(model.plant)
    discrete_plant = DiscretePlant(model, realisation)
    n, size = discrete_plant.a.shape[0], discrete_plant.a.shape[0] + len(law.a)

    # States: plant, then controller.
    a, b = np.zeros((size, size)), np.zeros(size)
    measured_angle_row, measured_torque_row, command_column = np.zeros((3, size))
    measured_angle_row[:n] = discrete_plant.measured_angle
    measured_torque_row[:n] = discrete_plant.measured_torque
    command_column[:n] = discrete_plant.b
    output_rows = np.outer(law.d[:, 1], measured_angle_row) + np.outer(
        law.d[:, 2], measured_torque_row
    )
    output_rows[:, n:] = law.c
    torque_row = output_rows[0]

    angle_action_column = law.d[0, 1] * command_column
    angle_action_column[n:] = law.b[:, 1]
    torque_action_column = law.d[0, 2] * command_column
    torque_action_column[n:] = law.b[:, 2]
    openings = (
        LoopOpening("torque command", command_column, torque_row),
        LoopOpening("angle reading", angle_action_column, measured_angle_row),
        LoopOpening("torque reading", torque_action_column, measured_torque_row),
    )

    a[:n, :n] = discrete_plant.a
    a[:n] += np.outer(discrete_plant.b, torque_row)
    b[:n] = discrete_plant.b * law.d[0, 0]
    a[n:] = np.outer(law.b[:, 1], measured_angle_row) + np.outer(law.b[:, 2], measured_torque_row)
    a[n:, n:] = law.a
    b[n:] = law.b[:, 0]

    c = np.zeros((_OUTPUT_ROWS, size))
    c[0, :n], c[1, :n], c[4, :n] = (
        discrete_plant.angle,
        discrete_plant.velocity,
        discrete_plant.sensor_torque,
    )
    c[2:4] = output_rows
    d = np.array([0.0, 0.0, law.d[0, 0], law.d[1, 0], 0.0])

    loop_poles = continuous_poles(a, model.rate_hz)
    return ClosedLoop(
        a,
        b,
        c,
        d,
        model,
        openings,
        loop_poles[np.argsort(-loop_poles.real)],
        np.append(discrete_plant.shaft_torque_column, np.zeros(len(law.a))),
        realisation,
    )


def continuous_poles(a: RealArray, rate_hz: float) -> ComplexArray:
    """Return the poles in continuous time, in rad/s, of the system ``x[k+1] = a x[k]``."""
    eigenvalues = np.linalg.eigvals(a).astype(complex)
    # Delays have eigenvalues at zero, which decay within a few ticks.
    poles: ComplexArray = (
        np.log(eigenvalues[np.abs(eigenvalues) > _MAX_EIGENVALUE_OF_DELAY]) * rate_hz
    )
    return poles


def check_stability(closed_loop: ClosedLoop) -> str | None:
    """Return a warning if a closed loop is slightly unstable, else None; raise if it is clearly so.

    Returns
    -------
    str or None
        A warning if the loop is unstable, but so slowly that a session is possible.

    Raises
    ------
    ControlDesignError
        If an oscillation of the loop grows faster than `MAX_OSCILLATION_GROWTH_PER_S`, or
        would do so without the beam's own damping (`MAX_DAMPING_REDUCTION`).
    """
    remedy_text = _stability_remedy(closed_loop.model)
    growth_rate_per_s = closed_loop.growth_per_s
    instability_text = (
        "The closed loop of motor, beam and delays is unstable (spectral radius "
        f"{closed_loop.spectral_radius:.7f}): {_describe_pole(closed_loop.poles_rad_s[0])} grows "
        f"at {growth_rate_per_s:.2g} /s"
    )
    if growth_rate_per_s > MAX_OSCILLATION_GROWTH_PER_S:
        raise ControlDesignError(f"{instability_text}; {remedy_text}.")
    if (plant := closed_loop.model.plant) is not None:
        lightly_damped_loop = close_loop(lightly_damped_model(closed_loop.model, plant))
        least_damped_pole = lightly_damped_loop.least_damped_pole()
        if _damping_ratio(least_damped_pole) < _LIGHT_DAMPING_RATIO - MAX_DAMPING_REDUCTION:
            raise ControlDesignError(
                "The closed loop is stable only by the beam's own damping: without it (spectral "
                f"radius {lightly_damped_loop.spectral_radius:.7f}), "
                f"{_describe_pole(least_damped_pole)} grows at {least_damped_pole.real:.2g} /s; "
                f"{remedy_text}."
            )
    if growth_rate_per_s <= 0.0:
        return None
    return (
        f"{instability_text}, which is accepted up to "
        f"{MAX_OSCILLATION_GROWTH_PER_S:g} /s; this happens if the "
        "beam has almost no damping, so keep sessions short."
    )


def stable_loop(model: LoopModel) -> tuple[ClosedLoop, str | None]:
    """Return the closed loop of a rig and a stability warning; raise if the loop is unstable.

    The results for the last few models are cached, because the check of a rig and the planning of a
    session need the same loop.

    Parameters
    ----------
    model
        Parameters of the loop, from :meth:`rigd.profile.Profile.loop_model`.

    Returns
    -------
    loop : ClosedLoop
        Closed loop.
    warning : str or None
        Warning of `check_stability`.

    Raises
    ------
    ControlDesignError
        As `close_loop` and `check_stability`.
    RealisationError
        If the beam's damping cannot be realised.
    """
    return _stable_loop(model)


@lru_cache(maxsize=4)
def _stable_loop(model: LoopModel) -> tuple[ClosedLoop, str | None]:
    """Return the closed loop and the warning of `check_stability`, cached by loop model."""
    closed_loop = close_loop(model)
    return closed_loop, check_stability(closed_loop)


def _stability_remedy(model: LoopModel) -> str:
    """Return the end of a message: how to change the settings of an unstable controller."""
    settings = model.settings
    if model.controller is not None:
        return (
            f"change the settings of [{settings.controller}], or choose another controller "
            '(control.controller = "pid")'
        )
    if settings.feedforward_gain < 0.5:
        return (
            f"control.feedforward_gain = {settings.feedforward_gain:g} leaves the beam's torque "
            "to the integral action; set it to 1"
        )
    return (
        f"change control.pole_rad_s = {settings.pole_rad_s:g} rad/s, bring "
        f"control.feedforward_gain = {settings.feedforward_gain:g} nearer to 1, or shorten the "
        "delays of command and readings"
    )


def lightly_damped_model(model: LoopModel, plant: Plant) -> LoopModel:
    """Return the model of a closed loop with a plant whose damping is replaced by almost none."""
    first_mode_rad_s = float(undamped_frequencies_rad_s(plant.beam, 1)[0])
    damping = Damping(zeta=2.0 * _LIGHT_DAMPING_RATIO / first_mode_rad_s)
    return replace(model, plant=replace(plant, damping=damping))


def _damping_ratio(pole_rad_s: complex) -> float:
    """Return the damping ratio of a pole in rad/s, as a fraction of critical damping."""
    return -pole_rad_s.real / abs(pole_rad_s)


def _describe_pole(pole_rad_s: complex) -> str:
    """Return frequency in Hz and damping ratio of a pole, as text for a message."""
    frequency_hz = abs(pole_rad_s.imag) / (2.0 * pi)
    return f"a mode at {frequency_hz:.3g} Hz with damping ratio {_damping_ratio(pole_rad_s):.2g}"
