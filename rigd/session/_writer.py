"""Writer of session files.

Samples, controls and timings arrive as blocks of records and are written chunk by chunk, with the
events; an error is written at once. The file has the suffix ``.part`` and a lock until it is
complete, and is then renamed to its final name, never over another file.
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
from rigd.session._mcap_writer import INDEX_DTYPE, MESSAGE_HEAD, RECORD_HEAD_SIZE, McapWriter
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
    protected_metadata,
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

CHUNK_SAMPLES: Final = 250
CHUNK_S: Final = 0.25
"""Samples and time per chunk: a killed recorder loses at most the lesser of the two."""
SYNC_INTERVAL_S: Final = 1.0
"""Wall time between two syncs to the disk: the additional loss if the host fails."""

_MESSAGE_HEAD_FIELDS: Final = [
    ("opcode", "u1"),
    ("length", "<u8"),
    ("channel", "<u2"),
    ("sequence", "<u4"),
    ("log_time", "<u8"),
    ("publish_time", "<u8"),
]
"""`MESSAGE_HEAD` as numpy fields."""

_CHANNELS: Final = {
    SAMPLE_TOPIC: (1, SAMPLE_SCHEMA),
    CONTROL_TOPIC: (2, CONTROL_SCHEMA),
    TIMING_TOPIC: (3, TIMING_SCHEMA),
    EVENT_TOPIC: (4, EVENT_SCHEMA),
    TOUCH_TOPIC: (5, TOUCH_SCHEMA),
}
"""Topic → number of the channel in the file, and name of its schema."""

_MEDIA_TYPES: Final = {".toml": "application/toml", ".json": "application/json"}
_URGENT: Final = ("error", "fatal")


class _CountedFile(io.FileIO):
    """A file that counts the bytes written to it."""

    written = 0

    def write(self, data: Any, /) -> int:  # noqa: ANN401 - any bytes-like object
        """Write and count."""
        count = super().write(data)
        self.written += count
        return count


class SessionWriter:
    """Writes one session, durably, to ``NAME.mcap.part`` and in the end to ``NAME.mcap``.

    After `begin`, messages arrive in blocks. A chunk goes to the file with every 250th sample, and
    the file to the disk once a second; data once written is never lost to a later failure.

    Parameters
    ----------
    path : the final name

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
        self._chunk_samples = CHUNK_SAMPLES
        self._events: list[tuple[int, bytes]] = []  # log_time, message
        self._event_count = 0
        self._start_utc_ns = 0
        self._mcap: McapWriter | None = None
        self._synced_at = time.monotonic()
        self._dirty = False
        self._failed = False
        with self._explained():
            try:
                # Append mode, so that the end detects bytes that another program has removed.
                flags = os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_APPEND
                descriptor = os.open(self.part, flags, 0o666)
            except FileExistsError:
                raise SessionExistsError(
                    f"{self.part} exists: another session is being recorded to it or was "
                    "interrupted. Choose another name or move that file away; nothing is "
                    "overwritten."
                ) from None
            self._raw = _CountedFile(descriptor, "wb")
            self._stream = io.BufferedWriter(self._raw)
            mark_as_written(descriptor)
            # Checked only now, to detect a writer that finishes in between.
            if os.path.lexists(path):
                self._stream.close()
                self.part.unlink()
                raise SessionExistsError(
                    f"{path} exists. Choose another name or move that file away; "
                    "nothing is overwritten."
                )

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
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
        """Write the data known before the first tick.

        Parameters
        ----------
        start_utc_ns : wall clock at tick 0, ns since the Unix epoch
        metadata : the record ``session``; ``format_version`` and ``start_utc_ns`` are added
        segments : name → first tick and end (exclusive): the record ``segments``
        attachments : file name → contents
        """
        if self._mcap is not None:
            raise RuntimeError("begin() was called twice")
        self._start_utc_ns = start_utc_ns
        self._chunk_samples = _chunk_samples(metadata)
        with self._explained():
            mcap = McapWriter(self._stream, library=f"rigd {rigd.__version__}")
            session = {
                **metadata,
                "format_version": FORMAT_VERSION,
                "start_utc_ns": str(start_utc_ns),
            }
            ticks = _segment_texts(segments)
            mcap.add_metadata("session", session)
            mcap.add_metadata("segments", ticks)
            for name, data in attachments.items():
                media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
                mcap.add_attachment(name, media_type, data, start_utc_ns)
            mcap.declare(*_session_channels(protected_metadata(session, ticks)))
            self._mcap = mcap
            self._sync()
            fsync_directory(self.part.parent)

    def write_samples(self, block: Buffer) -> None:
        """Append n × ``SAMPLE_SIZE`` bytes of packed samples (n may be 0)."""
        arrived = self._checked(block, SAMPLE_SIZE)
        chunk_size = self._chunk_samples * SAMPLE_SIZE
        with self._explained():
            while arrived:
                taken = chunk_size - len(self._samples)
                self._samples += arrived[:taken]
                arrived = arrived[taken:]
                if len(self._samples) == chunk_size:
                    self._write_chunk(everything=False)
            self._sync_when_due()

    def write_controls(self, block: Buffer) -> None:
        """Append n × ``CONTROL_SIZE`` bytes of packed control messages (n may be 0).

        They go into the same chunk as the samples of that time if written before these.
        """
        self._controls += self._checked(block, CONTROL_SIZE)
        with self._explained():
            self._sync_when_due()

    def write_timings(self, block: Buffer) -> None:
        """Append n × ``TIMING_SIZE`` bytes of packed ages, as `write_controls` does."""
        self._timings += self._checked(block, TIMING_SIZE)
        with self._explained():
            self._sync_when_due()

    def write_touches(self, block: Buffer) -> None:
        """Append n × ``TOUCH_SIZE`` bytes of packed touches, which go into the current chunk."""
        self._touches += self._checked(block, TOUCH_SIZE)

    def log(self, t_ns: int, level: str, message: str, name: str = "rigd") -> None:
        """Record an event in the file.

        It is written with the current chunk; an error or a fatal one at once, together with the
        chunk so far.

        Parameters
        ----------
        t_ns : ns since the session start
        level : "debug", "info", "warning", "error" or "fatal"
        message : text for the operator
        name : process or part that logs it
        """
        self._begun()
        log_time = self._start_utc_ns + t_ns
        seconds, nanos = divmod(log_time, 10**9)
        event = event_class()(
            timestamp={"seconds": seconds, "nanos": nanos},
            level=EVENT_LEVELS.index(level),
            message=message,
            name=name,
        )
        self._events.append((log_time, event.SerializeToString()))
        if level in _URGENT:
            with self._explained():
                self._write_chunk(everything=True)

    def close(
        self,
        outcome: Mapping[str, str],
        segments: Mapping[str, tuple[int, int]] = MappingProxyType({}),
    ) -> Path:
        """Write the record ``outcome``, complete the file and give it its final name.

        Parameters
        ----------
        outcome : the record ``outcome``
        segments : those that were unknown at the beginning, or have changed

        Returns
        -------
        The final name.

        Raises
        ------
        SessionExistsError
            If a file of that name has appeared meanwhile; the complete session then has the name
            with ``.part``.
        """
        mcap = self._begun()
        with self._explained():
            self._write_chunk(everything=True)
            if segments:
                mcap.add_metadata("segments", _segment_texts(segments))
            mcap.add_metadata("outcome", outcome)
            mcap.finish()
            self._sync()
            self._check_part_file()
            self._stream.close()
            try:
                rename_new(self.part, self.path)
            except FileExistsError:
                raise SessionExistsError(
                    f"{self.path} was created during the session and is not overwritten; the "
                    f"complete session is {self.part}, to be renamed."
                ) from None
            fsync_directory(self.path.parent)
        return self.path

    def abandon(self) -> Path | None:
        """Write the received data and leave the ``.part`` file without an end.

        If it was removed, its contents, which exist while it is open, are saved to the nearest
        writable folder above.

        Returns
        -------
        Path of the contents; None if they could not be saved.

        Raises
        ------
        SessionError
            If the received data cannot be written; earlier data stays.
        """
        if self._stream.closed:
            return self.part
        try:
            if not self._failed:
                with self._explained():
                    if self._mcap is not None:
                        self._write_chunk(everything=True)
                    self._stream.flush()
                    os.fsync(self._stream.fileno())
        finally:
            saved = self._saved_path()
            with contextlib.suppress(OSError):  # the failure to write was reported already
                self._stream.close()
        return saved

    def discard(self) -> None:
        """Remove the ``.part`` of a session that was never begun."""
        if self._mcap is not None:
            raise RuntimeError("a session that was begun is not discarded")
        self._stream.close()
        with self._explained():
            self.part.unlink(missing_ok=True)

    def _check_part_file(self) -> None:
        """Check that the file has its name and the length of the data written to it.

        Writing to a removed or shortened file would still succeed.
        """
        if not self._has_its_name():
            raise SessionError(
                f"{self.part} was removed or moved while it was recorded. Do not change the folder "
                "of a running session."
            )
        if os.fstat(self._stream.fileno()).st_size != self._raw.written:
            raise SessionError(
                f"{self.part} was shortened or written to by another program while it was "
                "recorded. Do not change the files of a running session."
            )

    def _has_its_name(self) -> bool:
        try:
            return os.path.samestat(self.part.stat(), os.fstat(self._stream.fileno()))
        except OSError:
            return False

    def _saved_path(self) -> Path | None:
        """Return the path of the contents, saving them elsewhere if the file was removed."""
        descriptor = self._stream.fileno()
        if self._has_its_name():
            return self.part
        if os.fstat(descriptor).st_nlink:
            with contextlib.suppress(OSError):
                return Path(f"/proc/self/fd/{descriptor}").readlink()
            return None
        for folder in self.part.absolute().parents:
            with contextlib.suppress(OSError):  # missing, not writable, full, or name exists
                copy = folder / self.part.name
                copy_new(descriptor, copy)
                return copy
        return None

    def _begun(self) -> McapWriter:
        if self._mcap is None:
            raise RuntimeError("begin() comes first")
        if self._failed:
            # Part of a record may be in the file: nothing after it could be read.
            raise SessionError(f"{self.part}: writing failed before, the recording ends there.")
        return self._mcap

    def _checked(self, block: Buffer, size: int) -> memoryview:
        self._begun()
        view = memoryview(block).cast("B")
        if len(view) % size:
            raise ValueError(
                f"a block of {len(view)} bytes is not a whole number of {size}-byte messages"
            )
        return view

    def _write_chunk(self, *, everything: bool) -> None:
        """Write the collected messages as a chunk.

        Controls and timings wait for the samples of the same time, unless `everything` is written.
        """
        mcap = self._begun()
        samples = np.frombuffer(self._samples, SAMPLE_WIRE_DTYPE)
        controls = np.frombuffer(self._controls, CONTROL_WIRE_DTYPE)
        timings = np.frombuffer(self._timings, TIMING_WIRE_DTYPE)
        if not everything:
            controls, timings = (
                others[: np.searchsorted(others["t_ns"], samples["t_ns"][-1], side="right")]
                for others in (controls, timings)
            )
        parts: list[bytes] = []
        indexes: dict[int, npt.NDArray[np.void]] = {}
        offset = 0
        for topic, wire in (
            (SAMPLE_TOPIC, samples),
            (CONTROL_TOPIC, controls),
            (TIMING_TOPIC, timings),
            (TOUCH_TOPIC, np.frombuffer(self._touches, TOUCH_WIRE_DTYPE)),
        ):
            if len(wire):
                channel, _ = _CHANNELS[topic]
                records = _fixed_records(wire, channel, self._start_utc_ns)
                parts.append(records.tobytes())
                indexes[channel] = _fixed_index(records, offset)
                offset += records.nbytes
        if self._events:
            channel, _ = _CHANNELS[EVENT_TOPIC]
            events, indexes[channel] = _event_records(
                self._events, channel, self._event_count, offset
            )
            parts.append(events)
            self._event_count += len(self._events)
        if indexes:
            mcap.add_chunk(b"".join(parts), indexes)
            self._stream.flush()
            self._dirty = True
        self._samples = bytearray()
        self._controls = self._controls[controls.nbytes :]
        self._timings = self._timings[timings.nbytes :]
        self._touches = bytearray()
        self._events = []

    def _sync_when_due(self) -> None:
        if self._dirty and time.monotonic() - self._synced_at >= SYNC_INTERVAL_S:
            self._sync()
            self._check_part_file()

    def _sync(self) -> None:
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._synced_at = time.monotonic()
        self._dirty = False


