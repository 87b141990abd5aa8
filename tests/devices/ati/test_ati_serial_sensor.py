"""The Digital F/T sensor, against a fake at a pseudo-terminal, from devices.md 2.1."""

import gc
import json
import os
import random
import select
import threading
import time
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from rigd.devices.ati import AtiSerialSensor
from rigd.devices.contracts import DeviceError
from rigd.devices.running_simulator import SimulatorAddress


@pytest.fixture
def open_sensor(serial_rig, digital_ft):
    """Make sensors on the line of the fake one, and close them."""
    made = []

    def make(*, lock_step=False, mode="same_tick", rate_hz=1000.0, deadline_us=1e6, **ati):
        address = SimulatorAddress(0, "", serial_port=digital_ft.port, lock_step=lock_step)
        rig = replace(
            serial_rig,
            rate_hz=rate_hz,
            ati_serial=replace(serial_rig.ati_serial, **ati),
            acquisition=replace(serial_rig.acquisition, mode=mode, deadline_us=deadline_us),
        )
        made.append(AtiSerialSensor(rig, address))
        return made[-1]

    yield make
    for sensor in made:
        sensor.close()


@pytest.fixture
def unhurried(monkeypatch):
    """No tick comes after a pause that the driver distrusts, even if a test runs slowly."""
    monkeypatch.setattr("rigd.devices.ati._serial_sensor._MAX_TIME_WITHOUT_READ_NS", 10**12)


def refusal(sensor):
    with pytest.raises(DeviceError) as caught:
        sensor.connect()
    return str(caught.value)


def tick(sensor):
    sensor.request(0)
    return sensor.read_wrench()


def wrench_of(fakes, gauges):
    raw = np.array(fakes.MATRIX) @ np.array(gauges, dtype=float)
    return raw / np.repeat((1_000_000, 2_000_000), 3)


def emitted(fakes, digital_ft, gauges):
    digital_ft.emit(b"".join(map(fakes.record_of, gauges)))


def test_connecting_loads_gains_and_offsets_between_unlock_and_lock(open_sensor, digital_ft):
    open_sensor().connect()
    log = digital_ft.log
    assert "0a 03 00 1d 00 01 15 77" in log
    assert "0a 03 00 e3 00 40 b4 b7" in log
    unlock, lock = log.index("0a 6a aa ff 1d"), log.index("0a 6a 18 7f 68")
    written = log[unlock + 1 : lock]
    assert [entry[:20] for entry in written] == ["0a 10 00 00 00 06 0c", "0a 10 00 06 00 06 0c"]
    assert log[-1] == "0a 46 55 a3 9d"
    assert digital_ft.registers[:6] == [541, 550, 560, 570, 575, 579]
    assert digital_ft.registers[6:12] == [31842, 32000, 32768, 33000, 34000, 34927]
    assert not digital_ft.unlocked


def test_a_running_stream_is_stopped_first(open_sensor, digital_ft):
    digital_ft.streaming = True
    open_sensor().connect()
    assert digital_ft.log[0] == "jam"


def test_the_calibration_goes_into_the_file(open_sensor, digital_ft, fakes):
    sensor = open_sensor()
    sensor.connect()
    calibration = sensor.calibration()
    assert json.loads(json.dumps(calibration, allow_nan=False)) == calibration
    assert (calibration["serial_number"], calibration["part_number"]) == ("FT12345", "SI-20-1")
    assert (calibration["family"], calibration["calibration_date"]) == ("DIG", "2021/03/04 12:00")
    assert calibration["matrix"] == [list(row) for row in fakes.MATRIX]
    assert calibration["range_n_nm"] == [20.0, 20.0, 60.0, 1.0, 1.0, 1.0]
    assert calibration["gains"] == [541, 550, 560, 570, 575, 579]
    assert calibration["low_latency"] is False
    assert (calibration["port"], calibration["baud"]) == (digital_ft.port, 1_250_000)
    assert sum(calibration["filter_weights"]) == pytest.approx(1.0)


def test_another_calibration_block_is_found(open_sensor, digital_ft, fakes):
    digital_ft.set_block(3, fakes.calibration_registers(part=b"SI-40-2"))
    sensor = open_sensor(calibration=3)
    sensor.connect()
    assert sensor.calibration()["part_number"] == "SI-40-2"


