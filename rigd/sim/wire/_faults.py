"""Faults to inject: their syntax, their effect on frames, and the log of events.

A fault is written as ``KIND[,key=value…][@SECONDS]``. With ``@`` it begins this time after the
drive was first enabled, otherwise at once. Times are simulated time. At most one fault acts on a
frame: the oldest that matches.
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
    """Error: a request cannot be fulfilled; the message states the reason for the operator."""


# Specification of a fault

FaultValue = int | float | str
"""Value of a fault's key."""
DeliverFrame = Callable[[int, bytes, object], None]
"""Function that delivers a frame: identifier, data and sending host."""

SERIAL_PSEUDO_ID = -1
"""Pseudo-identifier of data on a serial line."""


class FaultError(WrongUseError):
    """Error: a fault is written wrongly or not possible on this rig; the message states why."""


@dataclass(frozen=True, slots=True)
class _FaultKey:
    """Key of a fault: its parser, its allowed values and its default."""

    parse_value: Callable[[str], FaultValue]
    """Function that parses the value, or raises ValueError."""
    allowed_text: str
    """Description of the allowed values, for error messages."""
    default: FaultValue | None = None
    """Value if the key is omitted; None: the key is then absent."""
    is_required: bool = False
    """Whether the key must be given."""


def _integer_key(low: int, high: int, **key_options: Any) -> _FaultKey:  # noqa: ANN401 - passed on
    """Return a key whose value is an integer from `low` to `high`."""

    def parse_value(value_text: str) -> int:
        parsed_number = int(value_text, 0)
        if not low <= parsed_number <= high:
            raise ValueError(value_text)
        return parsed_number

    return _FaultKey(parse_value, f"a whole number from {low} to {high}", **key_options)


def _positive_number_key(**key_options: Any) -> _FaultKey:  # noqa: ANN401 - passed on
    """Return a key whose value is a number above 0."""

    def parse_value(value_text: str) -> float:
        parsed_number = float(value_text)
        if not 0 < parsed_number <= _MAX_FAULT_TIME_S:
            raise ValueError(value_text)
        return parsed_number

    return _FaultKey(parse_value, f"a number above 0, up to {_MAX_FAULT_TIME_S:g}", **key_options)


def _choice_key(*allowed_words: str, **key_options: Any) -> _FaultKey:  # noqa: ANN401 - passed on
    """Return a key whose value is one of several words."""

    def parse_value(value_text: str) -> str:
        if value_text not in allowed_words:
            raise ValueError(value_text)
        return value_text

    return _FaultKey(parse_value, " or ".join(allowed_words), **key_options)


_MAX_FAULT_TIME_S = 1e6
"""Largest time in seconds in a fault."""
_MAX_AFFECTED_COUNT = 1_000_000_000
"""Largest number of frames or bytes on which a fault acts."""
_LINE_KEYS = {
    "from": _choice_key("drive", "sensor", "host", is_required=True),
    "id": _integer_key(0, 0x7FF),
    "frames": _integer_key(1, _MAX_AFFECTED_COUNT, default=1),
}
"""Keys of the faults on a line: sender, CAN identifier, number of frames."""
_DEVICE_KEY = _choice_key("drive", "sensor", is_required=True)
"""Key for the device on which a fault acts."""
_DURATION_KEY = _positive_number_key()
"""Key for the duration of a fault in seconds."""

_OPTIONAL_TEXT_KEY = _FaultKey(str, "a value")
"""Optional key whose value `parse_obstacle` checks."""
_REQUIRED_TEXT_KEY = _FaultKey(str, "a value", is_required=True)
"""Required key whose value `parse_obstacle` checks."""

