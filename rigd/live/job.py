"""What the publisher is told at its start."""

from dataclasses import dataclass

from rigd.engine.ring import RingSpec


@dataclass(frozen=True, slots=True)
class LiveJob:
    """What the publisher is to show.

    Attributes
    ----------
    samples
        The ring of samples, by an inherited descriptor.
    board_fd
        Inherited descriptor of the board, where the publisher counts what it dropped.
    name
        Of the session; Rerun shows it as the name of the recording.
    rate_hz
        Samples a second.
    linger_s
        How long the view stays open after the end of the session.
    """

    samples: RingSpec
    board_fd: int
    name: str
    rate_hz: float
    linger_s: float = 0.0
