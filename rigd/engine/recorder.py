"""The recorder process: it writes the records of the rings to the session file.

It opens the file before anything moves, writes what the loop publishes as fast as the disk allows,
and closes the file with the outcome. If the supervisor dies, it waits until the loop has stopped
and then closes the file itself.
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
from rigd.engine.messages import Armed, Close, Closed, Failed, FileHeader, Opened, RecorderJob
from rigd.engine.processes import Parent
from rigd.engine.realtime import Precedence
from rigd.engine.reference import is_whole
from rigd.engine.shared_state import Phase, SharedState, StateField, read_events
from rigd.runtime import ignore as ignore_signals
from rigd.session import SessionError, SessionExistsError, SessionWriter, segments_until
from rigd.session.layout import SAMPLE_SIZE

_BLOCK = 250
_IDLE_S = 0.005
_ORPHAN_PATIENCE_S = 3.0
_DISK_POLL_S = 1.0


def main() -> None:
    """Run as ``python -m rigd.engine.recorder``."""
    ignore_signals()
    parent = Parent()
    job: RecorderJob = parent.receive_job()
    channels = attach_channels(job.channels)
    obtained = {}
    if job.realtime is not None:
        obtained = Precedence(job.realtime.supervision_priority, job.realtime.cpu).take()
    try:
        writer = SessionWriter(job.path)
    except SessionError as error:
        parent.send(Failed(str(error), taken=isinstance(error, SessionExistsError)))
        raise SystemExit(1) from None
    _show_free_space(channels.shared_state, job.path.parent)
    parent.send(Opened(obtained))
    try:
        _record(parent, channels, writer, job.path.parent)
    except SessionError as error:
        text, saved = _abandoned(writer)
        parent.send(Failed(f"{error}{text}", saved_path=saved))
        raise SystemExit(1) from None


def _abandoned(writer: SessionWriter) -> tuple[str, Path | None]:
    """Abandon a recording; return a sentence and the path of the data, if not at its own name."""
    try:
        saved = writer.abandon()
    except SessionError:
        return "", None  # disk full, device gone: what reached the disk stays there
    if saved == writer.part:
        return "", None
    if saved is None:
        return " What was recorded could not be saved elsewhere.", None
    return (
        f" What was recorded is now {saved}; rigd recover {shlex.quote(str(saved))} makes "
        "a session file of it.",
        saved,
    )


def _record(parent: Parent, channels: Channels, writer: SessionWriter, folder: Path) -> None:
    recorder = Recorder(channels, writer)
    polled_s = time.monotonic()
    while True:
        moved = recorder.transfer()
        if time.monotonic() - polled_s > _DISK_POLL_S:
            polled_s = time.monotonic()
            _show_free_space(channels.shared_state, folder)
        try:
            message = parent.poll(0.0 if moved else _IDLE_S)
        except EOFError:
            recorder.finish_orphaned()
            return
        match message:
            case FileHeader():
                recorder.header = message
                parent.send(Armed())
            case Close(outcome, touches, segments):
                recorder.transfer()
                if recorder.begun:
                    writer.write_touches(touches)
                    parent.send(recorder.close(outcome, segments))
                else:
                    writer.discard()
                    parent.send(Closed())
                return


def _show_free_space(shared_state: SharedState, folder: Path) -> None:
    """Publish the free disk space; the next write reports a folder that is gone."""
    with contextlib.suppress(OSError):
        shared_state[StateField.DISK_FREE_MB] = max(1, ceil(shutil.disk_usage(folder).free / 1e6))


class Recorder:
    """Writer of the rings' records to a session file.

    Parameters
    ----------
    channels
        Attached channels.
    writer
        Writer of the file, not yet begun.

    Attributes
    ----------
    begun
        Whether the record and the file have begun.
    """

    def __init__(self, channels: Channels, writer: SessionWriter) -> None:
        self._channels = channels
        self._writer = writer
        writers: dict[Topic, Callable[[bytes], None]] = {
            EVENT: self._log,
            CONTROL: writer.write_controls,
            TIMING: writer.write_timings,
            SAMPLE: self._write_samples,
        }
        self._ways = [
            (ring, writers[topic])
            for topic, ring in zip(TOPICS, channels.rings, strict=True)
            if topic.logged
        ]
        self._recorded = 0
        self.header: FileHeader | None = None
        """Header of the session; None until the supervisor has sent it."""
        self.begun = False

    def _begin(self, header: FileHeader) -> None:
        attachments = {name: text.encode() for name, text in header.attachments.items()}
        start_utc_ns = self._channels.shared_state[StateField.START_UTC_NS]
        self._writer.begin(start_utc_ns, header.metadata, header.segments, attachments)
        self.begun = True

    def transfer(self) -> bool:
        """Write the available records to the file; return whether there were any."""
        self._channels.shared_state.beat(StateField.RECORDER_BEAT)
        if not self.begun:
            if self.header is None or not self._channels.shared_state[StateField.START_UTC_NS]:
                return False
            self._begin(self.header)
        moved = False
        for ring, write in self._ways:
            block = ring.take(_BLOCK)
            if block:
                write(block)
                moved = True
        return moved

    def _log(self, block: bytes) -> None:
        for event in read_events(block):
            self._writer.log(event.t_ns, event.level, event.message)

    def _write_samples(self, block: bytes) -> None:
        self._writer.write_samples(block)
        self._recorded += len(block) // SAMPLE_SIZE

    def close(
        self,
        outcome: Mapping[str, str],
        segments: Mapping[str, tuple[int, int]] = MappingProxyType({}),
    ) -> Closed:
        """Write the remaining records and the outcome, and close the file.

        Parameters
        ----------
        outcome
            Outcome as reported by the loop.
        segments
            Segments that were not known before the record; they may extend beyond its end.
        """
        while self.transfer():
            pass
        accounted = self._recorded + int(outcome["missed"])
        # A killed control process may not have counted its last sample.
        scheduled = max(int(outcome["scheduled"]), accounted)
        counts = {
            "scheduled": scheduled,
            "recorded": self._recorded,
            "lost": scheduled - accounted,
        }
        if counts["lost"] and outcome["outcome"] == "complete":
            outcome = {
                **outcome,
                "outcome": "fault",
                "reason": "Samples were lost before the recorder.",
            }
        counted = {**outcome, **{name: str(count) for name, count in counts.items()}}
        shared_state = self._channels.shared_state
        if self.header is not None and (
            shared_state[StateField.PLANNED] or shared_state[StateField.LAST_SEGMENT]
        ):
            # Segments of a growing reference end with the record.
            segments = segments_until({**self.header.segments, **segments}, scheduled)
        path = self._writer.close(counted, segments)
        return Closed(path, counts, outcome["outcome"], outcome["reason"])

    def finish_orphaned(self) -> None:
        """Close the file after the loop has stopped, because the supervisor is gone."""
        shared_state = self._channels.shared_state
        self.transfer()  # all of the record may still be in the rings
        deadline = time.monotonic() + _ORPHAN_PATIENCE_S
        while shared_state[StateField.PHASE] != Phase.OFF and time.monotonic() < deadline:
            if self.transfer():
                deadline = time.monotonic() + _ORPHAN_PATIENCE_S
            time.sleep(_IDLE_S)
        if self.header is None or not self.begun:
            self._writer.discard()
            return
        scheduled = shared_state[StateField.SCHEDULED]
        whole = is_whole(
            shared_state, scheduled, max(end for _, end in self.header.segments.values())
        )
        self.close(
            {
                "outcome": "complete" if whole else "fault",
                "reason": "After the record: The supervising process ended."
                if whole
                else "The supervising process ended during the session.",
                "scheduled": str(scheduled),
                "missed": str(shared_state[StateField.MISSED]),
                "late": str(shared_state[StateField.LATE]),
                "stale_angles": str(shared_state[StateField.STALE_ANGLES]),
                "stale_wrenches": str(shared_state[StateField.STALE_WRENCHES]),
            }
        )


if __name__ == "__main__":
    main()
