"""``rigd profiles``: a new profile from a drive's EDS loads and lists what to fill in."""

import json
import re
import shutil
from math import isnan

import pytest
from cases import further
from eds_files import WITH_TORQUE, WITHOUT_TORQUE, eds_path, eds_text, without
from typer.testing import CliRunner

from rigd.cli.app import app
from rigd.devices import MAY_BE_UNKNOWN
from rigd.profile import load_profile
from rigd.profile._from_eds import QUESTIONS

QUESTION_KEYS = {question.profile_key for question in QUESTIONS}


@pytest.fixture
def new_profile(rigd_here):
    def new_profile(eds, *more, output="my_rig.toml"):
        return rigd_here("profiles", "new", "--eds", eds, "--output", output, *more)

    return new_profile


@pytest.fixture
def profile_from_answers(tmp_path, monkeypatch):
    """Make a profile at a terminal with some answers and then the end of input."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("rigd.cli.profiles.is_terminal", lambda: True)

    def profile_from_answers(eds, *answers):
        arguments = ["profiles", "new", "--eds", str(eds), "--output", "my_rig.toml"]
        lines = "".join(f"{answer}\n" for answer in answers)
        return CliRunner().invoke(app, arguments, input=lines)

    return profile_from_answers


@pytest.mark.parametrize("start_from", ["antenna_can", further("antenna_serial")])
@pytest.mark.parametrize("name", [WITH_TORQUE[0], *map(further, WITH_TORQUE[1:])])
def test_new_profile_has_the_values_of_the_file(new_profile, tmp_path, name, start_from):
    done = new_profile(eds_path(name), "--from", start_from)
    assert done.returncode == 0, done.stderr
    assert "my_rig.toml: written." in done.stdout
    profile = load_profile(tmp_path / "my_rig.toml")
    settings = profile.rig.cia402
    assert profile.name == "my_rig"
    assert settings.eds == str(eds_path(name)) or settings.eds.endswith(f"{name}.eds")
    vendor = {"elmo_gold": 0x9A, "e35": 0xFF}.get(name, 0xFB)
    assert settings.vendor_id == vendor
    assert profile.sources["cia402.vendor_id"] == "datasheet"
    assert settings.accept_without == ()


@pytest.mark.parametrize("name", [WITH_TORQUE[0], *map(further, WITH_TORQUE[1:])])
def test_check_of_a_new_profile(new_profile, rigd_here, monkeypatch, name):
    monkeypatch.setattr("rigd.cli.check.signal.signal", lambda *_: None)
    monkeypatch.setattr("rigd.checks._check.inspect_devices", lambda _: [])
    new_profile(eds_path(name))
    done = rigd_here("check", "--profile", "my_rig.toml", "--json")
    assert done.returncode == 1, done.stdout
    assert done.stderr == ""
    rows = [row for row in json.loads(done.stdout)["rows"] if row["verdict"] == "failed"]
    assert [row["what"] for row in rows if row["name"] == "unknown_values"] == [
        key for key in MAY_BE_UNKNOWN if key in QUESTION_KEYS
    ]
    # Missing features of a drive are not accepted by default.
    lacks = {"e35": "watchdog", "epos4_0110": "torque_limit", "epos4_0170": "torque_limit"}
    others = [row for row in rows if row["name"] != "unknown_values"]
    assert {row["name"] for row in others} == ({"eds"} if name in lacks else set())
    assert lacks.get(name, "") in " ".join(row["detail"] for row in others)


def test_values_missing_in_the_file_are_marked_and_listed(new_profile, tmp_path):
    done = new_profile(eds_path("epos4_0170"))
    text = (tmp_path / "my_rig.toml").read_text()
    profile = load_profile(tmp_path / "my_rig.toml")
    for question in QUESTIONS:
        unknown = question.profile_key in MAY_BE_UNKNOWN
        assert f"  {question.profile_key} = {'unknown' if unknown else ''}" in done.stderr
        source = "unknown" if unknown else "assumed"
        assert profile.sources.get(question.profile_key, "assumed") == source
        name = question.profile_key.rpartition(".")[2]
        assert not unknown or f'\n{name} = {{ source = "unknown" }}\n' in text
        assert re.search(rf"^# TO FILL IN: [^\n]*\n(# [^\n]*\n)*{name} = ", text, re.MULTILINE)
    shown = r'^# TO FILL IN: according[^\n]*\n(# [^\n]*\n)+# accept_without = \["torque_limit"\]$'
    assert re.search(shown, text, re.MULTILINE)
    assert "cia402.accept_without: torque_limit: what the drive lacks" in done.stderr
    assert "It has no object 6072 (Max torque)" in done.stderr
    assert "3001:2 (Output current limit, 15000)" in text.replace("\n# ", " ")
    assert "rigd check reads it from the drive" in done.stderr
    # The comments of the base profile are still there.
    assert "The measured coupling torque cancels the beam's reaction" in text
    assert "Written by rigd profiles new from epos4_0170.eds" in text


def test_missing_watchdog_is_not_accepted_by_default(new_profile, tmp_path):
    done = new_profile(eds_path("e35"))
    settings = load_profile(tmp_path / "my_rig.toml").rig.cia402
    assert settings.accept_without == ()
    assert settings.own_watchdog_s == 0.0
    assert "cia402.own_watchdog_s" in done.stderr
    assert "cia402.accept_without: watchdog" in done.stderr


def test_missing_objects_disable_their_functions(new_profile, tmp_path):
    path = tmp_path / "drive.eds"
    path.write_text(eds_text(without("6080", "6076", "6077"), "BaudRate_500=1\nBaudRate_800=1"))
    done = new_profile(path)
    assert done.returncode == 0, done.stderr
    profile = load_profile(tmp_path / "my_rig.toml")
    settings = profile.rig.cia402
    assert settings.max_speed_rad_s == 0.0
    assert settings.rated_torque_unit_nm == 0.0
    assert settings.torque_tolerance_percent == 0.0
    assert settings.accept_without == ()
    assert '# accept_without = ["torque_feedback"]' in profile.text
    assert profile.rig.can.bitrate_bit_s == 800_000
    assert "rated_torque_unit_nm" not in done.stderr
    assert 'eds = "drive.eds"' in profile.text


def test_node_id_from_a_dcf(new_profile, tmp_path):
    path = tmp_path / "drive.dcf"
    path.write_text(eds_path("elmo_gold").read_text() + "\n[DeviceComissioning]\nNodeID=0x11\n")
    new_profile(path)
    profile = load_profile(tmp_path / "my_rig.toml")
    assert profile.rig.cia402.node_id == 17
    assert profile.sources["cia402.node_id"] == "datasheet"


def test_names_with_special_characters(new_profile, tmp_path):
    """A vendor's name can neither end a text nor begin a key of the profile."""
    path = tmp_path / 'a "drive".eds'
    device = 'VendorName=A "b" \\ = [x] # ü\x1b[31m\u2028y\nProductName=\'\'\'"""'
    path.write_text(eds_text(without("6072"), device), encoding="utf-8")
    done = new_profile(path)
    assert done.returncode == 0, done.stderr
    assert "\x1b" not in done.stderr + (tmp_path / "my_rig.toml").read_text()
    profile = load_profile(tmp_path / "my_rig.toml")
    assert 'A "b" \\ = [x] # ü' in profile.description