def _fixed_records(
    wire: npt.NDArray[np.void], channel: int, start_utc_ns: int
) -> npt.NDArray[np.void]:
    """Put the head of an MCAP message record before each message (n,) of a wire dtype."""
    records = np.empty(wire.shape, [*_MESSAGE_HEAD_FIELDS, ("data", wire.dtype)])
    records["opcode"] = Opcode.MESSAGE
    records["length"] = records.dtype.itemsize - RECORD_HEAD_SIZE
    records["channel"] = channel
    records["sequence"] = wire["tick"]
    records["log_time"] = wire["t_ns"] + start_utc_ns
    records["publish_time"] = records["log_time"]
    records["data"] = wire
    return records


def _fixed_index(records: npt.NDArray[np.void], offset: int) -> npt.NDArray[np.void]:
    index = np.empty(records.shape, INDEX_DTYPE)
    index["log_time"] = records["log_time"]
    index["offset"] = offset + records.dtype.itemsize * np.arange(len(records))
    return index


def _event_records(
    events: Sequence[tuple[int, bytes]], channel: int, first_sequence: int, offset: int
) -> tuple[bytes, npt.NDArray[np.void]]:
    """Return message records of events (log time, message), and their index."""
    records = b""
    index = np.empty(len(events), INDEX_DTYPE)
    for i, (log_time, data) in enumerate(events):
        index[i] = (log_time, offset + len(records))
        length = MESSAGE_HEAD.size - RECORD_HEAD_SIZE + len(data)
        records += MESSAGE_HEAD.pack(
            Opcode.MESSAGE, length, channel, first_sequence + i, log_time, log_time
        )
        records += data
    return records, index


