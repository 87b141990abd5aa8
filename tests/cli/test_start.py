"""`rigd start` as it follows a series, by the events of a daemon that is none."""

import json
import os
import signal
import socket
import struct
import sys
import threading

import pytest
import typer
import warm_start
from cases import further

from rigd.cli import start
from rigd.daemon.address import socket_path

DONE = {
    "event": "session", "part": None, "outcome": "complete", "reason": "", "scheduled": 1200,
    "recorded": 1200, "missed": 0, "late": 0, "lost": 0, "stale_angles": 0, "stale_wrenches": 0,
}  # fmt: skip


def process_at(link):
    """Number of the process at the other end of a socket."""
    size = struct.calcsize("3i")
    return struct.unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))[0]


class Client:
    """Has events to tell, and presses Ctrl-C where there is a number of times."""

    def __init__(self, interrupts, *events):
        self.interrupts = interrupts
        self.events = list(events)
        self.sent = []

    def event(self, _timeout_s):
        event = self.events.pop(0) if self.events else None
        if isinstance(event, int):
            self.interrupts.count += event
            return None
        return event

    def send(self, command):
        self.sent.append(command)


@pytest.fixture
def follow(monkeypatch):
    """Follow series 7; returns what it comes to, and what was done with lines of progress."""

    def run(*events, quick_looks=True):
        done = []

        class Line:
            def __init__(self):
                done.append("new")

            def __getattr__(self, name):
                return lambda *what, **_: done.append((name, *what[:1]))

        monkeypatch.setattr("rigd.runner.ProgressLine", Line)
        interrupts = start._Interrupts()
        client = Client(interrupts, *events)
        try:
            ended = start._follow_series(
                client, 7, interrupts, as_json=True, quick_looks=quick_looks
            )
        except typer.Exit as ending:
            ended = ending.exit_code
        return ended, done, client.sent

    return run


def progress(session):
    counts = {"tick": 1, "total": 1200, "missed": 0, "late": 0}
    return {"event": "progress", "phase": "running", "session": session, "repeat": 2} | counts


def session(number):
    return DONE | {"number": number, "path": f"out/{number}.mcap"}


def series(*numbers):
    sessions = [session(number) for number in numbers]
    return {"event": "series", "series": 7, "sessions": sessions}


def look(number, text="Quick look"):
    content = {"text": [text]}
    return {"event": "quick_look", "path": f"out/{number}.mcap", "look": content, "error": ""}


def test_no_bar_is_drawn_after_a_session_before_the_next(follow):
    events = (progress(1), session(1), progress(1), progress(2), session(2), progress(2))
    _, done, _ = follow(*events, series(1, 2), quick_looks=False)
    updates = [each[0] for each in done if each[0] == "update"]
    assert len(updates) == 2
    first = done.index(("write_message", "Complete: 1200 of 1200 samples, 0 missed, 0 late."))
    assert done[first + 1 : first + 4] == [("close",), "new", ("update", done[first + 3][1])]
    assert done[-1] == ("close",)


def test_the_last_quick_look_is_waited_for(follow):
    other = look(9)  # of somebody else's session
    ended, done, _ = follow(session(1), look(1), session(2), series(1, 2), other, look(2, "Last"))
    assert [each["look"] for each in ended["sessions"]] == [
        "out/1.look.json",
        "out/2.look.json",
    ]
    said = [each[1] for each in done if each[0] == "write_message"]
    assert said[-2:] == ["Quick look at the session; Ctrl-C skips it.", "Last"]
    assert said.count("Quick look") == 1


def test_a_quick_look_that_does_not_follow_is_not_waited_for(follow):
    first, second = (session(k) | {"look_follows": k == 1} for k in (1, 2))
    ended, done, _ = follow(first, look(1), second, series(1, 2))
    assert [each["look"] for each in ended["sessions"]] == ["out/1.look.json", None]
    assert not any("Ctrl-C skips it" in each[1] for each in done if each[0] == "write_message")


@pytest.mark.parametrize("interrupts", [(), (1,)])  # the session was stopped by a first one
def test_ctrl_c_skips_the_quick_look(follow, interrupts):
    ended, _, sent = follow(*interrupts, session(1), series(1), 1)
    assert ended["sessions"][0]["look"] is None
    assert sent == ["stop"] * len(interrupts)


def test_a_second_ctrl_c_in_a_session_leaves_it_to_the_daemon(follow):
    ended, _, sent = follow(1, 1)
    assert (ended, sent) == (130, ["stop"])


def test_what_is_notable_is_told_and_the_fit_is_in_the_document(follow):
    told = [
        {"event": "message", "level": "info", "text": text, "notable": notable}
        for text, notable in (("  8.0 s 0.910 ± 0.010 %", True), ("Next: mode 1.", False))
    ]
    told.append({"event": "message", "level": "error", "text": "Fault: no record.", "session": 1})
    fit = {"duration_s": 9.5, "modes": []}
    ended, done, _ = follow(
        *told, session(1) | {"fit": fit}, session(2), series(1, 2), quick_looks=False
    )
    said = [each[1] for each in done if each[0] == "write_message"]
    assert said[0] == "  8.0 s 0.910 ± 0.010 %"
    assert not any("Next" in each for each in said)
    assert not any("Fault" in each for each in said)  # the session's own event tells it
    assert [each.get("fit") for each in ended["sessions"]] == [fit, None]


@pytest.fixture
def interrupting_daemon(runtime_folder):
    """A daemon that keeps a start waiting, and presses Ctrl-C once it has it; what it heard."""
    path = socket_path("sim")
    path.parent.mkdir(exist_ok=True)
    heard = []
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
                    heard.append(command)
                    if command == "start":
                        os.kill(process_at(link), signal.SIGINT)
                        continue
                    told = {"daemon": {"what_moves": "No hardware."}, "stopping": False}
                    file.write(json.dumps({"reply": command, "ok": True, **told}) + "\n")
                    file.flush()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield heard
    listener.shutdown(socket.SHUT_RDWR)  # which wakes the thread
    thread.join(10.0)
    listener.close()


@pytest.mark.process
@pytest.mark.parametrize("options", [(), further(("--detach",))])
def test_ctrl_c_cancels_a_start_that_waits(interrupting_daemon, options):
    done = warm_start.run(
        [sys.executable, "-m", "rigd", "start", "hold", "--profile", "sim", *options],
        check=False,
        capture_output=True,
        text=True,
        timeout=50.0,
    )
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "No hardware.\nStopped before the session began.\n"
    assert interrupting_daemon[-2:] == ["start", "stop"]
