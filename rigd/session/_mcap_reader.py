"""MCAP container, read record by record with every length checked and every checksum verified.

The data section is read from its beginning, which takes a millisecond for the chunks of a session.
This one way of reading serves files of any chunking, with or without a summary, and finds how far a
truncated file is readable. Messages are passed on block by block and not stored. Consecutive
messages of equal length, as a session's are, are passed on as one run of bytes.

Every claim of the file is checked before use, and no file can exceed its limits of memory and time
(:mod:`rigd.session._mcap_limits`).
"""

import mmap
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema, Statistics

from rigd.session import limits
from rigd.session._mcap_limits import (
    CHUNK_STEPS,
    DECLARATION_STEPS,
    MAX_SKIPPED,
    MOST_UNPACKED_BYTES,
    Allowance,
    McapDamageError,
    McapError,
    McapTooLargeError,
    prefixed,
    unpacked,
    unpacked_parts,
    zstd_decompressor,
)
from rigd.session._mcap_writer import MAGIC, MESSAGE_HEAD
from rigd.session.layout import Buffer

RECORD_HEAD: Final = struct.Struct("<BQ")
# Opcode, length and channel, which are equal throughout a run: 11 bytes as two words that overlap.
_RUN_HEAD: Final = struct.Struct("<BQH")
_RUN_KEY: Final = np.dtype(
    {"names": ["head", "tail"], "formats": ["<u8", "<u8"], "offsets": [0, 3], "itemsize": 11}
)
_CHUNK_HEAD: Final = struct.Struct("<QQQI")
_DECLARATIONS: Final = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT)
_CHANNEL_ID: Final = struct.Struct("<H")
FOOTER: Final = struct.Struct("<BQ QQI")
_FOOTER_CONTENT_SIZE: Final = 20
_BARE_MESSAGES: Final = 250
"""Messages outside of chunks that form one unit."""
_SHORT_RUN: Final = 8
"""Messages that are compared one by one before an array of them pays off."""
_FIRST_STEP: Final = 256
_MOST_RUNS: Final = 1 << 16
"""Runs that are passed on at once."""
_PASSED_BYTES: Final = 32 << 20
"""Length of the file after which the memory of the part already read is given back."""

_Record = TypeVar("_Record")
Run = tuple[int, int, int, int]
"""Consecutive messages of equal length: channel, bytes of a record with its head, byte at which the
first begins, and their number."""


@dataclass(frozen=True, slots=True)
class MessageBlock:
    """Consecutive message records of a file."""

    records: Buffer
    """Buffer with the runs; the reader does not hold it."""
    runs: list[Run]
    """Runs of messages of the wanted topics, in the order of the file."""
    unit: int
    """Byte of the file at which their chunk begins, or that of some messages without a chunk."""


@dataclass(slots=True)
class McapContents:
    """Content of a file as far as it could be read, without the messages."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    message_counts: dict[int, int] = field(default_factory=lambda: defaultdict(int))
    """Channel → number of messages read, wanted or not."""
    declared_in_chunks: set[int] = field(default_factory=set)
    """Channels that were declared where a checksum covers them and their schemas."""
    skipped: list[str] = field(default_factory=list)
    """Damaged records that were skipped, as predicates like `damage`. The last one states how many
    more there are than `MAX_SKIPPED`."""
    stated_counts: dict[int, int] = field(default_factory=dict)
    """Channel → number of messages by the file's statistics; empty if these are damaged."""
    sound_bytes: int = 0
    """Length of the file that was read: up to the end of a record."""
    verified: bool = False
    """Whether the file has a correct checksum over its whole data section."""
    complete: bool = False
    """Whether the file has its end."""
    damage: str | None = None
    """Reason why reading stopped: a sentence's predicate, with the byte. None: it did not stop."""

    def count(self, topic: str) -> int:
        """Return the number of messages read of a topic."""
        channels = [channel.id for channel in self.channels.values() if channel.topic == topic]
        return sum(self.message_counts[channel] for channel in channels)


