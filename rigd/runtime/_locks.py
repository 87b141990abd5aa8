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
from rigd.runtime._addresses import file_name, runtime_folder

_COMMON = Path("/run/lock")
_LOCKS = Path("/proc/locks")
_NAME_SIZE = 200


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
        said = os.pread(fd, _NAME_SIZE, 0).decode(errors="replace").strip() or "unknown"
        raise HeldError(said + _others(fd, said)) from None


def _others(fd: int, said: str) -> str:
    """Name who holds the file by the kernel's table, if that is not who the file says it is.

    Any user may write to the file, and hold the lock.
    """
    inode = str(os.fstat(fd).st_ino)
    try:
        # 1: FLOCK ADVISORY WRITE PID MAJOR:MINOR:INODE START END
        rows = [line.split() for line in _LOCKS.read_text("ascii").splitlines()]
    except OSError:
        return ""
    found = ""
    for row in rows:
        if len(row) < 6 or row[1] != "FLOCK" or row[5].rpartition(":")[2] != inode:
            continue
        if re.search(rf"\bprocess {row[4]}\b", said):
            return ""
        with suppress(OSError):
            found = f"; held by process {row[4]} of user {Path('/proc', row[4]).stat().st_uid}"
    return found


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
