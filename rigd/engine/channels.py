"""The shared memory of a rig's processes: a ring for each topic, and the board."""

from collections.abc import Sequence
from dataclasses import dataclass

from rigd.engine.board import Board, Stop, Word
from rigd.engine.ring import Ring, RingSpec
from rigd.engine.topics import TOPICS
from rigd.safety.limits import BUFFERED_S

DESCRIPTORS = len(TOPICS) + 2
"""Of shared memory, for :func:`create_channels`."""


@dataclass(frozen=True, slots=True)
class ChannelSpecs:
    """What a child process needs to attach."""

    rings: tuple[RingSpec, ...]
    """In the order of :data:`rigd.engine.topics.TOPICS`."""
    board_fd: int


@dataclass(frozen=True, slots=True)
class Channels:
    """The rings, in the order of :data:`rigd.engine.topics.TOPICS`, and the board."""

    events: Ring
    controls: Ring
    timings: Ring
    samples: Ring
    board: Board
    reference_fd: int = -1
    """Where the supervisor places the reference of a session."""

    @property
    def rings(self) -> tuple[Ring, ...]:
        """All rings, in the order of the table."""
        return (self.events, self.controls, self.timings, self.samples)

    @property
    def specs(self) -> ChannelSpecs:
        """What to hand to a child process."""
        return ChannelSpecs(tuple(ring.spec for ring in self.rings), self.board.fd)

    def ask_to_stop(self) -> None:
        """Ask the control process to stop, unless that was done before."""
        if self.board[Word.STOP] == Stop.NO:
            self.board[Word.STOP] = Stop.OPERATOR

    def clear(self) -> None:
        """Forget what the last session left; only while no recorder is at work."""
        for ring in self.rings:
            ring.discard()

    def close(self) -> None:
        """Unmap the memory; the descriptors stay open."""
        for ring in self.rings:
            ring.close()
        self.board.close()


def create_channels(rate_hz: float, fds: Sequence[int], buffered_s: float = BUFFERED_S) -> Channels:
    """Lay out the memory for sessions at ``rate_hz`` in descriptors of shared memory."""
    *for_rings, for_board, for_reference = fds
    rings = [
        Ring.create(topic.record_size, topic.capacity(rate_hz, buffered_s), fd)
        for topic, fd in zip(TOPICS, for_rings, strict=True)
    ]
    return _together(rings, Board.create(for_board), for_reference)


def attach_channels(specs: ChannelSpecs) -> Channels:
    """Attach in a child process to what the supervisor made."""
    return _together([Ring(spec) for spec in specs.rings], Board(specs.board_fd))


def _together(rings: Sequence[Ring], board: Board, reference_fd: int = -1) -> Channels:
    events, controls, timings, samples = rings
    return Channels(events, controls, timings, samples, board, reference_fd)
