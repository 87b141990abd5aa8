"""Faults to inject: how they are specified, what they do to frames, and the log of events.

A fault is written as ``KIND[,key=value…][@SECONDS]``: with ``@`` it begins so long after the drive
was first enabled, without at once. Times are simulated time. A frame meets at most one fault, the
oldest that it fits.
"""

import json
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from rigd.devices.contracts import DeviceError
from rigd.devices.obstacles import Disturbance, ObstacleError, parse_obstacle
from rigd.errors import UserError


class WrongUseError(UserError, ValueError):
    """A request that cannot be met; the message says why, for the operator."""


# Specification of a fault

Value = int | float | str
Deliver = Callable[[int, bytes, object], None]
"""Takes identifier, data and origin of what gets through."""

SERIAL = -1
"""Pseudo-identifier of the data on a serial line."""


class FaultError(WrongUseError):
    """A fault has a syntax error, or is not possible on this rig; the message says why."""


@dataclass(frozen=True, slots=True)
class _FaultKey:
    """Values that a key may have, and its default."""

    read: Callable[[str], Value]
    says: str
    default: Value | None = None
    needed: bool = False


def _whole(low: int, high: int, **how: Any) -> _FaultKey:  # noqa: ANN401 - passed on
    def read(text: str) -> int:
        number = int(text, 0)
        if not low <= number <= high:
            raise ValueError(text)
        return number

    return _FaultKey(read, f"a whole number from {low} to {high}", **how)


def _positive(**how: Any) -> _FaultKey:  # noqa: ANN401 - passed on
    def read(text: str) -> float:
        number = float(text)
        if not 0 < number <= _LONGEST_S:
            raise ValueError(text)
        return number

    return _FaultKey(read, f"a number above 0, up to {_LONGEST_S:g}", **how)


def _one_of(*choices: str, **how: Any) -> _FaultKey:  # noqa: ANN401 - passed on
    def read(text: str) -> str:
        if text not in choices:
            raise ValueError(text)
        return text

    return _FaultKey(read, " or ".join(choices), **how)


_LONGEST_S = 1e6
_MOST = 1_000_000_000
_SENDER = {
    "from": _one_of("drive", "sensor", "host", needed=True),
    "id": _whole(0, 0x7FF),
    "frames": _whole(1, _MOST, default=1),
}
_DEVICE = _one_of("drive", "sensor", needed=True)
_FOR = _positive()

_TEXT = _FaultKey(str, "a value")
_FOUND = _FaultKey(str, "a value", needed=True)

