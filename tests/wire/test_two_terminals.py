"""`rigd simulate` in one terminal, `rigd run` in the other, in real time."""

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest
from processes import child_running, eventually

from rigd.session import read_session, read_timings
from rigd.session.layout import Status

pytestmark = pytest.mark.process

# Little torque: while the computer is paused it is held, and swings the motor out.
CHIRP = ("--amplitude", "0.005", "--stop-hz", "5", "--duration", "1.5")
LENGTHS = ("--rest", "0.2", "--ring-down", "0.3")

ALONE = {"name": f'"alone_{os.getpid()}"'}
"""A rig that no other test simulates at the same time."""


def _recording(folder: Path) -> bool:
    """Whether a session is being recorded in a folder and has its first samples."""
    return any(part.stat().st_size > 100_000 for part in folder.glob("sessions/*.part"))


# A patient profile lets the shaft turn for as long as a computer may pause.
ACCEPTED = [
    word
    for name in ("travel_loop_fails", "travel_no_angle", "travel_missed_ticks")
    for word in ("--accept", name)
]


@pytest.fixture
def run_chirp(rigd):
    def run(profile, *options):
        return rigd("run", "chirp", "--profile", profile, *CHIRP, *LENGTHS, "--json", *options)

    return run


@pytest.fixture
def refuse_chirp(rigd_here):
    """The same within this process, up to the start of others."""
    return lambda profile, *options: rigd_here("run", "chirp", "--profile", profile, *options)


@pytest.fixture
def start_chirp(start_rigd):
    """Start the paper's chirp and leave it running."""
    return lambda profile: start_rigd("run", "chirp", "--profile", profile, "--json", *ACCEPTED)


def _undisturbed(session) -> np.ndarray:
    """The tracking error up to the first missing reading; none if it began in motion."""
    samples = session.samples
    error = samples["angle_rad"] - samples["angle_reference_rad"]
    disturbed = (samples["status"] & (Status.ANGLE_STALE | Status.WRENCH_STALE)) != 0
    disturbed |= np.diff(samples["tick"].astype(int), prepend=-1) > 1
    first = int(np.argmax(disturbed)) if disturbed.any() else len(error)
    began_at_rest = np.abs(error[:50]).max() < 2e-3
    return error[: first if began_at_rest else 0]


@pytest.mark.further  # as in lock-step
@pytest.mark.parametrize(
    "name", [pytest.param("antenna_can", marks=pytest.mark.slow), "antenna_serial"]
)
def test_a_chirp_over_the_wire_is_recorded_whole(
    name, quiet_profile, start_simulator, run_chirp, drive_log, tmp_path
):
    profile = quiet_profile(name, patient=True)
    log = tmp_path / "drive.jsonl"
    simulator = start_simulator(profile, "--log", log)
    done = run_chirp(profile, *ACCEPTED)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"No hardware: {name} is simulated (rigd simulate, by the clock)." in done.stderr
    (counts,) = json.loads(done.stdout)["sessions"]
    assert counts["outcome"] == "complete"
    assert counts["lost"] == 0
    assert counts["scheduled"] == 2000 == counts["recorded"] + counts["missed"]

    session = read_session(tmp_path / counts["path"])
    metadata = session.metadata
    assert metadata["simulated"] == "true"
    assert metadata["acquisition_mode"] == "same_tick"
    assert ("sensor_filter" in metadata) == (name == "antenna_serial")
    calibration = json.loads(session.attachments["calibration.json"])
    assert np.shape(calibration["matrix"]) == (6, 6)
    fresh = (session.samples["status"] & (Status.ANGLE_STALE | Status.WRENCH_STALE)) == 0
    assert fresh.any()
    # Lock-step tests the whole reference: here the computer may pause.
    assert np.abs(_undisturbed(session)).max(initial=0.0) < 0.005  # the whole amplitude

    timings = read_timings(tmp_path / counts["path"])
    assert np.array_equal(timings["tick"], session.samples["tick"])
    # Requested after the tick was due, in the same tick.
    request_delay_s = -timings["angle_age_s"][fresh]
    assert np.all(request_delay_s >= 0)
    assert np.median(request_delay_s) < 1e-3
    assert np.median(-timings["wrench_age_s"][fresh]) < 1e-3

    simulator.send_signal(signal.SIGTERM)
    assert simulator.wait(30.0) == 0
    entries = drive_log(log)
    assert entries.last_torque["enabled"] is False
    assert entries.last_torque["torque_nm"] == 0.0
    assert max(abs(entry["torque_nm"]) for entry in entries.of("torque")) > 0.01
    assert not entries.of("emergency")


