"""Client side of the daemon's socket: a blocking connection, and requests to stop a session."""

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

from rigd.daemon.address import peer_pid_and_uid, running_daemon_sockets
from rigd.errors import FailureError, RigdError
from rigd.live.address import LiveAddress
from rigd.live.address import running as running_views
from rigd.runtime import STOP_SIGNAL
from rigd.runtime.processes import read_process, read_processes, send_signal

Document = dict[str, Any]

_REPLY_TIMEOUT_S = 60.0
"""Maximum time in seconds for a reply; connecting the devices again takes up to half of it."""
_CONNECT_TIMEOUT_S = 5.0
"""Maximum time in seconds to connect to the daemon."""
_TOO_MANY_CLIENTS_TIMEOUT_S = 10.0
"""Time in seconds for which a request is repeated if the daemon has too many clients."""
_STOP_TIMEOUT_S = 10.0
"""Maximum time in seconds until a daemon must have confirmed a stop."""
_FIRST_STOP_REPLY_TIMEOUT_S = 0.5
"""Time in seconds for the reply to the first attempt to stop; it is doubled at each attempt."""
_STOP_SIGNAL_DELAY_S = 0.3
"""Time in seconds without confirmation after which the daemon is also stopped by a signal."""
_PROCESS_END_TIMEOUT_S = 3.0
"""Time in seconds in which the other processes of a dead daemon end by themselves."""
_RETRY_PAUSE_S = 0.02
"""Pause in seconds between two attempts."""
_STOP_POLL_INTERVAL_S = 0.1
"""Time in seconds between two checks whether a stop was requested."""
_TIMEVAL_FORMAT = struct.Struct("@ll")
"""Format of the kernel's time value: seconds and microseconds."""
UNKNOWN_STATE_ADVICE = (
    "A session may still be running: check the rig, and press the wired stop (STO) if "
    "anything moves."
)


# Connection


class DaemonUnreachableError(FailureError):
    """Raised if the daemon cannot be reached, or the connection to it was lost.

    Parameters
    ----------
    message
        Text for the operator.
    lost_pid_and_uid
        Process id and user id of a daemon whose connection was lost; None if `message` needs no
        report on the processes that it leaves.
    """

    def __init__(self, message: str, lost_pid_and_uid: tuple[int, int] | None = None) -> None:
        super().__init__(message)
        self._lost_pid_and_uid = lost_pid_and_uid

    def full_message(self) -> str:
        """Return the message for the operator; this may take up to 3 s.

        If the connection was lost, the message states which processes of the daemon still run.
        """
        return (
            str(self)
            if self._lost_pid_and_uid is None
            else describe_remaining_processes(*self._lost_pid_and_uid)
        )


class RefusedByDaemonError(RigdError):
    """Raised if the daemon refused a request, or the request failed.

    Parameters
    ----------
    message
        Reason that the daemon states, for the operator.
    wrong_use
        Whether the request can succeed only if it is changed (exit code 2).
    """

    def __init__(self, message: str, *, wrong_use: bool) -> None:
        super().__init__(message)
        self.wrong_use = wrong_use


