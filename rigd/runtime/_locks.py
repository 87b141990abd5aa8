"""Locks: a file that one program holds at a time, and one program at a time on a rig."""

import errno
import fcntl
import os
import re
import stat
from contextlib import suppress
from pathlib import Path
from typing import Self

from rigd.errors import FailureError
from rigd.runtime.addresses import file_name, runtime_folder

_COMMON = Path("/run/lock")
_LOCKS = Path("/proc/locks")
_NAME_SIZE = 200
_RIG_LOCK = re.compile(r"/(?:rigd-)?rig-([^/]*)\.lock(?: \(deleted\))?$")


class HeldError(Exception):
    """Another program holds the file; carries its own description."""


class HeldFile:
    """A lock with its holder's name in it.

    Parameters
    ----------
    name
        Name of what is locked; other characters than letters and digits count alike.
    everybody
        It is hardware, which all users of this computer share: the lock is in ``/run/lock`` where
        there is one. Otherwise it is in the user's own runtime folder.
    """

    def __init__(self, name: str, *, everybody: bool) -> None:
        plain = file_name(name)
        common = everybody and os.access(_COMMON, os.W_OK)
        self.path = _COMMON / f"rigd-{plain}.lock" if common else runtime_folder() / f"{plain}.lock"
        self._fd: int | None = None

    def acquire(self, holder: str, *, alone: bool = True) -> None:
        """Take it, or share it with others that do not want it alone.

        Parameters
        ----------
        holder
            What others are told of who has it.
        alone
            Whether the lock is exclusive.

        Raises
        ------
        HeldError
            If somebody else has it.
        OSError
            If the file cannot be made.
        """
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        fd = self._open()
        try:
            _lock(fd, alone=alone)
            os.ftruncate(fd, 0)
            os.pwrite(fd, f"{holder}, process {os.getpid()}".encode(), 0)
        except BaseException:
            os.close(fd)
            raise
        self._fd = fd

    def release(self) -> None:
        """Give it up; harmless when repeated."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None

    def _open(self) -> int:
        """Open it for reading and writing, whichever user made it."""
        with suppress(FileExistsError):
            fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
            os.fchmod(fd, 0o666)  # whatever the umask: the next holder may be another user
            return fd
        # In a folder that others may write to the name may be a link to anything.
        fd = os.open(self.path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            os.close(fd)
            raise OSError(errno.EINVAL, f"{self.path.name} there is not a plain file")
        return fd


def _lock(fd: int, *, alone: bool) -> None:
    try:
        fcntl.flock(fd, (fcntl.LOCK_EX if alone else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except OSError:
        holder = os.pread(fd, _NAME_SIZE, 0).decode(errors="replace").strip() or "unknown"
        raise HeldError(holder + _others(fd, holder)) from None


def _others(fd: int, holder: str) -> str:
    """Name who holds the file by the kernel's table, if that is not who the file says it is.

    Any user may write to the file, and hold the lock.
    """
    inode = os.fstat(fd).st_ino
    try:
        holders = sorted(pid for pid, held in _held_inodes() if held == inode)
    except OSError:
        return ""
    found = ""
    for pid in holders:
        if re.search(rf"\bprocess {pid}\b", holder):
            return ""
        with suppress(OSError):
            found = f"; held by process {pid} of user {Path('/proc', str(pid)).stat().st_uid}"
    return found


def _held_inodes() -> set[tuple[int, int]]:
    """Return process and inode of each file lock on this computer, by the kernel's table.

    Raises
    ------
    OSError
        If the system has no such table.
    """
    # 1: FLOCK ADVISORY WRITE PID MAJOR:MINOR:INODE START END
    rows = [line.split() for line in _LOCKS.read_text("ascii").splitlines()]
    return {
        (int(row[4]), int(row[5].rpartition(":")[2]))
        for row in rows
        if len(row) >= 6 and row[1] == "FLOCK"
    }


# One program at a time on a rig


class RigBusyError(FailureError):
    """Another program runs the rig; the message says which."""


class RigLock:
    """Held as long as its context lasts.

    Parameters
    ----------
    rig
        The profile's name.
    holder
        Name of this program, for messages to a second one.
    hardware
        The rig is none of a user's own: all users of this computer have to be asked.
    alone
        Refuse everybody else; otherwise only those who want to be alone: sessions on simulated rigs
        of their own, each in its own process and time, do not disturb each other.
    """

    def __init__(self, rig: str, holder: str, *, hardware: bool, alone: bool = True) -> None:
        self._rig = rig
        self._holder = holder
        self._alone = alone
        self._file = HeldFile(f"rig-{rig}", everybody=hardware)

    def acquire(self) -> None:
        """Take the rig.

        Raises
        ------
        RigBusyError
            If another program has it, or it cannot be told.
        """
        try:
            self._file.acquire(self._holder, alone=self._alone)
        except HeldError as holder:
            raise RigBusyError(
                f"The rig {self._rig} is in use ({holder}). Wait until it is free; if a daemon has "
                "it, use rigd start."
            ) from None
        except OSError as error:
            raise RigBusyError(
                f"The rig {self._rig} cannot be reserved in {self._file.path.parent} "
                f"({error.strerror}); set XDG_RUNTIME_DIR to a folder that is yours."
            ) from None

    def release(self) -> None:
        """Give the rig up."""
        self._file.release()

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def holds_rig(pid: int, rig: str, folder: Path) -> bool:
    """Whether a process holds the lock of a rig, by the kernel's table of locks.

    Parameters
    ----------
    pid
        Number of the process.
    rig
        Name of the rig.
    folder
        Runtime folder in which the lock is looked for, apart from where the process opened it.

    Raises
    ------
    OSError
        If the system has no such table.
    """
    held = _held_inodes()
    plain = f"rig-{file_name(rig)}"
    files = [folder / f"{plain}.lock", _COMMON / f"rigd-{plain}.lock"]
    files += [path for name, path in _open_locks(pid) if name == file_name(rig)]
    for path in files:
        with suppress(OSError):
            if (pid, path.stat().st_ino) in held:
                return True
    return False


def held_rig(pid: int) -> str | None:
    """Return the name of the rig whose lock a process has open, as file names have it.

    Parameters
    ----------
    pid
        Number of the process.

    Returns
    -------
    str or None
        The name; None if it has none, or the system does not show its files.
    """
    return next((name for name, _ in _open_locks(pid)), None)


def _open_locks(pid: int) -> list[tuple[str, Path]]:
    """Return the rigs' locks that a process has open: name of the rig, and way to the file."""
    found = []
    with suppress(OSError):
        for entry in Path("/proc", str(pid), "fd").iterdir():
            with suppress(OSError):
                match = _RIG_LOCK.search(str(entry.readlink()))
                if match is not None:
                    found.append((match[1], entry))
    return found
