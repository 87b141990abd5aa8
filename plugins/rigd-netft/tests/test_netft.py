"""Driver on the simulated box: settings that are accepted or refused, and effects of faults."""

import os
import socket
import sys
import time
from dataclasses import replace

import pytest
import warm_start
from loopback_netft import UdpBox, serve_page
from rigd_netft import protocol
from rigd_netft.box import SimulatedBox
from rigd_netft.sensor import NetFtSensor
from rigd_netft.settings import NetFtSettings

from rigd.check_rows import overall_verdict
from rigd.checks import check_rig
from rigd.devices import open_devices
from rigd.devices.contracts import DeviceError
from rigd.profile import ProfileError, load_profile
from rigd.session import read_session
from rigd.testing import DEVICE_CHECKS, write_profile

PERIOD_NS = 1_000_000
WRENCH = (1.0, -2.0, 3.0, 0.1, -0.2, 0.3)


def write_rig(folder, lines="", **values):
    """Write a profile with the simulated drive and a box."""
    path = write_profile(folder, {"name": "netft", "devices.sensor": "netft"} | values)
    path.write_text(path.read_text() + f'\n[netft]\nhost = "192.168.1.1"\n{lines}\n')
    return path


@pytest.fixture
def rig(tmp_path):
    return load_profile(write_rig(tmp_path)).rig


@pytest.fixture
def connect(rig):
    """Return a function that returns a connected driver and its simulated box."""

    def connect(tags=None, faults=(), **settings):
        box = SimulatedBox(lambda: WRENCH, tags, faults)
        sensor = NetFtSensor(rig, replace(NetFtSettings("127.0.0.1"), **settings), box)
        sensor.connect()
        return sensor, box

    return connect


@pytest.fixture
def streaming_box():
    with UdpBox(SimulatedBox(lambda: WRENCH)).streaming() as box:
        yield box


@pytest.fixture
def loopback_sensor(rig, streaming_box):
    """Return a driver connected to a box that streams in real time on the loopback interface."""
    with serve_page(streaming_box.box) as http_port:
        sensor = NetFtSensor(
            rig, NetFtSettings("127.0.0.1", port=streaming_box.port, http_port=http_port)
        )
        sensor.connect()
    yield sensor
    sensor.close()


def run(sensor, ticks, first=0):
    """Run ticks; return the numbers of stale and of saturated wrenches."""
    stale = saturated = 0
    for tick in range(first, first + ticks):
        sensor.request(tick * PERIOD_NS)
        sensor.read_wrench()
        stale += sensor.wrench_stale
        saturated += sensor.wrench_saturated
    return stale, saturated


@pytest.mark.parametrize("check", DEVICE_CHECKS)
def test_it_passes_the_checks_of_devices(rig, check):
    devices = open_devices(rig)
    check(devices)
    devices.sensor.close()


def test_records_are_not_stale_after_missed_ticks(rig):
    sensor = open_devices(rig).sensor
    sensor.connect()
    for tick in (*range(500), *range(504, 900)):
        sensor.request(tick * PERIOD_NS)
        sensor.read_wrench()
        assert not sensor.wrench_stale, tick
    sensor.close()


def test_a_record_has_the_age_of_the_box_s_counter(connect):
    sensor, _ = connect()
    assert run(sensor, 3000) == (0, 0)
    assert sensor.read_wrench() == pytest.approx(WRENCH)
    assert sensor.wrench_stale  # no record since
    assert sensor.wrench_time_ns == pytest.approx(2999 * PERIOD_NS, abs=1000)
    assert not any(sensor.counts.values())
    assert sensor.health().bits > 0
    sensor.close()
    sensor.connect()
    assert run(sensor, 10, 9000) == (0, 0)


@pytest.mark.parametrize("drift", [5e-5, pytest.param(-5e-5, marks=pytest.mark.further)])
def test_the_age_follows_clocks_that_drift_apart(connect, drift):
    sensor, _ = connect()
    for tick in range(2000):
        due_ns = round(tick * PERIOD_NS * (1 + drift))
        sensor.request(due_ns)
        sensor.read_wrench()
    assert sensor.wrench_time_ns == pytest.approx(due_ns, abs=1000)  # not 100 µs, as they drifted


@pytest.mark.parametrize(
    ("unit_tags", "per_torque"),
    [
        ({"scfgtu": "Nm"}, 1.0), ({"scfgtu": "N-m", "cfgcpt": "250000"}, 1.0),
        ({"scfgfu": "lbf", "scfgtu": "lbf-in"}, 1.0), ({"scfgtu": "Nmm", "cfgcpt": "1000"}, 1.0),
    ],
)  # fmt: skip
def test_units_and_counts_of_the_box_make_no_difference(connect, unit_tags, per_torque):
    sensor, _ = connect(unit_tags)
    run(sensor, 5)
    sensor.request(5 * PERIOD_NS)
    assert sensor.read_wrench() == pytest.approx(WRENCH, rel=1e-3)


