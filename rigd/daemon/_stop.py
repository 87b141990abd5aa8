"""Stop of all sessions of a user: find the sessions, stop them, and verify their end.

Sessions are found in two independent ways. A daemon is reached through its socket, provided that
the listening process holds the lock of the rig. It reports the end of its session itself. Every
other process that runs sessions is found in the process table, and gets `STOP_SIGNAL`. The process
table shows when that process has ended, and by the last name of its control process whether the
drive has shown that it is off.
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

from rigd.daemon.address import GROUP_FOLDER, SOCKET_SUFFIX, daemon_pid_and_uid, own_daemon_sockets
from rigd.daemon.client import UNKNOWN_STATE_ADVICE, await_series_end, stop_session
from rigd.engine import CONNECTING_NAME, IDLE_NAME, SESSION_NAME, supervisor_of_control
from rigd.errors import RigdError
from rigd.runtime import STOP_SIGNAL
from rigd.runtime.addresses import file_name, folder_fault, known_folders
from rigd.runtime.locks import holds_rig_lock, locked_rig
from rigd.runtime.processes import RunningProcess, read_processes, send_signal

_END_TIMEOUT_S: Final = 10.0
"""Maximum time in seconds to wait for the end of a session."""
_STOP_CONTROL_DELAY_S: Final = 3.0
"""Time in seconds after which the control process of an unresponsive supervisor is stopped."""
_DOUBTED_REPLY_TIMEOUT_S: Final = 2.0
"""Maximum time in seconds to wait for a process whose replies are not trusted."""
_REPEAT_SIGNAL_INTERVAL_S: Final = 0.5
"""Time in seconds after which the stop signal is sent again."""
_SIGNAL_REACTION_TIME_S: Final = 0.05
"""Time in seconds after the stop signal from which a process is assumed to have reacted."""
_POLL_INTERVAL_S: Final = 0.02
"""Time in seconds between two readings of the process table."""
_DAEMON_POLL_INTERVAL_S: Final = 0.25
"""Time in seconds between two readings of the process table while only daemons are awaited."""
_SESSION_COMMANDS: Final = ("run", "identify")
"""Commands of ``rigd`` that run sessions in the foreground."""


@dataclass(frozen=True, slots=True)
class StopReport:
    """Result of stopping all sessions of a user, as lists of texts for the operator.

    Attributes
    ----------
    stopped_sessions
        Sessions that have ended, with excitation or command, rig and process.
    stopping_sessions
        Sessions that were requested to stop, if their end is not waited for.
    sentences_without_session
        Sentences on rigs that run no session.
    unended_sessions
        Sessions that were requested to stop, but have not ended in time.
    unconfirmed_drives
        Sentences on rigs that run no session, but whose drive has not shown that it is off.
    doubts
        Sentences on folders and tables that could not be read, and on replies that are not trusted.
    sessions_of_others
        Sessions of other users, which this user cannot stop.
    searched_locations
        Tables and folders that were searched for sessions.
    """

    stopped_sessions: list[str] = field(default_factory=list)
    stopping_sessions: list[str] = field(default_factory=list)
    sentences_without_session: list[str] = field(default_factory=list)
    unended_sessions: list[str] = field(default_factory=list)
    unconfirmed_drives: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    sessions_of_others: list[str] = field(default_factory=list)
    searched_locations: list[str] = field(default_factory=list)

    @property
    def has_found_process(self) -> bool:
        """Whether a process was found that can run sessions."""
        return bool(
            self.stopped_sessions
            or self.stopping_sessions
            or self.sentences_without_session
            or self.unended_sessions
            or self.unconfirmed_drives
        )

    @property
    def is_stop_certain(self) -> bool:
        """Whether it is certain that no session of this user runs, and that its drive is off."""
        return not (self.unended_sessions or self.unconfirmed_drives or self.doubts)


def stop_all(rig_name: str | None, *, is_end_awaited: bool = True) -> StopReport:
    """Stop all sessions of this user, or of all users for root, and report what was found.

    Parameters
    ----------
    rig_name
        Name of the only rig whose sessions are stopped, or None for all rigs.
    is_end_awaited
        Whether to wait until the sessions have ended, for at most 10 s.
    """
    return _StopOfAll(
        None if rig_name is None else file_name(rig_name), is_end_awaited=is_end_awaited
    ).run()


class _StopOfAll:
    """Stop of all sessions of a user, on all rigs or on one.

    `rig_name` is the name of the rig as in file names, or None for all rigs.
    """

    def __init__(self, rig_file_name: str | None, *, is_end_awaited: bool) -> None:
        self._rig_name = rig_file_name
        self._is_end_awaited = is_end_awaited
        self._uid = os.getuid()
        self._report = StopReport()
        self._own_supervisors: dict[tuple[int, int], _SupervisorStop] = {}
        self._supervisors_of_others: list[_SupervisorStop] = []
        """Supervisors of other users."""
        self._began_s = time.monotonic()

    def run(self) -> StopReport:
        """Stop the sessions, wait for their end, and return the report."""
        daemons = self._find_daemons()
        for daemon in daemons:
            daemon.begin_stop()
        unended_supervisors = self._stop_supervisors(daemons)
        disabled_drive_pids = {
            supervisor_stop.process.pid
            for supervisor_stop in self._own_supervisors.values()
            if supervisor_stop not in unended_supervisors and supervisor_stop.has_shown_torque_off
        }
        trusted_daemon_pids = set()
        for daemon in daemons:
            daemon.report_to(self._report, is_drive_disabled=daemon.pid in disabled_drive_pids)
            if not daemon.doubt:
                trusted_daemon_pids.add(daemon.pid)
        for supervisor in self._own_supervisors.values():
            if supervisor.process.pid not in trusted_daemon_pids:
                has_ended = supervisor not in unended_supervisors
                supervisor.report_to(
                    self._report, has_ended=has_ended, is_end_awaited=self._is_end_awaited
                )
        for other_supervisor in self._supervisors_of_others:
            if (
                other_supervisor.has_session
                and other_supervisor.process.pid not in trusted_daemon_pids
            ):
                self._report.sessions_of_others.append(
                    f"{other_supervisor.description} of user "
                    f"{_user_name(other_supervisor.process.uid)}"
                )
        return self._report

    @property
    def _elapsed_s(self) -> float:
        """Time in seconds since the stop began."""
        return time.monotonic() - self._began_s

    # Daemons, by their sockets

    def _find_daemons(self) -> "list[_DaemonStop]":
        """Return the daemons that listen on a socket, sorted by the path of the socket."""
        report = self._report
        report.searched_locations.append("the listening sockets (/proc/net/unix)")
        report.searched_locations.append(f"{tempfile.gettempdir()}/rigd-{self._uid or ''}*")
        try:
            socket_paths = set(own_daemon_sockets())
        except OSError as error:
            report.doubts.append(f"The list of sockets cannot be read ({error.strerror}).")
            socket_paths = set()
        for folder in [*known_folders(self._uid or None), GROUP_FOLDER]:
            report.searched_locations.append(str(folder))
            folder_fault_text = folder_fault(folder, is_shared=folder == GROUP_FOLDER)
            if folder_fault_text:
                report.doubts.append(folder_fault_text)
            try:
                folder_sockets = [
                    daemon_socket
                    for daemon_socket in folder.iterdir()
                    if daemon_socket.name.endswith(SOCKET_SUFFIX)
                ]
            except (FileNotFoundError, NotADirectoryError):
                continue
            except PermissionError as error:
                if folder == GROUP_FOLDER or _may_folder_belong_to(folder, self._uid):
                    report.doubts.append(f"The folder {folder} cannot be read ({error.strerror}).")
                continue
            except OSError as error:
                report.doubts.append(f"The folder {folder} cannot be read ({error.strerror}).")
                continue
            socket_paths.update(folder_sockets)
        daemons = []
        for daemon_socket in sorted(socket_paths):
            rig_name = daemon_socket.name.removesuffix(SOCKET_SUFFIX)
            if self._rig_name in (None, rig_name):
                with suppress(ConnectionRefusedError, FileNotFoundError):  # of a dead daemon
                    try:
                        daemons.append(
                            _DaemonStop(
                                daemon_socket,
                                daemon_pid_and_uid(daemon_socket),
                                is_end_awaited=self._is_end_awaited,
                            )
                        )
                    except PermissionError as error:
                        report.doubts.append(
                            f"{daemon_socket} cannot be opened ({error.strerror})."
                        )
        return daemons

    # Other processes, by the process table

    def _stop_supervisors(self, daemons: "list[_DaemonStop]") -> "list[_SupervisorStop]":
        """Signal the supervisors that no socket reaches, and wait for the end of all sessions.

        Returns the supervisors whose session has not ended in time.
        """
        self._report.searched_locations.insert(0, "the process table (/proc)")
        while True:
            try:
                process_table = read_processes()
            except OSError as error:
                self._report.doubts.append(
                    f"The process table cannot be read ({error.strerror}): sessions in the "
                    "foreground, and daemons in other folders, are not found."
                )
                for daemon in daemons:
                    daemon.join(2.0 * _END_TIMEOUT_S)
                return []
            socket_stopped_pids = {
                daemon.pid for daemon in daemons if self._is_stopped_by_socket(daemon)
            }
            unended_supervisors = []
            for supervisor in self._update_supervisors(process_table):
                if supervisor.process.pid in socket_stopped_pids:
                    continue
                self._own_supervisors.setdefault(supervisor.identity, supervisor)
                supervisor.send_due_signals(self._elapsed_s)
                if not supervisor.is_session_over:
                    unended_supervisors.append(supervisor)
            awaited_daemons = [daemon for daemon in daemons if self._is_awaited(daemon)]
            if not (awaited_daemons or (unended_supervisors and self._is_end_awaited)):
                return unended_supervisors
            if self._elapsed_s > _END_TIMEOUT_S and not awaited_daemons:
                return unended_supervisors
            if unended_supervisors or not awaited_daemons:
                time.sleep(_POLL_INTERVAL_S)
            else:  # reading the process table takes processor time that the daemon may need
                awaited_daemons[0].join(_DAEMON_POLL_INTERVAL_S)

    def _is_stopped_by_socket(self, daemon: "_DaemonStop") -> bool:
        """Return whether a daemon is stopped through its socket, so that it needs no signal."""
        return daemon.doubt == "" and (daemon.is_done or self._elapsed_s < _STOP_CONTROL_DELAY_S)

    def _is_awaited(self, daemon: "_DaemonStop") -> bool:
        """Return whether to wait longer for a daemon's report that its session has ended."""
        if daemon.is_done:
            return False
        supervisors = self._own_supervisors.values()
        if any(
            supervisor.suspended and supervisor.process.pid == daemon.pid
            for supervisor in supervisors
        ):
            return False
        timeout_s = _DOUBTED_REPLY_TIMEOUT_S if daemon.doubt else 2.0 * _END_TIMEOUT_S
        return self._elapsed_s < timeout_s

    def _update_supervisors(
        self, process_table: Sequence[RunningProcess]
    ) -> "list[_SupervisorStop]":
        """Return the supervisors of this user in a process table, with their present state.

        The supervisors of other users are stored separately.
        """
        self._supervisors_of_others.clear()
        own_supervisors = []
        for process, control_processes in _find_supervisors(process_table):
            if self._uid not in (0, process.uid):
                self._supervisors_of_others.append(_SupervisorStop(process, control_processes))
                continue
            supervisor = self._own_supervisors.get((process.pid, process.start_ticks or 0))
            if supervisor is None:
                supervisor = _SupervisorStop(process, control_processes)
                if self._rig_name is not None and not supervisor.may_run_rig(self._rig_name):
                    continue
            supervisor.process, supervisor.control_processes = process, control_processes
            own_supervisors.append(supervisor)
        return own_supervisors


