"""What the publisher is told: at its start, and of each session."""

from dataclasses import dataclass

from rigd.engine.channels import ChannelSpecs
from rigd.view.subject import Subject


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
        What its picture is of.
    recording_id
        By which viewers tell it from others; the same for a publisher that takes it over.
    begins
        How many records had been written to each ring before it, in the order of
        :data:`rigd.engine.topics.TOPICS`.
    """

    subject: Subject
    recording_id: str
    begins: tuple[int, ...]


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