@pytest.mark.parametrize(
    ("tags", "settings", "message"),
    [
        ({"scfgtu": "furlong"}, {}, 'scfgtu is "furlong", but unknown unit'),
        ({"cfgcpf": "0"}, {}, 'cfgcpf is "0"'),
        ({"cfgtfx": "0;0;132.710;0;0;0"}, {}, r"cfgtfx is .0;0;132.710;0;0;0.*tool_transform"),
        ({}, {"serial_number": "FT1"}, 'cfgcalsn is "FT00001".*serial_number is FT1'),
        ({"runrate": "3500"}, {}, "does not send 7000 records"),
    ],
)
def test_a_box_that_does_not_suit_is_refused_by_name(connect, tags, settings, message):
    with pytest.raises(DeviceError, match=message):
        connect(tags, **settings)


def test_rate_filter_and_bias_are_set_and_read_back(connect):
    _, box = connect(
        {"comrdtrate": "100", "comrdtbsiz": "40", "setuserfilter": "5", "comrdte": "Disabled"},
        rate_hz=3500.0, filter_hz=73, bias="zero",
    )  # fmt: skip
    assert (box.tags["comrdtrate"], box.tags["comrdtbsiz"]) == ("3500", "1")
    assert (box.tags["setuserfilter"], box.tags["setbias"]) == ("4", "0;0;0;0;0;0")
    assert connect()[1].tags["setbias"].startswith("745")  # kept unless it is asked for


def test_a_value_that_the_box_does_not_take_is_refused(connect, monkeypatch):
    get_page = SimulatedBox.get_page
    monkeypatch.setattr(
        SimulatedBox, "get_page", lambda box, path: "" if "?" in path else get_page(box, path)
    )
    with pytest.raises(DeviceError, match='setuserfilter is "5", but 0 was set'):
        connect({"setuserfilter": "5"})


def test_without_a_page_the_counts_must_be_stated(connect):
    with pytest.raises(DeviceError, match=r"does not answer.*counts_per_n"):
        connect(faults=["no_page"])
    sensor, _ = connect(faults=["no_page"], counts_per_n=1e6, counts_per_nm=1e6)
    run(sensor, 2)
    assert sensor.read_wrench() == pytest.approx(WRENCH)
    assert "assumed" in sensor.calibration()


@pytest.mark.parametrize(
    ("fault", "counted", "stale", "saturated"),
    [
        ("loss=0.01", {"lost"}, (0, 3), (0, 0)),
        ("duplicate=0.05", {"duplicates"}, (0, 0), (0, 0)),
        ("reorder=0.05", {"out_of_order"}, (0, 0), (0, 0)),
        ("malformed=0.02", {"malformed", "lost"}, (0, 0), (0, 0)),
        ("burst=0.04@0.5", set(), (38, 42), (0, 0)),
        ("silence@0.5", set(), (495, 505), (0, 0)),
        ("saturate=0.1@0.5", set(), (0, 0), (95, 105)),
        ("threshold@0.5", set(), (0, 0), (0, 0)),
    ],
)
def test_faults_are_counted_and_flagged(connect, fault, counted, stale, saturated):
    sensor, _ = connect(faults=[fault])
    stale_ticks, saturated_ticks = run(sensor, 1000)
    assert {name for name, count in sensor.counts.items() if count} == counted
    assert stale[0] <= stale_ticks <= stale[1]
    assert saturated[0] <= saturated_ticks <= saturated[1]
    assert bool(sensor.health().cause) == (fault.startswith("silence"))


@pytest.mark.parametrize(
    ("fault", "tags", "message"),
    [
        ("restart@0.2", {}, "has restarted; its bias may have changed"),
        ("status=0x80000004@0.2", {}, "0x80000004 reports temperature"),
        ("status=0x80001000@0.2", {}, "reports EEPROM"),
        ("status=0x80000004@0.2", {"setadcrate": "7912"}, "reports broken gauge"),
    ],
)
def test_faults_of_the_box_end_the_session(connect, fault, tags, message):
    sensor, _ = connect(tags, [fault])
    with pytest.raises(DeviceError, match=message):
        run(sensor, 1000)


def test_a_second_client_takes_the_stream_and_the_cause_is_stated(loopback_sensor, streaming_box):
    assert not loopback_sensor.health().cause
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as thief:
        thief.connect(("127.0.0.1", streaming_box.port))
        thief.send(protocol.STREAM_REQUEST)
        assert thief.recv(64)
        loopback_sensor.read_wrench()
        time.sleep(0.05)
        loopback_sensor.read_wrench()
    assert loopback_sensor.wrench_stale
    assert "another program has started a stream" in loopback_sensor.health().cause


def test_packets_from_elsewhere_are_ignored(loopback_sensor):
    port = loopback_sensor._line._socket.getsockname()[1]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for sequence in range(50):
            record = protocol.RECORD_LAYOUT.pack(sequence, sequence, 0xFFFFFFFF, *(6 * [10**9]))
            stranger.sendto(record, ("127.0.0.1", port))
    time.sleep(0.01)
    assert loopback_sensor.read_wrench() == pytest.approx(WRENCH)
    assert not any(loopback_sensor.counts.values())


