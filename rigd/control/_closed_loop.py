"""The discrete closed loop of motor, beam, delays, feed-forward and PID: linear, exact at ticks.

The plant is propagated exactly under the held torque, with the instant inside a period at which the
actuation delay passes a command; delayed readings are the exact values of that earlier instant.
Friction, quantisation, the torque limit and noise are left out. A sensor that is read at the
instant a new torque takes effect sees the old one.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from math import exp, floor, pi

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Beam, Damping, LoadedBeam, undamped_frequencies_rad_s
from rigd.beam.realisation import Realisation, couple, propagator, realise
from rigd.control._pid import (
    ControlDesignError,
    ControlSettings,
    derivative_coefficients,
    design_pid,
    lowpass_coefficients,
)

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]

MAX_GROWTH_PER_S = 0.02
"""Fastest accepted growth of the loop, with a warning.

A beam with almost no damping leaves the loop slightly unstable with any controller (below 0.02 % at
a pole of 80 rad/s, at up to 0.003 /s). At the rate allowed here an oscillation grows by 35 % over
the 15 s of a ring-down, and from the noise floor by a factor of 15 in a session of 136 s.
"""

MAX_DAMPING_TAKEN = 0.004
"""Largest damping ratio that the controller may take from a mode of the beam.

Checked on a beam of the same dimensions with almost no damping of its own: a loop that is stable
only through the damping to be measured is not safe, and its record shows little of the beam near
that mode. With feed-forward of the coupling torque a mode loses 0.0001 to 0.0015 (poles from 40 to
120 rad/s, gains from 0.8 to 1.2, torque readings up to 10 ms old); without, 0.0045 to 0.013.
"""

_LIGHT_DAMPING_RATIO = 1e-4
"""Damping of the beam in that check: rounding may make an undamped realisation unstable."""

MAX_DELAY_PERIODS = 50
"""Longest delay in the model: every period of delay is one more state."""

_DEAD = 1e-9
_BLOCK = 64  # ticks: fewer make the sequential part longer, more the products
_BLOCKS_AT_ONCE = 4096
_ROWS = 5  # angle, velocity, torque without friction, reference speed, sensor torque


@dataclass(frozen=True, slots=True)
class LoopModel:
    """Parameters of the closed loop."""

    rate_hz: float
    """Ticks a second."""
    beam: Beam | None
    """None: the motor alone."""
    damping: Damping
    """Damping of the beam."""
    motor_inertia_kg_m2: float
    """At the output shaft."""
    viscous_nm_s_per_rad: float
    """Viscous friction of the motor, at the output shaft."""
    tool_inertia_kg_m2: float
    """Inertia between torque sensor and beam."""
    actuation_delay_s: float
    """Delay from a tick to the instant its command takes effect; any fraction of a period."""
    angle_delay_s: float
    """Age of the angle at the tick that uses it."""
    torque_delay_s: float
    """Age of the coupling torque at the tick that uses it."""
    settings: ControlSettings
    """Settings of the controller."""
    tip_mass_kg: float = 0.0
    """Point mass at the beam's tip."""
    root_compliance_rad_per_nm: float = 0.0
    """Rotation of the clamp per torque on the beam's root."""
    stiffness_offsets: tuple[float, ...] = ()
    """Relative differences of the stiffness of modes 2, 3, … from the uniform beam's."""

    @property
    def loaded_beam(self) -> LoadedBeam:
        """The beam with tip mass and root compliance; a loop without a beam has none."""
        assert self.beam is not None
        return LoadedBeam(
            self.beam,
            self.damping,
            self.tip_mass_kg,
            self.root_compliance_rad_per_nm,
            self.stiffness_offsets,
        )


@dataclass(frozen=True, slots=True, eq=False)
class LoopResponse:
    """Response of the loop, tick by tick; each of shape (n,)."""

    angle_rad: Real
    """At the output shaft."""
    velocity_rad_s: Real
    """At the output shaft."""
    torque_nm: Real
    """The command, friction compensation included, not limited."""
    coupling_torque_nm: Real
    """Measured torque (beam and tool inertia), without the sensor's delay."""


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """A signal at which the loop can be opened: it is read from the state and acts on the next.

    ``outer(action, reading)`` is the part of the closed loop's matrix through the cut.
    """

    name: str
    action: Real
    """(n,): effect of one unit of the signal on the next state."""
    reading: Real
    """(n,): the signal is ``reading · x``."""


