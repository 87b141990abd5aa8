"""The simulated Digital F/T sensor, polled by a host written from the protocol's tables."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rigd.sim import SimulatedRig

UNLOADED = [612, -1043, 385, 871, -724, 198]
JAM = bytes(range(1, 15))

START = bytes.fromhex("0A 46 55 A3 9D")
STARTED = bytes.fromhex("0A 46 01 A2 62")
UNLOCK = bytes.fromhex("0A 6A AA FF 1D")
LOCK = bytes.fromhex("0A 6A 18 7F 68")
LOCK_SET = bytes.fromhex("0A 6A 01 BE A2")
READ_STATUS = bytes.fromhex("0A 03 00 1D 00 01 15 77")
READ_DIAGNOSTICS = bytes.fromhex("0A 04 00 27 00 06 C1 78")
READ_CALIBRATION = bytes.fromhex("0A 03 00 E3 00 40 B4 B7")

fixtures_are_reset_by_the_test = settings(
    max_examples=60,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def test_the_witness_computes_checksums_as_published(check_crc):
    assert check_crc(b"123456789") == 0x4B37
    for frame in (START, STARTED, UNLOCK, LOCK, LOCK_SET, READ_STATUS, READ_DIAGNOSTICS):
        assert check_crc(frame) == 0


@pytest.mark.parametrize(
    ("request_", "answer"), [(START, STARTED), (UNLOCK, LOCK_SET), (LOCK, LOCK_SET)]
)
def test_frames_are_those_of_the_protocol(serial_host, request_, answer):
    assert serial_host.send(request_) == answer


def test_the_status_word(serial_host, with_crc):
    assert serial_host.send(READ_STATUS) == with_crc(bytes.fromhex("0A 03 02 00 00"))
    serial_host.device.status_bits = 0x0820
    assert serial_host.send(READ_STATUS) == with_crc(bytes.fromhex("0A 03 02 08 20"))


def test_diagnostics_come_in_seventeen_bytes(serial_host, check_crc):
    answer = serial_host.send(READ_DIAGNOSTICS)
    assert len(answer) == 17
    assert answer[:3] == bytes.fromhex("0A 04 0C")
    assert check_crc(answer) == 0


def test_the_calibration_block_of_the_profile(make_serial_host, rig):
    host = make_serial_host(calibration=1)
    answer = host.send(READ_CALIBRATION)
    assert len(answer) == 5 + 128
    assert answer[3:11] == b"FT12345\0"
    assert answer[11:43] == b"SI-20-1".ljust(32, b"\0")
    data, matrix, counts = host.calibration()
    assert data[44:64].rstrip(b"\0").decode("ascii")
    assert matrix.astype(np.float32).tolist() == host.device.gauges.matrix.tolist()
    assert data[208:210] == b"\x02\x03"
    assert struct.unpack(">6f", data[210:234]) == pytest.approx(rig.sensor.range)
    assert counts == (1_000_000, 1_000_000)
    gains = struct.unpack(">6H", data[242:254])
    offsets = struct.unpack(">6H", data[254:266])
    assert all(541 <= gain <= 579 for gain in gains)
    assert all(31842 <= offset <= 34927 for offset in offsets)


@pytest.mark.parametrize("filled", [1, 2, 16])
def test_the_other_fifteen_blocks_are_erased(make_serial_host, filled):
    host = make_serial_host(calibration=filled, serial_number="FT00016")
    for block in range(1, 17):
        words = [w for k in range(3) for w in host.registers(0xE3 + (block - 1) * 192 + 64 * k, 64)]
        assert (set(words) == {0xFFFF}) == (block != filled)
        assert (struct.pack(">4H", *words[:4]) == b"FT00016\0") == (block == filled)


def test_gains_and_offsets_need_the_storage_unlocked(serial_host):
    refused = b"\x90\x02"
    assert serial_host.write(0, [1] * 6) == refused
    serial_host.send(UNLOCK)
    assert serial_host.write(0, [1] * 6) == b"\x10\x00\x00\x00\x06"
    assert serial_host.write(6, [2] * 6) == b"\x10\x00\x06\x00\x06"
    serial_host.send(LOCK)
    assert serial_host.write(6, [3] * 6) == refused
    assert serial_host.registers(0, 12) == [1] * 6 + [2] * 6


def test_a_write_is_answered_as_in_modbus(serial_host, with_crc):
    serial_host.send(UNLOCK)
    request = with_crc(bytes.fromhex("0A 10 00 00 00 06 0C 02 29 02 31 02 23 02 3C 02 2E 02 1F"))
    assert serial_host.send(request) == with_crc(bytes.fromhex("0A 10 00 00 00 06"))
    assert serial_host.registers(0, 6) == [0x229, 0x231, 0x223, 0x23C, 0x22E, 0x21F]


def test_session_id_and_baud_register(serial_host, make_serial_host):
    assert serial_host.registers(0x0C, 1) == [0]
    assert serial_host.write(0x0C, [0xBEEF]) == b"\x10\x00\x0c\x00\x01"
    assert serial_host.registers(0x0C, 1) == [0xBEEF]
    assert serial_host.registers(0x1E, 2) == [0, 0]
    assert serial_host.write(0x1E, [1]) == b"\x10\x00\x1e\x00\x01"
    assert serial_host.write(0x1F, [2]) == b"\x10\x00\x1f\x00\x01"
    assert serial_host.registers(0x1E, 2) == [1, 2]
    assert make_serial_host(baud=19_200).registers(0x1F, 1) == [1]


@pytest.mark.parametrize(
    ("body", "exception"),
    [
        ("06 00 0C 00 01", "86 01"),
        ("2B 0E 01 00", "AB 01"),
        ("6B 01", "EB 01"),
        ("03 00 0D 00 01", "83 02"),
        ("03 00 0C 00 02", "83 02"),
        ("03 0C E2 00 02", "83 02"),
        ("03 FF FF 00 02", "83 02"),
        ("03 00 00 00 00", "83 03"),
        ("03 00 E3 00 7E", "83 03"),
        ("04 00 06 00 01", "84 02"),
        ("04 00 05 00 02", "84 02"),
        ("04 00 2D 00 01", "84 02"),
        ("04 00 00 00 00", "84 03"),
        ("10 00 1D 00 01 02 00 00", "90 02"),
        ("10 00 E3 00 01 02 00 00", "90 02"),
        ("10 00 0C 00 01 04 00 00 00 00", "90 03"),
        ("10 00 0C 00 00 00", "90 03"),
        ("10 00 1F 00 01 02 00 03", "90 03"),
        ("10 00 1E 00 01 02 00 02", "90 03"),
    ],
)
def test_exceptions(serial_host, body, exception):
    assert serial_host.request(bytes.fromhex(body)) == bytes.fromhex(exception)


def test_the_largest_number_of_registers_in_modbus(serial_host):
    assert len(serial_host.registers(0xE3, 125)) == 125
    assert len(serial_host.registers(0xCE2, 1)) == 1


@pytest.mark.parametrize("body", ["46 54", "46 01", "6A 00", "6A AB"])
def test_a_wrong_key_is_answered_with_zero(serial_host, body):
    body = bytes.fromhex(body)
    assert serial_host.request(body) == body[:1] + b"\x00"
    assert not serial_host.device.streaming
    assert serial_host.write(0, [1]) == b"\x90\x02"


def test_a_wrong_checksum_or_address_gets_no_answer(serial_host, with_crc):
    assert serial_host.send(READ_STATUS[:-1] + b"\x76") == b""
    assert serial_host.send(with_crc(b"\x0b" + READ_STATUS[1:-2])) == b""
    assert serial_host.send(READ_STATUS) != b""


REQUESTS = [READ_STATUS, READ_DIAGNOSTICS, READ_CALIBRATION, UNLOCK, LOCK]


@given(
    st.lists(st.tuples(st.binary(max_size=6), st.sampled_from(REQUESTS)), min_size=1, max_size=6),
    st.lists(st.integers(1, 12), min_size=1),
)
@fixtures_are_reset_by_the_test
def test_requests_may_be_split_joined_or_separated_by_noise(make_serial_host, parts, cuts):
    # Noise with the address in it can be the start of a request; that is another test.
    noise_free = [(noise.replace(b"\x0a", b""), request) for noise, request in parts]
    separate, host = make_serial_host(), make_serial_host()
    expected = b"".join(separate.send(request) for _, request in noise_free)
    line = b"".join(noise + request for noise, request in noise_free)
    answered = b""
    position = 0
    while line[position:]:
        for cut in cuts:
            answered += host.send(line[position : position + cut])
            position += cut
    assert answered == expected


@pytest.mark.parametrize(
    "noise", ["0A", "0A 0A", "0A 03", "0A 10 00 00 00 06 0C", "0A 46", "0A 99 12 34", "00 0A 6A AA"]
)
def test_noise_like_a_request_does_not_hide_the_next_request(serial_host, noise):
    expected = serial_host.send(READ_STATUS)
    assert serial_host.send(bytes.fromhex(noise) + READ_STATUS) == expected


def test_an_incomplete_request_expires_in_silence(serial_host):
    expected = serial_host.send(READ_STATUS)
    assert serial_host.send(READ_STATUS[:5]) == b""
    for millisecond in range(1, 50):
        serial_host.device.tick(0.001 * millisecond)
    assert serial_host.send(READ_STATUS[5:]) == expected
    assert serial_host.send(READ_STATUS[:5]) == b""
    for millisecond in range(50, 105):
        serial_host.device.tick(0.001 * millisecond)
    assert serial_host.send(READ_STATUS[5:]) == b""


@pytest.mark.parametrize("cut", range(1, 21))
def test_a_request_with_the_address_may_be_split_anywhere(serial_host, with_crc, cut):
    serial_host.send(UNLOCK)
    request = with_crc(bytes.fromhex("0A 10 00 00 00 06 0C") + b"\x0a" * 12)
    assert serial_host.send(request[:cut]) == b""
    assert serial_host.send(request[cut:]) == with_crc(bytes.fromhex("0A 10 00 00 00 06"))
    assert serial_host.registers(0, 6) == [0x0A0A] * 6


@pytest.mark.parametrize("cut", range(1, 8))
def test_a_request_of_an_unknown_function_may_be_split(serial_host, with_crc, cut):
    request = with_crc(bytes.fromhex("0A 06 00 0C 00 01"))
    assert serial_host.send(request[:cut]) == b""
    assert serial_host.send(request[cut:]) == with_crc(bytes.fromhex("0A 86 01"))


def test_an_answered_request_leaves_nothing_behind(serial_host):
    serial_host.send(READ_STATUS[:4])
    assert serial_host.send(READ_STATUS[4:]) != b""
    assert serial_host.send(READ_STATUS[4:]) == b""


def test_bytes_beyond_the_longest_request_are_dropped(serial_host, with_crc):
    request = with_crc(bytes.fromhex("0A 10 00 00 00 7F FE") + bytes(254))
    assert serial_host.send(request[:258]) == b""
    assert serial_host.send(request[258:]) == b""
    assert serial_host.send(READ_STATUS) != b""


@given(st.tuples(*[st.floats(-1, 1)] * 6))
@fixtures_are_reset_by_the_test
def test_a_host_recovers_the_wrench(make_serial_host, load, rig, fractions):
    host = make_serial_host()
    load.wrench = tuple(np.array(fractions) * rig.sensor.range)
    _, matrix, (per_force, per_torque) = host.calibration(2)
    host.load_gains(2)
    assert host.send(START) == STARTED
    load.advance()
    gauges, errors = host.period()
    assert errors == [0] * 7
    wrenches = (gauges - UNLOADED) @ matrix.T / np.repeat([per_force, per_torque], 3)
    assert np.all(np.abs(wrenches - load.wrench) <= host.device.gauges.quantisation + 1e-9)
    assert np.all(np.abs(wrenches - load.wrench) < 0.5 * np.array(rig.sensor.resolution))


def test_an_unloaded_record_byte_by_byte(serial_host, load):
    serial_host.load_gains(2)
    serial_host.send(START)
    load.advance()
    serial_host.writes.clear()
    serial_host.device.emit()
    # 612, 385, -724, -1043, 871, 198; the twelve bytes sum up to 1321 = 10 · 128 + 41.
    record = bytes.fromhex("0264 0181 FD2C FBED 0367 00C6") + b"\x29"
    assert serial_host.writes == [record * 7]


def test_the_records_of_a_period_are_its_readings_oldest_first(serial_host, load):
    serial_host.load_gains(2)
    serial_host.send(START)
    _, matrix, _ = serial_host_calibration(serial_host)
    for period in range(3):
        readings = [(0, 0, 0, 0, 0, 0.01 * (7 * period + n)) for n in range(7)]
        load.advance(*readings)
        gauges, _ = serial_host.period()
        torques = (gauges - UNLOADED) @ matrix.T[:, 5] / 1e6
        assert torques == pytest.approx([w[5] for w in readings], abs=5e-5)
    assert load.measured == 0


def serial_host_calibration(host):
    """Calibration as read by a host that streams: stopped for it, and started again."""
    host.send(JAM)
    calibration = host.calibration(2)
    assert host.send(START) == STARTED
    return calibration


@pytest.mark.parametrize("filter_", ["mean", "triangle"])
def test_a_filtered_stream_is_the_direct_simulation(rig, make_serial_host, filter_):
    """The same noise, reading by reading."""
    serial = replace(rig.ati_serial, filter=filter_)
    rig = replace(rig, ati_serial=serial)
    twin, simulated = SimulatedRig(rig), SimulatedRig(rig)
    host = make_serial_host(simulated, filter=filter_)
    _, matrix, _ = host.calibration(2)
    host.load_gains(2)
    host.send(START)
    weights = np.array(serial.filter_weights(rig.rate_hz))
    stream = np.empty((0, 6))
    for _ in range(30):
        twin.advance(1)
        simulated.advance(1)
        gauges, _ = host.period()
        stream = np.vstack([stream, (gauges - UNLOADED) @ matrix.T / 1e6])
        if len(stream) < len(weights):
            twin.sensor.records.extendleft([(0.0,) * 6] * (len(weights) - len(stream)))
        else:
            difference = weights @ stream[-len(weights) :] - np.array(twin.sensor.read_wrench())
            assert np.all(np.abs(difference) <= host.device.gauges.quantisation)


def test_one_record_a_period_is_one_reading(rig, make_serial_host):
    rig = replace(rig, ati_serial=replace(rig.ati_serial, stream_hz=1000.0))
    twin, simulated = SimulatedRig(rig), SimulatedRig(rig)
    host = make_serial_host(simulated, stream_hz=1000.0)
    _, matrix, _ = host.calibration(2)
    host.load_gains(2)
    host.send(START)
    for _ in range(20):
        twin.advance(1)
        simulated.advance(1)
        gauges, _ = host.period()
        wrench = matrix @ (gauges[0] - UNLOADED) / 1e6
        assert len(gauges) == 1
        assert np.all(np.abs(wrench - twin.sensor.read_wrench()) <= host.device.gauges.quantisation)


def test_warning_and_constant_gauges_without_gains_and_offsets(serial_host, load):
    load.wrench = (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    serial_host.send(START)
    load.advance()
    gauges, _ = serial_host.period()
    assert np.all(gauges == -32768)
    assert serial_host.log.entries[-1] == (
        "sensor",
        "gains and offsets not loaded",
        {"gauges": [0, 1, 2, 3, 4, 5]},
    )


@pytest.mark.parametrize("register", [3, 9])
def test_one_wrong_gain_or_offset_stops_one_gauge(serial_host, load, register):
    serial_host.load_gains(2)
    serial_host.send(UNLOCK)
    serial_host.write(register, [700])
    serial_host.send(START)
    load.advance()
    gauges, _ = serial_host.period()
    assert gauges[0].tolist() == [612, -1043, 385, -32768, -724, 198]


def test_no_warning_with_gains_and_offsets(serial_host):
    serial_host.load_gains(2)
    serial_host.send(START)
    assert "gains and offsets not loaded" not in serial_host.log.what
    assert serial_host.log.what[-1] == "stream started"


def test_no_stream_before_a_request(serial_host, load):
    load.advance()
    serial_host.device.emit()
    assert serial_host.writes == []


def test_no_stream_before_the_first_period(serial_host):
    serial_host.send(START)
    serial_host.writes.clear()
    serial_host.device.emit()
    assert serial_host.writes == []


def test_thirteen_bytes_do_not_stop_the_stream_and_fourteen_do(serial_host, load):
    serial_host.send(START)
    load.advance()
    assert serial_host.send(JAM[:13]) == b""
    assert len(serial_host.period()[0]) == 7
    assert serial_host.send(JAM[13:]) == b""
    serial_host.device.emit()
    assert serial_host.writes == []
    assert serial_host.log.what[-1] == "stream stopped"


@pytest.mark.parametrize("jam", [JAM, bytes(72), JAM + JAM[:10]])
def test_after_a_jam_the_sensor_listens_again(serial_host, load, jam):
    status = serial_host.send(READ_STATUS)
    for _ in range(3):
        assert serial_host.send(START) == STARTED
        serial_host.send(jam)
        assert not serial_host.device.streaming
        assert serial_host.send(READ_STATUS) == status


def test_late_bytes_of_a_jam_are_harmless(serial_host):
    status = serial_host.send(READ_STATUS)
    serial_host.send(START)
    serial_host.send(bytes(20))
    serial_host.send(bytes(52))
    assert serial_host.send(READ_STATUS) == status


def test_each_stream_takes_its_own_jam(serial_host):
    serial_host.send(START)
    serial_host.send(bytes(20))
    serial_host.send(START)
    serial_host.send(bytes(13))
    assert serial_host.device.streaming


def test_a_request_joined_to_the_start_counts_as_jam(serial_host):
    assert serial_host.send(START + READ_STATUS) == STARTED
    assert serial_host.device.streaming
    assert serial_host.send(START + READ_STATUS) == b""
    assert not serial_host.device.streaming


def test_a_streaming_sensor_answers_nothing(serial_host, load):
    serial_host.send(START)
    assert serial_host.send(READ_STATUS) == b""
    assert serial_host.device.streaming


def test_every_record_has_the_error_bit(serial_host, load):
    serial_host.load_gains(2)
    serial_host.send(START)
    serial_host.device.status_bits = 1
    load.advance()
    assert serial_host.period()[1] == [1] * 7
    serial_host.device.status_bits = 0
    assert serial_host.period()[1] == [0] * 7


def test_saturation_of_one_gauge_in_the_stream(serial_host, load):
    serial_host.load_gains(2)
    serial_host.send(START)
    serial_host.device.saturate = 4
    load.advance()
    gauges, _ = serial_host.period()
    assert gauges.tolist() == [[612, -1043, 385, 871, -32767, 198]] * 7


def test_a_frozen_sensor_neither_writes_nor_measures(serial_host, load):
    serial_host.send(START)
    serial_host.device.frozen = True
    load.advance()
    assert serial_host.send(JAM) == b""
    serial_host.device.emit()
    assert serial_host.writes == []
    serial_host.device.frozen = False
    assert len(serial_host.period()[0]) == 7


def test_polled_gauges(serial_host, load):
    serial_host.load_gains(2)
    load.wrench = (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)
    load.advance()
    polled = np.array(serial_host.registers(0, 6, function=4), dtype=np.uint16).view(np.int16)
    _, matrix, _ = serial_host.calibration(2)
    wrench = matrix @ (polled - UNLOADED) / 1e6
    assert wrench == pytest.approx(load.wrench, abs=5e-3)
    assert wrench[5] == pytest.approx(0.5, abs=5e-5)
    assert load.measured == 0


def test_gauges_polled_before_the_first_period_are_measured(serial_host, load):
    serial_host.load_gains(2)
    unloaded = serial_host.registers(0, 6, function=4)
    load.wrench = (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)
    assert serial_host.registers(0, 6, function=4) != unloaded
    assert load.measured == 2
