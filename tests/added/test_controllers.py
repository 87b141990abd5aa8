"""Controllers in one file outside: profile, check, sessions, file and commands take them."""

import json
import sys

import numpy as np
import pytest
from packages import CONTROLLERS, install, rigd_with

from rigd.check_rows import CheckResult
from rigd.checks import check_rig, run_offline_checks
from rigd.control import LinearController, close_loop
from rigd.control.kinds import make_controller
from rigd.excitation import hold
from rigd.plugins import PluginError, check_plugin, find_plugin, installed_plugins
from rigd.profile import ProfileError, load_profile
from rigd.runner.planning import plan_session
from rigd.session import read_session
from rigd.testing import CONTROLLER_CHECKS, write_profile

GROUP = "rigd.controllers"
ENTRY_POINTS = (
    f"[{GROUP}]\nstatespace = {{0}}:STATE_SPACE\ndashpot = {{0}}:DASHPOT\nown = {{0}}:OWN\n"
)
SECTIONS = {
    "statespace": 'pole_rad_s = { value = 80.0, source = "assumed" }',
    "dashpot": 'speed_percent = { value = 60.0, source = "assumed" }',
    "own": 'stiffness_nm_per_rad = { value = 9.0, source = "assumed" }',
}


def write_rig(folder, name, section=None, **values):
    path = write_profile(folder, {"name": "lab", "control.controller": name} | values)
    keys = SECTIONS.get(name) if section is None else section
    if keys is not None:
        path.write_text(f"{path.read_text()}\n[{name}]\n{keys}\n")
    return path


@pytest.fixture
def packages(tmp_path, monkeypatch):
    """Folder in which the package with the controllers is installed."""
    folder = tmp_path / "site"
    install(folder, "lab-laws", "2.1", CONTROLLERS, ENTRY_POINTS.format("lab_laws"))
    monkeypatch.syspath_prepend(folder)
    yield folder
    sys.modules.pop("lab_laws", None)


@pytest.mark.parametrize("name", SECTIONS)
def test_added_controller_meets_the_contract_in_a_profile(packages, tmp_path, name):
    profile = load_profile(write_rig(tmp_path, name))
    assert profile.control.controller == name
    assert run_offline_checks(profile).failed == ()
    for check in CONTROLLER_CHECKS:
        check(profile)


def test_the_pid_as_matrices_is_the_pid(packages, tmp_path):
    shipped = load_profile(write_rig(tmp_path, "pid", **{"control.friction_compensation_nm": 0.0}))
    added = load_profile(write_rig(tmp_path, "statespace"))
    loops = [close_loop(profile.loop_model()) for profile in (shipped, added)]
    reference_rad = 0.02 * np.sin(0.01 * np.arange(2000))
    responses = [loop.simulate(reference_rad).angle_rad for loop in loops]
    assert np.allclose(*responses, atol=1e-12)
    # Tick by tick too, also at the limit of the torque.
    controllers = [make_controller(profile.controlled_rig()) for profile in (shipped, added)]
    for controller in controllers:
        controller.reset(0.1)
    readings = np.random.default_rng(1).normal(0.1, 0.1, (500, 3))
    torques_nm = np.array([[each.step(*row) for each in controllers] for row in readings])
    assert np.allclose(torques_nm[:, 0], torques_nm[:, 1], atol=1e-9)
    limit_nm = shipped.rig.motor.peak_torque_nm
    assert (np.abs(torques_nm) == limit_nm).any()
    assert not (np.abs(torques_nm) == limit_nm).all()


def test_a_shift_of_the_reference_damps_the_predicted_loop(packages, tmp_path):
    def decay_per_s(profile):
        poles = close_loop(profile.loop_model()).poles_rad_s
        return -max(pole.real for pole in poles if 5.0 < abs(pole.imag) < 50.0)

    assert decay_per_s(load_profile(write_rig(tmp_path, "dashpot"))) > 2 * decay_per_s(
        load_profile("sim")
    )


