"""`rigd check` without a device and the start of a session refuse the same profiles."""

import inspect
import json
import re
import shutil
from pathlib import Path

import pytest
from cases import further
from eds_files import eds_path

from rigd.check_rows import CheckResult, overall_verdict
from rigd.checks import ACCEPTABLE_ROW_NAMES, check_without_devices, run_offline_checks
from rigd.control import ControlDesignError
from rigd.devices import MAY_BE_UNKNOWN, open_devices, unknown_values
from rigd.devices.contracts import DeviceError
from rigd.errors import UserError
from rigd.excitation import KINDS, hold
from rigd.profile import ProfileError, load_profile
from rigd.runner import Rig, RigError, Series
from rigd.runner.planning import excitation_for
from rigd.testing import write_profile

FACTORS = {
    "cia402.gear_ratio": (0.01, 0.2, 5, 100),
    "motor.rated_torque_nm": (0.1, 0.2, 0.5, 1.5, 5),
    "motor.peak_torque_nm": (0.2, 0.56, 0.7, 2, 5, 20),
    "motor.inertia_kg_m2": (0.05, 0.2, 0.5, 2, 5, 20),
    "motor.coulomb_nm": (0, 0.1, 10),
    "encoder.resolution_rad": (0.1, 10),
    "limits.angle_rad": (0.005, 0.5, 1.9),
    "limits.stop_angle_rad": (0.51, 0.6, 0.7, 3),
    "limits.velocity_rad_s": (0.1, 0.3, 0.5, 2),
    "limits.tracking_error_rad": (0.1, 0.5),
    "limits.missed_ticks_in_a_row": (2, 6, 12, 16, 40),
    "limits.stale_ticks_in_a_row": (10, 30, 100),
    "cia402.max_speed_rad_s": (0, 0.5, 2, 4, 10),
    "cia402.heartbeat_timeout_s": (2, 4, 8, 20, 100),
    "actuation.delay_s": (2, 5, 20),
}
WRONG_VALUES = [(key, factor) for key, factors in FACTORS.items() for factor in factors]
AT_ONCE = {
    ("limits.velocity_rad_s", 0.3), ("actuation.delay_s", 20), ("limits.missed_ticks_in_a_row", 16),
}  # fmt: skip


def test_sixty_wrong_values():
    assert len(WRONG_VALUES) == 60


@pytest.fixture
def wrong_value(tmp_path, can_profile):
    """Write the shipped profile with one value multiplied."""

    def wrong_value(key, factor):
        section, _, name = key.partition(".")
        owner = getattr(can_profile, section, None) or getattr(can_profile.rig, section)
        value = type(getattr(owner, name))(getattr(owner, name) * factor)
        return write_profile(tmp_path, {"name": "one_lie", key: value}, base_profile="antenna_can")

    return wrong_value


def refusal(profile, folder, kind, accept=(), **options):
    """Return the reason for refusing a session, or ""."""
    try:
        Series(profile, excitation_for(profile, kind, options), folder, accepted_row_names=accept)
    except (RigError, ControlDesignError) as error:
        return str(error)
    except Exception as error:
        assert type(error).__name__ in ("CheckFailedError", "RefusedError"), error
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("key", "factor"), [each if each in AT_ONCE else further(*each) for each in WRONG_VALUES]
)
def test_check_and_run_agree_on_a_wrong_value(wrong_value, tmp_path, key, factor):
    path = wrong_value(key, factor)
    try:
        profile = load_profile(path)
    except ProfileError:
        return  # neither command begins
    rows = check_without_devices(profile, None)
    failed = [row for row in rows if row.verdict is CheckResult.FAIL]
    assert {row.name for row in failed} == {
        each.name for each in run_offline_checks(profile).failed
    }
    refused = refusal(profile, tmp_path / "out", "hold", duration_s=0.5)
    assert bool(failed) == bool(refused)
    for row in failed:
        assert f"({row.name})" in refused or row.found in refused
    # A chirp may exceed limits that a hold does not: check reports that, too.
    chirp = refusal(profile, tmp_path / "out", "chirp")
    advice = [row.verdict for row in rows if row.what == "chirp without options"]
    assert bool(chirp) == bool(failed or advice == [CheckResult.WARNING])


def test_the_shipped_profiles_pass(can_profile, serial_profile):
    for profile in (can_profile, serial_profile, load_profile("sim")):
        assert run_offline_checks(profile).failed == ()


