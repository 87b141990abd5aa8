"""Safe opening of files named by users, which may be of any kind."""

import errno
import os
import stat
from pathlib import Path
from typing import Final, TextIO

_FLAGS: Final = os.O_RDONLY | sum(
    getattr(os, name, 0) for name in ("O_CLOEXEC", "O_NONBLOCK", "O_BINARY")
)
"""Flags for opening; some do not exist on Windows."""


def open_plain_file(path: Path, most_bytes: int, *, newline: str | None = None) -> TextIO:
    """Open a regular text file of limited size, without blocking on a pipe.

    Parameters
    ----------
    path
        Name of the file.
    most_bytes
        Largest permitted size.
    newline
        Argument of `open`.

    Raises
    ------
    OSError
        If the file cannot be opened, is not a regular file, or is too large.
    """
    fd = _open(path, most_bytes)
    return open(fd, newline=newline, encoding="utf-8-sig")  # noqa: PTH123 - of a descriptor


def read_plain_file(path: Path, most_bytes: int) -> bytes:
    """Return the content of a regular file of limited size, without blocking on a pipe.

    Parameters
    ----------
    path
        Name of the file.
    most_bytes
        Largest permitted size.

    Raises
    ------
    OSError
        If the file cannot be read, is not a regular file, or is too large.
    """
    with open(_open(path, most_bytes), "rb") as file:
        return file.read(most_bytes)


def _open(path: Path, most_bytes: int) -> int:
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "its name contains a NUL character")
    fd = os.open(path, _FLAGS)
    status = os.fstat(fd)
    if not stat.S_ISREG(status.st_mode) or status.st_size > most_bytes:
        os.close(fd)
        raise OSError(errno.EINVAL, f"not a file of at most {most_bytes / 1e6:g} MB")
    return fd