# Daemons


class _DaemonStop:
    """Stop of a daemon through its socket, in a thread.

    `socket_path` is the path of the socket, `peer` the daemon's process id and user id.
    """

    def __init__(
        self, socket_path: Path, peer: tuple[int, int] | None, *, is_end_awaited: bool
    ) -> None:
        self._socket_path = socket_path
        self._is_end_awaited = is_end_awaited
        self._reply: dict[str, Any] = {}
        self._status: dict[str, Any] | None = None
        self._error: RigdError | None = None
        self._thread = threading.Thread(target=self._stop, daemon=True)
        self.pid = 0 if peer is None else peer[0]
        self.doubt = "It accepts no connection." if peer is None else self._reason_to_doubt(*peer)
        """Sentence that states why the daemon's replies are not trusted; empty if they are."""

    def begin_stop(self) -> None:
        """Start the thread that stops the daemon's session."""
        self._thread.start()

    def join(self, timeout_s: float) -> None:
        """Wait, for at most `timeout_s` seconds, until the stop has succeeded or failed."""
        self._thread.join(timeout_s)

    @property
    def is_done(self) -> bool:
        """Whether the stop has succeeded or failed."""
        return not self._thread.is_alive()

    def _stop(self) -> None:
        """Stop the daemon's session, and wait for its end if requested; run in the thread."""
        try:
            stop_reply = stop_session(self._socket_path)
            self.pid, uid = stop_reply["peer"]
            self.doubt = self._reason_to_doubt(self.pid, uid)
            if self._is_end_awaited:
                self._status = await_series_end(
                    self._socket_path, _END_TIMEOUT_S, stop_reply["peer"]
                )
            self._reply = stop_reply
        except RigdError as error:
            self._error = error

    def _reason_to_doubt(self, pid: int, uid: int) -> str:
        """Return the reason not to trust the replies of a process on the socket; "" if trusted."""
        folder, rig = self._socket_path.parent, self._socket_path.name.removesuffix(SOCKET_SUFFIX)
        is_group_folder = folder == GROUP_FOLDER
        if folder_fault(folder, is_shared=is_group_folder):
            return "Other users can write to its folder."
        try:
            holds_lock = holds_rig_lock(pid, rig, folder)
        except OSError as error:
            return f"The table of locks cannot be read ({error.strerror})."
        # The folder with the lock of a simulated rig is readable only by the daemon's user. But
        # only that user can create a socket in the group's folder.
        with suppress(OSError):
            if is_group_folder and uid in (0, folder.stat().st_uid) and uid != os.getuid():
                return ""
        if holds_lock and os.getuid() in (0, uid):
            return ""
        return f"It does not hold the lock of the rig {rig}, so it may not be a daemon."

    def report_to(self, report: StopReport, *, is_drive_disabled: bool) -> None:
        """Add the result of the stop to a report.

        `is_drive_disabled` states whether the process table shows that the drive is disabled.
        """
        rig_name = self._socket_path.name.removesuffix(SOCKET_SUFFIX)
        if self.doubt:
            process_text = f"process {self.pid}" if self.pid else "the process"
            report.doubts.append(
                f"The reply of {process_text} that listens on {self._socket_path} is not "
                f"trusted. {self.doubt}"
            )
            return
        rig_text = f"the rig {rig_name} (rigd serve, process {self.pid})"
        if is_drive_disabled and not self._reply:
            report.doubts.append(
                f"The daemon of {rig_text} does not answer. Its control process has disabled the "
                "drive."
            )
        elif self._error is not None:
            report.doubts.append(f"Not stopped: {rig_text}. {self._error.full_message()}")
        elif not self._reply:
            report.doubts.append(
                f"The daemon of {rig_text} does not answer. {UNKNOWN_STATE_ADVICE}"
            )
        elif not self._is_end_awaited:
            if self._reply["stopping"]:
                report.stopping_sessions.append(rig_text)
            else:
                report.sentences_without_session.append(f"No session is running on {rig_text}.")
        elif self._status is None:
            report.unended_sessions.append(rig_text)
        else:
            self._report_end(report, self._status, rig_text)

    def _report_end(self, report: StopReport, status: dict[str, Any], rig_text: str) -> None:
        """Add to a report that the daemon's session has ended, or that none was running."""
        series = status["series"]
        is_stopped_by_signal = self._reply["signalled"] and series is not None and series["stopped"]
        if status["state"] == "fault" and status.get("rig") is not None:
            # The devices stay connected only if the drive has shown that it is off.
            report.sentences_without_session.append(
                f"No session is running on {rig_text}; the torque is off. The rig is in fault: "
                f"{status['reason']}"
            )
        elif status["state"] == "fault":
            report.unconfirmed_drives.append(
                f"No session is running on {rig_text}, but the rig is in fault, and its devices "
                "are not connected, so the drive does not show that it is off. Reason of the "
                f"fault: {status['reason']}"
            )
        elif status["state"] == "idle":
            report.unconfirmed_drives.append(
                f"No session is running on {rig_text}, but the devices are not connected, so the "
                "drive does not show that it is off."
            )
        elif self._reply["stopping"] or is_stopped_by_signal:
            sessions = [] if series is None else series["sessions"]
            session_path = sessions[-1]["path"] if sessions else None
            session_text = "a session" if series is None else series["excitation"]
            report.stopped_sessions.append(
                f"{session_text} on {rig_text}"
                + (f"; its file is {session_path}" if session_path else "")
            )
        else:
            report.sentences_without_session.append(
                f"No session is running on {rig_text}; the torque is off."
            )