@pytest.mark.parametrize(
    ("name", "section", "message"),
    [
        ("statespace", SECTIONS["statespace"].replace("80", "5"), "pole_rad_s = 5 rad/s must be m"),
        ("statespace", SECTIONS["statespace"].replace("rad_s", "hz"), "wrong unit .*in rad/s"),
        ("statespace", "pole_rad_s = 80.0", "does not state its source"),
        ("statespace", SECTIONS["statespace"].replace("80.0", "nan"), "pole_rad_s = nan rad/s"),
        ("statespace", SECTIONS["statespace"] + "\nspeed = 1", "statespace.speed is unknown"),
        ("statespace", "", r"section \[statespace\] is missing, which control.controller"),
        ("dashpot", SECTIONS["dashpot"] + '\nslow_hz = {value = 4.5, source = "assumed"}', ""),
        ("nosuch", None, '"nosuch" is not known; choose "pid" or .*"own"'),
        ("", None, "control.controller"),
    ],
)  # fmt: skip
def test_wrong_values_are_named_as_those_of_other_sections(
    packages, tmp_path, name, section, message
):
    values = {} if message else {"rig.rate_hz": 400.0}
    with pytest.raises(ProfileError, match=message or r"dashpot\.slow_hz = 4\.5 Hz is too fast"):
        load_profile(write_rig(tmp_path, name, section, **values))


def test_section_without_its_package_or_its_line_is_explained(tmp_path, monkeypatch):
    with pytest.raises(ProfileError, match=r'controller = "spare": no installed package has'):
        load_profile(write_rig(tmp_path, "spare", ""))
    install(tmp_path / "site", "spare", "1", "", f"[{GROUP}]\nspare = spare:SPARE\n")
    monkeypatch.syspath_prepend(tmp_path / "site")
    path = write_profile(tmp_path, {"name": "lab"})
    path.write_text(f"{path.read_text()}\n[spare]\n")  # all keys have defaults
    with pytest.raises(ProfileError, match=r'write controller = "spare" in the section .control'):
        load_profile(path)


def test_unstable_loop_and_failed_row_refuse_a_session(packages, tmp_path):
    unstable = write_rig(
        tmp_path, "statespace",
        SECTIONS["statespace"] + '\ngain = { value = 30.0, source = "assumed" }',
    )  # fmt: skip
    (failed,) = run_offline_checks(load_profile(unstable)).failed
    assert failed.name == "loop_stability"
    assert "change the settings of [statespace]" in failed.text
    stiff = write_rig(tmp_path, "own", SECTIONS["own"].replace("9.0", "30.0"))
    (failed,) = run_offline_checks(load_profile(stiff)).failed
    assert (failed.name, failed.acceptable) == ("controller", False)
    assert "30 N·m/rad" in failed.text


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("grade(fail=stiffness > 20)", '"failed"', "controller, stiffness: 9 N·m/rad"),
        ("grade(fail=stiffness > 20)", "None", "None is not a valid CheckResult"),
        ('"at most 20"', "20", "CheckRow.wanted must be text, not int"),
        ("yield CheckRow", "yield", "returned a tuple, and not a CheckRow"),
    ],
)
def test_row_of_a_wrong_form_refuses_a_session(packages, tmp_path, old, new, message):
    module = packages / "lab_laws.py"
    module.write_text(module.read_text().replace(old, new))
    (failed,) = run_offline_checks(load_profile(write_rig(tmp_path, "own"))).failed
    assert (failed.name, failed.acceptable) == ("controller", False)
    assert message in failed.text


