"""Profiles of rigs on the wire: the shipped ones, and contradictions with the protocol."""

import re
from pathlib import Path

import pytest

from rigd.control import check_stability, close_loop
from rigd.excitation import chirp
from rigd.profile import load_profile
from rigd.runner.planning import plan_session

HW_PROFILES = Path(__file__).parents[2] / "hw_profiles"


@pytest.fixture
def refuse(complaints_of):
    """Change a shipped profile, load it, and return the lines of the complaint."""

    def attempt(name: str, *changes: tuple[str, str]) -> list[str]:
        return complaints_of((HW_PROFILES / f"{name}.toml").read_text("utf-8"), *changes)

    return attempt


@pytest.mark.parametrize("name", ["antenna_can", "antenna_serial"])
def test_every_number_has_a_source(name):
    profile = load_profile(name)
    numbers = re.findall(r"^\w+ = \{", profile.text, re.MULTILINE)
    assert len(profile.sources) == len(numbers) > 60


@pytest.mark.parametrize("name", ["antenna_can", "antenna_serial"])
def test_the_paper_s_chirp_is_stable_and_within_the_limits(name):
    profile = load_profile(name)
    assert check_stability(close_loop(profile.loop_model())) is None
    assert plan_session(profile, chirp(rate_hz=profile.rig.rate_hz)).warnings == ()


def test_sections_are_those_of_the_chosen_devices():
    can, serial = load_profile("antenna_can").rig, load_profile("antenna_serial").rig
    assert can.can == serial.can
    assert can.cia402 == serial.cia402
    assert can.ati_can is not None
    assert can.ati_serial is None
    assert serial.ati_serial is not None
    assert serial.ati_can is None
    assert (can.name, serial.name) == ("antenna_can", "antenna_serial")


def test_a_section_needed_by_a_device_is_required(refuse):
    (line,) = refuse("antenna_can", ('sensor = "ati_can"', 'sensor = "ati_serial"'))[:1]
    assert line == (
        'section [ati_serial] is missing, which devices.drive = "cia402" with devices.sensor = '
        '"ati_serial" needs.'
    )


def test_an_unused_section_is_refused(refuse):
    lines = refuse("antenna_can", ('drive = "cia402"', 'drive = "sim"'), (
        'sensor = "ati_can"', 'sensor = "sim"'))  # fmt: skip
    assert any(line.startswith("section [ati_can] belongs to none of") for line in lines)


@pytest.mark.parametrize(
    ("name", "old", "new", "complaint"),
    [
        ("antenna_can", "max_speed_rad_s = { value = 5.0", "max_speed_rad_s = { value = 3.0",
         r"cia402.max_speed_rad_s = 3 rad/s is below limits.velocity_rad_s = 4 rad/s; .*"),
        ("antenna_can", 'mode = "same_tick"', 'mode = "next_tick"', r'acquisition.mode = "next_t'
         r'ick" must be "same_tick" or "previous_tick"\.'),
        ("antenna_can", 'mode = "same_tick"', 'mode = "previous_tick"',
         r"encoder.delay_s = 5.5e-05 s is less than the reply of the previous tick alone: at lea"
         r"st 0.001 s\."),
        ("antenna_can", "deadline_us = { value = 700.0", "deadline_us = { value = 1000.0",
         r"acquisition.deadline_us = 1000 µs is not below the period of 1000 µs"),
        ("antenna_can", "direction = { value = 1,", "direction = { value = 0,",
         r"cia402.direction = 0 must be 1, or -1"),
        ("antenna_can", "host_node_id = { value = 127,", "host_node_id = { value = 1,",
         r"cia402.host_node_id = 1 is the drive's own"),
        ("antenna_can", "heartbeat_timeout_s = { value = 0.05,",
         "heartbeat_timeout_s = { value = 0.015,",
         r"cia402.heartbeat_timeout_s = 0.015 s is below twice cia402.heartbeat_period_s"),
        ("antenna_can", "heartbeat_period_s = { value = 0.01,",
         "heartbeat_period_s = { value = 0.0104,",
         r"cia402.heartbeat_period_s = 0.0104 s must be a whole number of milliseconds"),
        ("antenna_can", "peak_torque_nm = { value = 0.9,", "peak_torque_nm = { value = 20.0,",
         r"motor.peak_torque_nm is 40 times"),
        ("antenna_can", "delay_s = { value = 1.0e-3,", "delay_s = { value = 0.5e-3,",
         r"actuation.delay_s = 0.0005 s is less than a torque that takes effect at the next SYNC"),
        ("antenna_can", "base_id = { value = 0x68,", "base_id = { value = 0x80,",
         r"ati_can.base_id = 128 must be at most 127"),
        ("antenna_can", "bitrate_bit_s = { value = 1_000_000,", "bitrate_bit_s = { value = 1e6,",
         r"can.bitrate_bit_s = 1e\+06 bit/s must be a whole number"),
        ("antenna_can", 'serial_number = ""', "serial_number = 5",
         r"ati_can.serial_number = 5 must be text in quotes"),
        ("antenna_serial", 'mode = "same_tick"', 'mode = "previous_tick"',
         r'acquisition.mode = "previous_tick" cannot be used with \[ati_serial\]'),
        ("antenna_serial", "baud = { value = 1_250_000,", "baud = { value = 115_200,",
         r"ati_serial.stream_hz = 7000 Hz does not fit ati_serial.baud = 115200, which carries "
         r"806 records a second"),
        ("antenna_serial", "delay_s = { value = 5.33e-4,", "delay_s = { value = 0.0,",
         r"sensor.delay_s = 0 s is less than .* at least 0.000428571 s"),
        ("antenna_serial", "stream_hz = { value = 7000.0,", "stream_hz = { value = 700.0,",
         r"ati_serial.stream_hz = 700 Hz is below rig.rate_hz"),
    ],
)  # fmt: skip
def test_a_contradiction_with_the_protocol_is_reported(refuse, name, old, new, complaint):
    lines = refuse(name, (old, new))
    assert any(re.match(complaint, line) for line in lines), lines