@pytest.mark.parametrize("name", WITHOUT_TORQUE)
def test_no_profile_for_an_unusable_drive(new_profile, tmp_path, name):
    done = new_profile(eds_path(name))
    assert done.returncode == 1
    assert "object 6502 = 0x" in done.stderr
    assert "no profile was written" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_no_file_is_overwritten(new_profile, tmp_path):
    (tmp_path / "my_rig.toml").write_text("mine")
    done = new_profile(eds_path("elmo_gold"))
    assert done.returncode == 2
    assert "my_rig.toml: exists and is not overwritten" in done.stderr
    assert (tmp_path / "my_rig.toml").read_text() == "mine"
    (tmp_path / "link.toml").symlink_to("nowhere.toml")
    assert new_profile(eds_path("elmo_gold"), output="link.toml").returncode == 2
    assert not (tmp_path / "nowhere.toml").exists()


@pytest.mark.parametrize(
    ("eds", "more", "output", "code", "words"),
    [
        ("nowhere.eds", (), "a.toml", 1, "nowhere.eds: cannot be read"),
        (".", (), "a.toml", 1, "is a folder"),
        (None, (), "a.txt", 2, "ends in .toml"),
        (None, (), "nowhere/a.toml", 2, "there is no folder nowhere"),
        (None, (), "what?.toml", 2, 'name = "what?" cannot be used in file names'),
        (None, ("--from", "sim"), "a.toml", 2, "has no CiA 402 drive"),
        (None, ("--from", "none"), "a.toml", 2, "There is no profile 'none'"),
    ],
)
def test_wrong_use(new_profile, tmp_path, eds, more, output, code, words):
    done = new_profile(eds or eds_path("elmo_gold"), *more, output=output)
    assert done.returncode == code
    assert words in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_questions_at_a_terminal(profile_from_answers, tmp_path):
    answers = ("can1", "300", "five", "5", "", "1e-6", "0.6", "1.2", "nan", "0.5", "", "", "")
    done = profile_from_answers(eds_path("epos4_0170"), *answers)
    assert done.exit_code == 0, done.stderr
    profile = load_profile(tmp_path / "my_rig.toml")
    assert profile.rig.can.channel == "can1"
    assert profile.rig.cia402.node_id == 5
    assert isnan(profile.rig.cia402.gear_ratio)
    assert profile.rig.cia402.rated_torque_unit_nm == 1e-6
    assert profile.rig.motor.rated_torque_nm == 0.6
    assert profile.rig.motor.peak_torque_nm == 1.2
    assert profile.rig.motor.continuous_torque_nm == 0.5
    assert profile.sources["motor.peak_torque_nm"] == "datasheet"
    assert profile.sources["cia402.gear_ratio"] == "unknown"
    assert "less than or equal to 127" in done.stderr
    assert "To fill in" in done.stderr
    assert "  cia402.gear_ratio = unknown" in done.stderr
    assert "  cia402.node_id" not in done.stderr


