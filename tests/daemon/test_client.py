"""A client of a daemon that has too many clients, is suspended, or has ended."""

import json
import os
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from rigd.daemon import client as client_module
from rigd.daemon.client import (
    Client,
    DaemonUnreachableError,
    RefusedByDaemonError,
    await_series_end,
    stop_session,
)
from rigd.runtime import STOP_SIGNAL

CROWDED = {"reply": None, "ok": False, "error": "too many", "wrong_use": False, "crowded": True}


@pytest.fixture
def path(runtime_folder):
    return runtime_folder / "fake.daemon"


@pytest.fixture
def start_answering(path):
    """Answer the first line of each connection; None: close without a reply."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    received = []

    def begin(*replies):
        listener.listen(5)

        def work():
            for reply in replies:
                try:
                    link, _ = listener.accept()
                except OSError:  # the test is over
                    return
                with link, link.makefile("rw") as file:
                    received.append(json.loads(file.readline()))
                    if reply is not None:
                        file.write(json.dumps(reply) + "\n")
                        file.flush()

        threading.Thread(target=work, daemon=True).start()
        return received

    yield begin
    listener.shutdown(socket.SHUT_RDWR)  # which wakes the thread that accepts connections
    listener.close()


def test_client_repeats_a_request_after_too_many_clients(path, start_answering):
    received = start_answering(CROWDED, CROWDED, {"reply": "status", "ok": True})
    with Client(path) as client:
        assert client.ask("status")["ok"]
    assert [request["command"] for request in received] == ["status"] * 3


def test_too_many_clients_is_reported_after_a_timeout(path, start_answering, monkeypatch):
    monkeypatch.setattr(client_module, "_TOO_MANY_CLIENTS_TIMEOUT_S", 0.0)
    start_answering(CROWDED, CROWDED)
    with Client(path) as client, pytest.raises(RefusedByDaemonError, match="too many"):
        client.ask("start")


def test_refused_request_is_not_repeated(path, start_answering):
    received = start_answering(CROWDED | {"crowded": False}, {"reply": "tare", "ok": True})
    with Client(path) as client, pytest.raises(RefusedByDaemonError, match="too many"):
        client.ask("tare")
    assert len(received) == 1


def test_stop_is_repeated_until_it_is_answered(path, start_answering):
    received = start_answering(None, CROWDED, None, {"reply": "stop", "ok": True, "stopping": True})
    reply = stop_session(path)
    assert (reply["stopping"], reply["signalled"]) == (True, False)
    assert [request["command"] for request in received] == ["stop"] * 4


def test_wait_for_a_full_queue_is_limited(path):
    with socket.socket(socket.AF_UNIX) as listener, socket.socket(socket.AF_UNIX) as first:
        listener.bind(str(path))
        listener.listen(0)
        first.connect(str(path))
        with pytest.raises(DaemonUnreachableError, match=r"suspended.*may still be running.*STO"):
            Client(path, connect_timeout_s=0.05)


UNRESPONSIVE_PROGRAM = """
import signal, socket, sys, time
link = socket.socket(socket.AF_UNIX)
link.bind(sys.argv[1])
signal.signal(signal.SIGUSR1, lambda *_: print("asked to stop", flush=True))
link.listen(5)
print("listens", flush=True)
time.sleep(60.0)
time.sleep(60.0)
"""


@pytest.fixture
def unresponsive_daemon(path):
    """A daemon whose socket nobody serves; without `handles`, its signal is ignored too."""
    started = []

    def start(*, handles=True):
        code = (
            UNRESPONSIVE_PROGRAM
            if handles
            else UNRESPONSIVE_PROGRAM.replace("signal.signal(", "(lambda *_: None)(")
        )
        process = subprocess.Popen(
            [sys.executable, "-c", code, path], stdout=subprocess.PIPE, text=True
        )
        started.append(process)
        assert process.stdout.readline() == "listens\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def short_timeouts(monkeypatch):
    """Set time-outs shorter than a daemon without processor time would need."""
    for name, time_s in (
        ("_STOP_TIMEOUT_S", 0.2),
        ("_FIRST_STOP_REPLY_TIMEOUT_S", 0.05),
        ("_STOP_SIGNAL_DELAY_S", 0.05),
        ("_PROCESS_END_TIMEOUT_S", 0.1),
    ):
        monkeypatch.setattr(client_module, name, time_s)


@pytest.mark.process
def test_unresponsive_daemon_gets_a_signal_without_claim_of_success(
    path, unresponsive_daemon, short_timeouts
):
    process = unresponsive_daemon()
    with pytest.raises(DaemonUnreachableError) as raised:
        stop_session(path)
    assert process.stdout.readline() == "asked to stop\n"
    message = raised.value.full_message()
    assert f"process {process.pid}" in message
    assert STOP_SIGNAL.name in message
    assert "may still be running" in message
    assert "STO" in message


@pytest.mark.process
def test_no_signal_to_a_process_without_handler(path, unresponsive_daemon, short_timeouts):
    process = unresponsive_daemon(handles=False)
    with pytest.raises(DaemonUnreachableError) as raised:
        stop_session(path)
    assert process.poll() is None
    assert "though it runs" in raised.value.full_message()


@pytest.fixture
def ended_pid():
    """The number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.mark.process
