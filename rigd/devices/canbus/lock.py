"""One program at a time on a bus: a second one would reconfigure a drive that moves."""

import fcntl
import os
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from rigd.devices.contracts import DeviceError
from rigd.devices.simulator import runtime_folder


class BusLock:
    """Held from the opening of a bus to its closing; the kernel takes it off a process that dies.

    Parameters
    ----------
    bus
        Where the bus is: a channel, or the socket of a simulated one.
    """

    def __init__(self, bus: str) -> None:
        self._bus = bus
        self._file: TextIO | None = None

    def acquire(self) -> None:
        """Take the bus.

        Raises
        ------
        DeviceError
            If another program has it; the message says which process.
        """
        path = self._path()
        try:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            file = path.open("a+", encoding="utf-8")
        except OSError as error:
            raise DeviceError(
                f"CAN bus {self._bus}: it cannot be reserved in {path.parent} ({error.strerror}); "
                "set XDG_RUNTIME_DIR to a folder that is yours."
            ) from None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.seek(0)
            holder = file.read().strip() or "unknown"
            file.close()
            raise DeviceError(
                f"CAN bus {self._bus}: another rigd is using it (process {holder}); wait for it, "
                "or stop it."
            ) from None
        file.truncate(0)
        file.write(f"{os.getpid()}")
        file.flush()
        self._file = file

    def release(self) -> None:
        """Give the bus up; harmless when repeated."""
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            self._file = None

    def _path(self) -> Path:
        name = "".join(c if c.isalnum() else "-" for c in self._bus).strip("-")
        return runtime_folder() / f"bus-{name}.lock"
