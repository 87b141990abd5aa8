"""Reader of a session's records in the ring buffers, for the live view."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from rigd.engine import Ring, RingObserver
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
    """Functions that draw the records that one call has read from the ring buffers.

    Attributes
    ----------
    note_drawings
        Functions that draw events, which must not be dropped.
    other_drawings
        All other functions.
    new_sample_count
        Number of the samples among the records that no earlier publisher has shown.
    """

    note_drawings: "list[Drawing]"
    other_drawings: "list[Drawing]"
    new_sample_count: int


class SessionRecordReader:
    """Reads one session's records from the ring buffers, and provides functions that draw them.

    Records that are overwritten before they are read are counted; the writer never waits. The first
    sample that no earlier publisher has shown has the number `seen_sample_count`, as in
    `LiveSession.begins`; earlier samples that are still in the ring are read again for the scene.
    `t_ns` is the time of the newest sample since the start of the session, `read_duration_s` the
    duration of the samples of the last call.
    """

    def __init__(
        self,
        session: LiveSession,
        channels: Channels,
        seen_sample_count: int = 0,
        last_response: LastResponse | None = None,
    ) -> None:
        self.scene = Scene(session.description, last_response=last_response)
        self.t_ns = 0
        self.read_duration_s = 0.0
        self._rate_hz = session.description.rate_hz
        self._seen_sample_count = seen_sample_count
        self._readers = {
            topic: _RingReader(
                ring_buffer, first_record, seen_sample_count if topic is SAMPLE else 0
            )
            for topic, ring_buffer, first_record in zip(
                TOPICS, channels.rings, session.begins, strict=True
            )
            if topic.is_shown_live
        }

    @property
    def dropped_samples(self) -> int:
        """Number of samples that were overwritten before they were read."""
        return self._readers[SAMPLE].dropped_records

    @property
    def next_sample_number(self) -> int:
        """Number of the next sample to read; 0 is the first one ever written to the ring buffer."""
        return self._readers[SAMPLE].next_record_number

    def set_end(self, record_counts: Sequence[int]) -> None:
        """Set the number of records that each ring buffer has at the end of the session."""
        for topic, end_record in zip(TOPICS, record_counts, strict=True):
            if topic in self._readers:
                self._readers[topic].end_record = end_record

    def read_new_records(self) -> NewDrawings:
        """Read the records since the last call, and return functions that draw them."""
        scene, ring_readers = self.scene, self._readers
        note_drawings: list[Drawing] = []
        signal_drawings: list[Drawing] = []
        sample_count = newly_shown_count = 0
        for event_records in ring_readers[EVENT].read_records(read_events):
            note_drawings += scene.event_drawings(
                [Note(e.t_ns, e.level, e.message) for e in event_records]
            )
        for timing_records in ring_readers[TIMING].read_records(decode_timings):
            signal_drawings += scene.timing_drawings(timing_records)
        for sample_records in ring_readers[SAMPLE].read_records(decode_samples):
            signal_drawings += scene.sample_drawings(sample_records)
            self.t_ns = int(sample_records["t_ns"][-1])
            sample_count += len(sample_records)
            newly_shown_count += min(
                len(sample_records), max(0, self.next_sample_number - self._seen_sample_count)
            )
        self.read_duration_s = sample_count / self._rate_hz
        return NewDrawings(note_drawings, signal_drawings, newly_shown_count)


class _RingReader:
    """Reads one session's records from a ring buffer.

    `first_record` is the number of the session's first record, `first_unshown` that of the first
    record which no earlier publisher has shown.
    """

    def __init__(self, ring: Ring, first_record: int, first_unshown_record: int) -> None:
        self._ring = ring
        # Overwritten records that an earlier publisher showed do not count as dropped.
        self._observer = RingObserver(
            ring, max(first_record, min(first_unshown_record, ring.oldest_index))
        )
        self._damaged_records = 0
        self.end_record: int | None = None

    @property
    def dropped_records(self) -> int:
        """Number of records that were overwritten before they were read."""
        return self._observer.dropped + self._damaged_records

    @property
    def next_record_number(self) -> int:
        """Number of the next record to read; 0 is the first one ever written to the ring buffer."""
        return self._observer.next_index

    def read_records(self, decode: Callable[[bytes], Records]) -> Iterator[Records]:
        """Yield the unread records in decoded blocks."""
        observer, written_records = self._observer, self._ring.written_count
        end_record = (
            written_records if self.end_record is None else min(self.end_record, written_records)
        )
        while True:
            observer.take(0)  # skip overwritten records
            if observer.next_index >= end_record:
                return
            record_block = observer.take(end_record - observer.next_index)
            if not record_block:
                continue
            try:
                yield decode(record_block)
            except ValueError:  # overwritten while it was copied
                self._damaged_records += len(record_block) // self._ring.record_size
