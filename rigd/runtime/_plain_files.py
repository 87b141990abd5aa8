"""Safe opening of files whose names come from users: they may be pipes, devices or very large."""

import errno
import os
import stat
from pathlib import Path
from typing import Final, TextIO

_OPEN_FLAGS: Final = os.O_RDONLY | sum(
    getattr(os, name, 0) for name in ("O_CLOEXEC", "O_NONBLOCK", "O_BINARY")
)
"""Flags with which a file is opened; some do not exist on Windows."""


def open_plain_file(path: Path, max_bytes: int, *, newline: str | None = None) -> TextIO:
    """Open a regular text file of limited size, without blocking on a pipe.

    Parameters
    ----------
    path
        Path of the file.
    max_bytes
        Maximum size of the file in bytes.
    newline
        Treatment of line ends, as for `open`.

    Raises
    ------
    OSError
        If the file cannot be opened, is not a regular file, or is too large.
    """
    fd = _open_regular_file(path, max_bytes)
    return open(fd, newline=newline, encoding="utf-8-sig")  # noqa: PTH123 - of a descriptor


def read_plain_file(path: Path, max_bytes: int) -> bytes:
    """Return the content of a regular file of limited size, without blocking on a pipe.

    Parameters
    ----------
    path
        Path of the file.
    max_bytes
        Maximum size of the file in bytes.

    Raises
    ------
    OSError
        If the file cannot be read, is not a regular file, or is too large.
    """
    with open(_open_regular_file(path, max_bytes), "rb") as opened_file:
        return opened_file.read(max_bytes)


def _open_regular_file(path: Path, max_bytes: int) -> int:
    """Open a file and return its descriptor; raise OSError if it is not regular or too large."""
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "its name contains a NUL character")
    fd = os.open(path, _OPEN_FLAGS)
    file_status = os.fstat(fd)
    if not stat.S_ISREG(file_status.st_mode) or file_status.st_size > max_bytes:
        os.close(fd)
        raise OSError(errno.EINVAL, f"not a file of at most {max_bytes / 1e6:g} MB")
    return fd
