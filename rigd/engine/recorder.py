"""The recorder process, which writes the records of the rings to the session file.

The recorder opens the file before the motor moves, writes the records of the loop as fast as the
disk allows, and closes the file with the outcome. If the supervisor dies, it waits until the loop
has stopped and then closes the file itself.
"""

import contextlib
import shlex
import shutil
import time
from collections.abc import Callable, Mapping
from math import ceil
from pathlib import Path
from types import MappingProxyType

from rigd.engine.channels import (
    CONTROL,
    EVENT,
    SAMPLE,
    TIMING,
    TOPICS,
    Channels,
    Topic,
    attach_channels,
)
from rigd.engine.messages import (
    CloseFile,
    FileClosed,
    FileHeader,
    FileOpened,
    ProcessFailed,
    RecorderJob,
    RecorderReady,
)
from rigd.engine.processes import SupervisorConnection
from rigd.engine.realtime import RaisedPriority
from rigd.engine.reference import covers_reference
from rigd.engine.shared_state import Phase, SharedState, StateField, read_events
from rigd.runtime import ignore_end_signals as ignore_signals
from rigd.session import SessionError, SessionExistsError, SessionWriter, segments_until
from rigd.session.layout import SAMPLE_SIZE

_MAX_BLOCK_RECORDS = 250
"""Largest number of records that are taken from a ring at once."""
_IDLE_PAUSE_S = 0.005
"""Pause in s when the rings contain no new record."""
_ORPHAN_TIMEOUT_S = 3.0
"""Longest time in s without a new record before a recorder without supervisor closes the file."""
_DISK_POLL_S = 1.0
"""Time in s between two checks of the free disk space."""


def main() -> None:
    """Run the recorder process, started as ``python -m rigd.engine.recorder``."""
    ignore_signals()
    parent = SupervisorConnection()
    job: RecorderJob = parent.receive_job()
    channels = attach_channels(job.channels)
    realtime_results = {}
    if job.realtime is not None:
        realtime_results = RaisedPriority(
            job.realtime.supervision_priority, job.realtime.cpu
        ).request_priority()
    try:
        writer = SessionWriter(job.path)
    except SessionError as error:
        parent.send(ProcessFailed(str(error), is_name_taken=isinstance(error, SessionExistsError)))
        raise SystemExit(1) from None
    _publish_free_space(channels.shared_state, job.path.parent)
    parent.send(FileOpened(realtime_results))
    try:
        _record_until_closed(parent, channels, writer, job.path.parent)
    except SessionError as error:
        failure_text, saved_path = _abandon_recording(writer)
        parent.send(ProcessFailed(f"{error}{failure_text}", saved_path=saved_path))
        raise SystemExit(1) from None


def _abandon_recording(writer: SessionWriter) -> tuple[str, Path | None]:
    """Abandon a recording; return a sentence on where its data are, and the path of the data.

    The sentence is empty and the path None if the data are in the ``.part`` file as usual.
    """
    try:
        saved_path = writer.abandon()
    except SessionError:
        return "", None  # disk full, device gone: what reached the disk stays there
    if saved_path == writer.part:
        return "", None
    if saved_path is None:
        return " What was recorded could not be saved elsewhere.", None
    return (
        f" What was recorded is now {saved_path}; rigd recover {shlex.quote(str(saved_path))} "
        "makes a session file of it.",
        saved_path,
    )


def _record_until_closed(
    parent: SupervisorConnection, channels: Channels, writer: SessionWriter, disk_folder: Path
) -> None:
    """Write the records of the rings until the supervisor requests the end, or has ended."""
    recorder = Recorder(channels, writer)
    last_poll_s = time.monotonic()
    while True:
        has_transferred = recorder.transfer_records()
        if time.monotonic() - last_poll_s > _DISK_POLL_S:
            last_poll_s = time.monotonic()
            _publish_free_space(channels.shared_state, disk_folder)
        try:
            message = parent.poll(0.0 if has_transferred else _IDLE_PAUSE_S)
        except EOFError:
            recorder.close_without_supervisor()
            return
        match message:
            case FileHeader():
                recorder.header = message
                parent.send(RecorderReady())
            case CloseFile(outcome, touches, segments):
                recorder.transfer_records()
                if recorder.begun:
                    writer.write_touches(touches)
                    parent.send(recorder.close(outcome, segments))
                else:
                    writer.discard()
                    parent.send(FileClosed())
                return


def _publish_free_space(shared_state: SharedState, disk_folder: Path) -> None:
    """Write the free space in MB on the disk of a folder to the shared state."""
    with contextlib.suppress(OSError):
        shared_state[StateField.DISK_FREE_MB] = max(
            1, ceil(shutil.disk_usage(disk_folder).free / 1e6)
        )


