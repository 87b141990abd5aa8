"""MCAP container, read record by record with every length checked and every checksum verified.

The data section is walked from its beginning, which takes a millisecond for the chunks of a
session. So one way of reading serves files of any chunking, with or without a summary, and tells
for a file that was cut off how far it can be read. Messages of equal length that follow one
another, as those of a session do, are taken as one run of bytes.

Nothing in the file is believed before it is checked: what a chunk claims to decompress to is
bounded by `MAX_CHUNK_BYTES`, the sum over the file by `MAX_TOTAL_BYTES`, and what is kept of it
by what the caller allows: a few kilobytes may unpack to as many records as there is memory for.
"""

import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import Final, TypeVar

import lz4.frame
import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema, Statistics

from rigd.session.format import Buffer
from rigd.session.mcap_writer import MAGIC, MESSAGE_HEAD

MAX_CHUNK_BYTES: Final = 256 << 20
MAX_TOTAL_BYTES: Final = 2 << 30
MAX_DECLARED_BYTES: Final = 64 << 20
"""Most memory for schemas, channels, metadata and attachments together."""

_DECLARED_COST: Final = 1000
"""Bytes that an object for one of them takes, about, however small its record."""
_MESSAGE_COST: Final = 112
_RUN_COST: Final = 500
"""Likewise of a message, decoded, and of a run of messages."""

_RECORD_HEAD: Final = struct.Struct("<BQ")
# Opcode, length and channel, which are equal throughout a run: 11 bytes as two words that overlap.
_RUN_KEY: Final = np.dtype(
    {"names": ["head", "tail"], "formats": ["<u8", "<u8"], "offsets": [0, 3], "itemsize": 11}
)
_CHUNK_HEAD: Final = struct.Struct("<QQQI")
_DECLARATIONS: Final = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT)
_CHANNEL_ID: Final = struct.Struct("<H")
_FOOTER: Final = struct.Struct("<BQ QQI")
_FOOTER_CONTENT_SIZE: Final = 20
_BARE_MESSAGES: Final = 250
"""Messages outside of chunks that are kept together."""
_FIRST_STRETCH: Final = 256
_BLOCK_BYTES: Final = 1 << 18

_Record = TypeVar("_Record")


class McapError(Exception):
    """The bytes are no MCAP file of use; the message is a predicate to the file's name."""


class McapTooLargeError(McapError):
    """The file holds more messages than may be kept; the message likewise."""


