"""What the control process publishes, and the memory that a rig's processes share.

One table, `TOPICS`, from which the shared memory is laid out, by which the recorder logs, and with
which ``rigd status`` compares the rates it sees.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

from rigd.engine._ring import Ring, RingSpec
from rigd.engine.shared_state import EVENT_SIZE, SharedState, Stop, Word
from rigd.safety.limits import BUFFERED_S
from rigd.session.layout import CONTROL_SIZE, SAMPLE_SIZE, TIMING_SIZE

# Topics

HURRIED_BUFFERED_S = 160.0
"""What the rings hold under the virtual clock, instead of `BUFFERED_S`: there a session passes in a
second, and who only looks on lags."""
_EVENTS = 256


@dataclass(frozen=True, slots=True)
class Topic:
    """One kind of record, and its way."""

    name: str
    """Its channel in the file."""
    record_size: int
    """Bytes."""
    every: int
    """Ticks of the record from one to the next; 0: whenever there is something to say."""
    logged: bool
    """The recorder writes each of them into the file."""
    live: bool
    """The live publisher looks at them, as far as it can keep up."""

    def capacity(self, rate_hz: float, buffered_s: float = BUFFERED_S) -> int:
        """Return how many records its ring holds.

        Parameters
        ----------
        rate_hz
            Ticks a second.
        buffered_s
            Time that the ring holds.
        """
        return ceil(rate_hz * buffered_s / self.every) if self.every else _EVENTS

    def expected_hz(self, rate_hz: float) -> float | None:
        """Return the records a second of a recorded session; None where the rate is not fixed."""
        return rate_hz / self.every if self.every else None


EVENT = Topic("/rig/event", EVENT_SIZE, every=0, logged=True, live=True)
CONTROL = Topic("/rig/control", CONTROL_SIZE, every=10, logged=True, live=False)
TIMING = Topic("/rig/timing", TIMING_SIZE, every=1, logged=True, live=True)
SAMPLE = Topic("/rig/sample", SAMPLE_SIZE, every=1, logged=True, live=True)

TOPICS = (EVENT, CONTROL, TIMING, SAMPLE)
"""The samples last: what explains a sample is in the file no later than the sample."""


# Memory of a rig

DESCRIPTORS = len(TOPICS) + 2
"""File descriptors of shared memory, for :func:`create_channels`."""


@dataclass(frozen=True, slots=True)
class ChannelSpecs:
    """What a child process needs to attach."""

    rings: tuple[RingSpec, ...]
    """All rings, in the order of :data:`TOPICS`."""
    board_fd: int
    """Descriptor of the board's memory."""


@dataclass(frozen=True, slots=True)
class Channels:
    """The rings, in the order of :data:`TOPICS`, and the board."""

    events: Ring
    """Lines of the log."""
    controls: Ring
    """Terms of the controller."""
    timings: Ring
    """Ages of the readings."""
    samples: Ring
    """Samples."""
    board: SharedState
    """State that every process can read."""
    reference_fd: int = -1
    """Where the supervisor places the reference of a session."""

    @property
    def rings(self) -> tuple[Ring, ...]:
        """All rings, in the order of the table."""
        return (self.events, self.controls, self.timings, self.samples)

    @property
    def specs(self) -> ChannelSpecs:
        """Descriptors and layout to hand to a child process."""
        return ChannelSpecs(tuple(ring.spec for ring in self.rings), self.board.fd)

    def ask_to_stop(self) -> None:
        """Ask the control process to stop, unless that was done before."""
        if self.board[Word.STOP] == Stop.NO:
            self.board[Word.STOP] = Stop.OPERATOR

    def clear(self) -> None:
        """Forget what the last session left; only while no recorder is running."""
        for ring in self.rings:
            ring.discard()

    def close(self) -> None:
        """Unmap the memory; the descriptors stay open."""
        for ring in self.rings:
            ring.close()
        self.board.close()


def create_channels(rate_hz: float, fds: Sequence[int], buffered_s: float = BUFFERED_S) -> Channels:
    """Lay out the memory for sessions at ``rate_hz`` in descriptors of shared memory.

    Parameters
    ----------
    rate_hz
        Ticks a second.
    fds
        Descriptors, as many as `TOPICS` and one for the board.
    buffered_s
        Time that the rings hold.
    """
    *for_rings, for_board, for_reference = fds
    rings = [
        Ring.create(topic.record_size, topic.capacity(rate_hz, buffered_s), fd)
        for topic, fd in zip(TOPICS, for_rings, strict=True)
    ]
    return _together(rings, SharedState.create(for_board), for_reference)


def attach_channels(specs: ChannelSpecs) -> Channels:
    """Attach in a child process to what the supervisor made."""
    return _together([Ring(spec) for spec in specs.rings], SharedState(specs.board_fd))


def _together(rings: Sequence[Ring], board: SharedState, reference_fd: int = -1) -> Channels:
    events, controls, timings, samples = rings
    return Channels(events, controls, timings, samples, board, reference_fd)
