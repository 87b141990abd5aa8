"""Messages between the supervisor and the publisher process of a live view.

The publisher's reply to a `LiveJob` is a `rigd.live.address.LiveAddress`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rigd.engine.channels import ChannelSpecs
from rigd.view import SessionDescription


@dataclass(frozen=True, slots=True)
class LiveJob:
    """First message to the publisher: the rig whose sessions it shows.

    Attributes
    ----------
    rig
        Name of the profile, by which viewers find the view.
    channels
        Shared memory of the rig's processes.
    linger_s
        Time for which the view remains open after the last session.
    """

    rig: str
    channels: ChannelSpecs
    linger_s: float = 0.0


@dataclass(frozen=True, slots=True)
class LiveSession:
    """Message to the publisher: a session that it shows from now on.

    Attributes
    ----------
    description
        Data of the session for its drawings.
    recording_id
        Identifier of the session in viewers, also for a publisher that replaces this one.
    begins
        Number of records in each ring buffer before the session, in the order of
        :data:`rigd.engine.channels.TOPICS`.
    folder
        Folder of its file and of earlier sessions, or None if it is unknown.
    """

    description: SessionDescription
    recording_id: str
    begins: tuple[int, ...]
    folder: Path | None = None


@dataclass(frozen=True, slots=True)
class LiveTouches:
    """Message to the publisher: estimated touches in the session that it shows."""

    touches: tuple[Mapping[str, Any], ...]
    """Estimated touches as JSON objects; a later estimate of a touch replaces an earlier one."""


@dataclass(frozen=True, slots=True)
class LiveFit:
    """Message to the publisher: a fit of the record so far of the session that it shows."""

    fit: Mapping[str, Any]
    """Fit as a JSON object; it replaces the previous fit."""


@dataclass(frozen=True, slots=True)
class LiveSessionEnded:
    """Message to the publisher: the session that it shows has ended.

    Attributes
    ----------
    ends
        Number of records in each ring buffer at the end of the session, counted as in
        :attr:`LiveSession.begins`.
    outcome, reason
        Outcome of the session and its reason, or empty strings if they are unknown.
    """

    ends: tuple[int, ...]
    outcome: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True)
class LiveSessionShown:
    """Message from the publisher: it has begun to show a session."""

    recording_id: str
    """Identifier of the :class:`LiveSession` that is shown."""