LINE_KINDS = ("drop", "delay", "corrupt", "reorder")
KINDS: dict[str, dict[str, _FaultKey]] = {
    "drop": _SENDER | {"bytes": _whole(1, _MOST)},
    "delay": _SENDER | {"ms": _positive(needed=True)},
    "corrupt": _SENDER | {"byte": _whole(0, 255, default=0)},
    "reorder": _SENDER,
    "freeze": {"device": _DEVICE, "for": _FOR},
    "emcy": {"code": _whole(0, 0xFFFF, needed=True), "register": _whole(0, 0xFF, default=1)},
    "sto": {"for": _FOR},
    "busoff": {"for": _FOR},
    "saturate": {"gauge": _whole(0, 5, needed=True), "for": _FOR},
    "status": {"bits": _whole(0, 0xFFFF, needed=True), "for": _FOR},
    "jump": {"counts": _whole(-(2**31), 2**31 - 1, needed=True)},
    "stuck": {"what": _one_of("encoder", "sensor", "gauge", needed=True)}
    | {"gauge": _whole(0, 5, default=0), "every": _whole(2, 1000), "for": _FOR},
    "cut": {"device": _one_of("bus", "sensor", default="bus")},
    "restart": {"device": _DEVICE},
    "power_cycle": {"device": _DEVICE},
    "lag": {"ms": _positive(needed=True), "for": _FOR},
    "no_pre_operational": {"for": _FOR},
    "no_bit_12": {"for": _FOR},
    "no_watch": {"for": _FOR},
    "object": {
        "index": _whole(0x1000, 0xFFFF, needed=True),
        "sub": _whole(0, 255, default=0),
        "value": _whole(0, 0xFFFF_FFFF),
    },
    "obstacle": {"x": _FOUND, "angle": _FOUND, "stiffness": _TEXT, "damping": _TEXT}
    | {"side": _TEXT, "rate": _TEXT, "for": _FOR},
    "knock": {"x": _FOUND, "force": _FOUND, "duration": _FOUND},
}
_MOMENTARY = ("emcy", "jump", "restart", "power_cycle", "object", "knock")
LASTING = tuple(kind for kind in KINDS if kind not in _MOMENTARY)
"""Kinds that last until they end by themselves or are ended."""
DISTURBANCES = ("obstacle", "knock")
"""Kinds that disturb the beam; their keys are those of `rigd.devices.obstacles.parse_obstacle`."""
KINDS["end"] = {"fault": _one_of(*LASTING)}


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault, as an operator asks for it."""

    kind: str
    values: Mapping[str, Value]
    """Values by key; a key that was left out and has no default is missing."""
    after_s: float | None = None
    """Time after the drive was first enabled; None: at once."""

    @property
    def is_persistent(self) -> bool:
        """Whether it lasts until it is ended, neither by a time nor by a number of frames."""
        return self.kind in LASTING and self.kind not in LINE_KINDS and "for" not in self.values

    def __str__(self) -> str:
        """Return the fault as it is written; `parse_fault` reads it back."""
        words = [self.kind]
        words += [f"{key}={_text(key, value)}" for key, value in self.values.items()]
        return ",".join(words) + ("" if self.after_s is None else f"@{self.after_s!r}")


def parse_fault(spec: str) -> Fault:
    """Read a fault.

    Raises
    ------
    FaultError
        If a word is wrong; the message states what is allowed.

    Examples
    --------
    >>> from rigd.sim.wire import parse_fault
    >>> parse_fault("drop,from=drive,frames=3@10").kind
    'drop'
    """
    body, at, time = spec.partition("@")
    kind, *words = (word.strip() for word in body.split(","))
    if kind not in KINDS:
        raise FaultError(_complaint(spec, f"unknown fault '{kind}'; choose {', '.join(KINDS)}"))
    keys = KINDS[kind]
    values: dict[str, Value] = {}
    for word in words:
        key, _, text = word.partition("=")
        if key not in keys:
            raise FaultError(_complaint(spec, f"{kind} has no '{key}'; choose {', '.join(keys)}"))
        if key in values:
            raise FaultError(_complaint(spec, f"'{key}' is given twice"))
        try:
            values[key] = keys[key].read(text)
        except ValueError:
            raise FaultError(_complaint(spec, f"{key}={text}: give {keys[key].says}")) from None
    if "bytes" in values and "frames" in values:
        raise FaultError(_complaint(spec, "give frames or bytes, not both"))
    for name, key_of in keys.items():
        if key_of.needed and name not in values:
            raise FaultError(_complaint(spec, f"{kind} needs {name}: {key_of.says}"))
        if key_of.default is not None and not (name == "frames" and "bytes" in values):
            values.setdefault(name, key_of.default)
    fault = Fault(kind, values, _time(spec, time) if at else None)
    if kind in DISTURBANCES:
        try:
            disturbance_of(fault, 0.0)
        except ObstacleError as error:
            raise FaultError(_complaint(spec, str(error).partition(": ")[2].rstrip("."))) from None
    return fault


def disturbance_of(fault: Fault, now_s: float) -> Disturbance:
    """Return the obstacle or knock that a fault puts in the beam's way from now on.

    Parameters
    ----------
    fault
        One of the `DISTURBANCES`.
    now_s
        Time since the drive was first enabled.
    """
    words = [f"{key}={value}" for key, value in fault.values.items() if key != "for"]
    if fault.kind == "knock":
        words.append(f"at={now_s!r}")
    else:
        words.append(f"from={now_s!r}")
        if "for" in fault.values:
            words.append(f"until={now_s + float(fault.values['for'])!r}")
    return parse_obstacle(",".join(words))


def _time(spec: str, text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds <= _LONGEST_S:
        raise FaultError(
            _complaint(spec, f"'@{text}': give the seconds after enabling, 0 to {_LONGEST_S:g}")
        )
    return seconds


def _text(key: str, value: Value) -> str:
    return f"{value:#x}" if key in ("id", "code", "bits") else f"{value}"


def _complaint(spec: str, what: str) -> str:
    return f"Fault '{spec}': {what}."


# Faults on a line


class _Active:
    """A fault of a line, and how much of it is still to come."""

    def __init__(self, fault: Fault) -> None:
        values = fault.values
        self.kind = fault.kind
        self.can_id = values.get("id")
        self.in_bytes = "bytes" in values
        self.left = int(values["bytes"] if self.in_bytes else values["frames"])
        self.delay_s = float(values.get("ms", 0)) * 1e-3
        self.byte = int(values.get("byte", 0))

    def fits(self, can_id: int, data: bytes) -> bool:
        """Whether it acts on this."""
        if self.can_id is not None and self.can_id != can_id:
            return False
        return self.kind != "corrupt" or self.byte < len(data)


class FaultyLine:
    """Line from one sender to all others, with the faults on it.

    Parameters
    ----------
    sender
        Sender of the frames, for the log.
    deliver
        Receives the frames that pass.
    postpone
        Calls something after so many seconds.
    log
        Called for each frame that a fault hits.
    """

    def __init__(
        self,
        sender: str,
        deliver: Deliver,
        postpone: Callable[[float, Callable[[], None]], None],
        log: Callable[..., None],
    ) -> None:
        self._sender = sender
        self._deliver = deliver
        self._postpone = postpone
        self._log = log
        self._active: list[_Active] = []
        self._held: list[tuple[int, bytes, object]] = []

    @property
    def disturbed(self) -> bool:
        """Whether a fault may act on what comes next."""
        return bool(self._active or self._held)

    def add(self, fault: Fault) -> None:
        """Let a fault act from now on."""
        self._active.append(_Active(fault))

    def end(self, kind: str | None) -> list[str]:
        """End the faults of a kind, or all; return the kinds of those that were active."""
        over = [fault for fault in self._active if kind in (None, fault.kind)]
        self._active = [fault for fault in self._active if fault not in over]
        return [fault.kind for fault in over]

    def send(self, can_id: int, data: bytes, origin: object = None) -> None:
        """Send a frame, or a record of a serial line, over this line."""
        if not self._active and not self._held:
            self._deliver(can_id, data, origin)
            return
        waiting, self._held = self._held, []
        fault = next((fault for fault in self._active if fault.fits(can_id, data)), None)
        if waiting and fault is not None and fault.kind == "reorder":
            fault = None  # this is the frame that the held one waits for
        if fault is None:
            self._deliver(can_id, data, origin)
        else:
            self._disturb(fault, can_id, data, origin)
        # A held frame goes after the next one, whatever becomes of that.
        for held in waiting:
            self._deliver(*held)

    def _disturb(self, fault: _Active, can_id: int, data: bytes, origin: object) -> None:
        hit = min(fault.left, len(data)) if fault.in_bytes else 1
        fault.left -= hit
        if fault.left == 0:
            self._active.remove(fault)
        where = {} if can_id == SERIAL else {"can_id": can_id}
        self._log("simulator", fault.kind, sender=self._sender, data=data.hex(), **where)
        if fault.kind == "delay":
            self._postpone(fault.delay_s, lambda: self._deliver(can_id, data, origin))
        elif fault.kind == "corrupt":
            wrong = data[fault.byte] ^ 0xFF
            data = data[: fault.byte] + bytes([wrong]) + data[fault.byte + 1 :]
            self._deliver(can_id, data, origin)
        elif fault.kind == "reorder":
            self._held.append((can_id, data, origin))
        elif fault.in_bytes and hit < len(data):
            self._deliver(can_id, data[hit:], origin)


# Log of events

_FLUSH_S = 0.2
_SILENT = ("torque", "sdo write", *LINE_KINDS)
"""Events too frequent to be shown on the terminal."""


class EventLog:
    """Writes down each event with the simulated time, in seconds since the start.

    Parameters
    ----------
    path
        Path of the new file of JSON lines; None for none.
    quiet
        Whether nothing is shown on the terminal.

    Attributes
    ----------
    time_s : float
        Simulated time; `BusSimulation` sets it.

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
            self.print_line(f"{self.time_s:10.3f} s  {device}: {what}  {details}".rstrip())

    def print_line(self, line: str) -> None:
        """Print a line for the operator; ignore a closed terminal."""
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
            self.print_line(f"The log cannot be written any more ({error.strerror}).")


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
