"""Line to a Net F/T box: its web page by HTTP, requests and records by UDP."""

import contextlib
import http.client
import socket
import time

from rigd_netft.settings import NetFtSettings

_TIMEOUT_S = 2.0
"""Longest time in seconds for a connection to the page, and for each read from it."""
_MAX_PAGE_BYTES = 1 << 16
"""Largest size in bytes of a page that is read."""
_BUFFER_BYTES = 4 << 20
"""Requested size of the kernel's buffer; the usual 212 992 bytes hold 256 small packets only."""
_MAX_PACKETS_PER_TICK = 1024
"""Most packets that are read in a tick, so that a flood does not stop the loop."""


class NetworkLine:
    """Line to a box on the network."""

    def __init__(self, settings: NetFtSettings) -> None:
        self._settings = settings
        self._socket: socket.socket | None = None

    def get(self, path: str) -> str:
        """Return the answer to a request for a path of the page; raise OSError without one."""
        settings = self._settings
        connection = http.client.HTTPConnection(settings.host, settings.http_port, _TIMEOUT_S)
        try:
            connection.request("GET", path)
            answer = connection.getresponse()
            content = answer.read(_MAX_PAGE_BYTES)
        except http.client.HTTPException as error:
            raise OSError(str(error)) from error
        finally:
            connection.close()
        if answer.status not in (200, 302):
            raise OSError(f"HTTP status {answer.status}")
        return content.decode("utf-8", errors="replace")

    def open(self) -> None:
        """Open the socket for requests and records."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        self._socket.setblocking(False)
        # Connected, the kernel drops packets from elsewhere.
        self._socket.connect((self._settings.host, self._settings.port))

    def send(self, request: bytes) -> None:
        """Send a request; nothing tells whether it arrives."""
        if self._socket is not None:
            with contextlib.suppress(OSError):  # nobody listens there: no record will come
                self._socket.send(request)

    def receive(self, _due_ns: int) -> tuple[list[bytes], int]:
        """Return the packets that have arrived, so that none waits for a later tick, and the time.

        The argument is for a simulated box.
        """
        assert self._socket is not None
        receive, packets = self._socket.recv, list[bytes]()
        try:
            while len(packets) < _MAX_PACKETS_PER_TICK:
                packets.append(receive(64))
        except OSError:  # nothing is there, or the box answered that its port is closed
            pass
        return packets, time.monotonic_ns()

    def close(self) -> None:
        """Release the socket; never raises."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
