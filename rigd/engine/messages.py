"""Messages between the processes of a rig, and their encoding.

The supervisor sends jobs and orders, the other processes answer (`rigd.engine.workers` names the
messages that each sends):

============  =============================================
process       receives
============  =============================================
control       ControlJob, then SessionJob, TareOrder, ZeroOrder, ProbeOrder
recorder      RecorderJob, FileHeader, CloseFile
live          LiveJob, LiveSession, LiveSessionEnded of `rigd.live`
touch         TouchJob
fit           FitJob, FileHeader, RecordEnded
page          the data that it shows, as a JSON document
prediction    a job of `rigd.daemon.background` (also: plan)
============  =============================================

A message is one of these objects, pickled, after its length in bytes. In a session each message is
short enough for a pipe's buffer, so that no child ever waits for its supervisor.
`multiprocessing.connection` is not used: after a hung child has written half a message, it would
wait for the rest.
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
    from rigd.touch import DetectorModel, DetectorSettings, TouchModel

_LENGTH_HEADER: Final = struct.Struct("=I")
"""Binary format of the length in bytes that precedes each message."""
_MAX_MESSAGE_BYTES: Final = 1 << 28
"""Largest length of a message in bytes. A larger length means that the pipe contains something
else, such as text."""


# Control


@dataclass(frozen=True, slots=True)
class ControlJob:
    """First message to the control process: the profile of the rig to connect and control."""

    profile: "Profile"
    """Profile whose devices are connected."""
    announced_target: "ActuationTarget | None"
    """Target of the motion that was announced to the operator; any other is refused. None: not
    announced."""
    channels: "ChannelSpecs"
    """Shared memory of the rig's processes."""
    fast: bool
    """Whether sessions run with the virtual clock, faster than real time."""


@dataclass(frozen=True, slots=True)
class PostRecordPlan:
    """Plan of the steps after a session's record: how to damp the beam and return the motor."""

    stays: bool = False
    """Whether the motor stays at the end of the reference instead of returning to its start."""
    poles_rad_s: tuple[complex, ...] = ()
    """Poles in rad/s of the modes that the return must not excite; empty if they are unknown."""
    damper: "DamperSettings | None" = None
    """Active damping of the remaining vibration; None: no active damping."""


@dataclass(frozen=True, slots=True)
class TouchOrder:
    """Settings of a session that moves the beam until it touches an obstacle."""

    beam: "DetectorModel"
    """Model of the beam for the touch detector."""
    settings: "DetectorSettings"
    """Sensitivity of the touch detector."""
    approach: "Approach"
    """Passes of the search, and the reaction to a touch."""
    shear_projection: tuple[float, ...] | None
    """Projection in shear force = projection · wrench; None: the shear force is not measured."""


@dataclass(frozen=True, slots=True)
class SessionJob:
    """Order of the supervisor to run a session."""

    profile: "Profile"
    """Profile of the rig, possibly with another controller and other limits."""
    reference: "ReferenceSpec"
    """Reference angles in shared memory, relative to the angle at the start."""
    refused_settings: Mapping[str, str] = field(default_factory=dict)
    """Real-time setting of supervisor or recorder → reason why the system refused it."""
    ending: PostRecordPlan = field(default_factory=PostRecordPlan)
    """Steps after the record."""
    touch: TouchOrder | None = None
    """Search for an obstacle; None: no search."""
    seed: int | None = None
    """Seed of a simulated rig's noise; None: the rig chooses a seed."""
    accepted_check_texts: tuple[str, ...] = ()
    """Texts for the log, one for each failed row of `rigd check` that the operator accepted."""


@dataclass(frozen=True, slots=True)
class TareOrder:
    """Order to measure the sensor's zero by averaging at rest."""


@dataclass(frozen=True, slots=True)
class ZeroOrder:
    """Order to set the rig's zero to the present angle."""


@dataclass(frozen=True, slots=True)
class ProbeOrder:
    """Order to run the probing move, with the data of a profile."""

    profile: "Profile"
    """Profile of the rig, possibly with another beam."""


@dataclass(frozen=True, slots=True)
class DevicesConnected:
    """Message that the devices are connected and the torque is off."""

    calibration: Mapping[str, Any]
    """Identity and calibration as read from the sensor, for the file."""
    drive: Mapping[str, str]
    """Identity and settings that the drive reports, for the file."""
    realtime: Mapping[str, str]
    """Real-time settings that were granted, for the file."""
    simulated: bool
    """Whether the devices are simulated, so that no motor moves."""


@dataclass(frozen=True, slots=True)
class ReadyToRecord:
    """Message that the motor is held at its angle and the record may begin."""

    tare: Mapping[str, str]
    """Metadata of the tare, and the seed of a simulated rig's noise."""


