"""Obstacles in the path of the simulated beam and impacts on it, computed tick by tick.

A force on the beam drives additional states (`realise_force`), which describe its effect on the
beam, and whose torque acts on the shaft. While the beam touches nothing, plant and these states
advance by whole periods. Near an obstacle a period is divided into substeps with a constant force
each. The rest of the plant is linear and known exactly, so the force of each substep is the root of
one scalar equation.

Within a substep the penetration changes from a to q. The mean elastic force of the obstacle over
the substep is chosen so that the work done on the obstacle equals the change of its stored energy.
So no energy is created, whatever the stiffness. An obstacle that is stiffer than the beam within
one substep dissipates some energy, because its force would otherwise oscillate from substep to
substep.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import ceil, exp, inf, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Beam, Damping, PointForceGrid, realise_force
from rigd.beam.realisation import (
    CoupledModel,
    Realisation,
    propagator,
    state_output,
    states_after_constant_inputs,
)
from rigd.devices.obstacles import Disturbance, ImpactSpecification, Obstacle

RealArray = NDArray[np.float64]
"""Array of real numbers."""
ComplexArray = NDArray[np.complexfloating]
"""Array of complex numbers."""

_RIGID_STIFFNESS_N_PER_M = 1e9
"""Stiffness in N/m of a rigid obstacle: its deflection is a nanometre per newton."""
_MAX_RESOLVED_STIFFNESS_N_PER_M = 1e5
"""Stiffness in N/m of the stiffest obstacle whose contact the substeps resolve."""
_SUBSTEPS_PER_CONTACT_TIME = 6
"""Number of substeps in the time in which a beam that is hit recedes from an obstacle."""
_MIN_SUBSTEPS_PER_S = 16e3
"""Smallest number of substeps per second."""
_MIN_SUBSTEPS_PER_PERIOD = 8
"""Smallest number of substeps per period."""
_TIP_COMPLIANCE_RATIO = 4.0
"""Compliance of a beam at its tip, relative to that of a beam without ends."""
_CONTACT_MARGIN_M = 1e-3
"""Distance in m, beyond the beam's motion in a period, within which an obstacle may be touched."""
_SMALL_DISPLACEMENT_RATIO = 0.01
"""Displacement, relative to a rigid beam's, below which the fit limits the absolute error.

A beam that moves so little hardly follows the motor, and needs no relative accuracy."""
_CONTACT_ITERATION_COUNT = 3
"""Number of iterations over several obstacles that the beam touches in one substep."""


