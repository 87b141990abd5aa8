"""Metadata and number of samples of a session file, read without its samples.

The summary section at the end of a complete file contains the offsets of the metadata and the
number of messages, so that a few reads suffice for a file of any length. A complete file without a
usable summary section is read as a whole. Only the beginning of an incomplete file is read, which
contains the record ``session``.
"""

import shlex
import struct
import zlib
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import BinaryIO, Final

from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, MetadataIndex, Statistics

from rigd.session._contents import load_contents, open_mcap_file
from rigd.session._mcap_limits import McapDamageError
from rigd.session._mcap_reader import (
    FOOTER_FORMAT,
    RECORD_HEAD_FORMAT,
    McapContents,
    parse_record,
    read_mcap,
)
from rigd.session._mcap_writer import MAGIC
from rigd.session._reader import merged_metadata, no_samples_error
from rigd.session._schema import SAMPLE_TOPIC
from rigd.session._writer import is_being_written

_CHECKSUM_SIZE: Final = 4
_INCOMPLETE_FILE_BYTES: Final = 1 << 18
"""Number of bytes at the start of an incomplete file that are read for its metadata."""
_MAX_SUMMARY_BYTES: Final = 16 << 20
"""Maximum length in bytes of a summary section that is used; otherwise the whole file is read."""
_MAX_METADATA_BYTES: Final = 1 << 20
"""Maximum length in bytes of a metadata record that is read by its offset."""
_MAX_METADATA_RECORDS: Final = 100
"""Maximum number of metadata records that are read by their offsets."""


@dataclass(frozen=True, slots=True)
class SessionSummary:
    """Metadata, outcome and number of samples of a session file."""

    metadata: dict[str, str]
    """Record ``session``: key → text; empty if an incomplete file does not contain it."""
    outcome: dict[str, str] | None
    """Record ``outcome``: how the session ended; None if the file does not state it."""
    samples: int | None
    """Number of recorded samples, or None for an incomplete or damaged file."""
    problem: str
    """Sentence on damage of the file and its remedy; empty for an intact file."""
    is_recording: bool
    """Whether the session is still being recorded."""


def read_summary(path: str | PathLike[str]) -> SessionSummary:
    """Read metadata, outcome and number of samples of a session file.

    The samples are neither read nor checked.

    Raises
    ------
    SessionError
        If the file cannot be read, or is not a session.

    Examples
    --------
    >>> from rigd.session import read_summary
    >>> summary = read_summary("session.mcap")
    >>> summary.metadata["excitation"], summary.outcome["outcome"], summary.samples
    ('chirp', 'complete', 21500)
    """
    path = Path(path)
    with open_mcap_file(path) as file:
        mcap_contents = _read_by_summary(file, path.stat().st_size)
        if mcap_contents is None:
            file.seek(0)
            beginning = read_mcap(memoryview(file.read(_INCOMPLETE_FILE_BYTES)), ())
            is_complete = _has_final_magic(file)
    problem_text, is_recording = "", False
    remedy = f"save what is intact with rigd recover {shlex.quote(str(path))}"
    if mcap_contents is None and is_complete:
        mcap_contents = load_contents(path, ())
        if mcap_contents.damage is not None:
            problem_text = f"The file is damaged: it {mcap_contents.damage}; {remedy}."
    elif mcap_contents is None:
        mcap_contents, is_recording = beginning, is_being_written(path)
        problem_text = (
            "The session is being recorded."
            if is_recording
            else f"The file is incomplete; {remedy}."
        )
    has_samples_channel = SAMPLE_TOPIC in {
        channel.topic for channel in mcap_contents.channels.values()
    }
    if not has_samples_channel and not problem_text:
        raise no_samples_error(path)
    return SessionSummary(
        metadata=merged_metadata(mcap_contents, "session") or {},
        outcome=merged_metadata(mcap_contents, "outcome"),
        samples=None if problem_text else mcap_contents.message_count(SAMPLE_TOPIC),
        problem=problem_text,
        is_recording=is_recording,
    )


def _has_final_magic(file: BinaryIO) -> bool:
    """Return whether a file ends with the magic bytes of a complete MCAP file."""
    file.seek(-len(MAGIC), 2)
    return file.read() == MAGIC


def _read_by_summary(file: BinaryIO, file_size: int) -> McapContents | None:
    """Find the summary section of a file, and return channels, message counts and metadata.

    Returns None if the file of `file_size` bytes has no usable summary section with a correct
    checksum.
    """
    footer_start = file_size - len(MAGIC) - FOOTER_FORMAT.size
    if footer_start < len(MAGIC) or file.read(len(MAGIC)) != MAGIC:
        return None
    file.seek(footer_start)
    footer_and_magic = file.read()
    if len(footer_and_magic) != FOOTER_FORMAT.size + len(MAGIC) or not footer_and_magic.endswith(
        MAGIC
    ):
        return None
    opcode, record_length, summary_start, _, crc = FOOTER_FORMAT.unpack_from(footer_and_magic)
    if (opcode, record_length) != (Opcode.FOOTER, FOOTER_FORMAT.size - RECORD_HEAD_FORMAT.size):
        return None
    if not len(MAGIC) < summary_start <= footer_start <= summary_start + _MAX_SUMMARY_BYTES:
        return None
    file.seek(summary_start)
    summary_bytes = file.read(footer_start - summary_start)
    crc_covered_length = FOOTER_FORMAT.size - _CHECKSUM_SIZE
    if (
        crc == 0
        or zlib.crc32(footer_and_magic[:crc_covered_length], zlib.crc32(summary_bytes)) != crc
    ):
        return None
    try:
        return _contents_from_summary(file, summary_bytes)
    except (McapDamageError, struct.error):
        return None


def _contents_from_summary(file: BinaryIO, summary_bytes: bytes) -> McapContents | None:
    """Return channels, message counts and metadata of a file, given its summary section.

    Returns None if the section is incomplete, or the metadata are too long.
    """
    mcap_contents = McapContents()
    metadata_indexes: list[MetadataIndex] = []
    statistics: Statistics | None = None
    record_position = 0
    while record_position < len(summary_bytes):
        opcode, record_length = RECORD_HEAD_FORMAT.unpack_from(summary_bytes, record_position)
        content_start = record_position + RECORD_HEAD_FORMAT.size
        record_position = content_start + record_length
        record = summary_bytes[content_start:record_position]
        if opcode == Opcode.CHANNEL:
            channel = parse_record(Channel.read, record, "")
            mcap_contents.channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            statistics = parse_record(Statistics.read, record, "")
        elif opcode == Opcode.METADATA_INDEX:
            metadata_indexes.append(parse_record(MetadataIndex.read, record, ""))
            if len(metadata_indexes) > _MAX_METADATA_RECORDS:
                return None
    if statistics is None or len(metadata_indexes) != statistics.metadata_count:
        return None
    mcap_contents.message_counts |= statistics.channel_message_counts
    for metadata_index in metadata_indexes:
        if not RECORD_HEAD_FORMAT.size <= metadata_index.length <= _MAX_METADATA_BYTES:
            return None
        file.seek(metadata_index.offset)
        record = file.read(metadata_index.length)
        if RECORD_HEAD_FORMAT.unpack_from(record) != (
            Opcode.METADATA,
            metadata_index.length - RECORD_HEAD_FORMAT.size,
        ):
            return None
        mcap_contents.metadata.append(
            parse_record(Metadata.read, record[RECORD_HEAD_FORMAT.size :], "")
        )
    return mcap_contents
