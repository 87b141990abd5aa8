"""Rerun server of the live view, which forwards the publisher's drawings to all viewers.

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
"""Preferred port of the server, Rerun's default.

Viewers use it by default, and tunnels can forward it in advance."""
_SERVER_MEMORY_LIMIT: Final = "16MiB"
"""Size of the data that the server stores for viewers that connect late: about 80 s of signals."""
_MAX_SESSIONS_PER_SERVER: Final = 20
"""Number of sessions after which a server is replaced.

Each session leaves about 300 kB of layout and charts in the server."""
_START_TIMEOUT_S: Final = 15.0
"""Longest time in seconds for the start of a server, on a busy computer."""
_CONNECT_TIMEOUT_S: Final = 0.1
"""Timeout in seconds of the test whether the server accepts connections."""
_MIN_RESTART_INTERVAL_S: Final = 1.0
"""Shortest time in seconds between two starts of a server."""


class RerunServer:
    """Rerun server of the live view, which is restarted when it ends and announces its address.

    `address` is None while no server accepts connections. The constructor raises `RerunError` if
    Rerun's program cannot be started.
    """

    def __init__(self, rig_name: str) -> None:
        self.address: LiveAddress | None = None
        self._announced_address: LiveAddress | None = None
        self._rig = rig_name
        self._grpc_port = free_port(GRPC_PORT)
        self._page = serve_page(lambda: self.address, lambda: self._program.page_port)
        self._start_program()

    def wait(self) -> LiveAddress:
        """Wait until the first server accepts connections, and return its address.

        Raise `RerunError` if the server ends or accepts no connections.
        """
        deadline_s = time.monotonic() + 2 * _START_TIMEOUT_S
        while not self.poll():
            if not self._program.running:
                if not self._grpc_port:
                    raise RerunError(f"The Rerun server ended: {self._program.last_log_lines}.")
                self._restart()
            if time.monotonic() > deadline_s:
                self.close()
                raise RerunError(
                    f"The Rerun server does not answer: {self._program.last_log_lines}."
                )
            time.sleep(0.01)
        assert self.address is not None
        return self.address

    def poll(self) -> bool:
        """Restart the server if it has ended, and return whether a server accepts connections."""
        program = self._program
        if program.running and program.grpc_port and program.page_port:
            if self.address is None:
                self._announce()
            return True
        self.address = None
        program_age_s = time.monotonic() - self._started_s
        if program_age_s > _START_TIMEOUT_S:
            # The program mistook a listener on its port for another Rerun server.
            program.kill()
        if program_age_s > _MIN_RESTART_INTERVAL_S and not program.running:
            self._restart()
        return False

    def accepts_connections(self) -> bool:
        """Return whether the server accepts a connection now; the SDK itself would wait 5 s."""
        try:
            socket.create_connection((LOOPBACK, self._grpc_port), _CONNECT_TIMEOUT_S).close()
        except OSError:
            return False
        return True

    def count_session(self) -> None:
        """Count a session, and replace the server after many of them.

        Rerun's server never frees the data of a session.
        """
        self._sessions += 1
        if self._sessions > _MAX_SESSIONS_PER_SERVER:
            self.kill_server()

    def kill_server(self) -> None:
        """Kill the server; the next `poll` replaces it."""
        self._program.kill()

    def close(self) -> None:
        """End the server, and delete the file with its address."""
        self._program.kill()
        self._page.close()
        if self._announced_address is not None:
            with suppress(OSError):  # readers of the file notice that its process has ended
                withdraw(self._announced_address)

    def _restart(self) -> None:
        """Start another server, if possible on the same port for viewers and tunnels.

        If the last server never accepted connections, the port was taken, and the system chooses
        another one.
        """
        if not self._program.grpc_port:
            self._grpc_port = 0
        with suppress(RerunError):  # `poll` tries again
            self._start_program()

    def _start_program(self) -> None:
        """Start Rerun's program as a server."""
        self._started_s = time.monotonic()
        self._sessions = 0
        self._program = RerunProgram(
            (
                "--serve-web",
                *("--port", str(self._grpc_port)),
                *("--web-viewer-port", "0"),
                *("--server-memory-limit", _SERVER_MEMORY_LIMIT),
            )
        )

    def _announce(self) -> None:
        """Write the address of the new server to the address file, in which viewers find it."""
        self._grpc_port = self._program.grpc_port
        self.address = self._announced_address = LiveAddress.for_this_process(
            self._rig, self._grpc_port, self._page.port, time.time_ns()
        )
        with suppress(OSError):  # the view works nevertheless
            announce(self.address)


def free_port(preferred_port: int) -> int:
    """Return the port `preferred_port` if no process listens on it, otherwise 0.

    For port 0 the system chooses a free port. Rerun's program cannot check the port itself: it may
    mistake a listener for another Rerun server.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as test_socket:
        # Connections of a server that has just ended do not count.
        test_socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            test_socket.bind((LOOPBACK, preferred_port))
        except OSError:
            return 0
    return preferred_port
