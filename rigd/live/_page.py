"""Page of the live view for browsers: Rerun's web viewer on loopback, confined to this computer.

Unchanged, Rerun's page loads fonts and sends usage statistics to the internet, from the operator's
browser. Therefore it is passed on from here, with a policy that browsers enforce: it may load from
this computer, and from nowhere else. A few lines are added by which it is loaded again when a
server was replaced: viewers do not connect a second time by themselves.
"""

import http.client
import json
import re
import socket
import socketserver
import threading
import time
import urllib.parse
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from rigd.live.address import LOOPBACK, LiveAddress

PAGE_PORT: Final = 9090
"""Rerun's own, unless another process uses it."""
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


class ViewerPageServer:
    """Serves the page to browsers on this computer, in separate threads.

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
) -> ViewerPageServer:
    """Serve the page, on :data:`PAGE_PORT` or on a free port if that is taken."""
    try:
        return ViewerPageServer(PAGE_PORT, address, upstream)
    except OSError:
        return ViewerPageServer(0, address, upstream)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False  # does not wait for a browser
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
            self._say(HTTPStatus.NOT_FOUND, "Not found.")
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
