"""The publisher from the supervisor's side: one message, loopback only, and no delay."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from cases import further
from online_fits import online_fit
from processes import eventually, has_ended, listeners, sockets

from rigd.engine.messages import ProcessFailed
from rigd.engine.shared_state import StateField
from rigd.live.address import LiveAddress, find
from rigd.live.messages import LiveFit, LiveJob
from rigd.live.publisher import RerunError, main

pytestmark = pytest.mark.process

LOOPBACK = "0100007F"  # 127.0.0.1 as /proc/net/tcp writes it
SHORT_QUEUE = "from rigd.live import publisher; publisher._MAX_QUEUED_SAMPLES_S = 1.0"


def fetch(url: str):
    """Return (status, headers, text) of a page, as a browser gets it."""
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(url, timeout=30.0) as response:
        return response.status, response.headers, response.read().decode(errors="replace")


def page(publisher) -> str:
    return fetch(publisher.address.page_url)[2]


def accepts(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=30.0).close()
    except OSError:
        return False
    return True


def test_every_record_arrives_in_units_of_the_plots(received):
    columns = received["fault"]
    assert columns.application_id == "rigd"
    time_ns, angle_mrad = columns("/signals", "angle_mrad")
    time_s = time_ns * 1e-9
    assert len(time_ns) > 500
    assert time_ns[-1] == (received["ticks"] - 1) * 1_000_000  # up to the last one written
    assert np.all(np.diff(time_ns) == 1_000_000)  # none missing, none twice
    reference = 0.025 * np.sin(2.0 * np.pi * (0.5 * time_s + 0.1 * time_s**2))
    assert angle_mrad[:, 0] == pytest.approx(1e3 * reference, abs=1e-9)
    _, error_mrad = columns("/signals", "tracking_error_mrad")
    assert error_mrad[:, 0] == pytest.approx(angle_mrad[:, 0] - angle_mrad[:, 1], abs=1e-9)
    _, torque_nm = columns("/signals", "coupling_torque_nm")
    assert torque_nm[:, 0] == pytest.approx(0.05 * np.sin(14.0 * np.pi * time_s), abs=1e-9)
    _, command_nm = columns("/signals", "torque_command_nm")
    assert command_nm[:, 0] == pytest.approx(0.2 * np.cos(3.0 * time_s), abs=1e-9)
    _, loop_us = columns("/signals", "loop_us")
    assert loop_us[:, 0] == pytest.approx(40.0 + np.round(time_s * 1e3) % 60, abs=1e-9)
    age_ns, age_ms = columns("/readings", "ages_ms")
    assert np.array_equal(age_ns, time_ns)
    assert np.allclose(age_ms, [0.5, 1.5])
    _, lines = columns("/events", "TextLog:text")
    assert lines[0] == ["Record starts"]
    assert lines[-1] == ["Outcome: fault. The drive was lost."]
    health_ns, dropped = columns("/health", "backlog_samples")
    assert len(health_ns) >= 1
    assert dropped[-1, 1] == 0


@pytest.mark.further  # as in tests/view
def test_fits_are_in_the_plots_and_events(publisher, save):
    publisher.show("fitted", fitted_mode_count=2, excitation="until")
    saver = save(publisher.address)
    fits = online_fit(0.4, 2.0), online_fit(0.8)
    for fit in fits:
        publisher.send(LiveFit(fit))
    assert eventually(saver.has_begun)
    publisher.producer.stop()
    publisher.finish()
    assert eventually(saver.has_all)
    publisher.end()
    columns = saver.recordings()["recording of fitted"]
    # A connection that comes in between receives them again.
    time_ns, damping = columns("/fits", "damping_1_percent")
    last = damping[np.argmax(time_ns)]
    assert set(time_ns.tolist()) >= {400_000_000, 800_000_000}
    assert last[2:] == pytest.approx([0.91 - 0.0196, 0.91 + 0.0196, 0.91])
    _, lines = columns("/events", "TextLog:text")
    assert [fit["text"][0] in [text for (text,) in lines] for fit in fits] == [True, True]


@pytest.mark.further  # as a fit is
def test_quick_look_is_added_to_the_events(publisher, save, tmp_path):
    publisher.show("looked at", folder=tmp_path)
    saver = save(publisher.address)
    assert eventually(saver.has_begun)
    publisher.producer.stop()
    publisher.finish()
    quick_look = {"version": 1, "text": ["Quick look at it", "  mode 1\x1b[31m"]}
    (tmp_path / "looked at.look.json.new").write_text(json.dumps(quick_look))
    (tmp_path / "looked at.look.json.new").rename(tmp_path / "looked at.look.json")
    time.sleep(1.5)  # the file is polled once a second
    assert eventually(saver.has_all)
    publisher.end()
    _, lines = saver.recordings()["recording of looked at"]("/events", "TextLog:text")
    assert lines.tolist()[-2:] == [["Quick look at it"], ["  mode 1?[31m"]]


@pytest.mark.parametrize("at_once", [further(False), True])
def test_two_rigs_have_separate_views_and_leave_no_server(
    publisher, start_producer, start_publisher, at_once
):
    assert_on_loopback(publisher)
    own = publisher.ports
    # The port was free when it was checked, and taken a moment later.
    race = f"outlet.free_port = lambda _: {publisher.address.grpc_port}" if at_once else "pass"
    first = f"from rigd.live import _server as outlet; {race}"
    other = start_publisher(start_producer(), first=first)
    assert not other.ports & own
    assert all(accepts(port) for port in other.ports | own)
    # A killed publisher leaves no server, and the other one has its own.
    server = publisher.server_pid
    publisher.process.kill()
    assert eventually(lambda: has_ended(server))
    assert not has_ended(other.server_pid)
    assert_ends_with_its_input(other)


def assert_on_loopback(publisher):
    """Assert that the view is at its announced address, and that nothing else is open."""
    address = publisher.address
    assert (address.rig, address.pid) == ("rig under test", publisher.process.pid)
    assert find("rig under test") == address
    assert eventually(lambda: page(publisher))
    pids = publisher.process.pid, publisher.server_pid
    listening = {end.local for pid in pids for end in listeners(pid)}
    assert {f"{LOOPBACK}:{port:04X}" for port in publisher.ports} <= listening
    assert len(listening) == 3  # the third is that of the page's files on the server
    addresses = {address for pid in pids for end in sockets(pid) for address in end.addresses}
    assert addresses == {LOOPBACK, "00000000"}  # the latter is the far end of a listening socket


def assert_ends_with_its_input(publisher):
    """Assert that an interrupt, which the supervisor handles, does not end a publisher."""
    server = publisher.server_pid
    for number in (signal.SIGINT, signal.SIGTERM):
        os.kill(publisher.process.pid, number)
        os.kill(server, signal.SIGINT)
    time.sleep(0.3)
    assert publisher.process.poll() is None
    assert not has_ended(server)
    own = listeners(publisher.process.pid) | listeners(server)
    assert len(own) == 3
    assert publisher.end() == (0, "", "")
    assert has_ended(server)
    assert not own & listeners()


@pytest.mark.slow
def test_publisher_remains_for_the_requested_time(start_publisher):
    publisher = start_publisher(linger_s=2.5)
    began_s = time.monotonic()
    publisher.process.stdin.close()
    with pytest.raises(subprocess.TimeoutExpired):
        publisher.process.wait(0.2)
    assert page(publisher)
    assert publisher.process.wait(300.0) == 0
    assert time.monotonic() - began_s >= 2.5


@pytest.mark.further  # as when killed
def test_publisher_ends_with_its_parent(producer, send, receive_message):
    middle = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import os, subprocess, sys; child = subprocess.Popen("
            "[sys.executable, '-m', 'rigd.live.publisher', str(os.getpid())], stdin=0, stdout=1, "
            f"pass_fds={producer.fds}); sys.stderr.write(f'{{child.pid}}\\n'); child.wait()",
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        pass_fds=producer.fds,
    )
    with middle:
        pid = int(middle.stderr.readline())
        send(middle.stdin, LiveJob("orphan", producer.channels.specs, linger_s=60.0))
        assert isinstance(receive_message(middle.stdout), LiveAddress)
        (server,) = map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())
        middle.kill()
        assert eventually(lambda: has_ended(pid) and has_ended(server))
    assert find("orphan") is None, "what it left behind is told from a live view"


@pytest.mark.further  # as a suspended publisher
def test_no_wait_for_a_frozen_server(start_producer, start_publisher):
    producer = start_producer(speed=8.0)
    publisher = start_publisher(producer, first=SHORT_QUEUE)
    server = publisher.server_pid
    os.kill(server, signal.SIGSTOP)
    assert eventually(lambda: publisher.dropped > 1000), "what cannot be shown is counted"
    os.kill(server, signal.SIGCONT)
    dropped = -1

    def count_is_constant() -> bool:
        nonlocal dropped
        before, dropped = dropped, publisher.dropped
        time.sleep(0.3)
        return dropped == before

    assert eventually(count_is_constant)
    os.kill(server, signal.SIGSTOP)
    assert eventually(lambda: publisher.dropped > dropped + 500)
    code, more, _ = publisher.end()
    assert (code, more) == (0, "")
    assert has_ended(server)
    assert producer.refused == 0


@pytest.mark.slow
def test_frozen_server_is_replaced(start_producer, start_publisher, receive, own_port):
    producer = start_producer(speed=8.0)
    publisher = start_publisher(
        producer,
        first=f"from rigd.live import _feed as feed; feed._MAX_STALLED_POLLS = 20; {own_port}",
    )
    frozen = publisher.server_pid
    os.kill(frozen, signal.SIGSTOP)
    ports = publisher.ports
    assert eventually(lambda: has_ended(frozen))
    killed_ns = producer.tick * 1_000_000
    publisher.next_address()
    assert publisher.server_pid != frozen
    assert publisher.ports == ports
    (columns,) = receive(publisher)().values()
    assert columns("/signals", "angle_mrad")[0].max() > killed_ns
    assert producer.refused == 0


@pytest.mark.slow
def test_killed_frozen_server_is_replaced(start_producer, start_publisher, receive, own_port):
    producer = start_producer(speed=8.0)
    publisher = start_publisher(producer, first=f"{SHORT_QUEUE}; {own_port}")
    os.kill(publisher.server_pid, signal.SIGSTOP)
    assert eventually(lambda: publisher.dropped > 0)
    assert_replaced_when_killed(publisher, receive)


def test_server_is_replaced_after_a_kill_or_many_sessions(start_publisher, receive, own_port):
    publisher = start_publisher(first=f"{own_port}; outlet._MAX_SESSIONS_PER_SERVER = 2")
    first = publisher.address
    begins = tuple(ring.written_count for ring in publisher.producer.channels.rings)
    for name in ("second", "third"):
        publisher.show(name, begins)
    address = publisher.next_address()
    assert address.server != first.server
    assert address.grpc_port == first.grpc_port
    assert_replaced_when_killed(publisher, receive)


def assert_replaced_when_killed(publisher, receive):
    """Kill the server; check that viewers find another one, with all later samples."""
    producer, server, ports = publisher.producer, publisher.server_pid, publisher.ports
    os.kill(server, signal.SIGKILL)
    killed_ns = producer.tick * 1_000_000
    publisher.next_address()
    assert publisher.server_pid != server
    assert publisher.ports == ports
    assert all(accepts(port) for port in ports)
    (columns,) = receive(publisher)().values()
    assert columns("/signals", "angle_mrad")[0].max() > killed_ns
    assert producer.refused == 0


@pytest.mark.further  # as test_live_backlog.py
def test_overwritten_samples_are_counted(start_producer, start_publisher):
    producer = start_producer(capacity=1000, speed=8.0)
    publisher = start_publisher(producer)
    os.kill(publisher.process.pid, signal.SIGSTOP)
    behind = producer.tick
    assert eventually(lambda: producer.tick > behind + 2000)
    os.kill(publisher.process.pid, signal.SIGCONT)
    assert eventually(lambda: publisher.dropped > 0)
    assert publisher.dropped <= producer.tick
    assert producer.refused == 0


@pytest.mark.slow
def test_second_publisher_counts_only_samples_not_shown(start_producer, start_publisher):
    producer = start_producer(capacity=4000)
    first = start_publisher(producer)
    shared_state = producer.channels.shared_state
    assert eventually(lambda: producer.tick > 5000)
    producer.stop()
    assert eventually(lambda: shared_state[StateField.LIVE_SAMPLES_SEEN] == producer.tick)
    before = producer.dropped
    first.process.kill()
    first.process.wait()
    producer.write_more(3000)
    second = start_publisher(producer)
    assert eventually(lambda: shared_state[StateField.LIVE_SAMPLES_SEEN] == producer.tick)
    # An observer reads half of what a ring has; the half before it is gone.
    assert second.dropped == before + 3000 - 4000 // 2


@pytest.mark.parametrize(
    ("script", "mode", "sentence"),
    [
        ("#!/bin/sh\necho no such option >&2\nexit 2\n", 0o755, "ended: no such option."),
        ("#!/bin/sh\n", 0o644, "cannot be run: Permission denied."),
    ],
)
@pytest.mark.further  # as test_live_address.py
def test_error_message_if_the_server_does_not_start(
    start_publisher, tmp_path, script, mode, sentence
):
    package = tmp_path / "rerun_cli"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "rerun").write_text(script)
    (package / "rerun").chmod(mode)
    publisher = start_publisher(PYTHONPATH=str(tmp_path))
    assert isinstance(publisher.answer, ProcessFailed)
    assert publisher.answer.reason.endswith(sentence)
    assert publisher.end() == (1, "", "")


def test_supervisor_receives_the_reason_without_a_view(monkeypatch):
    sent = []
    job = SimpleNamespace(channels=None, rig="sim")
    parent = SimpleNamespace(receive_job=lambda: job, send=sent.append)

    def fail(_):
        raise RerunError("The Rerun server ended.")

    for name, stub in {
        "signal": Mock(), "ignore_signals": Mock(), "prepare_sdk_environment": Mock(),
        "attach_channels": Mock(), "SupervisorConnection": lambda: parent, "RerunServer": fail,
    }.items():  # fmt: skip
        monkeypatch.setattr(f"rigd.live.publisher.{name}", stub)
    with pytest.raises(SystemExit, match="1"):
        main()
    assert sent == [ProcessFailed("The Rerun server ended.")]


def test_publisher_ends_without_a_job():
    publisher = subprocess.run(
        [sys.executable, "-m", "rigd.live.publisher", str(os.getpid())],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        check=True,
    )
    assert (publisher.stdout, publisher.stderr) == (b"", b"")
