"""Messages between the processes of a rig, and their encoding.

The supervisor sends jobs and orders, the others answer:

============  =============================================  ================================
process       receives                                       sends
============  =============================================  ================================
control       ControlJob, then SessionJob, Tare, Zero, Probe Connected, then Ready, Finished;
                                                             Measured or Refused; last Ended
recorder      RecorderJob, FileHeader, Close                 Opened, Armed, Closed; or Failed
live          LiveJob, LiveSession, LiveEnd of `rigd.live`   LiveAddress, LiveShown; or Failed
touch         TouchJob                                       TouchReady, then TouchReport
fit           FitJob, FileHeader, RecordEnded                FitReady, then FitReport,
                                                             PlannedSegment, SearchEnded; or Failed
============  =============================================  ================================

A message is its length followed by one of these objects, pickled. Each is short enough for a pipe's
buffer, so that no child ever waits for its supervisor. `multiprocessing.connection` is not used,
because it would wait for the remainder of a message of which a hung child has written half.
"""

import os
import pickle
import select
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:  # children start before the supervisor has imported any of these
    from rigd.control.damper import DamperSettings
    from rigd.devices import ActuationTarget
    from rigd.engine.channels import ChannelSpecs
    from rigd.engine.reference import ReferenceSpec
    from rigd.excitation import Approach, PrecisionSearch
    from rigd.profile import Profile, RealtimeSettings
    from rigd.touch import DetectorSettings, TouchModel, WatchedBeam

_LENGTH: Final = struct.Struct("=I")
_MOST_BYTES: Final = 1 << 24
"""Limit of a message's length: beyond it, the pipe contains something else, such as text."""


# Control


@dataclass(frozen=True, slots=True)
class ControlJob:
    """The rig to control."""

    profile: "Profile"
    """Profile whose devices are connected."""
    moving: "ActuationTarget | None"
    """The only thing that may move, as stated to the operator; None: nothing was stated."""
    channels: "ChannelSpecs"
    """Shared memory of the rig's processes."""
    fast: bool
    """Whether to run with the virtual clock."""


@dataclass(frozen=True, slots=True)
class Ending:
    """Steps after the record, with the motor still held; planned before the session."""

    stays: bool = False
    """Whether the motor stays at the end of the reference instead of returning to the start."""
    poles_rad_s: tuple[complex, ...] = ()
    """Poles of the modes that the return must not excite; empty if they are unknown."""
    damper: "DamperSettings | None" = None
    """Active damping of the remaining vibration; None: no active damping."""


@dataclass(frozen=True, slots=True)
class TouchOrder:
    """Search for an obstacle in a session."""

    beam: "WatchedBeam"
    """Model of the beam for the detector."""
    settings: "DetectorSettings"
    """Thresholds of the detector."""
    approach: "Approach"
    """Passes of the search, and the reaction to a touch."""
    shear_projection: tuple[float, ...] | None
    """Base shear = projection · wrench; None: it is not measured."""


@dataclass(frozen=True, slots=True)
class SessionJob:
    """A session to run."""

    profile: "Profile"
    """Profile of the rig, possibly with another controller and other limits."""
    reference: "ReferenceSpec"
    """Angles relative to the one at the start."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """Settings that the system refused to supervisor and recorder, with the reasons."""
    ending: Ending = field(default_factory=Ending)
    """Steps after the record."""
    touch: TouchOrder | None = None
    """Search for an obstacle; None: no search."""
    seed: int | None = None
    """Seed of a simulated rig's noise; None: the rig chooses one."""
    accepted: tuple[str, ...] = ()
    """Failed rows of `rigd check` that the operator accepted, each as a text for the log."""


@dataclass(frozen=True, slots=True)
class Tare:
    """Average the sensor at rest."""


@dataclass(frozen=True, slots=True)
class Zero:
    """Make the present angle the zero."""


@dataclass(frozen=True, slots=True)
class Probe:
    """Make the probing move of a profile."""

    profile: "Profile"
    """Profile of the rig, possibly with another beam."""


