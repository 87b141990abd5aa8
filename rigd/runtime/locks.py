"""Lock files, which one program holds at a time, and the lock of a rig."""

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

_COMMON_LOCK_FOLDER = Path("/run/lock")
_LOCK_TABLE = Path("/proc/locks")
_MAX_HOLDER_BYTES = 200
_RIG_LOCK_PATTERN = re.compile(r"/(?:rigd-)?rig-([^/]*)\.lock(?: \(deleted\))?$")


class LockHeldError(Exception):
    """Raised if another program holds a lock file; the message describes that program."""


class LockFile:
    """Lock file that contains the name of the program that holds it.

    Parameters
    ----------
    name
        Name of the locked resource. Names that differ only in other characters than letters and
        digits are the same resource.
    for_all_users
        Whether the resource is common to all users of this computer, as hardware is. The file is
        then in ``/run/lock`` if that folder is writable. Otherwise it is in the user's runtime
        folder.
    """

    def __init__(self, name: str, *, for_all_users: bool) -> None:
        file_stem = file_name(name)
        uses_common_folder = for_all_users and os.access(_COMMON_LOCK_FOLDER, os.W_OK)
        self.path = (
            _COMMON_LOCK_FOLDER / f"rigd-{file_stem}.lock"
            if uses_common_folder
            else runtime_folder() / f"{file_stem}.lock"
        )
        self._fd: int | None = None

    def acquire(self, holder: str, *, exclusive: bool = True) -> None:
        """Acquire the lock, exclusively or together with other non-exclusive holders.

        Parameters
        ----------
        holder
            Name of this program, for error messages of other programs.
        exclusive
            Whether the lock is exclusive.

        Raises
        ------
        LockHeldError
            If another program holds the lock.
        OSError
            If the lock file cannot be created.
        """
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        fd = self._open_file()
        try:
            _lock_descriptor(fd, exclusive=exclusive)
            os.ftruncate(fd, 0)
            os.pwrite(fd, f"{holder}, process {os.getpid()}".encode(), 0)
        except BaseException:
            os.close(fd)
            raise
        self._fd = fd

    def release(self) -> None:
        """Release the lock, if this program holds it; may be called repeatedly."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None

    def _open_file(self) -> int:
        """Return a descriptor of the lock file, which is created if it does not exist."""
        with suppress(FileExistsError):
            fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
            os.fchmod(fd, 0o666)  # despite the umask: the next holder may be another user
            return fd
        # In a folder that others can write to, the name may be a link to any file.
        fd = os.open(self.path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            os.close(fd)
            raise OSError(errno.EINVAL, f"{self.path.name} there is not a plain file")
        return fd


def _lock_descriptor(fd: int, *, exclusive: bool) -> None:
    """Lock an open file without waiting; raise LockHeldError if another program holds it."""
    try:
        fcntl.flock(fd, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except OSError:
        holder_text = (
            os.pread(fd, _MAX_HOLDER_BYTES, 0).decode(errors="replace").strip() or "unknown"
        )
        raise LockHeldError(holder_text + _unnamed_holder_text(fd, holder_text)) from None


def _unnamed_holder_text(fd: int, stated_holder: str) -> str:
    """Return a text that names the process holding a lock; "" if the lock file already does.

    Any user can write to the file, so its content `stated_holder` may be wrong. The kernel's table
    is right.
    """
    lock_inode = os.fstat(fd).st_ino
    try:
        holder_pids = sorted(pid for pid, held_inode in _held_inodes() if held_inode == lock_inode)
    except OSError:
        return ""
    holder_text = ""
    for pid in holder_pids:
        if re.search(rf"\bprocess {pid}\b", stated_holder):
            return ""
        with suppress(OSError):
            holder_text = f"; held by process {pid} of user {Path('/proc', str(pid)).stat().st_uid}"
    return holder_text


def _held_inodes() -> set[tuple[int, int]]:
    """Return the pairs (process id, inode of the locked file) of the kernel's table of locks."""
    # 1: FLOCK ADVISORY WRITE PID MAJOR:MINOR:INODE START END
    table_rows = [table_line.split() for table_line in _LOCK_TABLE.read_text("ascii").splitlines()]
    return {
        (int(row[4]), int(row[5].rpartition(":")[2]))
        for row in table_rows
        if len(row) >= 6 and row[1] == "FLOCK"
    }


# One program at a time on a rig


class RigBusyError(FailureError):
    """Raised if another program uses the rig; the message states which program."""


class RigLock:
    """Lock that prevents two programs from using a rig, held while its context lasts.

    Parameters
    ----------
    rig_name
        Name of the rig's profile.
    holder
        Name of this program, for error messages of a second program.
    hardware
        Whether the rig is hardware, which is common to all users of this computer.
    exclusive
        Whether the lock is exclusive. Programs with a non-exclusive lock can run at the same time,
        because each simulates a rig of its own.
    """

    def __init__(
        self, rig_name: str, holder: str, *, hardware: bool, exclusive: bool = True
    ) -> None:
        self._rig = rig_name
        self._holder = holder
        self._is_exclusive = exclusive
        self._file = LockFile(f"rig-{rig_name}", for_all_users=hardware)

    def acquire(self) -> None:
        """Acquire the lock of the rig.

        Raises
        ------
        RigBusyError
            If another program holds the lock, or this cannot be determined.
        """
        try:
            self._file.acquire(self._holder, exclusive=self._is_exclusive)
        except LockHeldError as holder:
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
        """Release the lock of the rig."""
        self._file.release()

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def holds_rig_lock(pid: int, rig_name: str, folder: Path) -> bool:
    """Return whether a process holds the lock of a rig, according to the kernel's table of locks.

    Parameters
    ----------
    pid
        Process id.
    rig_name
        Name of the rig.
    folder
        Runtime folder that may contain the lock file. The files that the process has open are
        searched too.

    Raises
    ------
    OSError
        If the system has no table of locks.
    """
    held_inodes = _held_inodes()
    file_stem = f"rig-{file_name(rig_name)}"
    lock_files = [folder / f"{file_stem}.lock", _COMMON_LOCK_FOLDER / f"rigd-{file_stem}.lock"]
    lock_files += [
        lock_path
        for open_lock_name, lock_path in _open_rig_locks(pid)
        if open_lock_name == file_name(rig_name)
    ]
    for lock_path in lock_files:
        with suppress(OSError):
            if (pid, lock_path.stat().st_ino) in held_inodes:
                return True
    return False


def locked_rig(pid: int) -> str | None:
    """Return the name of the rig whose lock file a process has open.

    Parameters
    ----------
    pid
        Process id.

    Returns
    -------
    str or None
        Name of the rig as in file names. None if the process has no such file open, or the system
        does not show the files of the process.
    """
    return next((rig_name for rig_name, _ in _open_rig_locks(pid)), None)


def _open_rig_locks(pid: int) -> list[tuple[str, Path]]:
    """Return the lock files of rigs that a process has open: name of the rig, and path in /proc."""
    rig_locks = []
    with suppress(OSError):
        for fd_entry in Path("/proc", str(pid), "fd").iterdir():
            with suppress(OSError):
                lock_match = _RIG_LOCK_PATTERN.search(str(fd_entry.readlink()))
                if lock_match is not None:
                    rig_locks.append((lock_match[1], fd_entry))
    return rig_locks
