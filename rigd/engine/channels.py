"""The shared memory of one session: three rings and the board, made by the supervisor."""

import os
from dataclasses import dataclass

from rigd.engine.board import Board
from rigd.engine.events import EVENT_SIZE
from rigd.engine.ring import Ring, RingSpec
from rigd.session.format import CONTROL_SIZE, SAMPLE_SIZE

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
    events: RingSpec
    board_fd: int

    @property
    def fds(self) -> tuple[int, ...]:
        """The descriptors a child must inherit."""
        return (self.samples.fd, self.controls.fd, self.events.fd, self.board_fd)


@dataclass(frozen=True, slots=True)
class Channels:
    """The rings and the board, attached."""

    samples: Ring
    controls: Ring
    events: Ring
    board: Board

    @property
    def specs(self) -> ChannelSpecs:
        """What to hand to a child process."""
        return ChannelSpecs(self.samples.spec, self.controls.spec, self.events.spec, self.board.fd)

    def close(self) -> None:
        """Unmap the memory and close the descriptors of this process."""
        specs = self.specs
        for part in (self.samples, self.controls, self.events, self.board):
            part.close()
        for fd in specs.fds:
            os.close(fd)


def create_channels(rate_hz: float) -> Channels:
    """Make the shared memory of one session at ``rate_hz``."""
    ticks = int(rate_hz * BUFFERED_S)
    return Channels(
        samples=Ring.create(SAMPLE_SIZE, ticks),
        controls=Ring.create(CONTROL_SIZE, ticks // CONTROL_DECIMATION + 1),
        events=Ring.create(EVENT_SIZE, _EVENTS),
        board=Board.create(),
    )


def attach_channels(specs: ChannelSpecs) -> Channels:
    """Attach in a child process to what the supervisor made."""
    return Channels(
        Ring(specs.samples), Ring(specs.controls), Ring(specs.events), Board(specs.board_fd)
    )
