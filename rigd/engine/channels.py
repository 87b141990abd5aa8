"""Topics that the control process publishes, and the shared memory of a rig's processes.

The table `TOPICS` determines the layout of the shared memory, the channels that the recorder logs,
and the rates that ``rigd status`` expects.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

from rigd.engine._ring import Ring, RingSpec
from rigd.engine.shared_state import EVENT_SIZE, SharedState, StateField, Stop
from rigd.safety.limits import BUFFERED_S
from rigd.session.layout import CONTROL_SIZE, SAMPLE_SIZE, TIMING_SIZE

# Topics

VIRTUAL_BUFFERED_S = 160.0
"""Time that the rings hold under the virtual clock, instead of `BUFFERED_S`: there a session takes
about a second, and observers lag behind."""
_EVENTS = 256


@dataclass(frozen=True, slots=True)
class Topic:
    """One kind of record, and the processes that read it."""

    name: str
    """Name of its channel in the file."""
    record_size: int
    """Size of a record in bytes."""
    every: int
    """Period in ticks of the record; 0: irregular."""
    logged: bool
    """Whether the recorder writes each record to the file."""
    live: bool
    """Whether the live publisher reads them, and drops what it cannot show in time."""

    def capacity(self, rate_hz: float, buffered_s: float = BUFFERED_S) -> int:
        """Return the number of records that the ring holds.

        Parameters
        ----------
        rate_hz
            Ticks a second.
        buffered_s
            Time that the ring holds.
        """
        return ceil(rate_hz * buffered_s / self.every) if self.every else _EVENTS

    def expected_hz(self, rate_hz: float) -> float | None:
        """Return the records per second of a recorded session; None if the rate is not fixed."""
        return rate_hz / self.every if self.every else None


EVENT = Topic("/rig/event", EVENT_SIZE, every=0, logged=True, live=True)
CONTROL = Topic("/rig/control", CONTROL_SIZE, every=10, logged=True, live=False)
TIMING = Topic("/rig/timing", TIMING_SIZE, every=1, logged=True, live=True)
SAMPLE = Topic("/rig/sample", SAMPLE_SIZE, every=1, logged=True, live=True)

TOPICS = (EVENT, CONTROL, TIMING, SAMPLE)
"""Topics in the order of logging: the samples last, so that what explains a sample precedes it."""


# Memory of a rig

DESCRIPTORS = len(TOPICS) + 2
"""File descriptors of shared memory, for :func:`create_channels`."""


@dataclass(frozen=True, slots=True)
class ChannelSpecs:
    """Descriptors and layout that a child process needs to attach."""

    rings: tuple[RingSpec, ...]
    """All rings, in the order of :data:`TOPICS`."""
    shared_state_fd: int
    """Descriptor of the memory of the shared state."""


@dataclass(frozen=True, slots=True)
class Channels:
    """The rings, in the order of :data:`TOPICS`, and the shared state."""

    events: Ring
    """Lines of the log."""
    controls: Ring
    """Terms of the controller."""
    timings: Ring
    """Ages of the readings."""
    samples: Ring
    """Samples."""
    shared_state: SharedState
    """State that every process can read."""
    reference_fd: int = -1
    """Descriptor of the memory for the reference of a session."""

    @property
    def rings(self) -> tuple[Ring, ...]:
        """All rings, in the order of the table."""
        return (self.events, self.controls, self.timings, self.samples)

    @property
    def specs(self) -> ChannelSpecs:
        """Descriptors and layout to hand to a child process."""
        return ChannelSpecs(tuple(ring.spec for ring in self.rings), self.shared_state.fd)

    def ask_to_stop(self) -> None:
        """Request a stop of the control process, unless a stop was requested before."""
        if self.shared_state[StateField.STOP] == Stop.NO:
            self.shared_state[StateField.STOP] = Stop.OPERATOR

    def clear(self) -> None:
        """Discard the records of the last session; only while no recorder runs."""
        for ring in self.rings:
            ring.discard()

    def close(self) -> None:
        """Unmap the memory; the descriptors stay open."""
        for ring in self.rings:
            ring.close()
        self.shared_state.close()


def create_channels(rate_hz: float, fds: Sequence[int], buffered_s: float = BUFFERED_S) -> Channels:
    """Lay out the memory for sessions at ``rate_hz`` in descriptors of shared memory.

    Parameters
    ----------
    rate_hz
        Ticks a second.
    fds
        Descriptors, as many as `DESCRIPTORS`: for the rings, the shared state and the reference.
    buffered_s
        Time that the rings hold.
    """
    *for_rings, for_shared_state, for_reference = fds
    rings = [
        Ring.create(topic.record_size, topic.capacity(rate_hz, buffered_s), fd)
        for topic, fd in zip(TOPICS, for_rings, strict=True)
    ]
    return _together(rings, SharedState.create(for_shared_state), for_reference)


def attach_channels(specs: ChannelSpecs) -> Channels:
    """Return the channels that the supervisor created, attached in a child process."""
    return _together([Ring(spec) for spec in specs.rings], SharedState(specs.shared_state_fd))


def _together(rings: Sequence[Ring], shared_state: SharedState, reference_fd: int = -1) -> Channels:
    events, controls, timings, samples = rings
    return Channels(events, controls, timings, samples, shared_state, reference_fd)