@pytest.mark.parametrize(
    ("lacking", "answers", "accepted", "remaining"),
    [
        further(("6072", "6077"), ("y", "yes"), ("torque_limit", "torque_feedback"), ""),
        (("6072", "6077"), ("", "y"), ("torque_feedback",), "torque_limit"),
        further(("6072", "6077"), ("n", "n"), (), "torque_limit, torque_feedback"),
        # Without a watchdog nothing acts on a silent computer, whatever 6007 is.
        (("1016:1", "6007"), ("y",), ("watchdog",), ""),
        further(("1016:1", "6007"), ("n",), (), "watchdog"),
    ],
)
def test_missing_features_are_accepted_only_by_yes(
    profile_from_answers, tmp_path, lacking, answers, accepted, remaining
):
    path = tmp_path / "drive.eds"
    path.write_text(eds_text(without(*lacking)))
    questions = len(QUESTIONS) + ("1016:1" in lacking)
    done = profile_from_answers(path, *[""] * questions, *answers)
    assert done.exit_code == 0, done.stderr
    profile = load_profile(tmp_path / "my_rig.toml")
    assert profile.rig.cia402.accept_without == accepted
    assert ("cia402.accept_without: " in done.stderr) == bool(remaining)
    assert f"cia402.accept_without: {remaining}" in done.stderr or not remaining
    if accepted and remaining:
        assert f"so that rigd refuses it: {remaining}" in profile.text.replace("\n# ", " ")


