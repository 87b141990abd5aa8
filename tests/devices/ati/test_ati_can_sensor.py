"""The sensor behind a NETCANOEM box, against a fake written with struct from devices.md 1.1."""

import json
import math
import socket
import threading
from dataclasses import replace

import pytest

from rigd.devices.ati import AtiCanSensor
from rigd.devices.canbus import CanLink
from rigd.devices.contracts import DeviceError
from rigd.devices.running_simulator import SimulatorAddress


class Bench:
    """A sensor on a fake bus."""

    def __init__(self, fakes, rig, bus=None):
        self.fake = fakes.FakeNetcanoem()
        self.bus = (bus or fakes.FakeBus)(self.fake.answer)
        self.link = fakes.FakeLink(self.bus)
        self.sensor = AtiCanSensor(rig, self.link)

    def tick(self):
        self.sensor.request(0)
        return self.sensor.read_wrench()

    def refusal(self):
        with pytest.raises(DeviceError) as caught:
            self.sensor.connect()
        assert self.link.users == 0
        return str(caught.value)


@pytest.fixture
def bench(fakes, can_rig):
    return Bench(fakes, can_rig)


@pytest.fixture
def quick(monkeypatch):
    """No long waits for replies that never come."""
    monkeypatch.setattr("rigd.devices.ati._can_sensor._REPLY_TIMEOUT_S", 0.01)
    monkeypatch.setattr("rigd.devices.ati._can_sensor._LATE_REPLY_WAIT_S", 0.01)


def with_ati(rig, **changes):
    return replace(rig, ati_can=replace(rig.ati_can, **changes))


