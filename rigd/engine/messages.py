"""Messages between the processes of a rig: what each of them says, and how it travels.

The supervisor gives jobs and orders, the others answer:

============  =============================================  ================================
process       is told                                        tells
============  =============================================  ================================
control       ControlJob, then SessionJob, Tare, Zero, Probe Connected, then Ready, Finished;
                                                             Measured or Refused; last Ended
recorder      RecorderJob, FileHeader, Close                 Opened, Armed, Closed; or Failed
live          LiveJob, LiveSession, LiveEnd of `rigd.live`   LiveAddress, LiveShown; or Failed
touch         TouchJob                                       TouchReady, then TouchTold
fit           FitJob, FileHeader, RecordEnded                FitReady, then FitTold, PieceTold,
                                                             SearchEnded; or Failed
============  =============================================  ================================

A message is one of these objects, pickled, behind its length. Each is short enough for a pipe's
buffer, so that no child ever waits for its supervisor. `multiprocessing.connection` would wait for
the rest of a message of which a hung child has written half; nobody here does.
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
    from rigd.devices import WhatMoves
    from rigd.engine.channels import ChannelSpecs
    from rigd.engine.reference import ReferenceSpec
    from rigd.excitation import Approach, PrecisionSearch
    from rigd.profile import Profile, RealtimeSettings
    from rigd.touch import DetectorSettings, TouchModel, WatchedBeam

_LENGTH: Final = struct.Struct("=I")
_MOST_BYTES: Final = 1 << 24
"""No message is longer: something else has been written into the pipe, such as a text."""


# Control


@dataclass(frozen=True, slots=True)
class ControlJob:
    """The rig to attend to."""

    profile: "Profile"
    """Profile whose devices are connected."""
    moving: "WhatMoves | None"
    """What the operator was told would move, and nothing else may; None: nothing was told."""
    channels: "ChannelSpecs"
    """Shared memory of the rig's processes."""
    fast: bool
    """Run under the virtual clock."""


@dataclass(frozen=True, slots=True)
class Ending:
    """What follows the record, while the motor is still held; planned before the session."""

    stays: bool = False
    """The motor stays where the reference ends; else it returns to the start angle."""
    poles_rad_s: tuple[complex, ...] = ()
    """Modes that the return leaves at rest; none: nothing is known of the beam."""
    damper: "DamperSettings | None" = None
    """Active damping of what still vibrates; None: it is left to itself."""


@dataclass(frozen=True, slots=True)
class TouchOrder:
    """The obstacle to look for in a session."""

    beam: "WatchedBeam"
    """What the detector knows of the beam."""
    settings: "DetectorSettings"
    """How sure the detector has to be."""
    approach: "Approach"
    """The passes, and what to do after a touch."""
    shear_projection: tuple[float, ...] | None
    """Base shear = projection · wrench; None: it is not measured."""


@dataclass(frozen=True, slots=True)
class SessionJob:
    """The session to run on it."""

    profile: "Profile"
    """The rig's; its controller and limits may be others."""
    reference: "ReferenceSpec"
    """Angles relative to the one at the start."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """What the system did not grant supervisor and recorder, and why."""
    ending: Ending = field(default_factory=Ending)
    """What follows the record."""
    touch: TouchOrder | None = None
    """What to look for; None: nothing."""
    seed: int | None = None
    """Seed of a simulated rig's noise; None: one of the rig's own."""
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
    """The rig's; its beam may be another."""


@dataclass(frozen=True, slots=True)
class Connected:
    """The devices are connected, and the torque is off."""

    calibration: Mapping[str, Any]
    """Identity and calibration as read from the sensor, for the file."""
    drive: Mapping[str, str]
    """What the drive states of itself, for the file."""
    realtime: Mapping[str, str]
    """The real-time settings that were granted, for the file."""
    simulated: bool
    """The devices are simulated: no motor moves."""


@dataclass(frozen=True, slots=True)
class Ready:
    """The motor is held where it stands; the record may begin."""

    tare: Mapping[str, str]
    """Metadata of the tare, and the seed of a simulated rig's noise."""


@dataclass(frozen=True, slots=True)
class Finished:
    """A session has ended, and the torque is off."""

    outcome: str
    """Outcome of the record: ``complete``, ``stopped`` or ``fault``."""
    reason: str
    """Why the session ended early, or what failed after the record; empty if neither."""
    fault: bool
    """Something failed, in the record or after it."""
    counts: Mapping[str, int]
    """Numbers of ticks: scheduled, missed, late, lost, and those with stale readings."""
    results: Mapping[str, str] = field(default_factory=dict)
    """Results for the record's outcome, in addition to the counts."""
    device_failed: bool = False
    """The control process lets go of all, and ends."""


@dataclass(frozen=True, slots=True)
class Measured:
    """What was measured between sessions."""

    values: dict[str, Any]
    """Results by name, as the methods `tare`, `zero` and `probe` of `rigd.runner.Rig` return."""


@dataclass(frozen=True, slots=True)
class Refused:
    """It could not be measured."""

    reason: str
    """What prevented it, such as a motor that moves; a sentence for the operator."""


