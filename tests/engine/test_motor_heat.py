"""The motor's heat is stored between connections to hardware, and decays meanwhile."""

import json
from dataclasses import replace
from math import exp

import pytest

from rigd.engine import cycle
from rigd.engine.cycle import make_limit_monitor, store_motor_heat, stored_motor_heat_nm2
from rigd.engine.messages import SessionFinished
from rigd.excitation import chirp
from rigd.profile import load_profile


@pytest.fixture
def profile(runtime_folder):
    return load_profile("antenna_can")


@pytest.fixture
def heat_file(runtime_folder):
    """The file of the motor's heat, or None."""
    return lambda: next(runtime_folder.rglob("heat-*.json"), None)


@pytest.fixture
def at(monkeypatch):
    """Set the time since the computer was started, s."""

    def move(now_s):
        monkeypatch.setattr(cycle.time, "clock_gettime", lambda _: now_s)

    move(1000.0)
    yield move
    monkeypatch.undo()


def test_a_motor_cools_down_by_its_time_constant(profile, at):
    assert stored_motor_heat_nm2(profile) == 0.0
    store_motor_heat(profile, 0.5)
    assert stored_motor_heat_nm2(profile) == pytest.approx(0.5)
    at(1007.0)
    time_constant_s = profile.rig.motor.thermal_time_constant_s
    assert stored_motor_heat_nm2(profile) == pytest.approx(0.5 * exp(-7.0 / time_constant_s))
    assert make_limit_monitor(profile, 0.25).heat_nm2 == 0.25


def test_heat_before_a_restart_is_dropped_and_heat_is_bounded(profile, at):
    store_motor_heat(profile, 1e9)
    assert stored_motor_heat_nm2(profile) == profile.rig.motor.peak_torque_nm**2
    at(999.0)
    assert stored_motor_heat_nm2(profile) == 0.0


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", '{"heat_nm2": "x", "boot_s": 1}', '{"heat_nm2": 1}',
             '{"heat_nm2": NaN, "boot_s": 1}', '{"heat_nm2": 1, "boot_s": NaN}'],
)  # fmt: skip
def test_an_unusable_file_is_a_cold_motor(profile, heat_file, text):
    store_motor_heat(profile, 1.0)
    heat_file().write_text(text)
    assert stored_motor_heat_nm2(profile) == 0.0


def test_a_motor_is_cold_without_a_folder(profile, monkeypatch, tmp_path):
    (tmp_path / "rigd").touch()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    store_motor_heat(profile, 1.0)
    assert stored_motor_heat_nm2(profile) == 0.0


@pytest.mark.parametrize("simulated", [False, True])
def test_connections_in_a_row_add_up_on_hardware_alone(make_session, heat_file, simulated):
    """Sessions with torque, each on its own connection, as with repeated `rigd run`."""
    heat = []
    for _ in range(2):
        session = make_session()
        session.devices = replace(session.devices, simulated=simulated)
        sweep = chirp(
            rate_hz=session.profile.rig.rate_hz,
            amplitude_rad=0.02,
            start_hz=1.0,
            stop_hz=10.0,
            duration_s=1.0,
            rest_s=0.1,
            ring_down_s=0.0,
        )
        session.obey(session.order(sweep))
        assert session.parent.messages_of(SessionFinished)[0].outcome == "complete"
        if not simulated:
            heat.append(json.loads(heat_file().read_text())["heat_nm2"])
    if simulated:
        assert heat_file() is None
    else:
        assert heat[1] > 1.2 * heat[0] > 0.0
