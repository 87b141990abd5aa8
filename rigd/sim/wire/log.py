"""What happened in the simulated rig: JSON lines for programs, plain lines for the operator."""

import json
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from rigd.devices.contracts import DeviceError
from rigd.sim.wire.errors import WrongUseError
from rigd.sim.wire.faults import LINE_KINDS

_FLUSH_S = 0.2
_SILENT = ("torque", "sdo write", *LINE_KINDS)
"""What happens too often to be told on the terminal."""


class EventLog:
    """Writes down each event with the simulated time, in seconds since the start.

    Parameters
    ----------
    path
        Of the file of JSON lines, which is new; None for none.
    quiet
        Tell nothing on the terminal.

    Attributes
    ----------
    time_s : float
        Simulated time; whoever moves the world sets it.

    Raises
    ------
    WrongUseError
        If there is a file of that name.
    DeviceError
        If the file cannot be written.
    """

    def __init__(self, path: Path | None, *, quiet: bool) -> None:
        self._quiet = quiet
        self._path = path
        self._file = None if path is None else _new_file(path)
        self._flushed_s = 0.0
        self.time_s = 0.0

    def __call__(self, device: str, what: str, **values: object) -> None:
        """Write down that something happened to a device."""
        if self._file is not None:
            entry = {"t_s": round(self.time_s, 9), "device": device, "what": what, **values}
            self._attempt(lambda file: file.write(json.dumps(entry) + "\n"))
        if what not in _SILENT:
            # States and faults must be in the file even if the process is killed.
            self._write_out()
            details = "  ".join(f"{key} {value}" for key, value in values.items())
            self.tell(f"{self.time_s:10.3f} s  {device}: {what}  {details}".rstrip())

    def tell(self, line: str) -> None:
        """Tell the operator; a terminal that has gone is none of our business."""
        if not self._quiet:
            with suppress(OSError, ValueError):
                sys.stdout.write(f"{line}\n")
                sys.stdout.flush()

    def flush(self) -> None:
        """Write out what has been waiting for some time."""
        if time.monotonic() - self._flushed_s > _FLUSH_S:
            self._write_out()

    def close(self) -> None:
        """Write out the rest."""
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):
                file.close()

    def discard(self) -> None:
        """Leave no file, for nothing happened; a pipe or a device stays."""
        self.close()
        if self._path is not None and self._path.is_file():
            self._path.unlink()

    def _write_out(self) -> None:
        self._flushed_s = time.monotonic()
        self._attempt(lambda file: file.flush())

    def _attempt(self, action: Callable[[TextIO], object]) -> None:
        """Do something with the file; a full disk ends the log, not the simulated rig."""
        if self._file is None:
            return
        try:
            action(self._file)
        except OSError as error:
            self.close()
            self.tell(f"The log cannot be written any more ({error.strerror}).")


def _new_file(path: Path) -> TextIO:
    """Open a file that was not there, or a device or pipe, in which nothing can be overwritten."""
    try:
        try:
            return path.open("x", encoding="utf-8")
        except FileExistsError:
            if path.is_file() or not path.exists():  # a link that leads nowhere is a name, too
                raise WrongUseError(
                    f"--log {path} exists; choose another name or move it away, nothing is "
                    "overwritten."
                ) from None
            return path.open("w", encoding="utf-8")
    except OSError as error:
        raise DeviceError(
            f"The log {path} of the simulated rig cannot be written ({error.strerror})."
        ) from None