class Recorder:
    """Recorder of one session, which copies the records of the rings to the session file.

    Parameters
    ----------
    channels
        Channels with the rings, to which this process is attached.
    writer
        Writer of the session file, on which `begin` has not been called yet.

    Attributes
    ----------
    begun
        Whether the first sample has arrived, so that the file has contents.
    """

    def __init__(self, channels: Channels, writer: SessionWriter) -> None:
        self._channels = channels
        self._writer = writer
        topic_writers: dict[Topic, Callable[[bytes], None]] = {
            EVENT: self._write_events,
            CONTROL: writer.write_controls,
            TIMING: writer.write_timings,
            SAMPLE: self._write_samples,
        }
        self._ring_writers = [
            (ring, topic_writers[topic])
            for topic, ring in zip(TOPICS, channels.rings, strict=True)
            if topic.is_recorded
        ]
        self._recorded_samples = 0
        self.header: FileHeader | None = None
        """Header of the session; None until the supervisor has sent it."""
        self.begun = False

    def _begin_file(self, file_header: FileHeader) -> None:
        """Write metadata, segments and attachments at the start of the file."""
        attachment_bytes_by_name = {
            attachment_name: attachment_text.encode()
            for attachment_name, attachment_text in file_header.attachments.items()
        }
        start_utc_ns = self._channels.shared_state[StateField.START_UTC_NS]
        self._writer.begin(
            start_utc_ns, file_header.metadata, file_header.segments, attachment_bytes_by_name
        )
        self.begun = True

    def transfer_records(self) -> bool:
        """Copy available records from the rings to the file, and return whether there were any."""
        self._channels.shared_state.beat(StateField.RECORDER_BEAT)
        if not self.begun:
            if self.header is None or not self._channels.shared_state[StateField.START_UTC_NS]:
                return False
            self._begin_file(self.header)
        has_transferred = False
        for ring, write_block in self._ring_writers:
            record_bytes = ring.take(_MAX_BLOCK_RECORDS)
            if record_bytes:
                write_block(record_bytes)
                has_transferred = True
        return has_transferred

    def _write_events(self, record_bytes: bytes) -> None:
        """Write a block of log events to the file."""
        for event in read_events(record_bytes):
            self._writer.log(event.t_ns, event.level, event.message)

    def _write_samples(self, record_bytes: bytes) -> None:
        """Write a block of samples to the file and count them."""
        self._writer.write_samples(record_bytes)
        self._recorded_samples += len(record_bytes) // SAMPLE_SIZE

    def close(
        self,
        outcome: Mapping[str, str],
        segments: Mapping[str, tuple[int, int]] = MappingProxyType({}),
    ) -> FileClosed:
        """Write the remaining records and the outcome, and close the file.

        Parameters
        ----------
        outcome
            Record ``outcome`` with the counts of the control loop.
        segments
            Segments that were not known before the record. They may extend beyond its last tick.
        """
        while self.transfer_records():
            pass
        accounted_ticks = self._recorded_samples + int(outcome["missed"])
        # A killed control process may not have counted its last sample.
        scheduled_ticks = max(int(outcome["scheduled"]), accounted_ticks)
        tick_counts = {
            "scheduled": scheduled_ticks,
            "recorded": self._recorded_samples,
            "lost": scheduled_ticks - accounted_ticks,
        }
        if tick_counts["lost"] and outcome["outcome"] == "complete":
            outcome = {
                **outcome,
                "outcome": "fault",
                "reason": "Samples were lost before the recorder.",
            }
        outcome_with_counts = {
            **outcome,
            **{count_name: str(tick_count) for count_name, tick_count in tick_counts.items()},
        }
        shared_state = self._channels.shared_state
        if self.header is not None and (
            shared_state[StateField.PLANNED_TICKS] or shared_state[StateField.LAST_SEGMENT]
        ):
            # Segments of a growing reference end with the record.
            segments = segments_until({**self.header.segments, **segments}, scheduled_ticks)
        closed_path = self._writer.close(outcome_with_counts, segments)
        return FileClosed(closed_path, tick_counts, outcome["outcome"], outcome["reason"])

    def close_without_supervisor(self) -> None:
        """Wait until the loop has stopped, and close the file without the supervisor's order."""
        shared_state = self._channels.shared_state
        self.transfer_records()  # all of the record may still be in the rings
        deadline_s = time.monotonic() + _ORPHAN_TIMEOUT_S
        while shared_state[StateField.PHASE] != Phase.OFF and time.monotonic() < deadline_s:
            if self.transfer_records():
                deadline_s = time.monotonic() + _ORPHAN_TIMEOUT_S
            time.sleep(_IDLE_PAUSE_S)
        if self.header is None or not self.begun:
            self._writer.discard()
            return
        scheduled_ticks = shared_state[StateField.SCHEDULED_TICKS]
        is_complete = covers_reference(
            shared_state, scheduled_ticks, max(end for _, end in self.header.segments.values())
        )
        self.close(
            {
                "outcome": "complete" if is_complete else "fault",
                "reason": "After the record: The supervising process ended."
                if is_complete
                else "The supervising process ended during the session.",
                "scheduled": str(scheduled_ticks),
                "missed": str(shared_state[StateField.MISSED_TICKS]),
                "late": str(shared_state[StateField.LATE_TICKS]),
                "stale_angles": str(shared_state[StateField.STALE_ANGLES]),
                "stale_wrenches": str(shared_state[StateField.STALE_WRENCHES]),
            }
        )


if __name__ == "__main__":
    main()
