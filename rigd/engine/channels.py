"""The shared memory of one session: four rings and the board, made by the supervisor."""

from collections.abc import Sequence
from dataclasses import dataclass

from rigd.engine.board import Board, Stop, Word
from rigd.engine.events import EVENT_SIZE
from rigd.engine.ring import Ring, RingSpec
from rigd.session.format import CONTROL_SIZE, SAMPLE_SIZE, TIMING_SIZE

BUFFERED_S = 16.0
"""What the rings hold, so that no stall of a disk loses a sample."""
CONTROL_DECIMATION = 10
"""The controller's terms are logged every so many ticks."""
_EVENTS = 256


@dataclass(frozen=True, slots=True)
class ChannelSpecs:
    """What a child process needs to attach."""

    samples: RingSpec
    controls: RingSpec
    timings: RingSpec
    events: RingSpec
    board_fd: int


@dataclass(frozen=True, slots=True)
class Channels:
    """The rings and the board, attached."""

    samples: Ring
    controls: Ring
    timings: Ring
    events: Ring
    board: Board

    @property
    def specs(self) -> ChannelSpecs:
        """What to hand to a child process."""
        return ChannelSpecs(
            self.samples.spec,
            self.controls.spec,
            self.timings.spec,
            self.events.spec,
            self.board.fd,
        )

    def ask_to_stop(self) -> None:
        """Ask the control process to stop, unless that was done before."""
        if self.board[Word.STOP] == Stop.NO:
            self.board[Word.STOP] = Stop.OPERATOR

    def close(self) -> None:
        """Unmap the memory; the descriptors stay open."""
        for part in (self.samples, self.controls, self.timings, self.events, self.board):
            part.close()


def create_channels(rate_hz: float, fds: Sequence[int]) -> Channels:
    """Lay out the memory of one session at ``rate_hz`` in five descriptors of shared memory."""
    samples, controls, timings, events, board = fds
    ticks = int(rate_hz * BUFFERED_S)
    return Channels(
        samples=Ring.create(SAMPLE_SIZE, ticks, samples),
        controls=Ring.create(CONTROL_SIZE, ticks // CONTROL_DECIMATION + 1, controls),
        timings=Ring.create(TIMING_SIZE, ticks, timings),
        events=Ring.create(EVENT_SIZE, _EVENTS, events),
        board=Board.create(board),
    )


def attach_channels(specs: ChannelSpecs) -> Channels:
    """Attach in a child process to what the supervisor made."""
    return Channels(
        Ring(specs.samples),
        Ring(specs.controls),
        Ring(specs.timings),
        Ring(specs.events),
        Board(specs.board_fd),
    )