class AttachedObstacles:
    """Obstacles and impacts that act on the beam of the simulated plant.

    `period_s` is the duration of a step of the plant.

    Attributes
    ----------
    forces_n : (substeps, bodies)
        Force in N on the beam in each substep of the last period, positive in the direction of
        increasing angles.
    substeps : int
        Number of substeps per period.
    bodies : tuple of Disturbance
        Obstacles and impacts.
    """

    def __init__(
        self,
        beam: Beam,
        damping: Damping,
        realisation: Realisation,
        bodies: tuple[Disturbance, ...],
        period_s: float,
    ) -> None:
        self.bodies = bodies
        self._period_s = period_s
        self.substeps = _substeps_per_period(beam, bodies, period_s)
        self._substep_s = period_s / self.substeps
        positions_m = np.array([attached_body.x_m for attached_body in bodies])
        force_realisations = [
            realise_force(beam, damping, x, positions_m, 1 / self._substep_s)
            for x in positions_m.tolist()
        ]
        # Rows: displacement at each body, torque, shear. Columns of `_force_state_rows`: states of
        # each force; columns of `_direct_rows`: forces.
        self._force_state_rows = np.column_stack(
            [force_realisation.output_rows for force_realisation in force_realisations]
        )
        self._direct_rows = np.column_stack(
            [force_realisation.feedthrough for force_realisation in force_realisations]
        )
        self._a, self._b = force_realisations[0].a, force_realisations[0].b  # equal for all forces
        self._oscillating_state_count = 2 * force_realisations[0].mode_count
        angle_outputs = [
            state_output(
                realisation,
                partial(_displacement_per_angle, beam, damping, x),
                has_inertial_term=False,
                response_floor=_SMALL_DISPLACEMENT_RATIO * x,
            )
            for x in positions_m.tolist()
        ]
        self._rigid_rows = np.array(
            [[t.output_per_angle, t.output_per_velocity, *t.c] for t in angle_outputs]
        )
        self._positions_m = positions_m
        self._obstacles = [
            (
                body_index,
                attached_body,
                min(attached_body.stiffness_n_per_m, _RIGID_STIFFNESS_N_PER_M),
            )
            for body_index, attached_body in enumerate(bodies)
            if isinstance(attached_body, Obstacle)
        ]
        self._impacts = [
            (i, attached_body)
            for i, attached_body in enumerate(bodies)
            if isinstance(attached_body, ImpactSpecification)
        ]
        self._zero_forces: RealArray = np.zeros((self.substeps, len(bodies)))
        self.forces_n = self._zero_forces
        # Displacement at each body at the end of the last period, and at its start.
        self._displacement_m: RealArray = np.zeros(len(bodies))
        self._start_displacement_m = self._displacement_m
        self._penetration_m = self._end_penetrations_m = dict.fromkeys(range(len(bodies)), -inf)

    @property
    def displacement_rows(self) -> RealArray:
        """Matrix that gives the beam's displacement in m at each obstacle or impact from the state.

        The state is that of the model that `extended_model` returns.
        """
        return np.column_stack([self._rigid_rows, self._force_state_rows[:-2]])

    def extended_model(self, model: CoupledModel) -> tuple[CoupledModel, RealArray]:
        """Return the model of motor and beam, extended by the effect of forces on the beam.

        The model has additional states for each force, whose torque acts on the shaft. Return also
        the derivative of the state by each force, per N, shape (n, bodies).
        """
        body_count, states_per_body = self._positions_m.size, self._b.size
        n, added_state_count = model.b.size, body_count * states_per_body
        torque_row, shear_row = self._force_state_rows[-2], self._force_state_rows[-1]
        a = np.zeros((n + added_state_count, n + added_state_count))
        a[:n, :n] = model.a
        a[:n, n:] = -np.outer(model.b, torque_row)
        force_input = np.zeros((n + added_state_count, body_count))
        force_input[:n] = -np.outer(model.b, self._direct_rows[-2])
        for body_index in range(body_count):
            body_states = slice(
                n + body_index * states_per_body, n + (body_index + 1) * states_per_body
            )
            a[body_states, body_states] = self._a
            force_input[body_states, body_index] = self._b
        extended_coupled_model = replace(
            model,
            a=a,
            b=np.append(model.b, np.zeros(added_state_count)),
            angle_output_row=np.append(model.angle_output_row, np.zeros(added_state_count)),
            velocity_output_row=np.append(model.velocity_output_row, np.zeros(added_state_count)),
            acceleration_output_row=np.append(
                model.acceleration_output_row, -model.acceleration_per_torque * torque_row
            ),
            beam_torque_output_row=np.append(
                model.beam_torque_output_row, (1 - model.beam_torque_per_torque) * torque_row
            ),
            sensor_torque_output_row=np.append(
                model.sensor_torque_output_row, (1 - model.sensor_torque_per_torque) * torque_row
            ),
            shear_output_row=np.append(
                model.shear_output_row, shear_row - model.shear_per_torque * torque_row
            ),
        )
        return extended_coupled_model, force_input

    def substep_matrices(
        self,
        model: CoupledModel,
        force_input: RealArray,
        holding_torque_row: RealArray,
        torque_switch_s: float,
        angle_instant_s: float,
        torque_instant_s: float,
        friction_effect: RealArray,
    ) -> "SubstepMatrices":
        """Compute the matrices for the substeps of a period, for a free or a locked motor.

        `model` and `force_input` are those of `extended_model`. `friction_effect`, shape (n,), is
        the effect of 1 N·m of friction in the previous period on the state. The other arguments are
        as for :func:`rigd.sim._step._step_matrix`.
        """
        substep_count, substep_s, body_count = (
            self.substeps,
            self._substep_s,
            self._positions_m.size,
        )
        n = model.b.size
        phi, step_response = propagator(model, substep_s)
        displacement_rows = self.displacement_rows

        # Displacement without a force: rows for the states, columns for the torques.
        displacement_per_state = np.empty((substep_count, body_count, n))
        propagated_rows = displacement_rows
        for j in range(substep_count):
            displacement_per_state[j] = propagated_rows = propagated_rows @ phi
        displacement_per_torque = np.empty((substep_count, body_count, 2))
        state_per_torque = np.zeros((n, 2))
        for j in range(substep_count):
            time_before_switch_s = min(max(torque_switch_s - j * substep_s, 0.0), substep_s)
            response_after_switch = (
                propagator(model, substep_s - time_before_switch_s)[1]
                if 0 < time_before_switch_s < substep_s
                else step_response
            )
            response_after_switch = response_after_switch * (time_before_switch_s < substep_s)
            state_per_torque = phi @ state_per_torque + np.column_stack(
                [step_response - response_after_switch, response_after_switch]
            )
            displacement_per_torque[j] = displacement_rows @ state_per_torque
        unforced_displacement_matrix = np.column_stack(
            [displacement_per_state.reshape(-1, n), displacement_per_torque.reshape(-1, 2)]
        )
        unforced_displacement_matrix = np.column_stack(
            [unforced_displacement_matrix, unforced_displacement_matrix[:, :n] @ friction_effect]
        )

        # State j substeps after a force of 1 N that acted for one substep.
        decayed_states = np.empty((substep_count, n, body_count))
        decayed_states[0] = states_after_constant_inputs(model, force_input, substep_s)
        for j in range(1, substep_count):
            decayed_states[j] = phi @ decayed_states[j - 1]
        force_kernel = displacement_rows @ decayed_states
        force_kernel[0] += self._direct_rows[:-2]

        def forces_effect_on_output(
            output_row: RealArray, direct_effect: RealArray, instant_s: float
        ) -> RealArray:
            """Return the effect of each substep's force on an output at an instant."""
            substeps_until_instant = instant_s / substep_s
            substep_index = min(int(substeps_until_instant), substep_count - 1)
            substep_fraction = substeps_until_instant - substep_index
            effect_matrix = np.zeros((substep_count, body_count))
            for substep_node, node_weight in (
                (substep_index, 1 - substep_fraction),
                (substep_index + 1, substep_fraction),
            ):
                effect_matrix[:substep_node] += (
                    node_weight * (output_row @ decayed_states[:substep_node])[::-1]
                )
            effect_matrix[substep_index] += direct_effect
            return effect_matrix.ravel()

        direct_sensor_torque = (1 - model.sensor_torque_per_torque) * self._direct_rows[-2]
        direct_shear = self._direct_rows[-1] - model.shear_per_torque * self._direct_rows[-2]
        zero_row, period_s = np.zeros(body_count), self._period_s
        effect_matrix = np.vstack(
            [
                decayed_states[::-1].transpose(1, 0, 2).reshape(n, -1),
                forces_effect_on_output(model.angle_output_row, zero_row, period_s),
                forces_effect_on_output(model.velocity_output_row, zero_row, period_s),
                forces_effect_on_output(
                    model.sensor_torque_output_row, direct_sensor_torque, period_s
                ),
                forces_effect_on_output(holding_torque_row, self._direct_rows[-2], period_s),
                forces_effect_on_output(model.shear_output_row, direct_shear, period_s),
                forces_effect_on_output(model.angle_output_row, zero_row, angle_instant_s),
                forces_effect_on_output(
                    model.sensor_torque_output_row, direct_sensor_torque, torque_instant_s
                ),
                forces_effect_on_output(model.shear_output_row, direct_shear, torque_instant_s),
            ]
        )
        return SubstepMatrices(
            unforced_displacement=np.asfortranarray(unforced_displacement_matrix).dot,
            displacement_per_friction=-displacement_per_torque.sum(axis=2),
            displacement_kernel=force_kernel,
            displacement_history=_history_matrices(force_kernel),
            force_effect=np.asfortranarray(effect_matrix).dot,
            velocity_index=n + 1,
        )

    def cannot_touch(self, displacement_m: RealArray, time_s: float) -> bool:
        """Return whether no obstacle and no impact can act on the beam during a period.

        `displacement_m`, shape (bodies,), is the beam's displacement at each body at the end of the
        period if no force acts, and `time_s` the start of the period.
        """
        period_end_s = time_s + self._period_s
        start_displacement_m = self._start_displacement_m = self._displacement_m
        self._displacement_m = displacement_m.copy()
        for _, active_impact in self._impacts:
            if (
                time_s < active_impact.at_s + active_impact.duration_s
                and active_impact.at_s < period_end_s
            ):
                return False
        for body_index, active_body, _ in self._obstacles:
            if active_body.from_s < period_end_s and time_s < active_body.until_s:
                if self._penetration_m[body_index] > 0:
                    return False
                old_m, new_m = (
                    start_displacement_m.item(body_index),
                    displacement_m.item(body_index),
                )
                max_motion_m = (
                    2 * abs(new_m - old_m)
                    + active_body.x_m * abs(active_body.rate_rad_s) * self._period_s
                )
                if active_body.side * (
                    new_m - _surface_displacement_m(active_body, period_end_s)
                ) > -(max_motion_m + _CONTACT_MARGIN_M):
                    return False
        self._penetration_m = dict.fromkeys(range(self._positions_m.size), -inf)
        self.forces_n = self._zero_forces
        return True

    def compute_forces(
        self, substep_matrices: "SubstepMatrices", unforced_displacement_m: RealArray, time_s: float
    ) -> RealArray:
        """Return the forces in N of obstacles and impacts on the beam in each substep of a period.

        The forces have the shape (substeps, bodies) and are positive in the direction of increasing
        angles. The matrices are those of the free or the locked motor.
        `unforced_displacement_m`, shape (substeps, bodies), is the beam's displacement at each body
        at the end of each substep if no force acts, and `time_s` the start of the period.
        """
        substep_count, substep_s = self.substeps, self._substep_s
        force_kernel = substep_matrices.displacement_kernel
        forces_n = np.zeros_like(self._zero_forces)
        unforced_displacement_m = unforced_displacement_m.copy()
        for body_index, active_impact in self._impacts:
            substep_edges_s = time_s - active_impact.at_s + substep_s * np.arange(substep_count + 1)
            # Mean of half a sine over each substep.
            pulse_phase = (
                pi
                / active_impact.duration_s
                * np.clip(substep_edges_s, 0.0, active_impact.duration_s)
            )
            forces_n[:, body_index] = (
                -active_impact.force_n
                * active_impact.duration_s
                / pi
                / substep_s
                * np.diff(np.cos(pulse_phase))
            )
            for j in np.flatnonzero(forces_n[:, body_index]).tolist():
                unforced_displacement_m[j:] += (
                    force_kernel[: substep_count - j, :, body_index] * forces_n[j, body_index]
                )

        substep_ends_s = time_s + substep_s * np.arange(1, substep_count + 1)
        active_obstacles = []
        for body_index, active_body, stiffness_n_per_m in self._obstacles:
            is_present = (substep_ends_s > active_body.from_s) & (
                substep_ends_s <= active_body.until_s
            )
            if not is_present.any():
                continue
            surface_displacement_m = _surface_displacement_m(active_body, substep_ends_s)
            start_penetration_m = self._penetration_m[body_index]
            if start_penetration_m == -inf and active_body.from_s <= time_s:
                start_penetration_m = active_body.side * (
                    self._start_displacement_m.item(body_index)
                    - _surface_displacement_m(active_body, time_s)
                )
            active_obstacles.append(
                _ActiveObstacle(
                    body_index=body_index,
                    side=active_body.side,
                    stiffness_n_per_m=stiffness_n_per_m,
                    damping_n_per_m=active_body.damping_n_s_per_m / substep_s,
                    compliance_m_per_n=force_kernel.item(0, body_index, body_index),
                    unforced_penetration_m=np.where(
                        is_present,
                        active_body.side
                        * (unforced_displacement_m[:, body_index] - surface_displacement_m),
                        -inf,
                    ),
                    start_penetration_m=start_penetration_m,
                    force_n=np.zeros(substep_count),
                )
            )
        if active_obstacles:
            self._compute_obstacle_forces(substep_matrices, active_obstacles)
        self._end_penetrations_m = dict.fromkeys(range(self._positions_m.size), -inf)
        for active_obstacle in active_obstacles:
            self._end_penetrations_m[active_obstacle.body_index] = (
                active_obstacle.start_penetration_m
            )
            forces_n[:, active_obstacle.body_index] = (
                -active_obstacle.side * active_obstacle.force_n
            )
        return forces_n

    def _compute_obstacle_forces(
        self, substep_matrices: "SubstepMatrices", obstacles: "list[_ActiveObstacle]"
    ) -> None:
        """Compute the forces of all obstacles in a period, substep by substep.

        The forces of later substeps are still zero, so whole matrix rows can be multiplied.
        """
        substep_count = self.substeps
        # By how much each force moves the beam out of an obstacle until the end of each substep.
        displacement_kernels = [
            [(one.side * other_one.side
              * substep_matrices.displacement_history[one.body_index, other_one.body_index],
              other_one.force_n) for other_one in obstacles]
            for one in obstacles
        ]  # fmt: skip
        kernel_rows = [
            [(list(kernel_matrix), force_n) for kernel_matrix, force_n in kernel_pairs]
            for kernel_pairs in displacement_kernels
        ]
        obstacles_with_rows = list(zip(obstacles, kernel_rows, strict=True))
        iteration_count = _CONTACT_ITERATION_COUNT if len(obstacles) > 1 else 1
        substep_index = 0
        while substep_index < substep_count:
            if all(obstacle.start_penetration_m <= 0 for obstacle in obstacles):
                # Nothing is touched: skip to the first substep with a contact at its end.
                contact_substep = substep_count
                unforced_penetration_arrays = [
                    obstacle.unforced_penetration_m
                    - sum(kernel_matrix @ force_n for kernel_matrix, force_n in kernel_pairs)
                    for obstacle, kernel_pairs in zip(obstacles, displacement_kernels, strict=True)
                ]
                for unforced_penetration_m in unforced_penetration_arrays:
                    is_touching = unforced_penetration_m[substep_index:contact_substep] > 0
                    if is_touching.any():
                        contact_substep = substep_index + int(is_touching.argmax())
                if contact_substep > substep_index:
                    for obstacle, unforced_penetration_m in zip(
                        obstacles, unforced_penetration_arrays, strict=True
                    ):
                        obstacle.start_penetration_m = unforced_penetration_m.item(
                            contact_substep - 1
                        )
                substep_index = contact_substep
                if substep_index == substep_count:
                    return
            for _ in range(iteration_count):
                for obstacle, row_pairs in obstacles_with_rows:
                    obstacle.force_n[substep_index] = 0.0
                    unforced_end_penetration_m = obstacle.unforced_penetration_m.item(substep_index)
                    for matrix_rows, force_n in row_pairs:
                        unforced_end_penetration_m -= matrix_rows[substep_index].dot(force_n)
                    mean_force_n, obstacle.end_penetration_m = obstacle.force_and_penetration(
                        unforced_end_penetration_m
                    )
                    obstacle.force_n[substep_index] = mean_force_n
            for obstacle in obstacles:
                obstacle.start_penetration_m = obstacle.end_penetration_m
            substep_index += 1

    def adopt_states(
        self, old_state: RealArray, old_obstacles: "AttachedObstacles | None"
    ) -> RealArray:
        """Take over the state of a plant with fewer obstacles; return the state with all of them.

        The obstacles that have acted so far come first among these obstacles. `old_state` is the
        state of the plant with `old_obstacles`, which are None if there were none.
        """
        states_per_body = self._b.size
        old_states_per_body = 0 if old_obstacles is None else old_obstacles._b.size
        old_body_count = 0 if old_obstacles is None else old_obstacles._positions_m.size
        n = old_state.size - old_states_per_body * old_body_count
        new_state = np.zeros(n + states_per_body * self._positions_m.size)
        new_state[:n] = old_state[:n]
        if old_obstacles is not None:
            modal_state_count = min(
                self._oscillating_state_count, old_obstacles._oscillating_state_count
            )
            real_state_count = min(
                states_per_body - self._oscillating_state_count,
                old_states_per_body - old_obstacles._oscillating_state_count,
            )
            for body_index in range(old_body_count):
                new_body_states = new_state[n + body_index * states_per_body :]
                old_body_states = old_state[n + body_index * old_states_per_body :]
                new_body_states[:modal_state_count] = old_body_states[:modal_state_count]
                new_body_states[
                    self._oscillating_state_count : self._oscillating_state_count + real_state_count
                ] = old_body_states[
                    old_obstacles._oscillating_state_count : old_obstacles._oscillating_state_count
                    + real_state_count
                ]
            self._penetration_m.update(old_obstacles._penetration_m)
        self._displacement_m = self.displacement_rows @ new_state
        return new_state

    def remove(self, removed_body: Disturbance, time_s: float) -> None:
        """Remove an obstacle from the simulation at a time in seconds."""
        self._obstacles = [
            (
                body_index,
                replace(known_body, until_s=min(known_body.until_s, time_s))
                if known_body == removed_body
                else known_body,
                stiffness_n_per_m,
            )
            for body_index, known_body, stiffness_n_per_m in self._obstacles
        ]

    def store_forces(
        self,
        substep_matrices: "SubstepMatrices",
        forces_n: RealArray,
        unforced_displacement_m: RealArray,
    ) -> None:
        """Store the forces of a period, and the displacements and penetrations at its end."""
        self.forces_n = forces_n
        self._penetration_m = self._end_penetrations_m
        self._displacement_m = unforced_displacement_m[-1] + np.einsum(
            "jab,jb->a", substep_matrices.displacement_kernel[::-1], forces_n
        )


