"""The recorder process: from the rings to the session file.

It opens the file before anything moves, takes what the loop publishes as fast as the disk lets
it, and closes the file with the outcome. If the supervisor dies it waits until the loop has
stopped, and closes the file itself.
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
from rigd.engine.shared_state import Phase, SharedState, Word, read_events
from rigd.runtime import ignore as ignore_signals
from rigd.session import SessionError, SessionExistsError, SessionWriter, segments_until
from rigd.session.layout import SAMPLE_SIZE

_BLOCK = 250
_IDLE_S = 0.005
_ORPHAN_PATIENCE_S = 3.0
_DISK_LOOK_S = 1.0


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
    _show_free_space(channels.board, job.path.parent)
    parent.send(Opened(obtained))
    try:
        _record(parent, channels, writer, job.path.parent)
    except SessionError as error:
        text, kept = _abandoned(writer)
        parent.send(Failed(f"{error}{text}", kept=kept))
        raise SystemExit(1) from None


def _abandoned(writer: SessionWriter) -> tuple[str, Path | None]:
    """End a recording that cannot go on; say where its contents are if not under their name."""
    try:
        kept = writer.abandon()
    except SessionError:
        return "", None  # disk full, device gone: what reached the disk stays there
    if kept == writer.part:
        return "", None
    if kept is None:
        return " What was recorded could not be saved elsewhere.", None
    return (
        f" What was recorded is now {kept}; rigd recover {shlex.quote(str(kept))} makes "
        "a session file of it.",
        kept,
    )


def _record(parent: Parent, channels: Channels, writer: SessionWriter, folder: Path) -> None:
    recorder = Recorder(channels, writer)
    looked_s = time.monotonic()
    while True:
        moved = recorder.transfer()
        if time.monotonic() - looked_s > _DISK_LOOK_S:
            looked_s = time.monotonic()
            _show_free_space(channels.board, folder)
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


def _show_free_space(board: SharedState, folder: Path) -> None:
    """Let the loop know; a folder that has gone is told by the next write."""
    with contextlib.suppress(OSError):
        board[Word.DISK_FREE_MB] = max(1, ceil(shutil.disk_usage(folder).free / 1e6))


class Recorder:
    """From the rings into a file.

    Parameters
    ----------
    channels
        Attached.
    writer
        Writer of the file, not yet begun.

    Attributes
    ----------
    begun
        The record has begun, and so has the file.
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
        start_utc_ns = self._channels.board[Word.START_UTC_NS]
        self._writer.begin(start_utc_ns, header.metadata, header.segments, attachments)
        self.begun = True

    def transfer(self) -> bool:
        """Move what is there into the file; say whether there was anything."""
        self._channels.board.beat(Word.RECORDER_BEAT)
        if not self.begun:
            if self.header is None or not self._channels.board[Word.START_UTC_NS]:
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
        """Write the rest and what is known at the end.

        Parameters
        ----------
        outcome
            As of the loop.
        segments
            Segments that were not known before the record; they may go on beyond it.
        """
        while self.transfer():
            pass
        accounted = self._recorded + int(outcome["missed"])
        # A control process that was killed may have left before it counted its last sample.
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
        board = self._channels.board
        if self.header is not None and (board[Word.PLANNED] or board[Word.LAST_PIECE]):
            # Of a reference that grows, nothing was planned beyond the end of the record.
            segments = segments_until({**self.header.segments, **segments}, scheduled)
        path = self._writer.close(counted, segments)
        return Closed(path, counts, outcome["outcome"], outcome["reason"])

    def finish_orphaned(self) -> None:
        """Close what there is once the loop has stopped, the supervisor being gone."""
        board = self._channels.board
        self.transfer()  # the whole record may still be in the rings
        deadline = time.monotonic() + _ORPHAN_PATIENCE_S
        while board[Word.PHASE] != Phase.OFF and time.monotonic() < deadline:
            if self.transfer():
                deadline = time.monotonic() + _ORPHAN_PATIENCE_S
            time.sleep(_IDLE_S)
        if self.header is None or not self.begun:
            self._writer.discard()
            return
        scheduled = board[Word.SCHEDULED]
        whole = is_whole(board, scheduled, max(end for _, end in self.header.segments.values()))
        self.close(
            {
                "outcome": "complete" if whole else "fault",
                "reason": "After the record: The supervising process ended."
                if whole
                else "The supervising process ended during the session.",
                "scheduled": str(scheduled),
                "missed": str(board[Word.MISSED]),
                "late": str(board[Word.LATE]),
                "stale_angles": str(board[Word.STALE_ANGLES]),
                "stale_wrenches": str(board[Word.STALE_WRENCHES]),
            }
        )


if __name__ == "__main__":
    main()