# Processes


class _SupervisorStop:
    """Stop of a process that runs sessions and of its control processes, by signals.

    The process may also be a control process whose supervisor has ended.
    """

    def __init__(self, process: RunningProcess, control_processes: list[RunningProcess]) -> None:
        self.process = process
        self._control_name_by_pid: dict[int, str] = {}
        """Process id of each control process that was seen → its last name."""
        self._was_session_seen = False
        """Whether a session was observed, so that its file may still be open."""
        self.control_processes = control_processes
        self._rigd_command = _rigd_arguments(process.command)
        self._start_time = process.start_ticks or 0
        self._rig_name = locked_rig(process.pid) or self._rig_of_command_line
        self._had_session = self.has_session
        self.suspended = False
        """Whether the process was sent the signal but is suspended, and cannot receive it."""
        self._last_signal_s = -_REPEAT_SIGNAL_INTERVAL_S
        self._is_signal_sent = False
        self._is_control_stopped = False

    @property
    def identity(self) -> tuple[int, int]:
        """Process id and start time, which identify the process uniquely."""
        return self.process.pid, self._start_time

    @property
    def description(self) -> str:
        """Text for the operator with command, rig and process id."""
        command_words = takewhile(
            lambda argument: not argument.startswith("-"), self._rigd_command[:2]
        )
        command_name = " ".join(["rigd", *command_words]) if self._rigd_command else "a session"
        rig_name = self._rig_name or _option_value(self._rigd_command, "--profile")
        rig_text = "an unknown rig" if rig_name is None else f"the rig {rig_name}"
        printable_text = "".join(
            c if c.isprintable() else "?" for c in f"{command_name} on {rig_text}"
        )
        return f"{printable_text} (process {self.process.pid})"

    @property
    def _rig_of_command_line(self) -> str | None:
        """Name of the rig by the command line; None if that states the path of a profile."""
        profile_option = _option_value(self._rigd_command, "--profile")
        if profile_option is None:
            return "sim" if self._is_foreground_command else None
        return None if "/" in profile_option or profile_option.endswith(".toml") else profile_option

    @property
    def _is_foreground_command(self) -> bool:
        """Whether the process is a command that runs sessions in the foreground."""
        return self._rigd_command[:1] in [(name,) for name in _SESSION_COMMANDS]

    @property
    def has_session(self) -> bool:
        """Whether a session may be running, or the torque may be on."""
        if any(control_process.name != IDLE_NAME for control_process in self.control_processes):
            return True
        return self._is_foreground_command and not self.process.ignores(STOP_SIGNAL)

    @property
    def control_processes(self) -> list[RunningProcess]:
        """Control processes that were running when the process table was last read."""
        return self._control_processes

    @control_processes.setter
    def control_processes(self, control_processes: list[RunningProcess]) -> None:
        self._control_processes = control_processes
        for control_process in control_processes:
            self._control_name_by_pid[control_process.pid] = control_process.name
            self._was_session_seen |= control_process.name == SESSION_NAME

    @property
    def _may_have_torque(self) -> bool:
        """Whether a drive has not shown that it is off, by the last name of its control process.

        Before a control process gets its first name, it has not communicated with the drive.
        """
        return not {CONNECTING_NAME, SESSION_NAME}.isdisjoint(self._control_name_by_pid.values())

    @property
    def has_shown_torque_off(self) -> bool:
        """Whether every drive that was connected has shown that it is off."""
        return not self._may_have_torque and IDLE_NAME in self._control_name_by_pid.values()

    @property
    def is_session_over(self) -> bool:
        """Whether no session is running, and none can begin any more."""
        if self.process.suspended and self.process.has_pending(STOP_SIGNAL):
            self.suspended = True
            return all(
                control_process.name == IDLE_NAME for control_process in self.control_processes
            )
        has_reacted = time.monotonic() - self._last_signal_s > _SIGNAL_REACTION_TIME_S
        has_obeyed = (
            self._is_signal_sent and has_reacted and not self.process.has_pending(STOP_SIGNAL)
        )
        if self._is_foreground_command and self.process.handles(STOP_SIGNAL):
            # Its control process ends after the file was closed. A process without a session may
            # still be planning, but will not begin the session.
            return has_obeyed and not (
                self.control_processes and (self._was_session_seen or self._may_have_torque)
            )
        return not self.has_session and (has_obeyed or not self._is_signal_sent)

    def may_run_rig(self, rig_file_name: str) -> bool:
        """Return whether the process may be using a rig, given by its name in file names."""
        return self._rig_name is None or file_name(self._rig_name) == rig_file_name

    def send_due_signals(self, elapsed_s: float) -> None:
        """Send the signals that are due, `elapsed_s` seconds after the stop began."""
        for control_process in self.control_processes:
            if control_process.suspended:  # a suspended control process leaves its last torque on
                self._send_unless_ended(control_process, signal.SIGCONT)
        now_s = time.monotonic()
        if now_s - self._last_signal_s > _REPEAT_SIGNAL_INTERVAL_S and (
            self.has_session or not self._is_signal_sent
        ):
            self._last_signal_s = now_s
            self._send_stop_signal()
        if elapsed_s > _STOP_CONTROL_DELAY_S and not self._is_control_stopped:
            self._is_control_stopped = True
            self._stop_control()

    def _send_stop_signal(self) -> None:
        """Send the process the signal that requests its sessions to stop."""
        process = self.process
        if process.handles(STOP_SIGNAL) and process not in self.control_processes:
            self._is_signal_sent = send_signal(process, self._start_time, STOP_SIGNAL)
        elif not self._is_foreground_command:
            self._stop_control()
        elif not process.ignores(STOP_SIGNAL):  # the process is starting, or an older version
            child_signal = signal.SIGINT if process.handles(signal.SIGINT) else signal.SIGTERM
            self._is_signal_sent = send_signal(process, self._start_time, child_signal)

    def _stop_control(self) -> None:
        """Send SIGTERM to the control processes that are not idle."""
        for control_process in self.control_processes:
            if control_process.name != IDLE_NAME:
                self._send_unless_ended(control_process, signal.SIGTERM)

    def _send_unless_ended(self, process: RunningProcess, signal_number: int) -> None:
        """Send a signal to a process, unless it has ended."""
        start_ticks = process.start_ticks
        if start_ticks is not None:
            send_signal(process, start_ticks, signal_number)

    def report_to(self, report: StopReport, *, has_ended: bool, is_end_awaited: bool) -> None:
        """Add to a report whether the session of this process has ended."""
        if not is_end_awaited and self._had_session:
            report.stopping_sessions.append(self.description)
        elif not has_ended:
            report.unended_sessions.append(self.description)
        elif self._may_have_torque:
            report.stopped_sessions.append(self.description)
            report.unconfirmed_drives.append(
                f"The drive of {self.description} has not shown that it is off."
            )
        elif self._had_session and not self.has_shown_torque_off:
            report.sentences_without_session.append(
                f"Stopped before it connected the devices: {self.description}."
            )
        elif self._had_session:
            report.stopped_sessions.append(self.description)
        elif self.control_processes:
            report.sentences_without_session.append(
                f"No session is running on {self.description}; the torque is off."
            )
        if self.suspended:
            drive_text = (
                "; its control process has disabled the drive" if self.has_shown_torque_off else ""
            )
            report.doubts.append(f"{self.description} is suspended and cannot respond{drive_text}.")


