"""Load against frames built bit by bit, and against the table of the protocol notes."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.devices.canbus import bus_load
from rigd.profile import load_profile


def bits_on_the_wire(can_id, data):
    """Length of a data frame of CAN 2.0A with its stuffed bits, and the pause after it."""
    bits = [0, *_binary(can_id, 11), 0, 0, 0, *_binary(len(data), 4)]
    for byte in data:
        bits += _binary(byte, 8)
    remainder = 0
    for bit in bits:
        top = bit ^ (remainder >> 14)
        remainder = (remainder << 1) & 0x7FFF
        if top:
            remainder ^= 0x4599
    bits += _binary(remainder, 15)
    run, last, sent = 0, None, 0
    for bit in bits:
        run, last = (run + 1 if bit == last else 1), bit
        sent += 1
        if run == 5:
            run, last = 1, 1 - bit
            sent += 1
    # Delimiters of checksum and acknowledgement, the acknowledgement, end of frame, pause.
    return sent + 3 + 7 + 3


def _binary(value, width):
    return [value >> shift & 1 for shift in reversed(range(width))]


@pytest.fixture(scope="module")
def can_rig():
    return load_profile("antenna_can").rig


@pytest.fixture(scope="module")
def serial_rig():
    return load_profile("antenna_serial").rig


def bits_per_second(frames, data_of):
    return sum(each.rate_hz * bits_on_the_wire(each.can_id, data_of(each)) for each in frames)


@settings(max_examples=40)
@given(st.data())
def test_the_load_of_any_data_lies_between_plain_and_worst(can_rig, data):
    load = bus_load(can_rig)
    load_of_data = bits_per_second(
        load.cyclic_frames,
        lambda frame: data.draw(st.binary(min_size=frame.data_length, max_size=frame.data_length)),
    )
    assert load.load_without_stuffing * 1e6 <= load_of_data <= load.worst_case_load * 1e6


def test_real_frames_come_near_the_worst(can_rig):
    """Data of 3C has a bit stuffed after every four; heads and checksums are typical."""
    load = bus_load(can_rig)
    stuffed = bits_per_second(load.cyclic_frames, lambda frame: b"\x3c" * frame.data_length)
    assert stuffed > load.worst_case_load * 1e6 - 9 * load.frames_per_s


def test_motor_and_sensor_at_1_mbit(can_rig):
    """490 and 590 bits a millisecond, and heartbeats of 55 and 65 bits."""
    load = bus_load(can_rig)
    heartbeats_hz = 1 / can_rig.cia402.heartbeat_period_s
    heartbeats_hz += 1 / can_rig.cia402.drive_heartbeat_period_s
    assert load.load_without_stuffing == pytest.approx((490e3 + 55 * heartbeats_hz) / 1e6)
    assert load.worst_case_load == pytest.approx((590e3 + 65 * heartbeats_hz) / 1e6)
    assert load.frames_per_s == pytest.approx(6000 + heartbeats_hz)


def test_half_the_bit_rate_does_not_fit(can_rig):
    assert (
        bus_load(replace(can_rig, can=replace(can_rig.can, bitrate_bit_s=500_000))).worst_case_load
        > 1.18
    )


def test_load_of_the_motor_alone_with_a_serial_sensor(serial_rig):
    drive = serial_rig.cia402
    slow = replace(
        serial_rig, cia402=replace(drive, heartbeat_period_s=1.0, drive_heartbeat_period_s=1.0)
    )
    assert bus_load(slow).worst_case_load == pytest.approx(0.285 + 2 * 65e-6)


def test_a_loop_sends_no_heartbeat_between_its_ticks(can_rig):
    often = replace(can_rig, cia402=replace(can_rig.cia402, heartbeat_period_s=1e-4))
    host = next(t for t in bus_load(often).cyclic_frames if t.frame_name == "host's heartbeat")
    assert host.rate_hz == 1000


def test_frames_carry_the_identifiers_of_the_profile(can_rig):
    drive, sensor = replace(can_rig.cia402, node_id=5), replace(can_rig.ati_can, base_id=0x6A)
    found = {
        t.frame_name: t.can_id
        for t in bus_load(replace(can_rig, cia402=drive, ati_can=sensor)).cyclic_frames
    }
    assert found["drive's TPDO1"] == 0x185
    assert found["drive's RPDO1"] == 0x205
    assert found["drive's heartbeat"] == 0x705
    assert found["sensor's request"] == found["sensor's reply 1"] == 0x6A0
    assert found["sensor's reply 2"] == 0x6A1


def test_no_load_without_a_bus():
    with pytest.raises(ValueError, match="no CAN bus"):
        bus_load(load_profile("sim").rig)
