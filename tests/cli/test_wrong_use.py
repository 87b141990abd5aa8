"""Errors of an operator: one or two sentences, an exit code, no damage."""

import contextlib
import errno
import os
import re
import subprocess
import sys

import pytest
from cases import further
from typer.testing import CliRunner

PROFILE_CHANGES = {
    "missing key": ("viscous_nm_s_per_rad = ", "# viscous_nm_s_per_rad = ", "viscous_nm_s_per_rad"),
    "unknown key": ("rate_hz =", "colour = { value = 1.0, source = 'paper' }\nrate_hz =", "colour"),
    "wrong unit": ("inertia_kg_m2 = ", "inertia_g_cm2 = ", "inertia_g_cm2"),
    "out of range": ("value = 2.0e-3, source", "value = -2.0e-3, source", "inertia_kg_m2"),
    "not a number": ("value = 0.98", "value = nan", "length_m"),
    "a word": ("value = 0.98", "value = 'long'", "length_m"),
    "millimetres": ("value = 0.98", "value = 980", "length_m"),
    "grams": ("{ value = 4.7e-3", "{ value = 4.7", "density_kg_per_m"),
    "coarse encoder": ("value = 7.0e-5", "value = 7.0", "resolution_rad"),
    "absurd damping": ("zeta = { value = 7.1e-5", "zeta = { value = 7.1", "zeta"),
    "no source": ("{ value = 0.98, source = \"paper\" }", "0.98", "length_m"),
    "unstable beam": ("zeta = { value = 7.1e-5", "zeta = { value = -7.1e-5", "zeta"),
    "unstable loop": (
        "feedforward_gain = { value = 1.0",
        "feedforward_gain = { value = 0.0",
        "feedforward_gain",
    ),
    "no such drive": ('drive = "sim"', 'drive = "steam"', "steam"),
    "not TOML": ("[rig]", "[rig", "TOML"),
}  # fmt: skip


def assert_refused(done, code, *words):
    text = done.stdout + done.stderr
    assert done.returncode == code, text
    assert "Traceback" not in text
    for word in words:
        assert word in text
    assert len(text) < 1500


UNMARKED = ("missing key", "millimetres", "no source", "unstable loop", "not TOML")
"""Cases that `make test` has; tests/profile has the others without the command."""


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(change, id=name) if name in UNMARKED else further(change, id=name)
        for name, change in PROFILE_CHANGES.items()
    ],
)
def test_a_bad_profile_is_refused(rigd_here, tmp_path, change):
    from rigd.profile import load_profile

    old, new, word = change
    text = load_profile("sim").text
    assert old in text
    (tmp_path / "bad.toml").write_text(text.replace(old, new, 1))
    done = rigd_here("run", "chirp", "--fast", "--profile", "bad.toml")
    assert_refused(done, 2, word)
    assert not (tmp_path / "sessions").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--amplitude", "nan"), ("amplitude",)),
        further(("--amplitude", "inf"), ("amplitude",)),
        further(("--amplitude", "0"), ("amplitude",)),
        (("--amplitude", "much"), ("--amplitude",)),
        further(("--duration", "-1"), ("duration",)),
        further(("--duration", "1e9"), ("s",)),
        (("--stop-hz", "1e4"), ("stop_hz", "Hz")),
        further(("--start-hz", "nan"), ("start_hz",)),
        further(("--rest", "-1"), ("rest",)),
        (("--repeat", "0"), ("--repeat",)),
        further(("--seed", "-1"), ("--seed",)),
        (("--profile", "nowhere"), ("nowhere", "sim")),
        (("--profile", ""), ("No profile is named; known profiles are",)),
        (("--no-such-option",), ("--no-such-option",)),
        (("--output", "taken"), ("taken",)),
        (("--note", "two\nlines"), ("--note",)),
        (("--obstacle", "x=0.5"), ("Obstacle 'x=0.5'", "'angle' is missing")),
        further(("--obstacle", "x=1.5,angle=1"), ("beyond the tip", "0.98 m")),
    ],
)
def test_invalid_option_is_refused(rigd_here, tmp_path, arguments, words):
    (tmp_path / "taken").write_text("a file")
    assert_refused(rigd_here("run", "chirp", "--fast", *arguments), 2, *words)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["taken"]


@pytest.mark.parametrize("percent", ["11", further("-1"), further("nan")])
def test_invalid_uniformity_of_a_search_is_refused(rigd_here, tmp_path, percent):
    done = rigd_here("run", "until", "--fast", "--zeta", "5%", "--uniformity", percent)
    assert_refused(done, 2, f"uniformity_percent = {percent} % must lie between 0 and 10 %")
    assert not list(tmp_path.glob("sessions/*"))


