"""Files that are never overwritten, survive a dead host, and say while somebody writes them."""

import contextlib
import errno
import os
from pathlib import Path
from typing import Final

try:
    import fcntl
except ImportError:  # sessions are recorded on Linux, but read anywhere
    fcntl = None  # type: ignore[assignment]


_COPY_BYTES: Final = 1 << 20


def fsync_directory(path: Path) -> None:
    """Bring the names in a folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def copy_new(descriptor: int, target: Path) -> None:
    """Copy what an open file holds, of whatever name, to a new file and to the disk."""
    with target.open("xb") as copy:
        try:
            position = 0
            while data := os.pread(descriptor, _COPY_BYTES, position):
                copy.write(data)
                position += len(data)
            copy.flush()
            os.fsync(copy.fileno())
        except OSError:
            target.unlink()
            raise


def rename_new(source: Path, target: Path) -> None:
    """Rename a file, atomically failing with ``FileExistsError`` if `target` exists."""
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK):
            raise
        # A file system without hard links (FAT, some network shares): reserve the name, which
        # fails if anybody has it, and replace the empty file that then is our own.
        os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        source.replace(target)
    else:
        source.unlink()


def mark_as_written(descriptor: int) -> None:
    """Say for as long as `descriptor` is open, and its process lives, that the file grows.

    An advisory lock; a file system without locks goes without it.
    """
    if fcntl is not None:
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_being_written(path: Path) -> bool:
    """Tell whether a living process holds the mark of `mark_as_written`."""
    if fcntl is None:
        return False
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    else:
        return False
    finally:
        os.close(descriptor)
