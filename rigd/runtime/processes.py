"""Process table of this computer from the kernel: running processes, sockets and locks.

The table does not depend on the environment of the calling process, nor on the folder in which
another process of the same user created its socket.
"""

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rigd.runtime.addresses import started_at

_PROC: Final = Path("/proc")
_SOCKETS: Final = Path("/proc/net/unix")
_LISTENER: Final = re.compile(r"\S+: \S+ \S+ ([0-9A-Fa-f]{1,8}) \S+ \S+ +\S+ (/.*)")
"""Line of the table of sockets; any user can choose any name, even with a line break."""
_LISTENS: Final = 0x10000


@dataclass(frozen=True, slots=True)
class RunningProcess:
    """One row of the process table."""

    pid: int
    """Process id."""
    parent: int
    """Process id of the parent or, after its end, of the adopting process."""
    uid: int
    """User id; -1 while the process changes users (a setuid program)."""
    name: str
    """Short name (`name_this_process`)."""
    command: tuple[str, ...]
    """Command line."""
    caught: int
    """Mask of handled signals: bit n-1 for signal n, also in the next two masks."""
    ignored: int
    """Mask of ignored signals."""
    pending: int
    """Mask of pending signals."""
    suspended: bool
    """Whether the process is stopped by a signal or a debugger."""

    @property
    def born(self) -> int | None:
        """Start time in clock ticks after that of the computer; None: the process has ended."""
        return started_at(self.pid)

    def handles(self, number: int) -> bool:
        """Return whether the process has a handler for a signal."""
        return bool(self.caught >> (number - 1) & 1)

    def ignores(self, number: int) -> bool:
        """Return whether the process ignores a signal."""
        return bool(self.ignored >> (number - 1) & 1)

    def awaits(self, number: int) -> bool:
        """Return whether a signal is pending."""
        return bool(self.pending >> (number - 1) & 1)


def read_processes() -> list[RunningProcess]:
    """Return all running processes that this user can see, by process id.

    Raises
    ------
    OSError
        If the system has no process table.
    """
    numbers = sorted(int(entry.name) for entry in _PROC.iterdir() if entry.name.isdigit())
    found = [process for process in map(read_process, numbers) if process is not None]
    if not any(process.pid == os.getpid() for process in found):
        raise FileNotFoundError(2, "this process is not in it", os.fspath(_PROC))
    return found


def read_process(pid: int) -> RunningProcess | None:
    """Return the row of one process, or None if it has ended or cannot be seen.

    Parameters
    ----------
    pid
        Process id.
    """
    try:
        status = Path(_PROC, str(pid), "status").read_text("utf-8", errors="replace")
        command = Path(_PROC, str(pid), "cmdline").read_bytes()
        return _row(pid, status, command)
    except (OSError, KeyError, ValueError, IndexError):
        return None


def _row(pid: int, status: str, command: bytes) -> RunningProcess | None:
    rows = [line.partition(":\t") for line in status.split("\n")]
    fields = {key: value for key, _, value in reversed(rows)}  # the first value of a name is used
    state = fields["State"][:1]
    if state in "ZX":
        return None
    users = {int(number) for number in fields["Uid"].split()}
    return RunningProcess(
        pid=pid,
        parent=int(fields["PPid"]),
        uid=users.pop() if len(users) == 1 else -1,
        name=fields["Name"],
        command=tuple(os.fsdecode(command).split("\0")[:-1]),
        caught=int(fields["SigCgt"], 16),
        ignored=int(fields["SigIgn"], 16),
        pending=int(fields["SigPnd"], 16) | int(fields["ShdPnd"], 16),
        suspended=state in "Tt",
    )


def send_signal(process: RunningProcess, born: int, number: int) -> bool:
    """Send a signal to a process, unless it has ended; return whether it was sent.

    Parameters
    ----------
    process
        The process.
    born
        Its start time, because its process id may have been reused.
    number
        The signal.
    """
    if process.born != born:
        return False
    with suppress(OSError):
        os.kill(process.pid, number)
        return True
    return False


def name_this_process(name: str) -> None:
    """Set the short name of the calling thread, which every user sees in the process table.

    Parameters
    ----------
    name
        At most 15 bytes.
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
        If the system has no such list.
    """
    # Num RefCount Protocol Flags Type St Inode Path
    lines = _SOCKETS.read_text("utf-8", errors="surrogateescape").split("\n")
    matches = filter(None, map(_LISTENER.fullmatch, lines))
    return sorted({Path(match[2]) for match in matches if int(match[1], 16) & _LISTENS})
