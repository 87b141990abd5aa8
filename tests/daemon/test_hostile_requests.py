"""Requests that are made to exhaust the daemon's memory or time."""

import contextlib
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from processes import eventually

from rigd.daemon.address import socket_path
from rigd.runtime.addresses import socket_answers

pytestmark = pytest.mark.process

MOST_GROWTH_MB = 15
LONGEST = 65_536


@pytest.fixture
def daemon(runtime_folder, write_profile, tmp_path):
    """A daemon in a process of its own, ready."""
    profile = write_profile("sim", patient=True)
    command = [sys.executable, "-m", "rigd", "serve", "--profile", profile, "--fast", "--no-look"]
    process = subprocess.Popen(
        [*map(str, command), "--output", str(tmp_path / "out")], stderr=subprocess.DEVNULL
    )
    try:
        assert eventually(lambda: socket_answers(socket_path("sim")))
        assert eventually(lambda: send_request({"command": "status"})["state"] == "ready")
        yield process
    finally:
        process.terminate()
        process.wait(60)


def send_request(document):
    """Send a line (bytes unchanged); return the reply, or None if the link is closed."""
    line = document if isinstance(document, bytes) else json.dumps(document).encode()
    with socket.socket(socket.AF_UNIX) as link:
        link.settimeout(60)
        link.connect(str(socket_path("sim")))
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            link.sendall(line + b"\n")
            reply = link.makefile("rb").readline()
            return json.loads(reply) if reply else None
    return None


def megabytes(process):
    status = Path(f"/proc/{process.pid}/status").read_text()
    fields = dict(line.split(":", 1) for line in status.splitlines())
    return tuple(int(fields[name].split()[0]) / 1024 for name in ("VmRSS", "VmHWM"))


LINES = (
    b"[" * (LONGEST - 10),
    b'{"command": "predict", "excitation": "chirp", "parameters": '
    + b'{"a": ' * 9000 + b"1" + b"}" * 9001,
    b'{"command": "status", "id": ' + b"9" * 5000 + b"}",
    b'{"command": "' + b"x" * 60_000 + b'"}',
    b'{"command": "start", "excitation": "chirp", "parameters": {"amplitude_rad": 1e-308}}',
    b'{"command": "start", "excitation": "multisine", "parameters": {"period_s": 1e-308}}',
    b'{"command": "start", "excitation": "until", "parameters": {"targets": "1=1e-308"}}',
    b"x" * 5_000_000,
    b"\0" * 60_000,
    b"\xff" * 60_000,
)  # fmt: skip


def files(folder):
    """Yield requests that name files: a pipe, an endless one, a long reference out of range."""
    pipe, heavy = folder / "pipe", folder / "heavy.csv"
    os.mkfifo(pipe)
    heavy.write_bytes(b"0.5\n" * 400_000)
    for kind, path in (("file", pipe), ("modes", "/dev/zero"), ("file", heavy)):
        yield {"command": "start", "excitation": kind, "parameters": {"path": str(path)}}


@pytest.mark.further  # tests/daemon and tests/recovery test the refusals one by one
def test_memory_is_bounded_and_other_clients_are_answered(daemon, tmp_path):
    requests = list(files(tmp_path))
    for line in LINES:
        send_request(line)
    before, _ = megabytes(daemon)
    for line in LINES * 5:
        reply = send_request(line)
        assert reply is None or not reply["ok"]
    crowd = [socket.socket(socket.AF_UNIX) for _ in range(100)]
    for link in crowd:
        link.settimeout(10)
        with contextlib.suppress(OSError):
            link.connect(str(socket_path("sim")))
            link.sendall(b"{" * 1000)
    for link in crowd:
        link.close()
    with socket.socket(socket.AF_UNIX) as busy:
        busy.connect(str(socket_path("sim")))
        for request in requests:
            busy.sendall(json.dumps(request).encode() + b"\n")
            # While it plans, another client is answered.
            assert send_request({"command": "status"})["ok"]
            reply = json.loads(busy.makefile("rb").readline())
            assert not reply["ok"]
            assert len(json.dumps(reply)) < 10_000
    after, most = megabytes(daemon)
    assert after < before + MOST_GROWTH_MB
    assert most < before + 2 * MOST_GROWTH_MB
