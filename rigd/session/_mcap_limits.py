"""Decompression of MCAP chunks, and limits on memory and time for reading an MCAP file.

A few bytes may decompress to any number of records. Therefore `MAX_CHUNK_BYTES` limits the stated
size of a chunk, and `MAX_TOTAL_UNPACKED_BYTES` the sum of these sizes over the file. A long chunk
is decompressed in parts. Each record or run of messages counts as work against `MAX_READING_STEPS`.
"""

import struct
from collections.abc import Iterator
from typing import Final

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from rigd.session import limits
from rigd.session.layout import Buffer

MAX_SKIPPED_TEXTS: Final = 20
"""Maximum number of damaged records that are described one by one."""

READING_STEPS_PER_CHUNK: Final = 20
"""Number of steps of work, out of `MAX_READING_STEPS`, that reading a chunk costs."""
READING_STEPS_PER_DECLARATION: Final = 15
"""Number of steps, out of `MAX_READING_STEPS`, that a schema, channel or attachment costs."""

_DECLARATION_MEMORY_BYTES: Final = 1000
"""Approximate memory in bytes of the Python object for a declaration of any length."""

MAX_UNPACKED_BYTES: Final = 4 << 20
"""Maximum size in bytes of a chunk that is decompressed at once, and of a longer chunk's parts."""
_LZ4_INPUT_BYTES: Final = 1 << 18
"""Number of compressed bytes that are passed to the LZ4 decompressor at once."""
_MAX_ZSTD_WINDOW_BYTES: Final = 32 << 20
"""Maximum memory in bytes of the Zstandard decompressor's window."""


class McapError(Exception):
    """Raised if a file is not a usable MCAP file.

    The message ends a sentence that begins with the file's name.
    """


class McapTooLargeError(McapError):
    """Raised if reading an MCAP file would take too much memory or time.

    The message ends a sentence that begins with the file's name.
    """


class McapDamageError(Exception):
    """Raised if a file is damaged or violates the MCAP format.

    The message ends a sentence that begins with the file's name.
    """


class ReadingBudget:
    """Counters of work and memory for one MCAP file, which raise an error above the limits."""

    def __init__(self) -> None:
        self._used_steps = 0
        self._unpacked_bytes = 0
        self._declared_bytes = 0
        self._declared_text_bytes = 0
        self._key_count = 0

    def count_steps(self, step_count: int) -> None:
        """Count steps of work; raise McapTooLargeError if the file exceeds `MAX_READING_STEPS`."""
        self._used_steps += step_count
        if self._used_steps > limits.MAX_READING_STEPS:
            raise McapTooLargeError(
                "is made of so many small parts that reading it would take too long: more than "
                f"{limits.MAX_READING_STEPS} runs of messages, chunks and other records, each "
                "weighed by its work"
            )

    def count_unpacked_bytes(self, chunk_length: int, location_text: str) -> None:
        """Count the stated size of a chunk in bytes before the chunk is decompressed.

        Raises McapDamageError if the chunk, or all chunks of the file together, are too long.
        """
        self._unpacked_bytes += chunk_length
        if (
            chunk_length > limits.MAX_CHUNK_BYTES
            or self._unpacked_bytes > limits.MAX_TOTAL_UNPACKED_BYTES
        ):
            raise McapDamageError(
                f"claims {chunk_length} bytes{location_text}, which is more than the "
                f"{limits.MAX_CHUNK_BYTES >> 20} MiB for a chunk or the "
                f"{limits.MAX_TOTAL_UNPACKED_BYTES >> 20} MiB for a file that are accepted"
            )

    def count_declaration(self, opcode: int, record_content: Buffer, location_text: str) -> None:
        """Count the memory of a schema, channel, metadata record or attachment before parsing.

        `location_text` ends the error message. Raises McapError if the file has too many such
        records, or too long ones.
        """
        self._declared_bytes += len(record_content) + _DECLARATION_MEMORY_BYTES
        if opcode != Opcode.ATTACHMENT:
            self._declared_text_bytes += len(record_content)
        if opcode in (Opcode.METADATA, Opcode.CHANNEL):
            self._key_count += _count_keys(record_content, opcode, limits.MAX_METADATA_KEYS)
        for used_bytes, max_bytes, unit_text in (
            (
                self._declared_bytes,
                limits.MAX_DECLARATION_BYTES,
                "MiB of channels, schemas, metadata and files",
            ),
            (
                self._declared_text_bytes,
                limits.MAX_DECLARATION_TEXT_BYTES,
                "MiB of channels, schemas and metadata",
            ),
        ):
            if used_bytes > max_bytes:
                raise McapError(
                    "declares channels, schemas, metadata and attachments without limit: more than "
                    f"{max_bytes >> 20} {unit_text}{location_text}"
                )
        if self._key_count > limits.MAX_METADATA_KEYS:
            raise McapError(
                f"has more than {limits.MAX_METADATA_KEYS} keys in its metadata{location_text}"
            )


def zstd_decompressor() -> zstandard.ZstdDecompressor:
    """Return a Zstandard decompressor; one decompressor is used for all chunks of a file."""
    return zstandard.ZstdDecompressor(max_window_size=_MAX_ZSTD_WINDOW_BYTES)