def test_the_wrench_is_the_filter_over_the_newest_records(
    open_sensor, digital_ft, fakes, unhurried, after_first_tick
):
    rng = random.Random(5)
    for kind, weights in (
        ("mean", [1 / 7] * 7),
        ("triangle", [w / 49 for w in (1, 2, 3, 4, 5, 6, 7, 6, 5, 4, 3, 2, 1)]),
    ):
        sensor = open_sensor(filter=kind)
        sensor.connect()
        sent = [list(fakes.GAUGES)] * 20
        tick_gauges = []
        for _ in range(5):
            new = [[rng.randint(-9000, 9000) for _ in range(6)] for _ in range(7)]
            emitted(fakes, digital_ft, new)
            sent += new
            newest = np.array(sent[-len(weights) :], dtype=float)
            tick_gauges.append(np.array(weights) @ newest)
            if len(tick_gauges) == 1:
                # The twenty records of the start are still there, too.
                tick(sensor)
                continue
            wrench = tick(sensor)
            assert wrench == pytest.approx(wrench_of(fakes, tick_gauges[-1]), rel=1e-9, abs=1e-12)
            assert not sensor.wrench_stale
        sensor.close()


@pytest.fixture
def after_first_tick(fakes, digital_ft):
    """Let a connected sensor do a first tick, with records of the start."""

    def settle(sensor):
        emitted(fakes, digital_ft, [fakes.GAUGES] * 7)
        tick(sensor)
        return sensor

    return settle


def watch_waits(sensor, digital_ft, chunks):
    """Let each wait of the driver bring one more chunk; return the requested timeouts."""
    waits = []
    original = sensor._line.wait

    def wait(timeout_s):
        waits.append(timeout_s)
        if chunks:
            digital_ft.emit(chunks.pop(0))
        original(timeout_s)

    sensor._line.wait = wait
    return waits


def test_a_tick_waits_for_all_its_records_in_lock_step(
    open_sensor, digital_ft, fakes, after_first_tick
):
    sensor = open_sensor(lock_step=True)
    sensor.connect()
    after_first_tick(sensor)
    chunks = [fakes.record_of((k, 0, 0, 0, 0, 0)) for k in range(7)]
    sensor.request(0)
    waits = watch_waits(sensor, digital_ft, chunks)
    wrench = sensor.read_wrench()
    del sensor._line.wait
    assert len(waits) == 7
    assert chunks == []
    assert wrench == pytest.approx(wrench_of(fakes, (3, 0, 0, 0, 0, 0)), abs=1e-15)
    assert all(earlier > later > 0.5 for earlier, later in pairwise(waits))


def test_wait_for_the_last_record_is_one_record_long(
    open_sensor, digital_ft, fakes, after_first_tick, unhurried
):
    """Else a sensor with a slow clock would drag every tick to its deadline."""
    sensor = open_sensor(deadline_us=5e6)
    sensor.connect()
    after_first_tick(sensor)
    six = b"".join(fakes.record_of((k, 0, 0, 0, 0, 0)) for k in range(6))
    sensor.request(0)
    waits = watch_waits(sensor, digital_ft, [six])
    sensor.read_wrench()
    del sensor._line.wait
    assert not sensor.wrench_stale
    assert waits[0] > 1.0
    assert all(timeout_s <= 1 / 7000 for timeout_s in waits[1:])


def test_a_tick_without_records_repeats_the_last_value(
    open_sensor, digital_ft, fakes, unhurried, after_first_tick
):
    sensor = open_sensor(deadline_us=2000.0)
    sensor.connect()
    before = tick(after_first_tick(sensor))
    time_ns = sensor.wrench_time_ns
    assert tick(sensor) == before
    assert sensor.wrench_stale
    assert sensor.wrench_time_ns == time_ns
    emitted(fakes, digital_ft, [(0, 0, 0, 0, 0, 9)] * 21)
    tick(sensor)
    assert not sensor.wrench_stale
    assert sensor.wrench_time_ns > time_ns


