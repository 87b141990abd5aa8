"""The simulated NETCANOEM box, polled by a host written from the protocol's table."""

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rigd.sim import SimulatedRig

UNLOADED = [612, -1043, 385, 871, -724, 198]

GOLDEN = [
    (0x115, "", [(0x115, "46 54 31 32 33 34 35 00")]),
    (0x116, "03", [(0x116, "03")]),
    (0x117, "", [(0x117, "00 0F 42 40 00 0F 42 40")]),
    (0x118, "", [(0x118, "02 03")]),
    (0x119, "05", [(0x119, "00 0C")]),
    (0x11C, "", []),
    (0x11D, "22", [(0x11D, "")]),
    (0x11E, "01", [(0x11E, "")]),
    (0x11F, "", [(0x11F, "03 08 00 02")]),
    # Status 0, then 612, 385, -724; and -1043, 871, 198.
    (0x110, "", [(0x110, "00 00 02 64 01 81 FD 2C"), (0x111, "FB ED 03 67 00 C6")]),
]


@pytest.mark.parametrize(("can_id", "request_hex", "replies"), GOLDEN)
def test_frames_are_those_of_the_protocol(can_host, can_id, request_hex, replies):
    can_host.frames.clear()
    can_host.node.receive(can_id, bytes.fromhex(request_hex))
    assert can_host.frames == [(reply_id, bytes.fromhex(data)) for reply_id, data in replies]


def test_a_matrix_row_comes_in_three_frames(can_host):
    for axis in range(6):
        frames = can_host.request(0x2, bytes([axis]))
        assert [can_id for can_id, _ in frames] == [0x112, 0x113, 0x114]
        row = can_host.node.gauges.matrix[axis]
        assert b"".join(data for _, data in frames) == row.astype(">f4").tobytes()