def decompressed_chunk(
    decompressor: zstandard.ZstdDecompressor,
    compression: bytes,
    packed_bytes: memoryview,
    unpacked_length: int,
    location_text: str,
) -> bytes:
    """Return the decompressed content of a chunk, which must have exactly `unpacked_length` bytes.

    The compression is ``zstd``, ``lz4``, or empty for none. `decompressor` is made by
    :func:`zstd_decompressor`. `location_text` is the position of the chunk, for error messages.
    Raise `McapDamageError` if the content cannot be decompressed, or has another length.
    """
    try:
        if compression == b"":
            unpacked_records = bytes(packed_bytes[: unpacked_length + 1])
        elif compression == b"zstd":
            _check_zstd_size(packed_bytes, unpacked_length, location_text)
            unpacked_records = decompressor.decompress(
                packed_bytes, max_output_size=unpacked_length
            )
        elif compression == b"lz4":
            # One byte more than allowed, so that a longer chunk is detected.
            unpacked_records = lz4.frame.LZ4FrameDecompressor().decompress(
                packed_bytes, max_length=unpacked_length + 1
            )
        else:
            raise McapDamageError(f"uses the unknown compression {compression!r}{location_text}")
    except (zstandard.ZstdError, RuntimeError, ValueError):
        raise McapDamageError(f"does not decompress{location_text}") from None
    if len(unpacked_records) != unpacked_length:
        raise McapDamageError(f"decompresses to a wrong size{location_text}")
    return unpacked_records


def decompressed_parts(
    decompressor: zstandard.ZstdDecompressor,
    compression: bytes,
    packed_bytes: memoryview,
    stated_length: int,
    location_text: str,
) -> Iterator[Buffer]:
    """Yield the decompressed content of a long chunk in parts.

    All parts together may be longer than `stated_length` by one part, because the caller compares
    the length. Otherwise parameters and errors are those of :func:`decompressed_chunk`.
    """
    unpacked_length = 0
    try:
        if compression == b"":
            for input_position in range(0, len(packed_bytes), MAX_UNPACKED_BYTES):
                yield packed_bytes[input_position : input_position + MAX_UNPACKED_BYTES]
        elif compression == b"zstd":
            _check_zstd_size(packed_bytes, stated_length, location_text)
            zstd_stream = decompressor.stream_reader(packed_bytes)
            while unpacked_length <= stated_length and (
                unpacked_part := zstd_stream.read(MAX_UNPACKED_BYTES)
            ):
                unpacked_length += len(unpacked_part)
                yield unpacked_part
        elif compression == b"lz4":
            lz4_stream = lz4.frame.LZ4FrameDecompressor()
            for input_position in range(0, len(packed_bytes), _LZ4_INPUT_BYTES):
                lz4_input: Buffer = packed_bytes[input_position : input_position + _LZ4_INPUT_BYTES]
                while not lz4_stream.eof and unpacked_length <= stated_length:
                    unpacked_part = lz4_stream.decompress(lz4_input, max_length=MAX_UNPACKED_BYTES)
                    unpacked_length += len(unpacked_part)
                    if unpacked_part:
                        yield unpacked_part
                    if lz4_stream.needs_input:
                        break
                    lz4_input = b""
        else:
            raise McapDamageError(f"uses the unknown compression {compression!r}{location_text}")
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError):
        raise McapDamageError(f"does not decompress{location_text}") from None


def _check_zstd_size(packed_bytes: memoryview, chunk_length: int, location_text: str) -> None:
    """Raise if the Zstandard frame of a chunk states another size than the chunk.

    The decompressor would allocate the memory that the frame states.
    """
    stated_size = zstandard.get_frame_parameters(packed_bytes).content_size
    if stated_size not in (chunk_length, zstandard.CONTENTSIZE_UNKNOWN):
        raise McapDamageError(f"states two different sizes{location_text}")


def read_prefixed_bytes(
    record_content: memoryview, length_position: int, length_format: str
) -> tuple[memoryview, int]:
    """Return the bytes after the length field at `length_position`, and the offset where they end.

    `length_format` is the format of the length field for the module ``struct``.
    """
    (byte_count,) = struct.unpack_from(length_format, record_content, length_position)
    bytes_start = length_position + struct.calcsize(length_format)
    if byte_count > len(record_content) - bytes_start:
        raise struct.error
    return record_content[bytes_start : bytes_start + byte_count], bytes_start + byte_count


def _count_keys(record_content: Buffer, opcode: int, max_count: int) -> int:
    """Return the number of keys in a metadata or channel record, counted up to `max_count` + 1.

    Counting ends at a malformed entry, which raises an error when the record is parsed.
    """
    content_view = memoryview(record_content)
    key_count = 0
    try:
        if opcode == Opcode.METADATA:
            _, position = read_prefixed_bytes(content_view, 0, "<I")
        else:
            _, position = read_prefixed_bytes(content_view, 4, "<I")
            _, position = read_prefixed_bytes(content_view, position, "<I")
        map_entries, _ = read_prefixed_bytes(content_view, position, "<I")
        position = 0
        while position < len(map_entries) and key_count <= max_count:
            _, position = read_prefixed_bytes(map_entries, position, "<I")
            _, position = read_prefixed_bytes(map_entries, position, "<I")
            key_count += 1
    except struct.error:
        pass
    return key_count
