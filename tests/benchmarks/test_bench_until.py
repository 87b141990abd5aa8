"""Sessions that end themselves, on a non-uniform beam of finite elements in air."""

import pytest
from bench_until import draw_uneven, intervals, run
from finite_element_rig import Plant

from rigd.profile import load_profile

pytestmark = pytest.mark.further


def test_finite_element_rig_conserves_momentum():
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
def test_no_damping_ratio_in_air_is_wrong_without_a_flag():
    rig = draw_uneven(1, 11)
    assert rig.air_drag_m > 1.5e-3
    result = run(rig, 60.0, [])
    assert len(result["modes"]) == 3
    assert any("air drag" in text for text in result["findings"])
    for name, true, value, low, high in intervals(result):
        if name.startswith("damping"):
            assert abs(value - true) < 4 * (high - low) / 3.92, name
