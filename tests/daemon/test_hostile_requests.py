"""Requests to the daemon that are made to take its memory or time: it stays as it was."""

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
from rigd.runtime.addresses import answers

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
        assert eventually(lambda: answers(socket_path("sim")))
        assert eventually(lambda: ask({"command": "status"})["state"] == "ready")
        yield process
    finally:
        process.terminate()
        process.wait(60)


def ask(request):
    """Send a line, of bytes as they are; return the reply, None where the link is closed."""
    line = request if isinstance(request, bytes) else json.dumps(request).encode()
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
    """Yield requests that name files: a pipe, what never ends, a long reference out of range."""
    pipe, heavy = folder / "pipe", folder / "heavy.csv"
    os.mkfifo(pipe)
    heavy.write_bytes(b"0.5\n" * 400_000)
    for kind, path in (("file", pipe), ("modes", "/dev/zero"), ("file", heavy)):
        yield {"command": "start", "excitation": kind, "parameters": {"path": str(path)}}


@pytest.mark.further  # what it refuses is tried one by one in tests/daemon and tests/recovery
def test_its_memory_stays_and_it_answers_others(daemon, tmp_path):
    requests = list(files(tmp_path))
    for line in LINES:
        ask(line)
    held, _ = megabytes(daemon)
    for line in LINES * 5:
        reply = ask(line)
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
            assert ask({"command": "status"})["ok"]
            reply = json.loads(busy.makefile("rb").readline())
            assert not reply["ok"]
            assert len(json.dumps(reply)) < 10_000
    after, most = megabytes(daemon)
    assert after < held + MOST_GROWTH_MB
    assert most < held + 2 * MOST_GROWTH_MB