def message_starts(runs: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the offset of each message if the runs follow one another.

    Parameters
    ----------
    runs : (n, 3), channel, bytes of a record, and count

    Returns
    -------
    array (sum of the counts,) of offsets from the beginning of the first
    """
    _, sizes, counts = runs.T
    lengths = sizes * counts
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.asarray(
        np.repeat(np.cumsum(lengths) - lengths, counts) + number * np.repeat(sizes, counts)
    )


OnBlock = Callable[[McapContents, MessageBlock], None]
"""Callback for messages as they are read, with the contents read before them."""


def read_mcap(
    data: memoryview,
    topics: Collection[str] | None,
    *,
    take: OnBlock | None = None,
    salvage: bool = False,
    on_progress: Callable[[float], None] | None = None,
) -> McapContents:
    """Read an MCAP file as far as it is sound.

    Parameters
    ----------
    data : the file; pages of an ``mmap`` are given back when they have been read
    topics : topics of the wanted messages; None for all
    take
        Called with the wanted messages, block by block in the order of the file. Damage may be
        found behind them only.
    salvage
        Read as much as possible: skip damaged records outside of chunks, on which no message
        depends, and search a damaged file for its statistics.
    on_progress : called now and then with the completed fraction of the file

    Returns
    -------
    The contents; `McapContents.damage` states whether, where and why reading stopped.

    Raises
    ------
    McapError
        If the file does not begin as an MCAP file does, or declares more than
        `MAX_DECLARED_BYTES`.
    McapTooLargeError
        If the file or a wanted message is too long, or the file has too many parts.
    """
    if bytes(data[: len(MAGIC)]) != MAGIC:
        raise McapError("is not an MCAP file")
    if len(data) > limits.MAX_FILE_BYTES:
        raise McapTooLargeError(
            f"has {len(data) >> 20} MiB, more than the {limits.MAX_FILE_BYTES >> 20} MiB that are "
            "read"
        )
    reader = _ContainerReader(data, topics, take, salvage=salvage)
    contents = reader.contents
    contents.complete = _has_end(data)
    try:
        reader.read(on_progress)
    except McapDamageError as error:
        contents.damage = str(error)
        if salvage and contents.complete:
            contents.stated_counts = reader.stated_counts()
    except MemoryError:
        contents.damage = "does not fit into the memory of this machine"
    return contents


def _has_end(data: memoryview) -> bool:
    """Return whether the file ends with a footer and the magic."""
    start = len(data) - len(MAGIC) - FOOTER.size
    if start < len(MAGIC) or bytes(data[-len(MAGIC) :]) != MAGIC:
        return False
    return RECORD_HEAD.unpack_from(data, start) == (Opcode.FOOTER, _FOOTER_CONTENT_SIZE)


def _record_at(data: Buffer, position: int, where: str) -> tuple[int, int, int]:
    """Return opcode, start of the content and end of the record at `position`."""
    content = position + RECORD_HEAD.size
    if content > len(data):
        raise _torn(position, where)
    opcode, length = RECORD_HEAD.unpack_from(data, position)
    if opcode == 0:
        raise _no_record(position, where)
    end = content + length
    if end > len(data):
        raise _torn(position, where)
    return opcode, content, end


def _torn(position: int, where: str) -> McapDamageError:
    return McapDamageError(f"ends in the middle of a record, at byte {position}{where}")


def _no_record(position: int, where: str) -> McapDamageError:
    return McapDamageError(f"has no record where one must be, at byte {position}{where}")


class _ContainerReader:
    """One pass over a file."""

    def __init__(
        self,
        data: memoryview,
        topics: Collection[str] | None,
        take: OnBlock | None,
        *,
        salvage: bool,
    ) -> None:
        self.contents = McapContents(sound_bytes=len(MAGIC))
        self._salvage = salvage
        self._data = data
        self._topics = topics
        self._take = take
        self._wanted: dict[int, bool] = {}  # channel → whether its messages are wanted
        self._allowance = Allowance()
        self._zstd = zstd_decompressor()
        self._skipped = 0
        self._unit = 0  # first byte of messages without chunk, and how many still belong to them
        self._unit_room = 0
        self._declarations: dict[tuple[int, bytes], bytes] = {}  # opcode and number → content
        self._crc = 0
        self._passed = 0  # end of the part whose checksum is computed and memory given back

    def read(self, on_progress: Callable[[float], None] | None) -> None:
        data, contents = self._data, self.contents
        end = len(MAGIC)
        while end < len(data):
            start = end
            opcode, content, end = _record_at(data, start, "")
            self._allowance.spend(1)
            if opcode == Opcode.CHUNK:
                self._read_chunk(data[content:end], start)
                if on_progress is not None:
                    on_progress(end / len(data))
            elif opcode == Opcode.MESSAGE:
                end = self._read_bare_messages(start, end)
                if on_progress is not None:
                    on_progress(end / len(data))
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
                except McapDamageError as error:
                    if not self._salvage:
                        raise
                    self._skip(str(error))
            contents.sound_bytes = end
            if end - self._passed > _PASSED_BYTES:
                self._give_back(end)
        raise McapDamageError("has no end of its data section")

    def _skip(self, damage: str) -> None:
        """Record a skipped damaged record; beyond the maximum, their number only."""
        self._skipped += 1
        skipped = self.contents.skipped
        if self._skipped > MAX_SKIPPED:
            del skipped[MAX_SKIPPED:]
            damage = f"has {self._skipped - MAX_SKIPPED} more damaged records"
        skipped.append(damage)

    def _give_back(self, end: int) -> None:
        """Compute the checksum up to `end`, and release the memory of the file up to there."""
        self._crc = self._crc_of(self._passed, end, self._crc)
        self._passed = end

    def _crc_of(self, start: int, end: int, crc: int = 0) -> int:
        for position in range(start, end, _PASSED_BYTES):
            crc = zlib.crc32(self._data[position : min(position + _PASSED_BYTES, end)], crc)
            self._let_go()
        return crc

    def _let_go(self) -> None:
        """Give the file's pages back to the system: they would count as memory of the process."""
        mapped = self._data.obj
        if len(self._data) > _PASSED_BYTES and isinstance(mapped, mmap.mmap):
            mapped.madvise(mmap.MADV_DONTNEED)

    def _read_bare_messages(self, start: int, first_end: int) -> int:
        """Read the messages outside of chunks from `start` on; return their end."""
        where = f" at byte {start}"
        if first_end - start < MESSAGE_HEAD.size:
            raise McapDamageError(f"has a message that is too short{where}")
        if self._is_stray(_RUN_HEAD.unpack_from(self._data, start)[2]):
            # Its writer uses chunks: this is another record, with a damaged opcode.
            raise McapDamageError(f"has a message outside of a chunk{where}")
        if self._unit_room == 0:
            self._unit, self._unit_room = start, _BARE_MESSAGES
        limit = min(len(self._data), max(first_end, start + MOST_UNPACKED_BYTES))
        end, count = self._read_messages(
            self._data, start, limit, self._unit, where, self._unit_room
        )
        self._unit_room -= count
        return end

    def _is_stray(self, channel: int) -> bool:
        return self._salvage and channel in self.contents.declared_in_chunks

    def _read_other(self, opcode: int, content: Buffer, where: str) -> None:
        """Read a record that is neither chunk nor message; skip unnecessary ones."""
        contents = self.contents
        if opcode not in _DECLARATIONS:
            return
        self._allowance.spend(DECLARATION_STEPS)
        # Many writers repeat schemas and channels in every chunk; a repetition takes no memory.
        number = (opcode, bytes(content[: _CHANNEL_ID.size]))
        if self._declarations.get(number) == content:
            return
        self._allowance.declare(opcode, content, where)
        if opcode == Opcode.SCHEMA:
            schema = parsed(Schema.read, content, where)
            if contents.schemas.setdefault(schema.id, schema) != schema:
                raise McapDamageError(f"declares schema {schema.id} twice, differently{where}")
            self._declarations[number] = bytes(content)
        elif opcode == Opcode.CHANNEL:
            channel = parsed(Channel.read, content, where)
            if contents.channels.setdefault(channel.id, channel) != channel:
                raise McapDamageError(f"declares channel {channel.id} twice, differently{where}")
            self._wanted[channel.id] = self._topics is None or channel.topic in self._topics
            self._declarations[number] = bytes(content)
        elif opcode == Opcode.METADATA:
            contents.metadata.append(parsed(Metadata.read, content, where))
        elif opcode == Opcode.ATTACHMENT:
            if len(content) >= 4:
                (crc,) = struct.unpack_from("<I", content, len(content) - 4)
                if crc not in (0, zlib.crc32(content[:-4])):
                    raise McapDamageError(f"has an attachment with a wrong checksum{where}")
            contents.attachments.append(parsed(Attachment.read, content, where))

    def _read_chunk(self, content: memoryview, start: int) -> None:
        self._allowance.spend(CHUNK_STEPS)
        where = f" in the chunk at byte {start}"
        try:
            *_, size, crc = _CHUNK_HEAD.unpack_from(content)
            name, position = prefixed(content, _CHUNK_HEAD.size, "<I")
            packed, _ = prefixed(content, position, "<Q")
        except struct.error:
            raise McapDamageError(f"has a malformed head{where}") from None
        self._allowance.unpack(size, where)
        compression = bytes(name[:20])
        if size <= MOST_UNPACKED_BYTES:
            records = unpacked(self._zstd, compression, packed, size, where)
            if crc not in (0, zlib.crc32(records)):
                raise McapDamageError(f"has a wrong checksum{where}")
            end = self._read_records(records, 0, start, where)
            if end < len(records):
                raise _torn(end, where)
            return
        # Too long for memory: unpacked once to be checked, and once more to be read.
        found, found_crc = 0, 0
        for part in unpacked_parts(self._zstd, compression, packed, size, where):
            found += len(part)
            found_crc = zlib.crc32(part, found_crc)
            self._let_go()
        if found != size:
            raise McapDamageError(f"decompresses to a wrong size{where}")
        if crc not in (0, found_crc):
            raise McapDamageError(f"has a wrong checksum{where}")
        self._read_parts(unpacked_parts(self._zstd, compression, packed, size, where), start, where)

    def _read_parts(self, parts: Iterator[Buffer], unit: int, where: str) -> None:
        """Read records that may begin in one part and end in another; skip unwanted ones."""
        rest = b""
        base = 0  # offset of `rest` in the chunk
        skip = 0  # remaining bytes of an unwanted record
        for part in parts:
            self._let_go()
            if skip >= len(part):
                skip -= len(part)
                base += len(part)
                continue
            rest += part[skip:]
            base += skip
            skip = 0
            used = self._read_records(rest, base, unit, where)
            rest = rest[used:]
            base += used
            if len(rest) >= _RUN_HEAD.size:
                skip = self._needless_bytes(rest, base, where)
                if skip:
                    base += len(rest)
                    skip -= len(rest)
                    rest = b""
        if rest or skip:
            raise _torn(base, where)

    def _needless_bytes(self, records: bytes, base: int, where: str) -> int:
        """Return the length of the first record if it is not needed, else 0."""
        opcode, length, channel = _RUN_HEAD.unpack_from(records)
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            if length > limits.MAX_TEXT_BYTES:
                raise _torn(base, where)
            return 0
        if opcode == Opcode.MESSAGE:
            if self._wanted.get(channel, True) and self._is_short(length, where):
                return 0
            self.contents.message_counts[channel] += 1
        return int(length) + RECORD_HEAD.size

    def _is_short(self, length: int, where: str) -> bool:
        """Return whether a message is short enough; in salvage mode a longer one is skipped."""
        if length <= limits.MAX_MESSAGE_BYTES:
            return True
        damage = (
            f"has a message of {length} bytes{where}, more than the "
            f"{limits.MAX_MESSAGE_BYTES >> 20} MiB that are accepted"
        )
        if not self._salvage:
            raise McapDamageError(damage)
        self._skip(damage)
        return False

    def _read_records(self, records: bytes, base: int, unit: int, where: str) -> int:
        """Read the complete records of a chunk; return the start of the incomplete one.

        `base` is the offset of the records in the chunk.
        """
        end = 0
        while end < len(records):
            start = end
            end, count = self._read_messages(records, start, len(records), unit, where)
            if count:
                continue
            if start + RECORD_HEAD.size > len(records):
                return start
            opcode, length = RECORD_HEAD.unpack_from(records, start)
            if opcode == 0:
                raise _no_record(base + start, where)
            content = start + RECORD_HEAD.size
            end = content + length
            if end > len(records):
                return start
            self._allowance.spend(1)
            if opcode == Opcode.MESSAGE:
                raise McapDamageError(f"has a message that is too short{where}")
            self._read_other(opcode, records[content:end], where)
            if opcode == Opcode.CHANNEL:
                (channel,) = _CHANNEL_ID.unpack_from(records, content)
                self.contents.declared_in_chunks.add(channel)
        return end

    def _read_messages(
        self,
        records: Buffer,
        start: int,
        limit: int,
        unit: int,
        where: str,
        most: int | None = None,
    ) -> tuple[int, int]:
        """Pass on consecutive messages from `start` on that end before `limit`.

        Outside of chunks at most `most`. Returns the start of the first other record and the number
        of messages.
        """
        unpack = _RUN_HEAD.unpack_from
        wanted, counts = self._wanted, self.contents.message_counts
        runs: list[Run] = []
        position = start
        taken = passed = 0  # messages, and runs of them
        try:
            while position + MESSAGE_HEAD.size <= limit and passed < _MOST_RUNS:
                key = unpack(records, position)
                opcode, length, channel = key
                size = length + RECORD_HEAD.size
                if opcode != Opcode.MESSAGE or size < MESSAGE_HEAD.size or position + size > limit:
                    break
                is_wanted = wanted.get(channel)
                if is_wanted is None:
                    raise McapDamageError(
                        f"has a message of an undeclared channel {channel}{where}"
                    )
                if most is not None and (taken == most or self._is_stray(channel)):
                    break
                end = position + size
                count = 1
                while end + size <= limit and unpack(records, end) == key:
                    end += size
                    count += 1
                    if count == _SHORT_RUN:
                        count = _run_length(records, position, size, limit)
                        break
                if most is not None:
                    count = min(count, most - taken)
                if is_wanted and self._is_short(length, where):
                    runs.append((channel, size, position, count))
                counts[channel] += count
                position += size * count
                taken += count
                passed += 1
        finally:
            if runs and self._take is not None:
                self._take(self.contents, MessageBlock(records, runs, unit))
        self._allowance.spend(passed)
        return position, taken

    def _check_data_end(self, content: memoryview, start: int) -> None:
        if len(content) < 4:
            raise McapDamageError(f"has a malformed end of its data section at byte {start}")
        (crc,) = struct.unpack_from("<I", content)
        if crc != 0 and crc != self._crc_of(self._passed, start, self._crc):
            raise McapDamageError("has a wrong checksum over its data section")
        self.contents.verified = crc != 0

    def _check_summary(self, start: int) -> None:
        """Compare the summary, if there is one, with the contents read."""
        data = self._data
        if not self.contents.complete:
            raise McapDamageError(
                "ends in the middle of its summary, or something was appended to it"
            )
        footer = len(data) - len(MAGIC) - FOOTER.size
        *_, summary_start, _, crc = FOOTER.unpack_from(data, footer)
        if summary_start not in (0, start) or (summary_start == 0 and footer != start):
            raise McapDamageError(
                f"has a footer that contradicts its data section at byte {footer}"
            )
        if crc not in (0, self._crc_of(start, footer + FOOTER.size - 4)):
            raise McapDamageError("has a wrong checksum over its summary")
        for opcode, content in self._summary_records(start, footer):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                # Declarations of channels without messages may be here only.
                self._read_other(opcode, content, " in the summary")
            elif opcode == Opcode.STATISTICS:
                statistics = parsed(Statistics.read, content, " in the summary")
                found = self.contents.message_counts
                counts = statistics.channel_message_counts
                if any(found[channel] != count for channel, count in counts.items()):
                    raise McapDamageError("does not contain the messages that its statistics count")

    def _summary_records(self, start: int, footer: int) -> Iterator[tuple[int, memoryview]]:
        """Yield opcode and content of the summary's records."""
        data, end, passed = self._data[:footer], start, start
        while end < footer:
            opcode, content, end = _record_at(data, end, " of the summary")
            if end - passed > _PASSED_BYTES:
                passed = end
                self._let_go()
            # Each channel in the statistics takes time.
            is_statistics = opcode == Opcode.STATISTICS
            self._allowance.spend(1 + (end - content) // 4 if is_statistics else 1)
            yield opcode, data[content:end]

    def stated_counts(self) -> dict[int, int]:
        """Return the statistics' message counts, if the checksum of the summary is correct."""
        data = self._data
        footer = len(data) - len(MAGIC) - FOOTER.size
        *_, start, _, crc = FOOTER.unpack_from(data, footer)
        if not len(MAGIC) <= start <= footer:
            return {}
        if crc == 0 or crc != self._crc_of(start, footer + FOOTER.size - 4):
            return {}
        try:
            for opcode, content in self._summary_records(start, footer):
                if opcode == Opcode.STATISTICS:
                    statistics = parsed(Statistics.read, content, "")
                    return dict(statistics.channel_message_counts)
        except McapDamageError:
            pass
        return {}


def parsed(read: Callable[[ReadDataStream], _Record], content: Buffer, where: str) -> _Record:
    """Parse a record with the ``mcap`` package."""
    try:
        stream = ReadDataStream(BytesIO(content))
        record = read(stream)
    except (EndOfFile, struct.error, UnicodeDecodeError, OverflowError):
        raise McapDamageError(f"has a malformed record{where}") from None
    return record


def _run_length(records: Buffer, start: int, size: int, limit: int) -> int:
    """Count the records of equal opcode, length and channel from `start` on, up to `limit`.

    The examined step grows, so that short runs in long chunks stay cheap.
    """
    (head, tail) = np.frombuffer(records[start : start + _RUN_KEY.itemsize], _RUN_KEY)[0]
    most = (limit - start) // size
    known, step = 1, _FIRST_STEP
    while known < most:
        count = min(step, most - known)
        keys = np.ndarray(count, _RUN_KEY, records, start + known * size, (size,))
        equal = (keys["head"] == head) & (keys["tail"] == tail)
        first = int(equal.argmin())
        if not equal[first]:
            return known + first
        known += count
        step *= 8
    return known
