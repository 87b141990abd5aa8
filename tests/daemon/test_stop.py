"""`rigd stop` finds running sessions, and reports an end only if it was observed."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace

import pytest
from packages import DEVICES, install
from processes import children, eventually
from stop_scenarios import SITUATIONS, can_isolate, isolated

from rigd.daemon.address import socket_path
from rigd.daemon.client import Client
from rigd.engine import IDLE_NAME, SESSION_NAME, supervisor_of_control
from rigd.engine.workers import CONTROL, RECORDER
from rigd.runtime import STOP_SIGNAL
from rigd.runtime.addresses import socket_answers
from rigd.runtime.processes import read_process


def control_of(pid):
    """Short name of the control process of a supervisor."""
    for process in filter(None, map(read_process, children(pid))):
        if supervisor_of_control(process.command) == pid:
            return process.name
    return None


def start_session(daemon):
    """Start a session of a new daemon of the rig "sim", and wait until it has begun."""
    path = socket_path("sim")
    assert eventually(
        lambda: (
            daemon.poll() is not None
            or (socket_answers(path) and control_of(daemon.pid) == IDLE_NAME)
        ),
        every_s=0.1,
    )
    assert daemon.poll() is None, daemon.communicate()
    with Client(path) as client:
        eventually(lambda: client.ask("status")["state"] == "ready")
        client.ask("start", excitation="hold", parameters={"duration_s": 100.0, "rest_s": 0.2})
    assert eventually(lambda: control_of(daemon.pid) == SESSION_NAME, every_s=0.1)


def test_searched_folders_are_named_without_a_session(stop_here, runtime_folder):
    code, out, err = stop_here()
    assert (code, err) == (0, "")
    assert out.startswith("No session is running. Searched: the process table")
    assert str(runtime_folder / "rigd") in out


@pytest.mark.process
def test_foreground_session_is_stopped_from_another_folder(
    stop_here, start_rigd, monkeypatch, write_profile, tmp_path
):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    with monkeypatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(elsewhere))
        profile = write_profile("sim", patient=True)
        hold = ("hold", "--duration", "100", "--rest", "0.2", "--no-look")
        run = start_rigd("run", *hold, "--profile", profile, cold=True)
    assert eventually(
        lambda: run.poll() is not None or control_of(run.pid) == SESSION_NAME, every_s=0.1
    )
    assert run.poll() is None, run.communicate()
    code, out, err = stop_here("--profile", "sim")
    assert (code, err) == (0, "")
    assert f"Stopped: rigd run hold on the rig sim (process {run.pid})." in out
    assert out.endswith("The session has ended; the torque is off.\n")
    run.wait(60.0)
    assert run.returncode == 130


DOUBT = "Drive: it does not show that it is off; press the wired stop (STO)."
DOUBTFUL_DRIVE = f'''
def open_twin(rig):
    opened = DEVICES.get("sim").open_drive(rig)
    drive, disable = opened.drive, opened.drive.disable

    def disable_without_reply():
        disable()
        drive.off_doubt = "{DOUBT}"

    drive.disable = disable_without_reply
    return opened
'''


@pytest.fixture
def doubtful_profile(write_profile, tmp_path, monkeypatch):
    """Profile of a simulated rig whose drive never shows that it is off."""
    own_open_twin = re.search(r"(?ms)^def open_twin.*?\n\n", DEVICES)[0]
    code = DEVICES.replace(own_open_twin, DOUBTFUL_DRIVE)
    entry_points = "[rigd.devices]\ntwin = lab_devices:TWIN\nscaled = lab_devices:SCALED\n"
    install(tmp_path / "site", "lab-devices", "1.2", code, entry_points)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "site"))
    path = write_profile(
        "sim", {"devices.drive": '"twin"', "devices.sensor": '"scaled"'}, patient=True
    )
    gain = '{ value = 100.0, source = "datasheet" }'
    sections = f'[twin]\nserial_number = "T1"\n[scaled]\ngain_percent = {gain}\n'
    path.write_text(path.read_text() + sections)
    return path


@pytest.mark.process
def test_foreground_session_whose_drive_does_not_confirm_is_an_error(
    stop_here, start_rigd, doubtful_profile
):
    hold = ("hold", "--duration", "100", "--rest", "0.2", "--no-look")
    run = start_rigd("run", *hold, "--profile", doubtful_profile, cold=True)
    assert eventually(
        lambda: run.poll() is not None or control_of(run.pid) == SESSION_NAME, every_s=0.1
    )
    assert run.poll() is None, run.communicate()
    code, out, err = stop_here()
    assert code == 1
    assert out == f"Stopped: rigd run hold on the rig sim (process {run.pid}).\n"
    assert "has not shown that it is off. Press the wired stop (STO)." in err
    out, _ = run.communicate(timeout=60.0)
    assert DOUBT in out


@pytest.mark.process
def test_daemon_whose_drive_does_not_confirm_is_an_error(stop_here, start_rigd, doubtful_profile):
    daemon = start_rigd("serve", "--profile", doubtful_profile, "--no-look", cold=True)
    start_session(daemon)
    for _ in range(2):  # also when it is in fault already
        code, out, err = stop_here()
        assert (code, out) == (1, "")
        assert "the rig is in fault" in err
        assert DOUBT in err
        assert err.endswith("Press the wired stop (STO).\n")
    daemon.terminate()


@pytest.mark.process
def test_fault_with_the_drive_off_is_no_error(stop_here, start_rigd, write_profile):
    profile = write_profile("sim", patient=True)
    daemon = start_rigd("serve", "--profile", profile, "--no-look", cold=True)
    start_session(daemon)
    with Client(socket_path("sim")) as client:
        for pid in children(daemon.pid):
            if RECORDER.module in read_process(pid).command:
                os.kill(pid, signal.SIGKILL)
        assert eventually(lambda: client.ask("status")["state"] == "fault", every_s=0.1)
    code, out, err = stop_here()
    assert (code, err) == (0, "")
    assert "the torque is off. The rig is in fault: " in out
    daemon.terminate()


class Impostor:
    """A thread that listens in place of a daemon and replies as a daemon would."""

    def __init__(self, path):
        path.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen(8)
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self):
        with suppress(OSError):
            while True:
                link, _ = self._listener.accept()
                threading.Thread(target=self._answer, args=(link,), daemon=True).start()

    def _answer(self, link):
        with suppress(OSError), link, link.makefile("rw") as file:
            for line in file:
                reply = {"reply": json.loads(line)["command"], "ok": True, "stopping": True}
                reply |= {"state": "ready", "series": None, "reason": ""}
                file.write(json.dumps(reply) + "\n")
                file.flush()

    def close(self):
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()


@pytest.mark.process
def test_an_impostor_on_the_socket_is_not_believed(
    stop_here, start_rigd, runtime_folder, write_profile
):
    profile = write_profile("sim", patient=True)
    daemon = start_rigd("serve", "--profile", profile, "--no-look", cold=True)
    path = socket_path("sim")
    start_session(daemon)
    impostor = Impostor(path)
    code, out, err = stop_here()
    assert code == 1
    assert f"Stopped: rigd serve on the rig sim (process {daemon.pid})." in out
    assert "torque is off" not in out
    assert f"The reply of process {os.getpid()} that listens on {path} is not trusted." in err
    assert control_of(daemon.pid) == IDLE_NAME
    assert daemon.poll() is None

    impostor.close()  # its socket does not listen any more, and the daemon's has no name
    code, out, err = stop_here()
    assert (code, err) == (0, "")
    assert "No session is running on rigd serve on the rig sim" in out
    assert "the torque is off" in out
    daemon.terminate()


def test_no_proof_from_a_folder_writable_by_others(stop_here, runtime_folder):
    runtime_folder.chmod(0o770)
    impostor = Impostor(runtime_folder / "sim.daemon")
    code, out, err = stop_here()
    impostor.close()
    assert (code, out) == (1, "")
    assert f"{runtime_folder} is writable by its group" in err
    assert "Whether another session runs is not known" in err


def test_error_without_a_process_table(stop_here):
    def no_table():
        raise FileNotFoundError(2, "no such table")

    code, out, err = stop_here(table=no_table)
    assert (code, out) == (1, "")
    assert "The process table cannot be read (no such table)" in err


LISTENER = """
import signal, sys
for number in (signal.SIGUSR1, signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda number, _: print(number, flush=True))
print("listens", flush=True)
for number in iter(signal.pause, 1):
    pass
