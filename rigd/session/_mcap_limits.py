"""Limits on memory and time for reading an MCAP file, and the unpacking of its chunks.

A few bytes may unpack to any number of records. Therefore `MAX_CHUNK_BYTES` bounds the stated size
of a chunk, and `MAX_TOTAL_BYTES` their sum over the file; a long chunk is unpacked in parts; and
every step of the program counts against `MAX_STEPS`.
"""

import struct
from collections.abc import Iterator
from typing import Final

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from rigd.session import limits
from rigd.session.layout import Buffer

MAX_SKIPPED: Final = 20
"""Most damaged records that are reported singly."""

CHUNK_STEPS: Final = 20
DECLARATION_STEPS: Final = 15
"""Steps for which a chunk and a declaration count."""

_DECLARED_COST: Final = 1000
"""Approximate bytes of an object for one declaration, however small its record."""

MOST_UNPACKED_BYTES: Final = 4 << 20
"""Longest chunk that is unpacked at once, and length of a part of a longer one."""
_FEED_BYTES: Final = 1 << 18
_MAX_ZSTD_WINDOW: Final = 32 << 20


class McapError(Exception):
    """The bytes are not a usable MCAP file; the message is a predicate to the file's name."""


class McapTooLargeError(McapError):
    """The file takes more memory or time than allowed; the message is a predicate to its name."""


class McapDamageError(Exception):
    """Something in the file contradicts the format; the message is a predicate to its name."""


class Allowance:
    """Memory and time that one file has used so far."""

    def __init__(self) -> None:
        self._steps = 0
        self._unpacked = 0
        self._declared = 0
        self._declared_text = 0
        self._entries = 0

    def spend(self, steps: int) -> None:
        """Count steps of work.

        Raises
        ------
        McapTooLargeError
            If the file takes more than it may.
        """
        self._steps += steps
        if self._steps > limits.MAX_STEPS:
            raise McapTooLargeError(
                "is made of so many small parts that reading it would take too long: more than "
                f"{limits.MAX_STEPS} runs of messages, chunks and other records, each weighed by "
                "its work"
            )

    def unpack(self, size: int, where: str) -> None:
        """Count the stated size of a chunk before it is unpacked.

        Raises
        ------
        McapDamageError
            If it is more than a chunk or a file may have.
        """
        self._unpacked += size
        if size > limits.MAX_CHUNK_BYTES or self._unpacked > limits.MAX_TOTAL_BYTES:
            raise McapDamageError(
                f"claims {size} bytes{where}, which is more than the "
                f"{limits.MAX_CHUNK_BYTES >> 20} MiB for a chunk or the "
                f"{limits.MAX_TOTAL_BYTES >> 20} MiB for a file that are accepted"
            )

    def declare(self, opcode: int, content: Buffer, where: str) -> None:
        """Count the memory of a declaration before it is parsed.

        Parameters
        ----------
        opcode, content
            Opcode and content of the record.
        where
            Its position, for messages.

        Raises
        ------
        McapError
            If there are too many declarations, or they are too long.
        """
        self._declared += len(content) + _DECLARED_COST
        if opcode != Opcode.ATTACHMENT:
            self._declared_text += len(content)
        if opcode in (Opcode.METADATA, Opcode.CHANNEL):
            self._entries += _entries(content, opcode, limits.MAX_ENTRIES)
        for amount, most, of_what in (
            (
                self._declared,
                limits.MAX_DECLARED_BYTES,
                "MiB of channels, schemas, metadata and files",
            ),
            (self._declared_text, limits.MAX_TEXT_BYTES, "MiB of channels, schemas and metadata"),
        ):
            if amount > most:
                raise McapError(
                    "declares channels, schemas, metadata and attachments without limit: more than "
                    f"{most >> 20} {of_what}{where}"
                )
        if self._entries > limits.MAX_ENTRIES:
            raise McapError(f"has more than {limits.MAX_ENTRIES} keys in its metadata{where}")


def zstd_decompressor() -> zstandard.ZstdDecompressor:
    """Return a decompressor for all chunks of a file: creating one for each would be slow."""
    return zstandard.ZstdDecompressor(max_window_size=_MAX_ZSTD_WINDOW)


