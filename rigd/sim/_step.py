"""Matrices for one period of the simulated rig: motor and beam, with a free or a locked shaft.

The input consists of the state, the motor's torque before and after its change within the period,
and the friction. The output consists of the state at the end of the period and the quantities for
sensors and friction.
"""

from dataclasses import replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Beam, Plant
from rigd.beam.realisation import (
    CoupledModel,
    Realisation,
    RealisationError,
    couple,
    propagator,
    realise,
    state_output,
    states_after_constant_inputs,
    with_filter,
)
from rigd.devices.parameters import RigParameters, Simulation
from rigd.sim._stiffness_drift import with_modal_displacements

RealArray = NDArray[np.float64]
"""Array of real numbers."""

STEP_OUTPUT_COUNT = 8
"""Number of outputs of a step in addition to the state.

They are angle, velocity, sensor torque, sensor torque on a shaft that does not accelerate, base
shear, sensed angle, sensed torque, sensed shear."""

_SAME_INSTANT_PERIODS = 1e-9
"""Difference of two instants, in periods, below which they count as equal."""


def beam_and_coupled_models(
    parameters: RigParameters, simulation: Simulation, mode_selection_beam: Beam | None = None
) -> tuple[Realisation, CoupledModel, CoupledModel]:
    """Return the realisation of the beam, and the models of the beam on a free and a locked shaft.

    The beam of `parameters` is simulated, with tip mass, clamp compliance and sensor filter of
    `simulation`. `mode_selection_beam` is the argument `modes_of` of
    :func:`rigd.beam.realisation.realise`.
    """
    plant = Plant(
        parameters.beam,
        parameters.damping,
        tip_mass_kg=simulation.tip_mass_kg,
        root_compliance_rad_per_nm=simulation.clamp_compliance_rad_per_nm,
    )
    beam_realisation = realise(plant, mode_selection_beam=mode_selection_beam)
    attach_beam = partial(
        couple,
        beam_realisation,
        tool_inertia_kg_m2=parameters.sensor.tool_inertia_kg_m2,
        shear=state_output(beam_realisation, plant.shear_response, has_inertial_term=True),
    )
    free_shaft_model = attach_beam(
        motor_inertia_kg_m2=parameters.motor.inertia_kg_m2,
        viscous_nm_s_per_rad=parameters.motor.viscous_nm_s_per_rad,
    )
    # No torque turns an infinite inertia: the beam on a locked shaft.
    locked_shaft_model = attach_beam(motor_inertia_kg_m2=np.inf)
    if simulation.torque_filter_hz > 0:
        free_shaft_model, locked_shaft_model = (
            with_filter(coupled_model, simulation.torque_filter_hz, simulation.torque_filter_order)
            for coupled_model in (free_shaft_model, locked_shaft_model)
        )
    return beam_realisation, free_shaft_model, locked_shaft_model


def free_and_locked_steps(
    free_shaft_model: CoupledModel,
    locked_shaft_model: CoupledModel,
    period_s: float,
    switch_and_sample_instants_s: tuple[float, float, float],
) -> tuple[RealArray, RealArray, RealArray]:
    """Return the step matrices for a free and a locked shaft, and the effect of 1 N·m of friction.

    The matrices have the shape (n + 8, n + 3), and the effect has the shape (n + 8,).
    `switch_and_sample_instants_s` are `torque_switch_s`, `angle_instant_s` and `torque_instant_s`
    of `_step_matrix`.

    The friction of a period is known only after the period's step, from the speed reached without
    friction. The outputs are then corrected at once, and the state by the last column of the next
    step's matrix.
    """
    n = free_shaft_model.b.size
    free_shaft_matrix = _step_matrix(
        free_shaft_model,
        locked_shaft_model.sensor_torque_output_row,
        period_s,
        *switch_and_sample_instants_s,
    )
    locked_shaft_matrix = _step_matrix(
        locked_shaft_model,
        locked_shaft_model.sensor_torque_output_row,
        period_s,
        *switch_and_sample_instants_s,
    )
    friction_effect = -(free_shaft_matrix[:, n] + free_shaft_matrix[:, n + 1])
    free_shaft_matrix = np.column_stack(
        [free_shaft_matrix, free_shaft_matrix[:, :n] @ friction_effect[:n]]
    )
    locked_shaft_matrix = np.column_stack(
        [locked_shaft_matrix, locked_shaft_matrix[:, :n] @ friction_effect[:n]]
    )
    return free_shaft_matrix, locked_shaft_matrix, friction_effect


