"""Simulated Net F/T box on the loopback interface, for the driver's sockets and for others."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler
from socketserver import TCPServer

from rigd_netft.box import SimulatedBox


@contextlib.contextmanager
def serve_page(box: SimulatedBox) -> Iterator[int]:
    """Serve the page of a box in this context, and yield its port."""

    class PageHandler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            try:
                content = box.get_page(self.path).encode()
            except OSError:
                self.send_error(404)
            else:
                self.send_response(200 if content else 302)
                self.end_headers()
                self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            pass

    # Not HTTPServer, which resolves the name of the computer and may wait for seconds.
    with TCPServer(("127.0.0.1", 0), PageHandler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield server.server_address[1]
        finally:
            server.shutdown()
            thread.join()


class UdpBox:
    """Box that answers requests by UDP and streams to the client of the last request."""

    def __init__(self, box: SimulatedBox) -> None:
        self.box = box
        self._client: tuple[str, int] | None = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]

    def stream(self, is_ended: Callable[[], bool], period_s: float) -> None:
        """Stream by the clock until a function returns True."""
        due_s = time.monotonic()
        while not is_ended():
            due_s += period_s
            time.sleep(max(0.0, due_s - time.monotonic()))
            with contextlib.suppress(BlockingIOError):
                while True:
                    request, self._client = self._socket.recvfrom(64)
                    self.box.send(request)
            for packet in self.box.packets(period_s):
                self._socket.sendto(packet, self._client or ("", 0))

    @contextlib.contextmanager
    def streaming(self, period_s: float = 1e-3) -> Iterator["UdpBox"]:
        """Stream in a thread while this context lasts."""
        ended = threading.Event()
        thread = threading.Thread(target=self.stream, args=(ended.is_set, period_s))
        thread.start()
        try:
            yield self
        finally:
            ended.set()
            thread.join()
            self._socket.close()
