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
    """The rig whose sessions are shown.

    Attributes
    ----------
    rig
        The profile's name, by which the view is found.
    channels
        The shared memory of the rig's processes.
    linger_s
        How long the view stays open after the last session.
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
        What the views need to know of it.
    recording_id
        By which viewers tell it from others; the same for a publisher that takes it over.
    begins
        How many records had been written to each ring before it, in the order of
        :data:`rigd.engine.channels.TOPICS`.
    folder
        Folder of its file, where the sessions before it are; None: it is not known.
    """

    subject: Subject
    recording_id: str
    begins: tuple[int, ...]
    folder: Path | None = None


@dataclass(frozen=True, slots=True)
class LiveTouches:
    """Estimates of touches in the session that is shown."""

    touches: tuple[Mapping[str, Any], ...]
    """As in JSON documents; a later estimate of a touch takes the place of an earlier one."""


@dataclass(frozen=True, slots=True)
class LiveFit:
    """Fit of the record so far, of the session that is shown."""

    fit: Mapping[str, Any]
    """As in JSON documents; it takes the place of the one before."""


@dataclass(frozen=True, slots=True)
class LiveEnd:
    """The end of a session that is shown.

    Attributes
    ----------
    ends
        How many records each ring had then, as :attr:`LiveSession.begins`.
    outcome, reason
        How the session ended, if that is known.
    """

    ends: tuple[int, ...]
    outcome: str = ""
    reason: str = ""


@dataclass(frozen=True, slots=True)
class LiveShown:
    """A session is shown from now on."""

    recording_id: str
    """That of its :class:`LiveSession`."""