def test_the_start_of_the_stream_lasts_until_the_first_tick(open_sensor, fakes):
    sensor = open_sensor(deadline_us=1.0)
    sensor.connect()
    assert tick(sensor) == pytest.approx(wrench_of(fakes, fakes.GAUGES), rel=1e-12)
    assert sensor.wrench_stale


PERIOD_NS = 1_000_000


@pytest.fixture
def follow(open_sensor, digital_ft, fakes, after_first_tick):
    """Run ticks in which so many records arrive; return the number of each tick, or stale.

    A record that is `torn` loses a byte.
    """

    def run(counts, lost=(), due_ns=lambda tick: tick * PERIOD_NS, torn=()):
        sensor = open_sensor(deadline_us=3000.0)
        sensor.connect()
        after_first_tick(sensor)
        number, shown = 0, []
        run.doubts = []
        for index, count in enumerate(counts):
            sensor.request(due_ns(index + 1))
            if index in lost:
                number += 7
            emitted(fakes, digital_ft, [(number + k, 0, 0, 0, 0, 0) for k in range(count)])
            number += count
            if index in torn:
                digital_ft.emit(fakes.record_of((1, 2, 3, 4, 5, 6))[1:])
            wrench = sensor.read_wrench()
            newest = wrench[0] / wrench_of(fakes, (1, 0, 0, 0, 0, 0))[0] + 3
            shown.append("stale" if sensor.wrench_stale else round(newest))
            run.doubts.append(sensor.health().doubt)
        run.doubt, run.count = sensor.health().doubt, sensor.health().doubt_count
        return shown

    return run


def test_late_records_do_not_count_for_the_tick(follow):
    # The adapter held a tick's records back once; then each tick finds the ones before its own.
    assert follow([7, 0, 7, 7, 14, 7]) == [6, "stale", "stale", "stale", 34, 41]
    assert follow.doubt == ""


def test_doubt_whether_records_are_late_or_lost(follow):
    shown = follow([7, 0, 0, 0, 7, 7, 7, 7])
    assert shown[1:6] == ["stale"] * 5
    assert "records did not arrive, or all have been delayed since" in follow.doubt
    assert follow.count.endswith("since it was connected: 21; or the wrench is late by 3 ms.")


def test_one_warning_for_all_late_records(follow):
    follow([7, 0, 0, 0, 7, 7, 7, 7, 0, 0, 7, 7, 7, 7])
    assert len({doubt for doubt in follow.doubts if doubt}) == 1
    assert ": 35; or" in follow.count


def test_the_latency_timer_of_the_adapter_is_named(
    open_sensor, digital_ft, fakes, after_first_tick, monkeypatch
):
    now_ns = 0
    monkeypatch.setattr(
        "rigd.devices.ati._serial_sensor.time", SimpleNamespace(monotonic_ns=lambda: now_ns)
    )
    sensor = open_sensor(deadline_us=0.0)
    sensor.connect()
    after_first_tick(sensor)

    def block(gap_ms):
        nonlocal now_ns
        now_ns += round(1e6 * gap_ms)
        records = sensor.stream.records + 112
        emitted(fakes, digital_ft, [(1, 2, 3, 4, 5, 6)] * 112)
        while sensor.stream.records < records:
            tick(sensor)
        return sensor.health().cause

    assert block(1.0) == ""
    causes = [block(16.0) for _ in range(5)]
    assert causes[:2] == ["", ""]
    assert "arrive in blocks every 16 ms: the latency timer of the USB adapter" in causes[-1]
    assert "latency_timer" in causes[-1]
    now_ns += 10**9
    assert sensor.health().cause == "", "what was long ago is not the cause of what is missing now"
    assert [block(gap_ms) for gap_ms in (3.0, 40.0, 7.0, 90.0, 3.0)][-1] == ""


def test_no_doubt_after_a_torn_record(follow):
    shown = follow([7, 7, 0, 7, 7, 7, 7, 7], lost={2}, torn={1})
    assert "stale" in shown
    assert shown[-1] != "stale"
    assert follow.doubt == ""


def test_lost_records_are_given_up_after_some_ticks(follow):
    shown = follow([7, 0, 7, 7, 7, 7], lost={1})
    assert shown == [6, "stale", "stale", "stale", 34, 41]