def test_every_failed_row_has_the_name_of_its_check(wrong_value):
    profile = load_profile(wrong_value("limits.stop_angle_rad", 0.51))
    travel = {
        "travel_loop_fails", "travel_no_angle", "travel_encoder_fails", "travel_missed_ticks",
    }  # fmt: skip
    assert {each.name for each in run_offline_checks(profile).failed} == travel
    assert {
        row.name for row in check_without_devices(profile, None) if row.verdict is CheckResult.FAIL
    } == travel


def test_only_accepted_rows_pass(wrong_value, tmp_path):
    profile = load_profile(wrong_value("limits.stop_angle_rad", 0.51))
    rows = ["travel_loop_fails", "travel_no_angle", "travel_encoder_fails", "travel_missed_ticks"]
    left = refusal(profile, tmp_path, "hold", accept=rows[:3])
    assert "(travel_missed_ticks)" in left
    assert "(travel_no_angle)" not in left
    assert not refusal(profile, tmp_path, "hold", accept=rows)
    series = Series(profile, hold(rate_hz=1000.0), tmp_path, accepted_row_names=rows)
    assert [each.name for each in series.plan.offline_check_result.accepted] == rows
    # Nothing else is accepted with it.
    assert "limits.velocity_rad_s" in refusal(
        profile, tmp_path, "chirp", accept=rows, amplitude_rad=0.2
    )


def test_every_acceptable_row_is_documented():
    page = (Path(__file__).parents[2] / "docs" / "check_a_rig.md").read_text("utf-8")
    table = page.partition("| row | what failed |")[2].partition("\n\n")[0]
    assert tuple(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == ACCEPTABLE_ROW_NAMES


def test_an_unknown_name_is_refused_with_the_known_ones(can_profile):
    with pytest.raises(UserError, match="travel_loop_fails, travel_no_angle") as refused:
        run_offline_checks(can_profile, ["worst travel"])
    assert refused.value.wrong_use
    with pytest.raises(UserError, match="nothing can be computed without it"):
        run_offline_checks(can_profile, ["unknown_values"])


def test_the_eds_of_the_drive_is_checked(can_profile, tmp_path):
    shutil.copy(eds_path("epos4_0170"), tmp_path / "drive.eds")
    values = {"cia402.eds": "drive.eds"}
    profile = load_profile(write_profile(tmp_path, values, base_profile="antenna_can"))
    assert "It has no object 6072 (Max torque)" in refusal(profile, tmp_path, "hold")
    assert not refusal(profile, tmp_path, "hold", accept=["eds"])


@pytest.mark.parametrize("command", ["run", further("identify")])
def test_the_command_refuses_before_it_connects(rigd_here, wrong_value, command):
    path = wrong_value("limits.missed_ticks_in_a_row", 16)
    what = ("hold",) if command == "run" else ("motor",)
    done = rigd_here(command, *what, "--profile", path)
    assert (done.returncode, done.stdout) == (1, ""), done.stderr
    assert "rigd check fails (travel_missed_ticks): travel, worst, if ticks are" in done.stderr
    assert done.stderr.count("\n") == 1
    if command == "run":
        done = rigd_here(command, *what, "--profile", path, "--accept", "misses")
        assert done.returncode == 2
        assert "--accept misses: no row of rigd check has that name" in done.stderr


def test_check_shows_names(rigd_here, wrong_value, monkeypatch):
    monkeypatch.setattr("rigd.cli.check.signal.signal", lambda *_: None)
    monkeypatch.setattr("rigd.checks._check.inspect_devices", lambda _: [])
    path = wrong_value("limits.missed_ticks_in_a_row", 16)
    done = rigd_here("check", "--profile", path)
    assert done.returncode == 1
    for name in ("loop_stability", "can_load", "travel_no_angle", "travel_missed_ticks"):
        assert done.stdout.count(f"  {name} ") == 1
    assert "--accept travel_missed_ticks" in done.stdout


# Unknown values


@pytest.fixture
def unknown(tmp_path, can_profile):
    """Write the shipped profile, or another, with unknown values."""

    def unknown(*keys, base=can_profile):
        text, section = "", ""
        for line in base.text.splitlines():
            section = f"{line.strip('[]')}." if line.startswith("[") else section
            name = line.partition(" =")[0]
            if section + name == "name":
                text += 'name = "rig_of_unknowns"\n'
            elif section + name in keys:
                text += f'{name} = {{ source = "unknown" }}\n'
            else:
                text += f"{line}\n"
        path = tmp_path / "unknown.toml"
        path.write_text(text, "utf-8")
        return path

    return unknown


@pytest.mark.process
@pytest.mark.parametrize("key", MAY_BE_UNKNOWN)
def test_an_unknown_value_is_named_where_needed(unknown, tmp_path, key):
    path = unknown(key)
    profile = load_profile(path)
    assert unknown_values(profile.rig) == (key,)
    assert profile.sources[key] == "unknown"
    (failed,) = [
        row for row in check_without_devices(profile, None) if row.verdict is CheckResult.FAIL
    ]
    assert (failed.what, failed.name) == (key, "unknown_values")
    assert str(path) in failed.detail
    assert MAY_BE_UNKNOWN[key] in failed.detail
    with pytest.raises(UserError, match=key):
        Series(profile, hold(rate_hz=1000.0), tmp_path / "out")
    with pytest.raises(UserError, match=key):
        excitation_for(profile, "move", {"angle_rad": 0.1})
    with pytest.raises(DeviceError, match=key):
        open_devices(profile.rig)
    with pytest.raises(RigError, match=key):
        Rig(profile).connect()
    assert not (tmp_path / "out").exists()


def test_all_values_unknown_and_on_a_simulated_rig(unknown, tmp_path):
    assert unknown_values(load_profile(unknown(*MAY_BE_UNKNOWN)).rig) == tuple(MAY_BE_UNKNOWN)
    profile = load_profile(unknown("motor.inertia_kg_m2", base=load_profile("sim")))
    assert overall_verdict(check_without_devices(profile, None)) == "failed"
    with pytest.raises(DeviceError, match="inertia_kg_m2 is unknown; enter its value"):
        open_devices(profile.rig)


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", "hold"), ("run", "move", "0.1"), ("run", "until", "--damping", "1%"),
        ("identify", "motor"), ("reset",), ("simulate",), ("check",),
    ],
    ids=lambda words: " ".join(words[:2]),
)  # fmt: skip
def test_commands_name_unknown_values(rigd_here, unknown, monkeypatch, arguments):
    monkeypatch.setattr("rigd.cli.check.signal.signal", lambda *_: None)
    monkeypatch.setattr("rigd.checks._check.rights_rows", lambda _: [])
    path = unknown("motor.peak_torque_nm", "cia402.gear_ratio")
    done = rigd_here(*arguments, "--profile", path)
    assert done.returncode in (1, 2)
    printed = done.stdout + done.stderr
    assert "motor.peak_torque_nm" in printed
    assert "cia402.gear_ratio" in printed
    assert "Traceback" not in printed


