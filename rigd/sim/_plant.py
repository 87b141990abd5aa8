"""Physics of the simulated rig: motor, clamp and beam between two ticks.

Motor and beam are one linear model, stepped exactly for torques that are constant between the
instants at which commands arrive. Coulomb friction, saturation and delays are added to it.
Quantisation and noise are those of the simulated devices, not of the plant.
"""

from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rigd.beam.realisation import Realisation
from rigd.devices.obstacles import (
    INCOMPATIBLE_WITH_OBSTACLES,
    Disturbance,
    check_obstacles,
    parse_obstacle,
)
from rigd.devices.parameters import RigParameters, Simulation
from rigd.sim._air_brake import AirBrake
from rigd.sim._obstacle import AttachedObstacles, March
from rigd.sim._step import OUTPUTS, arrays_at, held_of, models_of, split_delay, steps_of
from rigd.sim._stiffness_drift import StiffnessDrift

Real = NDArray[np.float64]

_OF_OBSTACLES = (
    "_contact", "_free", "_free_march", "_friction_effects", "_locked", "_locked_march", "_states",
)  # fmt: skip
"""Parts of a plant that depend on what its beam meets."""

_FRICTION_SWEEPS = 4
_SAME_FRICTION = 1e-3
"""Change of the Coulomb friction, as a fraction of the whole, that the contact may neglect."""

_STENCIL = 4
"""Readings through which the value between two of them is taken."""