@dataclass(frozen=True, slots=True)
class SessionFinished:
    """Message that a session has ended and the drive was commanded off."""

    outcome: str
    """Outcome of the record: ``complete``, ``stopped`` or ``fault``."""
    reason: str
    """Reason for an early end, or failure after the record; empty if neither."""
    fault: bool
    """Whether anything failed during or after the record."""
    counts: Mapping[str, int]
    """Numbers of scheduled, missed, late and lost ticks, and of ticks with stale readings."""
    results: Mapping[str, str] = field(default_factory=dict)
    """Results for the metadata ``outcome`` of the file, in addition to the counts."""
    device_failed: bool = False
    """Whether a device failed, so that the control process closes the devices and ends."""


@dataclass(frozen=True, slots=True)
class MeasurementResult:
    """Message with the result of a tare, a new zero or a probing move between sessions."""

    values: dict[str, Any]
    """Results by name: the dictionary that `Rig.tare`, `Rig.zero` or `Rig.probe` returns."""


@dataclass(frozen=True, slots=True)
class MeasurementRefused:
    """Message that a tare, a new zero or a probing move failed, with the reason."""

    reason: str
    """Reason, such as a moving motor, as a sentence for the operator."""


@dataclass(frozen=True, slots=True)
class ControlEnded:
    """Last message of the control process: the devices are closed."""

    reason: str
    """Description of the failure; empty if the end was requested."""


# Recorder


@dataclass(frozen=True, slots=True)
class RecorderJob:
    """First message to the recorder process: the path of the session file to write."""

    path: Path
    """Path of the session file; an existing file is not overwritten."""
    channels: "ChannelSpecs"
    """Shared memory of the rig's processes."""
    realtime: "RealtimeSettings | None" = None
    """Real-time scheduling that the recorder may request; None: the session is not in real time."""


@dataclass(frozen=True, slots=True)
class FileHeader:
    """Contents of the session file that precede its first sample."""

    metadata: Mapping[str, str]
    """Record ``session`` of docs/session_format.md."""
    segments: Mapping[str, tuple[int, int]]
    """Segment name → first tick and end tick (exclusive)."""
    attachments: Mapping[str, str]
    """Name of an attached file → its text."""


@dataclass(frozen=True, slots=True)
class CloseFile:
    """Order to the recorder to write the outcome and close the session file."""

    outcome: Mapping[str, str]
    """Record ``outcome`` of docs/session_format.md. The recorder replaces the counts of samples."""
    touches: bytes = b""
    """Estimated touches in the binary format of the session file."""
    segments: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """Name of a segment unknown before the record → first tick and end tick (exclusive)."""


@dataclass(frozen=True, slots=True)
class FileOpened:
    """Message of the recorder that it has created the session file."""

    realtime: Mapping[str, str]
    """Real-time scheduling that the system granted to the recorder."""


@dataclass(frozen=True, slots=True)
class RecorderReady:
    """Message that the recorder is ready, so the record may begin."""


@dataclass(frozen=True, slots=True)
class FileClosed:
    """Message of the recorder that it has completed and closed the session file."""

    path: Path | None = None
    """Path of the file; None: no record had begun, and there is no file."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Counts of scheduled, recorded and lost ticks."""
    outcome: str = ""
    """``complete``, ``stopped`` or ``fault``, as in the file; empty without a file."""
    reason: str = ""
    """Reason for an early end of the record, as in the file."""


@dataclass(frozen=True, slots=True)
class ProcessFailed:
    """Message that a recorder, live publisher, fit process or page has failed and ends."""

    reason: str
    """Description of the failure, for the operator."""
    is_name_taken: bool = False
    """Whether the process failed because a file with the session's name exists already."""
    saved_path: Path | None = None
    """Path of the saved record, if it is not in the expected file."""


# Touch


@dataclass(frozen=True, slots=True)
class TouchJob:
    """First message to the touch process, which estimates the touches of a session."""

    channels: "ChannelSpecs"
    """Shared memory of the rig's processes."""
    first_index: int
    """Index in the ring of the first sample of the session."""
    rate_hz: float
    """Ticks a second."""
    model: "TouchModel"
    """Model of the beam."""
    shear_projection: tuple[float, ...] | None
    """Projection in shear force = projection · wrench; None: the shear force is not measured."""
    realtime: "RealtimeSettings | None" = None
    """Real-time settings, with the loop's core that the touch process must avoid; None: the session
    is not in real time."""


@dataclass(frozen=True, slots=True)
class TouchReady:
    """Message that the touch process is ready to estimate touches."""


@dataclass(frozen=True, slots=True)
class TouchReport:
    """Message of the touch process with the estimated position and force of a touch."""

    number: int
    """Number of the touch in its session, from 1 on."""
    tick: int
    """Tick at which the touch was detected."""
    final: bool
    """Whether this is the last estimate of the touch."""
    document: Mapping[str, Any]
    """Contact point, instant, force, stiffness and kind of the touch, as in JSON documents."""


