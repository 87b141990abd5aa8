"""Writer of session files.

Samples, controller terms and ages of readings arrive as blocks of messages. They are written chunk
by chunk together with the events. An event that reports an error is written at once. Until the file
is complete, it has the suffix ``.part`` and a lock. It is then renamed to its final name, but never
replaces another file.
"""

import contextlib
import errno
import io
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

import rigd
from rigd.session._errors import SessionError, SessionExistsError
from rigd.session._mcap_writer import INDEX_DTYPE, MESSAGE_HEAD_FORMAT, RECORD_HEAD_SIZE, McapWriter
from rigd.session._schema import (
    CONTROL_SCHEMA,
    CONTROL_TOPIC,
    EVENT_LEVELS,
    EVENT_SCHEMA,
    EVENT_TOPIC,
    FORMAT_VERSION,
    SAMPLE_SCHEMA,
    SAMPLE_TOPIC,
    TIMING_SCHEMA,
    TIMING_TOPIC,
    TOUCH_SCHEMA,
    TOUCH_TOPIC,
    event_class,
    metadata_for_channel,
    schema_data,
)
from rigd.session.layout import (
    CONTROL_SIZE,
    CONTROL_WIRE_DTYPE,
    SAMPLE_SIZE,
    SAMPLE_WIRE_DTYPE,
    TIMING_SIZE,
    TIMING_WIRE_DTYPE,
    TOUCH_SIZE,
    TOUCH_WIRE_DTYPE,
    Buffer,
)

try:
    import fcntl
except ImportError:  # sessions are recorded on Linux, but read anywhere
    fcntl = None  # type: ignore[assignment]


PART_SUFFIX: Final = ".part"
"""Suffix that a session file has after its name until it is complete."""

MAX_CHUNK_SAMPLES: Final = 250
"""Maximum number of samples in a chunk, and thus of samples that a killed recorder loses."""
MAX_CHUNK_DURATION_S: Final = 0.25
"""Maximum time span of a chunk in seconds, and thus of what a killed recorder loses."""
SYNC_INTERVAL_S: Final = 1.0
"""Time in seconds between two syncs of the file to the disk, which a power failure may lose."""

_MESSAGE_HEAD_FIELDS: Final = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
"""NumPy fields of the head of an MCAP message record, in the order of `MESSAGE_HEAD_FORMAT`."""

_CHANNEL_NUMBERS_AND_SCHEMAS: Final = {
    SAMPLE_TOPIC: (1, SAMPLE_SCHEMA),
    CONTROL_TOPIC: (2, CONTROL_SCHEMA),
    TIMING_TOPIC: (3, TIMING_SCHEMA),
    EVENT_TOPIC: (4, EVENT_SCHEMA),
    TOUCH_TOPIC: (5, TOUCH_SCHEMA),
}
"""Topic → channel number in the file, and name of the channel's schema."""

_MEDIA_TYPES: Final = {".toml": "application/toml", ".json": "application/json"}
_LEVELS_SYNCED_AT_ONCE: Final = ("error", "fatal")


class _CountedFile(io.FileIO):
    """Binary file that counts the bytes written to it."""

    written_byte_count = 0
    """Number of bytes written so far."""

    def write(self, data: Any, /) -> int:  # noqa: ANN401 - any bytes-like object
        """Write bytes, and add their number to `written_byte_count`."""
        byte_count = super().write(data)
        self.written_byte_count += byte_count
        return byte_count


