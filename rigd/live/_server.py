"""Server of the live view: Rerun's server, the page for browsers, and the file with the address.

Server
    It takes what the publisher sends, and passes it on to any number of viewers. It is a process of
    its own because a viewer that is slow or frozen then holds nobody up, and because the SDK's own
    server listens on every interface. Viewers connect to it without any authentication, so it must
    never be reachable from another machine.
Page
    The web viewer's page on loopback, as Rerun brings it, but confined to this computer. Unchanged,
    it loads fonts and sends usage statistics to the internet, from the operator's browser.
    Therefore it is passed on from here, with a policy that browsers enforce: it may load from this
    computer, and from nowhere else. A few lines are added by which it is loaded again when a server
    was replaced: viewers do not connect a second time by themselves.
Address
    One small file for each live view in the user's runtime folder, as long as there is one. A file
    that a killed process left is recognised by that process being gone.
"""

import collections
import contextlib
import ctypes
import http.client
import importlib.util
import json
import os
import re
import signal
import socket
import socketserver
import subprocess
import threading
import time
import urllib.parse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final, Self

from rigd.runtime import runtime_folder
from rigd.view import without_settings

# Rerun's program

LOOPBACK: Final = "127.0.0.1"

_NOWHERE = f"http://{LOOPBACK}:9"
"""The discard port, on which nobody listens."""
_QUIET: Mapping[str, str] = {
    # How Rerun is told, for one process, to send no usage data.
    "CI": "1",
    # What it would look up on the web (newer versions, examples) is refused on this computer. Its
    # own connections to viewers and recordings know of no proxy.
    **dict.fromkeys(("ALL_PROXY", "HTTPS_PROXY", "HTTP_PROXY"), _NOWHERE),
    **dict.fromkeys(("all_proxy", "https_proxy", "http_proxy"), _NOWHERE),
    "NO_PROXY": "",
    "no_proxy": "",
    # Its log is where it tells its ports: readable, whatever the user has set.
    "RUST_LOG": "info",
    "NO_COLOR": "1",
}
_LISTENING = re.compile(rf"gRPC connections on {re.escape(LOOPBACK)}:(\d+)")
_SERVING_PAGE = re.compile(rf"web-viewer at http://{re.escape(LOOPBACK)}:(\d+)")
_NO_GRAPHICS = re.compile(
    # Neither Vulkan nor OpenGL; OpenGL alone, of which Mesa offers too little in software.
    "[Nn]o (suitable )?(graphics|wgpu) adapter|Failed to get render context"
)
_MOMENT_S: Final = 0.5
_MOST_READING_S: Final = 10.0
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class RerunError(Exception):
    """Rerun's program cannot be run."""