"""


@pytest.fixture
def bystander():
    """A process that prints each signal that it gets, and its row in the process table."""
    process = subprocess.Popen([sys.executable, "-c", LISTENER], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "listens\n"
    yield process, read_process(process.pid)
    process.kill()
    process.communicate()


RUN = ("/usr/bin/python3", "/usr/bin/rigd", "run", "hold")
FORGED = ("python", "-m", CONTROL.module)
OTHER = os.getuid() + 1
ABSENT_PID = 2**22 + 1
"""A process id that no process can have."""


@pytest.mark.process
@pytest.mark.parametrize(
    ("command", "changes", "expected"),
    [
        (RUN, {}, STOP_SIGNAL),
        (
            RUN,
            {"handled_signal_mask": 0},
            signal.SIGTERM,
        ),  # it has not begun, and its SIGINT is ignored
        (RUN, {"handled_signal_mask": 1 << signal.SIGINT - 1}, signal.SIGINT),
        (
            RUN,
            {"ignored_signal_mask": 1 << STOP_SIGNAL - 1, "handled_signal_mask": 0},
            None,
        ),  # only a quick look remains
        (("python3", "-m", "rigd", "identify", "motor"), {}, STOP_SIGNAL),
        (
            ("python3", "rigd", "identify", "motor", "--from", "a.mcap"),
            {"handled_signal_mask": 0},
            None,
        ),
        (("sudo", "rigd", "run", "hold"), {}, None),
        (("python3", "rigd", "check"), {}, None),
        (RUN, {"uid": -1}, None),
        pytest.param(
            *(RUN, {"uid": OTHER}, None),
            marks=pytest.mark.skipif(os.getuid() == 0, reason="root stops every user's"),
        ),
    ],
)
def test_only_processes_with_sessions_get_a_signal(
    stop_here, bystander, command, changes, expected
):
    process, row = bystander
    stop_here("--no-wait", table=lambda: [replace(row, command=command, **changes)])
    if expected is None:
        process.send_signal(signal.SIGTERM)
        assert process.stdout.readline() == f"{int(signal.SIGTERM)}\n"
    else:
        assert process.stdout.readline() == f"{int(expected)}\n"


@pytest.mark.process
@pytest.mark.parametrize(
    ("names", "expected_code", "stated"),
    [
        (["rigd session", "rigd idle"], 0, "The session has ended; the torque is off.\n"),
        (["rigd session"], 1, "has not shown that it is off. Press the wired stop (STO).\n"),
        (["rigd connecting"], 1, "has not shown that it is off. Press the wired stop (STO).\n"),
        (["rigd connecting", "rigd idle"], 0, "The session has ended; the torque is off.\n"),
        (["python3"], 0, "Stopped before it connected the devices: rigd run hold on the rig sim"),
        ([], 0, "Stopped before it connected the devices: rigd run hold on the rig sim"),
    ],
)
def test_off_is_stated_only_by_the_last_name_of_the_control_process(
    stop_here, bystander, names, expected_code, stated
):
    process, row = bystander
    run = replace(row, command=RUN, handled_signal_mask=1 << STOP_SIGNAL - 1)
    command = (*FORGED, str(row.pid))
    control = replace(row, pid=ABSENT_PID, parent=row.pid, command=command)
    first_call_s = []

    def table():
        """Each name for 0.2 s, then the control process has ended."""
        now_s = time.monotonic()
        first_call_s.append(now_s)
        number = int((now_s - first_call_s[0]) / 0.2)
        return [run, *(replace(control, name=name) for name in names[number : number + 1])]

    code, out, err = stop_here(table=table)
    assert code == expected_code, (out, err)
    assert stated in (err if code else out)
    assert ("torque is off" in out + err) is (names[-1:] == ["rigd idle"])
    assert process.poll() is None


@pytest.mark.process
def test_no_signal_by_a_forged_command_line(stop_here, bystander):
    process, row = bystander
    forged = subprocess.Popen([sys.executable, "-c", LISTENER], stdout=subprocess.PIPE, text=True)
    try:
        assert forged.stdout.readline() == "listens\n"
        command = (*FORGED, str(process.pid))
        other = replace(read_process(forged.pid), command=command, name=IDLE_NAME)
        stop_here("--no-wait", table=lambda: [row, other])
        process.send_signal(signal.SIGTERM)
        assert process.stdout.readline() == f"{int(signal.SIGTERM)}\n"
    finally:
        forged.kill()
        forged.communicate()


@pytest.mark.process
@pytest.mark.further  # as in this process, for other users and environments; benchmarks/bench_stop
@pytest.mark.parametrize("situation", SITUATIONS)
def test_stop_from_other_users_and_environments(situation):
    if not can_isolate():
        pytest.skip("needs root, and namespaces of its own (unshare)")
    import stop_scenarios

    done = subprocess.run(
        isolated(sys.executable, stop_scenarios.__file__, situation, 2),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    for line in done.stdout.splitlines():
        assert json.loads(line)["wrong"] == [], line
