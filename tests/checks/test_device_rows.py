"""Rows of the devices, which are never enabled and always closed."""

from dataclasses import replace

import pytest

from rigd.check_rows import CheckResult, overall_verdict
from rigd.checks.devices import inspect_devices
from rigd.devices.cia402 import DriveCapabilities
from rigd.devices.cia402.requirements import Watchdog
from rigd.devices.contracts import DeviceError
from rigd.profile import load_profile


def by_name(rows):
    return {(row.group, row.what): row for row in rows}


def test_a_healthy_rig(can_profile, stand_ins):
    # A computer that pauses meets no deadline, not even with a stand-in.
    acquisition = replace(can_profile.rig.acquisition, deadline_us=1e6)
    rig = replace(can_profile.rig, acquisition=acquisition)
    rows = inspect_devices(replace(can_profile, rig=rig))
    assert overall_verdict(rows) == "ok"
    found = by_name(rows)
    assert found["link", "what moves"].found == "the hardware"
    assert found["link", "CAN"].found == "can0 (socketcan)"
    assert found["drive", "vendor id"].found == "0x1234"
    assert found["drive", "serial number"].found == "not stated by the drive"
    assert found["sensor", "firmware"].found == "3.8.2"
    assert found["sensor", "calibration date"].found == "2020-01-02"
    assert found["sensor", "range"].found == "20, 20, 60, 1, 1, 1 N, N·m"
    assert found["sensor", "polls"].found == "1500 Hz"
    assert found["sensor", "turnaround median"].found == "0.4 ms"
    assert found["exchange", "angles missing"].found == "0 of 100 ticks"


def test_no_torque_and_everything_closed(can_profile, stand_ins):
    inspect_devices(can_profile)
    calls = stand_ins.calls
    assert not {"drive.enable", "drive.command"} & set(calls)
    assert calls.index("sensor.connect") < calls.index("drive.connect")
    assert stand_ins.closed
    assert calls[-2:] == ["drive.close", "sensor.close"]
    # As in a session: the angle is latched before the sensor is polled.
    assert calls.index("drive.latch") < calls.index("sensor.request")


@pytest.mark.parametrize("device", ["drive", "sensor"])
@pytest.mark.parametrize(
    "error", [DeviceError("it is dead"), OSError(19, "No such device")], ids=repr
)
def test_a_dead_device_fails_and_the_other_is_checked(can_profile, stand_ins, device, error):
    other = {"drive": "sensor", "sensor": "drive"}[device]
    getattr(stand_ins, device).fails_at["connect"] = error
    rows = inspect_devices(can_profile)
    found = by_name(rows)
    assert found[device, "error"].verdict is CheckResult.FAIL
    assert found[device, "error"].found == str(error)
    assert found[other, "connection"].verdict is CheckResult.OK
    assert found["exchange", "ticks"].verdict is CheckResult.SKIPPED
    assert stand_ins.closed


@pytest.mark.parametrize("where", ["latch", "request", "measure"])
def test_an_error_while_measuring_fails(can_profile, stand_ins, where):
    device = stand_ins.drive if where == "latch" else stand_ins.sensor
    device.fails_at[where] = DeviceError("the bus is gone")
    rows = inspect_devices(can_profile)
    assert any(row.found == "the bus is gone" and row.verdict is CheckResult.FAIL for row in rows)
    assert stand_ins.closed


@pytest.mark.parametrize("where", ["connect", "latch"])
def test_ctrl_c_closes(can_profile, stand_ins, where):
    stand_ins.drive.fails_at[where] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        inspect_devices(can_profile)
    assert stand_ins.closed


def test_failure_to_close_a_device_leaves_no_other_open(can_profile, stand_ins):
    stand_ins.drive.fails_at["close"] = DeviceError("it will not let go")
    rows = inspect_devices(can_profile)
    assert stand_ins.closed
    assert overall_verdict(rows) == "failed"


def test_failure_to_open_devices(can_profile, monkeypatch):
    def refuse(rig):
        raise DeviceError("a simulated rig is running, and the hardware is here too")

    monkeypatch.setattr("rigd.checks.devices.open_devices", refuse)
    assert inspect_devices(can_profile)[-1].verdict is CheckResult.FAIL


@pytest.mark.parametrize(
    ("profile_range", "verdict"),
    [(1.0, CheckResult.OK), (0.5, CheckResult.OK), (1.1, CheckResult.FAIL)],
)
def test_a_range_beyond_the_sensors_fails(can_profile, stand_ins, profile_range, verdict):
    sensor = replace(can_profile.rig.sensor, range=(20.0, 20.0, 60.0, 1.0, 1.0, profile_range))
    profile = replace(can_profile, rig=replace(can_profile.rig, sensor=sensor))
    assert by_name(inspect_devices(profile))["sensor", "range"].verdict is verdict


def test_values_not_stated_by_the_sensor(can_profile, stand_ins):
    found = stand_ins.sensor.found
    found |= {"range_n_nm": "not stated by the sensor", "calibration_date": "", "owner": ""}
    del found["firmware"]
    rows = by_name(inspect_devices(can_profile))
    for what in ("range", "calibration date", "firmware"):
        assert rows["sensor", what].found == "not stated by the sensor"
        assert rows["sensor", what].verdict is CheckResult.OK
    assert rows["sensor", "more"].detail == "Sensor: counts per force 1000000."