def expected_wrench(fakes, gauges, counts=(1_000_000, 2_000_000)):
    return [
        sum(m * g for m, g in zip(row, gauges, strict=True)) / counts[axis // 3]
        for axis, row in enumerate(fakes.MATRIX)
    ]


def test_connecting_selects_and_reads_the_calibration(bench):
    bench.sensor.connect()
    opcodes = [opcode for opcode, _ in bench.fake.requests]
    assert (6, b"\x01") in bench.fake.requests
    assert opcodes.index(6) < opcodes.index(2) < opcodes.index(7) < opcodes.index(8)
    assert [data for opcode, data in bench.fake.requests if opcode == 2] == [
        bytes((axis,)) for axis in (*range(6), *range(6))
    ]
    # Nothing that resets, re-addresses or re-clocks the sensor is ever sent.
    assert not {0xC, 0xD, 0xE} & set(opcodes)


def test_the_calibration_goes_into_the_file(bench, fakes):
    bench.sensor.connect()
    calibration = bench.sensor.calibration()
    assert json.loads(json.dumps(calibration, allow_nan=False)) == calibration
    assert calibration["serial_number"] == "FT12345"
    assert calibration["firmware"] == "3.8.2"
    assert calibration["calibration"] == 1
    assert calibration["matrix"] == [list(row) for row in fakes.MATRIX]
    assert (calibration["counts_per_force"], calibration["counts_per_torque"]) == (
        1_000_000,
        2_000_000,
    )
    assert (calibration["force_unit"], calibration["torque_unit"]) == ("N", "N·m")
    assert calibration["range_n_nm"] == "not stated by the sensor"
    assert calibration["status"] == []


def test_the_wrench_is_the_matrix_times_the_gauges(bench, fakes):
    bench.sensor.connect()
    assert bench.tick() == pytest.approx(expected_wrench(fakes, fakes.GAUGES), rel=1e-12)
    assert not bench.sensor.wrench_stale
    assert not bench.sensor.wrench_saturated
    assert bench.sensor.wrench_time_ns == bench.sensor.polls.sent_ns > 0


@pytest.mark.parametrize("firmware", [(3, 6, 9), (2, 9, 0)])
def test_no_request_of_counts_and_units_from_older_firmware(bench, fakes, firmware):
    bench.fake.firmware = firmware
    bench.fake.units = (1, 1)
    bench.sensor.connect()
    assert not {7, 8} & {opcode for opcode, _ in bench.fake.requests}
    wanted = expected_wrench(fakes, fakes.GAUGES, (1_000_000, 1_000_000))
    assert bench.tick() == pytest.approx(wanted, rel=1e-12)
    calibration = bench.sensor.calibration()
    assert (calibration["force_unit"], calibration["torque_unit"]) == ("N", "N·m")
    assert "3.7" in calibration["assumed"]


@pytest.mark.parametrize("firmware", [(3, 7, 0), (3, 7, 9), (3, 8, 0), (4, 0, 0)])
def test_firmware_from_3_7_on_reports_counts_and_units(bench, fakes, firmware):
    bench.fake.firmware = firmware
    bench.fake.counts = (2_000_000, 2_000_000)
    bench.sensor.connect()
    wanted = expected_wrench(fakes, fakes.GAUGES, (2_000_000, 2_000_000))
    assert bench.tick() == pytest.approx(wanted, rel=1e-12)
    assert "assumed" not in bench.sensor.calibration()


def test_serial_number_of_the_selected_calibration(fakes, can_rig):
    bench = Bench(fakes, with_ati(can_rig, serial_number="FT00001"))
    answer = bench.bus.answer

    def numbered(frame):
        bench.fake.serial_number = b"FT%05d\0" % bench.fake.active
        return answer(frame)

    bench.bus.answer = numbered
    bench.sensor.connect()
    assert bench.sensor.calibration()["serial_number"] == "FT00001"


def test_units_become_newtons(bench, fakes):
    bench.fake.units = (1, 4)
    bench.sensor.connect()
    wanted = expected_wrench(fakes, fakes.GAUGES)
    factors = [4.4482216152605] * 3 + [1e-3] * 3
    assert bench.tick() == pytest.approx([w * f for w, f in zip(wanted, factors, strict=True)])


def test_a_repeated_reply_does_not_answer_the_next_request(fakes, can_rig, monkeypatch):
    """A late reply is requested again, and then two are on their way."""
    monkeypatch.setattr("rigd.devices.ati._can_sensor._REPLY_TIMEOUT_S", 0.25)
    bench = Bench(fakes, can_rig, fakes.LateBus)
    bench.bus.late_s = {(2, b"\0"): [0.35, 0.35]}
    bench.sensor.connect()
    assert bench.fake.requests.count((2, b"\0")) == 3
    assert bench.sensor.calibration()["matrix"] == [list(row) for row in fakes.MATRIX]


def test_a_lost_set_up_frame_is_requested_again(bench, quick):
    bench.fake.lose_once = {0, 2, 5, 6, 7, 8, 0xF}
    bench.sensor.connect()
    assert bench.fake.lose_once == set()


@pytest.mark.parametrize(
    ("opcode", "what"),
    [
        (0xF, "firmware"),
        (5, "serial number"),
        (6, "calibration 1"),
        (0, "a reading"),
        (2, "row 0"),
        (7, "counts"),
        (8, "unit codes"),
    ],
)
def test_no_answer_of_the_sensor(bench, quick, opcode, what):
    bench.fake.silent_to = {opcode}
    message = bench.refusal()
    assert what in message
    assert "base id 0x68" in message
    assert "power" in message


@pytest.mark.parametrize("opcode", [0xF, 5, 2, 7, 8])
def test_replies_of_the_wrong_length(bench, quick, opcode):
    bench.fake.lengthen = {opcode}
    assert "bytes instead of" in bench.refusal()


def test_half_readings_of_the_wrong_length_are_ignored(bench, quick):
    bench.fake.lengthen = {0}
    assert "a reading" in bench.refusal()


def test_another_serial_number(fakes, can_rig):
    bench = Bench(fakes, with_ati(can_rig, serial_number="FT99999"))
    assert "FT12345" in (message := bench.refusal())
    assert "FT99999" in message
    Bench(fakes, with_ati(can_rig, serial_number="FT12345")).sensor.connect()


def test_a_missing_calibration(fakes, can_rig):
    bench = Bench(fakes, with_ati(can_rig, calibration=9))
    assert "asked for calibration 9, it selected 0" in bench.refusal()


def test_a_bad_active_calibration(bench):
    bench.fake.status = 0x8040
    message = bench.refusal()
    assert "active calibration is bad" in message
    assert "ati_can.calibration" in message


@pytest.mark.parametrize("entry", [math.nan, math.inf])
def test_a_matrix_with_no_numbers(bench, entry):
    bench.fake.matrix = ((*bench.fake.matrix[0][:5], entry), *bench.fake.matrix[1:])
    message = bench.refusal()
    assert "NETCANOEM" in message
    assert "entry Fx, gauge 5" in message or "differently" in message


def test_a_matrix_of_a_broken_memory(bench):
    rows = bench.fake.matrix
    bench.fake.matrix = (*rows[:4], (1e35, *rows[4][1:]), rows[5])
    message = bench.refusal()
    assert "NETCANOEM" in message
    assert "entry Ty, gauge 0" in message
    assert "1e+35" in message


def test_an_empty_matrix(bench):
    bench.fake.matrix = ((0.0,) * 6,) * 6
    assert "row Fx of its calibration matrix is zero" in bench.refusal()


def test_a_matrix_changed_between_two_readings(bench):
    answer = bench.bus.answer

    def swap(frame):
        if frame[4] and frame[8] == 5:
            bench.fake.matrix = bench.fake.matrix[::-1]
        return answer(frame)

    bench.bus.answer = swap
    assert "read differently" in bench.refusal()


def test_zero_counts_and_unknown_units(bench):
    bench.fake.counts = (0, 1)
    assert "0 counts per force" in bench.refusal()
    bench.fake.counts = (1, 1)
    bench.fake.units = (2, 7)
    assert "unit codes" in bench.refusal()


@pytest.mark.parametrize("section", ["ati_can", "acquisition"])
def test_a_profile_without_the_section(can_rig, section):
    with pytest.raises(DeviceError, match=section):
        AtiCanSensor(replace(can_rig, **{section: None}), None)


def test_critical_status_ends_the_session_with_a_message(bench):
    bench.sensor.connect()
    bench.fake.status = 0x8800
    with pytest.raises(DeviceError, match="the sensor is too hot"):
        bench.tick()
    bench.fake.status = 0x8006
    with pytest.raises(DeviceError, match=r"excitation is too high; .* too low"):
        bench.tick()


def test_bus_errors_are_counted_and_a_watchdog_reset_is_noted(bench):
    bench.fake.status = 0x8001
    bench.sensor.connect()
    assert bench.sensor.calibration()["status"] == ["its watchdog has reset the board"]
    before = bench.sensor.bus_errors
    bench.fake.status = 0xC001
    bench.tick()
    assert bench.sensor.bus_errors == before + 1


def test_a_watchdog_reset_in_mid_session_is_a_fault(bench):
    bench.sensor.connect()
    bench.tick()
    bench.fake.status = 0x8001
    with pytest.raises(
        DeviceError, match=r"watchdog has reset it .*back at calibration 0"
    ) as caught:
        bench.tick()
    assert "not those of calibration 1 (ati_can.calibration)" in str(caught.value)
    bench.sensor.connect()  # the bit stays, and the calibration is selected again
    assert bench.fake.requests.count((6, b"\x01")) == 2
    bench.tick()
    assert not bench.sensor.wrench_stale
    bench.fake.status = 0
    bench.tick()
    bench.fake.status = 0x8001
    with pytest.raises(DeviceError, match="watchdog has reset it"):
        bench.tick()


class Restarting(Bench):
    """A box that can be without power for some ticks; each calibration has its own matrix."""

    def __init__(self, fakes, rig, mode):
        super().__init__(fakes, replace(rig, acquisition=replace(rig.acquisition, mode=mode)))
        matrix, answer = self.fake.matrix, self.bus.answer

        def by_calibration(frame):
            self.fake.matrix = matrix if self.fake.active else matrix[::-1]
            return [] if self.without_power else answer(frame)

        self.without_power = False
        self.bus.answer = by_calibration
        self.sensor.connect()
        assert not self.fresh(3).count(False)

    def fresh(self, ticks):
        return [self.tick() and not self.sensor.wrench_stale for _ in range(ticks)][1:]

    def silence(self, ticks):
        self.without_power = True
        assert not any(self.fresh(ticks))
        self.without_power = False


@pytest.mark.parametrize("mode", ["same_tick", "previous_tick"])
def test_restart_with_another_calibration_is_a_fault(fakes, can_rig, mode):
    bench = Restarting(fakes, can_rig, mode)
    bench.silence(8)
    bench.fake.active = 0
    with pytest.raises(DeviceError, match=r"silent for a moment .*another calibration matrix"):
        assert not any(bench.fresh(20))
    assert bench.sensor.wrench_stale, "no reading with another calibration counts"


@pytest.mark.parametrize("mode", ["same_tick", "previous_tick"])
def test_session_continues_after_silence_without_restart(fakes, can_rig, mode):
    bench = Restarting(fakes, can_rig, mode)
    bench.silence(8)
    bench.fake.lose_once = {2}  # the check may be lost, too
    assert all(bench.fresh(20)[10:])
    assert (2, b"\0") in bench.fake.requests[-30:]


def test_occasional_lost_replies_need_no_check(fakes, can_rig):
    bench = Restarting(fakes, can_rig, "same_tick")
    bench.fake.requests.clear()
    for _ in range(5):
        bench.without_power = True
        bench.tick()
        bench.without_power = False
        bench.fresh(10)
    assert {opcode for opcode, _ in bench.fake.requests} == {0}


@pytest.mark.parametrize("gauge", range(6))
def test_saturation_of_any_gauge_either_way(fakes, can_rig, gauge):
    bench = Bench(fakes, with_ati(can_rig, saturation_counts=32700))
    bench.sensor.connect()
    for counts, saturated in ((32699, False), (32700, True), (-32700, True), (-32699, False)):
        bench.fake.gauges = tuple(counts if j == gauge else 0 for j in range(6))
        bench.tick()
        assert bench.sensor.wrench_saturated is saturated


class Numbered(Bench):
    """Every reading carries its number in all gauges, and the wrench shows it."""

    def __init__(self, fakes, rig, mode="same_tick"):
        acquisition = replace(rig.acquisition, mode=mode)
        super().__init__(fakes, replace(rig, acquisition=acquisition))
        self.fake.matrix = tuple(
            tuple(1e6 * (axis == gauge) for gauge in range(6)) for axis in range(6)
        )
        self.fake.counts = (1_000_000, 1_000_000)
        self.sensor.connect()
        self.number = 0
        self.held = []
        self.filter_frames = lambda frames: frames
        self.bus.answer = self.answer

    def answer(self, frame):
        self.number += 1
        self.fake.gauges = (self.number,) * 6
        return self.filter_frames(self.fake.answer(frame))

    def hold(self, frames):
        self.held += frames
        return []

    def release(self):
        self.bus.queue.extend(self.held)
        self.held = []

    def read(self):
        """One tick; the number that all six axes show, and whether it is stale."""
        wrench = self.tick()
        assert len(set(wrench)) == 1, wrench
        return wrench[0], self.sensor.wrench_stale


@pytest.fixture
def numbered(fakes, can_rig):
    return Numbered(fakes, can_rig)


def test_a_lost_reply_leaves_the_last_value_and_a_flag(numbered):
    assert numbered.read() == (1, False)
    numbered.filter_frames = lambda frames: []
    assert numbered.read() == (1, True)
    numbered.filter_frames = lambda frames: frames
    assert numbered.read() == (1, True), "it may be the missing one, late"
    # One tick without a poll: no reply comes, so none is on its way.
    assert numbered.read() == (1, True)
    assert numbered.number == 3
    assert numbered.read() == (4, False)
    assert numbered.sensor.polls.lost_reply_count == 1


@pytest.mark.parametrize("lost", [0, 1])
def test_half_a_reply_never_pairs_with_the_next(numbered, lost):
    assert numbered.read() == (1, False)
    numbered.filter_frames = lambda frames: [frames[1 - lost]]
    assert numbered.read() == (1, True)
    numbered.filter_frames = lambda frames: frames
    assert numbered.read() == (1, True)
    assert numbered.read() == (1, True)
    assert numbered.read() == (4, False)


def test_a_reply_after_the_deadline_costs_one_tick(numbered):
    assert numbered.read() == (1, False)
    numbered.filter_frames = numbered.hold
    assert numbered.read() == (1, True)
    numbered.filter_frames = lambda frames: frames
    numbered.release()
    assert numbered.read() == (3, False)
    assert numbered.sensor.late_replies == 1
    assert numbered.sensor.polls.lost_reply_count == 0


def test_a_reply_in_the_next_tick_is_dropped(numbered):
    assert numbered.read() == (1, False)
    numbered.filter_frames = numbered.hold
    assert numbered.read() == (1, True)
    numbered.filter_frames = lambda frames: frames
    numbered.sensor.request(0)
    numbered.release()
    # As the drive on the same bus does.
    numbered.link.open().deliver_frames()
    assert numbered.sensor.read_wrench()[0] == 1
    assert numbered.sensor.wrench_stale
    assert numbered.read() == (4, False)


def test_the_second_half_in_the_next_tick_is_dropped(numbered):
    assert numbered.read() == (1, False)

    def hold_second(frames):
        numbered.held.append(frames[1])
        return frames[:1]

    numbered.filter_frames = hold_second
    assert numbered.read() == (1, True)
    numbered.filter_frames = lambda frames: frames
    numbered.sensor.request(0)
    numbered.release()
    assert numbered.sensor.read_wrench()[0] == 1
    assert numbered.read() == (4, False)


@pytest.mark.parametrize("mode", ["same_tick", "previous_tick"])
@pytest.mark.parametrize("late", [1, 2, 3, 5])
@pytest.mark.parametrize("part", [slice(2), slice(1), slice(1, 2)])
def test_replies_always_late_never_count(fakes, can_rig, mode, late, part):
    """By whole ticks: each comes right after the poll of a later one, whole or half."""
    numbered = Numbered(fakes, can_rig, mode=mode)
    numbered.read() if mode == "same_tick" else numbered.tick()
    assert not any(numbered.read()[1] for _ in range(3))
    due = []

    def delay(frames):
        due.append((tick + late, frames[part]))
        return [frame for frame in frames if frame not in frames[part]]

    numbered.filter_frames = delay
    stale = []
    for tick in range(40):
        numbered.sensor.request(0)
        while due and due[0][0] <= tick:
            numbered.bus.queue.extend(due.pop(0)[1])
        numbered.sensor.read_wrench()
        stale.append(numbered.sensor.wrench_stale)
    first = 0 if mode == "same_tick" else 1  # which has the last one that was in time
    assert all(stale[first:])


def test_unrequested_frames_are_dropped(numbered, fakes):
    numbered.read()
    numbered.bus.queue.extend(numbered.fake.answer(fakes.frame_of(fakes.BASE << 4)))
    numbered.bus.queue.append(fakes.frame_of(fakes.BASE << 4 | 1, bytes(6)))
    assert numbered.read() == (2, False)


def test_with_the_previous_tick_a_tick_shows_the_poll_before(fakes, can_rig):
    numbered = Numbered(fakes, can_rig, mode="previous_tick")
    numbered.tick()
    assert numbered.sensor.wrench_stale, "no poll was sent before the first tick"
    sent_ns = numbered.sensor.polls.sent_ns
    assert numbered.read() == (1, False)
    assert numbered.sensor.wrench_time_ns == sent_ns
    assert numbered.read() == (2, False)
    numbered.filter_frames = numbered.hold
    assert numbered.read() == (3, False)
    numbered.filter_frames = lambda frames: frames
    numbered.release()
    assert numbered.read() == (4, False), "it came in time for this tick"
    numbered.filter_frames = lambda frames: []
    assert numbered.read() == (5, False)
    numbered.filter_frames = lambda frames: frames
    assert numbered.read() == (5, True)
    assert numbered.read() == (5, True)
    assert numbered.read() == (5, True)
    assert numbered.read() == (8, False)


def test_a_wait_ends_at_the_deadline_of_the_tick(numbered, monkeypatch):
    numbered.filter_frames = lambda frames: []
    waited = []
    monkeypatch.setattr(
        numbered.link.open(), "wait_until", lambda ready, end_ns: waited.append(end_ns)
    )
    numbered.sensor.request(0)
    numbered.sensor.read_wrench()
    assert waited == [numbered.sensor.polls.sent_ns + 200_000]


def test_measuring(numbered):
    found = numbered.sensor.measure(0.02)
    assert found["polls_hz"] > 0
    assert 0 < found["turnaround_median_s"] <= found["turnaround_p99_s"]
    assert found["lost"] == 0
    numbered.filter_frames = lambda frames: []
    silent = numbered.sensor.measure(0.03)
    assert silent["lost"] >= 1
    assert silent["polls_hz"] == 0
    assert math.isnan(silent["turnaround_median_s"])


def test_error_of_unconnected_and_closed_sensors(bench):
    for use in (bench.tick, bench.sensor.calibration, lambda: bench.sensor.measure(0.01)):
        with pytest.raises(DeviceError, match="not connected"):
            use()
    bench.sensor.close()
    bench.sensor.connect()
    bench.sensor.close()
    bench.sensor.close()
    assert bench.link.users == 0
    with pytest.raises(DeviceError, match="not connected"):
        bench.tick()
    bench.sensor.connect()
    bench.tick()


def test_waiting_for_connection_takes_all_replies_of_the_sensor(bench, fakes):
    bench.sensor.connect()
    replies = {fakes.BASE << 4 | opcode for opcode in (0, 1, 2, 3, 4, 5, 6, 7, 8, 0xF)}
    assert replies <= bench.bus.accepted


def test_through_the_socket_of_a_simulated_bus(fakes, can_rig, tmp_path):
    """The whole path: CanLink, Unix socket, a sensor in another thread."""
    fake = fakes.FakeNetcanoem()
    path = str(tmp_path / "can")
    hub = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    hub.bind(path)
    hub.listen()

    def serve():
        client, _ = hub.accept()
        with client:
            while len(frame := client.recv(16, socket.MSG_WAITALL)) == 16:
                for reply in fake.answer(frame):
                    client.sendall(reply)

    thread = threading.Thread(target=serve)
    thread.start()
    rig = replace(can_rig, acquisition=replace(can_rig.acquisition, deadline_us=1e6))
    link = CanLink(rig.can, SimulatorAddress(pid=0, control_socket="", can_socket=path))
    sensor = AtiCanSensor(rig, link)
    try:
        sensor.connect()
        for _ in range(20):
            sensor.request(0)
            assert sensor.read_wrench() == pytest.approx(expected_wrench(fakes, fakes.GAUGES))
            assert not sensor.wrench_stale
        fake.status = 0x8020
        sensor.request(0)
        with pytest.raises(DeviceError, match="supply voltage is too low"):
            sensor.read_wrench()
    finally:
        sensor.close()
        thread.join()
        hub.close()


@pytest.mark.parametrize("part", ["CAN, same tick", "CAN, previous tick", "CAN set-up"])
def test_rubbish_on_the_bus(fuzz, quick, part):
    _, function = fuzz.PARTS[part]
    function({"CAN set-up": 500}.get(part, 5_000), seed=3)
