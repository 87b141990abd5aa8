"""The daemon as its clients see it: one blocking connection."""

import json
import socket
import time
from collections import deque
from pathlib import Path
from types import TracebackType
from typing import Any, Self

Document = dict[str, Any]

_ANSWER_PATIENCE_S = 60.0
"""Connecting the devices anew takes up to half of it."""
_GONE = (
    "The daemon is gone. A session that it ran is stopped, and its file kept; see the daemon's log "
    "for why, and start it again with rigd serve."
)


class DaemonGoneError(Exception):
    """The daemon cannot be reached, or is gone; the message is for the operator."""


class RefusedByDaemonError(Exception):
    """The daemon refuses a request, or it failed; the message is the daemon's."""

    def __init__(self, message: str, *, wrong_use: bool) -> None:
        super().__init__(message)
        self.wrong_use = wrong_use


class Client:
    """A connection to a daemon; leaving its context closes it.

    Parameters
    ----------
    path
        Of the socket.

    Raises
    ------
    DaemonGoneError
        If nobody listens there.
    """

    def __init__(self, path: Path) -> None:
        self._link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._pending = b""
        self._events: deque[Document] = deque()
        try:
            self._link.connect(str(path))
        except OSError as error:
            self._link.close()
            raise DaemonGoneError(
                f"The daemon on {path} cannot be reached ({error.strerror or error})."
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let the daemon go; what was started goes on."""
        self._link.close()

    def ask(self, command: str, **fields: object) -> Document:
        """Send a request and wait for its reply; events that come meanwhile are kept.

        Raises
        ------
        RefusedByDaemonError
            If the reply is a refusal.
        DaemonGoneError
            If there is none.
        """
        self.send(command, **fields)
        deadline_s = time.monotonic() + _ANSWER_PATIENCE_S
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            message = self._next(left_s)
            if message is None:
                continue
            if "event" in message:
                self._events.append(message)
            elif not message.get("ok"):
                raise RefusedByDaemonError(
                    str(message.get("error", message)), wrong_use=bool(message.get("wrong_use"))
                )
            else:
                return message
        raise DaemonGoneError(f"The daemon does not answer within {_ANSWER_PATIENCE_S:g} s.")

    def send(self, command: str, **fields: object) -> None:
        """Send a request whose reply nobody waits for.

        Raises
        ------
        DaemonGoneError
            If it cannot be sent.
        """
        line = json.dumps({"command": command, **fields}).encode() + b"\n"
        try:
            self._link.settimeout(_ANSWER_PATIENCE_S)
            self._link.sendall(line)
        except OSError:
            # It may have said why before it left.
            self._raise_what_was_said()
            raise DaemonGoneError(_GONE) from None

    def event(self, timeout_s: float) -> Document | None:
        """Return the next event (or reply), or None if none comes in time.

        Raises
        ------
        DaemonGoneError
            If the daemon is gone.
        """
        return self._events.popleft() if self._events else self._next(timeout_s)

    def _next(self, timeout_s: float) -> Document | None:
        deadline_s = time.monotonic() + timeout_s
        while b"\n" not in self._pending:
            self._link.settimeout(max(1e-3, deadline_s - time.monotonic()))
            try:
                data = self._link.recv(65_536)
            except TimeoutError:
                return None
            except OSError:
                data = b""
            if not data:
                raise DaemonGoneError(_GONE)
            self._pending += data
        line, self._pending = self._pending.split(b"\n", 1)
        try:
            message = json.loads(line)
        except ValueError:
            message = None
        if not isinstance(message, dict):
            raise DaemonGoneError("What answers on the socket is no daemon of this version.")
        return message

    def _raise_what_was_said(self) -> None:
        try:
            while (message := self._next(0.1)) is not None:
                if "error" in message:
                    raise RefusedByDaemonError(str(message["error"]), wrong_use=False)
        except DaemonGoneError:
            return