@pytest.mark.further  # as faults do in test_injected_faults.py
def test_ctrl_c_stops_the_motor_over_the_wire(
    quiet_profile, start_simulator, start_chirp, drive_log, tmp_path
):
    profile = quiet_profile("antenna_can", patient=True)
    log = tmp_path / "drive.jsonl"
    simulator = start_simulator(profile, "--log", log)
    running = start_chirp(profile)
    assert eventually(lambda: _recording(tmp_path))
    os.killpg(running.pid, signal.SIGINT)
    out, err = running.communicate(timeout=300)
    assert running.returncode == 130, err
    (counts,) = json.loads(out)["sessions"]
    assert counts["outcome"] == "stopped"
    last = read_session(tmp_path / counts["path"]).samples[-1]
    assert last["torque_command_nm"] == 0.0
    assert last["status"] & Status.TORQUE_OFF
    simulator.send_signal(signal.SIGTERM)
    assert simulator.wait(30.0) == 0
    entries = drive_log(log)
    assert (entries.last_torque["enabled"], entries.last_torque["torque_nm"]) == (False, 0.0)
    assert not entries.of("emergency")


def test_advice_without_hardware_and_simulator(quiet_profile, run_chirp, runtime_folder):
    done = run_chirp(quiet_profile("antenna_can", ALONE))
    assert done.returncode == 1
    assert "rigd simulate" in done.stderr + done.stdout
    assert "Traceback" not in done.stderr


def test_real_time_can_be_skipped_only_in_lock_step(
    quiet_profile, start_simulator, refuse_chirp, runtime_folder
):
    profile = quiet_profile("antenna_can", ALONE)
    for option, name in ((("--fast",), "--fast"), (("--seed", "3"), "--seed")):
        done = refuse_chirp(profile, *option)
        assert done.returncode == 2
        assert f"{name}: {profile} is a profile of hardware" in done.stderr
    start_simulator(profile)
    done = refuse_chirp(profile, "--fast")
    assert done.returncode == 2
    assert "start rigd simulate with --lock-step" in done.stderr


@pytest.mark.further  # as in test_injected_faults.py
@pytest.mark.parametrize(
    "how", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.slow)]
)
def test_the_drive_goes_off_without_the_loop(
    how, quiet_profile, start_simulator, start_chirp, drive_log, tmp_path
):
    # Lock-step tests the exact tick: here the simulator may pause as well.
    timeout = {"cia402.heartbeat_timeout_s": "1.0"}
    profile = quiet_profile("antenna_can", timeout, patient=True)
    log = tmp_path / "drive.jsonl"
    simulator = start_simulator(profile, "--log", log)
    running = start_chirp(profile)
    assert eventually(lambda: _recording(tmp_path))
    os.kill(child_running(running.pid, "rigd.engine.control_process"), how)
    assert eventually(lambda: any(e["code"] == 0x8130 for e in drive_log(log).of("emcy")))
    running.send_signal(signal.SIGINT)  # the supervisor kills a process that does not answer
    running.communicate(timeout=300)
    simulator.send_signal(signal.SIGTERM)
    assert simulator.wait(30.0) == 0

    entries = drive_log(log)
    end = entries.last_torque
    assert (end["enabled"], end["torque_nm"]) == (False, 0.0)
    (lost,) = [e for e in entries.of("emcy") if e["code"] == 0x8130]
    assert end["t_s"] == pytest.approx(lost["t_s"], abs=2e-3)


def test_identifiers_that_collide_are_wrong_use(quiet_profile, refuse_chirp, runtime_folder):
    done = refuse_chirp(quiet_profile("antenna_can", {"ati_can.base_id": "0x20"}))
    assert done.returncode == 2
    assert "0x201" in done.stderr