def test_code_without_matrices_is_partly_predicted(packages, tmp_path):
    profile = load_profile(write_rig(tmp_path, "own"))
    rows = {(row.group, row.what): row for row in check_rig(profile)}
    assert rows["controller", "own"].found == "lab-laws 2.1"
    assert rows["controller", "stiffness"].verdict is CheckResult.OK
    assert rows["loop", "stability"].verdict is CheckResult.WARNING
    assert rows["loop", "margins"].verdict is CheckResult.SKIPPED
    plan = plan_session(profile, hold(rate_hz=1000, duration_s=0.5))
    assert "states no matrices" in plan.warnings[-1]
    assert plan.ending.damper is None
    shipped = plan_session(load_profile("sim"), hold(rate_hz=1000, duration_s=0.5))
    assert not any("matrices" in warning for warning in shipped.warnings)
    assert plan.prediction == shipped.prediction


@pytest.mark.process
def test_commands_check_run_and_list_added_controllers(packages, tmp_path, rigd_here):
    path, out = write_rig(tmp_path, "dashpot"), tmp_path / "out"
    done = rigd_here("check", "--profile", path, "--json")
    assert done.returncode == 0, done.stderr
    rows = {(row["group"], row["what"]): row for row in json.loads(done.stdout)["rows"]}
    assert rows["controller", "dashpot"]["found"] == "lab-laws 2.1"
    # The processes of a session find the package, though the working folder is another.
    code, output, errors = rigd_with(
        packages, "run", "hold", "--duration", "0.2", "--rest", "0", "--ring-down", "0",
        "--profile", path, "--fast", "--seed", "1", "--output", out, cwd=tmp_path,
    )  # fmt: skip
    assert code == 0, output + errors
    metadata = read_session(next(out.glob("*.mcap"))).metadata
    assert metadata["controller"] == "dashpot"
    assert metadata["controller_package"] == "lab-laws 2.1"
    listed = rigd_here("plugins").stdout
    assert "dashpot: reference that yields to the beam (rigd.controllers, lab-laws 2.1)" in listed
    shown = rigd_here("plugins", "show", "statespace").stdout
    assert shown.startswith('# In [control]: controller = "statespace"\n[statespace]\n')
    assert "# poles of the motor alone; more than 10; at most 200; in rad/s\n" in shown


def renamed(name, old="", new=""):
    """Return the package's code with the own controller under another name, and one change."""
    assert old in CONTROLLERS
    return CONTROLLERS.replace('"own", "', f'"{name}", "').replace(old or "\0", new)


WRONG = {  # code of a package, and the reason that is stated
    "raises": ("raise ValueError('no licence')", "ValueError: no licence"),
    "exits": ("raise SystemExit(3)", "SystemExit: 3"),
    "syntax": ("def", "SyntaxError"),
    "absent": ("", "no attribute 'OWN'"),
    "type": ("OWN = 3", "is a int, not a ControllerKind"),
    "other": (CONTROLLERS, 'declares the controller "own"'),
    "empty": (renamed("empty", "make=Own, ", ""), "neither matrices nor code"),
    "range": (renamed("range", "= 8.0", "= -8.0"), "stiffness_nm_per_rad is not in its range"),
    "thawed": (renamed("thawed", "(frozen=True)\nclass Own", "\nclass Own"), "not a frozen"),
    "motor": (renamed("motor"), "section of every profile; rename the controller"),
    "pid": (renamed("pid"), "built into rigd and cannot be replaced"),
}