def test_missed_ticks_bring_their_records_with_them(follow):
    late = lambda index: (index + 3 * (index > 1)) * PERIOD_NS  # noqa: E731
    assert follow([7, 28, 7], due_ns=late)[1:] == [34, 41]


@pytest.mark.parametrize("extra", [-1, 1])
def test_a_different_clock_is_no_lag(follow, extra):
    shown = follow([7, 7 + extra, 7, 7 + extra, 7, 7, 7 + extra, 7])
    assert "stale" not in shown


def test_after_a_pause_only_new_records_count(
    open_sensor, digital_ft, fakes, monkeypatch, after_first_tick
):
    monkeypatch.setattr("rigd.devices.ati._serial_sensor._MAX_TIME_WITHOUT_READ_NS", 1_000_000)
    sensor = open_sensor()
    sensor.connect()
    after_first_tick(sensor)
    emitted(fakes, digital_ft, [(1000, 0, 0, 0, 0, 0)] * 300)
    time.sleep(0.005)
    sensor.request(0)
    emitted(fakes, digital_ft, [(5, 0, 0, 0, 0, 0)] * 2)
    assert sensor.read_wrench() == pytest.approx(wrench_of(fakes, (5, 0, 0, 0, 0, 0)), abs=1e-15)
    assert not sensor.wrench_stale


def test_first_records_with_the_first_tick_in_lock_step(open_sensor, digital_ft, fakes):
    digital_ft.first_records = []
    sensor = open_sensor(lock_step=True, filter="triangle")
    sensor.connect()
    emitted(fakes, digital_ft, [(5, 1, 2, 3, 4, 6)] * 7)
    time.sleep(0.03)
    wrench = tick(sensor)
    assert not sensor.wrench_stale
    assert wrench == pytest.approx(wrench_of(fakes, (5, 1, 2, 3, 4, 6)), rel=1e-12)


@pytest.mark.parametrize("gauge", range(6))
def test_saturation_of_any_gauge_of_any_new_record(
    open_sensor, digital_ft, fakes, gauge, unhurried, after_first_tick
):
    sensor = open_sensor(saturation_counts=32700)
    sensor.connect()
    after_first_tick(sensor)
    for counts, saturated in ((32699, False), (-32700, True), (0, False), (32700, True)):
        gauges = [[0] * 6 for _ in range(7)]
        gauges[gauge][gauge] = counts
        emitted(fakes, digital_ft, gauges)
        tick(sensor)
        assert sensor.wrench_saturated is saturated


def test_an_error_of_the_sensor_ends_the_session(
    open_sensor, digital_ft, fakes, unhurried, after_first_tick
):
    sensor = open_sensor()
    sensor.connect()
    after_first_tick(sensor)
    single = [fakes.record_of(fakes.GAUGES, error=i == 3) for i in range(7)]
    digital_ft.emit(b"".join(single))
    tick(sensor)
    assert not sensor.wrench_stale, "one such bit may be a disturbed one"
    digital_ft.emit(fakes.record_of(fakes.GAUGES, error=True) * 7)
    with pytest.raises(DeviceError, match="its records report an error"):
        tick(sensor)
    digital_ft.status = 0x0204
    sensor.close()
    assert sensor.status == [
        "the gauges' excitation is too low",
        "the bridges take too much current (broken gauge or cable)",
    ]


def test_damage_is_counted_and_survived(
    open_sensor, digital_ft, fakes, fuzz, unhurried, after_first_tick
):
    sensor = open_sensor(deadline_us=20_000.0)
    sensor.connect()
    after_first_tick(sensor)
    records = fuzz.noisy_records(random.Random(3), 70)
    data = bytearray(b"".join(records))
    data[13 * 30 + 2] ^= 1
    del data[13 * 50 + 4]
    stale = 0
    for at in range(0, len(data), 91):
        digital_ft.emit(bytes(data[at : at + 91]))
        tick(sensor)
        stale += sensor.wrench_stale
    assert sensor.stream.checksum_errors == 2
    assert sensor.stream.dropped_bytes == 13 + 12
    assert sensor.stream.synchronised
    assert stale <= 1


