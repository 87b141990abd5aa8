"""A drive and a sensor in one file outside: each part of rigd takes them without a change."""

import json
import re
import sys

import pytest
from cases import further
from packages import DEVICES, install, rigd_with

from rigd.checks import run_offline_checks
from rigd.devices import actuation_target, check_selection, open_devices
from rigd.devices.contracts import DeviceError
from rigd.errors import FailureError
from rigd.plugins import PluginError, check_plugin, find_plugin, installed_plugins
from rigd.profile import ProfileError, load_profile
from rigd.session import read_session
from rigd.testing import DEVICE_CHECKS, write_profile

ENTRY_POINTS = "[rigd.devices]\ntwin = {0}:TWIN\nscaled = {0}:SCALED\n"
SECTIONS = """
[twin]
serial_number = "T1"

[scaled]
gain_percent = { value = 110.0, source = "datasheet" }
"""


def write_rig(folder, sections=SECTIONS, **devices):
    devices = {"drive": "twin", "sensor": "scaled"} | devices
    path = write_profile(
        folder, {"name": "lab"} | {f"devices.{key}": name for key, name in devices.items()}
    )
    path.write_text(path.read_text() + sections)
    return path


@pytest.fixture
def packages(tmp_path, monkeypatch):
    """Folder in which the package with the two devices is installed."""
    folder = tmp_path / "site"
    install(folder, "lab-devices", "1.2", DEVICES, ENTRY_POINTS.format("lab_devices"))
    monkeypatch.syspath_prepend(folder)
    yield folder
    sys.modules.pop("lab_devices", None)


def test_profile_reads_their_sections(packages, tmp_path):
    profile = load_profile(write_rig(tmp_path))
    twin, scaled = profile.rig.added_settings
    assert (twin.serial_number, twin.limit_nm) == ("T1", 5.0)  # the default
    assert (scaled.gain_percent, scaled.mode) == (110.0, "fast")
    assert profile.sources["scaled.gain_percent"] == "datasheet"
    check_selection(profile.rig.devices)
    assert actuation_target(profile.rig).allows_virtual_clock


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("110.0", "10.0", "scaled.gain_percent = 10 % must be at least 60"),
        ("gain_percent", "gain_hz", "wrong unit .* write scaled.gain_percent, the value in %"),
        ('"T1"', "1", 'twin.serial_number = 1 must be text'),
        ('serial_number = "T1"', "", "section .twin. is missing"),
        ('"T1"', '"T1"\nlimit_nm = 0.1', "limit_nm = 0.1 N·m does not state its source"),
        ('"T1"', '"T1"\nspeed = 1', "twin.speed is unknown; .twin. has serial_number, limit_nm"),
        ('"T1"', '"T1"\nlimit_nm = { value = 0.1, source = "assumed" }', "below motor.peak_tor"),
        ("[scaled]", '[scaled]\nmode = "odd"', 'scaled.mode = "odd" must be "fast" or "slow"'),
    ],
)  # fmt: skip
def test_wrong_values_are_named_as_those_of_other_sections(packages, tmp_path, old, new, message):
    with pytest.raises(ProfileError, match=message):
        load_profile(write_rig(tmp_path, SECTIONS.replace(old, new)))


def test_section_without_its_package_or_its_line_is_explained(tmp_path, monkeypatch):
    section = "[spare]\nspeed_percent = 1\n"
    with pytest.raises(ProfileError, match=r'sensor = "spare": no installed package has this dev'):
        load_profile(write_rig(tmp_path, section, drive="sim", sensor="spare"))
    install(tmp_path / "site", "spare", "1", "", "[rigd.devices]\nspare = spare:SPARE\n")
    monkeypatch.syspath_prepend(tmp_path / "site")
    lines = r'drive = "spare" or sensor = "spare" in the section \[devices\]'
    with pytest.raises(ProfileError, match=rf"\[spare\] is the section of the device .*{lines}"):
        load_profile(write_rig(tmp_path, section, drive="sim", sensor="sim"))