def _segment_texts(segments: Mapping[str, tuple[int, int]]) -> dict[str, str]:
    return {name: f"{first},{end}" for name, (first, end) in segments.items()}


def _chunk_samples(metadata: Mapping[str, str]) -> int:
    """Return the number of samples per chunk: `CHUNK_SAMPLES`, or fewer at a low rate."""
    try:
        in_time = int(float(metadata.get("rate_hz", "inf")) * CHUNK_S)
    except (ValueError, OverflowError):
        return CHUNK_SAMPLES
    return min(max(in_time, 1), CHUNK_SAMPLES)


def _session_channels(metadata: Mapping[str, str]) -> tuple[list[Schema], list[Channel]]:
    """Return the channels of a session; that of the samples repeats the file's metadata."""
    schemas, channels = [], []
    for topic, (number, schema_name) in _CHANNELS.items():
        schemas.append(
            Schema(id=number, name=schema_name, encoding="protobuf", data=schema_data(schema_name))
        )
        channels.append(
            Channel(
                id=number,
                topic=topic,
                message_encoding="protobuf",
                schema_id=number,
                metadata=dict(metadata) if topic == SAMPLE_TOPIC else {},
            )
        )
    return schemas, channels


# New files on the disk

_COPY_BYTES: Final = 1 << 20


