"""One period of the simulated rig as matrices: motor and beam, on a free and on a locked shaft.

The input is the state, the motor's torque before and after it changes, and the friction; the output
is the state at the period's end and the quantities for sensors and friction.
"""

from dataclasses import replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from rigd.beam import Beam, LoadedBeam
from rigd.beam.realisation import (
    CoupledModel,
    Realisation,
    RealisationError,
    couple,
    held_inputs,
    propagator,
    realise,
    state_output,
    with_filter,
)
from rigd.devices.parameters import RigParameters, Simulation
from rigd.sim._stiffness_drift import in_displacements

Real = NDArray[np.float64]

OUTPUTS = 8
"""Rows of a step beyond the state: angle, velocity, sensor torque, the same if the shaft did not
accelerate, base shear, sensed angle, sensed torque, sensed shear."""

_SAME_INSTANT_PERIODS = 1e-9


def models_of(
    parameters: RigParameters, simulation: Simulation, modes_of: Beam | None = None
) -> tuple[Realisation, CoupledModel, CoupledModel]:
    """Realise the beam, and attach it to the free and to the locked shaft.

    Parameters
    ----------
    parameters
        The rig, with the beam as it is simulated.
    simulation
        What is at the beam and in its sensor.
    modes_of
        As for `realise`.
    """
    beam = realise(
        parameters.beam,
        parameters.damping,
        tip_mass_kg=simulation.tip_mass_kg,
        root_compliance_rad_per_nm=simulation.clamp_compliance_rad_per_nm,
        modes_of=modes_of,
    )
    loaded = LoadedBeam(
        parameters.beam,
        parameters.damping,
        simulation.tip_mass_kg,
        simulation.clamp_compliance_rad_per_nm,
    )
    attach = partial(
        couple,
        beam,
        tool_inertia_kg_m2=parameters.sensor.tool_inertia_kg_m2,
        shear=state_output(beam, loaded.shear, inertial=True),
    )
    free = attach(
        motor_inertia_kg_m2=parameters.motor.inertia_kg_m2,
        viscous_nm_s_per_rad=parameters.motor.viscous_nm_s_per_rad,
    )
    # No torque turns an infinite inertia: the beam on a locked shaft.
    locked = attach(motor_inertia_kg_m2=np.inf)
    if simulation.torque_filter_hz > 0:
        free, locked = (
            with_filter(model, simulation.torque_filter_hz, simulation.torque_filter_order)
            for model in (free, locked)
        )
    return beam, free, locked


def steps_of(
    free: CoupledModel, locked: CoupledModel, period_s: float, instants: tuple[float, float, float]
) -> tuple[Real, Real, Real]:
    """One period on the free and on the locked shaft, and what friction of 1 N·m does in it.

    A period's friction is known only after its step, from the speed reached without it. The outputs
    are then corrected at once, the state by a last column of the next step.

    Parameters
    ----------
    free, locked
        Motor and beam.
    period_s, instants
        As for `_step`.

    Returns
    -------
    step, locked_step : (n + 8, n + 3)
    friction : (n + 8,)
    """
    n = free.b.size
    step = _step(free, locked.sensor_torque, period_s, *instants)
    locked_step = _step(locked, locked.sensor_torque, period_s, *instants)
    friction = -(step[:, n] + step[:, n + 1])
    step = np.column_stack([step, step[:, :n] @ friction[:n]])
    locked_step = np.column_stack([locked_step, locked_step[:, :n] @ friction[:n]])
    return step, locked_step, friction


def arrays_at(
    stiffness_ratio: float,
    parameters: RigParameters,
    simulation: Simulation,
    at_start: Realisation,
    period_s: float,
    instants: tuple[float, float, float],
) -> tuple[Real, Real, Real, Real]:
    """Compute the arrays of a step for a beam whose stiffness has drifted.

    Parameters
    ----------
    stiffness_ratio
        The stiffness over that at the start.
    parameters, simulation
        As for `models_of`, at the start.
    at_start
        The beam there.
    period_s, instants
        As for `_step`.

    Returns
    -------
    step, locked_step : (n + 8, n + 3)
    friction_effects : (8,)
    per_torque : (2,)
        Immediate effect of the motor's torque on torque and shear of the sensor.

    Raises
    ------
    RealisationError
        If the beam cannot be realised at that stiffness.
    """
    own = parameters.beam
    drifted = replace(own, bending_stiffness_n_m2=stiffness_ratio * own.bending_stiffness_n_m2)
    try:
        beam, *models = models_of(replace(parameters, beam=drifted), simulation, own)
    except RealisationError as error:
        raise RealisationError(
            "simulation.stiffness_drift_per_s: this beam cannot be simulated at "
            f"{stiffness_ratio:.4g} times its stiffness, which it drifts to; leave the drift out. "
            f"{error}"
        ) from error
    free, locked = (in_displacements(model, beam, at_start) for model in models)
    step, locked_step, friction = steps_of(free, locked, period_s, instants)
    per_torque = np.array([free.sensor_torque_per_torque, free.shear_per_torque])
    return step, locked_step, friction[free.b.size :], per_torque