def test_added_devices_pass_the_checks(packages, tmp_path):
    rig = load_profile(write_rig(tmp_path)).rig
    for check in DEVICE_CHECKS:
        check(open_devices(rig))


def test_sensor_without_its_drive_is_refused(packages, tmp_path):
    profile = load_profile(write_rig(tmp_path, SECTIONS.partition("[scaled]")[0], sensor="sim"))
    with pytest.raises(ValueError, match=r"no known combination.*packages add .*scaled, twin"):
        check_selection(profile.rig.devices, profile.path)


@pytest.mark.process
def test_commands_check_run_and_list_added_devices(packages, tmp_path, rigd_here):
    path, out = write_rig(tmp_path), tmp_path / "out"
    done = rigd_here("check", "--profile", path, "--json")
    rows = {(row["group"], row["what"]): row for row in json.loads(done.stdout)["rows"]}
    assert done.returncode == 0
    assert rows["sensor", "gain"]["verdict"] == "ok"
    assert rows["devices", "twin"]["found"] == "lab-devices 1.2"
    # The processes of a session find the package, though the working folder is another.
    code, output, errors = rigd_with(
        packages, "run", "hold", "--duration", "0.2", "--profile", path, "--fast", "--seed", "1",
        "--output", out, cwd=tmp_path,
    )  # fmt: skip
    assert code == 0, output + errors
    metadata = read_session(next(out.glob("*.mcap"))).metadata
    assert metadata["drive_package"] == metadata["sensor_package"] == "lab-devices 1.2"
    assert metadata["gain_mode"] == "fast"
    listed = rigd_here("plugins").stdout
    assert "twin: twin of the simulated drive (rigd.devices, lab-devices 1.2)" in listed
    shown = rigd_here("plugins", "show", "twin").stdout
    assert "# serial number on the case\n" in shown
    assert '# limit_nm = { value = 5.0, source = "assumed" }' in shown


def test_failed_row_refuses_a_session(packages, tmp_path, rigd_here):
    path = write_rig(tmp_path, SECTIONS.replace("110.0", "300.0"))
    done = rigd_here("run", "hold", "--profile", path, "--fast")
    assert done.returncode != 0
    assert "device_settings" in done.stderr


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("grade(fail=gain > 200)", '"failed"', "gain: 110.0 %"),
        ("grade(fail=gain > 200)", '"fail"', "'fail' is not a valid CheckResult"),
        ("grade(fail=gain > 200)", "False", "False is not a valid CheckResult"),
        ('f"{gain} %"', "gain", "CheckRow.found must be text, not float"),
        ("yield CheckRow", "yield", "returned a tuple, and not a CheckRow"),
    ],
)
def test_row_of_a_wrong_form_refuses_a_session(packages, tmp_path, old, new, message):
    module = packages / "lab_devices.py"
    module.write_text(module.read_text().replace(old, new))
    profile = load_profile(write_rig(tmp_path))
    with pytest.raises((FailureError, PluginError)) as refusal:
        run_offline_checks(profile).require_passed()
    assert message in str(refusal.value)
    assert "lab-devices 1.2" in str(refusal.value) or new == '"failed"'


@pytest.mark.process
@pytest.mark.parametrize(
    ("statement", "reason"),
    [
        further("sensor.connect = lambda: {}[1]", "KeyError: 1"),
        ("gains, gain = [gain] * 2000, None", "IndexError: pop from empty list"),  # in a tick
    ],
)
def test_error_in_a_package_ends_the_session(packages, tmp_path, statement, reason):
    module = packages / "lab_devices.py"
    code = module.read_text().replace("    measure = ", f"    {statement}\n    measure = ")
    module.write_text(code.replace("(gain * each", "((gain or gains.pop()) * each"))
    code, output, errors = rigd_with(
        packages, "run", "hold", "--profile", write_rig(tmp_path), "--fast", "--output",
        tmp_path / "out",
    )  # fmt: skip
    printed = " ".join(f"{output} {errors}".split())
    assert code == 1
    assert "Traceback" not in printed
    assert re.search(rf"Package lab-devices 1\.2, .*: its code failed \({reason}\)", printed)


