"""Physics of the simulated rig: motor, clamp and beam, stepped from tick to tick.

Motor and beam are one linear model, which is stepped exactly for torques that are constant between
the arrivals of commands. Coulomb friction, saturation and delays are added to it. Quantisation and
noise belong to the simulated devices, not to the plant.
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
from rigd.sim._obstacle import AttachedObstacles, SubstepMatrices
from rigd.sim._step import (
    STEP_OUTPUT_COUNT,
    beam_and_coupled_models,
    constant_force_effect,
    drifted_step_arrays,
    free_and_locked_steps,
    split_delay,
)
from rigd.sim._stiffness_drift import StiffnessDrift

RealArray = NDArray[np.float64]
"""Array of real numbers."""

_OBSTACLE_ATTRIBUTES = (
    "_contact", "_free_step", "_free_substeps", "_friction_effects", "_locked_step",
    "_locked_substeps", "_state_count",
)  # fmt: skip
"""Attributes of a plant that depend on its obstacles."""

_MAX_FRICTION_ITERATIONS = 4
"""Largest number of iterations between friction and contact forces in one period."""
_RELATIVE_FRICTION_TOLERANCE = 1e-3
"""Change of the friction, relative to the Coulomb friction, at which the iterations end."""

_INTERPOLATION_POINT_COUNT = 4
"""Number of readings through which the interpolating polynomial of `GrowingDelayLine` passes."""


class SimulatedPlant:
    """Simulated plant of a rig, initially at rest at angle zero with the drive off.

    At each tick the caller reads the attributes, passes the torque of this tick to `command`, and
    calls `advance` to get to the next tick.

    Parameters
    ----------
    parameters
        Parameters of the rig. Delays may be any non-negative time, including fractions of a period.

    Attributes
    ----------
    angle_rad, velocity_rad_s : float
        Angle in rad and speed in rad/s of the output shaft at the present tick.
    coupling_torque_nm : float
        Torque in N·m between motor and clamp at the present tick, ``Γ + J_tool θ''``, as an ideal
        sensor measures it. It jumps with the motor's torque. At a jump the value is the mean of
        both sides, through which a band-limited signal passes, if the torque after the jump is
        already known (an actuation delay of at least one period). Else it is the value just before
        the jump. A jump of the Coulomb friction is never known before: in its torque, the tool
        inertia acts half a period late, and an analysis finds it 4 to 5 % too large.
    base_shear_n : float
        Force in N of the motor on the beam at the present tick, positive in the direction of
        increasing angles. A jump is treated as for the torque.
    sensed_angle_rad, sensed_torque_nm, sensed_shear_n : float
        Angle, torque and shear that the devices report at the present tick: the values
        `encoder.delay_s` and `sensor.delay_s` ago.
    enabled : bool
        Whether the drive is enabled.

    Raises
    ------
    RealisationError
        If the beam's damping cannot be realised at its stiffness, or at one to which it drifts.
    ObstacleError
        If an obstacle has a syntax error, or is beyond the beam's tip.

    Notes
    -----
    Coulomb friction is constant over a period and implicit: it is the torque of at most T_c that
    brings the shaft's speed at the end of the period closest to zero. A shaft brought to rest is
    locked, and the beam vibrates with a fixed root, until the torques on the shaft at the start of
    a period exceed T_c.
    """

    __slots__ = (
        "_air",
        "_contact",
        "_coulomb_nm",
        "_drag_shear_fraction",
        "_drag_shear_n",
        "_drag_torque_fraction",
        "_drag_torque_nm",
        "_drift",
        "_fraction_before_switch",
        "_free_step",
        "_free_substeps",
        "_friction_effects",
        "_friction_nm",
        "_holding_beam_nm",
        "_is_stuck",
        "_jump_is_sensed",
        "_locked_step",
        "_locked_substeps",
        "_next_torque_is_known",
        "_peak_nm",
        "_period_s",
        "_periods_since_enabling",
        "_rest_state_per_angle",
        "_sensed_angles",
        "_sensed_shear_jump_gain",
        "_sensed_shears",
        "_sensed_torque_jump_gain",
        "_sensed_torques",
        "_shear_jump_gain",
        "_speed_per_friction",
        "_state_count",
        "_torque_instant_fraction",
        "_torque_jump_gain",
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
        period_s = 1 / parameters.rate_hz
        delay_periods, switch_s = split_delay(parameters.actuation.delay_s, period_s)
        angle_periods, angle_age_s = split_delay(parameters.encoder.delay_s, period_s)
        torque_periods, torque_age_s = split_delay(parameters.sensor.delay_s, period_s)
        switch_and_sample_instants_s = (switch_s, period_s - angle_age_s, period_s - torque_age_s)

        simulation = parameters.simulation or Simulation(torque_noise_nm=0.0, force_noise_n=0.0)
        nominal_beam = parameters.beam
        simulated_beam = replace(
            nominal_beam,
            density_kg_per_m=simulation.density_ratio * nominal_beam.density_kg_per_m,
            bending_stiffness_n_m2=simulation.stiffness_ratio * nominal_beam.bending_stiffness_n_m2,
        )
        parameters = replace(parameters, beam=simulated_beam)
        beam_realisation, free_shaft_model, locked_shaft_model = beam_and_coupled_models(
            parameters, simulation
        )
        has_sensor_filter = simulation.torque_filter_hz > 0
        self._air = _air_brake(parameters, beam_realisation)
        if self._air is not None:
            (free_shaft_model, free_input), (locked_shaft_model, locked_input) = map(
                self._air.extended_model, (free_shaft_model, locked_shaft_model)
            )
        self._contact = _attached_obstacles(parameters, beam_realisation, period_s)
        if self._contact is not None:
            (free_shaft_model, free_input), (locked_shaft_model, locked_input) = map(
                self._contact.extended_model, (free_shaft_model, locked_shaft_model)
            )
        n = free_shaft_model.b.size
        self._rest_state_per_angle = np.eye(1, n)[0]
        self._rest_state_per_angle[2:] = -np.linalg.solve(
            locked_shaft_model.a[2:, 2:], locked_shaft_model.a[2:, 0]
        )
        free_matrix, locked_matrix, friction_effect = free_and_locked_steps(
            free_shaft_model, locked_shaft_model, period_s, switch_and_sample_instants_s
        )
        self._friction_effects: list[float] = friction_effect[n:].tolist()
        beam_point_count = 0
        if self._air is not None:
            beam_point_count = len(self._air.speed_rows)
            free_shaft_drag_effect = constant_force_effect(
                free_shaft_model,
                free_input,
                locked_shaft_model.sensor_torque_output_row,
                period_s,
                *switch_and_sample_instants_s[1:],
            )
            locked_shaft_drag_effect = constant_force_effect(
                locked_shaft_model,
                locked_input,
                locked_shaft_model.sensor_torque_output_row,
                period_s,
                *switch_and_sample_instants_s[1:],
            )
            free_matrix, locked_matrix = (
                np.vstack(
                    [
                        step_matrix := np.column_stack(matrix_parts),
                        self._air.speed_rows @ step_matrix[:n],
                    ]
                )
                for matrix_parts in (
                    (free_matrix, free_shaft_drag_effect),
                    (locked_matrix, locked_shaft_drag_effect),
                )
            )
            self._speed_per_friction = self._air.speed_rows @ friction_effect[:n]
            self._drag_torque_nm = self._drag_shear_n = 0.0
            self._drag_torque_fraction = 1 - free_shaft_model.sensor_torque_per_torque
            self._drag_shear_fraction = -free_shaft_model.shear_per_torque
            self._torque_instant_fraction = 1 - torque_age_s / period_s
        if self._contact is not None:
            beam_point_count = len(self._contact.displacement_rows)
            self._free_substeps, self._locked_substeps = (
                self._contact.substep_matrices(
                    coupled_model,
                    force_input,
                    locked_shaft_model.sensor_torque_output_row,
                    *switch_and_sample_instants_s,
                    friction_effect=friction_effect[:n],
                )
                for coupled_model, force_input in (
                    (free_shaft_model, free_input),
                    (locked_shaft_model, locked_input),
                )
            )
            free_matrix, locked_matrix = (
                np.vstack([step_matrix, self._contact.displacement_rows @ step_matrix[:n]])
                for step_matrix in (free_matrix, locked_matrix)
            )
        self._drift: StiffnessDrift | None = None
        if simulation.stiffness_drift_per_s:
            self._drift = StiffnessDrift(
                simulation.stiffness_drift_per_s,
                period_s,
                np.abs(beam_realisation.poles_rad_s).max(
                    initial=0.0, where=beam_realisation.poles_rad_s.imag > 0
                ),
                lambda stiffness_ratio: drifted_step_arrays(
                    stiffness_ratio,
                    parameters,
                    simulation,
                    beam_realisation,
                    period_s,
                    switch_and_sample_instants_s,
                ),
            )
            free_matrix, locked_matrix = self._drift.arrays[:2]
        # The bound method of a matrix in column order is NumPy's fastest product of this size.
        self._free_step = np.asfortranarray(free_matrix).dot
        self._locked_step = np.asfortranarray(locked_matrix).dot

        # Two vectors that are alternately the input [state, torque before and after the switch,
        # friction, drag force] and the output [state, outputs, speeds or displacements at the
        # obstacles] of a step. Each has the views that a step needs.
        self._vectors = _step_vectors(
            n, beam_point_count, drag_point_count=beam_point_count if self._air is not None else 0
        )
        self._state_count = n

        self._coulomb_nm = parameters.motor.coulomb_nm
        self._peak_nm = parameters.motor.peak_torque_nm
        self._friction_nm = 0.0
        self._is_stuck = self._coulomb_nm > 0
        self._holding_beam_nm = 0.0
        self._fraction_before_switch = switch_s / period_s
        self._next_torque_is_known = switch_s == 0 and delay_periods > 0
        self._jump_is_sensed = torque_age_s == 0 and not has_sensor_filter
        self._set_jump_gains(
            free_shaft_model.sensor_torque_per_torque, free_shaft_model.shear_per_torque
        )

        self._torque_nm = 0.0
        self._torques = deque([0.0] * (delay_periods + 2), maxlen=delay_periods + 2)
        self._sensed_angles = deque([0.0] * (angle_periods + 1), maxlen=angle_periods + 1)
        clock_rate_difference = simulation.clock_rate_difference
        self._sensed_torques, self._sensed_shears = (
            GrowingDelayLine(torque_periods, -clock_rate_difference)
            if clock_rate_difference
            else deque([0.0] * (torque_periods + 1), maxlen=torque_periods + 1)
            for _ in range(2)
        )
        self._period_s = period_s
        self._periods_since_enabling = (
            -1
        )  # number of periods since the drive was first enabled; -1 before
        self.enabled = False
        self.angle_rad = 0.0
        self.velocity_rad_s = 0.0
        self.coupling_torque_nm = 0.0
        self.base_shear_n = 0.0
        self.sensed_angle_rad = 0.0
        self.sensed_torque_nm = 0.0
        self.sensed_shear_n = 0.0

    def enable(self) -> None:
        """Switch the simulated drive on; its torque is zero until the next command takes effect."""
        self.enabled = True
        self._periods_since_enabling = max(self._periods_since_enabling, 0)

    def disable(self) -> None:
        """Switch the simulated drive off; its torque is zero and delayed commands are dropped."""
        self.enabled = False
        self._torque_nm = 0.0
        self._torques.extend([0.0] * len(self._torques))

    @property
    def contact_forces_n(self) -> RealArray:
        """Force in N on the beam in each substep of the last period, shape (substeps, obstacles).

        It is positive in the direction of increasing angles. Without obstacles the shape is (0, 0).
        """
        return np.zeros((0, 0)) if self._contact is None else self._contact.forces_n

    @property
    def elapsed_s(self) -> float:
        """Time in seconds since the drive was first enabled; 0 before."""
        return max(self._periods_since_enabling, 0) * self._period_s

    def adopt_parameters(self, other_plant: "SimulatedPlant") -> None:
        """Take over another plant's parameters; the beam then rests at its angle, the drive off.

        Parameters
        ----------
        other_plant
            Plant with the same rates and delays, which must not be used any more.
        """
        angle_rad = self.angle_rad
        for attribute_name in self.__slots__:
            if hasattr(
                other_plant, attribute_name
            ):  # some attributes exist only with drag or obstacles
                setattr(self, attribute_name, getattr(other_plant, attribute_name))
        self._vectors[0][0][: self._state_count] = self._rest_state_per_angle * angle_rad
        self._sensed_angles.extend([angle_rad] * len(self._sensed_angles))
        self.angle_rad = self.sensed_angle_rad = angle_rad

    def use_obstacles_of(self, prepared_plant: "SimulatedPlant") -> None:
        """Replace the obstacles by those of another plant, without changing the present state.

        Parameters
        ----------
        prepared_plant
            Plant of the same rig, at rest, with the obstacles of this plant and more. It is created
            beforehand, because that takes a tenth of a second.
        """
        new_obstacles = prepared_plant._contact
        assert new_obstacles is not None
        plant_state = new_obstacles.adopt_states(
            self._vectors[0][0][: self._state_count], self._contact
        )
        for attribute_name in _OBSTACLE_ATTRIBUTES:
            setattr(self, attribute_name, getattr(prepared_plant, attribute_name))
        self._vectors = _step_vectors(
            plant_state.size, len(new_obstacles.bodies), drag_point_count=0
        )
        self._vectors[0][0][: plant_state.size] = plant_state

    def remove_obstacle(self, obstacle: Disturbance) -> None:
        """Remove an obstacle, if one equal to the given one is simulated."""
        if self._contact is not None:
            self._contact.remove(obstacle, self.elapsed_s)

    def command(self, torque_nm: float) -> float:
        """Command a motor torque in N·m that acts from this tick on, after the actuation delay.

        Returns
        -------
        float
            Torque that will act, in N·m: limited to the peak torque, 0 while the drive is off.
        """
        if not self.enabled:
            return 0.0
        if torque_nm > self._peak_nm:
            torque_nm = self._peak_nm
        elif torque_nm < -self._peak_nm:
            torque_nm = -self._peak_nm
        self._torque_nm = torque_nm
        return torque_nm

    def advance(self, period_count: int = 1) -> None:
        """Advance the plant by `period_count` ticks, in which the last torque command acts."""
        n = self._state_count
        torques_nm = self._torques
        for _ in range(period_count):
            if self._drift is not None and self._drift.refresh_if_due(self._periods_since_enabling):
                self._use_stiffness(self._drift)
            torques_nm.append(self._torque_nm)
            old_torque_nm, new_torque_nm = torques_nm[0], torques_nm[1]
            (step_vector, step_input, _), (step_output, _, output_values) = self._vectors
            step_vector[n] = old_torque_nm
            step_vector[n + 1] = new_torque_nm
            step_vector[n + 2] = self._friction_nm
            self._vectors = self._vectors[1], self._vectors[0]
            if self._air is not None:
                self._air.write_held_force(step_input[n + 3 :])

            fraction_before_switch = self._fraction_before_switch
            shaft_load_nm = (
                fraction_before_switch * old_torque_nm
                + (1 - fraction_before_switch) * new_torque_nm
                - self._holding_beam_nm
            )
            if self._is_stuck and abs(shaft_load_nm) <= self._coulomb_nm:
                self._locked_step(step_input, step_output)
                if self._contact is not None:
                    self._add_contact_effect(
                        self._locked_substeps, step_input, step_output, is_turning=False
                    )
                (
                    angle_rad,
                    _,
                    torque_nm,
                    holding_torque_nm,
                    shear_n,
                    sensed_angle_rad,
                    sensed_torque_nm,
                    sensed_shear_n,
                ) = output_values.tolist()
                self._friction_nm = velocity_rad_s = 0.0
                is_shaft_free = False
            else:
                is_shaft_free = True
                self._free_step(step_input, step_output)
                if self._contact is not None:
                    self._add_contact_effect(
                        self._free_substeps, step_input, step_output, is_turning=True
                    )
                (
                    angle_rad, velocity_rad_s, torque_nm, holding_torque_nm, shear_n,
                    sensed_angle_rad, sensed_torque_nm, sensed_shear_n,
                ) = output_values.tolist()  # fmt: skip
                if self._torque_jump_gain:
                    torque_jump_nm = torques_nm[2] - new_torque_nm
                    torque_nm += self._torque_jump_gain * torque_jump_nm
                    shear_n += self._shear_jump_gain * torque_jump_nm
                    sensed_torque_nm += self._sensed_torque_jump_gain * torque_jump_nm
                    sensed_shear_n += self._sensed_shear_jump_gain * torque_jump_nm
                if self._coulomb_nm:
                    friction_effects = self._friction_effects
                    friction_torque_nm = -velocity_rad_s / friction_effects[1]
                    self._is_stuck = abs(friction_torque_nm) <= self._coulomb_nm
                    if self._is_stuck:
                        velocity_rad_s = 0.0
                    else:
                        friction_torque_nm = (
                            self._coulomb_nm if friction_torque_nm > 0 else -self._coulomb_nm
                        )
                        velocity_rad_s += friction_effects[1] * friction_torque_nm
                    self._friction_nm = friction_torque_nm
                    angle_rad += friction_effects[0] * friction_torque_nm
                    torque_nm += friction_effects[2] * friction_torque_nm
                    holding_torque_nm += friction_effects[3] * friction_torque_nm
                    shear_n += friction_effects[4] * friction_torque_nm
                    sensed_angle_rad += friction_effects[5] * friction_torque_nm
                    sensed_torque_nm += friction_effects[6] * friction_torque_nm
                    sensed_shear_n += friction_effects[7] * friction_torque_nm
            if self._air is not None:
                torque_nm, holding_torque_nm, shear_n, sensed_torque_nm, sensed_shear_n = (
                    self._with_drag_effect(
                        step_output,
                        is_shaft_free,
                        torque_nm,
                        holding_torque_nm,
                        shear_n,
                        sensed_torque_nm,
                        sensed_shear_n,
                    )
                )
            if self._periods_since_enabling >= 0:
                self._periods_since_enabling += 1
            self._holding_beam_nm = holding_torque_nm
            self._sensed_angles.append(sensed_angle_rad)
            self._sensed_torques.append(sensed_torque_nm)
            self._sensed_shears.append(sensed_shear_n)
        if period_count > 0:
            self.angle_rad = angle_rad
            self.velocity_rad_s = velocity_rad_s
            self.coupling_torque_nm = torque_nm
            self.base_shear_n = shear_n
            self.sensed_angle_rad = self._sensed_angles[0]
            self.sensed_torque_nm = self._sensed_torques[0]
            self.sensed_shear_n = self._sensed_shears[0]

    def _set_jump_gains(self, torque_per_torque: float, shear_per_torque: float) -> None:
        """Set the gains by which a jump of the motor's torque at a tick changes its outputs.

        The gains contain the factor 0.5, since half of the jump counts at the tick.
        """
        self._torque_jump_gain = 0.5 * torque_per_torque if self._next_torque_is_known else 0.0
        self._shear_jump_gain = 0.5 * shear_per_torque if self._next_torque_is_known else 0.0
        self._sensed_torque_jump_gain = self._torque_jump_gain if self._jump_is_sensed else 0.0
        self._sensed_shear_jump_gain = self._shear_jump_gain if self._jump_is_sensed else 0.0

    def _use_stiffness(self, drift: StiffnessDrift) -> None:
        """Update the quantities that depend on the stiffness but are not in the step matrices."""
        self._friction_effects = drift.arrays[2].tolist()
        self._set_jump_gains(*drift.arrays[3].tolist())

    def _add_contact_effect(
        self,
        substep_matrices: SubstepMatrices,
        step_input: RealArray,
        step_output: RealArray,
        *,
        is_turning: bool,
    ) -> None:
        """Add the effect of the obstacles to the state and outputs of a step computed without them.

        Friction and contact depend on each other. They are computed alternately, starting with the
        friction of the previous period.
        """
        attached_obstacles = self._contact
        assert attached_obstacles is not None
        n = self._state_count
        time_s = self.elapsed_s
        if attached_obstacles.cannot_touch(step_output[n + STEP_OUTPUT_COUNT :], time_s):
            return
        unforced_displacement_m = substep_matrices.unforced_displacement(step_input).reshape(
            attached_obstacles.substeps, -1
        )
        friction_torque_nm = self._friction_nm if is_turning else 0.0
        for _ in range(_MAX_FRICTION_ITERATIONS):
            displacement_m = (
                unforced_displacement_m
                + friction_torque_nm * substep_matrices.displacement_per_friction
            )
            forces_n = attached_obstacles.compute_forces(substep_matrices, displacement_m, time_s)
            contact_effect = substep_matrices.force_effect(forces_n.ravel())
            if not is_turning or not self._coulomb_nm:
                break
            velocity_rad_s = step_output.item(
                substep_matrices.velocity_index
            ) + contact_effect.item(substep_matrices.velocity_index)
            required_friction_torque_nm = -velocity_rad_s / self._friction_effects[1]
            required_friction_torque_nm = min(
                max(required_friction_torque_nm, -self._coulomb_nm), self._coulomb_nm
            )
            if (
                abs(required_friction_torque_nm - friction_torque_nm)
                < _RELATIVE_FRICTION_TOLERANCE * self._coulomb_nm
            ):
                break
            friction_torque_nm = required_friction_torque_nm
        attached_obstacles.store_forces(substep_matrices, forces_n, displacement_m)
        step_output[: contact_effect.size] += contact_effect

    def _with_drag_effect(
        self,
        step_output: RealArray,
        is_shaft_free: bool,
        torque_nm: float,
        holding_torque_nm: float,
        shear_n: float,
        sensed_torque_nm: float,
        sensed_shear_n: float,
    ) -> tuple[float, float, float, float, float]:
        """Return the outputs at the end of a step, with the immediate effect of the drag added."""
        assert self._air is not None
        speed_m_s = step_output[self._state_count + STEP_OUTPUT_COUNT :]
        if is_shaft_free and self._friction_nm:
            speed_m_s += self._friction_nm * self._speed_per_friction
        old_drag_nm, old_drag_n = self._drag_torque_nm, self._drag_shear_n
        new_drag_nm, new_drag_n = self._air.update_force(speed_m_s)
        torque_fraction, shear_fraction = (
            (self._drag_torque_fraction, self._drag_shear_fraction) if is_shaft_free else (1.0, 0.0)
        )
        new_drag_n += shear_fraction * new_drag_nm
        self._drag_torque_nm, self._drag_shear_n = new_drag_nm, new_drag_n
        torque_instant_fraction = self._torque_instant_fraction
        return (
            torque_nm + torque_fraction * new_drag_nm,
            holding_torque_nm + new_drag_nm,
            shear_n + new_drag_n,
            sensed_torque_nm
            + torque_fraction
            * (old_drag_nm + torque_instant_fraction * (new_drag_nm - old_drag_nm)),
            sensed_shear_n + old_drag_n + torque_instant_fraction * (new_drag_n - old_drag_n),
        )


def _air_brake(parameters: RigParameters, beam_realisation: Realisation) -> AirBrake | None:
    """Return the air drag on the simulated beam, or None if the profile has no air drag."""
    simulation = parameters.simulation
    if simulation is None or not simulation.air_drag_m:
        return None
    return AirBrake(parameters.beam, parameters.damping, beam_realisation, simulation.air_drag_m)


def _attached_obstacles(
    parameters: RigParameters, beam_realisation: Realisation, period_s: float
) -> AttachedObstacles | None:
    """Return a profile's obstacles and impacts, attached to the beam; None if it has none."""
    simulation = parameters.simulation
    if simulation is None or not simulation.obstacles:
        return None
    disturbances = tuple(parse_obstacle(obstacle_text) for obstacle_text in simulation.obstacles)
    effect_by_name = {
        effect_name: getattr(simulation, effect_name) for effect_name in INCOMPATIBLE_WITH_OBSTACLES
    }
    check_obstacles(disturbances, parameters.beam, effect_by_name)
    return AttachedObstacles(
        parameters.beam, parameters.damping, beam_realisation, disturbances, period_s
    )