class SessionWriter:
    """Writer of a session file, ``NAME.mcap.part`` during the session and ``NAME.mcap`` afterwards.

    After `begin`, messages arrive in blocks. A chunk is written to the file with every 250th
    sample, and the file is synced to the disk once a second. A later failure does not destroy data
    that was written before.

    Parameters
    ----------
    path : final path of the session file

    Raises
    ------
    SessionExistsError
        If the file or its ``.part`` exists.
    SessionError
        If the file cannot be created.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = path = Path(path)
        self.part = path.with_name(path.name + PART_SUFFIX)
        self._samples = bytearray()
        self._controls = bytearray()
        self._timings = bytearray()
        self._touches = bytearray()
        self._samples_per_chunk = MAX_CHUNK_SAMPLES
        self._events: list[tuple[int, bytes]] = []  # log_time, message
        self._event_count = 0
        self._start_utc_ns = 0
        self._mcap: McapWriter | None = None
        self._last_sync_s = time.monotonic()
        self._is_sync_needed = False
        self._failed = False
        with self._io_errors_explained():
            try:
                # Append mode, so that the end detects bytes that another program has removed.
                open_flags = os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_APPEND
                file_descriptor = os.open(self.part, open_flags, 0o666)
            except FileExistsError:
                raise SessionExistsError(
                    f"{self.part} exists: another session is being recorded to it or was "
                    "interrupted. Choose another name or move that file away; nothing is "
                    "overwritten."
                ) from None
            self._counted_file = _CountedFile(file_descriptor, "wb")
            self._stream = io.BufferedWriter(self._counted_file)
            mark_as_being_written(file_descriptor)
            # Checked only now, to detect a writer that finishes in between.
            if os.path.lexists(path):
                self._stream.close()
                self.part.unlink()
                raise SessionExistsError(
                    f"{path} exists. Choose another name or move that file away; "
                    "nothing is overwritten."
                )

    @contextlib.contextmanager
    def _io_errors_explained(self) -> Iterator[None]:
        """Convert an OSError of the enclosed code to a SessionError with advice."""
        try:
            yield
        except OSError as error:
            self._failed = True
            raise SessionError(
                f"{self.part} cannot be written: {error.strerror or error}. Check that the folder "
                "exists, is writable and has space left."
            ) from error

    def begin(
        self,
        start_utc_ns: int,
        metadata: Mapping[str, str],
        segments: Mapping[str, tuple[int, int]],
        attachments: Mapping[str, bytes],
    ) -> None:
        """Begin the file with metadata, attachments and channels, before the first sample.

        Parameters
        ----------
        start_utc_ns : wall-clock time of tick 0, in nanoseconds since the Unix epoch
        metadata : record ``session``; ``format_version`` and ``start_utc_ns`` are added
        segments : record ``segments``: name → first tick and end tick (exclusive)
        attachments : file name → file contents
        """
        if self._mcap is not None:
            raise RuntimeError("begin() was called twice")
        self._start_utc_ns = start_utc_ns
        self._samples_per_chunk = _samples_per_chunk(metadata)
        with self._io_errors_explained():
            mcap_writer = McapWriter(self._stream, library=f"rigd {rigd.__version__}")
            session_record = {
                **metadata,
                "format_version": FORMAT_VERSION,
                "start_utc_ns": str(start_utc_ns),
            }
            segments_record = _segments_record(segments)
            mcap_writer.add_metadata("session", session_record)
            mcap_writer.add_metadata("segments", segments_record)
            for attachment_name, attachment_bytes in attachments.items():
                media_type = _MEDIA_TYPES.get(
                    Path(attachment_name).suffix, "application/octet-stream"
                )
                mcap_writer.add_attachment(
                    attachment_name, media_type, attachment_bytes, start_utc_ns
                )
            mcap_writer.declare(
                *_session_channels(metadata_for_channel(session_record, segments_record))
            )
            self._mcap = mcap_writer
            self._sync()
            fsync_directory(self.part.parent)

    def write_samples(self, packed_samples: Buffer) -> None:
        """Append packed samples: a multiple of ``SAMPLE_SIZE`` bytes, possibly 0."""
        remaining_bytes = self._checked_view(packed_samples, SAMPLE_SIZE)
        chunk_bytes = self._samples_per_chunk * SAMPLE_SIZE
        with self._io_errors_explained():
            while remaining_bytes:
                free_chunk_bytes = chunk_bytes - len(self._samples)
                self._samples += remaining_bytes[:free_chunk_bytes]
                remaining_bytes = remaining_bytes[free_chunk_bytes:]
                if len(self._samples) == chunk_bytes:
                    self._write_chunk(include_later_messages=False)
            self._sync_when_due()

    def write_controls(self, packed_controls: Buffer) -> None:
        """Append packed controller terms: a multiple of ``CONTROL_SIZE`` bytes, possibly 0.

        Call this before `write_samples` with the samples of the same time, so that both are written
        to the same chunk.
        """
        self._controls += self._checked_view(packed_controls, CONTROL_SIZE)
        with self._io_errors_explained():
            self._sync_when_due()

    def write_timings(self, packed_timings: Buffer) -> None:
        """Append packed ages of readings: a multiple of ``TIMING_SIZE`` bytes, possibly 0.

        Call this before `write_samples` with the samples of the same time, so that both are written
        to the same chunk.
        """
        self._timings += self._checked_view(packed_timings, TIMING_SIZE)
        with self._io_errors_explained():
            self._sync_when_due()

    def write_touches(self, packed_touches: Buffer) -> None:
        """Append packed touches, a multiple of ``TOUCH_SIZE`` bytes, to the current chunk."""
        self._touches += self._checked_view(packed_touches, TOUCH_SIZE)

    def log(self, t_ns: int, level: str, message: str, name: str = "rigd") -> None:
        """Record an event in the log of the session file.

        The event is written with the current chunk. An event of level "error" or "fatal" is written
        at once, together with all messages collected so far.

        Parameters
        ----------
        t_ns : time of the event in nanoseconds since the session start
        level : "debug", "info", "warning", "error" or "fatal"
        message : text for the operator
        name : process or component that logs the event
        """
        self._require_writer()
        log_time = self._start_utc_ns + t_ns
        seconds, nanoseconds = divmod(log_time, 10**9)
        event_message = event_class()(
            timestamp={"seconds": seconds, "nanos": nanoseconds},
            level=EVENT_LEVELS.index(level),
            message=message,
            name=name,
        )
        self._events.append((log_time, event_message.SerializeToString()))
        if level in _LEVELS_SYNCED_AT_ONCE:
            with self._io_errors_explained():
                self._write_chunk(include_later_messages=True)

    def close(
        self,
        outcome: Mapping[str, str],
        segments: Mapping[str, tuple[int, int]] = MappingProxyType({}),
    ) -> Path:
        """Write the record ``outcome``, complete the file, and rename it to its final path.

        Parameters
        ----------
        outcome : record ``outcome``: how the session ended, with the counts of ticks
        segments : segments that were unknown at the beginning, or that have changed

        Returns
        -------
        The final path.

        Raises
        ------
        SessionExistsError
            If another file with the final path was created during the session. The complete session
            then remains in the ``.part`` file.
        """
        mcap_writer = self._require_writer()
        with self._io_errors_explained():
            self._write_chunk(include_later_messages=True)
            if segments:
                mcap_writer.add_metadata("segments", _segments_record(segments))
            mcap_writer.add_metadata("outcome", outcome)
            mcap_writer.finish()
            self._sync()
            self._check_part_file()
            self._stream.close()
            try:
                rename_without_replacing(self.part, self.path)
            except FileExistsError:
                raise SessionExistsError(
                    f"{self.path} was created during the session and is not overwritten; the "
                    f"complete session is {self.part}, to be renamed."
                ) from None
            fsync_directory(self.path.parent)
        return self.path

    def abandon(self) -> Path | None:
        """Write the received data, and close the ``.part`` file as incomplete.

        If the file was deleted during the session, its contents are saved to the nearest writable
        parent folder.

        Returns
        -------
        Path of the file with the contents, or None if they could not be saved.

        Raises
        ------
        SessionError
            If the received data cannot be written. Data that was written before remains.
        """
        if self._stream.closed:
            return self.part
        try:
            if not self._failed:
                with self._io_errors_explained():
                    if self._mcap is not None:
                        self._write_chunk(include_later_messages=True)
                    self._stream.flush()
                    os.fsync(self._stream.fileno())
        finally:
            path_of_contents = self._path_of_contents()
            with contextlib.suppress(OSError):  # the failure to write was reported already
                self._stream.close()
        return path_of_contents

    def discard(self) -> None:
        """Remove the empty ``.part`` file of a session that was not begun."""
        if self._mcap is not None:
            raise RuntimeError("a session that was begun is not discarded")
        self._stream.close()
        with self._io_errors_explained():
            self.part.unlink(missing_ok=True)

    def _check_part_file(self) -> None:
        """Raise if the ``.part`` file was removed, moved, shortened or changed by another program.

        Writing would not report an error in such a case.
        """
        if not self._is_part_in_place():
            raise SessionError(
                f"{self.part} was removed or moved while it was recorded. Do not change the folder "
                "of a running session."
            )
        if os.fstat(self._stream.fileno()).st_size != self._counted_file.written_byte_count:
            raise SessionError(
                f"{self.part} was shortened or written to by another program while it was "
                "recorded. Do not change the files of a running session."
            )

    def _is_part_in_place(self) -> bool:
        """Return whether the path of the ``.part`` file still refers to the open file."""
        try:
            return os.path.samestat(self.part.stat(), os.fstat(self._stream.fileno()))
        except OSError:
            return False

    def _path_of_contents(self) -> Path | None:
        """Return the path of the recorded contents; copy them to a new file if it was deleted.

        Returns None if the contents could not be saved.
        """
        file_descriptor = self._stream.fileno()
        if self._is_part_in_place():
            return self.part
        if os.fstat(file_descriptor).st_nlink:
            with contextlib.suppress(OSError):
                return Path(f"/proc/self/fd/{file_descriptor}").readlink()
            return None
        for folder in self.part.absolute().parents:
            with contextlib.suppress(OSError):  # missing, not writable, full, or name exists
                copy_path = folder / self.part.name
                copy_new(file_descriptor, copy_path)
                return copy_path
        return None

    def _require_writer(self) -> McapWriter:
        """Return the MCAP writer; raise if `begin` was not called or writing has failed."""
        if self._mcap is None:
            raise RuntimeError("begin() comes first")
        if self._failed:
            # Part of a record may be in the file: nothing after it could be read.
            raise SessionError(f"{self.part}: writing failed before, the recording ends there.")
        return self._mcap

    def _checked_view(self, packed_messages: Buffer, message_size: int) -> memoryview:
        """Return a view of encoded messages; raise if the last message is incomplete."""
        self._require_writer()
        block_view = memoryview(packed_messages).cast("B")
        if len(block_view) % message_size:
            raise ValueError(
                f"a block of {len(block_view)} bytes is not a whole number of "
                f"{message_size}-byte messages"
            )
        return block_view

    def _write_chunk(self, *, include_later_messages: bool) -> None:
        """Write the collected messages as one chunk.

        Controller terms and ages of readings that are later than the last sample are written with
        the next chunk, unless `include_later_messages` is True.
        """
        mcap_writer = self._require_writer()
        samples = np.frombuffer(self._samples, SAMPLE_WIRE_DTYPE)
        controls = np.frombuffer(self._controls, CONTROL_WIRE_DTYPE)
        timings = np.frombuffer(self._timings, TIMING_WIRE_DTYPE)
        if not include_later_messages:
            controls, timings = (
                messages[: np.searchsorted(messages["t_ns"], samples["t_ns"][-1], side="right")]
                for messages in (controls, timings)
            )
        chunk_parts: list[bytes] = []
        message_indexes: dict[int, npt.NDArray[np.void]] = {}
        chunk_offset = 0
        for topic, wire_messages in (
            (SAMPLE_TOPIC, samples),
            (CONTROL_TOPIC, controls),
            (TIMING_TOPIC, timings),
            (TOUCH_TOPIC, np.frombuffer(self._touches, TOUCH_WIRE_DTYPE)),
        ):
            if len(wire_messages):
                channel, _ = _CHANNEL_NUMBERS_AND_SCHEMAS[topic]
                records = _message_records(wire_messages, channel, self._start_utc_ns)
                chunk_parts.append(records.tobytes())
                message_indexes[channel] = _message_index(records, chunk_offset)
                chunk_offset += records.nbytes
        if self._events:
            channel, _ = _CHANNEL_NUMBERS_AND_SCHEMAS[EVENT_TOPIC]
            event_records, message_indexes[channel] = _event_records(
                self._events, channel, self._event_count, chunk_offset
            )
            chunk_parts.append(event_records)
            self._event_count += len(self._events)
        if message_indexes:
            mcap_writer.add_chunk(b"".join(chunk_parts), message_indexes)
            self._stream.flush()
            self._is_sync_needed = True
        self._samples = bytearray()
        self._controls = self._controls[controls.nbytes :]
        self._timings = self._timings[timings.nbytes :]
        self._touches = bytearray()
        self._events = []

    def _sync_when_due(self) -> None:
        """Sync the file to the disk if it has changed and the last sync is a second or more ago."""
        if self._is_sync_needed and time.monotonic() - self._last_sync_s >= SYNC_INTERVAL_S:
            self._sync()
            self._check_part_file()

    def _sync(self) -> None:
        """Write all buffered bytes of the file to the disk."""
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._last_sync_s = time.monotonic()
        self._is_sync_needed = False


def _message_records(
    wire_messages: npt.NDArray[np.void], channel_id: int, start_utc_ns: int
) -> npt.NDArray[np.void]:
    """Return the MCAP message records (n,) that contain the encoded messages (n,)."""
    message_records = np.empty(
        wire_messages.shape, [*_MESSAGE_HEAD_FIELDS, ("data", wire_messages.dtype)]
    )
    message_records["opcode"] = Opcode.MESSAGE
    message_records["length"] = message_records.dtype.itemsize - RECORD_HEAD_SIZE
    message_records["channel"] = channel_id
    message_records["sequence"] = wire_messages["tick"]
    message_records["log_time"] = wire_messages["t_ns"] + start_utc_ns
    message_records["publish_time"] = message_records["log_time"]
    message_records["data"] = wire_messages
    return message_records


def _message_index(
    message_records: npt.NDArray[np.void], chunk_offset: int
) -> npt.NDArray[np.void]:
    """Return the message index of equally long records that begin at `chunk_offset` in a chunk."""
    message_index = np.empty(message_records.shape, INDEX_DTYPE)
    message_index["log_time"] = message_records["log_time"]
    message_index["offset"] = chunk_offset + message_records.dtype.itemsize * np.arange(
        len(message_records)
    )
    return message_index


def _event_records(
    events: Sequence[tuple[int, bytes]], channel_id: int, first_sequence: int, chunk_offset: int
) -> tuple[bytes, npt.NDArray[np.void]]:
    """Return the message records of events (log time in ns, message), and their message index."""
    event_records = b""
    message_index = np.empty(len(events), INDEX_DTYPE)
    for i, (log_time, message_data) in enumerate(events):
        message_index[i] = (log_time, chunk_offset + len(event_records))
        record_length = MESSAGE_HEAD_FORMAT.size - RECORD_HEAD_SIZE + len(message_data)
        event_records += MESSAGE_HEAD_FORMAT.pack(
            Opcode.MESSAGE, record_length, channel_id, first_sequence + i, log_time, log_time
        )
        event_records += message_data
    return event_records, message_index


def _segments_record(segments: Mapping[str, tuple[int, int]]) -> dict[str, str]:
    """Return the record ``segments``: name → "first,end" in ticks."""
    return {
        segment_name: f"{first_tick},{end}" for segment_name, (first_tick, end) in segments.items()
    }


def _samples_per_chunk(metadata: Mapping[str, str]) -> int:
    """Return the number of samples per chunk: fewer than the maximum at a low sample rate."""
    try:
        samples_in_interval = int(float(metadata.get("rate_hz", "inf")) * MAX_CHUNK_DURATION_S)
    except (ValueError, OverflowError):
        return MAX_CHUNK_SAMPLES
    return min(max(samples_in_interval, 1), MAX_CHUNK_SAMPLES)


def _session_channels(metadata: Mapping[str, str]) -> tuple[list[Schema], list[Channel]]:
    """Return schemas and channels of a session, with a copy of its metadata in one channel."""
    schemas, channels = [], []
    for topic, (channel_number, schema_name) in _CHANNEL_NUMBERS_AND_SCHEMAS.items():
        schemas.append(
            Schema(
                id=channel_number,
                name=schema_name,
                encoding="protobuf",
                data=schema_data(schema_name),
            )
        )
        channels.append(
            Channel(
                id=channel_number,
                topic=topic,
                message_encoding="protobuf",
                schema_id=channel_number,
                metadata=dict(metadata) if topic == SAMPLE_TOPIC else {},
            )
        )
    return schemas, channels


# New files on the disk

_COPY_BLOCK_BYTES: Final = 1 << 20
"""Number of bytes that `copy_new` reads at once."""


def fsync_directory(path: Path) -> None:
    """Write the entries of a folder to the disk, so that a new or renamed file survives a crash.

    On Windows, which cannot open folders, this is neither possible nor necessary.
    """
    if not hasattr(os, "O_DIRECTORY"):
        return
    folder_descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder_descriptor)
    finally:
        os.close(folder_descriptor)


def copy_new(source_descriptor: int, target_path: Path) -> None:
    """Copy the contents of an open file to a new file, and sync the new file to the disk.

    Raises FileExistsError if `target_path` exists.
    """
    with target_path.open("xb") as target_descriptor:
        try:
            copied_byte_count = 0
            while block_bytes := os.pread(source_descriptor, _COPY_BLOCK_BYTES, copied_byte_count):
                target_descriptor.write(block_bytes)
                copied_byte_count += len(block_bytes)
            target_descriptor.flush()
            os.fsync(target_descriptor.fileno())
        except OSError:
            target_path.unlink()
            raise


def rename_without_replacing(source: Path, target: Path) -> None:
    """Rename a file without ever replacing another file.

    Parameters
    ----------
    source
        Path of the file.
    target
        New path on the same disk.

    Raises
    ------
    FileExistsError
        If `target` exists.
    """
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK):
            raise
        # A file system without hard links (FAT, some network drives): create an empty file, which
        # fails if the name exists, and replace that file.
        os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        try:
            source.replace(target)
        except OSError:
            with contextlib.suppress(OSError):
                target.unlink()  # the empty file would prevent a recovery to that name
            raise
    else:
        source.unlink()


def mark_as_being_written(file_descriptor: int) -> None:
    """Lock an open file, which states that it is being written until it is closed.

    The lock is advisory, and ends with this process. On a file system without locks this does
    nothing.
    """
    if fcntl is not None:
        with contextlib.suppress(OSError):
            fcntl.flock(file_descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_being_written(path: Path) -> bool:
    """Return whether the lock of `mark_as_being_written` shows that a file is being written."""
    if fcntl is None:
        return False
    try:
        file_descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # opening a pipe would block
    except OSError:
        return False
    try:
        fcntl.flock(file_descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    else:
        return False
    finally:
        os.close(file_descriptor)