@given(st.tuples(*[st.floats(-1, 1)] * 6))
@settings(
    max_examples=50,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
def test_a_host_recovers_the_wrench(can_host, load, rig, fractions):
    load.wrench = tuple(np.array(fractions) * rig.sensor.range)
    per_force, per_torque = can_host.counts_per_unit()
    counts = np.repeat([per_force, per_torque], 3)
    status, gauges = can_host.gauges()
    wrench = can_host.matrix() @ (gauges - UNLOADED) / counts
    assert status == 0
    assert np.all(np.abs(wrench - load.wrench) <= can_host.node.gauges.quantisation + 1e-9)
    assert np.all(np.abs(wrench - load.wrench) < 0.5 * np.array(rig.sensor.resolution))


def test_a_host_with_counts_per_unit_recovers_every_scale(make_can_host, load):
    load.wrench = (3.0, -7.0, 21.0, 0.2, -0.3, 0.4)
    host = make_can_host(counts_per_unit=(200_000, 8_000_000))
    host.request(0x6, b"\x03")
    assert host.counts_per_unit() == (200_000, 8_000_000)
    wrench = host.matrix() @ (host.gauges()[1] - UNLOADED) / np.repeat([200_000, 8_000_000], 3)
    assert np.all(np.abs(wrench - load.wrench) <= host.node.gauges.quantisation + 1e-9)


@pytest.mark.parametrize("gauge", range(6))
def test_each_gauge_has_its_index(can_host, load, gauge):
    """The wrench under which only one gauge differs from its bias."""
    load.wrench = tuple(can_host.matrix()[:, gauge] * 1000 / 1e6)
    _, gauges = can_host.gauges()
    expected = [value + 1000 * (n == gauge) for n, value in enumerate(UNLOADED)]
    assert gauges.tolist() == expected


def test_each_request_is_one_reading_of_the_simulated_sensor(rig, make_can_host):
    rig = replace(rig, ati_serial=None)
    twin = SimulatedRig(rig)
    simulated = SimulatedRig(rig)
    host = make_can_host(simulated)
    host.request(0x6, b"\x03")
    matrix = host.matrix()
    for _ in range(50):
        simulated.advance(1)
        twin.advance(1)
        wrench = matrix @ (host.gauges()[1] - UNLOADED) / 1e6
        # Resolution and quantisation leave no doubt which step was meant.
        steps = np.round(wrench / rig.sensor.resolution)
        assert steps == pytest.approx(np.array(twin.sensor.measure()) / rig.sensor.resolution)


@pytest.mark.parametrize("bits", [0x0002, 0x4000, 0x3FFF])
def test_injected_status_bits_bring_the_summary_bit(can_host, bits):
    can_host.node.status_bits = bits
    assert can_host.gauges()[0] == bits | 0x8000
    can_host.node.status_bits = 0
    assert can_host.gauges()[0] == 0


def test_calibration_0_is_active_after_power_up(make_can_host):
    host = make_can_host()
    assert host.gauges()[0] == 0x8040
    assert np.isnan(host.matrix()).all()
    host.request(0x6, b"\x03")
    assert host.gauges()[0] == 0
    assert np.isfinite(host.matrix()).all()
    assert make_can_host(calibrations=[0, 5]).gauges()[0] == 0


@pytest.mark.parametrize("index", [0, 1, 2, 4, 15])
def test_a_missing_calibration_is_echoed_and_in_the_status(can_host, index):
    assert can_host.request(0x6, bytes([index])) == [(0x116, bytes([index]))]
    assert can_host.gauges()[0] == 0x8040
    ((_, data),) = can_host.request(0x2, b"\x00")[:1]
    assert all(map(math.isnan, struct.unpack(">ff", data)))


def test_a_reset_clears_the_selected_calibration(can_host):
    assert can_host.request(0xC) == []
    assert can_host.gauges()[0] == 0x8041
    assert can_host.log.entries[-1] == ("sensor", "reset", {})
    can_host.request(0x6, b"\x03")
    assert can_host.gauges()[0] == 0x8001


def test_a_power_up_clears_calibration_and_reset_flag(can_host):
    can_host.request(0x6, b"\x03")
    can_host.node.reset()
    can_host.node.power_cycle()
    assert can_host.gauges()[0] == 0x8040


def test_a_new_base_takes_effect_at_the_next_power_up(can_host):
    assert can_host.request(0xD, b"\x6a") == [(0x11D, b"")]
    assert can_host.log.entries[-1] == ("sensor", "base identifier set", {"base_id": 0x6A})
    assert can_host.request(0xF)
    can_host.request(0xC)
    assert can_host.request(0xF), "a reset is not a power-up"
    can_host.node.power_cycle()
    assert can_host.request(0xF) == []
    can_host.base = 0x6A
    assert can_host.request(0xF) == [(0x6AF, bytes.fromhex("03 08 00 02"))]
    assert can_host.gauges()[1].tolist() == UNLOADED


def test_a_new_bit_rate_is_only_logged(can_host):
    can_host.request(0xE, b"\x03")
    assert can_host.log.entries[-1] == (
        "sensor",
        "baud set",
        {"divisor": 3, "bitrate_bit_s": 500_000.0},
    )


@pytest.mark.parametrize("firmware", [(3, 6, 9), (3, 6, 0), (2, 9, 1)])
def test_old_firmware_does_not_report_counts(make_can_host, load, firmware):
    host = make_can_host(firmware=firmware, counts_per_unit=(5, 7))
    host.request(0x6, b"\x03")
    assert host.request(0x7) == host.request(0x8) == host.request(0x9, b"\x02") == []
    ((_, version),) = host.request(0xF)
    assert struct.unpack(">BBH", version) == firmware
    load.wrench = (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)
    wrench = host.matrix() @ (host.gauges()[1] - UNLOADED) / 1e6
    assert wrench[5] == pytest.approx(0.5, abs=1e-4)


@pytest.mark.parametrize("firmware", [(3, 7, 0), (3, 8, 0), (4, 0, 0)])
def test_newer_firmware_reports_counts(make_can_host, firmware):
    assert make_can_host(firmware=firmware).counts_per_unit() == (1_000_000, 1_000_000)


LENGTHS = {0: 0, 2: 1, 5: 0, 6: 1, 7: 0, 8: 0, 9: 1, 0xC: 0, 0xD: 1, 0xE: 1, 0xF: 0}


@pytest.mark.parametrize("opcode", range(16))
def test_invalid_requests_get_no_reply(can_host, opcode):
    for length in range(9):
        if LENGTHS.get(opcode) != length:
            assert can_host.request(opcode, bytes(length)) == []
    assert can_host.log.what == ["calibration set"]


@pytest.mark.parametrize(("opcode", "index"), [(0x2, 6), (0x6, 16), (0x9, 6), (0xD, 0x80)])
def test_an_impossible_index_gets_no_reply(can_host, opcode, index):
    assert can_host.request(opcode, bytes([index])) == []
    assert can_host.gauges()[0] == 0


@pytest.mark.parametrize(
    "can_id", [0x100, 0x120, 0x10F, 0x080, 0x711, 0x8000_0110, 0x4000_0110, 0x2000_0110]
)
def test_the_box_ignores_frames_for_others(can_host, can_id):
    can_host.frames.clear()
    can_host.node.receive(can_id, b"")
    assert can_host.frames == []


def test_saturation_of_one_gauge(can_host):
    can_host.node.saturate = 3
    assert can_host.gauges()[1].tolist() == [612, -1043, 385, 32767, -724, 198]


def test_a_frozen_box_neither_answers_nor_measures(can_host, load):
    can_host.node.frozen = True
    measured = load.measured
    for opcode in range(16):
        for data in (b"", b"\x01"):
            assert can_host.request(opcode, data) == []
    assert load.measured == measured
    can_host.node.frozen = False
    assert can_host.gauges()[0] == 0


def test_the_serial_number_is_the_profile_s(make_can_host):
    host = make_can_host(serial_number="FT09876X")
    assert host.request(0x5) == [(0x115, b"FT09876X")]


def test_time_passes_without_effect(can_host):
    before = can_host.request(0x0)
    can_host.node.tick(1e3)
    assert can_host.request(0x0) == before
