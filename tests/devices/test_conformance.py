"""What the cycle relies on, of every backend."""

import json
from math import isfinite

PERIOD_NS = 1_000_000


def run(devices, first, ticks, torque_nm=None):
    """Let some ticks pass; returns angles and wrenches."""
    angles, wrenches = [], []
    for tick in range(first, first + ticks):
        devices.drive.latch(tick * PERIOD_NS)
        devices.sensor.request(tick * PERIOD_NS)
        angles.append(devices.drive.read_angle())
        wrenches.append(devices.sensor.read_wrench())
        if torque_nm is not None:
            devices.drive.command(torque_nm)
    return angles, wrenches


def connect(devices):
    devices.drive.connect()
    devices.sensor.connect()


def test_until_it_is_enabled_the_rig_is_read_and_nothing_moves(devices):
    connect(devices)
    assert json.loads(json.dumps(devices.sensor.calibration()))
    angles, wrenches = run(devices, 0, 300, torque_nm=0.3)
    assert all(isfinite(angle) for angle in angles)
    assert all(len(wrench) == 6 and all(map(isfinite, wrench)) for wrench in wrenches)
    assert not devices.drive.angle_stale
    assert not devices.sensor.wrench_stale
    assert not devices.sensor.wrench_saturated
    assert max(angles) - min(angles) < 1e-3


def test_torque_is_what_was_commanded_from_enabling_to_disabling(devices):
    connect(devices)
    devices.drive.enable()
    angles, _ = run(devices, 0, 300)
    assert max(angles) - min(angles) < 1e-3
    angles, _ = run(devices, 300, 60, torque_nm=0.3)
    assert angles[-1] > angles[0] + 1e-3  # positive turns towards positive
    devices.drive.disable()
    devices.drive.disable()
    speeds = []
    last = run(devices, 360, 1, torque_nm=0.3)[0][0]
    for block in range(20):
        angles, _ = run(devices, 361 + 100 * block, 100, torque_nm=0.3)
        speeds.append(abs(angles[-1] - last))
        last = angles[-1]
    assert speeds[-1] < 0.2 * max(speeds)


def test_disabling_and_closing_work_in_every_state(devices):
    devices.drive.disable()
    connect(devices)
    devices.drive.disable()
    devices.drive.enable()
    devices.drive.disable()
    devices.drive.close()
    devices.drive.close()
    devices.sensor.close()


def test_the_lines_tell_how_they_are(devices):
    assert devices.drive.health().bits in (None, 0)
    connect(devices)
    before = devices.drive.health(), devices.sensor.health()
    run(devices, 0, 100)
    after = devices.drive.health(), devices.sensor.health()
    for then, now in zip(before, after, strict=True):
        assert (now.bits is None) is (then.bits is None)
        assert now.bits is None or (now.bits > then.bits and now.bit_rate_bit_s > 0)
        assert not now.errors
    assert after[1].status == 0