@dataclass(slots=True, eq=False)
class _ActiveObstacle:
    """Obstacle in one period: how far the beam penetrates it, and its force on the beam."""

    body_index: int
    side: int
    stiffness_n_per_m: float
    damping_n_per_m: float  # damping coefficient divided by the length of a substep
    compliance_m_per_n: float  # displacement of the beam by 1 N within a substep
    unforced_penetration_m: RealArray  # penetration at the end of each substep if no force acts
    start_penetration_m: float  # penetration at the start of the present substep
    force_n: RealArray  # forces of the substeps computed so far, else 0; positive on either side
    end_penetration_m: float = -inf  # penetration at the end of the present substep

    def force_and_penetration(self, unforced_end_m: float) -> tuple[float, float]:
        """Return the mean force in N over a substep, and the penetration in m at its end.

        `unforced_end_m` is the penetration in m that the substep would end with if the obstacle
        exerted no force. The mean force follows from the work, as the module's docstring explains.
        """
        if unforced_end_m == -inf:  # the obstacle is not present
            return 0.0, unforced_end_m
        start_m, compliance_m_per_n, damping_n_per_m = (
            self.start_penetration_m,
            self.compliance_m_per_n,
            self.damping_n_per_m,
        )
        stiffness_n_per_m = self.stiffness_n_per_m
        if start_m == -inf:  # the obstacle has just appeared
            start_m = 0.0
        if start_m >= 0:
            squared_stiffness_ratio = (stiffness_n_per_m * compliance_m_per_n) ** 2
            # From 1/2, which conserves energy, to 1, which damps oscillation between substeps.
            end_weight = 0.5 + 0.5 * squared_stiffness_ratio / (1 + squared_stiffness_ratio)
            mean_force_n = stiffness_n_per_m * (
                (1 - end_weight) * start_m + end_weight * unforced_end_m
            ) + damping_n_per_m * (unforced_end_m - start_m)
            mean_force_n /= 1 + compliance_m_per_n * (
                stiffness_n_per_m * end_weight + damping_n_per_m
            )
            end_m = unforced_end_m - compliance_m_per_n * mean_force_n
            if end_m >= 0:
                return (mean_force_n, end_m) if mean_force_n > 0 else (0.0, unforced_end_m)
            # The beam leaves: (unforced_end - end) (start - end) / compliance
            # = k start²/2 - damping start (start - end)
            damped_end_m = unforced_end_m + compliance_m_per_n * damping_n_per_m * start_m
            root_m = sqrt(
                (damped_end_m - start_m) ** 2
                + 2 * compliance_m_per_n * stiffness_n_per_m * start_m * start_m
            )
            end_m = 0.5 * (damped_end_m + start_m - root_m)
            mean_force_n = (
                0.5 * stiffness_n_per_m * start_m * start_m / (start_m - end_m)
                - damping_n_per_m * start_m
            )
        elif unforced_end_m > 0:
            # The beam arrives: (unforced_end - end) (end - start) / compliance
            # = k end²/2 + damping end (end - start)
            square_coefficient = 1 + compliance_m_per_n * (
                0.5 * stiffness_n_per_m + damping_n_per_m
            )
            linear_coefficient = (
                unforced_end_m + start_m + compliance_m_per_n * damping_n_per_m * start_m
            )
            root_m = sqrt(
                linear_coefficient * linear_coefficient
                - 4 * square_coefficient * unforced_end_m * start_m
            )
            # Two forms of the positive root: choose the one without cancellation.
            end_m = (
                (linear_coefficient + root_m) / (2 * square_coefficient)
                if linear_coefficient > 0
                else 2 * unforced_end_m * start_m / (linear_coefficient - root_m)
            )
            mean_force_n = (
                0.5 * stiffness_n_per_m * end_m * end_m / (end_m - start_m)
                + damping_n_per_m * end_m
            )
        else:
            return 0.0, unforced_end_m
        return (mean_force_n, end_m) if mean_force_n > 0 else (0.0, unforced_end_m)


