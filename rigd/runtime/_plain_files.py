"""Text files that a user names, of whatever kind they may turn out to be."""

import errno
import os
import stat
from pathlib import Path
from typing import TextIO


def open_plain_file(path: Path, most_bytes: int, *, newline: str | None = None) -> TextIO:
    """Open a text file of limited size; a pipe without a writer is not waited for.

    Parameters
    ----------
    path
        Name of the file.
    most_bytes
        The limit.
    newline
        Argument of `open`.

    Raises
    ------
    OSError
        If it cannot be opened, or is not of that kind.
    """
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "its name contains a NUL character")
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    status = os.fstat(fd)
    if not stat.S_ISREG(status.st_mode) or status.st_size > most_bytes:
        os.close(fd)
        raise OSError(errno.EINVAL, f"not a file of at most {most_bytes / 1e6:g} MB")
    return open(fd, newline=newline, encoding="utf-8-sig")  # noqa: PTH123 - of a descriptor
