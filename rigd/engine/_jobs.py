"""Jobs of a rig's processes: what each is told at its start, and for each session."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rigd.devices import Reality
from rigd.engine._ring import ReferenceSpec
from rigd.engine._topics import ChannelSpecs
from rigd.profile import Profile, RealtimeSettings


@dataclass(frozen=True, slots=True)
class ControlJob:
    """The rig to attend to."""

    profile: Profile
    """Profile of the rig."""
    moving: Reality | None
    """What the operator was told would move, and nothing else may; None: nothing was told."""
    channels: ChannelSpecs
    """Shared memory of the session."""
    fast: bool
    """Run under the virtual clock."""


@dataclass(frozen=True, slots=True)
class SessionJob:
    """The session to run on it."""

    profile: Profile
    """The rig's; its controller and limits may be others."""
    reference: ReferenceSpec
    """Angles relative to the one at the start."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """What the system did not grant supervisor and recorder, and why."""


@dataclass(frozen=True, slots=True)
class RecorderJob:
    """The file to write."""

    path: Path
    """Final name of the session file."""
    channels: ChannelSpecs
    """Shared memory of the session."""
    realtime: RealtimeSettings | None = None
    """What it may ask of the scheduler; None: nothing, for it is not in real time."""