LINE_FAULT_KINDS = ("drop", "delay", "corrupt", "reorder")
"""Kinds of faults on the line of one sender."""
KEYS_BY_FAULT_KIND: dict[str, dict[str, _FaultKey]] = {
    "drop": _LINE_KEYS | {"bytes": _integer_key(1, _MAX_AFFECTED_COUNT)},
    "delay": _LINE_KEYS | {"ms": _positive_number_key(is_required=True)},
    "corrupt": _LINE_KEYS | {"byte": _integer_key(0, 255, default=0)},
    "reorder": _LINE_KEYS,
    "freeze": {"device": _DEVICE_KEY, "for": _DURATION_KEY},
    "emcy": {
        "code": _integer_key(0, 0xFFFF, is_required=True),
        "register": _integer_key(0, 0xFF, default=1),
    },
    "sto": {"for": _DURATION_KEY},
    "busoff": {"for": _DURATION_KEY},
    "saturate": {"gauge": _integer_key(0, 5, is_required=True), "for": _DURATION_KEY},
    "status": {"bits": _integer_key(0, 0xFFFF, is_required=True), "for": _DURATION_KEY},
    "jump": {"counts": _integer_key(-(2**31), 2**31 - 1, is_required=True)},
    "stuck": {"what": _choice_key("encoder", "sensor", "gauge", is_required=True)}
    | {
        "gauge": _integer_key(0, 5, default=0),
        "every": _integer_key(2, 1000),
        "for": _DURATION_KEY,
    },
    "cut": {"device": _choice_key("bus", "sensor", default="bus")},
    "restart": {"device": _DEVICE_KEY},
    "power_cycle": {"device": _DEVICE_KEY},
    "lag": {"ms": _positive_number_key(is_required=True), "for": _DURATION_KEY},
    "no_pre_operational": {"for": _DURATION_KEY},
    "no_bit_12": {"for": _DURATION_KEY},
    "no_watch": {"for": _DURATION_KEY},
    "object": {
        "index": _integer_key(0x1000, 0xFFFF, is_required=True),
        "sub": _integer_key(0, 255, default=0),
        "value": _integer_key(0, 0xFFFF_FFFF),
    },
    "obstacle": {
        "x": _REQUIRED_TEXT_KEY,
        "angle": _REQUIRED_TEXT_KEY,
        "stiffness": _OPTIONAL_TEXT_KEY,
        "damping": _OPTIONAL_TEXT_KEY,
    }
    | {"side": _OPTIONAL_TEXT_KEY, "rate": _OPTIONAL_TEXT_KEY, "for": _DURATION_KEY},
    "knock": {"x": _REQUIRED_TEXT_KEY, "force": _REQUIRED_TEXT_KEY, "duration": _REQUIRED_TEXT_KEY},
}
"""Keys of each kind of fault."""
_MOMENTARY_FAULT_KINDS = ("emcy", "jump", "restart", "power_cycle", "object", "knock")
"""Kinds of faults without duration."""
LASTING_FAULT_KINDS = tuple(
    kind for kind in KEYS_BY_FAULT_KIND if kind not in _MOMENTARY_FAULT_KINDS
)
"""Kinds of faults that last until they expire or are ended."""
DISTURBANCE_FAULT_KINDS = ("obstacle", "knock")
"""Kinds of faults that disturb the beam, with the keys of
`rigd.devices.obstacles.parse_obstacle`."""
KEYS_BY_FAULT_KIND["end"] = {"fault": _choice_key(*LASTING_FAULT_KINDS)}


@dataclass(frozen=True, slots=True)
class Fault:
    """Fault to inject, as requested by the operator."""

    kind: str
    """Kind of the fault, one of :data:`KEYS_BY_FAULT_KIND`."""
    values: Mapping[str, FaultValue]
    """Values by key; an omitted key without default is absent."""
    after_s: float | None = None
    """Time in seconds from the first enabling of the drive to the fault; None: at once."""

    @property
    def is_persistent(self) -> bool:
        """Whether the fault lasts until it is ended, having neither duration nor frame count."""
        return (
            self.kind in LASTING_FAULT_KINDS
            and self.kind not in LINE_FAULT_KINDS
            and "for" not in self.values
        )

    def __str__(self) -> str:
        """Return the text form of the fault, which `parse_fault` reads back."""
        assignments = [self.kind]
        assignments += [
            f"{key}={_format_value(key, key_value)}" for key, key_value in self.values.items()
        ]
        return ",".join(assignments) + ("" if self.after_s is None else f"@{self.after_s!r}")


