"""The simulated beam in air against the analyzer's model of the drag, which is not a simulation."""

from dataclasses import replace

import numpy as np
import pytest
from cases import further
from shipped_profile import load_shipped

from analysis.identify import Comparison, Measurement
from analysis.identify.drag_torque import DragLaw, DragResponse
from rigd.beam import Damping, Plant, PointForceGrid
from rigd.sim import SimulatedPlant

DRAG_M = 2.3e-3
RATE_HZ = 1000.0
TICKS = 25_000


def rig(drag_m, damping, coulomb_nm=0.0, delay_s=0.0):
    parameters = load_shipped("sim").rig
    assert parameters.simulation is not None
    return replace(
        parameters,
        damping=damping,
        motor=replace(parameters.motor, coulomb_nm=coulomb_nm, peak_torque_nm=20.0),
        actuation=replace(parameters.actuation, delay_s=1 / RATE_HZ),
        encoder=replace(parameters.encoder, delay_s=0.0),
        sensor=replace(parameters.sensor, delay_s=delay_s),
        simulation=replace(parameters.simulation, air_drag_m=drag_m),
    )


def swept(parameters):
    """Angle and the sensor's torque under a sweep to 20 Hz, the coupling torque fed forward."""
    plant = SimulatedPlant(parameters)
    plant.enable()
    t = np.arange(TICKS) / RATE_HZ - 1
    reference = np.where((t > 0) & (t < 20), 0.025 * np.sin(2 * np.pi * (0.05 + 0.5 * t) * t), 0.0)
    stiffness, viscosity = 12.0, 0.35
    rows, before = np.empty((TICKS, 2)), 0.0
    for tick, angle in enumerate(reference.tolist()):
        rows[tick] = plant.sensed_angle_rad, plant.sensed_torque_nm
        speed = (angle - before) * RATE_HZ
        before = angle
        plant.command(
            stiffness * (angle - plant.angle_rad)
            + viscosity * (speed - plant.velocity_rad_s)
            + plant.coupling_torque_nm
        )
        plant.advance()
    return rows.T


def unexplained(parameters, drag_m):
    """Fraction of the simulated torque that the model with a drag leaves, and that of the drag."""
    angle_rad, torque_nm = swept(parameters)
    known = np.ones(TICKS, dtype=bool)
    measured = Measurement(
        "m", angle_rad, torque_nm, RATE_HZ, parameters.beam, known, known, 0.0,
        tool_inertia_kg_m2=parameters.sensor.tool_inertia_kg_m2,
        delay_s=parameters.sensor.delay_s,
    )  # fmt: skip
    compared = Comparison.from_measurement(measured, (0.0, 50.0))
    plant = Plant(
        parameters.beam, parameters.damping, measured.delay_s, measured.tool_inertia_kg_m2
    )
    linear = compared.torque_predictor.torque(plant)[0]
    response = DragResponse(compared.angle_rad, compared.decimation.rate_hz, plant)
    drag = response.torque(DragLaw(drag_m)).torque_nm[compared.retained_samples]
    measured_nm = compared.torque_nm[compared.retained_samples]
    left, by_drag, whole = (
        float(np.linalg.norm(compared.spectrum(values)))
        for values in (linear + drag - measured_nm, drag, measured_nm)
    )
    return left / whole, by_drag / whole


@pytest.mark.fit
@pytest.mark.parametrize(
    ("damping", "coulomb_nm", "delay_s"),
    [
        further(Damping(5.4e-5, 1.0, 0.02, 1.0), 0.0, 0.0, id="integer orders"),
        further(Damping(7.1e-5, 0.996, 0.055, 0.594), 0.03, 0.0, id="fractional, with friction"),
        pytest.param(
            Damping(7.1e-5, 0.996, 0.055, 0.594), 0.0, 0.4e-3, id="a sensor between two ticks"
        ),
    ],
)
def test_the_simulated_drag_is_that_of_the_exact_beam(damping, coulomb_nm, delay_s):
    left, by_drag = unexplained(rig(DRAG_M, damping, coulomb_nm, delay_s), DRAG_M)
    assert by_drag > 0.3
    assert left < 2e-3


@pytest.mark.fit
def test_no_drag_by_default():
    damping = Damping(7.1e-5, 0.996, 0.055, 0.594)
    still, braked = (swept(rig(drag_m, damping)) for drag_m in (0.0, DRAG_M))
    assert np.abs(still - braked).max() > 0.01
    left, _ = unexplained(rig(0.0, damping), 0.0)
    assert left < 1e-3


def test_the_air_s_torque_and_shear_are_those_of_its_force():
    parameters = rig(DRAG_M, Damping(7.1e-5, 0.996, 0.055, 0.594))
    plant = SimulatedPlant(parameters)
    plant.enable()
    grid = plant._air._grid
    ticks = 6000
    outputs, forces = np.empty((ticks, 3)), np.empty((ticks, grid.x_m.size))
    for tick in range(ticks):
        outputs[tick] = plant.angle_rad, plant.coupling_torque_nm, plant.base_shear_n
        forces[tick] = plant._air._forces[plant._air._newest] * grid.quadrature_weight_m
        plant.command(0.15 * np.sin(2 * np.pi * 1.7e-3 * tick) - 0.1 * plant.velocity_rad_s)
        plant.advance()
    padded = 1 << 15
    decay = np.exp(-8 * np.arange(ticks) / ticks)
    s = 8 * RATE_HZ / ticks + 2j * np.pi * np.fft.rfftfreq(padded, 1 / RATE_HZ)
    exact = PointForceGrid(s, parameters.beam, parameters.damping)
    angle, *_ = np.fft.rfft(outputs.T * decay, padded)
    pushed = np.fft.rfft(forces.T * decay, padded).T
    for column, per_angle, per_force in (
        (1, exact.torque_per_angle(), exact.torque_per_force(grid.x_m)),
        (2, exact.shear_per_angle(), exact.shear_per_force(grid.x_m)),
    ):
        drag = np.fft.irfft((per_force * pushed).sum(axis=1), padded)[:ticks] / decay
        whole = np.fft.irfft(per_angle * angle, padded)[:ticks] / decay + drag
        first_half = slice(0, ticks // 2)
        scale = np.std(outputs[first_half, column])
        assert np.std(drag[first_half]) > 0.1 * scale
        assert np.std((outputs[:, column] - whole)[first_half]) < 0.01 * scale
