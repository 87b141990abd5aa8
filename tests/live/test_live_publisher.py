"""The publisher as the supervisor sees it: one line, loopback only, and never in the way."""

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from rigd.engine.board import Board
from rigd.engine.ring import shared_memory_fd
from rigd.live.job import LiveJob

LOOPBACK = "0100007F"  # 127.0.0.1 as /proc/net/tcp writes it
LISTENING = "0A"


def sockets(pid: int) -> list[tuple[str, str, str]]:
    """Return (local, remote, state) of each TCP socket that a process has open."""
    inodes = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        try:
            target = str(descriptor.readlink())
        except FileNotFoundError:
            continue
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    found = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[9] in inodes:
                found.append((words[1], words[2], words[3]))
    return found


def page(publisher) -> str:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(publisher.answer["url"], timeout=30.0) as response:
        return response.read().decode()


def accepts(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=30.0).close()
    except OSError:
        return False
    return True


def settled(path: Path) -> bool:
    """Whether a file has stopped growing: looked at often, as a sleep may be one of the machine."""
    sizes = []
    for _ in range(8):
        sizes.append(path.stat().st_size)
        time.sleep(0.1)
    return len(set(sizes)) == 1


def receive(rerun_program, publisher, producer, path: Path, enough_bytes: int, eventually):
    """Have Rerun itself save what the server sends; return the saved columns by entity."""
    from rerun.chunk import RrdReader

    saver = subprocess.Popen(
        [rerun_program, publisher.proxy_url, "--save", path, "--bind", "127.0.0.1", "--port", "0"],
        env={**os.environ, "CI": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        assert eventually(lambda: path.exists() and path.stat().st_size > enough_bytes)
        # What is on its way when the server goes is lost: let everything arrive first.
        producer.stop()
        assert eventually(lambda: settled(path))
        # It completes the file when the server goes away.
        publisher.end()
        assert saver.wait(60.0) == 0
    finally:
        saver.kill()
        saver.wait()
    reader = RrdReader(path)
    columns: dict[str, list[np.ndarray]] = {}
    for chunk in reader.stream():
        if "session_time" in chunk.timeline_names:
            batch = chunk.to_record_batch()
            time_ns = batch.column("session_time").cast("int64").to_numpy()
            values = np.array(batch.column("Scalars:scalars").to_pylist())
            columns.setdefault(chunk.entity_path, []).append(np.column_stack([time_ns, values]))
    (recording,) = reader.recordings()
    return recording, {entity: np.concatenate(blocks) for entity, blocks in columns.items()}


def test_first_line_is_the_address_of_a_viewer(publisher):
    assert set(publisher.answer) == {"url"}
    assert publisher.answer["url"].startswith("http://127.0.0.1:")
    assert "rerun" in page(publisher).lower()
    assert all(accepts(port) for port in publisher.ports)


def test_nothing_is_open_beyond_loopback(publisher, eventually):
    assert eventually(lambda: page(publisher))
    every = sockets(publisher.process.pid) + sockets(publisher.server_pid)
    listening = {local for local, _, state in every if state == LISTENING}
    assert listening == {f"{LOOPBACK}:{port:04X}" for port in publisher.ports}
    ends = {end.split(":")[0] for local, remote, state in every for end in (local, remote)}
    assert ends == {LOOPBACK, "00000000"}  # the latter is the far end of a listening socket


def test_every_sample_arrives_in_the_units_of_the_plots(
    publisher, producer, rerun_program, tmp_path, eventually
):
    recording, columns = receive(
        rerun_program, publisher, producer, tmp_path / "live.rrd", 300_000, eventually
    )
    assert recording.application_id == "rigd"
    angle = columns["/angle_mrad"]
    time_s = angle[:, 0] * 1e-9
    assert len(angle) > 500
    assert angle[-1, 0] == (producer.tick - 1) * 1_000_000  # up to the last that was made
    assert np.all(np.diff(angle[:, 0]) == 1_000_000)  # none missing, none twice
    reference_rad = 0.025 * np.sin(2.0 * np.pi * (0.5 * time_s + 0.1 * time_s**2))
    assert angle[:, 1] == pytest.approx(1e3 * reference_rad, abs=1e-9)
    error = columns["/tracking_error_mrad"]
    assert error[:, 1] == pytest.approx(angle[:, 1] - angle[:, 2], abs=1e-9)
    torque = columns["/coupling_torque_nm"]
    assert torque[:, 1] == pytest.approx(0.05 * np.sin(14.0 * np.pi * time_s), abs=1e-9)
    command = columns["/torque_command_nm"]
    assert command[:, 1] == pytest.approx(0.2 * np.cos(3.0 * time_s), abs=1e-9)
    lateness = columns["/loop_lateness_us"]
    assert lateness[:, 1] == pytest.approx(40.0 + np.round(time_s * 1e3) % 60, abs=1e-9)
    assert publisher.dropped == 0
    assert producer.refused == 0


def test_ends_with_its_input_and_takes_the_server_along(publisher, gone):
    server = publisher.server_pid
    assert publisher.end() == (0, "", "")
    assert gone(server)
    assert not any(accepts(port) for port in publisher.ports)


def test_stays_open_for_as_long_as_asked(start_publisher):
    publisher = start_publisher(linger_s=2.5)
    publisher.process.stdin.close()
    with pytest.raises(subprocess.TimeoutExpired):
        publisher.process.wait(0.2)
    assert page(publisher)
    assert publisher.process.wait(60.0) == 0


def test_interrupt_is_the_supervisors_business(publisher, gone):
    server = publisher.server_pid
    for pid in (publisher.process.pid, server):
        os.kill(pid, signal.SIGINT)
    time.sleep(0.3)
    assert publisher.process.poll() is None
    assert not gone(server)


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_publisher_leaves_no_server(publisher, gone, eventually, end):
    server = publisher.server_pid
    publisher.process.send_signal(end)
    assert eventually(lambda: gone(server))


def test_ends_when_its_parent_dies_though_its_input_stays_open(
    producer, send_job, gone, eventually
):
    board = Board.create(shared_memory_fd())
    fds = (producer.ring.spec.fd, board.fd)
    middle = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import os, subprocess, sys; child = subprocess.Popen("
            "[sys.executable, '-m', 'rigd.live.publisher', str(os.getpid())], stdin=0, stdout=1, "
            f"pass_fds={fds}); sys.stderr.write(f'{{child.pid}}\\n'); child.wait()",
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        pass_fds=fds,
    )
    with middle:
        pid = int(middle.stderr.readline())
        job = LiveJob(producer.ring.spec, board.fd, "orphan", 1000.0, linger_s=60.0)
        send_job(middle.stdin, job)
        assert b"url" in middle.stdout.readline()
        (server,) = map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())
        middle.kill()
        assert eventually(lambda: gone(pid) and gone(server))
    board.close()
    os.close(board.fd)


def test_a_frozen_server_is_waited_for_by_nobody(start_producer, start_publisher, gone, eventually):
    producer = start_producer(speed=8.0)
    publisher = start_publisher(producer.ring)
    server = publisher.server_pid
    os.kill(server, signal.SIGSTOP)
    assert eventually(lambda: publisher.dropped > 1000), "what cannot be shown is counted"
    os.kill(server, signal.SIGCONT)
    dropped = -1

    def goes_on() -> bool:
        nonlocal dropped
        before, dropped = dropped, publisher.dropped
        time.sleep(0.3)
        return dropped == before

    assert eventually(goes_on)
    os.kill(server, signal.SIGSTOP)
    assert eventually(lambda: publisher.dropped > dropped + 500)
    code, more, _ = publisher.end()
    assert (code, more) == (0, "")
    assert gone(server)
    assert producer.refused == 0


@pytest.mark.parametrize("frozen_first", [False, True])
def test_a_killed_server_is_replaced_where_viewers_find_it(
    start_producer, start_publisher, rerun_program, tmp_path, eventually, frozen_first
):
    producer = start_producer(speed=8.0)
    publisher = start_publisher(producer.ring)
    first = publisher.server_pid
    if frozen_first:
        os.kill(first, signal.SIGSTOP)
        assert eventually(lambda: publisher.dropped > 0)
    os.kill(first, signal.SIGKILL)
    killed_ns = producer.tick * 1_000_000
    assert eventually(lambda: publisher.server_pid not in (0, first))
    assert eventually(lambda: all(accepts(port) for port in publisher.ports))
    _, columns = receive(
        rerun_program, publisher, producer, tmp_path / "live.rrd", 100_000, eventually
    )
    assert columns["/angle_mrad"][:, 0].max() > killed_ns
    assert producer.refused == 0


def test_what_was_overwritten_before_it_was_seen_is_counted(
    start_producer, start_publisher, eventually
):
    producer = start_producer(capacity=1000)
    publisher = start_publisher(producer.ring)
    os.kill(publisher.process.pid, signal.SIGSTOP)
    behind = producer.tick
    assert eventually(lambda: producer.tick > behind + 2000)
    os.kill(publisher.process.pid, signal.SIGCONT)
    assert eventually(lambda: publisher.dropped > 0)
    assert publisher.dropped <= producer.tick
    assert producer.refused == 0


@pytest.mark.parametrize(
    ("script", "mode", "sentence"),
    [
        ("#!/bin/sh\necho no such option >&2\nexit 2\n", 0o755, "ended: no such option."),
        ("#!/bin/sh\n", 0o644, "cannot be run: Permission denied."),
    ],
)
def test_a_server_that_does_not_start_is_told_in_a_sentence(
    start_publisher, tmp_path, script, mode, sentence
):
    package = tmp_path / "rerun_cli"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "rerun").write_text(script)
    (package / "rerun").chmod(mode)
    publisher = start_publisher(PYTHONPATH=str(tmp_path))
    assert set(publisher.answer) == {"error"}
    assert publisher.answer["error"].endswith(sentence)
    assert publisher.end() == (1, "", "")


def test_no_job_means_no_work():
    publisher = subprocess.run(
        [sys.executable, "-m", "rigd.live.publisher", str(os.getpid())],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        check=True,
    )
    assert (publisher.stdout, publisher.stderr) == (b"", b"")