@dataclass(frozen=True, slots=True, eq=False)
class SubstepMatrices:
    """Matrices for computing the contact with obstacles in the substeps of a period.

    One instance is for a free motor, another for a locked motor.
    """

    unforced_displacement: Callable[[RealArray], RealArray]
    """Function that returns the displacement at the end of each substep if no force acts, body by
    body, from [state, torque before and after the switch, friction of the previous period]."""
    displacement_per_friction: RealArray
    """Displacement at the end of each substep per friction, m per N·m, shape (substeps, bodies)."""
    displacement_kernel: RealArray
    """Displacement in m per N at the end of the substep in which a force acts, and of each later
    substep, shape (substeps, bodies, bodies)."""
    displacement_history: RealArray
    """Displacement in m per N at the end of each substep by a force in each substep (last axis),
    shape (bodies, bodies, substeps, substeps)."""
    force_effect: Callable[[RealArray], RealArray]
    """Function that returns the effect of the forces of all substeps on [next state, outputs]."""
    velocity_index: int
    """Index of the velocity in [next state, outputs]."""


def _history_matrices(displacement_kernel: RealArray) -> RealArray:
    """Return the displacement in m per N at the end of each substep by a force in each substep.

    A `displacement_kernel` of shape (substeps, m, m) gives lower triangular matrices of shape
    (m, m, substeps, substeps) for m obstacles and impacts.
    """
    substep_count = len(displacement_kernel)
    substep_lags = np.subtract.outer(np.arange(substep_count), np.arange(substep_count))
    history_matrices: RealArray = np.where(
        substep_lags >= 0,
        displacement_kernel.transpose(1, 2, 0)[:, :, np.maximum(substep_lags, 0)],
        0.0,
    )
    return history_matrices


