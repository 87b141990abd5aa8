"""Stop of all sessions of a user: find them in the kernel's tables, stop them, verify their end.

There are two independent ways to find sessions. A daemon is reached by its socket, provided that
the listening process holds the lock of the rig; it reports the end of its session itself. Every
other process that runs sessions is found in the process table and gets `STOP_SIGNAL`. The table
shows when that process has ended, or when its control process has disabled the drive.
"""

import os
import pwd
import signal
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Any, Final

from rigd.daemon.address import COMMON, SUFFIX, own_sockets, peer_at
from rigd.daemon.client import UNKNOWN_STATE, await_end, stop_session
from rigd.engine import IDLE_NAME, SESSION_NAME, supervisor_of_control
from rigd.errors import RigdError
from rigd.runtime import STOP_SIGNAL, held_rig, holds_rig
from rigd.runtime.addresses import file_name, folder_fault, known_folders
from rigd.runtime.processes import RunningProcess, read_processes, send_signal

_END_PATIENCE_S: Final = 10.0
_CONTROL_AFTER_S: Final = 3.0
"""Time after which the control process of a supervisor that does not obey is stopped directly."""
_DOUBTED_PATIENCE_S: Final = 2.0
"""Time for a process whose reply is not trusted."""
_AGAIN_S: Final = 0.5
_SETTLED_S: Final = 0.05
_POLL_S: Final = 0.02
_REREAD_S: Final = 0.25
_SESSIONS: Final = ("run", "identify")
"""Commands that run sessions in the foreground."""


@dataclass(frozen=True, slots=True)
class StopReport:
    """Results of a stop; each text is a phrase or a sentence.

    Attributes
    ----------
    stopped
        Sessions that ended: excitation or command, rig and process.
    stopping
        Sessions that were requested to stop, without waiting for their end.
    quiet
        Rigs without a session.
    running
        Sessions that were requested to stop, and whose end was not observed.
    doubts
        Folders and tables that could not be examined, and replies that are not trusted.
    others
        Sessions of other users, which this user cannot stop.
    searched
        Tables and folders that were searched.
    """

    stopped: list[str] = field(default_factory=list)
    stopping: list[str] = field(default_factory=list)
    quiet: list[str] = field(default_factory=list)
    running: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    others: list[str] = field(default_factory=list)
    searched: list[str] = field(default_factory=list)

    @property
    def found(self) -> bool:
        """Whether there was a process that can run sessions."""
        return bool(self.stopped or self.stopping or self.quiet or self.running)

    @property
    def sure(self) -> bool:
        """Whether no session of this user runs any more."""
        return not (self.running or self.doubts)


def stop_all(rig: str | None, *, wait: bool = True) -> StopReport:
    """Stop every session of this user (for root, of all users), and verify its end.

    Parameters
    ----------
    rig
        Name of the only rig to stop; None: all.
    wait
        Whether to wait until the sessions have ended, at most 10 s.
    """
    return _Stop(None if rig is None else file_name(rig), wait=wait).run()


