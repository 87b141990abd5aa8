"""The Rerun server: takes what the publisher sends, serves it and the web viewer on loopback.

It is a process of its own because a viewer that is slow or frozen then holds nobody up, and
because the SDK's own server listens on every interface. Viewers connect to it without any
authentication, so it must never be reachable from another machine.
"""

import collections
import ctypes
import importlib.util
import os
import re
import signal
import subprocess
import threading
import urllib.parse
from dataclasses import dataclass
from pathlib import Path

_HOST = "127.0.0.1"
_BACKLOG = "8MiB"  # what a viewer that joins late is sent first: some 40 s of samples
_GRPC_LINE = re.compile(rf"gRPC connections on ({re.escape(_HOST)}):(\d+)")
_WEB_LINE = re.compile(rf"web-viewer at http://({re.escape(_HOST)}):(\d+)")
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class ServerError(Exception):
    """The Rerun server cannot be started."""


@dataclass(frozen=True, slots=True)
class Ports:
    """Where the server listens on loopback; 0 leaves the choice to the system."""

    grpc: int = 0
    web: int = 0

    @property
    def proxy_url(self) -> str:
        """Where the SDK and native viewers connect."""
        return f"rerun+http://{_HOST}:{self.grpc}/proxy"

    @property
    def viewer_url(self) -> str:
        """What to open in a browser."""
        query = urllib.parse.urlencode({"url": self.proxy_url})
        return f"http://{_HOST}:{self.web}?{query}"


class Server:
    """A running Rerun server.

    Parameters
    ----------
    ports
        The ports to take. A server that replaces another takes its ports, so that viewers find it.

    Raises
    ------
    ServerError
        If the program is not there or does not run.
    """

    def __init__(self, ports: Ports) -> None:
        command = [
            _program(),
            "--serve-web",
            *("--bind", _HOST),
            *("--port", str(ports.grpc)),
            *("--web-viewer-port", str(ports.web)),
            *("--server-memory-limit", _BACKLOG),
        ]
        # CI=1 is how Rerun is told, for one process, to send no usage data; the other two settings
        # make its log, which is where it tells its ports, readable whatever the user has set.
        environment = {**os.environ, "CI": "1", "RUST_LOG": "info", "NO_COLOR": "1"}
        try:
            self._process = subprocess.Popen(
                command,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                preexec_fn=_die_with_parent,  # noqa: PLW1509 - one system call, no lock taken
            )
        except OSError as error:
            raise ServerError(f"{command[0]}: cannot be run: {error.strerror}.") from None
        self._grpc = self._web = 0
        self._last_lines: collections.deque[str] = collections.deque(maxlen=3)
        # Read to the end: a server whose output nobody reads would block once the pipe is full.
        self._reader = threading.Thread(target=self._read_log, daemon=True)
        self._reader.start()

    @property
    def running(self) -> bool:
        """Whether the process exists, be it frozen."""
        return self._process.poll() is None

    @property
    def ports(self) -> Ports | None:
        """Where it listens, or None as long as it does not accept connections."""
        accepting = self._grpc and self._web and self.running
        return Ports(self._grpc, self._web) if accepting else None

    @property
    def last_words(self) -> str:
        """The last lines of its log."""
        self._reader.join(timeout=0.5)
        return " ".join(self._last_lines) or "it said nothing"

    def kill(self) -> None:
        """End it at once; there is nothing in it to be saved."""
        self._process.kill()
        self._process.wait()

    def _read_log(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._last_lines.append(line.strip()[:200])
            if found := _GRPC_LINE.search(line):
                self._grpc = int(found[2])
            elif found := _WEB_LINE.search(line):
                self._web = int(found[2])


def _program() -> str:
    # Not the `rerun` command on the path: that is a script, and ending it leaves the server behind.
    package = importlib.util.find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise ServerError("The Python package rerun-sdk is not installed; the live view needs it.")
    return str(Path(package.origin).with_name("rerun"))


_prctl = ctypes.CDLL(None).prctl


def _die_with_parent() -> None:
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
