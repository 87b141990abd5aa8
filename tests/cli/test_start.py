"""`rigd start` follows a series, by the events of a fake daemon."""

import contextlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import typer
import warm_start
from cases import further

from rigd.cli import start
from rigd.daemon.address import socket_path
from rigd.daemon.client import DaemonUnreachableError

COMPLETE = {
    "event": "session", "part": None, "outcome": "complete", "reason": "", "scheduled": 1200,
    "recorded": 1200, "missed": 0, "late": 0, "lost": 0, "stale_angles": 0, "stale_wrenches": 0,
}  # fmt: skip


def process_at(link):
    """Return the PID of the process at the other end of a socket."""
    size = struct.calcsize("3i")
    return struct.unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))[0]


class Client:
    """Client that returns events; a number among them is a number of presses of Ctrl-C.

    An error among them is raised.
    """

    def __init__(self, press, *events):
        self.press = press
        self.events = list(events)
        self.sent = []

    def next_event(self, _timeout_s):
        event = self.events.pop(0) if self.events else None
        if isinstance(event, int):
            for _ in range(event):
                self.press()
            return None
        if isinstance(event, Exception):
            raise event
        return event

    def send(self, command):
        self.sent.append(command)


@pytest.fixture
def follow(monkeypatch):
    """Follow series 7; return its end, the calls of progress lines, and the commands sent."""

    def run(*events, quick_looks=True):
        calls = []

        class Line:
            def __init__(self):
                calls.append("new")

            def __getattr__(self, name):
                return lambda *arguments, **_: calls.append((name, *arguments[:1]))

        monkeypatch.setattr("rigd.runner.ProgressLine", Line)
        interrupts = start._InterruptCounter()
        client, results = Client(interrupts.add_press, *events), []
        try:
            ended = start._follow_series(
                client, 7, interrupts, results, as_json=True, makes_quick_looks=quick_looks
            ) | {"sessions": results}
        except typer.Exit as ending:
            ended = ending.exit_code
        return ended, calls, client.sent

    return run


def progress(session):
    counts = {"tick": 1, "total": 1200, "missed": 0, "late": 0}
    return {"event": "progress", "phase": "running", "session": session, "repeat": 2} | counts


def session(number):
    return COMPLETE | {"number": number, "path": f"out/{number}.mcap"}


def series(*numbers):
    sessions = [session(number) for number in numbers]
    return {"event": "series", "series": 7, "sessions": sessions}


def quick_look(number, text="Quick look"):
    content = {"text": [text]}
    return {"event": "quick_look", "path": f"out/{number}.mcap", "look": content, "error": ""}


def test_no_bar_between_two_sessions(follow):
    events = (progress(1), session(1), progress(1), progress(2), session(2), progress(2))
    _, calls, _ = follow(*events, series(1, 2), quick_looks=False)
    updates = [each[0] for each in calls if each[0] == "update"]
    assert len(updates) == 2
    first = calls.index(("write_message", "Complete: 1200 of 1200 samples, 0 missed, 0 late."))
    assert calls[first + 1 : first + 4] == [("close",), "new", ("update", calls[first + 3][1])]
    assert calls[-1] == ("close",)


def test_wait_for_the_last_quick_look(follow):
    other = quick_look(9)  # of another session
    ended, calls, _ = follow(
        session(1), quick_look(1), session(2), series(1, 2), other, quick_look(2, "Last")
    )
    assert [each["look"] for each in ended["sessions"]] == [
        "out/1.look.json",
        "out/2.look.json",
    ]
    messages = [each[1] for each in calls if each[0] == "write_message"]
    assert messages[-2:] == ["Quick look at the session; Ctrl-C skips it.", "Last"]
    assert messages.count("Quick look") == 1


def test_no_wait_if_no_quick_look_follows(follow):
    first, second = (session(k) | {"look_follows": k == 1} for k in (1, 2))
    ended, calls, _ = follow(first, quick_look(1), second, series(1, 2))
    assert [each["look"] for each in ended["sessions"]] == ["out/1.look.json", None]
    assert not any("Ctrl-C skips it" in each[1] for each in calls if each[0] == "write_message")


@pytest.mark.parametrize("interrupts", [(), (1,)])  # the session was stopped by a first one
def test_ctrl_c_skips_the_quick_look(follow, interrupts):
    ended, _, sent = follow(*interrupts, session(1), series(1), 1)
    assert ended["sessions"][0]["look"] is None
    assert sent == ["stop"] * len(interrupts)


def test_quick_look_that_takes_long_is_announced(follow, monkeypatch):
    monkeypatch.setattr(start, "_QUICK_LOOK_TIMEOUT_S", 0.0)
    ended, calls, _ = follow(session(1), session(2), quick_look(1), series(1, 2))
    assert ended["sessions"][1]["look"] is None
    announcement = "No quick look yet: the daemon still makes it; it will be out/2.look.json."
    assert [each[1] for each in calls if each[0] == "write_message"][-1] == announcement
    assert len([each for each in calls if "No quick look" in each[-1]]) == 1


def test_quick_look_that_ends_with_the_daemon(follow):
    lost = DaemonUnreachableError("The connection to the daemon is lost.")
    ended, calls, _ = follow(session(1), series(1), lost)
    assert ended["sessions"][0]["look"] is None
    assert ("write_message", "No quick look: the connection to the daemon is lost.") in calls
    with pytest.raises(DaemonUnreachableError):
        follow(session(1), lost)


