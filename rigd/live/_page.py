"""Page of the live view for browsers: Rerun's web viewer, which loads from this computer only.

Rerun's own page loads fonts from the internet and sends usage statistics there from the operator's
browser. This module therefore serves the page with a policy that makes browsers load from this
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
"""Preferred port of the page, Rerun's default."""
_SERVER_STATE_DOCUMENT: Final = "live.json"
"""Name of the document that identifies the present server."""
_SERVED_FILES: Final = frozenset(  # Names of all documents that the page serves
    {
        _SERVER_STATE_DOCUMENT,
        *("", "re_viewer.js", "re_viewer_bg.wasm", "sw.js", "favicon.ico", "apple-touch-icon.png"),
    }
)
_FORWARDED_BLOCK_BYTES: Final = 65_536
"""Number of bytes of Rerun's files that are forwarded at once."""
_REQUEST_TIMEOUT_S: Final = 10.0
"""Timeout in seconds of a browser's request and of Rerun's reply."""
_POLL_PERIOD_S: Final = 0.1
"""Interval in seconds of the server's polls, and pause after a failed connection."""
_MAX_CONNECTION_DURATION_S: Final = 60.0
"""Longest duration of a connection in seconds: the viewer has 40 MB, and a tunnel may be slow."""
_MAX_CONNECTIONS: Final = 16
"""Largest number of simultaneous connections."""
_PERMITTED_HOSTS: Final = frozenset({LOOPBACK, "localhost"})
"""Host names by which browsers may request the page.

Other names are refused, since any page on the internet can resolve its own name to loopback."""

