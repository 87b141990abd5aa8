"""The page's server in front of a daemon that only records requests, and the real daemon."""

import asyncio
import contextlib
import json
import os
import signal
import socket
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
import warm_start
from processes import eventually

from rigd.daemon import page_address
from rigd.daemon._page import _page_job
from rigd.profile import load_profile
from rigd.web import _access, _jobs, _library, _live, _server

_RIGD = Path(sys.executable).parent / "rigd"
TOKEN = "the-right-one"
ACTING = ("start", "tare", "zero", "reset", "check")
STATUS = {
    "daemon": {"pid": 1, "profile": "sim"},
    "state": "ready",
    "since_utc_ns": 0,
    "reason": "",
    "doing": "",
    "controller": None,
    "series": None,
    "progress": None,
    "rig": None,
    "history": [],
}


class FakeDaemon:
    """A socket that answers as the daemon does, and executes nothing."""

    def __init__(self):
        self.requests = []
        self.status = dict(STATUS)
        self.replies = {}
        self.delays = {}
        """Commands that are answered only after an event, by name."""
        self.watchers = []
        self.connected = set()
        self.silent = False

    @property
    def acted(self):
        return [each for each in self.requests if each["command"] in ACTING]

    async def serve(self, reader, writer):
        self.connected.add(writer)
        with contextlib.suppress(ConnectionError):
            while line := await reader.readline():
                request = json.loads(line)
                command = request["command"]
                self.requests.append(request)
                if command == "watch":
                    self.watchers.append(writer)
                if self.silent:
                    continue
                if command in self.delays:
                    await self.delays[command].wait()
                reply = {"reply": command, "ok": True} | self.replies.get(command, {})
                self._send(writer, self.status | reply if command == "status" else reply)
        self.connected.discard(writer)
        writer.close()

    def _send(self, writer, document):
        writer.write(json.dumps(document).encode() + b"\n")

    def publish(self, event):
        for writer in self.watchers:
            self._send(writer, event)


class Requests:
    """Requests to a page's server, byte by byte; it has a `port`."""

    timeout_s = 30.0

    def connect(self):
        return socket.create_connection(("127.0.0.1", self.port), self.timeout_s)

    def send(self, data):
        """Send bytes; return the answer, to the end of the connection or of the answer."""
        with self.connect() as link:
            with contextlib.suppress(ConnectionError):  # it may be closed before all is sent
                for block in [data] if isinstance(data, bytes) else data:
                    link.sendall(block)
            answer = b""
            with contextlib.suppress(ConnectionError):
                while block := link.recv(65_536):
                    answer += block
            return answer

    def request(self, method, target, headers=(), body=b""):
        """Send a request; return status, head and body of the answer."""
        given = {"Host": f"127.0.0.1:{self.port}", "Connection": "close"} | dict(headers)
        if body:
            given.setdefault("Content-Length", str(len(body)))
        lines = [f"{method} {target} HTTP/1.1"]
        lines += [f"{name}: {value}" for name, value in given.items() if value is not None]
        answer = self.send("\r\n".join(lines).encode("latin-1") + b"\r\n\r\n" + body)
        head, _, rest = answer.partition(b"\r\n\r\n")
        return (int(head.split()[1]) if head else 0), head.decode("latin-1"), rest