@pytest.mark.parametrize(
    ("options", "how_to_simulate"),
    [
        (("--fast",), " --lock-step in another terminal"),
        (("--seed", "1"), " in another terminal"),
        further(("--obstacle", "x=0.5,angle=1"), " in another terminal"),
    ],
)
def test_options_of_simulated_rigs_are_refused_on_hardware(
    rigd_here, tmp_path, write_profile, options, how_to_simulate
):
    """The message does not advise to omit the option, after which the motor would move."""
    # The name is unique: a simulated antenna_can of another test would be mentioned instead.
    profile = write_profile("antenna_can", {"name": f'"wrong_use_{os.getpid()}"'})
    done = rigd_here("run", "chirp", "--profile", profile, *options)
    remedy = f"rigd simulate --profile {profile}{how_to_simulate}"
    assert_refused(done, 2, options[0], "profile of hardware", "would move the motor", remedy)
    assert "omit" not in done.stderr
    assert not (tmp_path / "sessions").exists()


def test_excessive_torque_is_refused_before_motion(rigd_here, tmp_path):
    done = rigd_here("run", "chirp", "--fast", "--amplitude", "0.25")
    assert_refused(done, 2, "torque", "0.9 N·m", "peak_torque_nm")
    assert not (tmp_path / "sessions").exists()


def test_limits_cannot_be_forced(rigd_here, tmp_path):
    done = rigd_here("run", "chirp", "--fast", "--force", "--amplitude", "3", "--stop-hz", "1")
    assert_refused(done, 2, "angle", "limits.angle_rad")
    assert not (tmp_path / "sessions").exists()


@pytest.mark.parametrize(
    "content", [None, b"", b"time,angle\n", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" * 2]
)
def test_info_on_other_files(rigd_here, tmp_path, content):
    path = tmp_path / "broken.mcap"
    if content is not None:
        path.write_bytes(content)
    assert_refused(rigd_here("info", path), 1, "broken.mcap")
    if content is not None:
        assert path.read_bytes() == content


def test_error_in_a_reference_file_names_its_line(rigd_here, tmp_path):
    (tmp_path / "reference.csv").write_text("time_s,angle_rad\n0,0\n1,0,1\n")
    assert_refused(rigd_here("run", "file", "reference.csv", "--fast"), 2, "line 3 has 3 cells")


REFUSING = """
import sys
from rigd.cli.entry import run_command

def refuse():
    number, *texts = sys.argv[1:]
    raise OSError(int(number), *texts)

run_command(refuse)
"""


@pytest.mark.process
@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.EMFILE, "Too many open files", "x.py"), ("ulimit -n", "Too many open")),
        (OSError(errno.ENFILE, "Too many open files in system"), ("close other programs",)),
        (OSError(errno.EACCES, "Permission denied", "/x"), ("/x: Permission denied.",)),
        (OSError(errno.ENOSPC, "No space left on device"), ("the output cannot be written (No",)),
    ],
)
def test_errors_of_the_system_are_explained(error, words):
    done = subprocess.run(
        [sys.executable, "-c", REFUSING, *map(str, error.args), *filter(None, [error.filename])],
        capture_output=True,
        text=True,
        check=False,
    )
    assert_refused(done, 1, *words)
    assert ("output" in done.stderr) == (error.errno == errno.ENOSPC)


def test_version_of_both_commands(rigd_here):
    import rigd
    from analysis.cli.app import app

    assert rigd_here("--version").stdout == f"rigd {rigd.__version__}\n"
    assert CliRunner().invoke(app, ["--version"]).stdout == f"analyze {rigd.__version__}\n"


def test_predicted_peaks_of_a_tiny_motion_are_numbers(rigd_here, monkeypatch):
    from rigd.runtime import StopRequest

    stop = StopRequest()
    stop.requested = True  # the plan is printed, and nothing is run
    monkeypatch.setattr(
        "rigd.cli.run.start_processes", lambda **_: (stop, contextlib.nullcontext())
    )
    options = ("--amplitude", "1e-6", "--stop-hz", "1", "--duration", "5", "--ring-down", "0")
    printed = rigd_here("run", "chirp", "--fast", *options).stdout
    angle, speed, torque = map(
        float, re.findall(r"(?:angle|speed|torque) (\S+) \S+ \(limit", printed)
    )
    assert 0.9e-6 < angle < 1.1e-6
    assert 1e-6 < speed < 1e-5
    assert torque > 0.0
    printed = rigd_here("run", "chirp", "--fast", *options, "--there-and-back").stdout
    assert "and back, 5 s each way, record of 11 s" in printed