def test_second_ctrl_c_leaves_the_session_to_the_daemon(follow):
    ended, _, sent = follow(1, 1)
    assert (ended, sent) == (130, ["stop"])


@pytest.mark.parametrize(
    ("ending", "code"),
    [((2,), 130), ((DaemonUnreachableError("The connection to the daemon is lost."),), 1)],
)
def test_json_has_the_sessions_before_an_early_end(rigd_here, monkeypatch, ending, code):
    client = Client(lambda: signal.raise_signal(signal.SIGINT), session(1), *ending)
    client.ask = lambda _: {"daemon": {"what_moves": "No hardware."}}
    client.request_unless_stopped = lambda *_, **__: {"reply": "start", "series": 7, "plan": PLAN}
    monkeypatch.setattr(start, "daemon_client", lambda _: contextlib.nullcontext(client))
    done = rigd_here("start", "hold", "--repeat", "3", "--json")
    assert done.returncode == code
    (result,) = json.loads(done.stdout)["sessions"]
    assert (result["path"], result["outcome"], result["look"]) == ("out/1.mcap", "complete", None)


def test_notable_messages_are_printed_and_the_fit_is_returned(follow):
    events = [
        {"event": "message", "level": "info", "text": text, "notable": notable}
        for text, notable in (("  8.0 s 0.910 ± 0.010 %", True), ("Next: mode 1.", False))
    ]
    events.append({"event": "message", "level": "error", "text": "Fault: no record.", "session": 1})
    fit = {"duration_s": 9.5, "modes": []}
    ended, calls, _ = follow(
        *events, session(1) | {"fit": fit}, session(2), series(1, 2), quick_looks=False
    )
    messages = [each[1] for each in calls if each[0] == "write_message"]
    assert messages[0] == "  8.0 s 0.910 ± 0.010 %"
    assert not any("Next" in each for each in messages)
    assert not any("Fault" in each for each in messages)  # the session's own event has it
    assert [each.get("fit") for each in ended["sessions"]] == [fit, None]


PLAN = {
    "excitation": "hold", "record_s": 1.2, "peak_angle_rad": 0.0, "peak_velocity_rad_s": 0.0,
    "peak_torque_nm": 0.0, "warnings": ["A torque will be clipped."],
}  # fmt: skip


@pytest.fixture
def fake_daemon(runtime_folder):
    """A daemon that sends events after a start; without events, it sends Ctrl-C, and no reply.

    Yields the received commands and the events.
    """
    path = socket_path("sim")
    path.parent.mkdir(exist_ok=True)
    received, events = [], []
    listener = socket.create_server(str(path), family=socket.AF_UNIX)

    def serve():
        while True:
            try:
                link, _ = listener.accept()
            except OSError:  # the test is over
                return
            with link, link.makefile("rw") as file:
                for line in file:
                    command = json.loads(line)["command"]
                    received.append(command)
                    if command == "start" and not events:
                        os.kill(process_at(link), signal.SIGINT)
                        continue
                    status = {"daemon": {"what_moves": "No hardware."}, "stopping": False}
                    status |= {"series": 7, "plan": PLAN}
                    replies = [{"reply": command, "ok": True, **status}]
                    replies += events if command == "start" else []
                    file.writelines(json.dumps(reply) + "\n" for reply in replies)
                    file.flush()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield received, events
    listener.shutdown(socket.SHUT_RDWR)  # which wakes the thread
    thread.join(10.0)
    listener.close()


def start_hold(*options, stdout=subprocess.PIPE):
    return warm_start.run(
        [sys.executable, "-m", "rigd", "start", "hold", "--profile", "sim", *options],
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        timeout=50.0,
    )


@pytest.mark.process
@pytest.mark.parametrize(
    ("options", "output"), [(("--json",), '{"sessions": []}\n'), further(("--detach",), "")]
)
def test_ctrl_c_cancels_a_waiting_start(fake_daemon, options, output):
    received, _ = fake_daemon
    completed = start_hold(*options)
    assert (completed.returncode, completed.stdout) == (130, output)
    assert completed.stderr == "No hardware.\nStopped before the session began.\n"
    assert received[-2:] == ["start", "stop"]


@pytest.mark.process
def test_series_is_followed_although_the_output_cannot_be_written(fake_daemon):
    _, events = fake_daemon
    events += [session(1), session(2), series(1, 2) | {"failed": False, "stopped": False}]
    with Path("/dev/full").open("w") as full:
        completed = start_hold(stdout=full)
        assert completed.returncode == 0
        assert completed.stderr.count("Complete: 1200 of 1200 samples") == 2
        completed = start_hold("--detach", stdout=full)
    assert completed.returncode == 1
    assert "Error: Running, but the output cannot be written" in completed.stderr


@pytest.mark.process
def test_detached_start_with_json_shows_the_warnings_of_the_plan(fake_daemon):
    _, events = fake_daemon
    events.append(series() | {"failed": False, "stopped": False})
    completed = start_hold("--detach", "--json")
    assert json.loads(completed.stdout) == {"series": 7}
    assert "Warning: A torque will be clipped.\n" in completed.stderr


@pytest.mark.process
def test_series_that_was_stopped_between_two_sessions(fake_daemon):
    _, events = fake_daemon
    reason = "Stopped after 1 of 3 sessions."
    events += [session(1), series(1) | {"failed": False, "stopped": True, "reason": reason}]
    completed = start_hold("--repeat", "3")
    assert completed.returncode == 130
    assert completed.stderr.endswith(f"\n{reason}\n")