def parse_fault(spec: str) -> Fault:
    """Parse the text form of a fault.

    Raises
    ------
    FaultError
        If a key or value is wrong; the message states the allowed ones.

    Examples
    --------
    >>> from rigd.sim.wire import parse_fault
    >>> parse_fault("drop,from=drive,frames=3@10").kind
    'drop'
    """
    fault_text, at_sign, time_text = spec.partition("@")
    fault_kind, *assignments = (assignment.strip() for assignment in fault_text.split(","))
    if fault_kind not in KEYS_BY_FAULT_KIND:
        raise FaultError(
            _error_message(
                spec, f"unknown fault '{fault_kind}'; choose {', '.join(KEYS_BY_FAULT_KIND)}"
            )
        )
    allowed_keys = KEYS_BY_FAULT_KIND[fault_kind]
    fault_values: dict[str, FaultValue] = {}
    for assignment in assignments:
        key, _, value_text = assignment.partition("=")
        if key not in allowed_keys:
            raise FaultError(
                _error_message(
                    spec, f"{fault_kind} has no '{key}'; choose {', '.join(allowed_keys)}"
                )
            )
        if key in fault_values:
            raise FaultError(_error_message(spec, f"'{key}' is given twice"))
        try:
            fault_values[key] = allowed_keys[key].parse_value(value_text)
        except ValueError:
            raise FaultError(
                _error_message(spec, f"{key}={value_text}: give {allowed_keys[key].allowed_text}")
            ) from None
    if "bytes" in fault_values and "frames" in fault_values:
        raise FaultError(_error_message(spec, "give frames or bytes, not both"))
    for key_name, fault_key in allowed_keys.items():
        if fault_key.is_required and key_name not in fault_values:
            raise FaultError(
                _error_message(spec, f"{fault_kind} needs {key_name}: {fault_key.allowed_text}")
            )
        if fault_key.default is not None and not (key_name == "frames" and "bytes" in fault_values):
            fault_values.setdefault(key_name, fault_key.default)
    fault = Fault(fault_kind, fault_values, _parse_start_time(spec, time_text) if at_sign else None)
    if fault_kind in DISTURBANCE_FAULT_KINDS:
        try:
            disturbance_of(fault, 0.0)
        except ObstacleError as error:
            raise FaultError(
                _error_message(spec, str(error).partition(": ")[2].rstrip("."))
            ) from None
    return fault


def disturbance_of(fault: Fault, now_s: float) -> Disturbance:
    """Return the obstacle or impact that a fault describes, beginning at `now_s`.

    The fault is of a kind in `DISTURBANCE_FAULT_KINDS`. `now_s` is the time since the drive was
    first enabled.
    """
    assignments = [f"{key}={key_value}" for key, key_value in fault.values.items() if key != "for"]
    if fault.kind == "knock":
        assignments.append(f"at={now_s!r}")
    else:
        assignments.append(f"from={now_s!r}")
        if "for" in fault.values:
            assignments.append(f"until={now_s + float(fault.values['for'])!r}")
    return parse_obstacle(",".join(assignments))


def _parse_start_time(fault_spec: str, time_text: str) -> float:
    """Parse the time after ``@`` in a fault, in seconds."""
    try:
        start_s = float(time_text)
    except ValueError:
        start_s = -1.0
    if not 0 <= start_s <= _MAX_FAULT_TIME_S:
        raise FaultError(
            _error_message(
                fault_spec,
                f"'@{time_text}': give the seconds after enabling, 0 to {_MAX_FAULT_TIME_S:g}",
            )
        )
    return start_s


def _format_value(key: str, value: FaultValue) -> str:
    """Format the value of a fault's key."""
    return f"{value:#x}" if key in ("id", "code", "bits") else f"{value}"


