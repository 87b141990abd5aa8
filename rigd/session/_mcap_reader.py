"""Reader of MCAP files that checks every length and verifies every checksum.

The data section is read from its beginning, record by record. The reader therefore needs no summary
section, accepts chunks of any size, and finds where a truncated file ends. Messages are passed on
block by block and not stored. Consecutive messages of equal length, as in a session, are passed on
as one run of bytes.

Every length and number in the file is checked before use. Memory and time for a file are limited
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
    MAX_SKIPPED_TEXTS,
    MAX_UNPACKED_BYTES,
    READING_STEPS_PER_CHUNK,
    READING_STEPS_PER_DECLARATION,
    McapDamageError,
    McapError,
    McapTooLargeError,
    ReadingBudget,
    decompressed_chunk,
    decompressed_parts,
    read_prefixed_bytes,
    zstd_decompressor,
)
from rigd.session._mcap_writer import MAGIC, MESSAGE_HEAD_FORMAT
from rigd.session.layout import Buffer

RECORD_HEAD_FORMAT: Final = struct.Struct("<BQ")
# Opcode, length and channel, which are equal throughout a run: 11 bytes, as two overlapping
# 8-byte integers.
_RUN_HEAD_FORMAT: Final = struct.Struct("<BQH")
_RUN_HEAD_DTYPE: Final = np.dtype(
    {"names": ["head", "tail"], "formats": ["<u8", "<u8"], "offsets": [0, 3], "itemsize": 11}
)
_CHUNK_HEAD_FORMAT: Final = struct.Struct("<QQQI")
_DECLARATION_OPCODES: Final = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT)
_CHANNEL_NUMBER_FORMAT: Final = struct.Struct("<H")
FOOTER_FORMAT: Final = struct.Struct("<BQ QQI")
_FOOTER_CONTENT_SIZE: Final = 20
_MAX_GROUP_MESSAGES: Final = 250
"""Maximum number of messages outside of chunks that are treated as a group, like a chunk."""
_MAX_SINGLE_COMPARISONS: Final = 8
"""Number of messages that are compared one by one; for more, an array comparison is faster."""
_FIRST_COMPARISON_MESSAGES: Final = 256
"""Number of messages in the first array comparison of `_run_length`."""
_MAX_BLOCK_RUNS: Final = 1 << 16
"""Maximum number of runs that are passed on in one block."""
_RELEASE_INTERVAL_BYTES: Final = 32 << 20
"""Number of bytes after which the memory of the file's part that was read is released."""

_Record = TypeVar("_Record")
MessageRun = tuple[int, int, int, int]
"""Consecutive messages of equal length: channel number, length in bytes of each message record with
its head, offset of the first record in the buffer, and number of messages."""


@dataclass(frozen=True, slots=True)
class MessageBlock:
    """Consecutive message records of an MCAP file, as passed to the reader's callback."""

    records: Buffer
    """Bytes of the message records; the reader retains no reference to them."""
    runs: list[MessageRun]
    """Runs of messages of the requested topics, in the order of the file."""
    chunk_position: int
    """Offset in the file of the chunk with these messages, or of the first of up to 250 messages
    outside of chunks."""


@dataclass(slots=True)
class McapContents:
    """Records that were read from an MCAP file, up to its end or its first damage.

    Messages are counted only, not stored.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    message_counts: dict[int, int] = field(default_factory=lambda: defaultdict(int))
    """Channel number → number of messages read, including topics that were not requested."""
    channels_declared_in_chunks: set[int] = field(default_factory=set)
    """Numbers of the channels that were declared in chunks, and are covered by a checksum there."""
    skipped_record_texts: list[str] = field(default_factory=list)
    """Descriptions of the damaged records that were skipped, each the end of a sentence that begins
    with the file's name. The last one states how many more there are than `MAX_SKIPPED_TEXTS`."""
    stated_message_counts: dict[int, int] = field(default_factory=dict)
    """Channel number → number of messages that the file's statistics state, for a damaged file read
    in salvage mode. It is empty for a sound file and if the statistics are damaged."""
    intact_bytes: int = 0
    """Number of bytes at the start of the file that were read without error."""
    has_correct_checksum: bool = False
    """Whether the file has a correct checksum over its whole data section."""
    is_complete: bool = False
    """Whether the file ends with the footer and the magic bytes of a complete MCAP file."""
    damage: str | None = None
    """Description of the damage at which reading stopped, as the end of a sentence that begins with
    the file's name. None if the whole file was read."""

    def message_count(self, topic: str) -> int:
        """Return the number of messages of a topic that were read."""
        topic_channel_ids = [
            channel.id for channel in self.channels.values() if channel.topic == topic
        ]
        return sum(self.message_counts[channel] for channel in topic_channel_ids)