class SimulatedPlant:
    """The rig that `parameters` describes, at rest at angle zero, drive off.

    At tick k the caller reads the attributes, gives the torque of that tick to `command`, and calls
    `advance` to be at the next tick.

    Parameters
    ----------
    parameters
        Parameters of the rig. Delays may be any non-negative time, also a fraction of a period.

    Attributes
    ----------
    angle_rad, velocity_rad_s : float
        Angle and speed of the output shaft at this instant.
    coupling_torque_nm : float
        What an ideal sensor between motor and clamp measures at this instant, ``Γ + J_tool θ''``.
        It jumps with the motor's torque. At a jump the mean of both sides is given, which is where
        a band-limited signal passes, if the torque after it is known by now (an actuation delay of
        at least one period); else the value just before it.
    base_shear_n : float
        Force of the motor on the beam at this instant, positive towards a positive angle. At a jump
        of the torque it is as the torque is.
    sensed_angle_rad, sensed_torque_nm, sensed_shear_n : float
        The same angle, torque and shear `encoder.delay_s` and `sensor.delay_s` ago: what the
        devices have to show at this tick.
    enabled : bool
        Whether the drive is on.

    Raises
    ------
    RealisationError
        If the beam's damping cannot be realised, at the stiffness that it drifts to included.
    ObstacleError
        If an obstacle has a syntax error, or lies beyond the beam's tip.

    Notes
    -----
    Coulomb friction is constant over a period and implicit: the torque, of at most T_c, that takes
    the shaft's speed at the period's end nearest to zero. A shaft so brought to rest is locked, and
    the beam vibrates on a fixed root, until at the start of a period the torques on it exceed T_c.
    """

    __slots__ = (
        "_air",
        "_contact",
        "_coulomb_nm",
        "_direct_fraction",
        "_direct_nm",
        "_direct_shear_fraction",
        "_direct_shear_n",
        "_drift",
        "_fraction_before_switch",
        "_free",
        "_free_march",
        "_friction_effects",
        "_friction_nm",
        "_friction_speed",
        "_holding_beam_nm",
        "_jump_gain",
        "_jump_is_sensed",
        "_locked",
        "_locked_march",
        "_next_is_known",
        "_peak_nm",
        "_period_s",
        "_periods",
        "_rest_per_angle",
        "_sensed_angles",
        "_sensed_jump_gain",
        "_sensed_shear_jump_gain",
        "_sensed_shears",
        "_sensed_torques",
        "_shear_jump_gain",
        "_states",
        "_stuck",
        "_torque_instant_fraction",
        "_torque_nm",
        "_torques",
        "_vectors",
        "angle_rad",
        "base_shear_n",
        "coupling_torque_nm",
        "enabled",
        "sensed_angle_rad",
        "sensed_shear_n",
        "sensed_torque_nm",
        "velocity_rad_s",
    )

    def __init__(self, parameters: RigParameters) -> None:
        period = 1 / parameters.rate_hz
        periods, switch = split_delay(parameters.actuation.delay_s, period)
        angle_periods, angle_age = split_delay(parameters.encoder.delay_s, period)
        torque_periods, torque_age = split_delay(parameters.sensor.delay_s, period)
        instants = (switch, period - angle_age, period - torque_age)

        simulation = parameters.simulation or Simulation(torque_noise_nm=0.0, force_noise_n=0.0)
        stated = parameters.beam
        own = replace(
            stated,
            density_kg_per_m=simulation.density_ratio * stated.density_kg_per_m,
            bending_stiffness_n_m2=simulation.stiffness_ratio * stated.bending_stiffness_n_m2,
        )
        parameters = replace(parameters, beam=own)
        beam, free, locked = models_of(parameters, simulation)
        filtered = simulation.torque_filter_hz > 0
        self._air = _air(parameters, beam)
        if self._air is not None:
            (free, on_free), (locked, on_locked) = map(self._air.attached, (free, locked))
        self._contact = _contact(parameters, beam, period)
        if self._contact is not None:
            (free, on_free), (locked, on_locked) = map(self._contact.attached, (free, locked))
        n = free.b.size
        self._rest_per_angle = np.eye(1, n)[0]
        self._rest_per_angle[2:] = -np.linalg.solve(locked.a[2:, 2:], locked.a[2:, 0])
        step, locked_step, friction = steps_of(free, locked, period, instants)
        self._friction_effects: list[float] = friction[n:].tolist()
        points = 0
        if self._air is not None:
            points = len(self._air.speed)
            held = held_of(free, on_free, locked.sensor_torque, period, *instants[1:])
            locked_held = held_of(locked, on_locked, locked.sensor_torque, period, *instants[1:])
            step, locked_step = (
                np.vstack([whole := np.column_stack(parts), self._air.speed @ whole[:n]])
                for parts in ((step, held), (locked_step, locked_held))
            )
            self._friction_speed = self._air.speed @ friction[:n]
            self._direct_nm = self._direct_shear_n = 0.0
            self._direct_fraction = 1 - free.sensor_torque_per_torque
            self._direct_shear_fraction = -free.shear_per_torque
            self._torque_instant_fraction = 1 - torque_age / period
        if self._contact is not None:
            points = len(self._contact.displacement_rows)
            self._free_march, self._locked_march = (
                self._contact.march(
                    model, of_force, locked.sensor_torque, *instants, friction=friction[:n]
                )
                for model, of_force in ((free, on_free), (locked, on_locked))
            )
            step, locked_step = (
                np.vstack([whole, self._contact.displacement_rows @ whole[:n]])
                for whole in (step, locked_step)
            )
        self._drift: StiffnessDrift | None = None
        if simulation.stiffness_drift_per_s:
            self._drift = StiffnessDrift(
                simulation.stiffness_drift_per_s,
                period,
                np.abs(beam.poles_rad_s).max(initial=0.0, where=beam.poles_rad_s.imag > 0),
                lambda fraction: arrays_at(
                    fraction, parameters, simulation, beam, period, instants
                ),
            )
            step, locked_step = self._drift.arrays[:2]
        # A bound method of a matrix in column order: the quickest product of this size in numpy.
        self._free = np.asfortranarray(step).dot
        self._locked = np.asfortranarray(locked_step).dot

        # Two vectors, in turn the input [state, torque before and after the switch, friction, force
        # of the air] and the output [state, outputs, speeds in the air or displacements at the
        # obstacles] of a step; each with the views a step needs.
        self._vectors = _vectors(n, points, felt=points if self._air is not None else 0)
        self._states = n

        self._coulomb_nm = parameters.motor.coulomb_nm
        self._peak_nm = parameters.motor.peak_torque_nm
        self._friction_nm = 0.0
        self._stuck = self._coulomb_nm > 0
        self._holding_beam_nm = 0.0
        self._fraction_before_switch = switch / period
        self._next_is_known = switch == 0 and periods > 0
        self._jump_is_sensed = torque_age == 0 and not filtered
        self._set_jump_gains(free.sensor_torque_per_torque, free.shear_per_torque)

        self._torque_nm = 0.0
        self._torques = deque([0.0] * (periods + 2), maxlen=periods + 2)
        self._sensed_angles = deque([0.0] * (angle_periods + 1), maxlen=angle_periods + 1)
        difference = simulation.clock_rate_difference
        self._sensed_torques, self._sensed_shears = (
            OtherClock(torque_periods, -difference)
            if difference
            else deque([0.0] * (torque_periods + 1), maxlen=torque_periods + 1)
            for _ in range(2)
        )
        self._period_s = period
        self._periods = -1  # since the drive was first enabled; -1 before
        self.enabled = False
        self.angle_rad = 0.0
        self.velocity_rad_s = 0.0
        self.coupling_torque_nm = 0.0
        self.base_shear_n = 0.0
        self.sensed_angle_rad = 0.0
        self.sensed_torque_nm = 0.0
        self.sensed_shear_n = 0.0

    def enable(self) -> None:
        """Switch the drive on; its torque is zero until the next command takes effect."""
        self.enabled = True
        self._periods = max(self._periods, 0)

    def disable(self) -> None:
        """Switch the drive off: no torque from this instant, commands on their way included."""
        self.enabled = False
        self._torque_nm = 0.0
        self._torques.extend([0.0] * len(self._torques))

    @property
    def contact_forces_n(self) -> Real:
        """Force on the beam over each substep of the last period, shape (substeps, obstacles).

        Positive towards a positive angle. Without obstacles there is none, and no substep.
        """
        return np.zeros((0, 0)) if self._contact is None else self._contact.forces_n

    @property
    def elapsed_s(self) -> float:
        """Time since the drive was first enabled, from which obstacles count; 0 before."""
        return max(self._periods, 0) * self._period_s

    def become(self, other: "SimulatedPlant") -> None:
        """Adopt another plant's parameters, at rest at the present angle, with the drive off.

        Parameters
        ----------
        other
            A plant of the same rates and delays, not used any more.
        """
        angle_rad = self.angle_rad
        for name in self.__slots__:
            if hasattr(other, name):  # parts of a kind of plant are there if it is of that kind
                setattr(self, name, getattr(other, name))
        self._vectors[0][0][: self._states] = self._rest_per_angle * angle_rad
        self._sensed_angles.extend([angle_rad] * len(self._sensed_angles))
        self.angle_rad = self.sensed_angle_rad = angle_rad

    def meet(self, prepared: "SimulatedPlant") -> None:
        """Use the obstacles of another plant from now on, in the present state.

        Parameters
        ----------
        prepared
            A plant of the same rig, at rest. It takes a tenth of a second to make, which is why it
            is made before. Its obstacles are those of this one and more.
        """
        contact = prepared._contact
        assert contact is not None
        state = contact.take_over(self._vectors[0][0][: self._states], self._contact)
        for name in _OF_OBSTACLES:
            setattr(self, name, getattr(prepared, name))
        self._vectors = _vectors(state.size, len(contact.bodies), felt=0)
        self._vectors[0][0][: state.size] = state

    def end_obstacle(self, obstacle: Disturbance) -> None:
        """Remove an obstacle, if there is one like this."""
        if self._contact is not None:
            self._contact.end(obstacle, self.elapsed_s)

    def command(self, torque_nm: float) -> float:
        """Set the torque from this tick on, after the actuation delay; return it.

        Returns
        -------
        float
            That torque: limited to the peak, 0 while the drive is off.
        """
        if not self.enabled:
            return 0.0
        if torque_nm > self._peak_nm:
            torque_nm = self._peak_nm
        elif torque_nm < -self._peak_nm:
            torque_nm = -self._peak_nm
        self._torque_nm = torque_nm
        return torque_nm

    def advance(self, n_periods: int = 1) -> None:
        """Advance by `n_periods` ticks, with the last command repeated at those between."""
        n = self._states
        torques = self._torques
        for _ in range(n_periods):
            if self._drift is not None and self._drift.renew(self._periods):
                self._take_stiffness(self._drift)
            torques.append(self._torque_nm)
            before, after = torques[0], torques[1]
            (vector, input_, _), (output, _, results) = self._vectors
            vector[n] = before
            vector[n + 1] = after
            vector[n + 2] = self._friction_nm
            self._vectors = self._vectors[1], self._vectors[0]
            if self._air is not None:
                self._air.hold(input_[n + 3 :])

            fraction = self._fraction_before_switch
            load = fraction * before + (1 - fraction) * after - self._holding_beam_nm
            if self._stuck and abs(load) <= self._coulomb_nm:
                self._locked(input_, output)
                if self._contact is not None:
                    self._touch(self._locked_march, input_, output, turns=False)
                angle, _, torque, holding, shear, sensed_angle, sensed_torque, sensed_shear = (
                    results.tolist()
                )
                self._friction_nm = velocity = 0.0
                free = False
            else:
                free = True
                self._free(input_, output)
                if self._contact is not None:
                    self._touch(self._free_march, input_, output, turns=True)
                (
                    angle, velocity, torque, holding, shear,
                    sensed_angle, sensed_torque, sensed_shear,
                ) = results.tolist()  # fmt: skip
                if self._jump_gain:
                    jump = torques[2] - after
                    torque += self._jump_gain * jump
                    shear += self._shear_jump_gain * jump
                    sensed_torque += self._sensed_jump_gain * jump
                    sensed_shear += self._sensed_shear_jump_gain * jump
                if self._coulomb_nm:
                    effects = self._friction_effects
                    friction = -velocity / effects[1]
                    self._stuck = abs(friction) <= self._coulomb_nm
                    if self._stuck:
                        velocity = 0.0
                    else:
                        friction = self._coulomb_nm if friction > 0 else -self._coulomb_nm
                        velocity += effects[1] * friction
                    self._friction_nm = friction
                    angle += effects[0] * friction
                    torque += effects[2] * friction
                    holding += effects[3] * friction
                    shear += effects[4] * friction
                    sensed_angle += effects[5] * friction
                    sensed_torque += effects[6] * friction
                    sensed_shear += effects[7] * friction
            if self._air is not None:
                torque, holding, shear, sensed_torque, sensed_shear = self._braked(
                    output, free, torque, holding, shear, sensed_torque, sensed_shear
                )
            if self._periods >= 0:
                self._periods += 1
            self._holding_beam_nm = holding
            self._sensed_angles.append(sensed_angle)
            self._sensed_torques.append(sensed_torque)
            self._sensed_shears.append(sensed_shear)
        if n_periods > 0:
            self.angle_rad = angle
            self.velocity_rad_s = velocity
            self.coupling_torque_nm = torque
            self.base_shear_n = shear
            self.sensed_angle_rad = self._sensed_angles[0]
            self.sensed_torque_nm = self._sensed_torques[0]
            self.sensed_shear_n = self._sensed_shears[0]

    def _set_jump_gains(self, torque_per_torque: float, shear_per_torque: float) -> None:
        """Set the effect of half a jump of the motor's torque on the outputs at a tick."""
        self._jump_gain = 0.5 * torque_per_torque if self._next_is_known else 0.0
        self._shear_jump_gain = 0.5 * shear_per_torque if self._next_is_known else 0.0
        self._sensed_jump_gain = self._jump_gain if self._jump_is_sensed else 0.0
        self._sensed_shear_jump_gain = self._shear_jump_gain if self._jump_is_sensed else 0.0

    def _take_stiffness(self, drift: StiffnessDrift) -> None:
        """Update the quantities that depend on the stiffness and are not in the step matrices."""
        self._friction_effects = drift.arrays[2].tolist()
        self._set_jump_gains(*drift.arrays[3].tolist())

    def _touch(self, march: March, input_: Real, output: Real, *, turns: bool) -> None:
        """Add the effect of the obstacles to a step computed without them.

        Friction and contact depend on each other: they are computed in turn, beginning with the
        friction of the period before.
        """
        contact = self._contact
        assert contact is not None
        n = self._states
        time_s = self.elapsed_s
        if contact.nothing(output[n + OUTPUTS :], time_s):
            return
        free_m = march.free(input_).reshape(contact.substeps, -1)
        friction = self._friction_nm if turns else 0.0
        for _ in range(_FRICTION_SWEEPS):
            rubbed_m = free_m + friction * march.friction
            forces = contact.forces(march, rubbed_m, time_s)
            effect = march.effect(forces.ravel())
            if not turns or not self._coulomb_nm:
                break
            velocity = output.item(march.velocity_row) + effect.item(march.velocity_row)
            wanted = -velocity / self._friction_effects[1]
            wanted = min(max(wanted, -self._coulomb_nm), self._coulomb_nm)
            if abs(wanted - friction) < _SAME_FRICTION * self._coulomb_nm:
                break
            friction = wanted
        contact.take(march, forces, rubbed_m)
        output[: effect.size] += effect

    def _braked(
        self,
        output: Real,
        free: bool,
        torque: float,
        holding: float,
        shear: float,
        sensed_torque: float,
        sensed_shear: float,
    ) -> tuple[float, float, float, float, float]:
        """Add the immediate effect of the air's force to the outputs at the end of a step."""
        assert self._air is not None
        speed_m_s = output[self._states + OUTPUTS :]
        if free and self._friction_nm:
            speed_m_s += self._friction_nm * self._friction_speed
        before_nm, before_n = self._direct_nm, self._direct_shear_n
        now_nm, now_n = self._air.feel(speed_m_s)
        fraction, shear_fraction = (
            (self._direct_fraction, self._direct_shear_fraction) if free else (1.0, 0.0)
        )
        now_n += shear_fraction * now_nm
        self._direct_nm, self._direct_shear_n = now_nm, now_n
        at = self._torque_instant_fraction
        return (
            torque + fraction * now_nm,
            holding + now_nm,
            shear + now_n,
            sensed_torque + fraction * (before_nm + at * (now_nm - before_nm)),
            sensed_shear + before_n + at * (now_n - before_n),
        )


