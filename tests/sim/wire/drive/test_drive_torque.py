"""Torque of the plant: its time, its value, and none once the drive is off."""

from dataclasses import replace

import numpy as np
import pytest

from rigd.devices import open_devices
from rigd.devices.contracts import DeviceError

RATED_NM = 0.5


def test_torque_of_tick_k_acts_from_sync_k_plus_1(running):
    running.rpdo(0x0F, 200)
    assert running.torques == []
    order = []
    advance = running.node._advance
    running.node._advance = lambda: (order.append(list(running.torques)), advance())
    _, _, torque = running.sync()
    assert order == [[0.1]]
    assert torque == 200
    running.sync()
    assert running.torques == [0.1]


def test_torque_acts_at_once_on_arrival(bench):
    bench.configure(delivery=255)
    bench.sync()
    for word in (0x06, 0x07, 0x0F):
        bench.rpdo(word, 0)
    bench.rpdo(0x0F, 200)
    assert bench.torques == [0.1]


@pytest.mark.parametrize("direction", [1, -1])
def test_motion_is_the_same_without_a_wire(make_bench, direction):
    bench = make_bench(direction=direction).configure().enable()
    per_mille = [round(300 * np.sin(0.05 * k)) for k in range(400)]
    angles = []
    for value in per_mille:
        _, counts, _ = bench.sync()
        angles.append(direction * counts * bench.rig.encoder.resolution_rad)
        bench.rpdo(0x0F, direction * value)
    direct = open_devices(bench.rig).drive
    direct.connect()
    direct.enable()
    expected = []
    for k, value in enumerate(per_mille):
        direct.latch(k * 1_000_000)
        expected.append(direct.read_angle())
        direct.command(value * RATED_NM / 1000)
    assert np.ptp(expected) > 0.01
    assert angles == pytest.approx(expected, abs=1e-12)


def test_the_offset_is_added_and_the_limits_clip(running):
    running.write(0x60B2, 0, 50, 2)
    assert running.drive(100)[::2] == (0x1237, 150)
    running.write(0x60E0, 0, 120, 2)
    assert running.sync()[::2] == (0x1A37, 120)
    assert running.drive(-300)[::2] == (0x1237, -250)
    running.write(0x60E1, 0, 200, 2)
    assert running.sync()[::2] == (0x1A37, -200)
    running.write(0x6072, 0, 90, 2)
    assert running.sync()[::2] == (0x1A37, -90)
    assert running.drive(-140)[::2] == (0x1237, -90)
    assert running.logged_torque() == (pytest.approx(-0.045), True)


def test_no_setting_allows_more_than_the_peak(running):
    for index in (0x6072, 0x60E0, 0x60E1):
        running.write(index, 0, 0xFFFF, 2)
    running.write(0x60B2, 0, 32767, 2)
    assert running.drive(32767)[::2] == (0x1A37, 1800)
    running.write(0x60B2, 0, -32768, 2)
    assert running.drive(-32768)[::2] == (0x1A37, -1800)
    assert running.logged_torque() == (pytest.approx(-0.9), True)


def test_the_direction_reverses_torque_and_angle(make_bench):
    bench = make_bench(direction=-1).configure().enable()
    bench.drive(500)
    assert bench.torques == [pytest.approx(-0.25)]
    for _ in range(100):
        _, counts, _ = bench.sync()
    assert bench.plant.angle_rad < 0 < counts
    assert bench.read(0x606C, signed=True) > 0


def test_halt_and_other_modes_end_the_torque_only(running):
    running.drive(200)
    running.rpdo(0x010F, 200)
    status, _, torque = running.sync()
    assert torque == 0
    assert status & ~0x0400 == 0x0237
    assert running.plant.enabled
    assert running.drive(200)[::2] == (0x1237, 200)
    running.write(0x6060, 0, 0, 1)
    assert running.sync()[::2] == (0x0237, 0)
    assert running.logged_torque() == (0.0, True)
    running.write(0x6060, 0, 10, 1)
    assert running.sync()[::2] == (0x1237, 200)


def test_a_shaft_above_the_speed_limit_is_not_accelerated(running):
    running.write(0x6080, 0, 1000, 4)  # 10 rpm at the output: 1.047 rad/s
    statuses = []
    for _ in range(400):
        running.rpdo(0x0F, 400)
        statuses.append(running.sync()[0])
    assert running.plant.velocity_rad_s < 1.3
    torques = [running.sync()[2] for _ in range(200)]  # as the speed falls it comes back
    assert set(torques) == {0, 400}
    assert any(status & 0x0800 for status in statuses)
    running.rpdo(0x0F, -400)  # braking is allowed
    assert running.sync()[2] == -400


def test_all_values_of_a_pdo_are_stored_before_they_act(bench):
    # An earlier target must not act between the two halves of the frame.
    bench.configure().sync()
    for word in (0x06, 0x07):
        bench.rpdo(word, 0)
        bench.sync()
    bench.write(0x6071, 0, 900, 2)
    bench.rpdo(0x0F, 0)
    bench.sync()
    assert bench.state() == "operation enabled"
    assert bench.torques == []