def test_accepted_missing_features_of_another_drive_are_not_copied(new_profile, tmp_path):
    new_profile(eds_path("epos4_0170"), output="first.toml")
    text = (tmp_path / "first.toml").read_text()
    line = 'accept_without = ["torque_limit"]'
    (tmp_path / "first.toml").write_text(text.replace(f"# {line}", line))
    assert load_profile(tmp_path / "first.toml").rig.cia402.accept_without == ("torque_limit",)
    for name in ("epos4_0110", "elmo_gold"):
        done = new_profile(eds_path(name), "--from", "first.toml", output=f"{name}.toml")
        assert done.returncode == 0, done.stderr
        assert load_profile(tmp_path / f"{name}.toml").rig.cia402.accept_without == ()


def test_contradictory_answers_are_requested_again(profile_from_answers, tmp_path):
    first = ("", "", "", "", "2.0", "", "", "", "")
    second = ("", "", "", "", "", "4.0", "", "", "")
    done = profile_from_answers(eds_path("elmo_gold"), *first, *second)
    assert done.exit_code == 0, done.stderr
    assert "motor.peak_torque_nm" in done.stderr
    assert load_profile(tmp_path / "my_rig.toml").rig.motor.rated_torque_nm == 2.0


def test_ctrl_c_at_a_question_leaves_no_file(profile_from_answers, tmp_path):
    done = profile_from_answers(eds_path("elmo_gold"), "can1")
    assert done.exit_code == 130
    assert "no profile was written" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_list_of_profiles(rigd_here, tmp_path):
    folder = tmp_path / "hw_profiles"
    folder.mkdir()
    (folder / "broken.toml").write_text("[")
    done = rigd_here("profiles", "list")
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    for name in ("antenna_can: ", "antenna_serial: ", "sim: ", "broken: cannot be used: "):
        assert any(line.startswith(name) for line in lines), name


