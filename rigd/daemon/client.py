"""Client of the daemon: a blocking connection, and a persistent stop."""

import json
import os
import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rigd.daemon.address import peer_of, running
from rigd.errors import FailureError, RigdError
from rigd.live.address import LiveAddress
from rigd.live.address import running as running_views
from rigd.runtime import STOP_SIGNAL
from rigd.runtime.processes import read_process, read_processes, send_signal

Document = dict[str, Any]

_ANSWER_PATIENCE_S = 60.0
"""Timeout of a reply; reconnecting the devices takes up to half of it."""
_CONNECT_PATIENCE_S = 5.0
_CROWD_PATIENCE_S = 10.0
"""Time of repeated attempts to reach a daemon that has too many clients."""
_STOP_PATIENCE_S = 10.0
_STOP_ANSWER_S = 0.5
_SIGNAL_AFTER_S = 0.3
_END_PATIENCE_S = 3.0
"""Time in which the other processes of a dead daemon end by themselves."""
_PAUSE_S = 0.02
_POLL_S = 0.1
_TIME = struct.Struct("@ll")
UNKNOWN_STATE = (
    "A session may still be running: check the rig, and press the wired stop (STO) if "
    "anything moves."
)


# Connection


class DaemonGoneError(FailureError):
    """The daemon cannot be reached, or is gone; the message is for the operator.

    Parameters
    ----------
    message
        Message that needs no further examination.
    lost
        Process and user of a daemon whose connection was lost; None: the message is complete.
    """

    def __init__(self, message: str, lost: tuple[int, int] | None = None) -> None:
        super().__init__(message)
        self._lost = lost

    def full_message(self) -> str:
        """Return the message; for a lost daemon, after up to 3 s, with what still runs."""
        return str(self) if self._lost is None else describe_remains(*self._lost)


class RefusedByDaemonError(RigdError):
    """The daemon refused a request, or the request failed; the message is the daemon's.

    Parameters
    ----------
    message
        Reason that the daemon gives, for the operator.
    wrong_use
        Whether the request itself must change (exit code 2); otherwise it may succeed later.
    """

    def __init__(self, message: str, *, wrong_use: bool) -> None:
        super().__init__(message)
        self.wrong_use = wrong_use