def _surface_displacement_m(body: Obstacle, time_s: Any) -> Any:  # noqa: ANN401 - one time or several
    """Return the displacement in m at which the beam just touches an obstacle, at given times."""
    return body.x_m * (body.angle_rad + body.rate_rad_s * (time_s - body.from_s))


def _substeps_per_period(beam: Beam, bodies: tuple[Disturbance, ...], period_s: float) -> int:
    """Return how many substeps per period are needed to resolve the contacts with all obstacles."""
    # A force that grows like k t moves a beam without ends by k t^(3/2) / unit.
    endless_beam_factor = (
        2 * sqrt(2) * beam.density_kg_per_m**0.75 * beam.bending_stiffness_n_m2**0.25
    )
    required_rates_per_s = [_MIN_SUBSTEPS_PER_S]
    for attached_body in bodies:
        if isinstance(attached_body, Obstacle):
            contact_rate_per_s = (
                min(attached_body.stiffness_n_per_m, _MAX_RESOLVED_STIFFNESS_N_PER_M)
                / endless_beam_factor
            ) ** (2 / 3)
            reach_m = (beam.density_over_stiffness * contact_rate_per_s**2) ** -0.25
            tip_proximity = exp((attached_body.x_m - beam.length_m) / reach_m)
            compliance_ratio = 1 + (_TIP_COMPLIANCE_RATIO - 1) * tip_proximity
            required_rates_per_s.append(
                _SUBSTEPS_PER_CONTACT_TIME * contact_rate_per_s * compliance_ratio ** (2 / 3)
            )
    return max(_MIN_SUBSTEPS_PER_PERIOD, ceil(max(required_rates_per_s) * period_s))


def _displacement_per_angle(
    beam: Beam, damping: Damping, x_m: float, s: ComplexArray
) -> ComplexArray:
    """Return the transfer function in m/rad from motor angle to beam displacement at `x_m`."""
    return PointForceGrid(s, beam, damping).displacement_per_angle(x_m)