class RerunProgram:
    """Rerun's program as a child process, which ends with this one.

    Parameters
    ----------
    options
        Options of its command line.
    environment
        Environment variables in addition to this process's own.

    Raises
    ------
    RerunError
        If the program is not there or does not run.
    """

    def __init__(
        self, options: Sequence[str], environment: Mapping[str, str] | None = None
    ) -> None:
        command = [_path(), *("--bind", LOOPBACK), *options]
        try:
            self._process = subprocess.Popen(
                command,
                env={**without_settings(os.environ), **_QUIET, **(environment or {})},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                preexec_fn=_die_with_parent,  # noqa: PLW1509 - one system call, no lock taken
            )
        except OSError as error:
            raise RerunError(f"{command[0]}: cannot be run: {error.strerror}.") from None
        self._ports: dict[re.Pattern[str], int] = {}
        self._last_lines: collections.deque[str] = collections.deque(maxlen=3)
        self._without_graphics = False
        # Read to the end: a program whose output nobody reads would block once the pipe is full.
        self._reader = threading.Thread(target=self._read_log, daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether the process exists, be it frozen."""
        return self._process.poll() is None

    @property
    def exit_code(self) -> int | None:
        """How it ended; None while it is running."""
        return self._process.poll()

    @property
    def grpc_port(self) -> int:
        """Port for connections; 0: none yet."""
        return self._ports.get(_LISTENING, 0)

    @property
    def page_port(self) -> int:
        """Port of the web viewer's page, if it is to serve one; 0: none yet."""
        return self._ports.get(_SERVING_PAGE, 0)

    @property
    def last_words(self) -> str:
        """The last lines of its log."""
        self._read_on()
        return " ".join(self._last_lines) or "it said nothing"

    @property
    def without_graphics(self) -> bool:
        """Whether it said that it cannot draw: that the computer has no graphics it can use."""
        self._read_on()
        return self._without_graphics

    def kill(self) -> None:
        """End it at once; there is nothing in it to be saved."""
        self._process.kill()
        self._process.wait()

    def _read_on(self) -> None:
        # To its end, if it has one: what a program says last is read when it has long ended.
        self._reader.join(timeout=_MOMENT_S if self.running else _MOST_READING_S)

    def _read_log(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as log:
            for line in log:
                self._last_lines.append(line.strip()[:200])
                # A backtrace follows it, so that it is not among the last words.
                self._without_graphics |= _NO_GRAPHICS.search(line) is not None
                for pattern in (_LISTENING, _SERVING_PAGE):
                    if found := pattern.search(line):
                        self._ports[pattern] = int(found[1])


def _path() -> str:
    # Not the `rerun` command on the path: that is a script; ending it leaves the program behind.
    package = importlib.util.find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise RerunError("The Python package rerun-sdk is not installed; the live view needs it.")
    return str(Path(package.origin).with_name("rerun"))


_prctl = ctypes.CDLL(None).prctl


def _die_with_parent() -> None:
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


# Addresses

_PREFIX: Final = "live-"
_SUFFIX: Final = ".json"
_MOST_BYTES: Final = 4096


@dataclass(frozen=True, slots=True)
class LiveAddress:
    """A live view that runs.

    Attributes
    ----------
    rig
        The profile's name.
    pid
        Process of the publisher.
    born
        When that process was started, in clock ticks since the computer was: no other process has
        both numbers.
    grpc_port
        Port on loopback, for native viewers.
    page_port
        Port on loopback, for browsers.
    server
        Number of the server, another for each: viewers do not connect a second time by themselves.
    """

    rig: str
    pid: int
    born: int
    grpc_port: int
    page_port: int
    server: int

    @classmethod
    def of_this_process(cls, rig: str, grpc_port: int, page_port: int, server: int) -> Self:
        """Return the address of a live view that this process publishes.

        Parameters
        ----------
        rig
            Name of its profile.
        grpc_port, page_port
            Ports of Rerun's server and of its page.
        server
            Process id of the server.
        """
        pid = os.getpid()
        return cls(rig, pid, _born(pid) or 0, grpc_port, page_port, server)

    @property
    def proxy_url(self) -> str:
        """Address for native viewers."""
        return proxy_url(LOOPBACK, self.grpc_port)

    @property
    def page_url(self) -> str:
        """Address to open in a browser."""
        return f"http://{LOOPBACK}:{self.page_port}"

    @property
    def viewer_url(self) -> str:
        """Where :attr:`page_url` leads to: the page, told which server to show."""
        query = urllib.parse.urlencode({"url": self.proxy_url})
        return f"{self.page_url}/?{query}"

    @property
    def alive(self) -> bool:
        """Whether its process still runs."""
        born = _born(self.pid)
        return born is not None and born == self.born


def proxy_url(host: str, grpc_port: int) -> str:
    """Return where the SDK and native viewers connect to a server."""
    return f"rerun+http://{host}:{grpc_port}/proxy"


def announce(address: LiveAddress) -> None:
    """Write down where a live view is, for this user only, until :func:`withdraw`.

    Raises
    ------
    OSError
        If that cannot be written.
    """
    path = _file(address.rig)
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    fresh = path.with_suffix(f".{address.pid}")
    fresh.unlink(missing_ok=True)
    fresh.touch(mode=0o600)
    fresh.write_text(json.dumps(asdict(address)), encoding="utf-8")
    fresh.replace(path)


def withdraw(address: LiveAddress) -> None:
    """Take the address away, unless it is another's by now."""
    path = _file(address.rig)
    found = _read(path)
    if found is not None and (found.pid, found.born) == (address.pid, address.born):
        path.unlink(missing_ok=True)


def find(rig: str) -> LiveAddress | None:
    """Return the live view of a rig, if one runs."""
    address = _read(_file(rig))
    return address if address is not None and address.alive else None


def running() -> list[LiveAddress]:
    """Return all live views of this user."""
    return [address for path in _files() if (address := _read(path)) is not None and address.alive]


def _file(rig: str) -> Path:
    plain = "".join(c if c.isalnum() else "-" for c in rig).strip("-")
    return runtime_folder() / f"{_PREFIX}{plain}{_SUFFIX}"


def _files() -> Iterator[Path]:
    with suppress(OSError):
        yield from sorted(runtime_folder().glob(f"{_PREFIX}*{_SUFFIX}"))


def _read(path: Path) -> LiveAddress | None:
    """Return what a file says, None if it is none of ours: its text ends up on terminals."""
    try:
        # Anything may lie there, even what blocks whoever opens it.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        with os.fdopen(descriptor, "rb") as file:
            found = json.loads(file.read(_MOST_BYTES))
        address = LiveAddress(**found)
    except (OSError, ValueError, TypeError, RecursionError):
        return None
    return address if _is_sound(found) else None


def _is_sound(found: dict[str, object]) -> bool:
    """Whether what a file holds can be an address."""
    rig = found.pop("rig")
    ports = (found["grpc_port"], found["page_port"])
    return (
        isinstance(rig, str)
        and rig.isprintable()
        and all(type(number) is int for number in found.values())
        and all(0 < port < 1 << 16 for port in ports if isinstance(port, int))
    )


def _born(pid: int) -> int | None:
    """Return when a process was started, in clock ticks; None if it does not run."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text("utf-8")
    except OSError:
        return None
    state, *rest = text.rpartition(")")[2].split()  # the name before may hold anything
    return None if state in "ZX" else int(rest[18])


# Page for browsers

PAGE_PORT: Final = 9090
"""Rerun's own, as long as nobody else has it."""
_STATE: Final = "live.json"
"""Tells the page which server there is now."""
_FILES: Final = frozenset(
    {
        _STATE,
        *("", "re_viewer.js", "re_viewer_bg.wasm", "sw.js", "favicon.ico", "apple-touch-icon.png"),
    }
)
_BLOCK: Final = 65_536
_PATIENCE_S: Final = 10.0
_LOOK_S: Final = 0.1
_LONGEST_S: Final = 60.0
"""Longest time of a connection: the viewer has 40 MB, and the tunnel may be slow."""
_MOST_AT_ONCE: Final = 16
_OWN_NAMES: Final = frozenset({LOOPBACK, "localhost"})
"""Any page on the internet can have its own name lead here; it is not to read what this shows."""

_HERE: Final = f"http://{LOOPBACK}:* http://localhost:*"
_POLICY: Final = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'",
        "style-src 'unsafe-inline'",
        "img-src 'self' data: blob:",
        f"connect-src 'self' {_HERE}",
        "worker-src 'self' blob:",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
_REMOTE_LINK: Final = re.compile(r"<link\s[^>]*https?://[^>]*>")
_AGAIN: Final = """
    <script>
      let shown = null;
      async function beginAgain() {
        try {
          const found = await (await fetch("live.json")).json();
          if (shown === null) shown = found.server;
          if (found.server !== shown) location.replace("/");
        } catch {
          // The rig is gone; it may come back.
        }
      }
      setInterval(beginAgain, 1000);
    </script>
"""


class PageServer:
    """Serves the page to browsers on this computer, in threads of its own.

    Parameters
    ----------
    port
        Port to take on loopback; 0 leaves the choice to the system.
    address
        Asked for the view that there is now; None: none at the moment.
    upstream
        Asked for the port on loopback where Rerun itself serves the page; 0: nowhere.

    Attributes
    ----------
    port
        Port on which it listens.

    Raises
    ------
    OSError
        If the port is taken.
    """

    def __init__(
        self,
        port: int,
        address: Callable[[], LiveAddress | None],
        upstream: Callable[[], int],
    ) -> None:
        self._server = _Server(port, address, upstream)
        self.port = self._server.server_port
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(_LOOK_S,), daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Take no more connections."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


def serve_page(
    address: Callable[[], LiveAddress | None], upstream: Callable[[], int]
) -> PageServer:
    """Serve the page, on :data:`PAGE_PORT` unless that is taken; as for :class:`PageServer`."""
    try:
        return PageServer(PAGE_PORT, address, upstream)
    except OSError:
        return PageServer(0, address, upstream)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False  # nobody waits for a browser
    # So that the port of a view that has just ended can be taken; not one where somebody listens.
    allow_reuse_address = True

    def __init__(
        self, port: int, address: Callable[[], LiveAddress | None], upstream: Callable[[], int]
    ) -> None:
        self.address = address
        self.upstream = upstream
        self.room = threading.BoundedSemaphore(_MOST_AT_ONCE)
        super().__init__((LOOPBACK, port), _Handler)

    def server_bind(self) -> None:
        """Bind, and spare the base class's look-up of a name for the address."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = LOOPBACK, self.socket.getsockname()[1]

    def get_request(self) -> tuple[socket.socket, Any]:
        """Take a connection; where that fails for want of descriptors, it would at once again."""
        try:
            return super().get_request()
        except OSError:
            time.sleep(_LOOK_S)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401 - as there
        """Answer in a thread, if there is room for one more."""
        if self.room.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Answer, and have the connection cut off if that takes too long."""
        end = threading.Timer(_LONGEST_S, _cut_off, (request,))
        end.daemon = True
        end.start()
        try:
            super().process_request_thread(request, client_address)
        finally:
            end.cancel()
            self.room.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """Say nothing of a browser that goes away."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = _PATIENCE_S

    def do_GET(self) -> None:
        """Answer a browser."""
        host = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
        if host in _OWN_NAMES:
            self._answer()
        else:
            self._say(HTTPStatus.FORBIDDEN, f"Open this page as http://{LOOPBACK}:PORT.")

    def log_message(self, *_: object) -> None:
        """Keep quiet: the operator's terminal is for the session."""

    def _answer(self) -> None:
        split = urllib.parse.urlsplit(self.path)
        name, address = split.path.lstrip("/"), self.server.address()
        if name not in _FILES:
            self._say(HTTPStatus.NOT_FOUND, "There is nothing of that name here.")
        elif address is None:
            self._come_again()
        elif name == _STATE:
            self._send(json.dumps({"server": address.server}).encode(), "application/json")
        elif not name and "url" not in urllib.parse.parse_qs(split.query):
            # Relative: the browser may have come through a tunnel, from another port.
            self.send_response(HTTPStatus.FOUND)
            self.send_header("Location", f"/?{urllib.parse.urlsplit(address.viewer_url).query}")
            self.end_headers()
        else:
            self._pass_on(name)

    def _pass_on(self, name: str) -> None:
        """Send one of Rerun's files."""
        link = http.client.HTTPConnection(LOOPBACK, self.server.upstream(), timeout=_PATIENCE_S)
        try:
            link.request("GET", f"/{name}")
            answer = link.getresponse()
            kind = answer.headers.get("Content-Type", "application/octet-stream")
            if not name:
                self._send(kept_here(answer.read().decode()).encode(), kind)
                return
            self.send_response(answer.status)
            self.send_header("Content-Type", kind)
            # Its length, although it comes in pieces.
            if (size := answer.headers.get("rerun-final-length")) is not None:
                self.send_header("Content-Length", size)
            self._end_headers()
            while block := answer.read(_BLOCK):
                self.wfile.write(block)
        except (OSError, http.client.HTTPException):
            # The server is being replaced, or the browser is gone.
            with suppress(OSError):
                self._come_again()
        finally:
            link.close()

    def _come_again(self) -> None:
        """Have the browser try again."""
        self._say(HTTPStatus.SERVICE_UNAVAILABLE, "The live view is starting.", again=True)

    def _say(self, status: HTTPStatus, text: str, *, again: bool = False) -> None:
        self.send_response(status)
        if again:
            self.send_header("Refresh", "1")
        self.send_header("Content-Type", "text/plain; charset=utf-8")
        self._end_headers()
        self.wfile.write(text.encode())

    def _send(self, body: bytes, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self._end_headers()
        self.wfile.write(body)

    def _end_headers(self) -> None:
        self.send_header("Content-Security-Policy", _POLICY)
        self.end_headers()


def _cut_off(connection: socket.socket) -> None:
    with suppress(OSError):  # it has just ended by itself
        connection.shutdown(socket.SHUT_RDWR)


def kept_here(page: str) -> str:
    """Return Rerun's page without links to other computers, and with what connects it again."""
    return _REMOTE_LINK.sub("", page).replace("</body>", f"{_AGAIN}</body>", 1)


# Server of a rig

GRPC_PORT: Final = 9876
"""Rerun's own: where viewers look unless told otherwise, and tunnels can be laid in advance."""
_BACKLOG: Final = "16MiB"
"""Data that a viewer which joins late is sent first: some 80 s."""
_MOST_SESSIONS: Final = 20
"""Each leaves some 300 kB of layout and charts in the server; then another takes its place."""
_START_S: Final = 15.0
"""Time in which a server has to accept connections, on a busy computer."""
_ANSWER_S: Final = 0.1
_PAUSE_S: Final = 1.0
"""Least time between two starts of a server."""


class Outlet:
    """A Rerun server that is replaced when it ends, and how viewers find it.

    Parameters
    ----------
    rig
        The profile's name.

    Attributes
    ----------
    address
        Address of the server that accepts connections now; None while there is none.

    Raises
    ------
    RerunError
        If Rerun's program cannot be run.
    """

    def __init__(self, rig: str) -> None:
        self.address: LiveAddress | None = None
        self._announced: LiveAddress | None = None
        self._rig = rig
        self._grpc_port = free_port(GRPC_PORT)
        self._page = serve_page(lambda: self.address, lambda: self._program.page_port)
        self._start()

    def wait(self) -> LiveAddress:
        """Wait for the first server, and return its address.

        Raises
        ------
        RerunError
            If it ends or does not answer.
        """
        deadline = time.monotonic() + 2 * _START_S
        while not self.attend():
            if not self._program.running:
                if not self._grpc_port:
                    raise RerunError(f"The Rerun server ended: {self._program.last_words}.")
                self._replace()
            if time.monotonic() > deadline:
                self.close()
                raise RerunError(f"The Rerun server does not answer: {self._program.last_words}.")
            time.sleep(0.01)
        assert self.address is not None
        return self.address

    def attend(self) -> bool:
        """Look after the server; say whether one takes connections."""
        program = self._program
        if program.running and program.grpc_port and program.page_port:
            if self.address is None:
                self._tell()
            return True
        self.address = None
        age_s = time.monotonic() - self._started_s
        if age_s > _START_S:
            program.kill()  # it took who listens on its port for its like, and serves nobody
        if age_s > _PAUSE_S and not program.running:
            self._replace()
        return False

    def answers(self) -> bool:
        """Whether the server takes connections now: the SDK waits 5 s for one that does not."""
        try:
            socket.create_connection((LOOPBACK, self._grpc_port), _ANSWER_S).close()
        except OSError:
            return False
        return True

    def begin_session(self) -> None:
        """Make room for a session: what stays of each, the server never forgets by itself."""
        self._sessions += 1
        if self._sessions > _MOST_SESSIONS:
            self.kill_server()

    def kill_server(self) -> None:
        """End the server, which does not answer any more; another one takes its place."""
        self._program.kill()

    def close(self) -> None:
        """End the server, and what leads to it."""
        self._program.kill()
        self._page.close()
        if self._announced is not None:
            with contextlib.suppress(OSError):  # who looks there sees that its process has ended
                withdraw(self._announced)

    def _replace(self) -> None:
        """Start another server: on the same port, where viewers and tunnels look for it.

        If the last one never served, it found that port taken.
        """
        if not self._program.grpc_port:
            self._grpc_port = 0
        with contextlib.suppress(RerunError):  # to be tried again
            self._start()

    def _start(self) -> None:
        self._started_s = time.monotonic()
        self._sessions = 0
        self._program = RerunProgram(
            (
                "--serve-web",
                *("--port", str(self._grpc_port)),
                *("--web-viewer-port", "0"),
                *("--server-memory-limit", _BACKLOG),
            )
        )

    def _tell(self) -> None:
        self._grpc_port = self._program.grpc_port
        self.address = self._announced = LiveAddress.of_this_process(
            self._rig, self._grpc_port, self._page.port, time.time_ns()
        )
        with contextlib.suppress(OSError):  # the view is there all the same
            announce(self.address)


def free_port(wanted: int) -> int:
    """Return a port if nobody listens on it, or 0, which leaves the choice to the system.

    Rerun's program is not to find out: it may take who listens there for its like.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        # Connections of a server that has just ended do not count.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, wanted))
        except OSError:
            return 0
    return wanted
