"""Messages between the supervisor and the publisher of a live view.

The publisher answers a `LiveJob` with a `rigd.live.address.LiveAddress`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rigd.engine.channels import ChannelSpecs
from rigd.view import Subject


@dataclass(frozen=True, slots=True)
class LiveJob:
    """Job of the publisher for a rig.

    Attributes
    ----------
    rig
        Name of the profile, by which the view is found.
    channels
        Shared memory of the rig's processes.
    linger_s
        Time for which the view stays open after the last session.
    """

    rig: str
    channels: ChannelSpecs
    linger_s: float = 0.0


@dataclass(frozen=True, slots=True)
class LiveSession:
    """A session to show.

    Attributes
    ----------
    subject
        Data of the session for its views.
    recording_id
        Identifier of the session in viewers, also for a publisher that takes over.
    begins
        Number of records in each ring before the session, in the order of
        :data:`rigd.engine.channels.TOPICS`.
    folder
        Folder of its file and of earlier sessions; None: unknown.
    """

    subject: Subject
    recording_id: str
    begins: tuple[int, ...]
    folder: Path | None = None


@dataclass(frozen=True, slots=True)
class LiveTouches:
    """Estimates of touches in the session that is shown."""

    touches: tuple[Mapping[str, Any], ...]
    """Touches as in JSON documents; a later estimate of a touch replaces an earlier one."""


@dataclass(frozen=True, slots=True)
class LiveFit:
    """Fit of the record so far, in the session that is shown."""

    fit: Mapping[str, Any]
    """Fit as in JSON documents; it replaces the one before."""


@dataclass(frozen=True, slots=True)
class LiveEnd:
    """End of the session that is shown.

    Attributes
    ----------
    ends
        Number of records in each ring at the end, as :attr:`LiveSession.begins`.
    outcome, reason
        Outcome of the session and its reason; empty if unknown.
    """

    ends: tuple[int, ...]
    outcome: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True)
class LiveShown:
    """A session is shown from now on."""

    recording_id: str
    """Identifier of its :class:`LiveSession`."""