def test_measuring(open_sensor, digital_ft, fakes):
    sensor = open_sensor()
    sensor.connect()
    chunks = [fakes.record_of(fakes.GAUGES) * 7] * 10
    watch_waits(sensor, digital_ft, chunks)
    found = sensor.measure(0.05)
    assert 0 < found["records_hz"] <= 70 / 0.05
    assert found["checksum_errors"] == found["dropped_bytes"] == 0
    assert found["longest_gap_s"] > 0
    chunks[:] = [b"\x01" + fakes.record_of(fakes.GAUGES) * 10]
    assert sensor.measure(0.02)["checksum_errors"] == 1


@pytest.fixture
def impatient(monkeypatch):
    """Wait for late replies for no longer than a fake sensor takes."""
    monkeypatch.setattr("rigd.devices.ati._serial_setup._LATE_REPLY_WAIT_S", 0.05)


def test_a_silent_sensor(impatient, open_sensor, digital_ft, monkeypatch):
    monkeypatch.setattr("rigd.devices.ati._serial_setup._REPLY_TIMEOUT_S", 0.02)
    digital_ft.silent = True
    message = refusal(open_sensor())
    assert "no usable reply in 3 tries: no reply came" in message
    assert digital_ft.port in message
    assert "ati_serial.baud" in message


def test_a_disturbed_reply_is_requested_again(impatient, open_sensor, digital_ft):
    digital_ft.damage_next = 2
    open_sensor().connect()
    assert digital_ft.log.count("0a 03 00 1d 00 01 15 77") == 4


def test_disturbed_replies(impatient, open_sensor, digital_ft):
    digital_ft.damage_next = 9
    assert "checksum of the reply is wrong" in refusal(open_sensor())


def test_a_refused_request(open_sensor, digital_ft):
    digital_ft.refuse = {0x03: 2}
    assert "it refused: it has no such register" in refusal(open_sensor())


def test_a_refused_write_locks_the_storage(open_sensor, digital_ft):
    digital_ft.refuse = {0x10: 4}
    assert "load gains and offsets" in refusal(open_sensor())
    assert digital_ft.log[-1] == "0a 6a 18 7f 68"


def test_gains_not_stored_by_the_sensor(open_sensor, digital_ft):
    digital_ft.forgets_writes = True
    assert "read back as (0, 0, 0, 0, 0, 0" in refusal(open_sensor())


@pytest.mark.parametrize(
    ("status", "words"), [(0x0002, "excitation is too high"), (0x1000, "thermistor is too low")]
)
def test_critical_status_at_the_start(open_sensor, digital_ft, status, words):
    digital_ft.status = status
    assert words in refusal(open_sensor())


def test_critical_status_once_the_gains_are_loaded(open_sensor, digital_ft):
    digital_ft.after_load = 0x2000
    assert "analogue output is out of range" in refusal(open_sensor())


def test_a_watchdog_reset_is_noted(open_sensor, digital_ft):
    digital_ft.status = 1
    sensor = open_sensor()
    sensor.connect()
    assert sensor.calibration()["status"] == ["its watchdog has reset the board"]


def test_an_empty_calibration(open_sensor):
    message = refusal(open_sensor(calibration=2))
    assert "ati_serial.calibration 2" in message
    assert "Choose another" in message


def test_another_serial_number(open_sensor):
    message = refusal(open_sensor(serial_number="FT99999"))
    assert "FT12345" in message
    assert "FT99999" in message


def test_a_declined_start(open_sensor, digital_ft):
    digital_ft.start_reply = 0
    assert "does not start streaming: it declined with code 0" in refusal(open_sensor())


@pytest.mark.parametrize("first", [[], [b"\x01\x02\x03\x04\x05\x06\x07\x08\x09\x0a\x0b\x0c\x00"]])
def test_a_start_without_sound_records(open_sensor, digital_ft, monkeypatch, first):
    monkeypatch.setattr("rigd.devices.ati._serial_sensor._FIRST_RECORDS_TIMEOUT_S", 0.2)
    digital_ft.first_records = first * 30
    message = refusal(open_sensor())
    assert f"of the {390 if first else 0} bytes" in message
    assert "only 0 were valid records" in message