def _error_message(fault_spec: str, reason: str) -> str:
    """Return the message for a text that describes no valid fault: the text and the reason."""
    return f"Fault '{fault_spec}': {reason}."


# Faults on a line


class _ActiveFault:
    """Active fault on a line, with the number of frames or bytes on which it still acts."""

    def __init__(self, fault: Fault) -> None:
        fault_values = fault.values
        self.kind = fault.kind
        self.can_id = fault_values.get("id")
        self.counts_bytes = "bytes" in fault_values
        self.remaining_count = int(
            fault_values["bytes"] if self.counts_bytes else fault_values["frames"]
        )
        self.delay_s = float(fault_values.get("ms", 0)) * 1e-3
        self.byte_index = int(fault_values.get("byte", 0))

    def matches(self, can_id: int, data: bytes) -> bool:
        """Return whether the fault acts on a frame with this identifier and data."""
        if self.can_id is not None and self.can_id != can_id:
            return False
        return self.kind != "corrupt" or self.byte_index < len(data)


class FaultyLine:
    """Line from one sender to all receivers, on which faults act.

    The sender's name is for the log. `postpone_call` calls a function after a delay in seconds.
    `log` logs each frame on which a fault acts.
    """

    def __init__(
        self,
        sender: str,
        deliver_frame: DeliverFrame,
        postpone_call: Callable[[float, Callable[[], None]], None],
        log: Callable[..., None],
    ) -> None:
        self._sender = sender
        self._deliver = deliver_frame
        self._postpone = postpone_call
        self._log = log
        self._active_faults: list[_ActiveFault] = []
        self._held_frames: list[tuple[int, bytes, object]] = []

    @property
    def is_disturbed(self) -> bool:
        """Whether a fault may act on the next frame."""
        return bool(self._active_faults or self._held_frames)

    def add_fault(self, fault: Fault) -> None:
        """Let a fault act on this line from now on."""
        self._active_faults.append(_ActiveFault(fault))

    def end_faults(self, fault_kind: str | None) -> list[str]:
        """End the line's faults of a kind (None: of all kinds); return the ended faults' kinds."""
        ended_faults = [fault for fault in self._active_faults if fault_kind in (None, fault.kind)]
        self._active_faults = [fault for fault in self._active_faults if fault not in ended_faults]
        return [fault.kind for fault in ended_faults]

    def send(self, can_id: int, data: bytes, sending_host: object = None) -> None:
        """Send a frame, or a record of a serial line, over this line."""
        if not self._active_faults and not self._held_frames:
            self._deliver(can_id, data, sending_host)
            return
        held_frames, self._held_frames = self._held_frames, []
        acting_fault = next(
            (
                acting_fault
                for acting_fault in self._active_faults
                if acting_fault.matches(can_id, data)
            ),
            None,
        )
        if held_frames and acting_fault is not None and acting_fault.kind == "reorder":
            acting_fault = None  # this is the frame for which the held frame waits
        if acting_fault is None:
            self._deliver(can_id, data, sending_host)
        else:
            self._disturb(acting_fault, can_id, data, sending_host)
        # A held frame follows the next frame, whatever happens to that frame.
        for held_frame in held_frames:
            self._deliver(*held_frame)

    def _disturb(self, fault: _ActiveFault, can_id: int, data: bytes, sending_host: object) -> None:
        """Apply a fault to a frame: drop, delay, corrupt or hold it, and log it."""
        affected_count = min(fault.remaining_count, len(data)) if fault.counts_bytes else 1
        fault.remaining_count -= affected_count
        if fault.remaining_count == 0:
            self._active_faults.remove(fault)
        logged_identifier = {} if can_id == SERIAL_PSEUDO_ID else {"can_id": can_id}
        self._log(
            "simulator", fault.kind, sender=self._sender, data=data.hex(), **logged_identifier
        )
        if fault.kind == "delay":
            self._postpone(fault.delay_s, lambda: self._deliver(can_id, data, sending_host))
        elif fault.kind == "corrupt":
            corrupted_byte = data[fault.byte_index] ^ 0xFF
            data = data[: fault.byte_index] + bytes([corrupted_byte]) + data[fault.byte_index + 1 :]
            self._deliver(can_id, data, sending_host)
        elif fault.kind == "reorder":
            self._held_frames.append((can_id, data, sending_host))
        elif fault.counts_bytes and affected_count < len(data):
            self._deliver(can_id, data[affected_count:], sending_host)


