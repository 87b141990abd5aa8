"""Topics that the control process publishes, and the shared memory of a rig's processes.

The table `TOPICS` determines the layout of the shared memory, the channels that the recorder logs,
and the rates that ``rigd status`` expects.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

from rigd.engine._ring import Ring, RingSpec
from rigd.engine.shared_state import EVENT_SIZE, SharedState, StateField, StopReason
from rigd.safety.limits import RECORDER_BUFFER_S
from rigd.session.layout import CONTROL_SIZE, SAMPLE_SIZE, TIMING_SIZE

# Topics

VIRTUAL_CLOCK_BUFFER_S = 160.0
"""Time span in s of the records that the rings hold under the virtual clock.

It is longer than `RECORDER_BUFFER_S`, because under the virtual clock a session takes about a
second, and observers lag behind."""
_EVENT_CAPACITY = 256
"""Number of records that the ring of log events holds."""


@dataclass(frozen=True, slots=True)
class Topic:
    """Kind of record that the control process writes to a ring, and the processes that read it."""

    name: str
    """Name of the topic's channel in the session file."""
    record_size: int
    """Size of a record in bytes."""
    tick_interval: int
    """Number of ticks from one record to the next; 0: irregular."""
    is_recorded: bool
    """Whether the recorder writes each record to the file."""
    is_shown_live: bool
    """Whether the live publisher reads the records; it drops those that it cannot show in time."""

    def capacity(self, rate_hz: float, buffered_s: float = RECORDER_BUFFER_S) -> int:
        """Return the number of records that the topic's ring buffer must hold.

        Parameters
        ----------
        rate_hz
            Ticks a second.
        buffered_s
            Time span in s of the records that the ring holds.
        """
        return (
            ceil(rate_hz * buffered_s / self.tick_interval)
            if self.tick_interval
            else _EVENT_CAPACITY
        )

    def expected_hz(self, rate_hz: float) -> float | None:
        """Return the topic's records per second while a session is recorded, or None if irregular.

        `rate_hz` is the number of ticks a second.
        """
        return rate_hz / self.tick_interval if self.tick_interval else None


EVENT = Topic("/rig/event", EVENT_SIZE, tick_interval=0, is_recorded=True, is_shown_live=True)
"""Topic of the log events."""
CONTROL = Topic(
    "/rig/control", CONTROL_SIZE, tick_interval=10, is_recorded=True, is_shown_live=False
)
"""Topic of the controller's terms."""
TIMING = Topic("/rig/timing", TIMING_SIZE, tick_interval=1, is_recorded=True, is_shown_live=True)
"""Topic of the ages of the readings."""
SAMPLE = Topic("/rig/sample", SAMPLE_SIZE, tick_interval=1, is_recorded=True, is_shown_live=True)
"""Topic of the samples."""

TOPICS = (EVENT, CONTROL, TIMING, SAMPLE)
"""Topics in the order in which the recorder writes them. Samples come last, so that the events that
explain a sample precede it in the file."""


# Memory of a rig

DESCRIPTOR_COUNT = len(TOPICS) + 2
"""Number of file descriptors of shared memory that :func:`create_channels` needs."""


@dataclass(frozen=True, slots=True)
class ChannelSpecs:
    """File descriptors and layouts that a child process needs to open the shared memory."""

    rings: tuple[RingSpec, ...]
    """Descriptors and layouts of all rings, in the order of :data:`TOPICS`."""
    shared_state_fd: int
    """Descriptor of the memory of the shared state."""


@dataclass(frozen=True, slots=True)
class Channels:
    """Shared memory of a rig's processes: the rings of records and the shared state."""

    events: Ring
    """Ring of log events."""
    controls: Ring
    """Ring of the controller's terms."""
    timings: Ring
    """Ring of the ages of the readings."""
    samples: Ring
    """Ring of samples."""
    shared_state: SharedState
    """State that every process can read."""
    reference_fd: int = -1
    """Descriptor of the memory for the reference of a session; -1: none."""

    @property
    def rings(self) -> tuple[Ring, ...]:
        """All rings in the order of `TOPICS`."""
        return (self.events, self.controls, self.timings, self.samples)

    @property
    def specs(self) -> ChannelSpecs:
        """File descriptors and layouts that a child process needs to open the shared memory."""
        return ChannelSpecs(tuple(ring.spec for ring in self.rings), self.shared_state.fd)

    def request_stop(self) -> None:
        """Request a stop of the control process, unless a stop was requested before."""
        if self.shared_state[StateField.STOP_REASON] == StopReason.NONE:
            self.shared_state[StateField.STOP_REASON] = StopReason.OPERATOR

    def discard_records(self) -> None:
        """Discard all records in the rings before the next session, while no recorder runs."""
        for ring in self.rings:
            ring.discard_records()

    def close(self) -> None:
        """Unmap the shared memory of rings and state; the descriptors stay open."""
        for ring in self.rings:
            ring.close()
        self.shared_state.close()


def create_channels(
    rate_hz: float, descriptors: Sequence[int], buffered_s: float = RECORDER_BUFFER_S
) -> Channels:
    """Create the rings and the shared state of a rig's processes in shared memory.

    Parameters
    ----------
    rate_hz
        Ticks a second.
    descriptors
        `DESCRIPTOR_COUNT` file descriptors: one for each ring, the shared state and the reference.
    buffered_s
        Time span in s of the records that the rings hold.
    """
    *ring_fds, shared_state_fd, reference_fd = descriptors
    rings = [
        Ring.create(topic.record_size, topic.capacity(rate_hz, buffered_s), fd)
        for topic, fd in zip(TOPICS, ring_fds, strict=True)
    ]
    return _make_channels(rings, SharedState.create(shared_state_fd), reference_fd)


def attach_channels(specs: ChannelSpecs) -> Channels:
    """Return the channels that the supervisor created, opened in this child process."""
    return _make_channels(
        [Ring(ring_spec) for ring_spec in specs.rings], SharedState(specs.shared_state_fd)
    )


def _make_channels(
    topic_rings: Sequence[Ring], shared_state: SharedState, reference_fd: int = -1
) -> Channels:
    """Return channels from rings in the order of `TOPICS`, and the shared state."""
    events, controls, timings, samples = topic_rings
    return Channels(events, controls, timings, samples, shared_state, reference_fd)