def test_a_target_is_ignored_until_received_in_a_pdo(bench):
    bench.configure()
    bench.sync()
    bench.write(0x6071, 0, 400, 2)
    for word in (0x06, 0x07, 0x0F):
        bench.write(0x6040, 0, word, 2)
    assert bench.sync()[::2] == (0x0237, 0)
    assert bench.drive(300)[::2] == (0x1237, 300)


def test_a_target_is_ignored_until_a_sync(bench):
    bench.write(0x6060, 0, 10, 1)
    bench.nmt(1)
    bench.write(0x6071, 0, 400, 2)
    for word in (0x06, 0x07, 0x0F):
        bench.write(0x6040, 0, word, 2)
    assert bench.read(0x6041) == 0x0237
    assert bench.torques == []
    bench.sync()
    assert bench.read(0x6041) == 0x1237
    assert bench.torques == [pytest.approx(0.2)]


def test_a_target_needs_a_sync_after_another_nmt_state(running):
    running.write(0x6007, 0, 2, 2)
    running.nmt(128)
    running.nmt(1)
    for word in (0x06, 0x07, 0x0F):
        running.write(0x6040, 0, word, 2)
    running.map_pdo(1, "r", 255, 0x6040_0010, 0x6071_0010)
    running.rpdo(0x0F, 300)
    assert running.read(0x6041) == 0x0237
    assert running.sync()[::2] == (0x1237, 300)


WAYS_OUT = {
    "disable voltage": lambda b: b.write(0x6040, 0, 0x00, 2),
    "quick stop": lambda b: b.write(0x6040, 0, 0x02, 2),
    "shutdown": lambda b: b.write(0x6040, 0, 0x06, 2),
    "disable operation": lambda b: b.write(0x6040, 0, 0x07, 2),
    "nmt stop": lambda b: b.nmt(2),
    "nmt pre-operational": lambda b: b.nmt(128),
    "reset node": lambda b: b.nmt(129),
    "reset communication": lambda b: b.nmt(130),
    "emergency": lambda b: b.node.emergency(0x2310, 0x02, b""),
    "frozen": lambda b: (setattr(b.node, "frozen", True), b.wait(60, sync=True, beat=True)),
    "short pdo": lambda b: b.node.receive(0x205, b"\x0f\x00\x64"),
    "silence": lambda b: b.wait(60),
}


@pytest.mark.parametrize("option", [0, 1, 2, 3])
@pytest.mark.parametrize("way", WAYS_OUT)
def test_each_exit_ends_torque_and_operation(make_bench, way, option):
    bench = make_bench().configure()
    bench.write(0x6007, 0, option, 2)
    bench.enable()
    bench.beat()
    bench.drive(700)
    assert bench.exerting() == pytest.approx(0.35)
    WAYS_OUT[way](bench)
    bench.assert_off()
    bench.node.frozen = False
    if way not in ("shutdown", "disable operation"):  # from there 0F is a way back
        bench.rpdo(0x0F, 700)
        bench.wait(5, sync=True)
        bench.assert_off()


@pytest.mark.parametrize("delivery", [1, 255])
def test_a_pdo_with_the_disable_command_disables(make_bench, delivery):
    bench = make_bench().configure(delivery=delivery)
    bench.sync()
    bench.enable()
    bench.drive(700)
    bench.rpdo(0x07, 700)
    bench.sync()
    bench.assert_off()


def test_a_jumping_and_wrapping_encoder(running):
    _, before, _ = running.sync()
    running.node.angle_offset_counts = 12345
    assert running.sync()[1] == before + 12345
    running.node.angle_offset_counts = 0x7FFF_FFFF
    assert running.sync()[1] == before + 0x7FFF_FFFF
    running.node.angle_offset_counts = 0x8000_0001
    assert running.sync()[1] == before - 0x7FFF_FFFF


def test_each_change_of_torque_or_enabling_is_logged_once(running):
    running.events.clear()
    for per_mille in (0, 100, 100, -100, 0):
        running.drive(per_mille)
    running.write(0x6040, 0, 0x06, 2)
    torques = [values for _, what, values in running.events if what == "torque"]
    assert [(round(v["torque_nm"], 6), v["enabled"]) for v in torques] == [
        (0.05, True),
        (-0.05, True),
        (0.0, True),
        (0.0, False),
    ]


def test_an_unsupported_profile_is_refused(rig, bench_on, make_bench):
    with pytest.raises(DeviceError, match=r"\[cia402\]"):
        bench_on(replace(rig, cia402=None))
    with pytest.raises(DeviceError, match="resolution_rad"):
        bench_on(replace(rig, encoder=replace(rig.encoder, resolution_rad=0.0)))
    with pytest.raises(DeviceError, match="rated_torque_unit_nm"):
        make_bench(rated_torque_unit_nm=1.0)
    identity = make_bench(vendor_id=0, product_code=0)
    assert identity.read(0x1018, 1)
    assert identity.read(0x1018, 2)