def test_commands_without_need_of_values_work(rigd_here, unknown):
    path = unknown(*MAY_BE_UNKNOWN)
    done = rigd_here("check", "--eds", eds_path("elmo_gold"), "--profile", path, "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads(done.stdout)["rows"]
    assert not [row for row in rows if row["verdict"] == "failed"]
    assert rigd_here("profiles", "show", path).returncode == 0
    assert rigd_here("profiles", "copy", path, "mine", "--here").returncode == 0
    assert unknown_values(load_profile("hw_profiles/mine.toml").rig) == tuple(MAY_BE_UNKNOWN)


def test_every_excitation_is_refused(unknown, tmp_path):
    """By the check, whatever values the excitation itself needs."""
    profile = load_profile(unknown("motor.inertia_kg_m2"))
    for kind, function in KINDS.items():
        given = {"angle_rad": 0.1, "targets": "damping 1%"}
        known = inspect.signature(function).parameters
        needed = {name: value for name, value in given.items() if name in known}
        if kind in ("file", "modes"):
            continue  # read a file first
        with pytest.raises(UserError, match="inertia_kg_m2"):
            Series(profile, excitation_for(profile, kind, needed), tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (
            'inertia_kg_m2 = { value = 2.0e-3, source = "assumed" }',
            'inertia_kg_m2 = { value = 2.0e-3, source = "unknown" }',
            'motor.inertia_kg_m2 = 0.002 kg·m² has a value, and source = "unknown"; remove',
        ),
        (
            'angle_rad = { value = 1.57, source = "assumed" }',
            'angle_rad = { value = 1.57, source = "unknown" }',
            'limits.angle_rad has source = "unknown", but needs a value; only motor.inertia',
        ),
    ],
)
def test_a_value_and_no_value_exclude_each_other(can_profile, tmp_path, old, new, complaint):
    path = tmp_path / "rig.toml"
    assert old in can_profile.text
    path.write_text(can_profile.text.replace(old, new, 1), "utf-8")
    with pytest.raises(ProfileError) as caught:
        load_profile(path)
    assert f"{path}: {complaint}" in str(caught.value)
