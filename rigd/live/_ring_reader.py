"""Reader of a session's records in the ring buffers, for the live view."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from rigd.engine import Observer, Ring
from rigd.engine.channels import EVENT, SAMPLE, TIMING, TOPICS, Channels
from rigd.engine.shared_state import read_events
from rigd.live.messages import LiveSession
from rigd.session.layout import decode_samples, decode_timings
from rigd.view import Note, Scene
from rigd.view.frequency_charts import LastResponse

if TYPE_CHECKING:
    from rigd.view import Drawing

Records = TypeVar("Records")


@dataclass(frozen=True, slots=True)
class NewDrawings:
    """Drawings of the records that were read from the rings in one call.

    Attributes
    ----------
    notes
        Drawings of events, which must not be dropped.
    drawings
        All other drawings.
    samples
        Number of samples in the drawings that no earlier publisher has shown.
    """

    notes: "list[Drawing]"
    drawings: "list[Drawing]"
    samples: int


class SessionRecordReader:
    """Reads one session's records from the ring buffers, and turns them into drawings.

    Records that are overwritten before they are read are counted; the writer never waits.

    Parameters
    ----------
    session
        Session to read.
    channels
        Shared memory of the rig's processes.
    seen
        Number of samples that an earlier publisher has shown, counted as `LiveSession.begins`.
        Those that are still in the ring are read again for the scene.
    last
        Frequency response of the last session of the same specimen, or None.

    Attributes
    ----------
    scene
        Scene of the session, which makes the drawings.
    t_ns
        Time of the newest sample since the start of the session.
    read_duration_s
        Duration of the samples that were read in the last call.
    """

    def __init__(
        self,
        session: LiveSession,
        channels: Channels,
        seen: int = 0,
        last: LastResponse | None = None,
    ) -> None:
        self.scene = Scene(session.subject, last_response=last)
        self.t_ns = 0
        self.read_duration_s = 0.0
        self._rate_hz = session.subject.rate_hz
        self._seen_samples = seen
        self._readers = {
            topic: _RingReader(ring, first, seen if topic is SAMPLE else 0)
            for topic, ring, first in zip(TOPICS, channels.rings, session.begins, strict=True)
            if topic.live
        }

    @property
    def dropped(self) -> int:
        """Number of samples that were overwritten before they were read."""
        return self._readers[SAMPLE].dropped

    @property
    def next(self) -> int:
        """Number of the next sample to read, counted as `LiveSession.begins`."""
        return self._readers[SAMPLE].next

    @property
    def exhausted(self) -> bool:
        """Whether the session has ended and all its records were read."""
        return all(reader.exhausted for reader in self._readers.values())

    def end(self, ends: Sequence[int]) -> None:
        """Set the number of records in each ring at the end of the session."""
        for topic, end in zip(TOPICS, ends, strict=True):
            if topic in self._readers:
                self._readers[topic].end = end

    def read_new(self) -> NewDrawings:
        """Read the new records, and return their drawings."""
        scene, readers = self.scene, self._readers
        notes: list[Drawing] = []
        drawings: list[Drawing] = []
        count = first_shown = 0
        for events in readers[EVENT].records(read_events):
            notes += scene.events([Note(e.t_ns, e.level, e.message) for e in events])
        for timings in readers[TIMING].records(decode_timings):
            drawings += scene.timings(timings)
        for samples in readers[SAMPLE].records(decode_samples):
            drawings += scene.samples(samples)
            self.t_ns = int(samples["t_ns"][-1])
            count += len(samples)
            first_shown += min(len(samples), max(0, self.next - self._seen_samples))
        self.read_duration_s = count / self._rate_hz
        return NewDrawings(notes, drawings, first_shown)


class _RingReader:
    """Reads one session's records from a ring buffer.

    `first` is the number of the session's first record, `seen` that of the first record which no
    earlier publisher has shown.
    """

    def __init__(self, ring: Ring, first: int, seen: int) -> None:
        self._ring = ring
        # Overwritten records that an earlier publisher showed do not count as dropped.
        self._observer = Observer(ring, max(first, min(seen, ring.oldest)))
        self._damaged_records = 0
        self.end: int | None = None

    @property
    def dropped(self) -> int:
        """Number of records that were overwritten before they were read."""
        return self._observer.dropped + self._damaged_records

    @property
    def next(self) -> int:
        """Number of the next record to read."""
        return self._observer.next

    @property
    def exhausted(self) -> bool:
        """Whether the session has ended and all its records were read."""
        return self.end is not None and self._observer.next >= self.end

    def records(self, decode: Callable[[bytes], Records]) -> Iterator[Records]:
        """Yield the unread records in decoded blocks."""
        observer, written = self._observer, self._ring.written
        last = written if self.end is None else min(self.end, written)
        while True:
            observer.take(0)  # skip overwritten records
            if observer.next >= last:
                return
            block = observer.take(last - observer.next)
            if not block:
                continue
            try:
                yield decode(block)
            except ValueError:  # overwritten while it was copied
                self._damaged_records += len(block) // self._ring.record_size