# Fit


@dataclass(frozen=True, slots=True)
class FitJob:
    """Job of the fit process: fit the beam model to a session's record while it is recorded."""

    channels: "ChannelSpecs"
    """Shared memory of the rig's processes."""
    first_index: int
    """Index in the ring of the first sample of the session."""
    profile: "Profile"
    """Profile of the rig."""
    reference: "ReferenceSpec"
    """Reference of the session."""
    search: "PrecisionSearch | None" = None
    """Target precision, for which segments are planned; None: the reference is fixed."""
    realtime: "RealtimeSettings | None" = None
    """Real-time settings, with the loop's core that the fit process must avoid; None: the session
    is not in real time."""


@dataclass(frozen=True, slots=True)
class RecordEnded:
    """Message to the fit process that the record has ended, so that it fits the whole record."""

    ticks: int
    """Number of ticks that were scheduled in the record."""


@dataclass(frozen=True, slots=True)
class FitReady:
    """Message that the fit process is ready to fit the record."""


@dataclass(frozen=True, slots=True)
class FitReport:
    """Message with the model that the fit process has estimated from the record so far."""

    document: Mapping[str, Any]
    """Estimated modes and parameters with their intervals, as in JSON documents."""
    final: bool = False
    """Whether this is the last estimate, which uses the whole record."""


@dataclass(frozen=True, slots=True)
class PlannedSegment:
    """Message that a segment of excitation was appended to the reference."""

    name: str
    """Name of the segment for the operator."""
    document: Mapping[str, Any]
    """Present standard deviations, and those expected after the segment, as in JSON documents."""


@dataclass(frozen=True, slots=True)
class SearchEnded:
    """Message that no further segment is planned, so that the record ends with the last one."""

    reached: bool
    """Whether the target precision is reached."""
    reason: str
    """Reason for the end, a sentence for the operator."""
    segments: Mapping[str, tuple[int, int]]
    """Name of the scan or of a segment → first tick and end tick (exclusive)."""


# Daemon


@dataclass(frozen=True, slots=True)
class OperatorPageServed:
    """Message that the operator's page is served."""

    port: int
    """Port on the loopback interface."""


@dataclass(frozen=True, slots=True)
class JobPerformed:
    """Message with the result of a prediction, a check or a plan."""

    result: Any
    """Result of the job, or the error with which its request is refused."""


# Encoding


def encode(message: object) -> bytes:
    """Return a message as bytes for a pipe: its length and the pickled object."""
    pickled_message = pickle.dumps(message)
    return _LENGTH_HEADER.pack(len(pickled_message)) + pickled_message


class MessageReader:
    """Reader of messages from a pipe, which waits no longer than a given timeout.

    Parameters
    ----------
    fd
        Descriptor to read from.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._pending = bytearray()

    def next_message(self, timeout_s: float | None) -> object | None:
        """Return the next message, or None if no complete message arrives in time.

        Parameters
        ----------
        timeout_s
            Longest time to wait in s; None: wait forever.

        Raises
        ------
        EOFError
            If the other end is closed and no complete message remains.
        ValueError
            If the data are not a message.
        """
        while (message := self._take_complete_message()) is None:
            if not is_ready(self._fd, select.POLLIN, timeout_s):
                return None
            received_bytes = os.read(self._fd, 65_536)
            if not received_bytes:
                raise EOFError
            self._pending += received_bytes
        return message

    def _take_complete_message(self) -> object | None:
        """Remove the first complete message from the received data and return it, or None."""
        if len(self._pending) < _LENGTH_HEADER.size:
            return None
        (message_bytes,) = _LENGTH_HEADER.unpack_from(self._pending)
        if message_bytes > _MAX_MESSAGE_BYTES:
            raise ValueError(f"no message, but {bytes(self._pending[:80])!r}")
        message_end = _LENGTH_HEADER.size + message_bytes
        if len(self._pending) < message_end:
            return None
        message: object = pickle.loads(self._pending[_LENGTH_HEADER.size : message_end])
        del self._pending[:message_end]
        return message


def is_ready(fd: int, poll_event: int, timeout_s: float | None) -> bool:
    """Wait until a descriptor can be read or written without blocking; return False on a timeout.

    Parameters
    ----------
    fd
        File descriptor. Unlike `select`, `poll` accepts numbers beyond 1023.
    poll_event
        ``select.POLLIN`` to read or ``select.POLLOUT`` to write.
    timeout_s
        Longest time to wait in s; None: wait forever.
    """
    poller = select.poll()
    poller.register(fd, poll_event)
    return bool(poller.poll(None if timeout_s is None else 1000 * max(timeout_s, 0.0)))
