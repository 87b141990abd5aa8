"""Sessions that end themselves on a beam of finite elements, which is not uniform and in air."""

import numpy as np
import pytest
from bench_until import draw_uneven, intervals, run
from finite_element_rig import Plant

from rigd.profile import load_profile

pytestmark = pytest.mark.further


def test_the_rig_of_finite_elements_keeps_momentum_and_stops_in_air():
    rig = load_profile("sim").rig
    beam = draw_uneven(1, 11).modal_beam()
    plant = Plant(rig, beam)
    plant.enable()
    plant.command(0.2)
    for _ in range(50):
        plant.advance()
        assert abs(plant.torque_nm) < 0.3
    assert plant.angle_rad > 0
    plant.disable()
    last = plant.angle_rad
    for _ in range(60_000):
        plant.advance()
    resting = plant.angle_rad
    plant.advance()
    assert resting > last
    assert plant.angle_rad == pytest.approx(resting, abs=1e-9)
    assert abs(plant.torque_nm) < 1e-3


@pytest.mark.process
@pytest.mark.fit
def test_damping_ratios_of_an_uneven_beam_in_air_are_those_without_air():
    rig = draw_uneven(1, 11)
    assert rig.air_drag_m > 1.5e-3
    result = run(rig, 60.0, [])
    found = {name: (true, value, low, high) for name, true, value, low, high in intervals(result)}
    (drag,) = (text for text in result["findings"] if "air drag" in text)
    estimate_mm, std_mm = (float(drag.split("C_D d = ")[1].split()[i]) for i in (0, 2))
    assert abs(estimate_mm - 1e3 * rig.air_drag_m) < 4 * std_mm
    for mode in (1, 2, 3):
        true, value, low, high = found[f"damping {mode}"]
        assert abs(value - true) < 4 * (high - low) / 3.92
        assert np.isfinite(value)