def fsync_directory(path: Path) -> None:
    """Sync the names in a folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def copy_new(descriptor: int, target: Path) -> None:
    """Copy an open file, of any name, to a new file and to the disk."""
    with target.open("xb") as copy:
        try:
            position = 0
            while data := os.pread(descriptor, _COPY_BYTES, position):
                copy.write(data)
                position += len(data)
            copy.flush()
            os.fsync(copy.fileno())
        except OSError:
            target.unlink()
            raise


def rename_new(source: Path, target: Path) -> None:
    """Rename a file, atomically failing with ``FileExistsError`` if `target` exists.

    Parameters
    ----------
    source
        The file.
    target
        Its new name, on the same disk.
    """
    try:
        os.link(source, target)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK):
            raise
        # A file system without hard links (FAT, some network drives): reserve the name, which
        # fails if the name exists, and replace the empty file, which then is our own.
        os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        try:
            source.replace(target)
        except OSError:
            with contextlib.suppress(OSError):
                target.unlink()  # else it would keep the name from a recovery
            raise
    else:
        source.unlink()


def mark_as_written(descriptor: int) -> None:
    """Mark a file as being written while `descriptor` is open and its process lives.

    Uses an advisory lock; a file system without locks has no mark.
    """
    if fcntl is not None:
        with contextlib.suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_being_written(path: Path) -> bool:
    """Return whether a living process holds the mark of `mark_as_written`."""
    if fcntl is None:
        return False
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # opening a pipe would block
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    else:
        return False
    finally:
        os.close(descriptor)
