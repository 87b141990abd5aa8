"""The kernel's tables of running processes and of listening sockets.

They include the user's processes and sockets from other environments, which have another runtime
folder.
"""

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rigd.runtime.addresses import process_start_ticks

_PROCESS_TABLE: Final = Path("/proc")
_SOCKET_TABLE: Final = Path("/proc/net/unix")
_SOCKET_LINE_PATTERN: Final = re.compile(r"\S+: \S+ \S+ ([0-9A-Fa-f]{1,8}) \S+ \S+ +\S+ (/.*)")
"""Pattern of a line in the table of sockets; paths may contain any character, even line breaks."""
_LISTENING_FLAG: Final = 0x10000


@dataclass(frozen=True, slots=True)
class RunningProcess:
    """Running process, with its state at the time when the kernel's process table was read."""

    pid: int
    """Process id."""
    parent: int
    """Process id of the parent or, after the parent's end, of the adopting process."""
    uid: int
    """User id; -1 if the process has several user ids, as a setuid program has."""
    name: str
    """Short name, which `name_this_process` sets."""
    command: tuple[str, ...]
    """Command line: program and arguments."""
    handled_signal_mask: int
    """Bit mask of the signals that have a handler; bit n-1 represents signal n."""
    ignored_signal_mask: int
    """Bit mask of the ignored signals; bit n-1 represents signal n."""
    pending_signal_mask: int
    """Bit mask of the signals that were sent but not received yet; bit n-1 represents signal n."""
    suspended: bool
    """Whether the process is suspended by a signal or a debugger."""

    @property
    def start_ticks(self) -> int | None:
        """Start time in clock ticks since the computer was started, or None if it has ended."""
        return process_start_ticks(self.pid)

    def handles(self, signal_number: int) -> bool:
        """Return whether the process has a handler for a signal."""
        return bool(self.handled_signal_mask >> (signal_number - 1) & 1)

    def ignores(self, signal_number: int) -> bool:
        """Return whether the process ignores a signal."""
        return bool(self.ignored_signal_mask >> (signal_number - 1) & 1)

    def has_pending(self, signal_number: int) -> bool:
        """Return whether a signal was sent to the process but not received yet."""
        return bool(self.pending_signal_mask >> (signal_number - 1) & 1)


def read_processes() -> list[RunningProcess]:
    """Return all running processes that this user can see, sorted by process id.

    Raises
    ------
    OSError
        If the process table cannot be read.
    """
    process_ids = sorted(
        int(entry.name) for entry in _PROCESS_TABLE.iterdir() if entry.name.isdigit()
    )
    processes = [process for process in map(read_process, process_ids) if process is not None]
    if not any(process.pid == os.getpid() for process in processes):
        raise FileNotFoundError(2, "this process is not in it", os.fspath(_PROCESS_TABLE))
    return processes


def read_process(pid: int) -> RunningProcess | None:
    """Return the process with a process id; None if it has ended or this user cannot see it.

    Parameters
    ----------
    pid
        Process id.
    """
    try:
        status_text = Path(_PROCESS_TABLE, str(pid), "status").read_text("utf-8", errors="replace")
        command_bytes = Path(_PROCESS_TABLE, str(pid), "cmdline").read_bytes()
        return _parsed_process(pid, status_text, command_bytes)
    except (OSError, KeyError, ValueError, IndexError):
        return None


def _parsed_process(pid: int, status_text: str, command_bytes: bytes) -> RunningProcess | None:
    """Return a process from the texts of its files in /proc, or None if it has ended."""
    status_rows = [status_line.partition(":\t") for status_line in status_text.split("\n")]
    status_fields = {
        key: field_value for key, _, field_value in reversed(status_rows)
    }  # a name's first value is used
    process_state = status_fields["State"][:1]
    if process_state in "ZX":
        return None
    user_ids = {int(id_text) for id_text in status_fields["Uid"].split()}
    return RunningProcess(
        pid=pid,
        parent=int(status_fields["PPid"]),
        uid=user_ids.pop() if len(user_ids) == 1 else -1,
        name=status_fields["Name"],
        command=tuple(os.fsdecode(command_bytes).split("\0")[:-1]),
        handled_signal_mask=int(status_fields["SigCgt"], 16),
        ignored_signal_mask=int(status_fields["SigIgn"], 16),
        pending_signal_mask=int(status_fields["SigPnd"], 16) | int(status_fields["ShdPnd"], 16),
        suspended=process_state in "Tt",
    )


def send_signal(process: RunningProcess, start_ticks: int, signal_number: int) -> bool:
    """Send a signal to a process unless it has ended, and return whether the signal was sent.

    Parameters
    ----------
    process
        Process that gets the signal.
    start_ticks
        Start time of the process, which shows whether its process id was reused meanwhile.
    signal_number
        Number of the signal.
    """
    if process.start_ticks != start_ticks:
        return False
    with suppress(OSError):
        os.kill(process.pid, signal_number)
        return True
    return False


def name_this_process(name: str) -> None:
    """Set the short name of the calling thread, which every user sees in the process table.

    Parameters
    ----------
    name
        Short name of at most 15 bytes.
    """
    with suppress(OSError):  # not on Linux
        Path("/proc/thread-self/comm").write_text(name)


def listening_sockets() -> list[Path]:
    """Return the paths of the Unix sockets on which any process of this computer listens.

    The list contains the sockets of all users in all folders, each once, sorted. Any user can
    choose any path for a socket.

    Raises
    ------
    OSError
        If the system has no table of sockets.
    """
    # Num RefCount Protocol Flags Type St Inode Path
    table_lines = _SOCKET_TABLE.read_text("utf-8", errors="surrogateescape").split("\n")
    line_matches = filter(None, map(_SOCKET_LINE_PATTERN.fullmatch, table_lines))
    return sorted(
        {
            Path(line_match[2])
            for line_match in line_matches
            if int(line_match[1], 16) & _LISTENING_FLAG
        }
    )