class Served(Requests):
    """A page's server in its own thread, and the daemon behind it."""

    def __init__(self, folder, path, profile):
        self.folder = folder
        self.daemon = FakeDaemon()
        self._path = path
        self._job = _page_job(profile, folder, path) | {
            "token": TOKEN,
            "port": 0,
            "any_port": False,
        }
        self._thread = threading.Thread(target=self._work)
        self._ready = threading.Event()
        self._thread.start()
        assert self._ready.wait(30.0)

    def _work(self):
        asyncio.run(self._run())

    async def _run(self):
        self.loop = asyncio.get_running_loop()
        self._end = asyncio.Event()
        behind = await asyncio.start_unix_server(self.daemon.serve, self._path)
        self.server, runner, listening = await _server.start_page_server(self._job)
        self.port = _server.port_of(listening)
        running = asyncio.create_task(self.server.run())
        while self.server._status is None:
            await asyncio.sleep(0.01)
        self._ready.set()
        await self._end.wait()
        listening.close()
        behind.close()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        self.server.pages.close_all_connections()
        for writer in self.daemon.watchers:
            writer.close()
        await runner.cleanup()

    def call(self, function, *arguments):
        """Call a function in the server's thread."""
        self.loop.call_soon_threadsafe(function, *arguments)

    def close(self):
        self.call(self._end.set)
        self._thread.join(30.0)
        assert not self._thread.is_alive()


class Rig(Requests):
    """The real daemon of a simulated rig, with its page."""

    def __init__(self, process, name, folder, address):
        self.process, self.name, self.folder, self.address = process, name, folder, address
        url, _, self.token = address.partition("#token=")
        self.port = int(url.rstrip("/").rpartition(":")[2])


@contextlib.contextmanager
def rig_with_page(write_profile_in, folder, *options):
    """Start a daemon with its page, on a rig of its own."""
    name = f"page-{os.getpid()}-{time.monotonic_ns()}"
    profile = write_profile_in(folder, "sim", {"name": f'"{name}"'}, patient=True)
    command = [_RIGD, "serve", "--profile", profile, "--output", folder / "out", "--web", *options]
    log_path = folder / "serve.txt"
    environment = {name: value for name, value in os.environ.items() if name != "RIGD_NO_LOOK"}
    with log_path.open("w") as log:
        process = warm_start.start(
            command, stdout=log, stderr=log, start_new_session=True, env=environment
        )
    try:
        address = eventually(lambda: page_address(name), within_s=60.0)
        assert address, log_path.read_text()
        yield Rig(process, name, folder / "out", address)
    finally:
        process.send_signal(signal.SIGCONT)
        process.terminate()
        try:
            process.wait(20.0)
        finally:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sessions")
    path = tmp_path_factory.mktemp("s") / "daemon"
    server = Served(folder, path, load_profile("sim"))
    yield server
    server.close()


JobError, Jobs, MAX_JOBS = _jobs.JobError, _jobs.JobQueue, _jobs.MAX_WAITING_JOBS

_PARTS = {
    "silent_s": (_access, "_FIRST_REQUEST_TIMEOUT_S"),
    "read_s": (_access, "_BODY_TIMEOUT_S"),
    "most_connections": (_access, "_MAX_OPEN_CONNECTIONS"),
    "most_pages": (_live, "MAX_OPEN_PAGES"),
    "most_waiting": (_live, "_MAX_QUEUED_MESSAGES"),
    "list_sessions": (_library, "list_sessions"),
    "response": (_server, "SessionResponse"),
    "worker": (_jobs, "REPORT"),
    "poll_s": (_jobs, "_POLL_PERIOD_S"),
}
"""Limits and parts of the page's server that tests replace."""


@pytest.fixture
def replace_in_page(monkeypatch):
    """Replace limits and parts of the page's server for a test, by name."""

    def replace(**values):
        for name, value in values.items():
            monkeypatch.setattr(*_PARTS[name], value)

    return replace


@pytest.fixture
def run_instead(replace_in_page, monkeypatch, tmp_path):
    """Have jobs run Python code in place of `analyze`: their first argument or the code given."""

    def run_instead(code="exec(sys.argv.pop(1))", **parts):
        (tmp_path / "stand_in.py").write_text(f"import sys\n{code}\n")
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))
        replace_in_page(worker=replace(_jobs.REPORT, module="stand_in"), **parts)

    return run_instead


@pytest.fixture
def short_timeouts(replace_in_page):
    """Disconnect silent clients soon."""
    replace_in_page(silent_s=0.05, read_s=0.05)