class Client:
    """A connection to a daemon; leaving its context closes it.

    Parameters
    ----------
    path
        Path of the socket.
    connect_s
        Time to connect: the daemon may be suspended, or overloaded by other clients.
    answer_s
        Time to receive a reply.

    Attributes
    ----------
    pid, uid
        Process and user that listen there, as the kernel reports them.

    Raises
    ------
    DaemonGoneError
        If no process listens there, or the connection is not accepted in time.
    """

    def __init__(
        self,
        path: Path,
        connect_s: float = _CONNECT_PATIENCE_S,
        answer_s: float = _ANSWER_PATIENCE_S,
    ) -> None:
        self._path = path
        self._connect_s = connect_s
        self._answer_s = answer_s
        self._events: deque[Document] = deque()
        self._connect()

    def _connect(self) -> None:
        self._pending = b""
        self._link = link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            # The kernel's own time-out: with Python's, a full queue is a failure at once.
            patience = _TIME.pack(*divmod(round(self._connect_s * 1e6), 1_000_000))
            link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, patience)
            link.connect(str(self._path))
            self.pid, self.uid = peer_of(link)
        except BlockingIOError:
            link.close()
            raise DaemonGoneError(
                f"The daemon on {self._path} takes no connection within {self._connect_s:g} s: "
                f"it is suspended, or overloaded by other clients. {UNKNOWN_STATE}"
            ) from None
        except OSError as error:
            link.close()
            raise DaemonGoneError(
                f"The daemon on {self._path} cannot be reached ({error.strerror or error})."
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
        """Close the connection; sessions continue."""
        self._link.close()

    def ask(self, command: str, **fields: object) -> Document:
        """Send a request and return its reply; events that arrive meanwhile are stored.

        If the daemon refuses the client because there are too many, the request was not executed,
        and is repeated.

        Parameters
        ----------
        command
            A request of docs/control_socket.md.
        **fields
            Its further fields.

        Returns
        -------
        dict
            The reply.

        Raises
        ------
        RefusedByDaemonError
            If the reply is a refusal.
        DaemonGoneError
            If there is no reply.
        """
        return self.ask_unless(lambda: False, command, **fields)

    def ask_unless(self, stopped: Callable[[], bool], command: str, **fields: object) -> Document:
        """Send a request as :meth:`ask` does, and cancel it if a stop is requested.

        Parameters
        ----------
        stopped
            Returns whether a stop is requested; polled until there is a reply.
        command
            A request of docs/control_socket.md that a `stop` cancels.
        **fields
            Its further fields.

        Returns
        -------
        dict
            Reply to the request, or to the `stop` that cancelled it (``reply`` says which).

        Raises
        ------
        RefusedByDaemonError
            If the reply is a refusal.
        DaemonGoneError
            If there is none.
        """
        deadline_s = time.monotonic() + min(_CROWD_PATIENCE_S, self._answer_s)
        while True:
            try:
                return self._ask_once(command, fields, stopped)
            except _CrowdedError:
                if time.monotonic() > deadline_s:
                    raise
                time.sleep(_PAUSE_S)
                self.close()
                self._connect()

    def _ask_once(
        self, command: str, fields: dict[str, object], stopped: Callable[[], bool]
    ) -> Document:
        self.send(command, **fields)
        stopping = False
        deadline_s = time.monotonic() + self._answer_s
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            if stopped() and not stopping:
                # On this connection: on another one the stop might be executed before the request.
                self.send("stop")
                stopping = True
                deadline_s = min(deadline_s, time.monotonic() + _STOP_PATIENCE_S)
            message = self._next(min(left_s, _POLL_S))
            if message is None:
                continue
            if "event" in message:
                self._events.append(message)
            elif not message.get("ok"):
                raise _refusal(message)
            else:
                return message
        raise DaemonGoneError(
            f"The daemon (process {self.pid}) does not answer within {self._answer_s:g} s. "
            f"{UNKNOWN_STATE}"
        )

    def send(self, command: str, **fields: object) -> None:
        """Send a request without waiting for its reply.

        Parameters
        ----------
        command
            A request of docs/control_socket.md.
        **fields
            Its further fields.

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
            # The daemon may have sent the reason before it closed.
            self._raise_refusal()
            raise self._gone() from None

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
                raise self._gone()
            self._pending += data
        line, self._pending = self._pending.split(b"\n", 1)
        try:
            message = json.loads(line)
        except ValueError:
            message = None
        if not isinstance(message, dict):
            raise DaemonGoneError("The process on the socket is not a daemon of this version.")
        return message

    def _raise_refusal(self) -> None:
        try:
            while (message := self._next(0.1)) is not None:
                if "error" in message:
                    raise _refusal(message)
        except DaemonGoneError:
            return

    def _gone(self) -> DaemonGoneError:
        return DaemonGoneError(
            f"The connection to the daemon (process {self.pid}) is lost.", (self.pid, self.uid)
        )


class _CrowdedError(RefusedByDaemonError):
    """The daemon did not execute the request, because there were too many clients."""


def _refusal(message: Document) -> RefusedByDaemonError:
    kind = _CrowdedError if message.get("crowded") else RefusedByDaemonError
    return kind(str(message.get("error", message)), wrong_use=bool(message.get("wrong_use")))


# Stop


def stop_session(path: Path) -> Document:
    """Stop the session of a daemon: repeat the request, then send its process a signal.

    Parameters
    ----------
    path
        Path of its socket.

    Returns
    -------
    dict
        The reply, with ``signalled``: whether the signal was sent before, so that the session may
        have ended before the reply; and ``peer``: process and user that replied.

    Raises
    ------
    RefusedByDaemonError
        If it refuses.
    DaemonGoneError
        If it has not confirmed the stop for 10 s; the message states what was done and found.
    """
    began_s = time.monotonic()
    seen: tuple[int, int] | None = None
    signalled = False
    answer_s = _STOP_ANSWER_S
    while True:
        try:
            with Client(path, answer_s, answer_s) as client:
                seen = client.pid, client.uid
                return client.ask("stop") | {"signalled": signalled, "peer": seen}
        except (DaemonGoneError, _CrowdedError) as error:
            failure = str(error)
        waited_s = time.monotonic() - began_s
        if seen is not None and not signalled and waited_s > _SIGNAL_AFTER_S:
            signalled = _signal_stop(seen[0])
        if waited_s > _STOP_PATIENCE_S or not path.exists():
            break
        # A daemon that is starved of processor time obeys, and answers late.
        answer_s = min(2.0 * answer_s, _STOP_PATIENCE_S)
        time.sleep(_PAUSE_S)
    if seen is None:
        raise DaemonGoneError(failure)
    if not signalled:
        raise DaemonGoneError(failure, seen)
    raise DaemonGoneError(
        f"The daemon (process {seen[0]}) was sent {STOP_SIGNAL.name}, which asks it to stop, and "
        f"has not replied for {waited_s:.0f} s. {UNKNOWN_STATE}"
    )


def await_end(
    path: Path, patience_s: float, peer: tuple[int, int] | None = None
) -> Document | None:
    """Wait until a daemon reports that no session runs.

    Parameters
    ----------
    path
        Socket of the daemon.
    patience_s
        Longest wait.
    peer
        Process and user that must reply; None: any.

    Returns
    -------
    dict or None
        Final status; None if the session has not ended in time, or too many clients block this one.

    Raises
    ------
    RefusedByDaemonError, DaemonGoneError
        If the daemon no longer replies.
    """
    deadline_s = time.monotonic() + patience_s
    with Client(path, answer_s=patience_s) as client:
        if peer not in (None, (client.pid, client.uid)):
            raise DaemonGoneError(f"Another process listens on {path} now. {UNKNOWN_STATE}")
        while True:
            try:
                status = client.ask("status")
            except _CrowdedError:
                return None
            series = status["series"]
            # A stop during planning takes effect after it, before the session begins.
            if status["state"] not in ("running", "stopping") and (
                series is None
                or not series["running"]
                or (series.get("stopped") and status.get("doing") == "planning")
            ):
                return status
            if time.monotonic() > deadline_s:
                return None
            time.sleep(_PAUSE_S)


def describe_remains(pid: int, uid: int) -> str:
    """Return which processes of an unresponsive daemon still run, after some seconds.

    Parameters
    ----------
    pid, uid
        Process id and user id of the daemon.
    """
    deadline_s = time.monotonic() + _END_PATIENCE_S
    while True:
        daemon, control = _is_there(pid), _control_processes(pid)
        if not (daemon or control) or time.monotonic() > deadline_s:
            break
        time.sleep(_PAUSE_S)
    if daemon:
        return (
            f"The connection to the daemon (process {pid}) is lost, though it runs; see rigd "
            f"status. {UNKNOWN_STATE}"
        )
    begin_again = "see the daemon's log for the cause, and start it again with rigd serve."
    if control:
        return (
            f"The daemon is gone (process {pid}), and its control process {control[0]} still runs "
            "and may move the motor: press the wired stop (STO). Then " + begin_again
        )
    if uid != os.getuid() and not _sees_other_users():
        return f"The daemon is gone (process {pid}). {UNKNOWN_STATE} Then {begin_again}"
    return (
        "The daemon is gone. Its control process, which alone moves the motor, has ended too: "
        "check that the rig is at rest. What was recorded of a session is in the daemon's output "
        f"folder; {begin_again}"
    )


def _is_there(pid: int) -> bool:
    """Return whether a process with that id runs, of any user."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    with suppress(OSError, IndexError):  # a zombie, which its parent has not reaped yet
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return True


def _sees_other_users() -> bool:
    """Return whether /proc shows the processes of other users (mount option hidepid)."""
    try:
        return bool(Path("/proc/1/cmdline").read_bytes())
    except OSError:
        return False


def _control_processes(pid: int) -> list[int]:
    """Return the control processes of a supervisor, whose only argument is its process id."""
    from rigd.engine import supervisor_of_control

    with suppress(OSError):
        return [
            process.pid
            for process in read_processes()
            if supervisor_of_control(process.command) == pid
        ]
    return []


def _signal_stop(pid: int) -> bool:
    """Send the stop signal to a process that handles it; it would kill others."""
    process = read_process(pid)
    if process is None or not process.handles(STOP_SIGNAL):
        return False
    born = process.born
    return born is not None and send_signal(process, born, STOP_SIGNAL)


# Running daemons


def find_views(rig: str | None) -> list[LiveAddress]:
    """Return the live views of a rig, or of all.

    Parameters
    ----------
    rig
        The profile's name; None: of any.
    """
    own = running_views()
    views = [view for view in own if rig in (None, view.rig)]
    if not views:
        # The runtime folder of another user's daemon is not readable.
        found = (_of_daemon(path) for path in running())
        views = [view for view in found if view is not None and rig in (None, view.rig)]
    return views


def daemons() -> dict[str, bool]:
    """Return the rigs with a daemon, and for each whether the daemon has a live view."""
    found = (_status(path) for path in running())
    return {
        status["daemon"]["profile"]: status["daemon"]["live"]
        for status in found
        if status is not None
    }


def _of_daemon(path: Path) -> LiveAddress | None:
    status = _status(path)
    view = None if status is None or status["rig"] is None else status["rig"]["live_view"]
    if view is None:
        return None
    return LiveAddress(**{field.name: view[field.name] for field in fields(LiveAddress)})


def _status(path: Path) -> dict[str, Any] | None:
    try:
        with Client(path) as client:
            return client.ask("status")
    except RigdError:
        return None