def test_remaining_processes_of_a_dead_daemon_are_reported(ended_pid, monkeypatch):
    assert (
        "Its control process, which alone moves the motor, has ended"
        in client_module.describe_remaining_processes(ended_pid, os.getuid())
    )
    monkeypatch.setattr(client_module, "_PROCESS_END_TIMEOUT_S", 0.3)
    control = subprocess.Popen(
        [sys.executable, "-m", "rigd.engine.control_process", str(ended_pid)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    try:
        while not Path(f"/proc/{control.pid}/cmdline").read_bytes():
            time.sleep(0.001)  # its program is being loaded, and has no arguments yet
        message = client_module.describe_remaining_processes(ended_pid, os.getuid())
        assert f"control process {control.pid} still runs" in message
        assert "STO" in message
    finally:
        control.kill()
        control.communicate()
    assert "may still be running" in client_module.describe_remaining_processes(
        os.getpid(), os.getuid()
    )


@pytest.mark.process
def test_zombie_process_counts_as_ended():
    process = subprocess.Popen([sys.executable, "-c", ""])
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    assert "The daemon is gone." in client_module.describe_remaining_processes(
        process.pid, os.getuid()
    )
    process.wait()


@pytest.mark.parametrize(
    "last",
    [
        {"state": "ready", "series": {"running": False}},
        {"state": "ready", "doing": "planning", "series": {"running": True, "stopped": True}},
    ],
)
def test_await_end_waits_for_the_last_state(path, last):
    states = [
        {"state": "running", "series": {"running": True}},
        {"state": "stopping", "series": {"running": True}},
        {"state": "ready", "doing": "planning", "series": {"running": True, "stopped": False}},
        last,
    ]
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen(5)

    def work():
        link, _ = listener.accept()
        with link, link.makefile("rw") as file:
            for state in states:
                file.readline()
                file.write(json.dumps({"reply": "status", "ok": True, **state}) + "\n")
                file.flush()
            file.readline()

    threading.Thread(target=work, daemon=True).start()
    status = await_series_end(path, 30.0)
    assert status is not None
    assert status["state"] == "ready"
    listener.close()


def test_await_end_claims_nothing_without_a_status(path, monkeypatch):
    """The client reports neither that the session has ended nor that it continues."""
    monkeypatch.setattr(client_module, "_RETRY_PAUSE_S", 0.01)
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen(5)
    full = {"reply": None, "ok": False, "error": "There are too many clients.", "crowded": True}
    crowded = threading.Event()
    crowded.set()

    def work():
        with suppress(OSError):
            while True:
                link, _ = listener.accept()
                if crowded.is_set():
                    with link:
                        link.sendall(json.dumps(full).encode() + b"\n")
                else:
                    links.append(link)

    links = []
    threading.Thread(target=work, daemon=True).start()
    began_s = time.monotonic()
    assert await_series_end(path, 0.1) is None
    crowded.clear()
    with pytest.raises(DaemonUnreachableError, match="may still be running"):
        await_series_end(path, 0.1)
    assert time.monotonic() - began_s < 30.0  # and not the minute of other answers
    listener.close()