@dataclass(slots=True)
class Run:
    """Message records of one channel that are equally long, in the order of the file."""

    channel: int
    size: int
    """Bytes of a record, head and all."""
    pieces: list[Buffer] = field(default_factory=list)

    def blocks(self) -> Iterator[bytes]:
        """Yield the records, joined to blocks that stay in a processor's cache."""
        joined: list[Buffer] = []
        length = 0
        most = max(_BLOCK_BYTES // self.size, 1) * self.size
        for piece in self.pieces:
            for start in range(0, len(piece), most):
                part = piece[start : start + most]
                joined.append(part)
                length += len(part)
                if length >= _BLOCK_BYTES:
                    yield b"".join(joined)
                    joined, length = [], 0
        yield b"".join(joined)


@dataclass(slots=True)
class McapContents:
    """What was read of a file, as far as it could be."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    runs: dict[str, list[Run]] = field(default_factory=lambda: defaultdict(list))
    """Wanted topic → its messages in the order of the file."""
    message_counts: dict[int, int] = field(default_factory=lambda: defaultdict(int))
    """Channel → how many messages were read, wanted or not."""
    chunks: list[list[Run]] = field(default_factory=list)
    """Messages of all topics as they stood together in chunks, if that was asked for."""
    declared_in_chunks: set[int] = field(default_factory=set)
    """Channels that were declared where a checksum covers them and their schemas."""
    skipped: list[str] = field(default_factory=list)
    """Damaged records that were skipped: sentences' predicates, as `damage`."""
    stated_counts: dict[int, int] = field(default_factory=dict)
    """Channel → how many messages the file had, by its statistics; empty if they are not sound."""
    sound_bytes: int = 0
    """How far the file was read: up to the end of a record."""
    verified: bool = False
    """Whether a checksum over the whole data section was there, and right."""
    complete: bool = False
    """Whether the file has its end."""
    damage: str | None = None
    """Why reading stopped, None if it did not: a sentence's predicate, with the byte."""

    def count(self, topic: str) -> int:
        """Return how many messages of a topic were read."""
        channels = [channel.id for channel in self.channels.values() if channel.topic == topic]
        return sum(self.message_counts[channel] for channel in channels)


def read_mcap(
    data: memoryview,
    topics: Collection[str],
    *,
    salvage: bool = False,
    max_bytes: int = MAX_TOTAL_BYTES,
    on_progress: Callable[[float], None] | None = None,
) -> McapContents:
    """Read an MCAP file as far as it is sound.

    Parameters
    ----------
    data : the file
    topics : of which the messages are wanted
    salvage
        Get as much as there is: keep `McapContents.chunks`, skip damaged records outside of
        chunks, which no message depends on, and look for the statistics of a damaged file.
    max_bytes : most memory for the messages wanted, raw or decoded, about
    on_progress : called now and then with the share of the file that is done

    Returns
    -------
    The contents; `McapContents.damage` tells whether, where and why reading stopped.

    Raises
    ------
    McapError
        If the file does not begin as an MCAP file does, or declares more than
        `MAX_DECLARED_BYTES`.
    McapTooLargeError
        If it holds more than `max_bytes` of messages.
    """
    if bytes(data[: len(MAGIC)]) != MAGIC:
        raise McapError("is not an MCAP file")
    reader = _Reader(data, topics, salvage=salvage, max_bytes=max_bytes)
    contents = reader.contents
    contents.complete = _has_end(data)
    try:
        reader.read(on_progress)
    except _DamageError as error:
        contents.damage = str(error)
        if salvage and contents.complete:
            contents.stated_counts = _stated_counts(data)
    except MemoryError:
        contents.damage = "does not fit into the memory of this machine"
    return contents


class _DamageError(Exception):
    """Something in the file contradicts the format."""


def _has_end(data: memoryview) -> bool:
    """Tell whether the file ends with a footer and the magic."""
    start = len(data) - len(MAGIC) - _FOOTER.size
    if start < len(MAGIC) or bytes(data[-len(MAGIC) :]) != MAGIC:
        return False
    return _RECORD_HEAD.unpack_from(data, start) == (Opcode.FOOTER, _FOOTER_CONTENT_SIZE)


def _record_at(data: memoryview, position: int, where: str) -> tuple[int, int, int]:
    """Return the opcode of the record at `position`, where its content begins and where it ends."""
    content = position + _RECORD_HEAD.size
    if content > len(data):
        raise _DamageError(f"ends in the middle of a record, at byte {position}{where}")
    opcode, length = _RECORD_HEAD.unpack_from(data, position)
    if opcode == 0:
        raise _DamageError(f"has no record where one must be, at byte {position}{where}")
    end = content + length
    if end > len(data):
        raise _DamageError(f"ends in the middle of a record, at byte {position}{where}")
    return opcode, content, end


class _Reader:
    """One pass over a file."""

    def __init__(
        self, data: memoryview, topics: Collection[str], *, salvage: bool, max_bytes: int
    ) -> None:
        self.contents = McapContents(sound_bytes=len(MAGIC))
        self._salvage = salvage
        self._data = data
        self._topics = topics
        self._wanted: dict[int, str | None] = {}  # channel → its topic if wanted
        self._uncompressed = 0
        self._max_bytes = max_bytes
        self._kept = 0
        self._declared = 0
        self._zstd = zstandard.ZstdDecompressor()

    def read(self, on_progress: Callable[[float], None] | None) -> None:
        data, contents = self._data, self.contents
        end = len(MAGIC)
        while end < len(data):
            start = end
            opcode, content, end = _record_at(data, start, "")
            if opcode == Opcode.CHUNK:
                self._read_chunk(data[content:end], start)
                if on_progress is not None:
                    on_progress(end / len(data))
            elif opcode == Opcode.MESSAGE:
                self._read_bare_message(data[start:end], start)
            elif opcode == Opcode.DATA_END:
                self._check_data_end(data[content:end], start)
                contents.sound_bytes = end
                self._check_summary(end)
                contents.sound_bytes = len(data)
                return
            elif opcode == Opcode.FOOTER:
                break
            else:
                try:
                    self._read_other(opcode, data[content:end], f" at byte {start}")
                except _DamageError as error:
                    if not self._salvage:
                        raise
                    contents.skipped.append(str(error))
            contents.sound_bytes = end
        raise _DamageError("has no end of its data section")

    def _read_bare_message(self, record: memoryview, start: int) -> None:
        where = f" at byte {start}"
        if self._salvage:
            channel = MESSAGE_HEAD.unpack_from(record)[2] if len(record) >= MESSAGE_HEAD.size else 0
            if channel in self.contents.declared_in_chunks:
                # Its writer uses chunks: this is another record, with a damaged opcode.
                raise _DamageError(f"has a message outside of a chunk{where}")
            if not self.contents.chunks or len(self.contents.chunks[-1]) >= _BARE_MESSAGES:
                self.contents.chunks.append([])
        self._take_run(record, 1, len(self._data), where)

    def _read_other(self, opcode: int, content: memoryview, where: str) -> None:
        """Take a record that is neither chunk nor message; skip what is not needed."""
        contents = self.contents
        if opcode in _DECLARATIONS:
            self._declared += len(content) + _DECLARED_COST
            if self._declared > MAX_DECLARED_BYTES:
                raise McapError(
                    f"declares channels, schemas, metadata and attachments without end: more than "
                    f"{MAX_DECLARED_BYTES >> 20} MiB of them{where}"
                )
        if opcode == Opcode.SCHEMA:
            schema = _parsed(Schema.read, content, where)
            if contents.schemas.setdefault(schema.id, schema) != schema:
                raise _DamageError(f"declares schema {schema.id} twice, differently{where}")
        elif opcode == Opcode.CHANNEL:
            channel = _parsed(Channel.read, content, where)
            if contents.channels.setdefault(channel.id, channel) != channel:
                raise _DamageError(f"declares channel {channel.id} twice, differently{where}")
            self._wanted[channel.id] = channel.topic if channel.topic in self._topics else None
        elif opcode == Opcode.METADATA:
            contents.metadata.append(_parsed(Metadata.read, content, where))
        elif opcode == Opcode.ATTACHMENT:
            if len(content) >= 4:
                (crc,) = struct.unpack_from("<I", content, len(content) - 4)
                if crc not in (0, zlib.crc32(content[:-4])):
                    raise _DamageError(f"has an attachment with a wrong checksum{where}")
            contents.attachments.append(_parsed(Attachment.read, content, where))

    def _read_chunk(self, content: memoryview, start: int) -> None:
        where = f" in the chunk at byte {start}"
        try:
            *_, size, crc = _CHUNK_HEAD.unpack_from(content)
            name, position = _prefixed(content, _CHUNK_HEAD.size, "<I")
            packed, _ = _prefixed(content, position, "<Q")
        except struct.error:
            raise _DamageError(f"has a malformed head{where}") from None
        self._uncompressed += size
        if size > MAX_CHUNK_BYTES or self._uncompressed > MAX_TOTAL_BYTES:
            raise _DamageError(
                f"claims {size} bytes{where}, which is more than the {MAX_CHUNK_BYTES >> 20} MiB "
                f"for a chunk or the {MAX_TOTAL_BYTES >> 20} MiB for a file that are accepted"
            )
        records = memoryview(self._decompressed(bytes(name), packed, size, where))
        if crc not in (0, zlib.crc32(records)):
            raise _DamageError(f"has a wrong checksum{where}")
        if self._salvage:
            self.contents.chunks.append([])
        self._read_chunk_records(records, where)

    def _decompressed(self, compression: bytes, packed: memoryview, size: int, where: str) -> bytes:
        """Decompress a chunk to exactly `size` bytes, never allocating more."""
        try:
            if compression == b"":
                records = bytes(packed)
            elif compression == b"zstd":
                # The frame may state a size of its own, which the decompressor would believe.
                if zstandard.get_frame_parameters(packed).content_size not in (
                    size,
                    zstandard.CONTENTSIZE_UNKNOWN,
                ):
                    raise _DamageError(f"states two different sizes{where}")
                records = self._zstd.decompress(packed, max_output_size=size)
            elif compression == b"lz4":
                # One byte more than is right, so that what is too long is seen.
                records = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
            else:
                raise _DamageError(f"uses the unknown compression {compression!r}{where}")
        except (zstandard.ZstdError, RuntimeError, ValueError):
            raise _DamageError(f"does not decompress{where}") from None
        if len(records) != size:
            raise _DamageError(f"decompresses to a wrong size{where}")
        return records

    def _read_chunk_records(self, records: memoryview, where: str) -> None:
        end = 0
        while end < len(records):
            start = end
            opcode, content, end = _record_at(records, start, where)
            if opcode == Opcode.MESSAGE:
                count = _run_length(records, start, end - start)
                end = start + count * (end - start)
                self._take_run(records[start:end], count, len(records), where)
            else:
                self._read_other(opcode, records[content:end], where)
                if opcode == Opcode.CHANNEL:
                    (channel,) = _CHANNEL_ID.unpack_from(records, content)
                    self.contents.declared_in_chunks.add(channel)

    def _take_run(self, run: memoryview, count: int, total: int, where: str) -> None:
        """Take `count` message records of equal length and channel out of `total` bytes."""
        size = len(run) // count
        if size < MESSAGE_HEAD.size:
            raise _DamageError(f"has a message that is too short{where}")
        channel = MESSAGE_HEAD.unpack_from(run)[2]
        if channel not in self._wanted:
            raise _DamageError(f"has a message of an undeclared channel {channel}{where}")
        self.contents.message_counts[channel] += count
        if self._salvage:
            self.contents.chunks[-1].append(Run(channel, size, [run]))
        topic = self._wanted[channel]
        if topic is None:
            return
        runs = self.contents.runs[topic]
        self._kept += max(len(run), count * _MESSAGE_COST)
        if not runs or (runs[-1].channel, runs[-1].size) != (channel, size):
            runs.append(Run(channel, size))
            self._kept += _RUN_COST
        if self._kept > self._max_bytes:
            raise McapTooLargeError(
                f"holds more than the {self._max_bytes >> 20} MiB of messages that are accepted in "
                f"{' and '.join(sorted(self._topics))}"
            )
        # A slice keeps the chunk in memory, which is well where it is most of it.
        runs[-1].pieces.append(run if 2 * len(run) > total else bytes(run))

    def _check_data_end(self, content: memoryview, start: int) -> None:
        if len(content) < 4:
            raise _DamageError(f"has a malformed end of its data section at byte {start}")
        (crc,) = struct.unpack_from("<I", content)
        if crc not in (0, zlib.crc32(self._data[:start])):
            raise _DamageError("has a wrong checksum over its data section")
        self.contents.verified = crc != 0

    def _check_summary(self, start: int) -> None:
        """Compare the summary, if there is one, with what was found."""
        data = self._data
        if not self.contents.complete:
            raise _DamageError("ends in the middle of its summary, or something was appended to it")
        footer = len(data) - len(MAGIC) - _FOOTER.size
        *_, summary_start, _, crc = _FOOTER.unpack_from(data, footer)
        if summary_start not in (0, start) or (summary_start == 0 and footer != start):
            raise _DamageError(f"has a footer that contradicts its data section at byte {footer}")
        if crc not in (0, zlib.crc32(data[start : footer + _FOOTER.size - 4])):
            raise _DamageError("has a wrong checksum over its summary")
        end = start
        while end < footer:
            opcode, content, end = _record_at(data[:footer], end, " of the summary")
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                # Those of channels without messages may stand here only.
                self._read_other(opcode, data[content:end], " in the summary")
            elif opcode == Opcode.STATISTICS:
                statistics = _parsed(Statistics.read, data[content:end], " in the summary")
                found = self.contents.message_counts
                counts = statistics.channel_message_counts
                if any(found[channel] != count for channel, count in counts.items()):
                    raise _DamageError("has not the messages that its statistics count")


def _stated_counts(data: memoryview) -> dict[int, int]:
    """Return the statistics' message counts, if the summary has a checksum that is right."""
    footer = len(data) - len(MAGIC) - _FOOTER.size
    *_, start, _, crc = _FOOTER.unpack_from(data, footer)
    if not len(MAGIC) <= start <= footer:
        return {}
    if crc == 0 or crc != zlib.crc32(data[start : footer + _FOOTER.size - 4]):
        return {}
    end = start
    try:
        while end < footer:
            opcode, content, end = _record_at(data[:footer], end, "")
            if opcode == Opcode.STATISTICS:
                statistics = _parsed(Statistics.read, data[content:end], "")
                return dict(statistics.channel_message_counts)
    except _DamageError:
        pass
    return {}


def _prefixed(content: memoryview, position: int, prefix: str) -> tuple[memoryview, int]:
    """Return the bytes behind a length of format `prefix`, and where they end."""
    (length,) = struct.unpack_from(prefix, content, position)
    start = position + struct.calcsize(prefix)
    if length > len(content) - start:
        raise struct.error
    return content[start : start + length], start + length


def _parsed(read: Callable[[ReadDataStream], _Record], content: memoryview, where: str) -> _Record:
    """Parse a record with the ``mcap`` package."""
    try:
        stream = ReadDataStream(BytesIO(content))
        record = read(stream)
    except (EndOfFile, struct.error, UnicodeDecodeError, OverflowError):
        raise _DamageError(f"has a malformed record{where}") from None
    return record


def _run_length(records: memoryview, start: int, size: int) -> int:
    """Count the records of equal opcode, length and channel from `start` on.

    The stretch examined at once grows, so that short runs in long chunks stay cheap.
    """
    key = bytes(records[start : start + _RUN_KEY.itemsize])
    most = (len(records) - start) // size
    if most < 2 or bytes(records[start + size : start + size + _RUN_KEY.itemsize]) != key:
        return 1
    (head, tail) = np.frombuffer(key, _RUN_KEY)[0]
    known, stretch = 1, _FIRST_STRETCH
    while known < most:
        count = min(stretch, most - known)
        keys: npt.NDArray[np.void] = np.ndarray(
            count, _RUN_KEY, records, start + known * size, (size,)
        )
        equal = (keys["head"] == head) & (keys["tail"] == tail)
        first = int(equal.argmin())
        if not equal[first]:
            return known + first
        known += count
        stretch *= 8
    return known
