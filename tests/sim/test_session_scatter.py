"""A simulated beam that differs between sessions: its draws, and its plant."""

from dataclasses import replace

import numpy as np
import pytest
from shipped_profile import load_shipped

from rigd.devices.obstacles import ObstacleError
from rigd.sim import SimulatedPlant, SimulatedRig, session_parameters

SCATTER = {
    "zeta_scatter_percent": 20.0, "gamma_scatter_percent": 7.0, "stiffness_scatter_percent": 0.5,
}  # fmt: skip


def rig_with(**more):
    rig = load_shipped("sim").rig
    return replace(rig, simulation=replace(rig.simulation, **more))


def ratios(rig, seed):
    found = session_parameters(rig, seed)
    return (
        found.damping.zeta / rig.damping.zeta,
        found.damping.gamma / rig.damping.gamma,
        found.simulation.stiffness_ratio / rig.simulation.stiffness_ratio,
    )


def test_the_logarithms_have_the_standard_deviation_stated():
    rig = rig_with(**SCATTER)
    logarithms = np.log([ratios(rig, seed) for seed in range(2000)])
    stated = np.array([0.2, 0.07, 0.005])
    assert logarithms.std(axis=0) == pytest.approx(stated, rel=0.06)
    assert np.abs(logarithms.mean(axis=0) / stated).max() < 0.08
    assert np.abs(np.corrcoef(logarithms.T) - np.eye(3)).max() < 0.08
    assert ratios(rig, 5) == ratios(rig, 5)


def test_each_parameter_has_its_own_draw():
    alone = ratios(rig_with(gamma_scatter_percent=7.0), 5)
    assert alone == (1.0, ratios(rig_with(**SCATTER), 5)[1], 1.0)
    plain = rig_with()
    assert session_parameters(plain, 5) is plain


def torques_of(plant, ticks=400):
    plant.enable()
    found = []
    for tick in range(ticks):
        found.append((plant.angle_rad, plant.sensed_torque_nm))
        plant.command(0.3 * np.sin(0.02 * tick))
        plant.advance()
    return np.array(found)


def test_a_session_has_the_plant_of_its_seed():
    rig = rig_with(**SCATTER)
    plain = torques_of(SimulatedPlant(rig))
    for seed in (5, 6):
        simulated = SimulatedRig(rig)
        plant = simulated.plant
        simulated.begin_session(seed)
        assert simulated.plant is plant  # drive and sensor have it
        found = torques_of(plant)
        expected = torques_of(SimulatedPlant(session_parameters(rig, seed)))
        assert found == pytest.approx(expected, abs=1e-12)
        assert np.abs(found - plain).max() > 1e-4


@pytest.mark.parametrize("more", [{}, {"torque_filter_hz": 100.0}])
def test_a_session_begins_at_rest_at_the_last_angle(more):
    simulated = SimulatedRig(rig_with(**SCATTER, **more))
    plant = simulated.plant
    torques_of(plant)
    plant.disable()
    angle_rad = plant.angle_rad
    assert abs(angle_rad) > 0.01
    simulated.begin_session(5)
    assert (plant.angle_rad, plant.enabled) == (angle_rad, False)
    for _ in range(200):
        plant.advance()
        assert plant.angle_rad == pytest.approx(angle_rad, abs=1e-9)
        assert plant.sensed_angle_rad == pytest.approx(angle_rad, abs=1e-9)
        assert plant.sensed_torque_nm == pytest.approx(0.0, abs=2e-5)


def test_scatter_with_obstacles_is_refused():
    with pytest.raises(ObstacleError, match="gamma_scatter_percent and an obstacle cannot"):
        SimulatedPlant(rig_with(gamma_scatter_percent=5.0, obstacles=("x=0.6,angle=0.1",)))
