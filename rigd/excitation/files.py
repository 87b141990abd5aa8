"""Opening what an operator names as an excitation's file."""

import os
import stat
from pathlib import Path
from typing import TextIO

from rigd.excitation.options import ExcitationError


def open_plain_file(path: Path, most_bytes: int, *, newline: str | None = None) -> TextIO:
    """Open a text file of limited size; a pipe that nobody writes to is not waited for.

    Parameters
    ----------
    path
        Its name.
    most_bytes
        The limit.
    newline
        As `open` has it.

    Raises
    ------
    ExcitationError
        If it is no such file.
    OSError
        If it cannot be opened.
    """
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    status = os.fstat(fd)
    if not stat.S_ISREG(status.st_mode) or status.st_size > most_bytes:
        os.close(fd)
        raise ExcitationError(f"{path}: is not a file of at most {most_bytes / 1e6:g} MB.")
    return open(fd, newline=newline, encoding="utf-8-sig")  # noqa: PTH123 - of a descriptor
