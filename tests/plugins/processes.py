"""Waiting, and the state of other processes: children, signals, sockets."""

import contextlib
import re
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, TypeVar

Met = TypeVar("Met")

LISTENING = "0A"
"""State of a socket, as /proc/net/tcp writes it."""


def eventually(
    condition: Callable[[], Met], within_s: float = 300.0, every_s: float = 0.02
) -> Met | None:
    """Whether a condition comes true: its last answer. The limit only ends a test that fails.

    The other process may be too busy to answer: that is not an answer yet.
    """
    deadline = time.monotonic() + within_s
    while True:
        met = None
        with contextlib.suppress(TimeoutError):
            met = condition()
        if met or time.monotonic() > deadline:
            return met
        time.sleep(every_s)


def children(pid: int) -> list[int]:
    """Return the children of all threads of a process; none if it has ended."""
    listed = ""
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                listed += (thread / "children").read_text()
    return [int(child) for child in listed.split()]


def child_running(pid: int, module: str) -> int:
    """Return the child of a process that runs a module."""
    found = [child for child in children(pid) if module in _command(child)]
    assert found, f"no {module} below {pid}"
    return found[0]


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        return ""


def state_of(task: Path) -> str:
    """Return the state of a process or a thread, X if there is none any more."""
    try:
        return (task / "stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return "X"


def has_ended(pid: int) -> bool:
    """Whether a process has ended, reaped or not."""
    return state_of(Path(f"/proc/{pid}")) in "ZX"


@contextlib.contextmanager
def ignored(number: int) -> Iterator[None]:
    """Ignore a signal; a process that is started meanwhile does so until it handles it."""
    before = signal.signal(number, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(number, before)


def ignores(pid: int, number: int) -> bool:
    """Whether a process ignores a signal."""
    status = Path(f"/proc/{pid}/status").read_text()
    (mask,) = re.findall(r"^SigIgn:\s*(\w+)$", status, re.MULTILINE)
    return bool(int(mask, 16) >> (number - 1) & 1)


class Socket(NamedTuple):
    """One end of TCP, as /proc/net/tcp writes it.

    Its number distinguishes two: that of a port that was given back may be another test's by
    now.
    """

    number: str
    local: str
    remote: str
    state: str

    @property
    def addresses(self) -> tuple[str, str]:
        """Addresses of both ends, without ports."""
        return self.local.partition(":")[0], self.remote.partition(":")[0]


def listeners(pid: int | None = None) -> set[Socket]:
    """Return the sockets on which somebody listens, or a process does."""
    return {socket for socket in sockets(pid) if socket.state == LISTENING}


def sockets(pid: int | None = None) -> set[Socket]:
    """Return the TCP sockets of this computer, or those that a process has open."""
    found = {
        Socket(words[9], *words[1:4])
        for table in ("tcp", "tcp6")
        for words in map(str.split, Path(f"/proc/net/{table}").read_text().splitlines()[1:])
    }
    if pid is None:
        return found
    numbers = _socket_numbers(pid)
    return {socket for socket in found if socket.number in numbers}


def _socket_numbers(pid: int) -> set[str]:
    numbers = set()
    with contextlib.suppress(FileNotFoundError):  # it has ended
        for descriptor in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(FileNotFoundError):  # closed meanwhile
                kind, _, number = str(descriptor.readlink()).partition(":")
                if kind == "socket":
                    numbers.add(number.strip("[]"))
    return numbers