def _find_supervisors(
    process_table: Sequence[RunningProcess],
) -> list[tuple[RunningProcess, list[RunningProcess]]]:
    """Return the processes of a table that run sessions, each with its control processes."""
    process_by_pid = {process.pid: process for process in process_table}
    control_processes_by_supervisor: dict[int, list[RunningProcess]] = {}
    for process in process_table:
        supervisor_pid = supervisor_of_control(process.command)
        if supervisor_pid is None or process.uid < 0:
            continue
        supervisor_process = process_by_pid.get(supervisor_pid)
        # Any process can have this command line, so only the parent, of the same user, is trusted.
        is_orphaned = supervisor_process is None or (supervisor_process.uid, supervisor_pid) != (
            process.uid,
            process.parent,
        )
        control_processes_by_supervisor.setdefault(
            process.pid if is_orphaned else supervisor_pid, []
        ).append(process)
    for process in process_table:
        rigd_arguments = _rigd_arguments(process.command)
        if process.uid < 0 or rigd_arguments[:1] not in [
            (process_name,) for process_name in _SESSION_COMMANDS
        ]:
            continue
        parent_process = process_by_pid.get(process.parent)
        is_forked = parent_process is not None and parent_process.command == process.command
        runs_no_session = "--from" in rigd_arguments and not process.handles(STOP_SIGNAL)
        if not (is_forked or runs_no_session or process.ignores(STOP_SIGNAL)):
            control_processes_by_supervisor.setdefault(process.pid, [])
    return [
        (process_by_pid[pid], control_processes)
        for pid, control_processes in sorted(control_processes_by_supervisor.items())
    ]


