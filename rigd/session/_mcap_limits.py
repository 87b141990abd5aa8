"""Limits on memory and time for reading an MCAP file, and the unpacking of its chunks.

A few bytes may unpack to any number of records. So the size that a chunk claims is bounded by
`MAX_CHUNK_BYTES` and the sum over the file by `MAX_TOTAL_BYTES`; a long chunk is unpacked piece by
piece; and whatever takes a step of the program is counted against `MAX_STEPS`.
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
"""Most damaged records that are told one by one."""

CHUNK_STEPS: Final = 20
DECLARATION_STEPS: Final = 15
"""Steps that a chunk and a declaration count as."""

_DECLARED_COST: Final = 1000
"""Bytes that an object for one of them takes, about, however small its record."""

PIECE_BYTES: Final = 4 << 20
"""Longest chunk that is unpacked at once, and length of a piece of a longer one."""
_FEED_BYTES: Final = 1 << 18
_MAX_ZSTD_WINDOW: Final = 32 << 20


class McapError(Exception):
    """The bytes are no MCAP file of use; the message is a predicate to the file's name."""


class McapTooLargeError(McapError):
    """The file takes more memory or time than allowed; the message is a predicate to its name."""


class McapDamageError(Exception):
    """Something in the file contradicts the format; the message is a predicate to its name."""


class Allowance:
    """Memory and time that one file has taken so far."""

    def __init__(self) -> None:
        self._steps = 0
        self._unpacked = 0
        self._declared = 0
        self._declared_text = 0
        self._entries = 0

    def spend(self, steps: int) -> None:
        """Count work.

        Raises
        ------
        McapTooLargeError
            If that is more than the file may take.
        """
        self._steps += steps
        if self._steps > limits.MAX_STEPS:
            raise McapTooLargeError(
                "is made of so many small parts that reading it would take too long: more than "
                f"{limits.MAX_STEPS} runs of messages, chunks and other records, each weighed by "
                "its work"
            )

    def unpack(self, size: int, where: str) -> None:
        """Count the bytes that a chunk claims to hold before it is unpacked.

        Raises
        ------
        McapDamageError
            If they are more than a chunk or a file may have.
        """
        self._unpacked += size
        if size > limits.MAX_CHUNK_BYTES or self._unpacked > limits.MAX_TOTAL_BYTES:
            raise McapDamageError(
                f"claims {size} bytes{where}, which is more than the "
                f"{limits.MAX_CHUNK_BYTES >> 20} MiB for a chunk or the "
                f"{limits.MAX_TOTAL_BYTES >> 20} MiB for a file that are accepted"
            )

    def declare(self, opcode: int, content: Buffer, where: str) -> None:
        """Count what a declaration takes before it is parsed.

        Parameters
        ----------
        opcode, content
            Opcode and content of the record.
        where
            It stands, for messages.

        Raises
        ------
        McapError
            If there are too many, or they are too long.
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
    """Return one for the chunks of a file: to make one for each takes longer than a small chunk."""
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
        It stands, for messages.

    Raises
    ------
    McapDamageError
        If it cannot be done.
    """
    try:
        if compression == b"":
            records = bytes(packed[: size + 1])
        elif compression == b"zstd":
            _check_zstd_size(packed, size, where)
            records = zstd.decompress(packed, max_output_size=size)
        elif compression == b"lz4":
            # One byte more than is right, so that what is too long is seen.
            records = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
        else:
            raise McapDamageError(f"uses the unknown compression {compression!r}{where}")
    except (zstandard.ZstdError, RuntimeError, ValueError):
        raise McapDamageError(f"does not decompress{where}") from None
    if len(records) != size:
        raise McapDamageError(f"decompresses to a wrong size{where}")
    return records


def unpacked_pieces(
    zstd: zstandard.ZstdDecompressor, compression: bytes, packed: memoryview, size: int, where: str
) -> Iterator[Buffer]:
    """Yield a chunk piece by piece, and at most one piece more than its `size`.

    Parameters and errors are those of :func:`unpacked`.
    """
    done = 0
    try:
        if compression == b"":
            for start in range(0, len(packed), PIECE_BYTES):
                yield packed[start : start + PIECE_BYTES]
        elif compression == b"zstd":
            _check_zstd_size(packed, size, where)
            stream = zstd.stream_reader(packed)
            while done <= size and (piece := stream.read(PIECE_BYTES)):
                done += len(piece)
                yield piece
        elif compression == b"lz4":
            lz4_stream = lz4.frame.LZ4FrameDecompressor()
            for start in range(0, len(packed), _FEED_BYTES):
                feed: Buffer = packed[start : start + _FEED_BYTES]
                while not lz4_stream.eof and done <= size:
                    piece = lz4_stream.decompress(feed, max_length=PIECE_BYTES)
                    done += len(piece)
                    if piece:
                        yield piece
                    if lz4_stream.needs_input:
                        break
                    feed = b""
        else:
            raise McapDamageError(f"uses the unknown compression {compression!r}{where}")
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError):
        raise McapDamageError(f"does not decompress{where}") from None


def _check_zstd_size(packed: memoryview, size: int, where: str) -> None:
    """Compare the size that the frame may state, which the decompressor would believe."""
    stated = zstandard.get_frame_parameters(packed).content_size
    if stated not in (size, zstandard.CONTENTSIZE_UNKNOWN):
        raise McapDamageError(f"states two different sizes{where}")


def prefixed(content: memoryview, position: int, prefix: str) -> tuple[memoryview, int]:
    """Return the bytes behind a length of format `prefix`, and where they end."""
    (length,) = struct.unpack_from(prefix, content, position)
    start = position + struct.calcsize(prefix)
    if length > len(content) - start:
        raise struct.error
    return content[start : start + length], start + length


def _entries(content: Buffer, opcode: int, most: int) -> int:
    """Count the entries of the map at the end of a metadata or channel record, up to `most` + 1.

    What is malformed has none: it is found out when the record is parsed.
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