def unpacked(
    zstd: zstandard.ZstdDecompressor, compression: bytes, packed: memoryview, size: int, where: str
) -> bytes:
    """Decompress a chunk to exactly `size` bytes, never allocating more.

    Parameters
    ----------
    zstd
        Made by :func:`zstd_decompressor`.
    compression
        Compression that the chunk names.
    packed
        Packed content of the chunk.
    size
        Bytes that it claims to hold.
    where
        Its position, for messages.

    Raises
    ------
    McapDamageError
        If it is impossible.
    """
    try:
        if compression == b"":
            records = bytes(packed[: size + 1])
        elif compression == b"zstd":
            _check_zstd_size(packed, size, where)
            records = zstd.decompress(packed, max_output_size=size)
        elif compression == b"lz4":
            # One byte more than allowed, so that a longer chunk is detected.
            records = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
        else:
            raise McapDamageError(f"uses the unknown compression {compression!r}{where}")
    except (zstandard.ZstdError, RuntimeError, ValueError):
        raise McapDamageError(f"does not decompress{where}") from None
    if len(records) != size:
        raise McapDamageError(f"decompresses to a wrong size{where}")
    return records


def unpacked_parts(
    zstd: zstandard.ZstdDecompressor, compression: bytes, packed: memoryview, size: int, where: str
) -> Iterator[Buffer]:
    """Yield a chunk in parts, at most one part more than its `size`.

    Parameters and errors are those of :func:`unpacked`.
    """
    done = 0
    try:
        if compression == b"":
            for start in range(0, len(packed), MOST_UNPACKED_BYTES):
                yield packed[start : start + MOST_UNPACKED_BYTES]
        elif compression == b"zstd":
            _check_zstd_size(packed, size, where)
            stream = zstd.stream_reader(packed)
            while done <= size and (part := stream.read(MOST_UNPACKED_BYTES)):
                done += len(part)
                yield part
        elif compression == b"lz4":
            lz4_stream = lz4.frame.LZ4FrameDecompressor()
            for start in range(0, len(packed), _FEED_BYTES):
                feed: Buffer = packed[start : start + _FEED_BYTES]
                while not lz4_stream.eof and done <= size:
                    part = lz4_stream.decompress(feed, max_length=MOST_UNPACKED_BYTES)
                    done += len(part)
                    if part:
                        yield part
                    if lz4_stream.needs_input:
                        break
                    feed = b""
        else:
            raise McapDamageError(f"uses the unknown compression {compression!r}{where}")
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError):
        raise McapDamageError(f"does not decompress{where}") from None


def _check_zstd_size(packed: memoryview, size: int, where: str) -> None:
    """Check the size in the frame, which the decompressor would trust."""
    stated = zstandard.get_frame_parameters(packed).content_size
    if stated not in (size, zstandard.CONTENTSIZE_UNKNOWN):
        raise McapDamageError(f"states two different sizes{where}")


def prefixed(content: memoryview, position: int, prefix: str) -> tuple[memoryview, int]:
    """Return the bytes after a length of format `prefix`, and their end."""
    (length,) = struct.unpack_from(prefix, content, position)
    start = position + struct.calcsize(prefix)
    if length > len(content) - start:
        raise struct.error
    return content[start : start + length], start + length


def _entries(content: Buffer, opcode: int, most: int) -> int:
    """Count the entries of the map at the end of a metadata or channel record, up to `most` + 1.

    A malformed map has none: parsing the record finds the error.
    """
    view = memoryview(content)
    count = 0
    try:
        if opcode == Opcode.METADATA:
            _, position = prefixed(view, 0, "<I")
        else:
            _, position = prefixed(view, 4, "<I")
            _, position = prefixed(view, position, "<I")
        entries, _ = prefixed(view, position, "<I")
        position = 0
        while position < len(entries) and count <= most:
            _, position = prefixed(entries, position, "<I")
            _, position = prefixed(entries, position, "<I")
            count += 1
    except struct.error:
        pass
    return count