class _Stop:
    """One stop; `rig` is the rig's name as in file names, or None for all."""

    def __init__(self, rig: str | None, *, wait: bool) -> None:
        self._rig = rig
        self._wait = wait
        self._uid = os.getuid()
        self._report = StopReport()
        self._supervisors: dict[tuple[int, int], _Supervisor] = {}
        self._others: list[_Supervisor] = []
        """Supervisors of other users."""
        self._began_s = time.monotonic()

    def run(self) -> StopReport:
        daemons = self._find_daemons()
        for daemon in daemons:
            daemon.begin()
        left = self._follow(daemons)
        over = {each.process.pid for each in self._supervisors.values() if each not in left}
        believed = set()
        for daemon in daemons:
            daemon.report_to(self._report, disabled=daemon.pid in over)
            if not daemon.doubt:
                believed.add(daemon.pid)
        for supervisor in self._supervisors.values():
            if supervisor.process.pid not in believed:
                ended = supervisor not in left
                supervisor.report_to(self._report, ended=ended, waited=self._wait)
        for other in self._others:
            if other.has_session and other.process.pid not in believed:
                self._report.others.append(f"{other.words} of user {_user(other.process.uid)}")
        return self._report

    @property
    def _passed_s(self) -> float:
        return time.monotonic() - self._began_s

    # Daemons, by their sockets

    def _find_daemons(self) -> "list[_Daemon]":
        """Return the listening daemons, in the order of their sockets."""
        report = self._report
        report.searched.append("the listening sockets (/proc/net/unix)")
        report.searched.append(f"{tempfile.gettempdir()}/rigd-{self._uid or ''}*")
        try:
            paths = set(own_sockets())
        except OSError as error:
            report.doubts.append(f"The list of sockets cannot be read ({error.strerror}).")
            paths = set()
        for folder in [*known_folders(self._uid or None), COMMON]:
            report.searched.append(str(folder))
            fault = folder_fault(folder, shared=folder == COMMON)
            if fault:
                report.doubts.append(fault)
            try:
                sockets = [path for path in folder.iterdir() if path.name.endswith(SUFFIX)]
            except (FileNotFoundError, NotADirectoryError):
                continue
            except PermissionError as error:
                if folder == COMMON or _may_belong_to(folder, self._uid):
                    report.doubts.append(f"The folder {folder} cannot be read ({error.strerror}).")
                continue
            except OSError as error:
                report.doubts.append(f"The folder {folder} cannot be read ({error.strerror}).")
                continue
            paths.update(sockets)
        found = []
        for path in sorted(paths):
            rig = path.name.removesuffix(SUFFIX)
            if self._rig in (None, rig):
                with suppress(ConnectionRefusedError, FileNotFoundError):  # of a dead daemon
                    try:
                        found.append(_Daemon(path, peer_at(path), wait=self._wait))
                    except PermissionError as error:
                        report.doubts.append(f"{path} cannot be opened ({error.strerror}).")
        return found

    # Other processes, by the process table

    def _follow(self, daemons: "list[_Daemon]") -> "list[_Supervisor]":
        """Stop supervisors without a socket; return those whose session did not end in time."""
        self._report.searched.insert(0, "the process table (/proc)")
        while True:
            try:
                table = read_processes()
            except OSError as error:
                self._report.doubts.append(
                    f"The process table cannot be read ({error.strerror}): sessions in the "
                    "foreground, and daemons in other folders, are not found."
                )
                for daemon in daemons:
                    daemon.join(2.0 * _END_PATIENCE_S)
                return []
            reached = {daemon.pid for daemon in daemons if self._is_reached(daemon)}
            left = []
            for supervisor in self._update(table):
                if supervisor.process.pid in reached:
                    continue
                self._supervisors.setdefault(supervisor.key, supervisor)
                supervisor.drive(self._passed_s)
                if not supervisor.is_over:
                    left.append(supervisor)
            waiting = [daemon for daemon in daemons if self._is_awaited(daemon)]
            if not (waiting or (left and self._wait)):
                return left
            if self._passed_s > _END_PATIENCE_S and not waiting:
                return left
            if left or not waiting:
                time.sleep(_POLL_S)
            else:  # reading the table takes processor time that the daemon may need
                waiting[0].join(_REREAD_S)

    def _is_reached(self, daemon: "_Daemon") -> bool:
        """Return whether a daemon's own report suffices: it is trusted and responds in time."""
        return daemon.doubt == "" and (daemon.done or self._passed_s < _CONTROL_AFTER_S)

    def _is_awaited(self, daemon: "_Daemon") -> bool:
        """Return whether a daemon may still report the end of its session."""
        if daemon.done:
            return False
        known = self._supervisors.values()
        if any(each.suspended and each.process.pid == daemon.pid for each in known):
            return False
        patience_s = _DOUBTED_PATIENCE_S if daemon.doubt else 2.0 * _END_PATIENCE_S
        return self._passed_s < patience_s

    def _update(self, table: Sequence[RunningProcess]) -> "list[_Supervisor]":
        """Return the supervisors of this user in a process table, and store those of others."""
        self._others.clear()
        found = []
        for process, controls in _supervisors(table):
            if self._uid not in (0, process.uid):
                self._others.append(_Supervisor(process, controls))
                continue
            supervisor = self._supervisors.get((process.pid, process.born or 0))
            if supervisor is None:
                supervisor = _Supervisor(process, controls)
                if self._rig is not None and not supervisor.is_for(self._rig):
                    continue
            supervisor.process, supervisor.controls = process, controls
            found.append(supervisor)
        return found