@dataclass(frozen=True, slots=True)
class Ended:
    """The devices are closed; the last message."""

    reason: str
    """Empty if it was asked for."""


# Recorder


@dataclass(frozen=True, slots=True)
class RecorderJob:
    """The file to write."""

    path: Path
    """Path of the session file; one that exists is not overwritten."""
    channels: "ChannelSpecs"
    """Shared memory of the rig's processes."""
    realtime: "RealtimeSettings | None" = None
    """What it may ask of the scheduler; None: nothing, for it is not in real time."""


@dataclass(frozen=True, slots=True)
class FileHeader:
    """What stands in the file before its first sample."""

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
    """Touches that were estimated, packed."""
    segments: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    """Segments that were not known before the record."""


@dataclass(frozen=True, slots=True)
class Opened:
    """The file is there."""

    realtime: Mapping[str, str]
    """What the scheduler granted."""


@dataclass(frozen=True, slots=True)
class Armed:
    """The record may begin."""


@dataclass(frozen=True, slots=True)
class Closed:
    """The file is whole."""

    path: Path | None = None
    """None: no record had begun, and there is none."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """What was counted in it."""
    outcome: str = ""
    """``complete``, ``stopped`` or ``fault``, as in the file; empty if there is none."""
    reason: str = ""
    """Reason as in the file."""


@dataclass(frozen=True, slots=True)
class Failed:
    """A recorder or a live publisher cannot do its work, and ends."""

    reason: str
    """What failed, for the operator."""
    taken: bool = False
    """The file is there already, and is somebody else's."""
    kept: Path | None = None
    """Where the record was saved, if not under the file's own name."""


# Touch


@dataclass(frozen=True, slots=True)
class TouchJob:
    """The session whose touches are to be estimated."""

    channels: "ChannelSpecs"
    """Shared memory of the rig's processes."""
    first: int
    """Records in the ring of samples before the session."""
    rate_hz: float
    """Ticks a second."""
    model: "TouchModel"
    """The beam."""
    shear_projection: tuple[float, ...] | None
    """Base shear = projection · wrench; None: it is not measured."""
    realtime: "RealtimeSettings | None" = None
    """Where the loop runs, from whose core it keeps off; None: not in real time."""


@dataclass(frozen=True, slots=True)
class TouchReady:
    """Touches are estimated from now on."""


@dataclass(frozen=True, slots=True)
class TouchTold:
    """Estimate of a touch."""

    number: int
    """Number of the touch in its session, from 1 on."""
    tick: int
    """Tick of its detection."""
    final: bool
    """No better one will come."""
    document: Mapping[str, Any]
    """Point, instant, force, stiffness and kind, as in JSON documents."""


# Fit


@dataclass(frozen=True, slots=True)
class FitJob:
    """The session whose record is fitted while it grows."""

    channels: "ChannelSpecs"
    """Shared memory of the rig's processes."""
    first: int
    """Records in the ring of samples before the session."""
    profile: "Profile"
    """Profile of the rig."""
    reference: "ReferenceSpec"
    """Reference of the session."""
    search: "PrecisionSearch | None" = None
    """What the session goes on for; None: its reference is given, and nothing is planned."""
    realtime: "RealtimeSettings | None" = None
    """Where the loop runs, from whose core it keeps off; None: not in real time."""


@dataclass(frozen=True, slots=True)
class RecordEnded:
    """The record has ended: fit all of it."""

    ticks: int
    """Ticks that were scheduled."""


@dataclass(frozen=True, slots=True)
class FitReady:
    """The record is fitted from now on."""


@dataclass(frozen=True, slots=True)
class FitTold:
    """Estimate from the record so far."""

    document: Mapping[str, Any]
    """Modes and parameters with their intervals, as in JSON documents."""
    final: bool = False
    """It rests on the whole record, and is the last."""


@dataclass(frozen=True, slots=True)
class PieceTold:
    """Piece of excitation that was appended to the reference."""

    name: str
    """What it is, for the operator."""
    document: Mapping[str, Any]
    """What it is expected to bring, as in JSON documents."""


@dataclass(frozen=True, slots=True)
class SearchEnded:
    """No further piece comes; the record ends with those that are there."""

    reached: bool
    """The precision that was asked for is reached."""
    reason: str
    """Why it ended, a sentence for the operator."""
    segments: Mapping[str, tuple[int, int]]
    """First tick and end of the scan and of each piece, by name."""


# On their way


def encode(message: object) -> bytes:
    """Return the bytes of a message."""
    data = pickle.dumps(message)
    return _LENGTH.pack(len(data)) + data


class MessageReader:
    """Messages from a descriptor, without ever waiting longer than asked.

    Parameters
    ----------
    fd
        Descriptor to read from.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._pending = bytearray()

    def next(self, timeout_s: float | None) -> object | None:
        """Return the next message, or None if none is complete in time (None: wait forever).

        Raises
        ------
        EOFError
            If the other end is gone and no whole message is left.
        ValueError
            If what comes is not a message.
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
        Longest wait; None: for ever.
    """
    waiting = select.poll()
    waiting.register(fd, event)
    return bool(waiting.poll(None if timeout_s is None else 1000 * max(timeout_s, 0.0)))
