"""Locks: a file with one holder at a time, and the lock of a rig."""

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
    """Another program holds the file; the message is the description of that program."""


class HeldFile:
    """Lock file that contains the name of its holder.

    Parameters
    ----------
    name
        Name of the locked resource; all characters except letters and digits are equivalent.
    everybody
        The resource is hardware, common to all users of this computer: the lock is in
        ``/run/lock`` if this folder exists. Otherwise it is in the user's own runtime folder.
    """

    def __init__(self, name: str, *, everybody: bool) -> None:
        plain = file_name(name)
        common = everybody and os.access(_COMMON, os.W_OK)
        self.path = _COMMON / f"rigd-{plain}.lock" if common else runtime_folder() / f"{plain}.lock"
        self._fd: int | None = None

    def acquire(self, holder: str, *, alone: bool = True) -> None:
        """Acquire the lock, either exclusively or together with other non-exclusive holders.

        Parameters
        ----------
        holder
            Name of the holder, for the messages of other programs.
        alone
            Whether the lock is exclusive.

        Raises
        ------
        HeldError
            If another program holds the lock.
        OSError
            If the file cannot be created.
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
        """Release the lock; repeated calls do nothing."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None

    def _open(self) -> int:
        """Open the file for reading and writing, whichever user created it."""
        with suppress(FileExistsError):
            fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
            os.fchmod(fd, 0o666)  # despite the umask: the next holder may be another user
            return fd
        # In a folder that is writable for others the name may be a link to any file.
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
    """Return the holders in the kernel's table that the file does not name.

    Any user can write to the file and hold the lock.
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
    """Return process id and inode of each file lock in the kernel's table."""
    # 1: FLOCK ADVISORY WRITE PID MAJOR:MINOR:INODE START END
    rows = [line.split() for line in _LOCKS.read_text("ascii").splitlines()]
    return {
        (int(row[4]), int(row[5].rpartition(":")[2]))
        for row in rows
        if len(row) >= 6 and row[1] == "FLOCK"
    }


# One program at a time on a rig


class RigBusyError(FailureError):
    """Another program uses the rig; the message names it."""


class RigLock:
    """Lock of a rig, held within its context.

    Parameters
    ----------
    rig
        The profile's name.
    holder
        Name of this program, for messages to a second one.
    hardware
        The rig is hardware, common to all users of this computer.
    alone
        Hold the lock exclusively. Otherwise only exclusive holders are excluded: sessions on
        simulated rigs of their own do not disturb each other.
    """

    def __init__(self, rig: str, holder: str, *, hardware: bool, alone: bool = True) -> None:
        self._rig = rig
        self._holder = holder
        self._alone = alone
        self._file = HeldFile(f"rig-{rig}", everybody=hardware)

    def acquire(self) -> None:
        """Acquire the rig.

        Raises
        ------
        RigBusyError
            If another program holds it, or this cannot be determined.
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
        """Release the rig."""
        self._file.release()

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def holds_rig(pid: int, rig: str, folder: Path) -> bool:
    """Return whether a process holds the lock of a rig, from the kernel's table of locks.

    Parameters
    ----------
    pid
        Number of the process.
    rig
        Name of the rig.
    folder
        Runtime folder to search for the lock, in addition to the folder where the process opened
        it.

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
    """Return the rig whose lock file a process has open, as spelled in file names.

    Parameters
    ----------
    pid
        Number of the process.

    Returns
    -------
    str or None
        The name; None if there is none, or the system does not show the files of the process.
    """
    return next((name for name, _ in _open_locks(pid)), None)


def _open_locks(pid: int) -> list[tuple[str, Path]]:
    """Return the rig locks that a process has open: name of the rig and path in /proc."""
    found = []
    with suppress(OSError):
        for entry in Path("/proc", str(pid), "fd").iterdir():
            with suppress(OSError):
                match = _RIG_LOCK.search(str(entry.readlink()))
                if match is not None:
                    found.append((match[1], entry))
    return found
