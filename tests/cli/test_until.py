"""`rigd run until`, from the command line to the session file and its result by `analyze`."""

import json
import os
import re
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cases import further
from processes import child_running

from analysis.record import load_record
from analysis.results import whole_record
from rigd.beam.tip import SMALL_TIP_SLOPE_RAD, tip_motion
from rigd.engine.workers import FIT
from rigd.profile import load_profile
from rigd.session import read_session

pytestmark = pytest.mark.process

RIGD = Path(sys.executable).parent / "rigd"
TARGET = 0.1
SEEDED = ("--fast", "--seed", "1")
LONG = ("run", "until", "--damping", "0.05%", "--at-most", "600", "--json", "--no-look", *SEEDED)
ROW = re.compile(r" *\d+\.\d s 0\.")
"""Row of the table of targets."""


@pytest.fixture(scope="module")
def fitted_session(made_once, write_profile_in):
    """A session until the damping was known to 10 %: exit code, errors, result.

    Its sensor is quieter than the shipped one, so that the first fit of all damping structures is
    enough. The working folder has files with names of modules.
    """

    def make(folder):
        profile = write_profile_in(folder, "sim", {"simulation.torque_noise_nm": "1.0e-3"})
        for name in ("analysis", "random", "rigd"):
            (folder / f"{name}.py").write_text("raise SystemExit('of the operator')")
        command = [RIGD, "run", "until", "--damping", f"{100 * TARGET}%", "--at-most", "60"]
        command += ["--fast", "--seed", "1", "--json", "--no-look", "--output", folder]
        command += ["--profile", profile]
        completed = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=400, cwd=folder
        )
        (folder / "told.json").write_text(
            json.dumps([completed.returncode, completed.stdout, completed.stderr])
        )

    code, output, errors = json.loads((made_once("until", make) / "told.json").read_text())
    assert output, errors
    (session,) = json.loads(output)["sessions"]
    return code, errors, session


@pytest.fixture(scope="module")
def record(fitted_session):
    return read_session(fitted_session[2]["path"])


@pytest.fixture(scope="module")
def search(run_patched):
    """Search until the damping is known to 1 %, by an estimator that knows the beam.

    The function takes the estimator's class and returns exit code, errors, result.
    """

    def search(estimator):
        command = ["until", "--damping", "1%", "--at-most", "20", "--json", "--no-look", *SEEDED]
        patches = {"rigd.engine.workers.ONLINE_ESTIMATOR": f"known_beam:{estimator}"}
        code, output, errors = run_patched(f"until-{estimator}", command, patches, FIT)
        assert output, errors
        (session,) = json.loads(output)["sessions"]
        return code, errors, session

    return search


@pytest.fixture(scope="module")
def search_result(search):
    return search("KnownBeamEstimator")


@pytest.fixture(scope="module")
def search_record(search_result):
    return read_session(search_result[2]["path"])


def test_search_ends_at_its_target(search_result, search_record):
    code, errors, session = search_result
    assert code == 0, errors
    assert (session["outcome"], session["reason"], session["lost"]) == ("complete", "", 0)
    assert session["scheduled"] == session["recorded"] + session["missed"] <= 20_000
    fit = session["fit"]
    assert fit["search"]["reached"]
    assert fit["search"]["asked"] == ["damping to 1 %"]
    assert json.loads(search_record.outcome["fit"]) == fit
    assert "Reached: damping of mode 1" in errors
    assert errors.count("± one standard deviation") == 1
    decided_s = [float(row.split()[0]) for row in errors.splitlines() if ROW.match(row)]
    assert decided_s[0] == 6.0
    assert decided_s == sorted(set(decided_s))  # by one estimate of each part of the record


@pytest.mark.further  # as above with an estimator, and tests/analysis/test_online.py
def test_search_with_fits_ends_at_its_target(fitted_session):
    code, errors, session = fitted_session
    assert code == 0, errors
    assert (session["outcome"], session["reason"]) == ("complete", "")
    assert session["scheduled"] == session["recorded"] + session["missed"] <= 60_000
    assert session["lost"] == 0
    fit = session["fit"]
    assert fit["search"]["reached"]
    assert fit["search"]["asked"] == ["damping to 10 %"]
    assert len(fit["modes"]) == 3
    for mode in fit["modes"]:
        damping = mode["damping_ratio"]
        assert damping["flag"] is None
        assert damping["std"] <= TARGET * damping["value"]
    assert "Reached: damping of mode 1" in errors
    assert errors.count("± one standard deviation") == 1
    decided_s = [float(row.split()[0]) for row in errors.splitlines() if ROW.match(row)]
    assert decided_s == sorted(set(decided_s))  # by one estimate of each part of the record