_LOOPBACK_POLICY_SOURCES: Final = f"http://{LOOPBACK}:* http://localhost:*"
"""Sources in the content security policy that stand for servers on this computer."""
_CONTENT_SECURITY_POLICY: Final = "; ".join(  # Content security policy of the page
    (
        "default-src 'none'",
        "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'",
        "style-src 'unsafe-inline'",
        "img-src 'self' data: blob:",
        f"connect-src 'self' {_LOOPBACK_POLICY_SOURCES}",
        "worker-src 'self' blob:",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
_REMOTE_LINK_PATTERN: Final = re.compile(r"<link\s[^>]*https?://[^>]*>")
"""Pattern of links in Rerun's page to other computers."""
_RELOAD_SCRIPT: Final = """
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


"""Script that reloads the page after the server was replaced."""


class ViewerPageServer:
    """HTTP server, in threads of its own, of the live view's page for browsers on this computer.

    It listens on a loopback port (0: the system chooses); `OSError` is raised if that is taken.
    `get_address` returns the address of the present live view, or None; `get_rerun_port` the
    loopback port at which Rerun itself serves the page, or 0.
    """

    def __init__(
        self,
        port: int,
        get_address: Callable[[], LiveAddress | None],
        get_rerun_port: Callable[[], int],
    ) -> None:
        self._server = _PageServer(port, get_address, get_rerun_port)
        self.port = self._server.server_port
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(_POLL_PERIOD_S,), daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop the server of the page."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


def serve_page(
    get_address: Callable[[], LiveAddress | None], get_rerun_port: Callable[[], int]
) -> ViewerPageServer:
    """Start the page's server on :data:`PAGE_PORT`, or on a free port if that one is taken.

    `get_address` and `get_rerun_port` are as for `ViewerPageServer`.
    """
    try:
        return ViewerPageServer(PAGE_PORT, get_address, get_rerun_port)
    except OSError:
        return ViewerPageServer(0, get_address, get_rerun_port)


class _PageServer(ThreadingHTTPServer):
    """HTTP server that limits the number and the duration of its connections."""

    daemon_threads = True
    block_on_close = False  # does not wait for browsers
    # Permits the port of a view that has just ended, but not one on which a process listens.
    allow_reuse_address = True

    def __init__(
        self,
        port: int,
        get_address: Callable[[], LiveAddress | None],
        get_rerun_port: Callable[[], int],
    ) -> None:
        self.get_address = get_address
        self.get_rerun_port = get_rerun_port
        self.free_connections = threading.BoundedSemaphore(_MAX_CONNECTIONS)
        super().__init__((LOOPBACK, port), _PageHandler)

    def server_bind(self) -> None:
        """Bind the socket, without resolving the host name as the base class does."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = LOOPBACK, self.socket.getsockname()[1]

    def get_request(self) -> tuple[socket.socket, Any]:
        """Accept a connection, or pause if no file descriptors are left."""
        try:
            return super().get_request()
        except OSError:
            time.sleep(_POLL_PERIOD_S)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:  # noqa: ANN401 - as there
        """Serve a connection in a thread, or close it if there are too many."""
        if self.free_connections.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:  # noqa: ANN401
        """Serve a connection, and close it if it lasts too long."""
        deadline_timer = threading.Timer(_MAX_CONNECTION_DURATION_S, _close_connection, (request,))
        deadline_timer.daemon = True
        deadline_timer.start()
        try:
            super().process_request_thread(request, client_address)
        finally:
            deadline_timer.cancel()
            self.free_connections.release()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore the error if a browser disconnects."""


class _PageHandler(BaseHTTPRequestHandler):
    """Replies to the requests of browsers for the page and for Rerun's files."""

    server: _PageServer
    timeout = _REQUEST_TIMEOUT_S

    def do_GET(self) -> None:
        """Send the requested document, or refuse the request if its host name is not permitted."""
        host_name = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
        if host_name in _PERMITTED_HOSTS:
            self._send_document()
        else:
            self._send_text(HTTPStatus.FORBIDDEN, f"Open this page as http://{LOOPBACK}:PORT.")

    def log_message(self, *_: object) -> None:
        """Write no log, because the operator's terminal shows the session."""

    def _send_document(self) -> None:
        """Send the requested document, a redirection, or an error."""
        requested_url = urllib.parse.urlsplit(self.path)
        document_name, address = requested_url.path.lstrip("/"), self.server.get_address()
        if document_name not in _SERVED_FILES:
            self._send_text(HTTPStatus.NOT_FOUND, "Not found.")
        elif address is None:
            self._send_retry_request()
        elif document_name == _SERVER_STATE_DOCUMENT:
            self._send_document_body(
                json.dumps({"server": address.server}).encode(), "application/json"
            )
        elif not document_name and "url" not in urllib.parse.parse_qs(requested_url.query):
            # Relative, because the browser may use a tunnel on another port.
            self.send_response(HTTPStatus.FOUND)
            self.send_header("Location", f"/?{urllib.parse.urlsplit(address.viewer_url).query}")
            self.end_headers()
        else:
            self._forward_rerun_file(document_name)

    def _forward_rerun_file(self, file_name: str) -> None:
        """Send a file that Rerun's own page server provides, without links to other computers."""
        rerun_connection = http.client.HTTPConnection(
            LOOPBACK, self.server.get_rerun_port(), timeout=_REQUEST_TIMEOUT_S
        )
        try:
            rerun_connection.request("GET", f"/{file_name}")
            rerun_reply = rerun_connection.getresponse()
            content_type = rerun_reply.headers.get("Content-Type", "application/octet-stream")
            if not file_name:
                self._send_document_body(
                    confine_to_loopback(rerun_reply.read().decode()).encode(), content_type
                )
                return
            self.send_response(rerun_reply.status)
            self.send_header("Content-Type", content_type)
            # The length, although the transfer is chunked.
            if (content_length := rerun_reply.headers.get("rerun-final-length")) is not None:
                self.send_header("Content-Length", content_length)
            self._end_headers()
            while file_block := rerun_reply.read(_FORWARDED_BLOCK_BYTES):
                self.wfile.write(file_block)
        except (OSError, http.client.HTTPException):
            # The server is being replaced, or the browser is gone.
            with suppress(OSError):
                self._send_retry_request()
        finally:
            rerun_connection.close()

    def _send_retry_request(self) -> None:
        """Send an error after which the browser repeats its request in a second."""
        self._send_text(
            HTTPStatus.SERVICE_UNAVAILABLE, "The live view is starting.", asks_retry=True
        )

    def _send_text(self, status: HTTPStatus, text: str, *, asks_retry: bool = False) -> None:
        """Send a text; with `asks_retry` the browser repeats its request in a second."""
        self.send_response(status)
        if asks_retry:
            self.send_header("Refresh", "1")
        self.send_header("Content-Type", "text/plain; charset=utf-8")
        self._end_headers()
        self.wfile.write(text.encode())

    def _send_document_body(self, body: bytes, content_type: str) -> None:
        """Send a document with its content type; no cache may store it."""
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self._end_headers()
        self.wfile.write(body)

    def _end_headers(self) -> None:
        """Send the content security policy as the last header."""
        self.send_header("Content-Security-Policy", _CONTENT_SECURITY_POLICY)
        self.end_headers()


def _close_connection(connection: socket.socket) -> None:
    """Shut down a connection in both directions."""
    with suppress(OSError):  # it has just ended by itself
        connection.shutdown(socket.SHUT_RDWR)


def confine_to_loopback(page_html: str) -> str:
    """Return Rerun's HTML page without links to other computers, with the reload script added."""
    return _REMOTE_LINK_PATTERN.sub("", page_html).replace("</body>", f"{_RELOAD_SCRIPT}</body>", 1)