def _step_vectors(
    state_count: int, beam_point_count: int, *, drag_point_count: int
) -> tuple[tuple[RealArray, RealArray, RealArray], ...]:
    """Return the two vectors that alternate in steps, each with views of its input and outputs.

    The input contains `drag_point_count` drag forces.
    """
    return tuple(
        (
            step_vector,
            step_vector[: state_count + 3 + drag_point_count],
            step_vector[state_count : state_count + STEP_OUTPUT_COUNT],
        )
        for step_vector in np.zeros((2, state_count + STEP_OUTPUT_COUNT + beam_point_count))
    )


class GrowingDelayLine:
    """Delay line of readings whose delay grows, for a sensor whose clock differs from the loop's.

    Between ticks the reading is interpolated by a cubic through the four nearest readings.
    `initial_delay_ticks` is the initial delay in ticks, and `delay_growth_per_tick` its increase
    per tick, in ticks and not negative.
    """

    __slots__ = ("_age", "_delay_growth_per_tick", "_readings")

    def __init__(self, initial_delay_ticks: int, delay_growth_per_tick: float) -> None:
        self._age = float(initial_delay_ticks)
        self._delay_growth_per_tick = delay_growth_per_tick
        self._readings = [0.0] * (initial_delay_ticks + _INTERPOLATION_POINT_COUNT)

    def append(self, new_reading: float) -> None:
        """Append the reading of the next tick to the delay line, and increase the delay."""
        self._age += self._delay_growth_per_tick
        stored_readings = self._readings
        stored_readings.append(new_reading)
        if len(stored_readings) > self._age + _INTERPOLATION_POINT_COUNT:
            del stored_readings[0]

    def __getitem__(self, index: int) -> float:
        """Return the interpolated reading at the present delay of the line; `index` must be 0."""
        assert index == 0
        stored_readings = self._readings
        read_position = len(stored_readings) - 1 - self._age
        first_index = min(
            max(int(read_position) - 1, 0), len(stored_readings) - _INTERPOLATION_POINT_COUNT
        )
        x = read_position - first_index
        a, b, c, d = stored_readings[first_index : first_index + _INTERPOLATION_POINT_COUNT]
        return (
            -a * (x - 1) * (x - 2) * (x - 3) / 6
            + b * x * (x - 2) * (x - 3) / 2
            - c * x * (x - 1) * (x - 3) / 2
            + d * x * (x - 1) * (x - 2) / 6
        )
