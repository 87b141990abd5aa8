"""Reader of a session's rings for the live view."""

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
class Harvest:
    """Drawings of the records since the last call.

    Attributes
    ----------
    notes
        Drawings of events, which must not be dropped.
    drawings
        All other drawings.
    samples
        Number of samples that the drawings show for the first time.
    """

    notes: "list[Drawing]"
    drawings: "list[Drawing]"
    samples: int


class Intake:
    """Reader of one session's rings, from its first record to its last.

    Records that are overwritten before they are read are counted; the writer never waits.

    Parameters
    ----------
    session
        Session to show.
    channels
        The memory of the rig's processes.
    seen
        Number of samples that an earlier publisher showed, counted as `begins` is. Those still in
        the ring are read again for the scene.
    last
        Response of the last session of the same specimen.

    Attributes
    ----------
    picture
        Scene of the session.
    t_ns
        Time of the newest sample, since the start of the session.
    took_s
        Duration of the samples that were read last.
    """

    def __init__(
        self,
        session: LiveSession,
        channels: Channels,
        seen: int = 0,
        last: LastResponse | None = None,
    ) -> None:
        self.picture = Scene(session.subject, last=last)
        self.t_ns = 0
        self.took_s = 0.0
        self._rate_hz = session.subject.rate_hz
        self._seen = seen
        self._readers = {
            topic: _RingReader(ring, first, seen if topic is SAMPLE else 0)
            for topic, ring, first in zip(TOPICS, channels.rings, session.begins, strict=True)
            if topic.live
        }

    @property
    def dropped(self) -> int:
        """Samples that were overwritten before they were read."""
        return self._readers[SAMPLE].dropped

    @property
    def next(self) -> int:
        """Number of the next sample, counted as `begins` is."""
        return self._readers[SAMPLE].next

    @property
    def exhausted(self) -> bool:
        """Whether the session is over and completely read."""
        return all(reader.exhausted for reader in self._readers.values())

    def end(self, ends: Sequence[int]) -> None:
        """Set the number of records in each ring at the end of the session."""
        for topic, end in zip(TOPICS, ends, strict=True):
            if topic in self._readers:
                self._readers[topic].end = end

    def take(self) -> Harvest:
        """Return the drawings of the new records, from the scene."""
        picture, readers = self.picture, self._readers
        notes: list[Drawing] = []
        drawings: list[Drawing] = []
        count = fresh = 0
        for events in readers[EVENT].records(read_events):
            notes += picture.events([Note(e.t_ns, e.level, e.message) for e in events])
        for timings in readers[TIMING].records(decode_timings):
            drawings += picture.timings(timings)
        for samples in readers[SAMPLE].records(decode_samples):
            drawings += picture.samples(samples)
            self.t_ns = int(samples["t_ns"][-1])
            count += len(samples)
            fresh += min(len(samples), max(0, self.next - self._seen))
        self.took_s = count / self._rate_hz
        return Harvest(notes, drawings, fresh)


class _RingReader:
    """Reader of one session's records in a ring."""

    def __init__(self, ring: Ring, first: int, seen: int) -> None:
        self._ring = ring
        # Overwritten records that an earlier publisher showed do not count as dropped.
        self._observer = Observer(ring, max(first, min(seen, ring.oldest)))
        self._damaged = 0
        self.end: int | None = None

    @property
    def dropped(self) -> int:
        return self._observer.dropped + self._damaged

    @property
    def next(self) -> int:
        return self._observer.next

    @property
    def exhausted(self) -> bool:
        return self.end is not None and self._observer.next >= self.end

    def records(self, decode: Callable[[bytes], Records]) -> Iterator[Records]:
        """Yield the present records in decoded blocks."""
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
                self._damaged += len(block) // self._ring.record_size