def test_failure_to_stop_the_stream(open_sensor, digital_ft, monkeypatch, fakes):
    monkeypatch.setattr("rigd.devices.ati._serial_setup._DRAIN_TIME_LIMIT_S", 0.1)
    digital_ft.streaming = digital_ft.deaf_to_jam = True
    really_select = select.select

    def babble(*descriptors):
        """The line is never quiet for the driver, even on a slow computer."""
        if threading.current_thread() is threading.main_thread():  # the fake sensor selects too
            digital_ft.emit(fakes.record_of(fakes.GAUGES))
        return really_select(*descriptors)

    monkeypatch.setattr(select, "select", babble)
    assert "continues to send" in refusal(open_sensor())
    monkeypatch.undo()
    digital_ft.deaf_to_jam = False


def test_a_line_too_slow_for_the_stream(open_sensor):
    message = refusal(open_sensor(baud=115_200))
    assert "7000 records a second need 1001000 bit/s" in message


def test_a_stream_slower_than_the_loop(open_sensor):
    assert "fewer than the loop's 1000 ticks" in refusal(open_sensor(stream_hz=500.0))


def test_a_missing_port(serial_rig):
    port = "/dev/ttyNowhere7"
    sensor = AtiSerialSensor(
        replace(serial_rig, ati_serial=replace(serial_rig.ati_serial, port=port)), None
    )
    message = refusal(sensor)
    assert f"{port} cannot be opened at 1250000 baud (No such file or directory)" in message
    assert "rigd simulate --profile" in message
    sensor.close()


def test_a_file_in_place_of_a_port(serial_rig, tmp_path):
    port = tmp_path / "port"
    port.touch()
    settings = replace(serial_rig.ati_serial, port=str(port))
    assert "cannot be opened" in refusal(
        AtiSerialSensor(replace(serial_rig, ati_serial=settings), None)
    )


def test_a_port_in_use_by_another_program(open_sensor):
    open_sensor().connect()
    assert "another program has it open" in refusal(open_sensor())


def test_an_unplugged_adapter_in_the_cycle(open_sensor, digital_ft):
    sensor = open_sensor()
    sensor.connect()
    digital_ft.hang_up()
    with pytest.raises(DeviceError, match="has failed"):
        for _ in range(3):
            tick(sensor)
    begin = time.monotonic()
    sensor.close()
    sensor.close()
    assert time.monotonic() - begin < 1.0


def test_an_adapter_unplugged_while_waiting(open_sensor, digital_ft, unhurried, after_first_tick):
    sensor = open_sensor()
    sensor.connect()
    after_first_tick(sensor)
    sensor.request(0)
    original = sensor._line.wait

    def wait(timeout_s):
        digital_ft.hang_up()
        original(timeout_s)

    sensor._line.wait = wait
    with pytest.raises(DeviceError, match="check adapter and cable"):
        sensor.read_wrench()


def test_closing_stops_the_stream_and_frees_the_port(open_sensor, digital_ft):
    sensor = open_sensor()
    sensor.connect()
    sensor.close()
    assert not digital_ft.streaming
    assert digital_ft.log[-2:] == ["jam", "0a 03 00 1d 00 01 15 77"]
    sensor.connect()
    assert tick(sensor)


def test_error_of_unconnected_sensors(open_sensor):
    sensor = open_sensor()
    for use in (lambda: tick(sensor), sensor.calibration, lambda: sensor.measure(0.01)):
        with pytest.raises(DeviceError, match="not connected"):
            use()
    sensor.close()


@pytest.mark.parametrize("section", ["ati_serial", "acquisition"])
def test_a_profile_without_the_section(serial_rig, section):
    with pytest.raises(DeviceError, match=section):
        AtiSerialSensor(replace(serial_rig, **{section: None}), None)


def test_no_descriptor_is_left_open(open_sensor, digital_ft):
    gc.collect()  # of other tests: it would close what counts here
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    sensor = open_sensor()
    sensor.connect()
    sensor.close()
    digital_ft.status = 2
    refusal(sensor)
    assert len(os.listdir("/proc/self/fd")) <= before  # noqa: PTH208