# Daemons


class _Daemon:
    """Stop of a daemon through its socket, in its own thread; `peer` is its process and user."""

    def __init__(self, path: Path, peer: tuple[int, int] | None, *, wait: bool) -> None:
        self._path = path
        self._wait = wait
        self._reply: dict[str, Any] = {}
        self._status: dict[str, Any] | None = None
        self._error: RigdError | None = None
        self._thread = threading.Thread(target=self._stop, daemon=True)
        self.pid = 0 if peer is None else peer[0]
        self.doubt = "It takes no connection." if peer is None else self._doubt_of(*peer)
        """Reason why its replies are not trusted; empty if they are."""

    def begin(self) -> None:
        """Start the stop."""
        self._thread.start()

    def join(self, patience_s: float) -> None:
        """Wait until the stop has succeeded or failed."""
        self._thread.join(patience_s)

    @property
    def done(self) -> bool:
        """Whether the stop has succeeded or failed."""
        return not self._thread.is_alive()

    def _stop(self) -> None:
        try:
            reply = stop_session(self._path)
            self.pid, uid = reply["peer"]
            self.doubt = self._doubt_of(self.pid, uid)
            if self._wait:
                self._status = await_end(self._path, _END_PATIENCE_S, reply["peer"])
            self._reply = reply
        except RigdError as error:
            self._error = error

    def _doubt_of(self, pid: int, uid: int) -> str:
        folder, rig = self._path.parent, self._path.name.removesuffix(SUFFIX)
        shared = folder == COMMON
        if folder_fault(folder, shared=shared):
            return "Other users can write to its folder."
        try:
            holds = holds_rig(pid, rig, folder)
        except OSError as error:
            return f"The table of locks cannot be read ({error.strerror})."
        # Only its user can read the folder with a simulated rig's lock, but also only that user can
        # create a socket in the group's folder.
        with suppress(OSError):
            if shared and uid in (0, folder.stat().st_uid) and uid != os.getuid():
                return ""
        if holds and os.getuid() in (0, uid):
            return ""
        return f"It does not hold the lock of the rig {rig}, and may be no daemon."

    def report_to(self, report: StopReport, *, disabled: bool) -> None:
        """Add the result; `disabled`: the process table shows that the drive is disabled."""
        rig = self._path.name.removesuffix(SUFFIX)
        if self.doubt:
            who = f"process {self.pid}" if self.pid else "the process"
            report.doubts.append(
                f"The reply of {who} that listens on {self._path} is not believed. {self.doubt}"
            )
            return
        where = f"the rig {rig} (rigd serve, process {self.pid})"
        if disabled and not self._reply:
            report.doubts.append(
                f"The daemon of {where} does not answer. Its control process has disabled the "
                "drive."
            )
        elif self._error is not None:
            report.doubts.append(f"Not stopped: {where}. {self._error.full_message()}")
        elif not self._reply:
            report.doubts.append(f"The daemon of {where} does not answer. {UNKNOWN_STATE}")
        elif not self._wait:
            if self._reply["stopping"]:
                report.stopping.append(where)
            else:
                report.quiet.append(f"No session is running on {where}.")
        elif self._status is None:
            report.running.append(where)
        else:
            self._report_end(report, self._status, where)

    def _report_end(self, report: StopReport, status: dict[str, Any], where: str) -> None:
        series = status["series"]
        by_signal = self._reply["signalled"] and series is not None and series["stopped"]
        if status["state"] == "fault":
            report.quiet.append(
                f"No session is running on {where}. The rig is in fault: {status['reason']}"
            )
        elif status["state"] == "idle":
            report.quiet.append(
                f"No session is running on {where}; the devices are not connected yet."
            )
        elif self._reply["stopping"] or by_signal:
            sessions = [] if series is None else series["sessions"]
            path = sessions[-1]["path"] if sessions else None
            what = "a session" if series is None else series["excitation"]
            report.stopped.append(f"{what} on {where}" + (f"; its file is {path}" if path else ""))
        else:
            report.quiet.append(f"No session is running on {where}; the torque is off.")