@pytest.mark.further
def test_analyze_agrees_with_the_last_fit_of_the_session(fitted_session, record):
    headline = whole_record(load_record(record.path)).headline
    fit = fitted_session[2]["fit"]
    assert json.loads(record.outcome["fit"]) == fit
    for mode, live in zip(headline.modes, fit["modes"], strict=True):
        for quantity in ("frequency_hz", "damping_ratio"):
            assert getattr(mode, quantity).as_json() == live[quantity]
    for name, quantity in headline.parameters.items():
        assert quantity.as_json() == fit["parameters"][name]


@pytest.mark.further
def test_estimates_agree_with_the_simulated_beam(fitted_session):
    from rigd.beam import modes

    rig = load_profile("sim").rig
    for mode, true in zip(
        fitted_session[2]["fit"]["modes"], modes(rig.beam, rig.damping, 3), strict=True
    ):
        for key, value in (
            ("frequency_hz", true.frequency_hz),
            ("damping_ratio", true.damping_ratio),
        ):
            assert abs(mode[key]["value"] - value) < 4 * mode[key]["std"]


def test_segments_name_the_planned_parts(search_result, search_record):
    segments = dict(search_record.segments)
    ticks = search_result[2]["scheduled"]
    assert segments.pop("rest") == (0, 1000)
    assert segments.pop("sweep") == (1000, ticks)
    assert segments.pop("scan") == (1000, 6000)
    planned_segments = search_result[2]["fit"]["search"]["pieces"]
    assert planned_segments
    assert list(segments) == [f"piece_{number + 1}" for number in range(len(planned_segments))]
    ends = [6000]
    for (first, end), planned_segment in zip(segments.values(), planned_segments, strict=True):
        assert ends[-1] <= first < end <= ticks
        assert end - first == round(1000 * planned_segment["duration_s"])
        ends.append(end)


def test_info_lists_the_modes_of_the_file(rigd_here, search_record):
    printed = rigd_here("info", search_record.path).stdout
    assert printed.count("\nfit ") == 3
    assert "mode 1: 2.5" in printed
    assert "covariance" not in printed


def test_segments_join_at_rest(search_record):
    """At the joints: no step in angle, speed or acceleration except those of the segments."""
    record = search_record
    reference_rad = record.samples["angle_reference_rad"]
    relative_rad = reference_rad - reference_rad[0]
    speed = np.gradient(relative_rad, 1e-3)
    acceleration = np.gradient(speed, 1e-3)
    joints = [tick for name, ends in record.segments.items() if name != "sweep" for tick in ends]
    for tick in joints:
        near = slice(max(tick - 2, 0), tick + 3)
        assert np.abs(relative_rad[near]).max(initial=0.0) < 2e-6
        assert np.abs(speed[near]).max(initial=0.0) < 2e-3
        assert np.abs(acceleration[near]).max(initial=0.0) < 0.02 * np.abs(acceleration).max()


def test_free_end_has_small_slopes(search_record):
    profile = load_profile("sim")
    angle_rad = search_record.samples["angle_rad"]
    slope_rad = tip_motion(profile.plant, angle_rad, profile.rig.rate_hz).slope_rad
    assert 0.5 * SMALL_TIP_SLOPE_RAD < slope_rad < SMALL_TIP_SLOPE_RAD


@pytest.mark.further  # as tests/runner, without processes
def test_unreached_target_is_reported(rigd, tmp_path):
    options = ("--damping", "0.01%", "--at-most", "8", *SEEDED, "--json", "--no-look")
    run = rigd("run", "until", *options)
    assert run.returncode == 1, run.stderr
    (session,) = json.loads(run.stdout)["sessions"]
    assert session["outcome"] == "complete"
    assert session["reason"].startswith("Not reached within 8 s (--at-most). So far: damping of mo")
    assert not session["fit"]["search"]["reached"]
    assert 7000 <= session["recorded"] <= 8000
    assert read_session(tmp_path / session["path"]).outcome["reason"] == session["reason"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), ("No precision is requested", "--damping 1%")),
        (("--damping", "much"), ("--damping much", "1% or 2:0.5%")),
        (("--damping", "-1%"), ("more than 0",)),
        (("--zeta", "2:1%"), ("not a quantity of a mode",)),
        (("--damping", "1%", "--at-most", "3"), ("at_most_s = 3 s", "6.5 s")),
        (("--damping", "1%", "--scan", "0.2"), ("scan_s = 0.2 s", "fades")),
        (("--damping", "1%", "--tip-slope", "0"), ("tip_slope_rad",)),
    ],
)
def test_invalid_options_are_refused(rigd_here, options, words):
    completed = rigd_here("run", "until", "--fast", *options)
    assert completed.returncode == 2, completed.stdout + completed.stderr
    for word in words:
        assert word in completed.stdout + completed.stderr


