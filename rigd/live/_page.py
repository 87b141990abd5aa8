"""Page of the live view for browsers: Rerun's web viewer on loopback, confined to this computer.

Rerun's own page loads fonts from the internet and sends usage statistics there from the operator's
browser. This module therefore serves the page with a policy by which browsers load from this
computer only. It adds a script that reloads the page when the server was replaced, because viewers
do not reconnect by themselves.
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
"""Rerun's default port, unless another process uses it."""
_STATE: Final = "live.json"
"""File that identifies the present server."""
_FILES: Final = frozenset(
    {
        _STATE,
        *("", "re_viewer.js", "re_viewer_bg.wasm", "sw.js", "favicon.ico", "apple-touch-icon.png"),
    }
)
_BLOCK: Final = 65_536
_PATIENCE_S: Final = 10.0
_POLL_S: Final = 0.1
_LONGEST_S: Final = 60.0
"""Longest connection: the viewer has 40 MB, and a tunnel may be slow."""
_MOST_AT_ONCE: Final = 16
_OWN_NAMES: Final = frozenset({LOOPBACK, "localhost"})
"""Permitted host names: any page on the internet can resolve its own name to loopback."""

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
    """Server of the page for browsers on this computer, in separate threads.

    Parameters
    ----------
    port
        Port on loopback; 0: the system chooses one.
    address
        Returns the present view; None: there is none.
    upstream
        Returns the port on loopback at which Rerun itself serves the page; 0: none.

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
            target=self._server.serve_forever, args=(_POLL_S,), daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


def serve_page(
    address: Callable[[], LiveAddress | None], upstream: Callable[[], int]
) -> ViewerPageServer:
    """Serve the page on :data:`PAGE_PORT` or on a free port if that is taken."""
    try:
        return ViewerPageServer(PAGE_PORT, address, upstream)
    except OSError:
        return ViewerPageServer(0, address, upstream)


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False  # does not wait for browsers
    # Permits the port of a view that has just ended, but not one with a listener.
    allow_reuse_address = True

    def __init__(
        self, port: int, address: Callable[[], LiveAddress | None], upstream: Callable[[], int]
    ) -> None:
        self.address = address
        self.upstream = upstream
        self.room = threading.BoundedSemaphore(_MOST_AT_ONCE)
        super().__init__((LOOPBACK, port), _Handler)

    def server_bind(self) -> None:
        """Bind without the base class's name resolution of the address."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = LOOPBACK, self.socket.getsockname()[1]

    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept a connection; pause if that fails for lack of descriptors."""
        try:
            return super().get_request()
        except OSError:
            time.sleep(_POLL_S)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401 - as there
        """Handle a request in a thread, unless there are too many."""
        if self.room.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Handle a request, and cut off the connection if that takes too long."""
        end = threading.Timer(_LONGEST_S, _cut_off, (request,))
        end.daemon = True
        end.start()
        try:
            super().process_request_thread(request, client_address)
        finally:
            end.cancel()
            self.room.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore errors of browsers that disconnect."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = _PATIENCE_S

    def do_GET(self) -> None:
        """Handle a request of a browser."""
        host = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
        if host in _OWN_NAMES:
            self._answer()
        else:
            self._say(HTTPStatus.FORBIDDEN, f"Open this page as http://{LOOPBACK}:PORT.")

    def log_message(self, *_: object) -> None:
        """Log nothing: the operator's terminal is for the session."""

    def _answer(self) -> None:
        split = urllib.parse.urlsplit(self.path)
        name, address = split.path.lstrip("/"), self.server.address()
        if name not in _FILES:
            self._say(HTTPStatus.NOT_FOUND, "Not found.")
        elif address is None:
            self._send_retry()
        elif name == _STATE:
            self._send(json.dumps({"server": address.server}).encode(), "application/json")
        elif not name and "url" not in urllib.parse.parse_qs(split.query):
            # Relative, because the browser may use a tunnel on another port.
            self.send_response(HTTPStatus.FOUND)
            self.send_header("Location", f"/?{urllib.parse.urlsplit(address.viewer_url).query}")
            self.end_headers()
        else:
            self._forward(name)

    def _forward(self, name: str) -> None:
        """Send one of Rerun's files."""
        link = http.client.HTTPConnection(LOOPBACK, self.server.upstream(), timeout=_PATIENCE_S)
        try:
            link.request("GET", f"/{name}")
            answer = link.getresponse()
            kind = answer.headers.get("Content-Type", "application/octet-stream")
            if not name:
                self._send(confine_to_loopback(answer.read().decode()).encode(), kind)
                return
            self.send_response(answer.status)
            self.send_header("Content-Type", kind)
            # The length, although the transfer is chunked.
            if (size := answer.headers.get("rerun-final-length")) is not None:
                self.send_header("Content-Length", size)
            self._end_headers()
            while block := answer.read(_BLOCK):
                self.wfile.write(block)
        except (OSError, http.client.HTTPException):
            # The server is being replaced, or the browser is gone.
            with suppress(OSError):
                self._send_retry()
        finally:
            link.close()

    def _send_retry(self) -> None:
        """Make the browser try again."""
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


def confine_to_loopback(page: str) -> str:
    """Return Rerun's page without links to other computers, and with the reload script."""
    return _REMOTE_LINK.sub("", page).replace("</body>", f"{_AGAIN}</body>", 1)