def split_delay(delay_s: float, period_s: float) -> tuple[int, float]:
    """Return the whole periods in a delay, and the remainder in seconds.

    Parameters
    ----------
    delay_s, period_s
        The delay, and the length of a period.
    """
    periods = int(delay_s / period_s + _SAME_INSTANT_PERIODS)
    rest = delay_s - periods * period_s
    return periods, rest if rest > _SAME_INSTANT_PERIODS * period_s else 0.0


def _step(
    model: CoupledModel,
    holding_torque: Real,
    period_s: float,
    switch_s: float,
    angle_instant_s: float,
    torque_instant_s: float,
) -> Real:
    """One period: from [state, torque before and after the switch] to [next state, outputs].

    Parameters
    ----------
    model
        Motor and beam.
    holding_torque
        (n,) row: sensor torque on a shaft that does not accelerate.
    period_s
        Length of the step.
    switch_s
        Time at which the motor's torque changes, from the step's start.
    angle_instant_s, torque_instant_s
        Instants of the sensed values, from the start of the step.

    Returns
    -------
    (n + 8, n + 2)
    """

    @cache
    def state_at(instant_s: float) -> Real:
        phi, whole = propagator(model, instant_s)
        after = propagator(model, max(instant_s - switch_s, 0.0))[1]
        return np.column_stack([phi, whole - after, after])

    def torque_at(instant_s: float) -> Real:
        return at_once(model.sensor_torque, model.sensor_torque_per_torque, instant_s)

    def shear_at(instant_s: float) -> Real:
        return at_once(model.shear, model.shear_per_torque, instant_s)

    def at_once(of_state: Real, per_torque: float, instant_s: float) -> Real:
        """Return the row of the immediate effect of the torque."""
        row: Real = of_state @ state_at(instant_s)
        apart_s = instant_s - switch_s
        if abs(apart_s) <= _SAME_INSTANT_PERIODS * period_s:
            fraction_after = 0.5
        else:
            fraction_after = 1.0 if apart_s > 0 else 0.0
        row[-2:] += per_torque * np.array([1 - fraction_after, fraction_after])
        return row

    end = state_at(period_s)
    return np.vstack(
        [
            *_output_rows(model, end, torque_at(period_s), holding_torque),
            shear_at(period_s),
            model.angle @ state_at(angle_instant_s),
            torque_at(torque_instant_s)
            if model.sensed_torque is None
            else model.sensed_torque @ state_at(torque_instant_s),
            shear_at(torque_instant_s)
            if model.sensed_shear is None
            else model.sensed_shear @ state_at(torque_instant_s),
        ]
    )


def _output_rows(
    model: CoupledModel, end: Real, torque: Real, holding_torque: Real
) -> tuple[Real, ...]:
    """Return the rows of the state at a period's end, and of outputs other than the sensors'."""
    return end, model.angle @ end, model.velocity @ end, torque, holding_torque @ end


def held_of(
    model: CoupledModel,
    of_force: Real,
    holding_torque: Real,
    period_s: float,
    angle_instant_s: float,
    torque_instant_s: float,
) -> Real:
    """Return the effect of a constant force of the air over a period on [next state, outputs].

    Parameters
    ----------
    model
        Motor and beam.
    of_force
        Effect of the force on the state's derivative, (n, points).
    holding_torque, period_s, angle_instant_s, torque_instant_s
        As for `_step`.

    Returns
    -------
    (n + 8, points)
    """

    def state_at(instant_s: float) -> Real:
        return held_inputs(model, of_force, instant_s)

    end = state_at(period_s)
    return np.vstack(
        [
            *_output_rows(model, end, model.sensor_torque @ end, holding_torque),
            model.shear @ end,
            model.angle @ state_at(angle_instant_s),
            model.sensor_torque @ state_at(torque_instant_s),
            model.shear @ state_at(torque_instant_s),
        ]
    )
