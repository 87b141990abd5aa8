"""Server of the live view, which forwards the publisher's drawings to any number of viewers.

It is a separate process so that a slow or frozen viewer delays nothing else, and because the SDK's
own server listens on every interface. Viewers connect without authentication, so the server must
never be reachable from another computer.
"""

import socket
import time
from contextlib import suppress
from typing import Final

from rigd.live._page import serve_page
from rigd.live._program import RerunError, RerunProgram
from rigd.live.address import LOOPBACK, LiveAddress, announce, withdraw

GRPC_PORT: Final = 9876
"""Rerun's default port, which viewers use by default and tunnels can forward in advance."""
_BACKLOG: Final = "16MiB"
"""Stored data for viewers that connect late: about 80 s."""
_MOST_SESSIONS: Final = 20
"""Sessions per server: each leaves about 300 kB of layout and charts in it."""
_START_S: Final = 15.0
"""Longest start of a server, on a busy computer."""
_ANSWER_S: Final = 0.1
_PAUSE_S: Final = 1.0
"""Least time between two starts of a server."""


class Outlet:
    """A Rerun server that is replaced when it ends, with its announced address.

    Parameters
    ----------
    rig
        The profile's name.

    Attributes
    ----------
    address
        Address of the present server; None while none accepts connections.

    Raises
    ------
    RerunError
        If Rerun's program cannot be started.
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
        while not self.poll():
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

    def poll(self) -> bool:
        """Check and replace the server if necessary; return whether it accepts connections."""
        program = self._program
        if program.running and program.grpc_port and program.page_port:
            if self.address is None:
                self._announce()
            return True
        self.address = None
        age_s = time.monotonic() - self._started_s
        if age_s > _START_S:
            # It mistook a listener on its port for another Rerun server, and serves nothing.
            program.kill()
        if age_s > _PAUSE_S and not program.running:
            self._replace()
        return False

    def answers(self) -> bool:
        """Return whether the server accepts connections: otherwise the SDK would wait 5 s."""
        try:
            socket.create_connection((LOOPBACK, self._grpc_port), _ANSWER_S).close()
        except OSError:
            return False
        return True

    def begin_session(self) -> None:
        """Count a session; replace the server after many, because it never frees their data."""
        self._sessions += 1
        if self._sessions > _MOST_SESSIONS:
            self.kill_server()

    def kill_server(self) -> None:
        """Kill the server, which is then replaced."""
        self._program.kill()

    def close(self) -> None:
        """End the server and withdraw its address."""
        self._program.kill()
        self._page.close()
        if self._announced is not None:
            with suppress(OSError):  # readers of the file notice that its process has ended
                withdraw(self._announced)

    def _replace(self) -> None:
        """Start another server, on the same port for viewers and tunnels.

        If the last one never served, the port was taken, and the system chooses another.
        """
        if not self._program.grpc_port:
            self._grpc_port = 0
        with suppress(RerunError):  # `poll` tries again
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

    def _announce(self) -> None:
        self._grpc_port = self._program.grpc_port
        self.address = self._announced = LiveAddress.of_this_process(
            self._rig, self._grpc_port, self._page.port, time.time_ns()
        )
        with suppress(OSError):  # the view works nevertheless
            announce(self.address)


def free_port(wanted: int) -> int:
    """Return a port if no process listens on it, or 0, with which the system chooses one.

    Rerun's program cannot check this itself: it may mistake a listener for another Rerun server.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        # Connections of a server that has just ended do not count.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, wanted))
        except OSError:
            return 0
    return wanted