def test_lost_planner_leaves_the_record(search):
    code, errors, session = search("KilledEstimator")
    assert code == 1, errors
    assert "Traceback" not in errors
    assert session["outcome"] == "complete"
    assert "The fit process was killed" in session["reason"]
    assert session["scheduled"] == session["recorded"] + session["missed"]
    # Nothing was cut short: no more was planned.
    _, end = read_session(session["path"]).segments["sweep"]
    assert end == session["scheduled"]


@pytest.mark.parametrize(
    "number", [further(signal.SIGKILL), pytest.param(signal.SIGSTOP, marks=pytest.mark.slow)]
)
def test_lost_planner_ends_the_session_with_its_record(start_rigd, tmp_path, number):
    process = start_rigd(*LONG)
    for line in process.stderr:
        if ROW.match(line):
            break
    planner = child_running(process.pid, "rigd.runner.fit_process")
    os.kill(planner, number)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 1, errors
    assert "Traceback" not in errors
    (session,) = json.loads(output)["sessions"]
    assert session["outcome"] == "complete"
    assert "The fit process was killed" in session["reason"]
    assert session["scheduled"] == session["recorded"] + session["missed"]
    # Nothing was cut short: no more was planned.
    _, end = read_session(tmp_path / session["path"]).segments["sweep"]
    assert end == session["scheduled"]


@pytest.mark.further  # as for other sessions in test_run.py
def test_stop_ends_a_search_at_once(start_rigd):
    process = start_rigd(*LONG)
    for line in process.stderr:
        if ROW.match(line):
            break
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 130, errors
    (session,) = json.loads(output)["sessions"]
    assert session["outcome"] == "stopped"
    assert session["reason"] == "Stopped by the operator."
    assert session["fit"]["modes"]
    assert not session["fit"]["search"]["reached"]


@pytest.mark.further  # as other sessions do
def test_counts_of_a_search_in_real_time(rigd, patient, tmp_path):
    """If the computer stalls for long there are gaps, and no fit is possible."""
    options = ("--damping", "10%", "--at-most", "20", "--json", "--no-look", "--profile", patient)
    run = rigd("run", "until", *options)
    assert run.returncode in (0, 1), run.stderr
    assert "Traceback" not in run.stderr
    (session,) = json.loads(run.stdout)["sessions"]
    assert session["outcome"] == "complete"
    assert session["lost"] == 0
    assert session["scheduled"] == session["recorded"] + session["missed"] <= 20_000
    assert (session["fit"]["search"]["reached"] is True) == (run.returncode == 0)
    assert len(read_session(tmp_path / session["path"]).samples) == session["recorded"]


@pytest.mark.further  # as tests/daemon/test_fits.py and test_online.py
def test_chirp_is_fitted_while_it_runs(rigd, tmp_path):
    lengths = ("--duration", "8", "--ring-down", "1", "--start-hz", "0.5", "--seed", "1")
    run = rigd("run", "chirp", "--fast", "--json", "--no-look", "--watch-fit", *lengths)
    assert run.returncode == 0, run.stderr
    (session,) = json.loads(run.stdout)["sessions"]
    assert "mode 1: 2.5" in run.stderr
    assert "search" not in session["fit"]
    headline = whole_record(load_record(tmp_path / session["path"])).headline
    assert headline.modes[0].damping_ratio.as_json() == session["fit"]["modes"][0]["damping_ratio"]


@pytest.mark.further  # as for other sessions in tests/recovery/test_recovery_disk.py
def test_full_disk_ends_a_search_with_its_reason(start_rigd, tmp_path):
    process = start_rigd(*LONG)
    for line in process.stderr:
        if ROW.match(line):
            break
    # The file is already larger: the next write fails, as on a full disk.
    recorder = child_running(process.pid, "rigd.engine.recorder")
    resource.prlimit(recorder, resource.RLIMIT_FSIZE, (20_000, 20_000))
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 1, errors
    assert "Traceback" not in errors
    (session,) = json.loads(output)["sessions"]
    assert session["outcome"] != "complete"
    assert "cannot be written" in session["reason"]
    assert list(tmp_path.glob("sessions/*.mcap*"))


@pytest.mark.slow
def test_limit_violation_ends_a_search(rigd, tmp_path):
    """From 7 s on the beam is within a wall, which throws it."""
    wall = "x=0.9,angle=-1,side=1,from=7"
    options = ("--damping", "0.01%", "--at-most", "30", *SEEDED, "--json", "--no-look")
    run = rigd("run", "until", *options, "--obstacle", wall)
    assert run.returncode == 1, run.stderr
    assert "Traceback" not in run.stderr
    (session,) = json.loads(run.stdout)["sessions"]
    assert session["outcome"] == "fault"
    assert session["reason"]
    assert not session["fit"]["search"]["reached"]
    record = read_session(tmp_path / session["path"])
    assert record.outcome["reason"] == session["reason"]
    assert record.samples["torque_command_nm"][-1] == 0