@dataclass(frozen=True, slots=True)
class Connected:
    """The devices are connected, and the torque is off."""

    calibration: Mapping[str, Any]
    """Identity and calibration as read from the sensor, for the file."""
    drive: Mapping[str, str]
    """Identity and settings that the drive reports, for the file."""
    realtime: Mapping[str, str]
    """Real-time settings that were granted, for the file."""
    simulated: bool
    """Whether the devices are simulated, so that no motor moves."""


@dataclass(frozen=True, slots=True)
class Ready:
    """The motor is held at its angle; the record may begin."""

    tare: Mapping[str, str]
    """Metadata of the tare, and the seed of a simulated rig's noise."""


@dataclass(frozen=True, slots=True)
class Finished:
    """A session has ended, and the torque is off."""

    outcome: str
    """Outcome of the record: ``complete``, ``stopped`` or ``fault``."""
    reason: str
    """Reason for an early end, or failure after the record; empty if neither."""
    fault: bool
    """Whether something failed, in the record or after it."""
    counts: Mapping[str, int]
    """Numbers of ticks: scheduled, missed, late, lost, and those with stale readings."""
    results: Mapping[str, str] = field(default_factory=dict)
    """Results for the record's outcome, in addition to the counts."""
    device_failed: bool = False
    """Whether a device failed, so that the control process closes the devices and ends."""


@dataclass(frozen=True, slots=True)
class Measured:
    """Result of a measurement between sessions."""

    values: dict[str, Any]
    """Results by name, as the methods `tare`, `zero` and `probe` of `rigd.runner.Rig` return."""


@dataclass(frozen=True, slots=True)
class Refused:
    """A measurement was not possible."""

    reason: str
    """Obstacle to the measurement, such as a moving motor; a sentence for the operator."""


@dataclass(frozen=True, slots=True)
class Ended:
    """The devices are closed; the last message."""

    reason: str
    """Failure; empty if the end was requested."""


# Recorder


@dataclass(frozen=True, slots=True)
class RecorderJob:
    """The file to write."""

    path: Path
    """Path of the session file; one that exists is not overwritten."""
    channels: "ChannelSpecs"
    """Shared memory of the rig's processes."""
    realtime: "RealtimeSettings | None" = None
    """Scheduling that it may request; None: none, because the session is not in real time."""


@dataclass(frozen=True, slots=True)
class FileHeader:
    """Contents of the file before its first sample."""

    metadata: Mapping[str, str]
    """Metadata ``session`` of docs/session_format.md."""
    segments: Mapping[str, tuple[int, int]]
    """First tick of each segment, and the tick after its last, by the segment's name."""
    attachments: Mapping[str, str]
    """Texts of the attached files, by file name."""


@dataclass(frozen=True, slots=True)
class Close:
    """Close the file with its outcome."""

    outcome: Mapping[str, str]
    """Metadata ``outcome`` of docs/session_format.md; the recorder recounts the samples."""
    touches: bytes = b""
    """Estimated touches, packed."""
    segments: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """Segments that were not known before the record."""


@dataclass(frozen=True, slots=True)
class Opened:
    """The file exists."""

    realtime: Mapping[str, str]
    """Scheduling that was granted."""


@dataclass(frozen=True, slots=True)
class Armed:
    """The record may begin."""


@dataclass(frozen=True, slots=True)
class Closed:
    """The file is complete."""

    path: Path | None = None
    """Path of the file; None: no record had begun, and there is no file."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Numbers of ticks in the file."""
    outcome: str = ""
    """``complete``, ``stopped`` or ``fault``, as in the file; empty without a file."""
    reason: str = ""
    """Reason as in the file."""


@dataclass(frozen=True, slots=True)
class Failed:
    """A recorder, live publisher or fit process failed, and ends."""

    reason: str
    """Description of the failure, for the operator."""
    taken: bool = False
    """Whether the file exists already and belongs to something else."""
    saved_path: Path | None = None
    """Path of the record, if it was not saved under its own name."""


# Touch


@dataclass(frozen=True, slots=True)
class TouchJob:
    """Estimation of the touches of a session."""

    channels: "ChannelSpecs"
    """Shared memory of the rig's processes."""
    first: int
    """Number of samples in the ring before the session."""
    rate_hz: float
    """Ticks a second."""
    model: "TouchModel"
    """Model of the beam."""
    shear_projection: tuple[float, ...] | None
    """Base shear = projection · wrench; None: it is not measured."""
    realtime: "RealtimeSettings | None" = None
    """Real-time settings, whose loop core it must avoid; None: not in real time."""