@dataclass(frozen=True, slots=True, eq=False)
class ClosedLoop:
    """``x[k+1] = a x[k] + b r[k]``, ``y[k] = c x[k] + d r[k]`` from the reference.

    The rows of y are angle (rad), velocity (rad/s), torque without friction compensation (N·m),
    the speed used by that compensation (rad/s), and the sensor's torque (N·m).
    """

    a: Real
    """(n, n)."""
    b: Real
    """(n,)."""
    c: Real
    """(5, n)."""
    d: Real
    """(5,)."""
    model: LoopModel
    """Model from which it was computed."""
    cuts: tuple[Cut, ...]
    """The torque command, the angle and the coupling torque as the controller reads them."""
    poles_rad_s: Complex
    """Its modes as continuous-time poles, the fastest growing (or slowest decaying) first."""
    shaft_torque: Real
    """(n,): effect on the next state of 1 N·m on the shaft, held for a period."""
    realisation: Realisation | None
    """The beam, whose states follow angle and velocity in x; None: the motor alone."""

    @property
    def spectral_radius(self) -> float:
        """Largest magnitude of an eigenvalue of `a`: the loop is stable below 1."""
        return exp(self.growth_per_s / self.model.rate_hz)

    @property
    def growth_per_s(self) -> float:
        """Growth rate of the dominating mode (negative: decays), in 1/s."""
        return float(self.poles_rad_s[0].real)

    def least_damped(self) -> complex:
        """Return the pole with the lowest damping ratio, in rad/s."""
        return complex(min(self.poles_rad_s, key=_damping_ratio))

    def simulate(self, reference_rad: Real) -> LoopResponse:
        """Return the response to a reference from rest, exact at the ticks.

        The record is divided into blocks. Within a block the response is a product of matrices (the
        block's impulse response with the reference, and its free response with the state at its
        start); only these states are computed one after the other.

        Parameters
        ----------
        reference_rad
            Shape (n,), relative to the angle at rest.

        Raises
        ------
        ControlDesignError
            If the loop is unstable and the response overflows.
        """
        n = reference_rad.size
        blocks = -(-n // _BLOCK)
        padded = np.zeros((blocks, _BLOCK))
        padded.ravel()[:n] = reference_rad
        rows = np.empty((_ROWS, blocks * _BLOCK))
        free, forced, step, drive = self._block_matrices()
        state = np.zeros(self.b.size)
        for first in range(0, blocks, _BLOCKS_AT_ONCE):
            part = padded[first : first + _BLOCKS_AT_ONCE]
            driven = part @ drive
            states = np.empty_like(driven)
            for index in range(len(part)):
                states[index] = state
                state = step @ state
                state += driven[index]
            if not np.isfinite(state).all():
                raise ControlDesignError(
                    f"The closed loop is unstable and grows at {self.growth_per_s:.3g} /s: its "
                    "response cannot be computed."
                )
            for row in range(_ROWS):
                out = rows[row].reshape(blocks, _BLOCK)[first : first + len(part)]
                np.matmul(part, forced[row], out=out)
                out += states @ free[row]
        del padded
        angle, velocity, torque, speed, coupling = rows[:, :n]
        settings = self.model.settings
        # Without a copy: an hour of record takes 30 MB a channel.
        speed /= settings.friction_velocity_rad_s
        np.tanh(speed, out=speed)
        speed *= settings.friction_compensation_nm
        torque += speed
        return LoopResponse(angle, velocity, torque, coupling)

    def response(self, frequency_hz: Real) -> Complex:
        """Return angle over reference, complex, in the shape of the frequencies."""
        z = np.exp(2j * pi * np.atleast_1d(frequency_hz) / self.model.rate_hz)
        identity = np.eye(self.b.size)
        values = [
            self.c[0] @ np.linalg.solve(point * identity - self.a, self.b) + self.d[0]
            for point in z.ravel()
        ]
        return np.array(values).reshape(np.shape(frequency_hz))

    def _block_matrices(self) -> tuple[Real, Real, Real, Real]:
        """Return free (5, n, L) and forced (5, L, L) response, step (n, n) and drive (L, n)."""
        n = self.b.size
        free = np.empty((_BLOCK, _ROWS, n))  # c aⁱ
        drive = np.empty((_BLOCK, n))  # aⁱ b, turned round at the end
        free[0], drive[0] = self.c, self.b
        power, done = self.a, 1
        while done < _BLOCK:  # doubling: rows i + done from rows i
            free[done : 2 * done] = free[:done] @ power
            drive[done : 2 * done] = drive[:done] @ power.T
            power = power @ power
            done *= 2
        impulse = np.empty((_ROWS, _BLOCK))
        impulse[:, 0] = self.d
        impulse[:, 1:] = drive[:-1].dot(self.c.T).T
        forced = np.zeros((_ROWS, _BLOCK, _BLOCK))
        for tick in range(_BLOCK):
            forced[:, tick, tick:] = impulse[:, : _BLOCK - tick]
        free_by_row = np.ascontiguousarray(free.transpose(1, 2, 0))
        return free_by_row, forced, np.ascontiguousarray(power), drive[::-1].copy()


def close_loop(model: LoopModel) -> ClosedLoop:
    """Close the loop of a rig around its designed controller.

    Parameters
    ----------
    model
        From :meth:`rigd.profile.Profile.loop_model`.

    Returns
    -------
    ClosedLoop
        Stable or not: see :func:`check_stability`.

    Raises
    ------
    ControlDesignError
        If the controller cannot be designed, or a delay is out of proportion.
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
    settings = model.settings
    gains = design_pid(model.motor_inertia_kg_m2, model.viscous_nm_s_per_rad, settings.pole_rad_s)
    realisation = (
        None
        if model.beam is None
        else realise(
            model.beam,
            model.damping,
            tip_mass_kg=model.tip_mass_kg,
            root_compliance_rad_per_nm=model.root_compliance_rad_per_nm,
            stiffness_offsets=model.stiffness_offsets,
        )
    )
    plant = _Plant(model, realisation)
    n = plant.a.shape[0]

    # States: plant, integral, derivative, two low-pass filters of the reference.
    integral, derivative, fast, slow = range(n, n + 4)
    period_s = 1.0 / model.rate_hz
    ki_t = gains.ki_nm_per_rad_s * period_s
    decay_d, gain_d = derivative_coefficients(gains, model.rate_hz)
    b_p, b_d, kp = gains.setpoint_weight_p, gains.setpoint_weight_d, gains.kp_nm_per_rad

    a = np.zeros((n + 4, n + 4))
    b = np.zeros(n + 4)
    measured_angle, measured_torque, command = np.zeros((3, n + 4))
    measured_angle[:n] = plant.measured_angle
    measured_torque[:n] = plant.measured_torque
    command[:n] = plant.b

    # The integral carries Ki T/2 of the last error, the derivative its decayed last step.
    torque_from_angle = -(kp + 0.5 * ki_t + gain_d)
    torque_from_reference = kp * b_p + 0.5 * ki_t + gain_d * b_d
    torque = torque_from_angle * measured_angle + settings.feedforward_gain * measured_torque
    torque[[integral, derivative]] = 1.0

    from_angle = torque_from_angle * command
    from_angle[integral] = -ki_t
    from_angle[derivative] = -(decay_d - 1.0) * gain_d
    cuts = (
        Cut("torque command", command, torque),
        Cut("angle reading", from_angle, measured_angle),
        Cut("torque reading", settings.feedforward_gain * command, measured_torque),
    )

    a[:n, :n] = plant.a
    a[:n] += np.outer(plant.b, torque)
    b[:n] = plant.b * torque_from_reference
    a[integral] = -ki_t * measured_angle
    a[integral, integral] += 1.0
    b[integral] = ki_t
    a[derivative] = -(decay_d - 1.0) * gain_d * measured_angle
    a[derivative, derivative] += decay_d
    b[derivative] = (decay_d - 1.0) * gain_d * b_d

    # Low-pass filters: output = state + gain · input, next state = decay · output + gain · input.
    decay, gain = lowpass_coefficients(settings, model.rate_hz)
    a[fast, fast] = decay
    b[fast] = gain * (decay + 1.0)
    a[slow, slow] = decay
    a[slow, fast] = gain * (decay + 1.0)
    b[slow] = gain * gain * (decay + 1.0)
    speed = np.zeros(n + 4)
    speed[fast], speed[slow] = settings.pole_rad_s * (1.0 - gain), -settings.pole_rad_s
    speed_from_reference = settings.pole_rad_s * (gain - gain * gain)

    c = np.zeros((_ROWS, n + 4))
    c[0, :n], c[1, :n], c[4, :n] = plant.angle, plant.velocity, plant.sensor_torque
    c[2], c[3] = torque, speed
    d = np.array([0.0, 0.0, torque_from_reference, speed_from_reference, 0.0])

    poles = continuous_poles(a, model.rate_hz)
    return ClosedLoop(
        a,
        b,
        c,
        d,
        model,
        cuts,
        poles[np.argsort(-poles.real)],
        np.append(plant.shaft_torque, np.zeros(4)),
        realisation,
    )


def continuous_poles(a: Real, rate_hz: float) -> Complex:
    """Return the modes of ``x[k+1] = a x[k]`` as poles in continuous time, in rad/s.

    Parameters
    ----------
    a
        Shape (n, n).
    rate_hz
        Ticks a second.
    """
    eigenvalues = np.linalg.eigvals(a).astype(complex)
    # Delays have eigenvalues at zero, which decay within a few ticks.
    poles: Complex = np.log(eigenvalues[np.abs(eigenvalues) > _DEAD]) * rate_hz
    return poles


def check_stability(loop: ClosedLoop) -> str | None:
    """Check the stability of a closed loop before anything moves.

    Returns
    -------
    str or None
        A warning if the loop is unstable, but so slowly that a session is possible.

    Raises
    ------
    ControlDesignError
        If the loop grows faster than `MAX_GROWTH_PER_S`, or would do so without the beam's own
        damping (`MAX_DAMPING_TAKEN`).
    """
    remedy = _remedy(loop.model.settings)
    growth = loop.growth_per_s
    finding = (
        "The closed loop of motor, beam and delays is unstable (spectral radius "
        f"{loop.spectral_radius:.7f}): {_describe(loop.poles_rad_s[0])} grows at {growth:.2g} /s"
    )
    if growth > MAX_GROWTH_PER_S:
        raise ControlDesignError(f"{finding}; {remedy}.")
    if loop.model.beam is not None:
        light = close_loop(light_beam(loop.model, loop.model.beam))
        pole = light.least_damped()
        if _damping_ratio(pole) < _LIGHT_DAMPING_RATIO - MAX_DAMPING_TAKEN:
            raise ControlDesignError(
                "The closed loop is stable only by the beam's own damping: without it (spectral "
                f"radius {light.spectral_radius:.7f}), {_describe(pole)} grows at "
                f"{pole.real:.2g} /s; {remedy}."
            )
    if growth <= 0.0:
        return None
    return (
        f"{finding}, which is accepted up to {MAX_GROWTH_PER_S:g} /s; a beam with almost no "
        "damping does that, so keep sessions short."
    )


def stable_loop(model: LoopModel) -> tuple[ClosedLoop, str | None]:
    """Close the loop of a rig, and raise if it is unstable.

    The results for the last few models are cached: the check of a rig and the planning of a session
    need the same one.

    Parameters
    ----------
    model
        From :meth:`rigd.profile.Profile.loop_model`.

    Returns
    -------
    loop : ClosedLoop
        The loop.
    warning : str or None
        From `check_stability`.

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
    loop = close_loop(model)
    return loop, check_stability(loop)


def _remedy(settings: ControlSettings) -> str:
    if settings.feedforward_gain < 0.5:
        return (
            f"control.feedforward_gain = {settings.feedforward_gain:g} leaves the beam to the "
            "integral action, set it to 1"
        )
    return (
        f"change control.pole_rad_s = {settings.pole_rad_s:g} rad/s, bring "
        f"control.feedforward_gain = {settings.feedforward_gain:g} nearer to 1, or shorten the "
        "delays of command and readings"
    )


def light_beam(model: LoopModel, beam: Beam) -> LoopModel:
    """Return a loop's model with a beam that has almost no damping.

    Parameters
    ----------
    model
        The loop.
    beam
        The beam.
    """
    first_mode_rad_s = float(undamped_frequencies_rad_s(beam, 1)[0])
    return replace(
        model, beam=beam, damping=Damping(zeta=2.0 * _LIGHT_DAMPING_RATIO / first_mode_rad_s)
    )


def _damping_ratio(pole_rad_s: complex) -> float:
    return -pole_rad_s.real / abs(pole_rad_s)


def _describe(pole_rad_s: complex) -> str:
    frequency_hz = abs(pole_rad_s.imag) / (2.0 * pi)
    return f"a mode at {frequency_hz:.3g} Hz with damping ratio {_damping_ratio(pole_rad_s):.2g}"


class _Plant:
    """Motor, beam and delays in discrete time: ``z[k+1] = a z[k] + b u[k]``.

    The state is that of the coupled model, the last commands (newest first), and chains of past
    readings. No reading depends on the command of its own tick.
    """

    def __init__(self, model: LoopModel, realisation: Realisation | None) -> None:
        coupled = couple(
            realisation,
            motor_inertia_kg_m2=model.motor_inertia_kg_m2,
            viscous_nm_s_per_rad=model.viscous_nm_s_per_rad,
            tool_inertia_kg_m2=model.tool_inertia_kg_m2,
        )
        period_s = 1.0 / model.rate_hz
        whole, part = _split(model.actuation_delay_s, period_s, "actuation.delay_s")
        angle_chain = _split(model.angle_delay_s, period_s, "encoder.delay_s")
        torque_chain = _split(model.torque_delay_s, period_s, "sensor.delay_s")
        n = coupled.b.size
        commands = whole + 1
        lengths = [w + (1 if f > 0.0 else 0) for w, f in (angle_chain, torque_chain)]
        size = n + commands + sum(lengths)

        # Columns of the torque before and after the switch within a period. Without a whole period
        # of delay the command after it is the tick's own: the input column, last.
        before = n + whole
        after = before - 1 if whole else size
        switch_s = part * period_s
        extended = np.zeros((size, size + 1))

        def advance(duration_s: float) -> tuple[Real, int]:
            """Return the state (n, size + 1) a time after a tick, and the torque's column then."""
            state, column = np.eye(n, size + 1), before
            for interval_s, acting in (
                (min(duration_s, switch_s), before),
                (duration_s - switch_s, after),
            ):
                if interval_s > 0.0:
                    phi, gamma = propagator(coupled, interval_s)
                    state = phi @ state
                    state[:, acting] += gamma
                    column = acting
            return state, column

        def read(row: Real, per_torque: float, since_tick_s: float = 0.0) -> Real:
            """Return the row (size + 1,) of a sensor's reading a time after a tick."""
            state, column = advance(since_tick_s)
            reading: Real = row @ state
            reading[column] += per_torque
            return reading

        extended[:n] = advance(period_s)[0]
        self.shaft_torque = np.append(propagator(coupled, period_s)[1], np.zeros(size - n))
        extended[n, size] = 1.0
        for command in range(1, commands):
            extended[n + command, n + command - 1] = 1.0

        angle = (coupled.angle, 0.0)
        sensor_torque = (coupled.sensor_torque, coupled.sensor_torque_per_torque)
        self.angle = read(*angle)[:size]
        self.velocity = read(coupled.velocity, 0.0)[:size]
        self.sensor_torque = read(*sensor_torque)[:size]

        measured = []
        first = n + commands
        for (_, fraction), length, quantity, undelayed in (
            (angle_chain, lengths[0], angle, self.angle),
            (torque_chain, lengths[1], sensor_torque, self.sensor_torque),
        ):
            if length == 0:
                measured.append(undelayed)
                continue
            # The chain's first link: the reading of the last tick, or one from the period since.
            since_tick = 1.0 - fraction if fraction > 0.0 else 0.0
            extended[first] = read(*quantity, since_tick * period_s)
            for link in range(first + 1, first + length):
                extended[link, link - 1] = 1.0
            measured.append(np.eye(size)[first + length - 1])
            first += length
        self.measured_angle, self.measured_torque = measured
        self.a = extended[:, :size]
        self.b = extended[:, size]


def _split(delay_s: float, period_s: float, key: str) -> tuple[int, float]:
    """Return the whole periods of a delay, and the remainder as a fraction of a period."""
    periods = delay_s / period_s
    if periods > MAX_DELAY_PERIODS:
        raise ControlDesignError(
            f"{key} = {delay_s:g} s is {periods:.4g} periods; at most {MAX_DELAY_PERIODS} can be "
            "controlled over."
        )
    whole = floor(periods + 1e-9)
    part = periods - whole
    return whole, part if part > 1e-9 else 0.0
