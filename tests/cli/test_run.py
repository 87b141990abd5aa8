"""`rigd run`, from the command line to the closed file."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import termios
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warm_start
from cases import further
from processes import child_running, eventually, has_ended, ignored, ignores
from resting_beams import pressing_force_n

from analysis import load, select
from analysis.applicability import analysis_remarks, welch_exclusion_reason, welch_settings
from analysis.models import WelchSettings
from analysis.paper import estimate
from analysis.record import record_of
from rigd.beam import modes
from rigd.profile import load_profile
from rigd.runner import ProcessGroup
from rigd.runtime import StopRequest
from rigd.session import read_controls, read_session
from rigd.session.layout import Status

pytestmark = pytest.mark.process

RIGD = Path(sys.executable).parent / "rigd"
SHORT = ("--duration", "2", "--rest", "0.2", "--ring-down", "0.3", "--stop-hz", "10")


def only_session(done):
    assert done.returncode == 0, done.stdout + done.stderr
    (session,) = json.loads(done.stdout)["sessions"]
    return session


def test_reference_chirp_is_complete_and_excites_three_modes(paper_session):
    path, session = paper_session
    assert session["outcome"] == "complete"
    assert session["scheduled"] == session["recorded"] == 136_000
    assert session["missed"] == session["lost"] == session["late"] == 0
    assert session["stale_angles"] == session["stale_wrenches"] == 0
    record = read_session(path)
    assert record.outcome["stale_angles"] == record.outcome["stale_wrenches"] == "0"
    assert record.outcome["outcome"] == "complete"
    assert record.outcome["recorded"] == "136000"
    assert record.segments == {
        "rest": (0, 1000),
        "sweep": (1000, 121_000),
        "ring_down": (121_000, 136_000),
    }
    samples = record.samples
    assert np.array_equal(samples["tick"], np.arange(136_000))
    flagged = Status.TORQUE_SATURATED | Status.WRENCH_SATURATED | Status.LIMIT_WARNING
    assert not (samples["status"] & flagged).any()
    # DESIGN: the reference is the paper's formula, relative to the angle at the start.
    t = np.arange(120_000) / 1000
    chirp = 0.025 * np.sin(2 * np.pi * (0.05 * t + (50 - 0.05) * t**2 / 240))
    reference = samples["angle_reference_rad"] - samples["angle_reference_rad"][0]
    assert np.abs(reference[1000:121_000] - chirp).max() < 1e-12
    controls = read_controls(path)
    assert np.array_equal(controls["tick"], np.arange(0, 136_000, 10))
    terms = ("proportional", "integral", "derivative", "feedforward", "friction")
    torque_nm = sum(controls[f"{term}_nm"] for term in terms)
    assert np.allclose(torque_nm, controls["unlimited_torque_nm"], atol=1e-12)
    assert np.allclose(torque_nm, samples["torque_command_nm"][::10], atol=1e-12)
    assert record.attachments["profile.toml"].decode().startswith("# The simulated rig")
    assert not list(path.parent.glob("*.part"))

    assert np.abs(samples["torque_command_nm"]).max() < 0.9
    spectrum = np.abs(np.fft.rfft(samples["coupling_torque_nm"][1000:121_000]))
    frequency_hz = np.fft.rfftfreq(120_000, 1e-3)
    noise = np.median(spectrum[frequency_hz > 100])
    for mode_hz in (2.57, 16.05, 44.5):
        assert spectrum[np.abs(frequency_hz - mode_hz) < 0.5].max() > 20 * noise


@pytest.mark.parametrize(
    ("arguments", "ticks"),
    [
        further(("hold", "--duration", "1", "--rest", "0.5"), 1500),
        pytest.param(  # also runs in tests/docs/test_readme.py
            ("step", "--duration", "1", "--rest", "0.5", "--ring-down", "0.5"),
            2000,
            marks=pytest.mark.slow,
        ),
        further(
            ("multisine", "--amplitude", "0.01", "--period", "1", "--duration", "2", "--start-hz",
             "1", "--stop-hz", "20", "--rest", "0.5", "--ring-down", "0.5"),
            3000,
        ),
    ],
)  # fmt: skip
def test_every_excitation_runs(rigd, tmp_path, arguments, ticks):
    session = only_session(rigd("run", *arguments, "--fast", "--json"))
    assert session["recorded"] == ticks
    record = read_session(tmp_path / session["path"])
    assert record.metadata["excitation"] == arguments[0]


@pytest.mark.further  # as tests/runner/test_quick_looks.py
def test_each_session_has_a_quick_look(rigd, tmp_path, brief_quick_looks):
    (tmp_path / "analysis").mkdir()
    (tmp_path / "analysis" / "__init__.py").write_text("raise SystemExit('the wrong one')")
    lengths = ("--duration", "1", "--rest", "0.2")
    done = rigd("run", "hold", "--fast", "--json", "--repeat", "2", *lengths)
    assert done.returncode == 0, done.stderr
    for session in json.loads(done.stdout)["sessions"]:
        quick_look = json.loads((tmp_path / session["look"]).read_text())
        assert quick_look["file"] == Path(session["path"]).name
        assert "\n".join(quick_look["text"]) in done.stderr
    session = only_session(rigd("run", "hold", "--fast", "--json", "--no-look", *lengths))
    assert session["look"] is None


def test_ctrl_c_skips_only_the_quick_look(start_rigd, monkeypatch, brief_quick_looks):
    brief_quick_looks.write_text("import time; time.sleep(600)\n")
    monkeypatch.delenv("PYTHONPATH")
    options = ("--fast", "--duration", "1", "--json")
    process = start_rigd("run", "hold", *options, packages=brief_quick_looks.parents[1])
    while "Ctrl-C skips it" not in (line := process.stderr.readline()):
        assert line
    quick_look = child_running(process.pid, "analysis.quick_look")
    to_all(process, signal.SIGINT)
    session = only_session(wait_for_end(process))
    assert session["outcome"] == "complete"
    assert session["look"] is None
    assert has_ended(quick_look)


def wait_for_end(process):
    output, errors = process.communicate(timeout=300)
    return subprocess.CompletedProcess(process.args, process.returncode, output, errors)


@pytest.mark.further  # as tests/excitation and the engine
def test_reference_from_a_file_is_followed(rigd, tmp_path):
    (tmp_path / "reference.csv").write_text(
        "time_s,angle_rad\n" + "".join(f"{t / 100},{0.01 * (t / 100)}\n" for t in range(201))
    )
    session = only_session(rigd("run", "file", "reference.csv", "--fast", "--json"))
    record = read_session(tmp_path / session["path"])
    first, end = record.segments["sweep"]
    sweep = record.samples["angle_reference_rad"][first:end]
    assert np.allclose(np.diff(sweep), 1e-5, atol=1e-9)
    assert abs(record.samples["angle_rad"][end + 2000] - sweep[-1]) < 1e-3


@pytest.mark.fit
@pytest.mark.further  # as identify/test_knock.py, with records of a motor at rest
def test_loud_impact_is_identified_while_the_motor_turns(rigd, tmp_path):
    """In mid-sweep, on the tip: for half of the sweep the beam rings louder than it is driven."""
    rigd(
        *("run", "chirp", "--duration", "20", "--stop-hz", "50", "--seed", "5", "--fast"),
        *("--obstacle", "x=0.98,force=0.5,duration=0.01,at=10", "--no-look"),
        *("--output", str(tmp_path)),
    )
    [path] = tmp_path.glob("*.mcap")
    result = select(load(path))
    assert result.verdict.adequate
    [finding] = result.verdict.findings
    assert finding.kind == "knock"
    assert all(mode.damping_ratio.flag is None for mode in result.headline.modes)
    rig = load_profile("sim").rig
    for mode, true in zip(result.headline.modes, modes(rig.beam, rig.damping, 3), strict=True):
        for quantity, value in (
            (mode.frequency_hz, true.frequency_hz),
            (mode.damping_ratio, true.damping_ratio),
        ):
            assert abs(quantity.value - value) < 4 * quantity.std


@pytest.mark.further  # as test_touch.py
def test_contact_with_an_obstacle_and_its_metadata(rigd, tmp_path):
    options = ("step", "--amplitude", "0.05", "--duration", "1", "--rest", "0.2", "--fast")
    obstacle = "x=0.62,angle=0.02,stiffness=3000"
    sessions = []
    for more in ((), ("--obstacle", obstacle)):
        folder = tmp_path / str(len(more))
        rigd("run", *options, "--output", str(folder), *more)
        [path] = folder.glob("*.mcap")
        sessions.append(read_session(path))
    free, touched = sessions
    assert "simulation_obstacles" not in free.metadata
    assert touched.metadata["simulation_obstacles"] == obstacle
    assert touched.metadata["shear_projection"] == "0.0,1.0,0.0,0.0,0.0,0.0"
    # At the end the beam rests against it: S = F, torque = x F.
    end = touched.samples[-300:]
    force_n = pressing_force_n(load_profile("sim").rig.beam, 0.62, 0.03, 3000.0)
    assert end["fy_n"].mean() == pytest.approx(force_n, abs=0.2 * force_n)
    assert end["coupling_torque_nm"].mean() == pytest.approx(0.62 * force_n, abs=0.1 * force_n)
    assert abs(free.samples["fy_n"][-300:].mean()) < 0.2 * force_n


@pytest.mark.further  # as in the engine
def test_series_is_reproducible_by_its_seed(rigd, tmp_path):
    def series():
        options = ("--seed", "5", "--repeat", "2", "--note", "a series", *SHORT)
        sessions = json.loads(rigd("run", "chirp", "--fast", "--json", *options).stdout)["sessions"]
        return [read_session(tmp_path / session["path"]) for session in sessions]

    records, again = series(), series()
    assert [record.metadata["series"] for record in records] == ["1 of 2", "2 of 2"]
    assert {record.metadata["note"] for record in records} == {"a series"}
    seeds = [record.metadata["simulation_seed"] for record in records]
    assert seeds[0] == "5"
    assert seeds[1] != "5"
    assert not np.array_equal(records[0].samples, records[1].samples)
    for first, second in zip(records, again, strict=True):
        assert np.array_equal(first.samples, second.samples)


@pytest.mark.further  # as the stopped sessions below
def test_counts_of_a_session_in_real_time(rigd, patient, tmp_path):
    lengths = ("--duration", "0.5", "--rest", "0.1", "--ring-down", "0.1")
    session = only_session(rigd("run", "chirp", "--json", "--profile", patient, *lengths))
    assert session["scheduled"] == 700
    assert session["lost"] == 0
    assert session["recorded"] + session["missed"] == 700
    record = read_session(tmp_path / session["path"])
    assert len(record.samples) == session["recorded"]
    check_real_time(record, session)


def check_real_time(record, session):
    """Check that a record was made in real time, and that its counts agree with its samples."""
    began_s = 1e-9 * (record.samples["t_ns"] + record.samples["lateness_ns"].astype(int))
    rate_hz = (len(began_s) - 1) / (began_s[-1] - began_s[0])
    assert float(record.outcome["true_rate_hz"]) == pytest.approx(rate_hz, rel=0.01)
    assert record.metadata["realtime_clock"] == "real"
    late = record.samples["status"] & Status.LATE
    assert np.count_nonzero(late) == session["late"]


def to_all(process, number):
    """Signal the whole process group, as a terminal or a service manager does."""
    os.killpg(process.pid, number)


def to_one(process, number):
    process.send_signal(number)


def wait_for_record(folder, size=10_000, timeout_s=60.0):
    """Wait until a session is being recorded in a folder; return its file."""

    def grown():
        for part in folder.glob("sessions/*.part"):
            with contextlib.suppress(FileNotFoundError):
                if part.stat().st_size > size:
                    return part
        return None

    part = eventually(grown, timeout_s)
    assert part, "no session is being recorded"
    return part


@pytest.mark.parametrize(
    ("send", "interrupts"),
    [
        (to_all, ("SIGINT", "SIGHUP")),
        further(to_all, ("SIGTERM", "SIGQUIT", "SIGTSTP")),
        pytest.param(to_one, ("SIGINT", "SIGTERM"), marks=pytest.mark.further),
        pytest.param(to_one, ("SIGHUP", "SIGQUIT", "SIGTSTP"), marks=pytest.mark.slow),
    ],
)
def test_every_stop_switches_off_and_completes_the_file(
    start_rigd, write_profile, tmp_path, send, interrupts
):
    running = {}
    for name in interrupts:  # all at once: most of the time is waiting
        (tmp_path / name).mkdir()
        values = {"name": f'"{name}"', "realtime.priority": "0"}
        profile = write_profile("sim", values, patient=True)
        options = ("--json", "--duration", "60", "--profile", profile)
        running[name] = start_rigd("run", "chirp", *options, folder=tmp_path / name)
    for name in interrupts:
        wait_for_record(tmp_path / name)
    for _ in range(3):  # an impatient operator presses again
        for name, process in running.items():
            send(process, signal.Signals[name])
        time.sleep(0.05)
    for name, process in running.items():
        folder = tmp_path / name
        output, errors = process.communicate(timeout=300)
        assert process.returncode == 130, errors
        assert "Traceback" not in errors
        (session,) = json.loads(output)["sessions"]
        assert session["outcome"] == "stopped"
        assert session["scheduled"] == session["recorded"] + session["missed"]
        assert session["lost"] == 0
        record = read_session(folder / session["path"])
        assert len(record.samples) == session["recorded"]
        check_real_time(record, session)
        assert record.outcome["outcome"] == "stopped"
        last = record.samples[-1]
        assert last["torque_command_nm"] == 0.0
        assert last["status"] & Status.TORQUE_OFF
        assert not list(folder.glob("sessions/*.part"))


@pytest.mark.further  # as tests/engine, without processes
def test_a_stop_before_the_record_leaves_no_file(start_rigd, write_profile, tmp_path):
    running = []
    for number in range(5):
        folder = tmp_path / str(number)
        folder.mkdir()
        values = {"name": f'"{number}"', "session.tare_s": "60"}
        profile = write_profile("sim", values, patient=True)
        with ignored(signal.SIGINT):  # by the interpreter's own start, which would end differently
            process = start_rigd("run", "chirp", "--json", "--profile", profile, folder=folder)
        running.append((folder, process))
    for number, (_, process) in enumerate(running):  # each in another part of its start
        assert eventually(lambda process=process: not ignores(process.pid, signal.SIGINT))
        time.sleep(0.3 * number)
        to_all(process, signal.SIGINT)
    for folder, process in running:
        output, errors = process.communicate(timeout=300)
        assert process.returncode == 130, errors
        assert "Traceback" not in errors
        assert not list(folder.glob("sessions/*"))
        if output:  # it had begun to plan sessions
            for session in json.loads(output)["sessions"]:
                assert session["path"] is None
                assert session["scheduled"] == 0


@pytest.mark.further  # as in tests/runner
def test_stopped_series_retains_its_sessions(start_rigd, tmp_path):
    process = start_rigd("run", "chirp", "--json", "--fast", "--repeat", "50", *SHORT)
    assert eventually(lambda: len(list(tmp_path.glob("sessions/*.mcap"))) >= 2)
    to_all(process, signal.SIGINT)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    sessions = json.loads(output)["sessions"]
    assert 2 <= len(sessions) < 50
    written = {session["path"] for session in sessions if session["path"]}
    assert written == {f"sessions/{path.name}" for path in tmp_path.glob("sessions/*")}
    for path in written:
        read_session(tmp_path / path)


@pytest.mark.further  # as tests/runner/test_rig.py
def test_hanging_control_process_is_killed_at_a_stop(start_rigd, patient, tmp_path):
    process = start_rigd("run", "chirp", "--json", "--duration", "60", "--profile", patient)
    wait_for_record(tmp_path)
    os.kill(child_running(process.pid, "rigd.engine.control_process"), signal.SIGSTOP)
    to_one(process, signal.SIGINT)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 1, errors  # a fault, although a stop was requested
    (session,) = json.loads(output)["sessions"]
    assert session["outcome"] == "fault"
    assert "was killed" in session["reason"]
    record = read_session(tmp_path / session["path"])
    assert len(record.samples) == session["recorded"]


@pytest.mark.further  # as tests/runner/test_rig.py and tests/recovery/test_advice.py
def test_file_created_meanwhile_is_not_overwritten(start_rigd, patient, tmp_path):
    process = start_rigd("run", "hold", "--duration", "3", "--rest", "0", "--profile", patient)
    part = wait_for_record(tmp_path, 1000)  # before that, its name is only being tried
    part.with_suffix("").write_text("somebody else's")
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 1
    assert "Traceback" not in errors
    assert "not overwritten" in errors
    assert re.search(r"after mv \S+\.mcap\.part \S+_2\.mcap\.part rigd recover \S+_2\.", errors)
    assert part.with_suffix("").read_text() == "somebody else's"
    assert part.exists()


@pytest.mark.parametrize(
    ("victim", "words"),
    [
        ("rigd.engine.control_process", "control process"),
        further("rigd.engine.recorder", ""),  # as tests/runner/test_rig.py
    ],
)
def test_a_killed_process_ends_the_session_safely(start_rigd, patient, tmp_path, victim, words):
    process = start_rigd("run", "chirp", "--duration", "60", "--profile", patient)
    wait_for_record(tmp_path)
    os.kill(child_running(process.pid, victim), signal.SIGKILL)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 1, (output, errors)
    assert "Traceback" not in errors
    if victim == "rigd.engine.control_process":
        (path,) = tmp_path.glob("sessions/*.mcap")
        record = read_session(path)
        assert record.outcome["outcome"] == "fault"
        assert words in record.outcome["reason"]
        counts = {name: int(record.outcome[name]) for name in ("scheduled", "missed", "lost")}
        assert counts["scheduled"] == len(record.samples) + counts["missed"] + counts["lost"]
    else:
        assert list(tmp_path.glob("sessions/*.part"))
        assert "recorder process was killed" in output + errors


@pytest.mark.further  # as with a moved folder
def test_failed_series_reports_the_earlier_sessions(start_rigd, patient, tmp_path):
    options = ("--json", "--duration", "2", "--rest", "0", "--repeat", "30", "--profile", patient)
    process = start_rigd("run", "hold", *options)
    assert eventually(lambda: list(tmp_path.glob("sessions/*-01.mcap")))
    # One that has completed its file is not missed, and this test may have been suspended.
    while process.poll() is None:
        with contextlib.suppress(AssertionError, ProcessLookupError):  # between two sessions
            recorder = child_running(process.pid, "rigd.engine.recorder")
            wait_for_record(tmp_path, 1000, timeout_s=10.0)
            os.kill(recorder, signal.SIGKILL)
        time.sleep(0.2)
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 1
    (part,) = tmp_path.glob("sessions/*.part")
    *before, failed = json.loads(output)["sessions"]
    assert len(before) == int(part.name.split(".")[0].rsplit("-")[-1]) - 1 >= 1
    assert {session["outcome"] for session in before} == {"complete"}
    assert {session["part"] for session in before} == {None}
    assert (failed["outcome"], failed["path"]) == ("fault", None)
    assert tmp_path / failed["part"] == part
    assert "recorder process was killed by signal 9" in failed["reason"]
    assert part.name in errors


class FolderMoves(StopRequest):
    """A stop that never comes; the folder of the sessions is moved once there is one."""

    @property
    def requested(self):
        if list(Path("sessions").glob("*-01.mcap")):
            Path("sessions").rename("moved")
            Path("sessions").touch()
        return False

    @requested.setter
    def requested(self, _):
        pass


@pytest.mark.usefixtures("children_copied")
def test_series_without_its_folder_reports_the_earlier_sessions(rigd_here, monkeypatch):
    processes = FolderMoves(), ProcessGroup(with_live_view=False)
    monkeypatch.setattr("rigd.cli.run.start_processes", lambda **_: processes)
    brief = ("--duration", "0.3", "--rest", "0", "--fast", "--no-look")
    done = rigd_here("run", "hold", *brief, "--repeat", "3", "--json")
    assert done.returncode == 1, done.stderr
    (session,) = json.loads(done.stdout)["sessions"]
    assert session["outcome"] == "complete"
    assert "cannot be created" in done.stderr


@pytest.mark.further  # as names that are taken
def test_sessions_of_the_same_second_have_different_names(start_rigd, tmp_path):
    options = ("hold", "--duration", "1", "--fast", "--json")
    processes = [start_rigd("run", *options) for _ in range(2)]
    paths = set()
    for process in processes:
        output, errors = process.communicate(timeout=300)
        assert process.returncode == 0, errors
        paths.add(json.loads(output)["sessions"][0]["path"])
    assert len(paths) == 2
    assert {f"sessions/{path.name}" for path in tmp_path.glob("sessions/*")} == paths


@pytest.mark.further  # as tests/session
def test_undecodable_file_name_is_stored_escaped(rigd, tmp_path):
    name = os.fsdecode(b"f\xff.csv")
    (tmp_path / name).write_text("angle_rad\n" + "0.0\n" * 100)
    done = subprocess.run(
        [RIGD, "run", "file", name, "--fast", "--json"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    path = tmp_path / only_session(done)["path"]
    assert read_session(path).metadata["file"] == r"f\udcff.csv"


def test_error_if_the_beam_cannot_be_simulated(rigd, write_profile, tmp_path):
    values = {"simulation.density_ratio": "1000.0", "simulation.stiffness_ratio": "1e-3"}
    profile = write_profile("sim", values)
    done = rigd("run", "hold", "--profile", str(profile), "--fast", "--output", str(tmp_path))
    assert done.returncode == 1
    error = done.stderr.splitlines()[-1]
    assert error.startswith("Error: ") and "modes below" in error
    assert "Traceback" not in done.stderr


def test_a_session_needs_neither_descriptors_nor_scipy(tmp_path):
    """Scipy would add 0.15 s of processor time to every start; the module found here exits."""
    (tmp_path / "scipy.py").write_text("raise SystemExit('scipy was imported')\n")
    done = subprocess.run(
        ["sh", "-c", f"exec {RIGD} run hold --duration 1 --fast --output out <&- >&- 2>&-"],
        cwd=tmp_path,
        check=False,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
    )
    assert done.returncode == 0
    (path,) = tmp_path.glob("out/*.mcap")
    assert read_session(path).outcome["outcome"] == "complete"


@pytest.mark.further  # as tests/daemon/test_log.py
def test_suspended_terminal_does_not_stop_the_supervisor(patient, tmp_path):
    master, slave = os.openpty()
    process = subprocess.Popen(
        [RIGD, "run", "hold", "--duration", "2", "--rest", "0", "--profile", patient, "--json"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=slave, text=True,
    )  # fmt: skip
    try:
        wait_for_record(tmp_path, 1000)
        termios.tcflow(slave, termios.TCOOFF)  # Ctrl-S
        assert eventually(lambda: list(tmp_path.glob("sessions/*.mcap")))
    finally:
        termios.tcflow(slave, termios.TCOON)
    output, _ = process.communicate(timeout=300)
    os.close(master)
    os.close(slave)
    (session,) = json.loads(output)["sessions"]
    assert session["outcome"] == "complete", session


def test_a_dead_supervisor_ends_the_session_safely(start_rigd, patient, tmp_path):
    process = start_rigd("run", "chirp", "--duration", "60", "--profile", patient)
    wait_for_record(tmp_path)
    control = child_running(process.pid, "rigd.engine.control_process")
    process.kill()
    process.wait()
    assert eventually(lambda: list(tmp_path.glob("sessions/*.mcap")))
    (path,) = tmp_path.glob("sessions/*.mcap")
    record = read_session(path)
    assert record.outcome["outcome"] == "fault"
    assert "supervising process" in record.outcome["reason"]
    assert record.samples[-1]["torque_command_nm"] == 0.0
    assert record.samples[-1]["status"] & Status.TORQUE_OFF
    assert eventually(lambda: has_ended(control))


@pytest.mark.further  # as below, and tests/excitation/test_signals.py
def test_chirp_there_and_back_begins_as_a_plain_chirp(short_chirps, tmp_path):
    """With the seed of the plain chirp: equal to the last bit up to the turn."""
    command = [RIGD, "run", "chirp", "--there-and-back", "--duration", "20", "--rest", "0.5"]
    command += ["--ring-down", "1", "--seed", "3", "--fast", "--no-look", "--output", tmp_path]
    done = warm_start.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "sweeps from 0.05 to 50 Hz and back, 20 s each way, record of 41.5 s" in done.stdout
    (path,) = tmp_path.glob("*.mcap")
    both, plain = load(path), load(short_chirps[0])
    assert both.outcome == "complete"
    assert both.metadata["there_and_back"] == "1"
    assert both.time_s.size == 41_500
    assert (both.outward_sweep, both.sweep) == (slice(500, 20_500), slice(500, 40_500))
    assert (plain.outward_sweep, plain.sweep) == (None, slice(500, 20_500))
    np.testing.assert_array_equal(both.torque_nm[:20_500], plain.torque_nm[:20_500])
    settings = welch_settings(both, WelchSettings())
    responses = [estimate(record, settings)[0].response for record in (both, plain)]
    np.testing.assert_array_equal(*responses)
    assert any("use the first sweep alone" in remark for remark in analysis_remarks(both))
    assert welch_exclusion_reason(both) is None
    assert not analysis_remarks(plain)
    # The reference passes the same angles, and the frequency at equal distances from the turn.
    reference = both.reference_rad - both.reference_rad[0]
    assert np.abs(np.diff(reference[20_400:20_600])).max() < 0.025 * 2 * np.pi * 50 / 1000


def test_welch_estimate_there_and_back_uses_the_way_there(short_chirps):
    """The estimate is that of half of a plain chirp, whatever follows."""
    session = read_session(short_chirps[0])
    planned = {"sweep": (500, 20_500), "there": (500, 10_500), "back": (10_500, 20_500)}
    stated = {**session.metadata, "duration_s": "10.0", "stop_hz": "25.0"}
    both = record_of(replace(session, segments=planned, metadata={**stated, "there_and_back": "1"}))
    half = {"sweep": (500, 10_500), "ring_down": (10_500, 20_500)}
    plain = record_of(replace(session, segments=half, metadata=stated))
    assert (both.outward_sweep, both.sweep) == (slice(500, 10_500), slice(500, 20_500))
    settings = welch_settings(both, WelchSettings(segment_length=1439, overlap=216))
    responses = [estimate(record, settings)[0].response for record in (both, plain)]
    np.testing.assert_array_equal(*responses)
    assert any("use the first sweep alone" in remark for remark in analysis_remarks(both))
    assert welch_exclusion_reason(both) is None


def test_welch_estimate_of_a_chirp_stopped_on_its_way_back(
    short_chirps,
):
    """Half of the way back: the plan is longer than the record, as of any stopped session."""
    session = read_session(short_chirps[0])
    planned = {"sweep": (500, 40_500), "there": (500, 15_500), "back": (15_500, 30_500)}
    stated = {**session.metadata, "duration_s": "15.0", "there_and_back": "1"}
    record = record_of(replace(session, segments=planned, metadata=stated))
    assert (record.outward_sweep, record.sweep) == (slice(500, 15_500), slice(500, 21_500))
    assert welch_exclusion_reason(record) is None
