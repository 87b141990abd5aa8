"""Writer of MCAP files, which writes a whole chunk at a time.

The writer of the ``mcap`` package accepts single messages only and takes several microseconds for
each. Here the caller passes all records of a chunk and their index at once; the ``mcap`` package
serialises all other records of the file. Format: https://mcap.dev/spec, version 0.
"""

import struct
import zlib
from collections.abc import Iterable, Mapping
from typing import BinaryIO, Final

import lz4.frame
import numpy as np
import numpy.typing as npt
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC: Final = b"\x89MCAP0\r\n"
"""Bytes with which every MCAP file begins and ends."""
# Compared with zstd at level 3, files are 20 % larger, and (de)compression takes half the time.
COMPRESSION: Final = "lz4"
_CHUNK_HEAD_FORMAT: Final = struct.Struct(f"<BQ QQQI I{len(COMPRESSION)}s Q")
_INDEX_HEAD_FORMAT: Final = struct.Struct("<BQ HI")
_FOOTER_HEAD_FORMAT: Final = struct.Struct("<BQ QQ")
RECORD_HEAD_SIZE: Final = 9
"""Number of bytes of a record's opcode and length field, which the length field does not count."""

MESSAGE_HEAD_FORMAT: Final = struct.Struct("<BQ HIQQ")
"""Format of the bytes before a message's data: opcode, length, channel, sequence, log and publish
time."""
LOG_TIME_OFFSET: Final = RECORD_HEAD_SIZE + 2 + 4
"""Offset of the log time in a message record, in bytes."""

INDEX_DTYPE: Final = np.dtype([("log_time", "<u8"), ("offset", "<u8")])
"""Entry of a message index: log time in ns, and offset of the record in the uncompressed chunk."""