def test_counters_may_wrap_around():
    assert protocol.counter_difference(3, 0xFFFFFFFE) == 5
    assert protocol.counter_difference(0xFFFFFFFE, 3) == -5
    assert protocol.NETFT.status_texts(0x80010000) == ["a monitor condition is latched"]


def test_a_box_that_streams_by_the_clock_is_read_without_a_growing_delay(loopback_sensor):
    assert loopback_sensor.calibration()["serial_number"] == "FT00001"
    time.sleep(0.1)  # 700 records wait
    loopback_sensor.read_wrench()
    newest_ns = loopback_sensor.wrench_time_ns
    time.sleep(0.02)
    loopback_sensor.read_wrench()
    assert loopback_sensor.wrench_time_ns > newest_ns
    assert not any(loopback_sensor.counts.values())
    measured = loopback_sensor.measure(0.3)
    assert measured["records_hz"] > 0
    assert measured["lost"] == 0
    sequence, _ = loopback_sensor._last_numbers
    assert sequence == loopback_sensor._record_count  # all came, and none waits


@pytest.mark.parametrize("port", ["port", "http_port"])
def test_a_silent_box_is_refused_with_its_address(rig, streaming_box, monkeypatch, port):
    monkeypatch.setattr("rigd_netft.sensor._START_WAIT_S", 0.01)
    stated = {"counts_per_n": 1e6, "counts_per_nm": 1e6} if port == "port" else {}
    settings = replace(NetFtSettings("127.0.0.1", **stated), **{port: 9})
    message = "no record came" if port == "port" else "page .* does not answer .*counts_per_n"
    with pytest.raises(DeviceError, match=f"Net F/T box at 127.0.0.1: .*{message}"):
        NetFtSensor(rig, settings).connect()


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('rate_hz = { value = 3000.0, source = "assumed" }', "would send 3500: write that"),
        ('filter_hz = { value = 50, source = "assumed" }', "50 Hz must be 0, 838, 326"),
        ('filter_hz = { value = 73, source = "assumed" }', "state it as sensor.filter_hz"),
        ('counts_per_n = { value = 1e6, source = "assumed" }', "go together"),
        ('bias = "auto"', 'must be "keep" or "zero"'),
        ('port = { value = 0, source = "assumed" }', "at least 1"),
    ],
)
def test_a_profile_that_does_not_suit_the_box_is_refused(tmp_path, line, message):
    with pytest.raises(ProfileError, match=message):
        load_profile(write_rig(tmp_path, line))


def rigd(*arguments):
    return warm_start.run(
        [sys.executable, "-P", "-m", "rigd", *map(str, arguments)],
        capture_output=True, text=True, check=False, env=os.environ | {"RIGD_NO_LOOK": "1"},
    )  # fmt: skip


@pytest.mark.process
@pytest.mark.parametrize(
    ("faults", "code", "text"),
    [
        ('"loss=0.01", "reorder=0.01", "duplicate=0.01"', 0, ""),
        pytest.param('"silence@1.2"', 1, "sends no records", marks=pytest.mark.further),
        pytest.param('"restart@1.2"', 1, "has restarted", marks=pytest.mark.further),
    ],
)
def test_sessions(tmp_path, faults, code, text):
    brief = {"session.tare_s": 0.5, "session.return_s": 0.3}
    path = write_rig(tmp_path, f"faults = [{faults}]", **brief)
    done = rigd(
        "run", "chirp", "--profile", path, "--fast", "--seed", "1", "--output", tmp_path / "out",
        "--duration", "1", "--rest", "0.5", "--ring-down", "0.5",
    )  # fmt: skip
    assert done.returncode == code, done.stdout + done.stderr
    assert text in done.stdout + done.stderr
    if not code:
        metadata = read_session(next((tmp_path / "out").glob("*.mcap"))).metadata
        assert metadata["sensor_package"].startswith("rigd-netft ")
        assert metadata["netft_rate_hz"] == "7000.0"
        assert metadata["sensor_serial_number"] == "FT00001"


def test_check_reads_the_box(tmp_path):
    rows = check_rig(load_profile(write_rig(tmp_path)))
    assert overall_verdict(rows) != "failed"
    found = " ".join(str(row.found) for row in rows)
    assert "rigd-netft" in found
    assert "FT00001" in found


def test_an_independent_client_reads_the_simulated_box(streaming_box):
    pynetft = pytest.importorskip("pynetft", reason="CLIENT NOT TESTED: pynetft is not installed")
    with serve_page(streaming_box.box) as http_port:
        config = pynetft.Config(
            sensor_host="127.0.0.1", rdt_port=streaming_box.port, http_port=http_port
        )
        client = pynetft.Client(config)
        client.start()
        assert client.wait_for_first_sample(20)
        sample = client.latest_sample()
        client.stop()
    assert tuple(sample.force) == pytest.approx(WRENCH[:3])
    assert tuple(sample.torque) == pytest.approx(WRENCH[3:])