WRONG = {  # code of a package, its entry points, and the reason that is stated
    "raises": ("raise ValueError('no licence')", "w_raises:KIND", "ValueError: no licence"),
    "exits": ("raise SystemExit(3)", "w_exits:KIND", "SystemExit: 3"),
    "syntax": ("def", "w_syntax:KIND", "SyntaxError"),
    "imports": ("import no_such_module", "w_imports:KIND", "No module named 'no_such_module'"),
    "absent": ("", "w_absent:KIND", "no attribute 'KIND'"),
    "type": ("KIND = 3", "w_type:KIND", "is a int, not a DeviceKind"),
    "form": ("", "w_form", "not of the form name = module:object"),
    "other": (DEVICES, "w_other:TWIN", 'declares the device "twin"'),
    "range": (
        DEVICES.replace("= 5.0", "= -5.0").replace('"twin", "', '"range", "'), "w_range:TWIN",
        "the default of limit_nm is not in its range",
    ),
    "thawed": (
        DEVICES.replace("(frozen=True)", "").replace('"twin", "', '"thawed", "'),
        "w_thawed:TWIN", "not a frozen dataclass",
    ),
    "motor": (DEVICES.replace('"twin", "', '"motor", "'), "w_motor:TWIN", "every profile"),
    "cia402": (DEVICES.replace('"twin", "', '"cia402", "'), "w_cia402:TWIN", "built into rigd"),
    "Upper": ("", "w_Upper:KIND", "lower-case"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_unusable_package_is_named_without_affecting_others(packages, tmp_path, monkeypatch, name):
    code, reference, reason = WRONG[name]
    folder = tmp_path / "wrong"
    install(folder, f"w-{name}", "0.3", code, f"[rigd.devices]\n{name} = {reference}\n")
    monkeypatch.syspath_prepend(folder)
    (plugin,) = [each for each in installed_plugins("rigd.devices") if each.name == name]
    with pytest.raises(PluginError, match=reason) as caught:
        check_plugin(plugin)
    assert f"w-{name.lower()} 0.3" in str(caught.value)
    check_plugin(find_plugin("rigd.devices", "twin"))
    load_profile("sim")
    if name not in ("motor", "Upper", "cia402"):
        with pytest.raises(ProfileError, match=reason):
            load_profile(write_rig(tmp_path, sensor=name))


def test_packages_of_one_name_are_named_and_unused(packages, tmp_path, monkeypatch):
    install(tmp_path / "b", "other-lab", "2.0", DEVICES, "[rigd.devices]\ntwin = other_lab:TWIN\n")
    monkeypatch.syspath_prepend(tmp_path / "b")
    with pytest.raises(PluginError, match=r"lab-devices 1\.2.*other-lab 2\.0|other-lab 2\.0.*1\.2"):
        find_plugin("rigd.devices", "twin")
    assert find_plugin("rigd.devices", "scaled").package == "lab-devices"


def test_failing_code_is_an_error_with_its_package(packages, tmp_path, monkeypatch):
    rig = load_profile(write_rig(tmp_path)).rig
    monkeypatch.delattr("rigd.devices.parameters.RigParameters.settings_of")
    with pytest.raises(DeviceError, match=r"lab-devices 1\.2.*AttributeError"):
        open_devices(rig)


@pytest.mark.process
def test_packages_are_not_searched_in_the_working_folder(packages, tmp_path):
    install(tmp_path / "here", "here-only", "1", "KIND = 1", "[rigd.devices]\nhere = here_only:K\n")
    code, output, _ = rigd_with(
        packages, "plugins", "--json", cwd=tmp_path / "here", program=("-m", "rigd"), cold=True
    )
    assert code == 0
    assert {row["name"] for row in json.loads(output)["plugins"]} >= {"twin", "scaled"}
    assert "here" not in output
    code = (
        "import sys; sys.argv[1:] = ['--help']\n"
        "from rigd.__main__ import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "sys.exit(len({'importlib.metadata', 'rigd.plugins', 'lab_devices'} & set(sys.modules)))"
    )
    assert rigd_with(packages, program=("-c", code), cold=True)[0] == 0
