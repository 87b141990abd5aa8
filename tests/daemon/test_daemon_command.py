"""`rigd serve` and its clients as an operator runs them."""

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import warm_start
from processes import eventually

from rigd.daemon.address import socket_path
from rigd.runtime import STOP_SIGNAL
from rigd.runtime.addresses import socket_answers
from rigd.session import read_session

pytestmark = pytest.mark.process

RIGD = Path(sys.executable).parent / "rigd"
SHORT = ("--duration", "1", "--rest", "0.2", "--ring-down", "0")
LONG = ("--duration", "100", "--rest", "0.2")


@pytest.fixture
def rigd(runtime_folder, tmp_path):
    """Start `rigd`; processes that still run at the end are killed."""
    started = []

    def start(*arguments):
        started.append(
            warm_start.start(
                [RIGD, *map(str, arguments)],
                cwd=tmp_path,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
        )
        return started[-1]

    yield start
    for process in reversed(started):
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def run_command(rigd):
    """Run a command to its end; return exit code, standard output and standard error."""

    def run(*arguments):
        process = rigd(*arguments)
        out, err = process.communicate(timeout=300.0)
        return process.returncode, out, err

    return run


@pytest.fixture
def run_here(rigd_here):
    """Run a command within this process, which costs less than `run_command`."""

    def run(*arguments):
        done = rigd_here(*arguments)
        return done.returncode, done.stdout, done.stderr

    return run


@pytest.fixture
def profile(write_profile):
    return write_profile("sim", patient=True)


@pytest.fixture
def serve(rigd, profile):
    """Start the daemon and wait until its rig is connected."""

    def start(*options):
        daemon = rigd("serve", "--profile", profile, "--output", "out", *options)
        until(lambda: socket_answers(socket_path("sim")), daemon)
        until(lambda: request("status")["state"] != "idle", daemon)
        return daemon

    return start


def until(condition, daemon=None):
    """Wait for a condition, as long as the daemon runs."""

    def ended():
        return daemon is not None and daemon.poll() is not None

    met = eventually(lambda: ended() or condition())
    assert not ended(), daemon.communicate()
    assert met


def request(command, **fields):
    with socket.socket(socket.AF_UNIX) as link, link.makefile("rw") as file:
        link.settimeout(30.0)
        link.connect(str(socket_path("sim")))
        file.write(json.dumps({"command": command, **fields}) + "\n")
        file.flush()
        return json.loads(file.readline())


def recording():
    progress = request("status")["progress"]
    if progress is None or progress["phase"] != "running" or progress["tick"] < 100:
        return False
    assert progress["time_left_s"] == round((progress["total"] - progress["tick"]) / 1000, 1)
    return True


def control_process():
    processes = request("status")["rig"]["processes"]
    return next(process["pid"] for process in processes if process["name"] == "control")


def test_commands_without_a_daemon_name_rigd_serve(runtime_folder, run_here):
    for command in (("status",), ("start", "hold")):
        code, out, err = run_here(*command)
        assert (code, out) == (1, "")
        assert "rigd serve --profile" in err


def test_watching_needs_a_terminal(run_command):
    code, out, err = run_command("status", "--watch")
    assert (code, out) == (2, "")
    assert "terminal" in err


def test_invalid_options_of_serve_are_refused_at_once(run_command, run_here, profile, tmp_path):
    (tmp_path / "file").touch()
    for run, *options in ((run_here, "--output", "file/out"), (run_command, "--group", "")):
        code, out, err = run("serve", "--profile", profile, *options)
        assert (code, out) == (2, "")
        assert options[0] in err
        assert "Traceback" not in err


def test_a_day_with_the_daemon(serve, run_command, run_here, profile, tmp_path):
    for name in ("analysis", "random", "rigd"):  # the operator's own, not the modules
        (tmp_path / f"{name}.py").write_text("raise SystemExit('of the operator')")
    daemon = serve("--fast")
    code, out, err = run_command("start", "chirp", *SHORT, "--stop-hz", "10", "--repeat", "2",
                                 "--json", "--operator", "Ada")  # fmt: skip
    assert code == 0
    assert err.startswith("No hardware: sim is simulated (in this process).\n")
    sessions = json.loads(out)["sessions"]
    assert [s["outcome"] for s in sessions] == ["complete", "complete"]
    assert [s["hardware"] for s in sessions] == [False, False]
    record = read_session(Path(sessions[1]["path"]))
    assert record.metadata["operator"] == "Ada"
    assert record.metadata["series"] == "2 of 2"
    assert Path(sessions[0]["path"]).parent == tmp_path / "out"

    code, out, err = run_here("start", "step", "--amplitude", "3")
    assert (code, out) == (2, "")
    assert "lower the amplitude" in err
    code, out, err = run_here("start", "chirp", "--amplitude", "nan")
    assert code == 2
    code, out, _ = run_command("status")
    assert code == 0
    assert "ready since" in out
    code, out, _ = run_here("tare", "--json")
    assert "torque_std_nm" in json.loads(out)
    code, out, _ = run_here("zero", "--profile", "sim")
    assert code == 0
    code, out, err = run_here("reset")
    assert code == 1
    assert "nothing to reset" in err

    code, _, err = run_command("serve", "--profile", profile)
    assert code == 1
    assert "rigd serve, process" in err
    code, _, err = run_here("run", "hold", "--profile", profile, "--fast", *SHORT)
    assert code == 1
    assert "rigd start" in err

    os.kill(control_process(), signal.SIGKILL)
    until(lambda: request("status")["state"] == "fault")
    code, _, err = run_here("start", "hold", *SHORT)
    assert code == 1
    assert "killed by signal 9" in err
    code, out, _ = run_command("reset")
    assert code == 0
    assert "rigd zero" in out  # it was set before, and is lost
    assert request("status")["state"] == "ready"

    daemon.send_signal(signal.SIGTERM)
    _, log = daemon.communicate(timeout=300.0)
    assert daemon.returncode == 0
    assert "state: ready -> running: chirp was started, 2 sessions" in log
    assert not socket_path("sim").exists()


@pytest.mark.further  # as tests/runner/test_quick_looks.py
def test_each_session_has_a_quick_look(serve, run_command, brief_quick_looks):
    daemon = serve("--fast")
    assert request("status")["daemon"]["quick_looks"] is True
    code, out, err = run_command("start", "chirp", *SHORT, "--repeat", "2", "--json")
    assert code == 0, err
    for session in json.loads(out)["sessions"]:
        quick_look = json.loads(Path(session["look"]).read_text())
        assert quick_look["file"] == Path(session["path"]).name
        assert "\n".join(quick_look["text"]) in err
    assert request("status")["series"]["sessions"] == json.loads(out)["sessions"]
    daemon.send_signal(signal.SIGTERM)
    _, log = daemon.communicate(timeout=300.0)
    assert f"INFO {quick_look['text'][0]}" in log


@pytest.mark.further  # as test_fits.py
def test_a_record_is_fitted_while_it_is_recorded(serve, run_command, run_here):
    serve("--fast")
    swept = ("--start-hz", "0.5", "--duration", "5", "--rest", "0.5", "--ring-down", "1")
    code, out, err = run_command("start", "chirp", *swept, "--watch-fit", "--json")
    assert code == 0, err
    (session,) = json.loads(out)["sessions"]
    assert [mode["mode"] for mode in session["fit"]["modes"] if mode["shown"]][:2] == [1, 2]
    fit = request("status")["series"]["fit"]
    assert fit["duration_s"] == session["fit"]["duration_s"] == 6.5
    assert "\n".join(fit["text"]) in err
    code, out, _ = run_here("status")
    assert code == 0
    assert fit["text"][0] in out


def test_session_ends_with_a_stop_or_its_daemon(serve, stop_here, rigd):
    daemon = serve()
    client = rigd("start", "hold", *LONG, "--repeat", "3")
    until(recording, daemon)
    client.kill()
    client.wait()
    until(lambda: request("status")["controller"] is None)
    assert request("status")["state"] == "running"
    code, out, _ = stop_here()
    assert code == 0
    assert "The session has ended; the torque is off." in out
    assert request("status")["state"] == "ready"
    (session,) = request("status")["series"]["sessions"]
    assert session["outcome"] == "stopped"
    assert session["lost"] == 0
    assert session["path"] in out
    assert read_session(Path(session["path"])).outcome["outcome"] == "stopped"

    client = rigd("start", "hold", *LONG, "--json")
    until(recording, daemon)
    control = control_process()
    os.killpg(daemon.pid, signal.SIGINT)
    _, log = daemon.communicate(timeout=300.0)
    assert daemon.returncode == 130
    assert "stopping -> ready" in log
    out, err = client.communicate(timeout=300.0)
    assert client.returncode == 130, (out, err, log)
    assert json.loads(out)["sessions"][0]["outcome"] == "stopped"
    assert not Path(f"/proc/{control}").exists()
    assert not socket_path("sim").exists()


@pytest.mark.further  # as by a stop that is waited for
def test_other_ways_to_stop_a_session(serve, stop_here, rigd):
    daemon = serve()
    client = rigd("start", "hold", *LONG)
    until(recording, daemon)
    code, out, _ = stop_here("--no-wait")
    assert code == 0
    assert "is being stopped" in out
    client.communicate(timeout=300.0)
    assert client.returncode == 130

    client = rigd("start", "hold", *LONG)
    until(recording, daemon)
    daemon.send_signal(STOP_SIGNAL)
    client.communicate(timeout=300.0)
    assert client.returncode == 130
    until(lambda: request("status")["state"] == "ready", daemon)
    code, out, _ = stop_here()
    assert code == 0
    assert out.startswith("No session is running on the rig sim")
    assert out.endswith("; the torque is off.\n")

    client = rigd("start", "hold", *LONG)
    until(recording, daemon)
    client.send_signal(signal.SIGINT)
    out, err = client.communicate(timeout=300.0)
    assert client.returncode == 130
    assert "Stopped:" in err


CROWD = """
import socket, sys
kept = []
while True:
    link = socket.socket(socket.AF_UNIX)
    try:
        link.connect(sys.argv[1])
        if sys.argv[2] == "half":
            link.send(b'{"command": "sto')
    except OSError:
        continue
    if sys.argv[2] != "close":
        kept = [*kept[-200:], link]
"""


@pytest.mark.further  # as test_control_socket.py
def test_stop_succeeds_among_many_clients(serve, rigd, run_command, stop_here):
    daemon = serve()
    client = rigd("start", "hold", *LONG)
    until(recording, daemon)
    crowd = [
        subprocess.Popen([sys.executable, "-c", CROWD, socket_path("sim"), kind])
        for kind in ("silent", "half", "close")
    ]
    try:
        code, out, err = run_command("status", "--json")
        assert code == 0, err
        assert json.loads(out)["state"] == "running"
        code, out, err = stop_here()
        assert code == 0, err
        assert "The session has ended; the torque is off." in out
    finally:
        for process in crowd:
            process.kill()
            process.wait()
    _, err = client.communicate(timeout=300.0)
    assert client.returncode == 130, err
    assert request("status")["state"] == "ready"


def test_a_killed_daemon_stops_the_rig(serve, rigd):
    daemon = serve()
    client = rigd("start", "hold", *LONG)
    until(recording, daemon)
    control = control_process()
    daemon.kill()
    daemon.wait()
    _, err = client.communicate(timeout=300.0)
    assert client.returncode == 1
    assert "The daemon is gone." in err
    assert "rigd serve" in err
    until(lambda: not Path(f"/proc/{control}").exists())
    assert socket_path("sim").exists()  # and is no obstacle: see test_control_socket.py