@pytest.mark.parametrize("name", WRONG)
def test_unusable_package_is_named_without_affecting_others(packages, tmp_path, monkeypatch, name):
    code, reason = WRONG[name]
    entry_points = f"[{GROUP}]\n{name} = v_{name}:OWN\n"
    install(tmp_path / "wrong", f"v-{name}", "0.3", code, entry_points)
    monkeypatch.syspath_prepend(tmp_path / "wrong")
    (plugin,) = [each for each in installed_plugins(GROUP) if each.name == name]
    with pytest.raises(PluginError, match=reason) as caught:
        check_plugin(plugin)
    assert f"v-{name} 0.3" in str(caught.value)
    check_plugin(find_plugin(GROUP, "dashpot"))
    load_profile(write_rig(tmp_path, "dashpot"))
    if name == "pid":  # the shipped one runs all the same
        profile = load_profile(write_rig(tmp_path, "pid"))
        make_controller(profile.controlled_rig())
    else:
        with pytest.raises(ProfileError, match=f'control.controller = "{name}".*{reason}'):
            load_profile(write_rig(tmp_path, name))


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("def __init__(self, rig):", "def __init__(self, rig):\n        oops", "NameError"),
        ("def __init__(self, rig):", "def __init__(self, rig):\n        raise SystemExit", "Exit"),
        ("def step(", "def tick(", "has no reset and step"),
        ("self.last_error = 0.0", "self.last_error = no", "NameError"),
        ("return self.stiffness", "return 1.0 + self.stiffness", "1 N·m"),
        ("return self.stiffness", "return float('nan') + self.stiffness", "returned nan"),
        ("return self.stiffness", "return 1 / 0 + self.stiffness", "ZeroDivisionError"),
        ("make=Own", "linear=Own", "returns a Own, not a LinearController"),
        ("make=Own", "linear=lambda rig: LinearController([[1, 2]], [], [], [])", "a must have"),
    ],
)  # fmt: skip
def test_failing_code_refuses_a_session_with_its_package(
    packages, tmp_path, monkeypatch, old, new, reason
):
    install(tmp_path / "b", "u-bad", "1", renamed("bad", old, new), f"[{GROUP}]\nbad = u_bad:OWN\n")
    monkeypatch.syspath_prepend(tmp_path / "b")
    profile = load_profile(write_rig(tmp_path, "bad", SECTIONS["own"]))
    failed = run_offline_checks(profile).failed
    assert {each.acceptable for each in failed} == {False}
    assert any(reason in each.text for each in failed)
    sys.modules.pop("u_bad", None)


def test_missing_package_is_an_error(packages, tmp_path, monkeypatch):
    profile = load_profile(write_rig(tmp_path, "own"))
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each != str(packages)])
    with pytest.raises(PluginError, match='"own": no installed package adds it'):
        make_controller(profile.controlled_rig())
    with pytest.raises(PluginError, match="no installed package"):
        profile.loop_model()


def test_two_controllers_of_one_section_are_named(packages, tmp_path, monkeypatch):
    load_profile(write_rig(tmp_path, "own"))
    code = (
        "from dataclasses import dataclass\nfrom rigd.devices.declaration import DeviceKind\n"
        "@dataclass(frozen=True)\nclass S:\n    a_s: float = 1.0\n"
        "D = DeviceKind('own', 'twin', open_drive=print, settings=S)"
    )
    install(tmp_path / "b", "t-dev", "1", code, "[rigd.devices]\nown = t_dev:D\n")
    monkeypatch.syspath_prepend(tmp_path / "b")
    with pytest.raises(PluginError, match="section of another package's part; rename the device"):
        check_plugin(find_plugin("rigd.devices", "own"))


@pytest.mark.parametrize(
    ("matrices", "message"),
    [
        ({"a": []}, "0 rows"),
        ({"b": [[1.0, 2.0]]}, r"b must have the shape \(1, 3\)"),
        ({"c": [1.0, 2.0]}, "c must have 1 numbers"),
        ({"d": [1.0]}, "d must have 3 numbers"),
        ({"anti_windup": [1.0, 2.0]}, "anti_windup must have 1"),
        ({"a": [[float("inf")]]}, "a has a number that is not finite"),
        ({"d": [0.0, float("nan"), 0.0]}, "d has a number that is not finite"),
    ],
)
def test_inconsistent_matrices_are_refused(matrices, message):
    good = {"a": [[0.5]], "b": [[1.0, -1.0, 0.0]], "c": [1.0], "d": [0.0, 0.0, 1.0]}
    assert LinearController(**{key: np.array(value) for key, value in good.items()}).order == 1
    with pytest.raises(ValueError, match=message):
        LinearController(**good | matrices)