def _rigd_arguments(command_line: Sequence[str]) -> tuple[str, ...]:
    """Return the arguments after ``rigd`` in a command line of Python, or () without ``rigd``."""
    if not command_line or not Path(command_line[0]).name.startswith("python"):
        return ()
    for argument_index, argument in enumerate(command_line[1:], start=1):
        if Path(argument).name == "rigd":
            return tuple(command_line[argument_index + 1 :])
        if not argument.startswith("-"):
            break
    return ()


def _option_value(arguments: Sequence[str], option_flag: str) -> str | None:
    """Return the value of an option in a command line, or None if the option is absent."""
    for argument_index, argument in enumerate(arguments):
        option_name, equals_sign, option_value = argument.partition("=")
        if option_name == option_flag:
            return (
                option_value
                if equals_sign
                else "".join(arguments[argument_index + 1 : argument_index + 2])
            )
    return None


def _may_folder_belong_to(folder: Path, uid: int) -> bool:
    """Return whether an unreadable folder may belong to a user, by its nearest readable parent."""
    for existing_path in (folder, *folder.parents):
        with suppress(OSError):
            return existing_path.stat().st_uid == uid
    return True


def _user_name(uid: int) -> str:
    """Return the name of a user, or the user id as text if there is no name."""
    with suppress(KeyError):
        return pwd.getpwuid(uid).pw_name
    return str(uid)