@pytest.mark.parametrize("name", ["../../evil", "a/b", "a\\u0000b", "x" * 70, ".hidden", "-x"])
def test_a_name_has_to_be_valid_in_file_names(refuse, name):
    (line,) = refuse("antenna_can", ('name = "antenna_can"', f'name = "{name}"'))
    assert "cannot be used in file names" in line


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        (
            'accept_without = ["watchdogs"]',
            r'accept_without\[0\] = "watchdogs" .*choose watchdog, '
            r"torque_limit, abort_option, torque_feedback",
        ),
        ('accept_without = "watchdog"', r'accept_without = "watchdog" must be an array of texts'),
        ("accept_without = [1]", r"accept_without\[0\] = 1 must be text in quotes"),
        (
            'set_objects = ["3001:2 2500"]',
            r'set_objects\[0\] = "3001:2 2500" must be index:sub, type',
        ),
        ('set_objects = ["3001:2 f32 2500"]', r"set_objects\[0\] .*unknown type 'f32'"),
        ('set_objects = ["3001:2 u8 256"]', r"set_objects\[0\] .*u8 does not hold \(0 to 255\)"),
        ('set_objects = ["3001:2 u8 abc"]', r"set_objects\[0\] .*not a whole number"),
        ('set_objects = ["6072 u16 100"]', r"set_objects\[0\] .*rigd sets itself"),
        ('set_objects = ["6071 i16 100"]', r"set_objects\[0\] .*rigd sets itself"),
        ('set_objects = ["1600:1 u32 1"]', r"set_objects\[0\] .*rigd sets itself"),
        ('set_objects = ["1010:1 u32 0x65766173"]', r"set_objects\[0\] .*memory at every start"),
        ('eds = "nowhere.eds"', r'eds = "nowhere.eds": there is no file .*nowhere.eds'),
        ("sync_gaps = 1", r"sync_gaps = 1 must be true or false"),
        ("own_watchdog_s = 0.1", r"own_watchdog_s = 0.1 s does not state its source"),
        ('own_watchdog_s = { value = -1.0, source = "assumed" }', r"own_watchdog_s = -1 s must be"),
        (
            'torque_response_s = { value = "x", source = "assumed" }',
            r"torque_response_s = .x. s must be",
        ),
    ],
)
def test_wrong_values_of_optional_keys(refuse, line, complaint):
    lines = refuse("antenna_can", ("[cia402]\n", f"[cia402]\n{line}\n"))
    assert any(re.match(f"cia402.{complaint}", each) for each in lines), lines


def test_optional_keys(tmp_path):
    text = load_profile("antenna_can").text
    plain = load_profile("antenna_can").rig.cia402
    assert (plain.eds, plain.set_objects, plain.accept_without) == ("", (), ())
    assert (plain.sync_gaps, plain.follows_target_bit) == (False, True)
    assert (plain.own_watchdog_s, plain.torque_response_s) == (0, 0)
    (tmp_path / "drive.eds").write_text("")
    path = tmp_path / "other.toml"
    lines = (
        'eds = "drive.eds"',
        'set_objects = ["3001:2 u32 2500", "0x2005 i16 -3"]',
        'accept_without = ["torque_limit"]',
        'own_watchdog_s = { value = 0.1, source = "datasheet" }',
        "sync_gaps = true",
        'torque_response_s = { value = 0.0032, source = "measured" }',
        "follows_target_bit = false",
    )
    path.write_text(text.replace("[cia402]\n", "[cia402]\n" + "\n".join(lines) + "\n"))
    profile = load_profile(path)
    drive = profile.rig.cia402
    assert drive.eds == str(tmp_path.resolve() / "drive.eds")
    assert drive.set_objects == ("3001:2 u32 2500", "0x2005 i16 -3")
    assert drive.accept_without == ("torque_limit",)
    assert (drive.sync_gaps, drive.follows_target_bit) == (True, False)
    assert profile.sources["cia402.torque_response_s"] == "measured"
