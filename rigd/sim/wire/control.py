"""The control socket of a simulated rig: one line of JSON asks, one line answers."""

import json
import socket
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from rigd.devices.contracts import DeviceError
from rigd.devices.simulator import SimulatorAddress
from rigd.sim.wire.hub import Handlers, listen

Answer = Callable[[dict[str, Any]], dict[str, Any]]
"""Answers a request."""

_LONGEST_LINE = 65_536
_TIMEOUT_S = 2.0


class ControlSocket:
    """Answers requests of other processes, within the event loop.

    Parameters
    ----------
    path
        Of the Unix socket.
    handlers
        Of the event loop; kept up to date.
    answer
        Takes a request, returns the reply.
    """

    def __init__(self, path: Path, handlers: Handlers, answer: Answer) -> None:
        self._handlers = handlers
        self._answer = answer
        self._links: dict[socket.socket, bytes] = {}
        self._path = path
        self._listener = listen(path)
        handlers[self._listener.fileno()] = self._accept

    def close(self) -> None:
        """Answer no more."""
        for link in list(self._links):
            self._drop(link)
        del self._handlers[self._listener.fileno()]
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        with suppress(OSError):
            link, _ = self._listener.accept()
            link.setblocking(False)
            self._links[link] = b""
            self._handlers[link.fileno()] = lambda: self._receive(link)

    def _receive(self, link: socket.socket) -> None:
        try:
            fresh = link.recv(_LONGEST_LINE)
        except BlockingIOError:
            return
        except OSError:
            fresh = b""
        *lines, rest = (self._links[link] + fresh).split(b"\n")
        if not fresh or len(rest) > _LONGEST_LINE:
            self._drop(link)
            return
        self._links[link] = rest
        for line in lines:
            with suppress(OSError):  # who asks and does not read gets no answer
                link.send(json.dumps(self._reply(line)).encode() + b"\n")

    def _reply(self, line: bytes) -> dict[str, Any]:
        try:
            request = json.loads(line)
        except ValueError:
            request = None
        if not isinstance(request, dict):
            return {"error": "A request is one line with one JSON object."}
        return self._answer(request)

    def _drop(self, link: socket.socket) -> None:
        del self._links[link]
        del self._handlers[link.fileno()]
        link.close()


def ask(address: SimulatorAddress, request: dict[str, Any]) -> dict[str, Any]:
    """Ask a running simulator, and return its reply.

    Raises
    ------
    DeviceError
        If it does not answer, or refuses; then with its own words.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
            link.settimeout(_TIMEOUT_S)
            link.connect(address.control_socket)
            link.sendall(json.dumps(request).encode() + b"\n")
            with link.makefile("rb") as lines:
                reply = json.loads(lines.readline(_LONGEST_LINE))
    except (OSError, ValueError) as error:
        raise DeviceError(
            f"The simulated rig (process {address.pid}) does not answer ({error}); start it again."
        ) from None
    if not isinstance(reply, dict) or "error" in reply:
        raise DeviceError(str(reply["error"] if isinstance(reply, dict) else reply))
    return reply