# Processes


class _Supervisor:
    """A process that runs sessions, or an orphaned control process, with its control processes."""

    def __init__(self, process: RunningProcess, controls: list[RunningProcess]) -> None:
        self.process = process
        self.controls = controls
        self._arguments = _rigd_arguments(process.command)
        self._born = process.born or 0
        self._rig = held_rig(process.pid) or self._named_rig
        self._had_session = self.has_session
        self.suspended = False
        """Whether it was sent the signal but is suspended and cannot receive it."""
        self._signalled_s = -_AGAIN_S
        self._sent = False
        self._seen = False
        self._control_stopped = False

    @property
    def key(self) -> tuple[int, int]:
        """Process id and start time, which identify the process uniquely."""
        return self.process.pid, self._born

    @property
    def words(self) -> str:
        """Command, rig and process for the operator."""
        words = takewhile(lambda argument: not argument.startswith("-"), self._arguments[:2])
        name = " ".join(["rigd", *words]) if self._arguments else "a session"
        given = self._rig or _option(self._arguments, "--profile")
        rig = "an unknown rig" if given is None else f"the rig {given}"
        plain = "".join(c if c.isprintable() else "?" for c in f"{name} on {rig}")
        return f"{plain} (process {self.process.pid})"

    @property
    def _named_rig(self) -> str | None:
        """Name of the rig from the command line; None if that names a file."""
        given = _option(self._arguments, "--profile")
        if given is None:
            return "sim" if self._in_foreground else None
        return None if "/" in given or given.endswith(".toml") else given

    @property
    def _in_foreground(self) -> bool:
        return self._arguments[:1] in [(name,) for name in _SESSIONS]

    @property
    def has_session(self) -> bool:
        """Whether a session may run or the torque be on."""
        if any(control.name != IDLE_NAME for control in self.controls):
            return True
        return self._in_foreground and not self.process.ignores(STOP_SIGNAL)

    @property
    def _recorded(self) -> bool:
        """Whether a session was observed, whose file may still be open."""
        self._seen |= any(control.name == SESSION_NAME for control in self.controls)
        return self._seen

    @property
    def is_over(self) -> bool:
        """Whether no session runs, and none can begin before the stop is obeyed."""
        if self.process.suspended and self.process.awaits(STOP_SIGNAL):
            self.suspended = True
            return all(control.name == IDLE_NAME for control in self.controls)
        settled = time.monotonic() - self._signalled_s > _SETTLED_S
        obeyed = self._sent and settled and not self.process.awaits(STOP_SIGNAL)
        if self._in_foreground and self.process.handles(STOP_SIGNAL):
            # Its control process ends once the file is closed. Without a session it may still be
            # planning, but will not begin one.
            return obeyed and not (self._recorded and self.controls)
        return not self.has_session and (obeyed or not self._sent)

    def is_for(self, rig: str) -> bool:
        """Return whether it may run a rig, given by its name in file names."""
        return self._rig is None or file_name(self._rig) == rig

    def drive(self, passed_s: float) -> None:
        """Take the next step of the stop, `passed_s` after its beginning."""
        for control in self.controls:
            if control.suspended:  # it would hold its last torque
                self._send(control, signal.SIGCONT)
        now_s = time.monotonic()
        if now_s - self._signalled_s > _AGAIN_S and (self.has_session or not self._sent):
            self._signalled_s = now_s
            self._ask()
        if passed_s > _CONTROL_AFTER_S and not self._control_stopped:
            self._control_stopped = True
            self._stop_control()

    def _ask(self) -> None:
        process = self.process
        if process.handles(STOP_SIGNAL) and process not in self.controls:
            self._sent = send_signal(process, self._born, STOP_SIGNAL)
        elif not self._in_foreground:
            self._stop_control()
        elif not process.ignores(STOP_SIGNAL):  # it is starting, or an older version
            number = signal.SIGINT if process.handles(signal.SIGINT) else signal.SIGTERM
            self._sent = send_signal(process, self._born, number)

    def _stop_control(self) -> None:
        for control in self.controls:
            if control.name != IDLE_NAME:
                self._send(control, signal.SIGTERM)

    def _send(self, process: RunningProcess, number: int) -> None:
        born = process.born
        if born is not None:
            send_signal(process, born, number)

    def report_to(self, report: StopReport, *, ended: bool, waited: bool) -> None:
        """Add the result to a report."""
        if not waited and self._had_session:
            report.stopping.append(self.words)
        elif not ended:
            report.running.append(self.words)
        elif self._had_session:
            report.stopped.append(self.words)
        elif self.controls:
            report.quiet.append(f"No session is running on {self.words}; the torque is off.")
        if self.suspended:
            report.doubts.append(
                f"{self.words} is suspended and cannot obey; its control process has disabled the "
                "drive."
            )