@pytest.mark.parametrize(
    ("watchdog", "verdict"),
    [
        (Watchdog.HEARTBEAT, CheckResult.OK),
        (Watchdog.RPDO_DEADLINE, CheckResult.OK),
        (Watchdog.OWN, CheckResult.WARNING),
        (Watchdog.NONE, CheckResult.WARNING),
    ],
)
def test_a_missing_or_unproven_watchdog_is_a_warning(can_profile, stand_ins, watchdog, verdict):
    after_s = float("inf") if watchdog is Watchdog.NONE else 0.05
    stand_ins.drive.capabilities = lambda: DriveCapabilities({}, watchdog, after_s, (), ())
    row = by_name(inspect_devices(can_profile))["drive", "watchdog"]
    assert row.verdict is verdict
    if watchdog is Watchdog.NONE:
        assert row.found == "none: accepted"
        assert "STO" in row.detail


def test_warning_if_the_sensor_complains(can_profile, stand_ins):
    stand_ins.sensor.found["status"] = ["its watchdog has reset the board"]
    row = by_name(inspect_devices(can_profile))["sensor", "status"]
    assert row.verdict is CheckResult.WARNING
    assert "watchdog" in row.found


@pytest.mark.parametrize(
    ("key", "value", "verdict"),
    [
        ("polls_hz", 999.0, CheckResult.FAIL),
        ("polls_hz", 1001.0, CheckResult.OK),
        ("turnaround_median_s", 0.8e-3, CheckResult.FAIL),  # the deadline is 0.7 ms
        ("turnaround_median_s", float("nan"), CheckResult.FAIL),
        ("turnaround_p99_s", 0.8e-3, CheckResult.WARNING),
        ("lost", 1.0, CheckResult.WARNING),
    ],
)
def test_rate_and_turn_round_on_can(can_profile, stand_ins, key, value, verdict):
    stand_ins.sensor.measured[key] = value
    rows = [row for row in inspect_devices(can_profile) if row.group == "sensor"]
    worst = [row.verdict for row in rows if row.verdict is not CheckResult.OK]
    assert worst == ([] if verdict is CheckResult.OK else [verdict])


@pytest.mark.parametrize(
    ("key", "value", "verdict"),
    [
        ("records_hz", 7000.0, CheckResult.OK),
        ("records_hz", 6900.0, CheckResult.WARNING),
        ("records_hz", 6000.0, CheckResult.FAIL),
        ("checksum_errors", 2.0, CheckResult.WARNING),
        ("longest_gap_s", 16e-3, CheckResult.WARNING),  # an adapter's latency timer
    ],
)
def test_rate_of_a_stream(serial_profile, stand_ins, key, value, verdict):
    stand_ins.sensor.measured = {
        "records_hz": 7001.0,
        "checksum_errors": 0.0,
        "dropped_bytes": 0.0,
        "longest_gap_s": 2e-4,
        key: value,
    }
    stand_ins.sensor.cause = "The adapter holds records back."
    rows = [row for row in inspect_devices(serial_profile) if row.group == "sensor"]
    worst = [row.verdict for row in rows if row.verdict is not CheckResult.OK]
    assert worst == ([] if verdict is CheckResult.OK else [verdict])
    named = [row.what for row in rows if row.detail == stand_ins.sensor.cause]
    assert named == (["longest gap"] if key == "longest_gap_s" else [])


@pytest.mark.parametrize(
    ("every", "verdict"), [(0, CheckResult.OK), (25, CheckResult.WARNING), (2, CheckResult.FAIL)]
)
def test_missing_replies(can_profile, stand_ins, every, verdict):
    stand_ins.drive.stale_every = every
    row = by_name(inspect_devices(can_profile))["exchange", "angles missing"]
    assert row.verdict is verdict


def test_a_saturated_sensor_fails(can_profile, stand_ins):
    stand_ins.sensor.wrench_saturated = True
    row = by_name(inspect_devices(can_profile))["exchange", "sensor saturated"]
    assert row.verdict is CheckResult.FAIL


def test_warning_if_the_shaft_moves_by_itself(can_profile, stand_ins):
    stand_ins.drive.angles_rad = iter(tick * 1e-4 for tick in range(100))
    row = by_name(inspect_devices(can_profile))["exchange", "shaft moved"]
    assert row.verdict is CheckResult.WARNING


def test_no_wait_for_replies_of_the_previous_tick(can_profile, stand_ins):
    acquisition = replace(can_profile.rig.acquisition, mode="previous_tick")
    profile = replace(can_profile, rig=replace(can_profile.rig, acquisition=acquisition))
    row = by_name(inspect_devices(profile))["exchange", "both replies after"]
    assert row.verdict is CheckResult.SKIPPED


def test_replies_after_the_deadline_fail(can_profile, stand_ins):
    # No reply comes within 0.1 µs: not even a stand-in's.
    acquisition = replace(can_profile.rig.acquisition, deadline_us=0.1)
    profile = replace(can_profile, rig=replace(can_profile.rig, acquisition=acquisition))
    row = by_name(inspect_devices(profile))["exchange", "both replies after"]
    assert row.verdict is CheckResult.FAIL


def test_the_simulation_in_this_process():
    rows = by_name(inspect_devices(load_profile("sim")))
    assert overall_verdict(rows.values()) == "ok"
    assert rows["drive", "connection"].found == "simulated in this process"
    assert rows["exchange", "ticks"].verdict is CheckResult.SKIPPED
