"""What the control process publishes: one table, from which everything that carries it works.

The shared memory is laid out from it, the recorder logs by it, and ``rigd status`` compares what
comes with what is expected.
"""

from dataclasses import dataclass
from math import ceil

from rigd.engine.events import EVENT_SIZE
from rigd.safety.limits import BUFFERED_S
from rigd.session.format import CONTROL_SIZE, SAMPLE_SIZE, TIMING_SIZE

HURRIED_BUFFERED_S = 160.0
"""What the rings hold under the virtual clock, instead of `BUFFERED_S`: there a session passes in a
second, and the live view lags."""
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
    ages_only: bool = False
    """Not under the virtual clock, where no reading has an age."""

    def capacity(self, rate_hz: float, buffered_s: float = BUFFERED_S) -> int:
        """Return how many records its ring holds."""
        return ceil(rate_hz * buffered_s / self.every) if self.every else _EVENTS

    def expected_hz(self, rate_hz: float) -> float | None:
        """Return the records a second of a recorded session; None where there is no saying."""
        return rate_hz / self.every if self.every else None


EVENT = Topic("/rig/event", EVENT_SIZE, every=0, logged=True, live=True)
CONTROL = Topic("/rig/control", CONTROL_SIZE, every=10, logged=True, live=False)
TIMING = Topic("/rig/timing", TIMING_SIZE, every=1, logged=True, live=True, ages_only=True)
SAMPLE = Topic("/rig/sample", SAMPLE_SIZE, every=1, logged=True, live=True)

TOPICS = (EVENT, CONTROL, TIMING, SAMPLE)
"""The samples last: what explains a sample is in the file no later than the sample."""
