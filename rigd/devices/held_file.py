"""A file that one program holds at a time: the kernel takes it off a program that dies."""

import fcntl
import os
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from rigd.devices.simulator import runtime_folder


class HeldError(Exception):
    """Another program holds the file; carries what it says of itself."""


class HeldFile:
    """A lock in the runtime folder, with its holder's name in it.

    Parameters
    ----------
    name
        What is locked; other characters than letters and digits count alike.
    """

    def __init__(self, name: str) -> None:
        plain = "".join(c if c.isalnum() else "-" for c in name).strip("-")
        self.path: Path = runtime_folder() / f"{plain}.lock"
        self._file: TextIO | None = None

    def acquire(self, holder: str, *, alone: bool = True) -> None:
        """Take it, or share it with others that do not want it alone.

        Raises
        ------
        HeldError
            If somebody else has it.
        OSError
            If the file cannot be made.
        """
        self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        file = self.path.open("a+", encoding="utf-8")
        try:
            fcntl.flock(file, (fcntl.LOCK_EX if alone else fcntl.LOCK_SH) | fcntl.LOCK_NB)
        except OSError:
            file.seek(0)
            said = file.read().strip() or "unknown"
            file.close()
            raise HeldError(said) from None
        file.truncate(0)
        file.write(f"{holder}, process {os.getpid()}")
        file.flush()
        self._file = file

    def release(self) -> None:
        """Give it up; harmless when repeated."""
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None