def drifted_step_arrays(
    stiffness_ratio: float,
    parameters: RigParameters,
    simulation: Simulation,
    initial_realisation: Realisation,
    period_s: float,
    switch_and_sample_instants_s: tuple[float, float, float],
) -> tuple[RealArray, RealArray, RealArray, RealArray]:
    """Return matrices and effects of a step for a beam whose bending stiffness has drifted.

    Return the matrices for a free and a locked shaft, shape (n + 8, n + 3), the effect of 1 N·m of
    friction on the outputs, shape (8,), and the immediate effect of the motor's torque on torque
    and shear of the sensor, shape (2,). `stiffness_ratio` is relative to the start of the drift, to
    which `parameters`, `simulation` and `initial_realisation` belong.
    `switch_and_sample_instants_s` are as for `free_and_locked_steps`. Raise
    `RealisationError` if the beam cannot be realised at that stiffness.
    """
    beam_at_start = parameters.beam
    drifted_beam = replace(
        beam_at_start, bending_stiffness_n_m2=stiffness_ratio * beam_at_start.bending_stiffness_n_m2
    )
    try:
        drifted_realisation, *coupled_models = beam_and_coupled_models(
            replace(parameters, beam=drifted_beam), simulation, beam_at_start
        )
    except RealisationError as error:
        raise RealisationError(
            "simulation.stiffness_drift_per_s: this beam cannot be simulated at "
            f"{stiffness_ratio:.4g} times its stiffness, which it drifts to; leave the drift "
            f"out. {error}"
        ) from error
    free_shaft_model, locked_shaft_model = (
        with_modal_displacements(coupled_model, drifted_realisation, initial_realisation)
        for coupled_model in coupled_models
    )
    free_matrix, locked_matrix, friction_effect = free_and_locked_steps(
        free_shaft_model, locked_shaft_model, period_s, switch_and_sample_instants_s
    )
    effects_per_torque = np.array(
        [free_shaft_model.sensor_torque_per_torque, free_shaft_model.shear_per_torque]
    )
    return (
        free_matrix,
        locked_matrix,
        friction_effect[free_shaft_model.b.size :],
        effects_per_torque,
    )


def split_delay(delay_s: float, period_s: float) -> tuple[int, float]:
    """Split a delay into a number of whole periods and a remainder in seconds."""
    whole_periods = int(delay_s / period_s + _SAME_INSTANT_PERIODS)
    remainder_s = delay_s - whole_periods * period_s
    return whole_periods, remainder_s if remainder_s > _SAME_INSTANT_PERIODS * period_s else 0.0


def _step_matrix(
    model: CoupledModel,
    holding_torque_row: RealArray,
    period_s: float,
    torque_switch_s: float,
    angle_instant_s: float,
    torque_instant_s: float,
) -> RealArray:
    """Return the matrix of a step of the plant, which lasts one period.

    The matrix, shape (n + 8, n + 2), maps [state, motor torque before and after its change] to
    [state, outputs]. The row `holding_torque_row`, shape (n,), gives from the state the sensor
    torque on a shaft that does not accelerate. Counted from the start of the step, the motor's
    torque changes at `torque_switch_s`, and angle and torque are sensed at `angle_instant_s` and
    `torque_instant_s`.
    """

    @cache
    def state_at(instant_s: float) -> RealArray:
        phi, step_response = propagator(model, instant_s)
        response_after_switch = propagator(model, max(instant_s - torque_switch_s, 0.0))[1]
        return np.column_stack([phi, step_response - response_after_switch, response_after_switch])

    def torque_at(instant_s: float) -> RealArray:
        return row_with_immediate_effect(
            model.sensor_torque_output_row, model.sensor_torque_per_torque, instant_s
        )

    def shear_at(instant_s: float) -> RealArray:
        return row_with_immediate_effect(model.shear_output_row, model.shear_per_torque, instant_s)

    def row_with_immediate_effect(
        state_row: RealArray, output_per_torque: float, instant_s: float
    ) -> RealArray:
        """Return the row of an output on which the motor torque acts at once."""
        output_row: RealArray = state_row @ state_at(instant_s)
        time_after_switch_s = instant_s - torque_switch_s
        if abs(time_after_switch_s) <= _SAME_INSTANT_PERIODS * period_s:
            fraction_after_switch = 0.5
        else:
            fraction_after_switch = 1.0 if time_after_switch_s > 0 else 0.0
        output_row[-2:] += output_per_torque * np.array(
            [1 - fraction_after_switch, fraction_after_switch]
        )
        return output_row

    end_state_rows = state_at(period_s)
    return np.vstack(
        [
            *_output_rows(model, end_state_rows, torque_at(period_s), holding_torque_row),
            shear_at(period_s),
            model.angle_output_row @ state_at(angle_instant_s),
            torque_at(torque_instant_s)
            if model.sensed_torque_output_row is None
            else model.sensed_torque_output_row @ state_at(torque_instant_s),
            shear_at(torque_instant_s)
            if model.sensed_shear_output_row is None
            else model.sensed_shear_output_row @ state_at(torque_instant_s),
        ]
    )


def _output_rows(
    model: CoupledModel,
    end_state_rows: RealArray,
    torque_row: RealArray,
    holding_torque_row: RealArray,
) -> tuple[RealArray, ...]:
    """Return the step matrix's first rows: state after a period, angle, speed and both torques."""
    return (
        end_state_rows,
        model.angle_output_row @ end_state_rows,
        model.velocity_output_row @ end_state_rows,
        torque_row,
        holding_torque_row @ end_state_rows,
    )


def constant_force_effect(
    model: CoupledModel,
    force_input: RealArray,
    holding_torque_row: RealArray,
    period_s: float,
    angle_instant_s: float,
    torque_instant_s: float,
) -> RealArray:
    """Return the effect of a drag force, constant over a period, on the next state and outputs.

    The effect has the shape (n + 8, points). `force_input`, shape (n, points), is the derivative of
    the state by the force per metre at the points of the beam. The other arguments are as for
    `_step_matrix`.
    """

    def state_at(instant_s: float) -> RealArray:
        return states_after_constant_inputs(model, force_input, instant_s)

    end_states = state_at(period_s)
    return np.vstack(
        [
            *_output_rows(
                model, end_states, model.sensor_torque_output_row @ end_states, holding_torque_row
            ),
            model.shear_output_row @ end_states,
            model.angle_output_row @ state_at(angle_instant_s),
            model.sensor_torque_output_row @ state_at(torque_instant_s),
            model.shear_output_row @ state_at(torque_instant_s),
        ]
    )