@pytest.fixture
def user_folder(tmp_path, monkeypatch):
    """The folder for the user's own profiles, which does not exist yet."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path / "config" / "rigd" / "profiles"


def test_without_a_command_the_profiles_are_listed(rigd_here):
    assert rigd_here("profiles") == rigd_here("profiles", "list")
    assert rigd_here("profiles").stdout.startswith("antenna_can: ")


def test_copy_names_hidden_and_hiding_profiles(rigd_here, user_folder, tmp_path, sim_toml):
    shipped = load_profile("sim").path
    done = rigd_here("profiles", "copy", "sim")
    assert done.returncode == 0, done.stderr
    own = user_folder / "sim.toml"
    assert own.read_text("utf-8") == sim_toml
    assert done.stdout == f"{own}: written. Next: edit it, then rigd check --profile sim\n"
    assert done.stderr == f"Note: it hides {shipped} (shipped).\n"
    done = rigd_here("profiles", "copy", "sim", "--here")
    assert done.stderr.splitlines() == [
        f"Note: it hides {own} (per-user folder).",
        f"Note: it hides {shipped} (shipped).",
    ]
    own.unlink()
    done = rigd_here("profiles", "copy", "sim")
    assert done.stderr.splitlines() == [
        "Note: hw_profiles/sim.toml (working folder) hides it here.",
        f"Note: it hides {shipped} (shipped).",
    ]
    lines = rigd_here("profiles").stdout.splitlines()
    index = next(i for i, line in enumerate(lines) if line.startswith("sim: "))
    assert lines[index].endswith("(hw_profiles/sim.toml, working folder)")
    assert lines[index + 1 :] == [
        f"  hides {own} (per-user folder)",
        f"  hides {shipped} (shipped)",
    ]


def test_copy_under_another_name(rigd_here, user_folder, sim_toml):
    done = rigd_here("profiles", "copy", "sim", "my_rig")
    assert (done.returncode, done.stderr) == (0, "")
    mine = load_profile("my_rig")
    assert mine.path == user_folder / "my_rig.toml"
    assert mine.name == "my_rig"
    assert mine.text == sim_toml.replace('name = "sim"', 'name = "my_rig"')


@pytest.mark.parametrize("options", [(), ("--here",)])
def test_copy_overwrites_no_file(rigd_here, user_folder, tmp_path, options):
    folder = tmp_path / "hw_profiles" if options else user_folder
    folder.mkdir(parents=True)
    (folder / "mine.toml").write_text("something else")
    done = rigd_here("profiles", "copy", "sim", "mine", *options)
    assert done.returncode == 2
    assert "exists and is not overwritten" in done.stderr
    assert (folder / "mine.toml").read_text() == "something else"


@pytest.mark.parametrize("name", ["../mine", "a/b", "/mine", "mine.toml", ".mine", "..", "ö" * 65])
def test_name_of_a_copy_must_be_valid(rigd_here, user_folder, tmp_path, name):
    done = rigd_here("profiles", "copy", "sim", name)
    assert done.returncode == 2
    assert done.stderr.startswith("Error: ")
    assert list(tmp_path.iterdir()) == []


def test_copy_finds_the_eds_file_of_its_drive(rigd_here, user_folder, tmp_path):
    (tmp_path / "rig").mkdir()
    shutil.copy(eds_path("elmo_gold"), tmp_path / "rig" / "drive.eds")
    text = load_profile("antenna_can").text.replace('# eds = "', 'eds = "')
    (tmp_path / "rig" / "first.toml").write_text(text, "utf-8")
    done = rigd_here("profiles", "copy", "rig/first.toml")
    assert done.returncode == 0, done.stderr
    copy = load_profile("first")
    assert copy.path == user_folder / "first.toml"
    assert copy.rig.cia402.eds == str(tmp_path / "rig" / "drive.eds")


def test_no_renamed_copy_of_an_unusual_text(rigd_here, user_folder, tmp_path, sim_toml):
    (tmp_path / "odd.toml").write_text(sim_toml.replace('name = "sim"', '"name" = "sim"'))
    done = rigd_here("profiles", "copy", "odd.toml", "even")
    assert done.returncode == 2
    assert "copy the file and edit it" in done.stderr
    assert not user_folder.exists()


def test_copy_into_the_working_folder_without_a_home(rigd_here, monkeypatch):
    def no_home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CONFIG_HOME")
    monkeypatch.setattr("pathlib.Path.home", no_home)
    done = rigd_here("profiles", "copy", "sim", "mine")
    assert done.returncode == 1
    assert "XDG_CONFIG_HOME" in done.stderr
    assert rigd_here("profiles", "copy", "sim", "mine", "--here").returncode == 0
    assert load_profile("mine").name == "mine"


def test_profile_is_shown_unchanged(rigd_here, sim_toml):
    done = rigd_here("profiles", "show", "sim")
    assert (done.returncode, done.stdout) == (0, sim_toml)
    assert done.stderr == f"{load_profile('sim').path}:\n"
    assert rigd_here("profiles", "show", "simm").returncode == 2


def test_vendor_settings_of_another_drive_are_not_copied(new_profile, tmp_path):
    shipped = load_profile("antenna_can").text
    own = '[cia402]\nset_objects = ["3001:2 u32 2500"]\n'
    own += 'own_watchdog_s = { value = 0.05, source = "datasheet" }\n'
    (tmp_path / "other.toml").write_text(shipped.replace("[cia402]\n", own, 1))
    done = new_profile(eds_path("e35"), "--from", "other.toml")
    assert done.returncode == 0, done.stderr
    settings = load_profile(tmp_path / "my_rig.toml").rig.cia402
    assert (settings.set_objects, settings.own_watchdog_s) == ((), 0.0)
    # The drive has no watchdog, so that one of its own is to be filled in.
    assert "cia402.own_watchdog_s" in done.stderr
    assert "cia402.accept_without: watchdog" in done.stderr