class McapWriter:
    """Writer of an MCAP file with LZ4-compressed chunks, message indexes and all checksums.

    `stream` is an empty file that is open for binary writing. `library` is the program name that is
    written to the file's header.
    """

    def __init__(self, stream: BinaryIO, library: str) -> None:
        self._stream = stream
        self._position = 0
        self._data_crc = 0
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunk_indexes: list[ChunkIndex] = []
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._message_counts: dict[int, int] = {}
        self._start_time: int | None = None
        self._end_time = 0
        self._write(MAGIC + _record_bytes(Header(profile="", library=library)))

    def _write(self, record_bytes: bytes) -> int:
        """Append bytes to the data section, and return their offset in the file."""
        position = self._position
        self._stream.write(record_bytes)
        self._data_crc = zlib.crc32(record_bytes, self._data_crc)
        self._position += len(record_bytes)
        return position

    def declare(self, schemas: Iterable[Schema], channels: Iterable[Channel]) -> None:
        """Write all schemas and channels in a separate chunk, which has a checksum."""
        self._schemas = list(schemas)
        self._channels = list(channels)
        self._message_counts = {channel.id: 0 for channel in self._channels}
        self.add_chunk(b"".join(map(_record_bytes, [*self._schemas, *self._channels])), {})

    def add_metadata(self, record_name: str, metadata_values: Mapping[str, str]) -> None:
        """Append a metadata record with the given name, keys and values."""
        record_data = _record_bytes(Metadata(name=record_name, metadata=dict(metadata_values)))
        record_position = self._write(record_data)
        self._metadata_indexes.append(
            MetadataIndex(offset=record_position, length=len(record_data), name=record_name)
        )

    def add_attachment(
        self, attachment_name: str, media_type: str, attachment_data: bytes, time_ns: int
    ) -> None:
        """Append an attachment; `time_ns` becomes its creation time and log time."""
        attachment_record = _record_bytes(
            Attachment(
                create_time=time_ns,
                log_time=time_ns,
                name=attachment_name,
                media_type=media_type,
                data=attachment_data,
            )
        )
        record_position = self._write(attachment_record)
        self._attachment_indexes.append(
            AttachmentIndex(
                offset=record_position,
                length=len(attachment_record),
                log_time=time_ns,
                create_time=time_ns,
                data_size=len(attachment_data),
                name=attachment_name,
                media_type=media_type,
            )
        )

    def add_chunk(
        self, record_bytes: bytes, message_index_by_channel: Mapping[int, npt.NDArray[np.void]]
    ) -> None:
        """Compress and append a chunk of records, with its message indexes.

        The records follow one after another. `message_index_by_channel` has for each channel number
        an array of `INDEX_DTYPE`, which is not empty, in the order of the messages.
        """
        first_log_time = min(
            (
                int(message_index["log_time"].min())
                for message_index in message_index_by_channel.values()
            ),
            default=0,
        )
        last_log_time = max(
            (
                int(message_index["log_time"].max())
                for message_index in message_index_by_channel.values()
            ),
            default=0,
        )
        compressed_records = lz4.frame.compress(record_bytes)
        compression_name = COMPRESSION.encode()
        chunk_head = _CHUNK_HEAD_FORMAT.pack(
            Opcode.CHUNK,
            _CHUNK_HEAD_FORMAT.size - RECORD_HEAD_SIZE + len(compressed_records),
            first_log_time,
            last_log_time,
            len(record_bytes),
            zlib.crc32(record_bytes),
            len(compression_name),
            compression_name,
            len(compressed_records),
        )
        chunk_length = len(chunk_head) + len(compressed_records)
        chunk_and_indexes = [chunk_head, compressed_records]
        index_position = self._position + chunk_length
        index_offsets: dict[int, int] = {}
        index_length = 0
        for channel, message_index in message_index_by_channel.items():
            index_offsets[channel] = index_position + index_length
            index_entries = message_index.tobytes()
            index_record_length = _INDEX_HEAD_FORMAT.size - RECORD_HEAD_SIZE + len(index_entries)
            chunk_and_indexes += [
                _INDEX_HEAD_FORMAT.pack(
                    Opcode.MESSAGE_INDEX, index_record_length, channel, len(index_entries)
                ),
                index_entries,
            ]
            index_length += _INDEX_HEAD_FORMAT.size + len(index_entries)
            self._message_counts[channel] += len(message_index)
        chunk_position = self._write(b"".join(chunk_and_indexes))
        if message_index_by_channel:
            self._start_time = (
                first_log_time
                if self._start_time is None
                else min(first_log_time, self._start_time)
            )
            self._end_time = max(last_log_time, self._end_time)
        self._chunk_indexes.append(
            ChunkIndex(
                message_start_time=first_log_time,
                message_end_time=last_log_time,
                chunk_start_offset=chunk_position,
                chunk_length=chunk_length,
                message_index_offsets=index_offsets,
                message_index_length=index_length,
                compression=COMPRESSION,
                compressed_size=len(compressed_records),
                uncompressed_size=len(record_bytes),
            )
        )

    def finish(self) -> None:
        """Complete the file: write the end of the data section, the summary and the footer."""
        self._write(_record_bytes(DataEnd(data_section_crc=self._data_crc)))
        statistics = Statistics(
            message_count=sum(self._message_counts.values()),
            schema_count=len(self._schemas),
            channel_count=len(self._channels),
            attachment_count=len(self._attachment_indexes),
            metadata_count=len(self._metadata_indexes),
            chunk_count=len(self._chunk_indexes),
            message_start_time=self._start_time or 0,
            message_end_time=self._end_time,
            channel_message_counts=self._message_counts,
        )
        records_by_opcode: dict[Opcode, list[McapRecord]] = {
            Opcode.SCHEMA: [*self._schemas],
            Opcode.CHANNEL: [*self._channels],
            Opcode.STATISTICS: [statistics],
            Opcode.CHUNK_INDEX: [*self._chunk_indexes],
            Opcode.ATTACHMENT_INDEX: [*self._attachment_indexes],
            Opcode.METADATA_INDEX: [*self._metadata_indexes],
        }
        summary_builder = RecordBuilder()
        summary_offsets: list[SummaryOffset] = []
        for opcode, records in records_by_opcode.items():
            group_start = summary_builder.count
            for record in records:
                record.write(summary_builder)
            if records:
                summary_offsets.append(
                    SummaryOffset(
                        group_opcode=opcode,
                        group_start=self._position + group_start,
                        group_length=summary_builder.count - group_start,
                    )
                )
        offset_start = self._position + summary_builder.count
        for summary_offset in summary_offsets:
            summary_offset.write(summary_builder)
        summary_data = _built_bytes(summary_builder)
        # The summary's checksum covers the footer up to the checksum itself.
        footer_record = Footer(
            summary_start=self._position, summary_offset_start=offset_start, summary_crc=0
        )
        footer_record.summary_crc = zlib.crc32(
            _record_bytes(footer_record)[: _FOOTER_HEAD_FORMAT.size], zlib.crc32(summary_data)
        )
        self._stream.write(summary_data + _record_bytes(footer_record) + MAGIC)


def _record_bytes(record: McapRecord) -> bytes:
    """Return the bytes of an MCAP record."""
    builder = RecordBuilder()
    record.write(builder)
    return _built_bytes(builder)


def _built_bytes(builder: RecordBuilder) -> bytes:
    """Return the bytes that were written to a record builder."""
    record_data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return record_data