def message_starts(message_runs: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the byte offset of each message in a buffer that consists of consecutive runs.

    `message_runs`, shape (n, 3), are the channel number, the length of a message record in bytes,
    and the message count. The offsets, one for each message, count from the beginning of the first
    message.
    """
    _, message_sizes, run_message_counts = message_runs.T
    run_bytes = message_sizes * run_message_counts
    index_in_run = np.arange(run_message_counts.sum()) - np.repeat(
        np.cumsum(run_message_counts) - run_message_counts, run_message_counts
    )
    return np.asarray(
        np.repeat(np.cumsum(run_bytes) - run_bytes, run_message_counts)
        + index_in_run * np.repeat(message_sizes, run_message_counts)
    )


OnBlock = Callable[[McapContents, MessageBlock], None]
"""Callback for each block of messages; its first argument is the contents read so far."""

IsChunkNeeded = Callable[[McapContents, int, int], bool]
"""Function that returns whether a chunk is read. Its arguments are the contents read so far, and
the log times in nanoseconds of the first and the last message that the chunk states."""


def read_mcap(
    file_data: memoryview,
    topics: Collection[str] | None,
    *,
    on_block: OnBlock | None = None,
    is_salvage: bool = False,
    on_progress: Callable[[float], None] | None = None,
    is_chunk_needed: IsChunkNeeded | None = None,
) -> McapContents:
    """Read an MCAP file up to its end or its first damage.

    Pages of an ``mmap`` are released when they have been read. `on_block` is called with the
    messages of `topics` (None: all), block by block in the order of the file, before it is known
    whether the rest of the file is damaged. `on_progress` is called repeatedly with the fraction of
    the file that was read, from 0 to 1. Chunks for which `is_chunk_needed` is false are neither
    decompressed nor checked, and then neither are the checksum and the statistics of the file.

    With `is_salvage`, read as much as possible: skip damaged records outside of chunks on which no
    message depends, and read the statistics of a damaged file. `McapContents.damage` states
    whether, where and why reading stopped. Raise `McapError` if the file does not begin like an
    MCAP file, or its schemas, channels, metadata and attachments are longer than
    `MAX_DECLARATION_BYTES`. Raise `McapTooLargeError` if the file is too long, or contains too many
    records.
    """
    if bytes(file_data[: len(MAGIC)]) != MAGIC:
        raise McapError("is not an MCAP file")
    if len(file_data) > limits.MAX_FILE_BYTES:
        raise McapTooLargeError(
            f"has {len(file_data) >> 20} MiB, more than the {limits.MAX_FILE_BYTES >> 20} MiB "
            "that are read"
        )
    container_reader = _ContainerReader(
        file_data, topics, on_block, is_salvage=is_salvage, is_chunk_needed=is_chunk_needed
    )
    mcap_contents = container_reader.contents
    mcap_contents.is_complete = _has_footer(file_data)
    try:
        container_reader.read(on_progress)
    except McapDamageError as error:
        mcap_contents.damage = str(error)
        if is_salvage and mcap_contents.is_complete:
            mcap_contents.stated_message_counts = container_reader.stated_message_counts()
    except MemoryError:
        mcap_contents.damage = "does not fit into the memory of this machine"
    return mcap_contents


def _has_footer(file_data: memoryview) -> bool:
    """Return whether an MCAP file ends with a footer record and the magic bytes."""
    footer_position = len(file_data) - len(MAGIC) - FOOTER_FORMAT.size
    if footer_position < len(MAGIC) or bytes(file_data[-len(MAGIC) :]) != MAGIC:
        return False
    return RECORD_HEAD_FORMAT.unpack_from(file_data, footer_position) == (
        Opcode.FOOTER,
        _FOOTER_CONTENT_SIZE,
    )


def _locate_record(
    file_data: Buffer, record_offset: int, location_text: str
) -> tuple[int, int, int]:
    """Return the opcode of the record at byte `record_offset`, and start and end of its content.

    `location_text` ends the error message for a truncated record.
    """
    content_start = record_offset + RECORD_HEAD_FORMAT.size
    if content_start > len(file_data):
        raise _truncated_record_error(record_offset, location_text)
    opcode, content_length = RECORD_HEAD_FORMAT.unpack_from(file_data, record_offset)
    if opcode == 0:
        raise _missing_record_error(record_offset, location_text)
    content_end = content_start + content_length
    if content_end > len(file_data):
        raise _truncated_record_error(record_offset, location_text)
    return opcode, content_start, content_end


def _truncated_record_error(record_offset: int, location_text: str) -> McapDamageError:
    """Return the error for a file that ends within a record."""
    return McapDamageError(
        f"ends in the middle of a record, at byte {record_offset}{location_text}"
    )


def _missing_record_error(record_offset: int, location_text: str) -> McapDamageError:
    """Return the error for a position at which a record must begin but does not."""
    return McapDamageError(
        f"has no record where one must be, at byte {record_offset}{location_text}"
    )


class _ContainerReader:
    """Reader of one MCAP file from its start, with the arguments of `read_mcap`."""

    def __init__(
        self,
        file_data: memoryview,
        topics: Collection[str] | None,
        on_block: OnBlock | None,
        *,
        is_salvage: bool,
        is_chunk_needed: IsChunkNeeded | None,
    ) -> None:
        self.contents = McapContents(intact_bytes=len(MAGIC))
        self._is_chunk_needed = is_chunk_needed
        self._has_omitted_chunks = False
        self._is_salvage = is_salvage
        self._data = file_data
        self._topics = topics
        self._on_block = on_block
        self._wanted_by_channel: dict[int, bool] = {}  # channel → whether its messages are wanted
        self._budget = ReadingBudget()
        self._zstd = zstd_decompressor()
        self._skipped = 0
        self._group_position = 0  # offset of the first of a group of messages outside of chunks
        self._remaining_group_messages = 0  # how many more messages can join that group
        self._declarations: dict[tuple[int, bytes], bytes] = {}  # opcode and number → content
        self._crc = 0
        self._released_end = 0  # end of the part whose checksum is computed and memory released

    def read(self, on_progress: Callable[[float], None] | None) -> None:
        """Read all records into `contents`; raise McapDamageError at the first damage."""
        data, contents = self._data, self.contents
        record_end = len(MAGIC)
        while record_end < len(data):
            record_offset = record_end
            opcode, content_start, record_end = _locate_record(data, record_offset, "")
            self._budget.count_steps(1)
            if opcode == Opcode.MESSAGE_INDEX:  # several follow each chunk
                contents.intact_bytes = record_end
                continue
            if opcode == Opcode.CHUNK:
                self._read_chunk(data[content_start:record_end], record_offset)
                if on_progress is not None:
                    on_progress(record_end / len(data))
            elif opcode == Opcode.MESSAGE:
                record_end = self._read_unchunked_messages(record_offset, record_end)
                if on_progress is not None:
                    on_progress(record_end / len(data))
            elif opcode == Opcode.DATA_END:
                self._check_data_end(data[content_start:record_end], record_offset)
                contents.intact_bytes = record_end
                self._check_summary(record_end)
                contents.intact_bytes = len(data)
                return
            elif opcode == Opcode.FOOTER:
                break
            else:
                try:
                    self._read_declaration(
                        opcode, data[content_start:record_end], f" at byte {record_offset}"
                    )
                except McapDamageError as error:
                    if not self._is_salvage:
                        raise
                    self._add_skipped(str(error))
            contents.intact_bytes = record_end
            if record_end - self._released_end > _RELEASE_INTERVAL_BYTES:
                self._release_up_to(record_end)
        raise McapDamageError("has no end of its data section")

    def _add_skipped(self, damage_text: str) -> None:
        """Store the description of a skipped record, or count it beyond `MAX_SKIPPED_TEXTS`."""
        self._skipped += 1
        skipped_texts = self.contents.skipped_record_texts
        if self._skipped > MAX_SKIPPED_TEXTS:
            del skipped_texts[MAX_SKIPPED_TEXTS:]
            damage_text = f"has {self._skipped - MAX_SKIPPED_TEXTS} more damaged records"
        skipped_texts.append(damage_text)

    def _release_up_to(self, read_end: int) -> None:
        """Update the checksum of the data section up to an offset, and release memory before it."""
        if self._has_omitted_chunks:  # then no checksum is verified
            self._release_pages()
        else:
            self._crc = self._crc_of_range(self._released_end, read_end, self._crc)
        self._released_end = read_end

    def _crc_of_range(self, range_start: int, range_end: int, crc: int = 0) -> int:
        """Return the CRC-32 of a range of bytes, continuing from `crc`."""
        for part_start in range(range_start, range_end, _RELEASE_INTERVAL_BYTES):
            crc = zlib.crc32(
                self._data[part_start : min(part_start + _RELEASE_INTERVAL_BYTES, range_end)], crc
            )
            self._release_pages()
        return crc

    def _release_pages(self) -> None:
        """Release the memory pages of the mapped file, which count as memory of the process."""
        mapped_file = self._data.obj
        if len(self._data) > _RELEASE_INTERVAL_BYTES and isinstance(mapped_file, mmap.mmap):
            mapped_file.madvise(mmap.MADV_DONTNEED)

    def _read_unchunked_messages(self, first_message_start: int, first_message_end: int) -> int:
        """Read consecutive messages outside of chunks, and return the offset where they end.

        The first message is the record from `first_message_start` to `first_message_end`.
        """
        location_text = f" at byte {first_message_start}"
        if first_message_end - first_message_start < MESSAGE_HEAD_FORMAT.size:
            raise McapDamageError(f"has a message that is too short{location_text}")
        if self._is_stray_message(_RUN_HEAD_FORMAT.unpack_from(self._data, first_message_start)[2]):
            # The writing program uses chunks: this is another record, with a damaged opcode.
            raise McapDamageError(f"has a message outside of a chunk{location_text}")
        if self._remaining_group_messages == 0:
            self._group_position, self._remaining_group_messages = (
                first_message_start,
                _MAX_GROUP_MESSAGES,
            )
        max_messages_end = min(
            len(self._data), max(first_message_end, first_message_start + MAX_UNPACKED_BYTES)
        )
        messages_end, message_count = self._read_messages(
            self._data,
            first_message_start,
            max_messages_end,
            self._group_position,
            location_text,
            self._remaining_group_messages,
        )
        self._remaining_group_messages -= message_count
        return messages_end

    def _is_stray_message(self, channel_id: int) -> bool:
        """Return whether a message outside of chunks is treated as damage in salvage mode.

        It is if its channel was declared in chunks.
        """
        return self._is_salvage and channel_id in self.contents.channels_declared_in_chunks

    def _read_declaration(self, opcode: int, record_content: Buffer, location_text: str) -> None:
        """Store a schema, channel, metadata record or attachment; ignore other kinds of record."""
        mcap_contents = self.contents
        if opcode not in _DECLARATION_OPCODES:
            return
        self._budget.count_steps(READING_STEPS_PER_DECLARATION)
        # Many writers repeat schemas and channels in every chunk; a repetition takes no memory.
        declaration_key = (opcode, bytes(record_content[: _CHANNEL_NUMBER_FORMAT.size]))
        if self._declarations.get(declaration_key) == record_content:
            return
        self._budget.count_declaration(opcode, record_content, location_text)
        if opcode == Opcode.SCHEMA:
            schema = parse_record(Schema.read, record_content, location_text)
            if mcap_contents.schemas.setdefault(schema.id, schema) != schema:
                raise McapDamageError(
                    f"declares schema {schema.id} twice, differently{location_text}"
                )
            self._declarations[declaration_key] = bytes(record_content)
        elif opcode == Opcode.CHANNEL:
            channel = parse_record(Channel.read, record_content, location_text)
            if mcap_contents.channels.setdefault(channel.id, channel) != channel:
                raise McapDamageError(
                    f"declares channel {channel.id} twice, differently{location_text}"
                )
            self._wanted_by_channel[channel.id] = (
                self._topics is None or channel.topic in self._topics
            )
            self._declarations[declaration_key] = bytes(record_content)
        elif opcode == Opcode.METADATA:
            mcap_contents.metadata.append(
                parse_record(Metadata.read, record_content, location_text)
            )
        elif opcode == Opcode.ATTACHMENT:
            if len(record_content) >= 4:
                (crc,) = struct.unpack_from("<I", record_content, len(record_content) - 4)
                if crc not in (0, zlib.crc32(record_content[:-4])):
                    raise McapDamageError(f"has an attachment with a wrong checksum{location_text}")
            mcap_contents.attachments.append(
                parse_record(Attachment.read, record_content, location_text)
            )

    def _read_chunk(self, chunk_content: memoryview, chunk_position: int) -> None:
        """Decompress a chunk, verify its checksum, and read the records in it."""
        location_text = f" in the chunk at byte {chunk_position}"
        try:
            first_log_time, last_log_time, stated_size, stated_crc = _CHUNK_HEAD_FORMAT.unpack_from(
                chunk_content
            )
            if self._is_chunk_needed is not None and not self._is_chunk_needed(
                self.contents, first_log_time, last_log_time
            ):
                self._has_omitted_chunks = True
                return
            self._budget.count_steps(READING_STEPS_PER_CHUNK)
            compression_name, packed_position = read_prefixed_bytes(
                chunk_content, _CHUNK_HEAD_FORMAT.size, "<I"
            )
            packed_bytes, _ = read_prefixed_bytes(chunk_content, packed_position, "<Q")
        except struct.error:
            raise McapDamageError(f"has a malformed header{location_text}") from None
        self._budget.count_unpacked_bytes(stated_size, location_text)
        compression = bytes(compression_name[:20])
        if stated_size <= MAX_UNPACKED_BYTES:
            unpacked_records = decompressed_chunk(
                self._zstd, compression, packed_bytes, stated_size, location_text
            )
            if stated_crc not in (0, zlib.crc32(unpacked_records)):
                raise McapDamageError(f"has a wrong checksum{location_text}")
            records_end = self._read_records(unpacked_records, 0, chunk_position, location_text)
            if records_end < len(unpacked_records):
                raise _truncated_record_error(records_end, location_text)
            return
        # Too long for memory: decompressed once to verify the checksum, and again to be read.
        unpacked_bytes, unpacked_crc = 0, 0
        for unpacked_part in decompressed_parts(
            self._zstd, compression, packed_bytes, stated_size, location_text
        ):
            unpacked_bytes += len(unpacked_part)
            unpacked_crc = zlib.crc32(unpacked_part, unpacked_crc)
            self._release_pages()
        if unpacked_bytes != stated_size:
            raise McapDamageError(f"decompresses to a wrong size{location_text}")
        if stated_crc not in (0, unpacked_crc):
            raise McapDamageError(f"has a wrong checksum{location_text}")
        self._read_parts(
            decompressed_parts(self._zstd, compression, packed_bytes, stated_size, location_text),
            chunk_position,
            location_text,
        )

    def _read_parts(
        self, record_parts: Iterator[Buffer], chunk_position: int, location_text: str
    ) -> None:
        """Read the records of a chunk that arrives in parts; a record may span several parts."""
        remainder = b""  # beginning of a record whose end is in a later part
        remainder_offset = 0  # offset of `remainder` in the chunk
        bytes_to_skip = 0  # remaining bytes of an unwanted record
        for record_part in record_parts:
            self._release_pages()
            if bytes_to_skip >= len(record_part):
                bytes_to_skip -= len(record_part)
                remainder_offset += len(record_part)
                continue
            remainder += record_part[bytes_to_skip:]
            remainder_offset += bytes_to_skip
            bytes_to_skip = 0
            used_bytes = self._read_records(
                remainder, remainder_offset, chunk_position, location_text
            )
            remainder = remainder[used_bytes:]
            remainder_offset += used_bytes
            if len(remainder) >= _RUN_HEAD_FORMAT.size:
                bytes_to_skip = self._skippable_bytes(remainder, remainder_offset, location_text)
                if bytes_to_skip:
                    remainder_offset += len(remainder)
                    bytes_to_skip -= len(remainder)
                    remainder = b""
        if remainder or bytes_to_skip:
            raise _truncated_record_error(remainder_offset, location_text)

    def _skippable_bytes(self, record_bytes: bytes, buffer_offset: int, location_text: str) -> int:
        """Return the length in bytes of a buffer's first record if it can be skipped, else 0."""
        opcode, length, channel_id = _RUN_HEAD_FORMAT.unpack_from(record_bytes)
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            if length > limits.MAX_DECLARATION_TEXT_BYTES:
                raise _truncated_record_error(buffer_offset, location_text)
            return 0
        if opcode == Opcode.MESSAGE:
            if self._wanted_by_channel.get(channel_id, True) and self._is_accepted_length(
                length, location_text
            ):
                return 0
            self.contents.message_counts[channel_id] += 1
        return int(length) + RECORD_HEAD_FORMAT.size

    def _is_accepted_length(self, message_length: int, location_text: str) -> bool:
        """Return whether a message does not exceed the maximum length.

        For a longer message, store in salvage mode that it is skipped, else raise McapDamageError.
        """
        if message_length <= limits.MAX_MESSAGE_BYTES:
            return True
        damage_text = (
            f"has a message of {message_length} bytes{location_text}, more than the "
            f"{limits.MAX_MESSAGE_BYTES >> 20} MiB that are accepted"
        )
        if not self._is_salvage:
            raise McapDamageError(damage_text)
        self._add_skipped(damage_text)
        return False

    def _read_records(
        self, record_bytes: bytes, buffer_offset: int, chunk_position: int, location_text: str
    ) -> int:
        """Read the complete records of a buffer, and return the offset where the last one ends.

        `buffer_offset` is the offset of the buffer in its chunk.
        """
        record_end = 0
        while record_end < len(record_bytes):
            record_offset = record_end
            record_end, message_count = self._read_messages(
                record_bytes, record_offset, len(record_bytes), chunk_position, location_text
            )
            if message_count:
                continue
            if record_offset + RECORD_HEAD_FORMAT.size > len(record_bytes):
                return record_offset
            opcode, length = RECORD_HEAD_FORMAT.unpack_from(record_bytes, record_offset)
            if opcode == 0:
                raise _missing_record_error(buffer_offset + record_offset, location_text)
            content_start = record_offset + RECORD_HEAD_FORMAT.size
            record_end = content_start + length
            if record_end > len(record_bytes):
                return record_offset
            self._budget.count_steps(1)
            if opcode == Opcode.MESSAGE:
                raise McapDamageError(f"has a message that is too short{location_text}")
            self._read_declaration(opcode, record_bytes[content_start:record_end], location_text)
            if opcode == Opcode.CHANNEL:
                (channel_id,) = _CHANNEL_NUMBER_FORMAT.unpack_from(record_bytes, content_start)
                self.contents.channels_declared_in_chunks.add(channel_id)
        return record_end

    def _read_messages(
        self,
        record_bytes: Buffer,
        first_message_start: int,
        max_messages_end: int,
        chunk_position: int,
        location_text: str,
        max_messages: int | None = None,
    ) -> tuple[int, int]:
        """Pass messages from an offset on to the callback, at most up to `max_messages_end`.

        Reading stops before a record of another kind. `max_messages` limits the number of messages
        outside of chunks. Returns the offset after the last message, and the number of messages.
        """
        unpack_run_head = _RUN_HEAD_FORMAT.unpack_from
        wanted_by_channel, message_counts = self._wanted_by_channel, self.contents.message_counts
        message_runs: list[MessageRun] = []
        run_start = first_message_start
        message_count = run_count = 0  # number of messages, and number of runs of messages
        try:
            while (
                run_start + MESSAGE_HEAD_FORMAT.size <= max_messages_end
                and run_count < _MAX_BLOCK_RUNS
            ):
                run_head = unpack_run_head(record_bytes, run_start)
                opcode, length, channel_id = run_head
                message_size = length + RECORD_HEAD_FORMAT.size
                if (
                    opcode != Opcode.MESSAGE
                    or message_size < MESSAGE_HEAD_FORMAT.size
                    or run_start + message_size > max_messages_end
                ):
                    break
                is_wanted = wanted_by_channel.get(channel_id)
                if is_wanted is None:
                    raise McapDamageError(
                        f"has a message of an undeclared channel {channel_id}{location_text}"
                    )
                if max_messages is not None and (
                    message_count == max_messages or self._is_stray_message(channel_id)
                ):
                    break
                message_end = run_start + message_size
                run_message_count = 1
                while (
                    message_end + message_size <= max_messages_end
                    and unpack_run_head(record_bytes, message_end) == run_head
                ):
                    message_end += message_size
                    run_message_count += 1
                    if run_message_count == _MAX_SINGLE_COMPARISONS:
                        run_message_count = _run_length(
                            record_bytes, run_start, message_size, max_messages_end
                        )
                        break
                if max_messages is not None:
                    run_message_count = min(run_message_count, max_messages - message_count)
                if is_wanted and self._is_accepted_length(length, location_text):
                    message_runs.append((channel_id, message_size, run_start, run_message_count))
                message_counts[channel_id] += run_message_count
                run_start += message_size * run_message_count
                message_count += run_message_count
                run_count += 1
        finally:
            if message_runs and self._on_block is not None:
                self._on_block(
                    self.contents, MessageBlock(record_bytes, message_runs, chunk_position)
                )
        self._budget.count_steps(run_count)
        return run_start, message_count

    def _check_data_end(self, record_content: memoryview, record_offset: int) -> None:
        """Verify the checksum over the data section, which `record_content` states."""
        if len(record_content) < 4:
            raise McapDamageError(
                f"has a malformed end of its data section at byte {record_offset}"
            )
        if self._has_omitted_chunks:
            return
        (crc,) = struct.unpack_from("<I", record_content)
        if crc != 0 and crc != self._crc_of_range(self._released_end, record_offset, self._crc):
            raise McapDamageError("has a wrong checksum over its data section")
        self.contents.has_correct_checksum = crc != 0

    def _check_summary(self, section_start: int) -> None:
        """Verify footer, checksum and message counts of the summary section, which may be empty."""
        data = self._data
        if not self.contents.is_complete:
            raise McapDamageError(
                "ends in the middle of its summary, or something was appended to it"
            )
        footer_position = len(data) - len(MAGIC) - FOOTER_FORMAT.size
        *_, summary_start, _, crc = FOOTER_FORMAT.unpack_from(data, footer_position)
        if summary_start not in (0, section_start) or (
            summary_start == 0 and footer_position != section_start
        ):
            raise McapDamageError(
                f"has a footer that contradicts its data section at byte {footer_position}"
            )
        if crc not in (
            0,
            self._crc_of_range(section_start, footer_position + FOOTER_FORMAT.size - 4),
        ):
            raise McapDamageError("has a wrong checksum over its summary")
        if self._has_omitted_chunks:  # then neither channels nor statistics can be compared
            return
        for opcode, record_content in self._summary_records(section_start, footer_position):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                # A channel without messages may be declared in the summary only.
                self._read_declaration(opcode, record_content, " in the summary")
            elif opcode == Opcode.STATISTICS:
                statistics = parse_record(Statistics.read, record_content, " in the summary")
                read_message_counts = self.contents.message_counts
                stated_message_counts = statistics.channel_message_counts
                if any(
                    read_message_counts[channel] != channel_count
                    for channel, channel_count in stated_message_counts.items()
                ):
                    raise McapDamageError("does not contain the messages that its statistics count")

    def _summary_records(
        self, section_start: int, footer_position: int
    ) -> Iterator[tuple[int, memoryview]]:
        """Yield opcode and content of each record between `section_start` and `footer_position`."""
        data, end, released_end = self._data[:footer_position], section_start, section_start
        while end < footer_position:
            opcode, content_start, end = _locate_record(data, end, " of the summary")
            if end - released_end > _RELEASE_INTERVAL_BYTES:
                released_end = end
                self._release_pages()
            # Each channel in the statistics takes time.
            is_statistics = opcode == Opcode.STATISTICS
            self._budget.count_steps(1 + (end - content_start) // 4 if is_statistics else 1)
            yield opcode, data[content_start:end]

    def stated_message_counts(self) -> dict[int, int]:
        """Return the message count of each channel from the file's statistics.

        Returns an empty dictionary if the summary has no correct checksum.
        """
        data = self._data
        footer_position = len(data) - len(MAGIC) - FOOTER_FORMAT.size
        *_, summary_start, _, crc = FOOTER_FORMAT.unpack_from(data, footer_position)
        if not len(MAGIC) <= summary_start <= footer_position:
            return {}
        if crc == 0 or crc != self._crc_of_range(
            summary_start, footer_position + FOOTER_FORMAT.size - 4
        ):
            return {}
        try:
            for opcode, record_content in self._summary_records(summary_start, footer_position):
                if opcode == Opcode.STATISTICS:
                    statistics = parse_record(Statistics.read, record_content, "")
                    return dict(statistics.channel_message_counts)
        except McapDamageError:
            pass
        return {}


def parse_record(
    read_record: Callable[[ReadDataStream], _Record], record_content: Buffer, location_text: str
) -> _Record:
    """Return a record parsed with the ``mcap`` package; raise McapDamageError if malformed."""
    try:
        stream = ReadDataStream(BytesIO(record_content))
        parsed_record = read_record(stream)
    except (EndOfFile, struct.error, UnicodeDecodeError, OverflowError):
        raise McapDamageError(f"has a malformed record{location_text}") from None
    return parsed_record


def _run_length(
    record_bytes: Buffer, run_start: int, message_size: int, max_messages_end: int
) -> int:
    """Return the number of consecutive records with equal opcode, length and channel.

    All counted records end before the byte offset `max_messages_end`. The number of records that
    are compared at once increases, so that a short run in a long chunk takes little time.
    """
    (first_head, first_tail) = np.frombuffer(
        record_bytes[run_start : run_start + _RUN_HEAD_DTYPE.itemsize], _RUN_HEAD_DTYPE
    )[0]
    max_message_count = (max_messages_end - run_start) // message_size
    equal_count, messages_to_compare = 1, _FIRST_COMPARISON_MESSAGES
    while equal_count < max_message_count:
        compared_count = min(messages_to_compare, max_message_count - equal_count)
        run_heads = np.ndarray(
            compared_count,
            _RUN_HEAD_DTYPE,
            record_bytes,
            run_start + equal_count * message_size,
            (message_size,),
        )
        is_equal = (run_heads["head"] == first_head) & (run_heads["tail"] == first_tail)
        first_different_index = int(is_equal.argmin())
        if not is_equal[first_different_index]:
            return equal_count + first_different_index
        equal_count += compared_count
        messages_to_compare *= 8
    return equal_count