def _air(parameters: RigParameters, beam: Realisation) -> AirBrake | None:
    simulation = parameters.simulation
    if simulation is None or not simulation.air_drag_m:
        return None
    return AirBrake(parameters.beam, parameters.damping, beam, simulation.air_drag_m)


def _contact(
    parameters: RigParameters, beam: Realisation, period_s: float
) -> AttachedObstacles | None:
    simulation = parameters.simulation
    if simulation is None or not simulation.obstacles:
        return None
    bodies = tuple(parse_obstacle(text) for text in simulation.obstacles)
    simulated = {name: getattr(simulation, name) for name in INCOMPATIBLE_WITH_OBSTACLES}
    check_obstacles(bodies, parameters.beam, simulated)
    return AttachedObstacles(parameters.beam, parameters.damping, beam, bodies, period_s)


def _vectors(states: int, points: int, *, felt: int) -> tuple[tuple[Real, Real, Real], ...]:
    """Two vectors of a step, with views of input and outputs; the input has `felt` points."""
    return tuple(
        (vector, vector[: states + 3 + felt], vector[states : states + OUTPUTS])
        for vector in np.zeros((2, states + OUTPUTS + points))
    )


class OtherClock:
    """Line of readings, appended at each tick, of which the first is the one to be seen.

    Between ticks a cubic through the nearest four is taken.

    Parameters
    ----------
    periods
        Age of the first reading, in ticks.
    growth
        Growth of the age per tick, in ticks; not negative.
    """

    __slots__ = ("_age", "_growth", "_readings")

    def __init__(self, periods: int, growth: float) -> None:
        self._age = float(periods)
        self._growth = growth
        self._readings = [0.0] * (periods + _STENCIL)

    def append(self, value: float) -> None:
        """Take the reading of the next tick."""
        self._age += self._growth
        readings = self._readings
        readings.append(value)
        if len(readings) > self._age + _STENCIL:
            del readings[0]

    def __getitem__(self, index: int) -> float:
        """Return the reading that is as old as the first has come to be (`index` 0)."""
        assert index == 0
        readings = self._readings
        position = len(readings) - 1 - self._age
        first = min(max(int(position) - 1, 0), len(readings) - _STENCIL)
        x = position - first
        a, b, c, d = readings[first : first + _STENCIL]
        return (
            -a * (x - 1) * (x - 2) * (x - 3) / 6
            + b * x * (x - 2) * (x - 3) / 2
            - c * x * (x - 1) * (x - 3) / 2
            + d * x * (x - 1) * (x - 2) / 6
        )