def _supervisors(
    table: Sequence[RunningProcess],
) -> list[tuple[RunningProcess, list[RunningProcess]]]:
    """Return the processes of a table that run sessions, each with its control processes."""
    rows = {process.pid: process for process in table}
    found: dict[int, list[RunningProcess]] = {}
    for process in table:
        number = supervisor_of_control(process.command)
        if number is None or process.uid < 0:
            continue
        owner = rows.get(number)
        # Any process can have this command line: only the parent, of the same user, is trusted.
        orphaned = owner is None or (owner.uid, number) != (process.uid, process.parent)
        found.setdefault(process.pid if orphaned else number, []).append(process)
    for process in table:
        arguments = _rigd_arguments(process.command)
        if process.uid < 0 or arguments[:1] not in [(name,) for name in _SESSIONS]:
            continue
        started = rows.get(process.parent)
        forked = started is not None and started.command == process.command
        estimates = "--from" in arguments and not process.handles(STOP_SIGNAL)
        if not (forked or estimates or process.ignores(STOP_SIGNAL)):
            found.setdefault(process.pid, [])
    return [(rows[pid], controls) for pid, controls in sorted(found.items())]


def _rigd_arguments(command: Sequence[str]) -> tuple[str, ...]:
    """Return the arguments of ``rigd`` in a Python command line; empty without ``rigd``."""
    if not command or not Path(command[0]).name.startswith("python"):
        return ()
    for index, argument in enumerate(command[1:], start=1):
        if Path(argument).name == "rigd":
            return tuple(command[index + 1 :])
        if not argument.startswith("-"):
            break
    return ()


def _option(arguments: Sequence[str], name: str) -> str | None:
    """Return the value of an option in a command line."""
    for index, argument in enumerate(arguments):
        option, equals, value = argument.partition("=")
        if option == name:
            return value if equals else "".join(arguments[index + 1 : index + 2])
    return None


def _may_belong_to(folder: Path, uid: int) -> bool:
    """Return whether a user may own files in a folder that this user cannot read."""
    for path in (folder, *folder.parents):
        with suppress(OSError):
            return path.stat().st_uid == uid
    return True


def _user(uid: int) -> str:
    """Return the name of a user, or the number if there is no name."""
    with suppress(KeyError):
        return pwd.getpwuid(uid).pw_name
    return str(uid)