# Log of events

_FLUSH_INTERVAL_S = 0.2
"""Time in seconds between two writes of the log to its file."""
_UNSHOWN_EVENTS = ("torque", "sdo write", *LINE_FAULT_KINDS)
"""Events that are too frequent to be shown on the terminal."""


class EventLog:
    """Log of events with simulated time, in a file of JSON lines and on the terminal.

    `path` is a new file; None: no file. With `quiet` nothing is shown on the terminal. The
    constructor raises `WrongUseError` if the file exists, and `DeviceError` if it cannot be
    written.

    Attributes
    ----------
    time_s : float
        Simulated time in seconds, which `BusSimulation` sets.
    """

    def __init__(self, path: Path | None, *, quiet: bool) -> None:
        self._quiet = quiet
        self._path = path
        self._file = None if path is None else _open_new_file(path)
        self._flushed_s = 0.0
        self.time_s = 0.0

    def __call__(self, device: str, event_name: str, **values: object) -> None:
        """Log an event of a device, with values by name."""
        if self._file is not None:
            log_entry = {
                "t_s": round(self.time_s, 9),
                "device": device,
                "what": event_name,
                **values,
            }
            self._run_on_file(lambda file: file.write(json.dumps(log_entry) + "\n"))
        if event_name not in _UNSHOWN_EVENTS:
            # States and faults must be in the file even if the process is killed.
            self._write_out()
            detail_text = "  ".join(f"{key} {event_value}" for key, event_value in values.items())
            self.print_line(
                f"{self.time_s:10.3f} s  {device}: {event_name}  {detail_text}".rstrip()
            )

    def print_line(self, text_line: str) -> None:
        """Print a line for the operator, unless quiet; ignore a closed terminal."""
        if not self._quiet:
            with suppress(OSError, ValueError):
                sys.stdout.write(f"{text_line}\n")
                sys.stdout.flush()

    def flush(self) -> None:
        """Write the logged events to the log file, if the last write was some time ago."""
        if time.monotonic() - self._flushed_s > _FLUSH_INTERVAL_S:
            self._write_out()

    def close(self) -> None:
        """Write the remaining events and close the log file."""
        log_file, self._file = self._file, None
        if log_file is not None:
            with suppress(OSError):
                log_file.close()

    def discard(self) -> None:
        """Close and remove the log file of a simulation that did not start.

        A pipe or device is not removed.
        """
        self.close()
        if self._path is not None and self._path.is_file():
            self._path.unlink()

    def _write_out(self) -> None:
        """Write the logged events to the log file."""
        self._flushed_s = time.monotonic()
        self._run_on_file(lambda file: file.flush())

    def _run_on_file(self, file_action: Callable[[TextIO], object]) -> None:
        """Run an action on the file; if the disk is full, close the log and continue."""
        if self._file is None:
            return
        try:
            file_action(self._file)
        except OSError as error:
            self.close()
            self.print_line(f"The log cannot be written any more ({error.strerror}).")


def _open_new_file(path: Path) -> TextIO:
    """Open a file that does not exist yet, or an existing device or pipe."""
    try:
        try:
            return path.open("x", encoding="utf-8")
        except FileExistsError:
            if path.is_file() or not path.exists():  # a dangling link counts as existing
                raise WrongUseError(
                    f"--log {path} exists; choose another name or move it away, nothing is "
                    "overwritten."
                ) from None
            return path.open("w", encoding="utf-8")
    except OSError as error:
        raise DeviceError(
            f"The log {path} of the simulated rig cannot be written ({error.strerror})."
        ) from None
