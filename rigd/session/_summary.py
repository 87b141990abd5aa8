"""Summary of a session file from its two ends: metadata and counts, without its samples.

The summary section of a complete file gives the offsets of its metadata and the number of messages:
a few reads suffice for a file of any length. A file without a usable summary is read whole; of one
without its end only the beginning is read, which contains ``session``.
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

from rigd.session._mcap_limits import McapDamageError
from rigd.session._mcap_reader import FOOTER, RECORD_HEAD, McapContents, parsed, read_mcap
from rigd.session._mcap_writer import MAGIC
from rigd.session._reader import load_contents, merged_metadata, no_session, opened
from rigd.session._schema import SAMPLE_TOPIC
from rigd.session._writer import is_being_written

_CHECKSUM_SIZE: Final = 4
_BEGINNING_BYTES: Final = 1 << 18
"""Length of the beginning that is read of a file without its end."""
_MOST_SUMMARY_BYTES: Final = 16 << 20
_MOST_METADATA_BYTES: Final = 1 << 20
_MOST_RECORDS: Final = 100
"""Longest summary, longest metadata record and most of them that are read by their index; beyond
that the general reader, which limits memory and time, is used."""


@dataclass(frozen=True, slots=True)
class SessionSummary:
    """Metadata and counts of a session file."""

    metadata: dict[str, str]
    """The record ``session``; empty if an incomplete file has lost it."""
    outcome: dict[str, str] | None
    """End of the session; None if the file does not state it."""
    samples: int | None
    """Number of recorded samples; None for a file without its end."""
    problem: str
    """Problem of the file and remedy, a sentence; empty for a sound file."""
    recording: bool
    """Whether the session is still being recorded."""


def read_summary(path: str | PathLike[str]) -> SessionSummary:
    """Read metadata and counts of a session file; its samples are neither read nor checked.

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
    with opened(path) as file:
        contents = _indexed(file, path.stat().st_size)
        if contents is None:
            file.seek(0)
            beginning = read_mcap(memoryview(file.read(_BEGINNING_BYTES)), ())
            ended = _has_end(file)
    problem, recording = "", False
    remedy = f"save what is intact with rigd recover {shlex.quote(str(path))}"
    if contents is None and ended:
        contents = load_contents(path, ())
        if contents.damage is not None:
            problem = f"The file is damaged: it {contents.damage}; {remedy}."
    elif contents is None:
        contents, recording = beginning, is_being_written(path)
        problem = (
            "The session is being recorded." if recording else f"The file is incomplete; {remedy}."
        )
    sampled = SAMPLE_TOPIC in {channel.topic for channel in contents.channels.values()}
    if not sampled and not problem:
        raise no_session(path)
    return SessionSummary(
        metadata=merged_metadata(contents, "session") or {},
        outcome=merged_metadata(contents, "outcome"),
        samples=None if problem else contents.count(SAMPLE_TOPIC),
        problem=problem,
        recording=recording,
    )


def _has_end(file: BinaryIO) -> bool:
    file.seek(-len(MAGIC), 2)
    return file.read() == MAGIC


def _indexed(file: BinaryIO, size: int) -> McapContents | None:
    """Read the records to which the summary section points; None if it is not sound."""
    footer_start = size - len(MAGIC) - FOOTER.size
    if footer_start < len(MAGIC) or file.read(len(MAGIC)) != MAGIC:
        return None
    file.seek(footer_start)
    end = file.read()
    if len(end) != FOOTER.size + len(MAGIC) or not end.endswith(MAGIC):
        return None
    opcode, length, summary_start, _, crc = FOOTER.unpack_from(end)
    if (opcode, length) != (Opcode.FOOTER, FOOTER.size - RECORD_HEAD.size):
        return None
    if not len(MAGIC) < summary_start <= footer_start <= summary_start + _MOST_SUMMARY_BYTES:
        return None
    file.seek(summary_start)
    summary = file.read(footer_start - summary_start)
    covered = FOOTER.size - _CHECKSUM_SIZE
    if crc == 0 or zlib.crc32(end[:covered], zlib.crc32(summary)) != crc:
        return None
    try:
        return _led_to(file, summary)
    except (McapDamageError, struct.error):
        return None


def _led_to(file: BinaryIO, summary: bytes) -> McapContents | None:
    contents = McapContents()
    indexes: list[MetadataIndex] = []
    statistics: Statistics | None = None
    position = 0
    while position < len(summary):
        opcode, length = RECORD_HEAD.unpack_from(summary, position)
        content = position + RECORD_HEAD.size
        position = content + length
        record = summary[content:position]
        if opcode == Opcode.CHANNEL:
            channel = parsed(Channel.read, record, "")
            contents.channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            statistics = parsed(Statistics.read, record, "")
        elif opcode == Opcode.METADATA_INDEX:
            indexes.append(parsed(MetadataIndex.read, record, ""))
            if len(indexes) > _MOST_RECORDS:
                return None
    if statistics is None or len(indexes) != statistics.metadata_count:
        return None
    contents.message_counts |= statistics.channel_message_counts
    for index in indexes:
        if not RECORD_HEAD.size <= index.length <= _MOST_METADATA_BYTES:
            return None
        file.seek(index.offset)
        record = file.read(index.length)
        if RECORD_HEAD.unpack_from(record) != (Opcode.METADATA, index.length - RECORD_HEAD.size):
            return None
        contents.metadata.append(parsed(Metadata.read, record[RECORD_HEAD.size :], ""))
    return contents
