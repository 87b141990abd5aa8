"""What the processes of a session are told at their start."""

from dataclasses import dataclass
from pathlib import Path

from rigd.engine.channels import ChannelSpecs
from rigd.excitation import Excitation
from rigd.profile import Profile


@dataclass(frozen=True, slots=True)
class ControlJob:
    """The session to run."""

    profile: Profile
    excitation: Excitation
    channels: ChannelSpecs
    fast: bool
    """Run under the virtual clock."""


@dataclass(frozen=True, slots=True)
class RecorderJob:
    """The file to write."""

    path: Path
    channels: ChannelSpecs