class Client:
    """Connection to a daemon, which is closed at the end of its context.

    Parameters
    ----------
    path
        Path of the daemon's socket.
    connect_timeout_s
        Maximum time to connect. The daemon may be suspended, or overloaded by other clients.
    reply_timeout_s
        Maximum time to receive a reply.

    Attributes
    ----------
    pid, uid
        Process id and user id of the daemon, as the kernel reports them.

    Raises
    ------
    DaemonUnreachableError
        If no process listens on the socket, or the connection is not accepted in time.
    """

    def __init__(
        self,
        path: Path,
        connect_timeout_s: float = _CONNECT_TIMEOUT_S,
        reply_timeout_s: float = _REPLY_TIMEOUT_S,
    ) -> None:
        self._path = path
        self._connect_timeout_s = connect_timeout_s
        self._reply_timeout_s = reply_timeout_s
        self._events: deque[Document] = deque()
        self._connect()

    def _connect(self) -> None:
        """Connect to the daemon; raise DaemonUnreachableError if that fails or takes too long."""
        self._received = b""
        self._socket = new_socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            # The timeout of the kernel is used, because with Python's a full queue fails at once.
            packed_timeout = _TIMEVAL_FORMAT.pack(
                *divmod(round(self._connect_timeout_s * 1e6), 1_000_000)
            )
            new_socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, packed_timeout)
            new_socket.connect(str(self._path))
            self.pid, self.uid = peer_pid_and_uid(new_socket)
        except BlockingIOError:
            new_socket.close()
            raise DaemonUnreachableError(
                f"The daemon on {self._path} accepts no connection within "
                f"{self._connect_timeout_s:g} s: it is suspended, or overloaded by other clients. "
                f"{UNKNOWN_STATE_ADVICE}"
            ) from None
        except OSError as error:
            new_socket.close()
            raise DaemonUnreachableError(
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
        """Close the connection; a running session continues."""
        self._socket.close()

    def ask(self, command: str, **request_fields: object) -> Document:
        """Send a request to the daemon, and return its reply.

        Events that arrive meanwhile are stored for :meth:`next_event`. If the daemon has too many
        clients, the request is repeated.

        Parameters
        ----------
        command
            Name of a request in docs/control_socket.md.
        **request_fields
            Further fields of the request.

        Returns
        -------
        dict
            Reply of the daemon.

        Raises
        ------
        RefusedByDaemonError
            If the daemon refuses the request.
        DaemonUnreachableError
            If the daemon does not reply.
        """
        return self.request_unless_stopped(lambda: False, command, **request_fields)

    def request_unless_stopped(
        self, is_stop_requested: Callable[[], bool], command: str, **request_fields: object
    ) -> Document:
        """Send a request like :meth:`ask`, but cancel it if a stop is requested meanwhile.

        Parameters
        ----------
        is_stop_requested
            Function that returns whether a stop is requested; called until the reply arrives.
        command
            Name of a request in docs/control_socket.md that a request `stop` cancels.
        **request_fields
            Further fields of the request.

        Returns
        -------
        dict
            Reply to the request, or to the `stop` that cancelled it; ``reply`` states which.

        Raises
        ------
        RefusedByDaemonError
            If the daemon refuses the request.
        DaemonUnreachableError
            If the daemon does not reply.
        """
        deadline_s = time.monotonic() + min(_TOO_MANY_CLIENTS_TIMEOUT_S, self._reply_timeout_s)
        while True:
            try:
                return self._request_once(command, request_fields, is_stop_requested)
            except _TooManyClientsError:
                if time.monotonic() > deadline_s:
                    raise
                time.sleep(_RETRY_PAUSE_S)
                self.close()
                self._connect()

    def _request_once(
        self, command: str, request_fields: dict[str, object], is_stop_requested: Callable[[], bool]
    ) -> Document:
        """Send a request once, and return its reply; after a stop, that to the request `stop`."""
        self.send(command, **request_fields)
        is_stop_sent = False
        deadline_s = time.monotonic() + self._reply_timeout_s
        while (remaining_s := deadline_s - time.monotonic()) > 0.0:
            if is_stop_requested() and not is_stop_sent:
                # It is sent on the same connection, because on another connection the stop might be
                # executed before the request.
                self.send("stop")
                is_stop_sent = True
                deadline_s = min(deadline_s, time.monotonic() + _STOP_TIMEOUT_S)
            reply_message = self._next_message(min(remaining_s, _STOP_POLL_INTERVAL_S))
            if reply_message is None:
                continue
            if "event" in reply_message:
                self._events.append(reply_message)
            elif not reply_message.get("ok"):
                raise _refusal_error(reply_message)
            else:
                return reply_message
        raise DaemonUnreachableError(
            f"The daemon (process {self.pid}) does not answer within {self._reply_timeout_s:g} s. "
            f"{UNKNOWN_STATE_ADVICE}"
        )

    def send(self, command: str, **request_fields: object) -> None:
        """Send a request without waiting for its reply.

        Parameters
        ----------
        command
            Name of a request in docs/control_socket.md.
        **request_fields
            Further fields of the request.

        Raises
        ------
        DaemonUnreachableError
            If the request cannot be sent.
        """
        request_line = json.dumps({"command": command, **request_fields}).encode() + b"\n"
        try:
            self._socket.settimeout(_REPLY_TIMEOUT_S)
            self._socket.sendall(request_line)
        except OSError:
            # The daemon may have sent the reason before it closed the connection.
            self._raise_refusal()
            raise self._connection_lost_error() from None

    def next_event(self, timeout_s: float) -> Document | None:
        """Return the next event or reply of the daemon, or None if none arrives in time.

        Raises
        ------
        DaemonUnreachableError
            If the connection was lost.
        """
        return self._events.popleft() if self._events else self._next_message(timeout_s)

    def _next_message(self, timeout_s: float) -> Document | None:
        """Return the next message from the socket, or None if none arrives in time."""
        deadline_s = time.monotonic() + timeout_s
        while b"\n" not in self._received:
            self._socket.settimeout(max(1e-3, deadline_s - time.monotonic()))
            try:
                received_bytes = self._socket.recv(65_536)
            except TimeoutError:
                return None
            except OSError:
                received_bytes = b""
            if not received_bytes:
                raise self._connection_lost_error()
            self._received += received_bytes
        message_line, self._received = self._received.split(b"\n", 1)
        try:
            message = json.loads(message_line)
        except ValueError:
            message = None
        if not isinstance(message, dict):
            raise DaemonUnreachableError(
                "The process on the socket is not a daemon of this version."
            )
        return message

    def _raise_refusal(self) -> None:
        """Raise the daemon's refusal if it has sent one before it closed the connection."""
        try:
            while (last_message := self._next_message(0.1)) is not None:
                if "error" in last_message:
                    raise _refusal_error(last_message)
        except DaemonUnreachableError:
            return

    def _connection_lost_error(self) -> DaemonUnreachableError:
        """Return the error for a lost connection."""
        return DaemonUnreachableError(
            f"The connection to the daemon (process {self.pid}) is lost.", (self.pid, self.uid)
        )


class _TooManyClientsError(RefusedByDaemonError):
    """Raised if the daemon did not execute a request because it has too many clients."""


def _refusal_error(refusal_reply: Document) -> RefusedByDaemonError:
    """Return the error that a reply of the daemon reports."""
    error_class = _TooManyClientsError if refusal_reply.get("crowded") else RefusedByDaemonError
    return error_class(
        str(refusal_reply.get("error", refusal_reply)),
        wrong_use=bool(refusal_reply.get("wrong_use")),
    )


# Stop


def stop_session(path: Path) -> Document:
    """Stop the session of a daemon: repeat the request until it is confirmed.

    If the confirmation takes long, the daemon is also sent the stop signal.

    Parameters
    ----------
    path
        Path of the daemon's socket.

    Returns
    -------
    dict
        Reply of the daemon with two more keys. ``signalled`` states whether the signal was sent, so
        that the session may have ended before the reply. ``peer`` is the process id and the user id
        of the process that replied.

    Raises
    ------
    RefusedByDaemonError
        If the daemon refuses the request.
    DaemonUnreachableError
        If the daemon does not confirm the stop within 10 s. The message states what was done.
    """
    stop_begin_s = time.monotonic()
    pid_and_uid: tuple[int, int] | None = None
    is_stop_signalled = False
    reply_timeout_s = _FIRST_STOP_REPLY_TIMEOUT_S
    while True:
        try:
            with Client(path, reply_timeout_s, reply_timeout_s) as client:
                pid_and_uid = client.pid, client.uid
                return client.ask("stop") | {"signalled": is_stop_signalled, "peer": pid_and_uid}
        except (DaemonUnreachableError, _TooManyClientsError) as error:
            last_failure = str(error)
        elapsed_s = time.monotonic() - stop_begin_s
        if pid_and_uid is not None and not is_stop_signalled and elapsed_s > _STOP_SIGNAL_DELAY_S:
            is_stop_signalled = _signal_stop(pid_and_uid[0])
        if elapsed_s > _STOP_TIMEOUT_S or not path.exists():
            break
        # A daemon that lacks processor time stops its session, but replies late.
        reply_timeout_s = min(2.0 * reply_timeout_s, _STOP_TIMEOUT_S)
        time.sleep(_RETRY_PAUSE_S)
    if pid_and_uid is None:
        raise DaemonUnreachableError(last_failure)
    if not is_stop_signalled:
        raise DaemonUnreachableError(last_failure, pid_and_uid)
    raise DaemonUnreachableError(
        f"The daemon (process {pid_and_uid[0]}) was sent {STOP_SIGNAL.name}, which asks it to "
        f"stop, and has not replied for {elapsed_s:.0f} s. {UNKNOWN_STATE_ADVICE}"
    )


def await_series_end(
    path: Path, timeout_s: float, pid_and_uid: tuple[int, int] | None = None
) -> Document | None:
    """Wait until a daemon reports that no session is running, and return its status.

    Parameters
    ----------
    path
        Path of the daemon's socket.
    timeout_s
        Maximum time to wait.
    pid_and_uid
        Process id and user id of the daemon that must reply, or None for any.

    Returns
    -------
    dict or None
        Status of the daemon, or None if the session has not ended in time, or the daemon has too
        many clients.

    Raises
    ------
    RefusedByDaemonError, DaemonUnreachableError
        If the daemon no longer replies.
    """
    deadline_s = time.monotonic() + timeout_s
    with Client(path, reply_timeout_s=timeout_s) as client:
        if pid_and_uid not in (None, (client.pid, client.uid)):
            raise DaemonUnreachableError(
                f"Another process listens on {path} now. {UNKNOWN_STATE_ADVICE}"
            )
        while True:
            try:
                daemon_status = client.ask("status")
            except _TooManyClientsError:
                return None
            served_series = daemon_status["series"]
            # A stop during planning takes effect after the planning, before the session begins.
            if daemon_status["state"] not in ("running", "stopping") and (
                served_series is None
                or not served_series["running"]
                or (served_series.get("stopped") and daemon_status.get("doing") == "planning")
            ):
                return daemon_status
            if time.monotonic() > deadline_s:
                return None
            time.sleep(_RETRY_PAUSE_S)


def describe_remaining_processes(pid: int, uid: int) -> str:
    """Return a text on the processes of a lost daemon that still run, with the remedy.

    The function first gives the processes some seconds to end.

    Parameters
    ----------
    pid, uid
        Process id and user id of the daemon.
    """
    deadline_s = time.monotonic() + _PROCESS_END_TIMEOUT_S
    while True:
        is_daemon_running, control_processes = _is_process_running(pid), _control_processes(pid)
        if not (is_daemon_running or control_processes) or time.monotonic() > deadline_s:
            break
        time.sleep(_RETRY_PAUSE_S)
    if is_daemon_running:
        return (
            f"The connection to the daemon (process {pid}) is lost, though it runs; see rigd "
            f"status. {UNKNOWN_STATE_ADVICE}"
        )
    restart_advice = "see the daemon's log for the cause, and start it again with rigd serve."
    if control_processes:
        return (
            f"The daemon is gone (process {pid}), and its control process {control_processes[0]} "
            "still runs and may move the motor: press the wired stop (STO). Then " + restart_advice
        )
    if uid != os.getuid() and not _sees_other_users():
        return f"The daemon is gone (process {pid}). {UNKNOWN_STATE_ADVICE} Then {restart_advice}"
    return (
        "The daemon is gone. Its control process, which alone moves the motor, has ended too: "
        "check that the rig is at rest. What was recorded of a session is in the daemon's output "
        f"folder; {restart_advice}"
    )


def _is_process_running(pid: int) -> bool:
    """Return whether a process of any user with this id is running."""
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
    """Return whether /proc shows this user the processes of others (mount option hidepid)."""
    try:
        return bool(Path("/proc/1/cmdline").read_bytes())
    except OSError:
        return False


def _control_processes(pid: int) -> list[int]:
    """Return the process ids of the control processes that a supervisor has started."""
    from rigd.engine import supervisor_of_control

    with suppress(OSError):
        return [
            process.pid
            for process in read_processes()
            if supervisor_of_control(process.command) == pid
        ]
    return []


def _signal_stop(pid: int) -> bool:
    """Send the stop signal to a process that has a handler for it; return whether it was sent.

    A process without a handler would be killed by the signal.
    """
    process = read_process(pid)
    if process is None or not process.handles(STOP_SIGNAL):
        return False
    start_ticks = process.start_ticks
    return start_ticks is not None and send_signal(process, start_ticks, STOP_SIGNAL)


# Running daemons


def find_live_views(rig_name: str | None) -> list[LiveAddress]:
    """Return the addresses of the live views of a rig, or of all rigs.

    Parameters
    ----------
    rig_name
        Name of the rig's profile, or None for all rigs.
    """
    own_views = running_views()
    matching_views = [live_view for live_view in own_views if rig_name in (None, live_view.rig)]
    if not matching_views:
        # The runtime folder of another user's daemon is not readable.
        daemon_views = (
            _view_of_daemon(daemon_socket) for daemon_socket in running_daemon_sockets()
        )
        matching_views = [
            live_view
            for live_view in daemon_views
            if live_view is not None and rig_name in (None, live_view.rig)
        ]
    return matching_views


def daemons_with_view() -> dict[str, bool]:
    """Return the rigs with a running daemon: name of the rig → whether it has a live view."""
    daemon_statuses = (
        _status_of_daemon(daemon_socket) for daemon_socket in running_daemon_sockets()
    )
    return {
        daemon_status["daemon"]["profile"]: daemon_status["daemon"]["live"]
        for daemon_status in daemon_statuses
        if daemon_status is not None
    }


def _view_of_daemon(path: Path) -> LiveAddress | None:
    """Return the address of a daemon's live view, or None if it has none."""
    daemon_status = _status_of_daemon(path)
    view_document = (
        None
        if daemon_status is None or daemon_status["rig"] is None
        else daemon_status["rig"]["live_view"]
    )
    if view_document is None:
        return None
    return LiveAddress(
        **{
            address_field.name: view_document[address_field.name]
            for address_field in fields(LiveAddress)
        }
    )


def _status_of_daemon(path: Path) -> dict[str, Any] | None:
    """Return the status of the daemon on a socket, or None if it does not reply."""
    try:
        with Client(path) as client:
            return client.ask("status")
    except RigdError:
        return None