@dataclass(frozen=True, slots=True)
class TouchReady:
    """Touches are estimated from now on."""


@dataclass(frozen=True, slots=True)
class TouchReport:
    """Estimate of a touch."""

    number: int
    """Number of the touch in its session, from 1 on."""
    tick: int
    """Tick of its detection."""
    final: bool
    """Whether it is the last estimate of this touch."""
    document: Mapping[str, Any]
    """Point, instant, force, stiffness and kind, as in JSON documents."""


# Fit


@dataclass(frozen=True, slots=True)
class FitJob:
    """Fit of a session's record during the session."""

    channels: "ChannelSpecs"
    """Shared memory of the rig's processes."""
    first: int
    """Number of samples in the ring before the session."""
    profile: "Profile"
    """Profile of the rig."""
    reference: "ReferenceSpec"
    """Reference of the session."""
    search: "PrecisionSearch | None" = None
    """Target precision, for which segments are planned; None: the reference is fixed."""
    realtime: "RealtimeSettings | None" = None
    """Real-time settings, whose loop core it must avoid; None: not in real time."""


@dataclass(frozen=True, slots=True)
class RecordEnded:
    """The record has ended: fit all of it."""

    ticks: int
    """Ticks that were scheduled."""


@dataclass(frozen=True, slots=True)
class FitReady:
    """The record is fitted from now on."""


@dataclass(frozen=True, slots=True)
class FitReport:
    """Estimate from the record so far."""

    document: Mapping[str, Any]
    """Modes and parameters with their intervals, as in JSON documents."""
    final: bool = False
    """Whether it uses the whole record and is the last."""


@dataclass(frozen=True, slots=True)
class PlannedSegment:
    """Segment of excitation that was appended to the reference."""

    name: str
    """Name for the operator."""
    document: Mapping[str, Any]
    """Expected improvement, as in JSON documents."""


@dataclass(frozen=True, slots=True)
class SearchEnded:
    """No further segment follows; the record ends with the present ones."""

    reached: bool
    """Whether the target precision is reached."""
    reason: str
    """Reason for the end, a sentence for the operator."""
    segments: Mapping[str, tuple[int, int]]
    """First tick and end of the scan and of each segment, by name."""


# Encoding


def encode(message: object) -> bytes:
    """Return the bytes of a message."""
    data = pickle.dumps(message)
    return _LENGTH.pack(len(data)) + data


class MessageReader:
    """Reader of messages from a descriptor, which never exceeds the given timeout.

    Parameters
    ----------
    fd
        Descriptor to read from.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._pending = bytearray()

    def next(self, timeout_s: float | None) -> object | None:
        """Return the next message, or None if none is complete in time.

        Parameters
        ----------
        timeout_s
            Longest wait; None: forever.

        Raises
        ------
        EOFError
            If the other end is closed and no complete message remains.
        ValueError
            If the data are not a message.
        """
        while (message := self._whole()) is None:
            if not is_ready(self._fd, select.POLLIN, timeout_s):
                return None
            data = os.read(self._fd, 65_536)
            if not data:
                raise EOFError
            self._pending += data
        return message

    def _whole(self) -> object | None:
        if len(self._pending) < _LENGTH.size:
            return None
        (length,) = _LENGTH.unpack_from(self._pending)
        if length > _MOST_BYTES:
            raise ValueError(f"no message, but {bytes(self._pending[:80])!r}")
        end = _LENGTH.size + length
        if len(self._pending) < end:
            return None
        message: object = pickle.loads(self._pending[_LENGTH.size : end])
        del self._pending[:end]
        return message


def is_ready(fd: int, event: int, timeout_s: float | None) -> bool:
    """Wait until a descriptor can be used, and return whether it can.

    Parameters
    ----------
    fd
        Descriptor; unlike `select`, `poll` takes numbers beyond 1023.
    event
        ``select.POLLIN`` or ``select.POLLOUT``.
    timeout_s
        Longest wait; None: forever.
    """
    waiting = select.poll()
    waiting.register(fd, event)
    return bool(waiting.poll(None if timeout_s is None else 1000 * max(timeout_s, 0.0)))
