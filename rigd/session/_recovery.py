"""Recovery of damaged session files: the intact messages are written to a new valid file.

Only verified data is used: messages, channels and schemas are in chunks with a checksum each, the
records ``session`` and ``segments`` are taken from the copy in such a chunk, and each attachment
has its own checksum. The record ``outcome`` is used only if the checksum of the whole data section
is correct. The file of another program may lack some checksums. It is recovered and marked as
unprotected.

`recovery_advice` states how much of an incomplete file can be recovered, and by which command.
"""

import contextlib
import hashlib
import os
import secrets
import shlex
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from mcap.records import Channel

import rigd
from rigd.session import limits
from rigd.session._errors import SessionError, SessionExistsError
from rigd.session._mcap_limits import McapError
from rigd.session._mcap_reader import McapContents, MessageBlock, message_starts, read_mcap
from rigd.session._mcap_writer import INDEX_DTYPE, LOG_TIME_OFFSET, McapWriter
from rigd.session._message_decoder import SAMPLES, MessageDecoder
from rigd.session._reader import (
    ORDER_AND_FLAG_FIELDS,
    TopicBuffer,
    load_contents,
    merged_metadata,
    read_session,
)
from rigd.session._schema import (
    OWN_TOPICS,
    SAMPLE_TOPIC,
    metadata_for_channel,
    metadata_from_channel,
)
from rigd.session._writer import (
    PART_SUFFIX,
    copy_new,
    fsync_directory,
    is_being_written,
    rename_new,
)
from rigd.session.layout import SAMPLE_DTYPE, SAMPLE_FIELDS, Status

RECOVERED_FROM: Final = "recovered_from"
"""Key of the record ``outcome`` of a recovered file; its value is the damaged file's name."""

_SESSION_SUFFIX: Final = ".mcap"
_RECOVERED_SUFFIX: Final = ".recovered.mcap"
_MIN_CHUNK_BYTES: Final = 1 << 14
_LONG_CHUNK_BYTES: Final = 4 << 20
"""Length of the collected messages, in bytes, above which a chunk is written in any case."""
_CHUNKS_BEFORE_GROWTH: Final = 10_000
"""Number of chunks after which new chunks become longer, since each one takes index space."""
_MAX_COPIED_CHANNELS: Final = 32
"""Maximum number of channels to copy with the session's own topics, and likewise with others."""
_FIRST_READING_FRACTION: Final = 0.3
"""Fraction of the reported progress at which the first reading of the damaged file ends."""

_SEARCHED_BYTES: Final = 1 << 20
"""Number of bytes at the start of a file in which its first samples lie, if there are any."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of the recovery of a damaged session file."""

    source: Path
    """Path of the damaged file."""
    path: Path | None
    """Path of the new file, or None if `source` is a complete and intact session file."""
    samples: int
    """Number of recovered samples."""
    outcome: Mapping[str, str]
    """Record ``outcome`` of the new file, with the counts of lost ticks."""
    damage: str | None
    """Description of the first damage, as the end of a sentence that begins with the file's name.

    None if the file is intact."""
    bytes_lost: int
    """Number of bytes of `source` after the last intact record."""
    skipped: tuple[str, ...]
    """Descriptions of further damage that was left out, in the form of `damage`."""
    protected: bool
    """Whether checksums cover the sample rate, the beam data and the segments."""

    def as_dict(self) -> dict[str, Any]:
        """Return the recovery's result as a dictionary that can be written as JSON."""
        return {
            "source": str(self.source),
            "path": None if self.path is None else str(self.path),
            "samples": self.samples,
            "outcome": dict(self.outcome),
            "damage": self.damage,
            "bytes_lost": self.bytes_lost,
            "skipped": list(self.skipped),
            "protected": self.protected,
        }

    def lines(self) -> list[str]:
        """Return the text lines that report the recovery's result to the operator."""
        if self.path is None:
            return [f"{self.source} is complete and intact; there is nothing to recover."]
        if self.damage is None:
            return [
                f"{self.path}: {self.source} is complete and intact, and was copied under this "
                "name."
            ]
        lines = [
            f"{self.path}: {self.samples} samples recovered from {self.source}, which "
            f"{self.damage}{_loss_text(self.bytes_lost)}."
        ]
        lines += [f"Left out: {self.source} {skipped}." for skipped in self.skipped]
        if not self.protected:
            lines.append(
                "Warning: no checksum covers the metadata of this file; compare rate, beam and "
                "segments (rigd info) with what you know of the session."
            )
        return lines


def recovered_path(path: Path) -> Path:
    """Return the path of the recovered file: ``X.mcap`` for ``X.mcap.part``.

    For ``X.mcap`` the path is ``X.recovered.mcap``.
    """
    if path.name.endswith(_SESSION_SUFFIX + PART_SUFFIX):
        return path.with_name(path.name.removesuffix(PART_SUFFIX))
    return path.with_name(path.name.removesuffix(_SESSION_SUFFIX) + _RECOVERED_SUFFIX)


def recover(
    path: str | os.PathLike[str], on_progress: Callable[[float], None] | None = None
) -> Recovery:
    """Write the intact part of a damaged session file to a new file in the same folder.

    The original file is not changed. The new file gets its name after it was written to the disk
    completely and read back.

    Parameters
    ----------
    path : path of an incomplete ``.part`` file or of a damaged session file
    on_progress : called repeatedly with the completed fraction of the work, from 0 to 1

    Returns
    -------
    The path of the new file, the number of its samples, and descriptions of the damage.

    Raises
    ------
    SessionExistsError
        If a file with the name of the new file exists.
    SessionError
        If the file cannot be read, is still being recorded, or has no sample before the damage, or
        if the new file cannot be written.
    """
    path = Path(path)
    if path.exists() and not path.is_file():  # reading a pipe would block
        raise SessionError(f"{path} is not a file. Give the path of a session file.")
    target = recovered_path(path)
    if is_being_written(path):
        raise SessionError(f"{path} is still being recorded. Wait for the end of the session.")
    selection = _SampleSelection(path)
    contents = load_contents(
        path, None, on_block=selection.add_block, salvage=True,
        on_progress=_scaled_progress(on_progress, 0.0, _FIRST_READING_FRACTION),
    )  # fmt: skip
    selection.finish(contents)
    if contents.damage is None and not contents.skipped and selection.order_error is None:
        return _copy_sound_file(path, target)
    damages = [contents.damage, *contents.skipped, selection.order_error]
    damage, *other_damage = [each for each in damages if each is not None]
    if not selection.is_copied.any():
        raise SessionError(
            f"{path} {damage}; no sample is intact before that, so there is nothing to recover."
        )
    recovery = _planned_recovery(path, target, contents, selection, damage, other_damage)
    _require_target_absent(path, target)
    with _temporary_target(path, target) as temporary:
        written_digest = _write_recovered_file(
            temporary,
            path,
            contents,
            selection,
            recovery,
            _scaled_progress(on_progress, _FIRST_READING_FRACTION, 1.0),
        )
        read_back_digest = SampleDigest()
        try:
            read_session(
                temporary,
                fields=ORDER_AND_FLAG_FIELDS,
                max_samples=limits.MAX_SAMPLES_WITHOUT_SIGNALS,
                on_samples=read_back_digest.add,
            )
        except SessionError as error:
            reason = str(error).replace(str(temporary), str(path))
            raise SessionError(f"{path} cannot be recovered to a session. {reason}") from None
        if read_back_digest.digest() != written_digest.digest():
            raise SessionError(
                f"{target} was not made: what was written for it does not read back as it is in "
                f"{path}. Check the disk."
            )
    return recovery


class SampleDigest:
    """Checksum of all bits of all fields of samples that arrive in blocks of any size."""

    def __init__(self) -> None:
        self._sums = {name: hashlib.blake2b() for name in SAMPLE_FIELDS}

    def add(self, samples: npt.NDArray[np.void]) -> None:
        """Include further samples, an array of ``SAMPLE_DTYPE``, in the checksum."""
        for name, checksum in self._sums.items():
            checksum.update(samples[name].tobytes())

    def digest(self) -> bytes:
        """Return the checksum of all samples added so far."""
        return b"".join(checksum.digest() for checksum in self._sums.values())


class _SampleSelection:
    """First reading of a damaged file, which selects the samples to copy to the new file."""

    def __init__(self, path: Path) -> None:
        self.order_error: str | None = None
        """Description of samples that repeat or are out of order, or None if there are none.

        It is the end of a sentence that begins with the file's name."""
        self.is_copied: npt.NDArray[np.bool_] = np.empty(0, np.bool_)
        """For each sample in the file, whether it is copied to the new file."""
        self.samples: npt.NDArray[np.void] = np.empty(0, SAMPLE_DTYPE)
        """Time, tick and status of the samples that are copied."""
        self._samples = TopicBuffer(
            path, SAMPLES, ORDER_AND_FLAG_FIELDS, limits.MAX_SAMPLES_WITHOUT_SIGNALS
        )
        self._samples_per_chunk: dict[
            int, int
        ] = {}  # position of a chunk in the file → number of samples

    def add_block(self, contents: McapContents, block: MessageBlock) -> None:
        """Decode the samples of a block of messages, and count them for each chunk."""
        self._samples.decoder.add_block(contents, block)
        is_sample = self._samples.decoder.is_of_topic
        count = sum(run[3] for run in block.runs if is_sample(contents, run[0]))
        self._samples_per_chunk[block.chunk_position] = (
            self._samples_per_chunk.get(block.chunk_position, 0) + count
        )

    def finish(self, contents: McapContents) -> None:
        """Select the samples to copy, with increasing ticks, after all blocks were read."""
        samples = self._samples.finish(contents)
        ticks = samples["tick"]
        self.is_copied = _increasing_ticks_mask(ticks)
        (excluded,) = np.nonzero(~self.is_copied)
        if len(excluded):
            self.order_error = (
                f"has {len(excluded)} samples that repeat or precede others, the first of them "
                f"with tick {ticks[excluded[0]]}"
            )
            samples = samples[self.is_copied]
        self.samples = samples

    def duplicate_chunks(self) -> set[int]:
        """Return the file positions of chunks that contain samples, but none that is copied."""
        counts = np.array(list(self._samples_per_chunk.values()), np.int64)
        # Number of copied samples up to each end of a chunk, and from it the number in each chunk.
        copied_before = np.append(0, np.cumsum(self.is_copied))
        ends = np.cumsum(counts)
        copied_in_chunk = copied_before[ends] - copied_before[ends - counts]
        is_duplicate = (counts > 0) & (copied_in_chunk == 0)
        return {
            position
            for position, is_chunk_duplicate in zip(
                self._samples_per_chunk, is_duplicate, strict=True
            )
            if is_chunk_duplicate
        }


def holds_samples(path: Path) -> bool:
    """Return whether `recover` may find a sample in a file.

    Only the first mebibyte is searched. The result is True for a longer MCAP file, and for a file
    that cannot be opened.
    """
    try:
        with path.open("rb") as file:
            beginning = file.read(_SEARCHED_BYTES)
            is_longer = bool(file.read(1))
    except OSError:
        return True
    try:
        contents = read_mcap(memoryview(beginning), (), salvage=True)
    except McapError:
        return False
    return is_longer or contents.count(SAMPLE_TOPIC) > 0


def recovery_advice(path: Path, *, was_whole: bool) -> str:
    """Return the end of an error message: how much of a damaged file is intact and recoverable.

    The text begins with the punctuation mark that follows the description of the damage.
    `was_whole` states whether the file was complete once, so that an intact copy may exist.
    """
    try:
        count = load_contents(path, (), salvage=True).count(SAMPLE_TOPIC)
    except SessionError:
        count = 0
    copy_again = ". Copy it again from where it was recorded"
    readable_samples = f"; {count} complete samples are readable before that"
    if not count:
        no_samples = ", so there is nothing to recover"
        if was_whole:
            return f"{readable_samples}{no_samples}{copy_again}."
        return (
            f"{readable_samples}{no_samples}. Copy it again if there is a complete one, or record "
            "it again."
        )
    target = recovered_path(path)
    recover_command = f"`rigd recover {shlex.quote(str(path))}`"
    if os.path.lexists(target):
        recover_command += f", once {target}, which may hold it already, is moved away"
    if was_whole:
        return f"{copy_again}, or save what is intact with {recover_command}."
    return f"{readable_samples}. Save them with {recover_command}."


def _increasing_ticks_mask(ticks: npt.NDArray[np.uint32]) -> npt.NDArray[np.bool_]:
    """Return a mask of the ticks to copy, so that the copied ticks increase strictly.

    The mask selects ticks that exceed all previous ticks, or ticks below all later ticks if these
    are more. A single tick that is far too high then does not exclude the ticks after it.
    """
    exceeds_previous, is_below_later = np.ones((2, len(ticks)), np.bool_)
    exceeds_previous[1:] = ticks[1:] > np.maximum.accumulate(ticks)[:-1]
    if exceeds_previous.all():
        return exceeds_previous
    is_below_later[:-1] = ticks[:-1] < np.minimum.accumulate(ticks[::-1])[::-1][1:]
    return is_below_later if is_below_later.sum() > exceeds_previous.sum() else exceeds_previous


def _scaled_progress(
    on_progress: Callable[[float], None] | None, start_fraction: float, end_fraction: float
) -> Callable[[float], None] | None:
    """Return a callback that scales the progress of one step to its range of the whole progress."""
    if on_progress is None:
        return None
    return lambda fraction: on_progress(start_fraction + (end_fraction - start_fraction) * fraction)


def _copy_sound_file(path: Path, target: Path) -> Recovery:
    """Copy a complete ``.part`` file to its final name; leave any other complete file alone."""
    session = read_session(
        path, fields=ORDER_AND_FLAG_FIELDS, max_samples=limits.MAX_SAMPLES_WITHOUT_SIGNALS
    )
    is_part = path.name.endswith(PART_SUFFIX)
    if is_part:
        _require_target_absent(path, target)
        with _temporary_target(path, target, copied_file=path):
            pass
    return Recovery(
        source=path,
        path=target if is_part else None,
        samples=len(session.samples),
        outcome=session.outcome or {},
        damage=None,
        bytes_lost=0,
        skipped=(),
        protected=True,
    )


def _require_target_absent(path: Path, target: Path) -> None:
    """Raise if a file with the name of the new file exists."""
    if os.path.lexists(target):
        raise SessionExistsError(
            f"{target} exists and is not overwritten. Move it away to recover {path} again."
        )


@contextlib.contextmanager
def _temporary_target(path: Path, target: Path, copied_file: Path | None = None) -> Iterator[Path]:
    """Yield a temporary path in the folder of `target`, and rename it to `target` on success.

    The temporary file starts as a copy of the file `copied_file`, if one is given.
    """
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        if copied_file is not None:
            with copied_file.open("rb") as source:
                copy_new(source.fileno(), temporary)
        yield temporary
        rename_new(temporary, target)
        fsync_directory(target.parent)
    except FileExistsError:
        _require_target_absent(path, target)  # the target may have been created meanwhile
        raise
    except OSError as error:
        raise SessionError(
            f"{target} cannot be written: {error.strerror or error}. Check that the folder is "
            f"writable and has space left, or copy {path} to one that is."
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def _planned_recovery(
    path: Path,
    target: Path,
    contents: McapContents,
    selection: _SampleSelection,
    damage: str,
    skipped: list[str],
) -> Recovery:
    """Return the result of a recovery whose new file is still to be written."""
    samples = selection.samples
    bytes_lost = path.stat().st_size - contents.sound_bytes
    # The recorded outcome describes all samples: it is used only if none is missing.
    is_outcome_valid = contents.verified and selection.order_error is None
    recovery = Recovery(
        source=path,
        path=target,
        samples=len(samples),
        outcome={},
        damage=damage,
        bytes_lost=bytes_lost,
        skipped=tuple(skipped),
        protected=contents.verified or bool(_metadata_from_chunk(contents)),
    )
    outcome: dict[str, str] = {}
    if is_outcome_valid:
        outcome |= merged_metadata(contents, "outcome") or {}
    else:
        outcome["outcome"] = "fault"
        outcome["reason"] = f"Recovered from {path.name}, which {damage}{_loss_text(bytes_lost)}."
        stated_samples = _sample_count(contents.stated_counts, contents)
        outcome |= _tick_counts(samples, max(stated_samples - len(samples), 0))
    outcome |= {
        RECOVERED_FROM: path.name,
        "recovered_by": f"rigd {rigd.__version__}",
        "recovered_damage": damage,
        "recovered_bytes_lost": str(bytes_lost),
        "recovered_protected": str(recovery.protected).lower(),
    }
    if recovery.skipped:
        outcome["recovered_left_out"] = "; ".join(recovery.skipped)
    return replace(recovery, outcome=outcome)


def _loss_text(count: int) -> str:
    """Return the words that report the number of lost bytes, or "" for 0."""
    return f"; {count} bytes from there on were lost" if count else ""


def _sample_count(counts: Mapping[int, int], contents: McapContents) -> int:
    """Return the number of samples, given the number of messages by channel number."""
    return sum(
        counts.get(channel.id, 0)
        for channel in contents.channels.values()
        if channel.topic == SAMPLE_TOPIC
    )


def _tick_counts(samples: npt.NDArray[np.void], unrecovered_samples: int) -> dict[str, str]:
    """Return the tick counts of the record ``outcome`` for a recovered file.

    A gap in the ticks counts as missed if the flags of the next sample state that, and as lost
    otherwise. `unrecovered_samples` is the number of samples that the damaged file contained once
    and that were not recovered.
    """
    status = samples["status"]
    missing_before = np.diff(samples["tick"].astype(np.int64), prepend=-1) - 1
    was_lost = (status & Status.AFTER_LOST) != 0
    was_missed = ~was_lost & ((status & Status.AFTER_MISSED) != 0)
    missed_ticks = int(missing_before[was_missed].sum())
    unexplained = int(missing_before[~was_lost & ~was_missed].sum())
    lost_ticks = int(missing_before[was_lost].sum()) + max(unexplained, unrecovered_samples)
    return {
        "scheduled": str(len(samples) + missed_ticks + lost_ticks),
        "recorded": str(len(samples)),
        "missed": str(missed_ticks),
        "lost": str(lost_ticks),
        "late": str(int(np.count_nonzero(status & Status.LATE))),
        "stale_angles": str(int(np.count_nonzero(status & Status.ANGLE_STALE))),
        "stale_wrenches": str(int(np.count_nonzero(status & Status.WRENCH_STALE))),
    }


def _metadata_from_chunk(contents: McapContents) -> dict[str, dict[str, str]]:
    """Return the records ``session`` and ``segments`` that are repeated in a chunk's channel.

    Returns an empty dictionary if no chunk contains them.
    """
    for channel in contents.channels.values():
        if channel.topic == SAMPLE_TOPIC and channel.id in contents.declared_in_chunks:
            records = metadata_from_channel(channel.metadata)
            if "session" in records:
                return records
    return {}


def _metadata_records(contents: McapContents) -> dict[str, dict[str, str]]:
    """Return the metadata records to copy, except ``outcome``: name → keys and values."""
    protected = _metadata_from_chunk(contents)
    if protected and not contents.verified:
        return protected
    names = dict.fromkeys(record.name for record in contents.metadata if record.name != "outcome")
    return {name: merged_metadata(contents, name) or {} for name in names}


def _write_recovered_file(
    path: Path,
    source: Path,
    contents: McapContents,
    selection: _SampleSelection,
    recovery: Recovery,
    on_progress: Callable[[float], None] | None,
) -> SampleDigest:
    """Write the recovered file to `path`, and return the checksum of its samples."""
    records = _metadata_records(contents)
    channels = _channels_to_copy(contents, records)
    schema_ids = {channel.schema_id for channel in channels}
    with path.open("xb") as stream:
        mcap = McapWriter(stream, library=f"rigd {rigd.__version__}")
        for name, values in records.items():
            mcap.add_metadata(name, values)
        for attachment in contents.attachments:
            mcap.add_attachment(
                attachment.name, attachment.media_type, attachment.data, attachment.log_time
            )
        mcap.declare(
            [schema for schema in contents.schemas.values() if schema.id in schema_ids], channels
        )
        copy = _MessageCopier(source, mcap, selection, {channel.id for channel in channels})
        # Second reading, up to the same damage as the first one, which selected the samples.
        contents_read_again = load_contents(
            source, None, on_block=copy.add_block, salvage=True, on_progress=on_progress
        )
        digest = copy.finish(contents_read_again)
        if on_progress is not None:
            on_progress(1.0)  # the damaged end is not read
        mcap.add_metadata("outcome", recovery.outcome)
        mcap.finish()
        stream.flush()
        os.fsync(stream.fileno())
    return digest


class _MessageCopier:
    """Second reading of a damaged file, which copies the selected messages to the new file.

    `channels` are the numbers of the channels that are declared in the new file.
    """

    def __init__(
        self, source: Path, mcap: McapWriter, selection: _SampleSelection, channels: set[int]
    ) -> None:
        self._source = source
        self._mcap = mcap
        self._is_copied = selection.is_copied
        self._duplicate_chunks = selection.duplicate_chunks()
        self._declared_channels = channels
        self._digest = SampleDigest()
        self._decoder = MessageDecoder(source, SAMPLES, self)
        self._samples_read = 0  # samples of the damaged file in the blocks so far
        self._samples_decoded = 0  # samples decoded so far
        self._collected_records: list[bytes] = []
        self._collected_runs: list[tuple[int, int, int]] = []  # channel, bytes of a record, count
        self._collected_bytes = 0  # bytes collected for the next chunk
        self._written_bytes = 0  # bytes in chunks so far
        self._chunk_position = 0  # position of the current chunk in the damaged file

    def array_for(self, count: int) -> npt.NDArray[np.void]:
        """Return an uninitialised array for the next `count` decoded samples."""
        return np.empty(count, SAMPLE_DTYPE)

    def store(self, messages: npt.NDArray[np.void]) -> None:
        """Add those decoded samples that are copied to the checksum."""
        end = self._samples_decoded + len(messages)
        is_copied = self._is_copied[self._samples_decoded : end]
        self._digest.add(messages if is_copied.all() else messages[: len(is_copied)][is_copied])
        self._samples_decoded = end

    def add_block(self, contents: McapContents, block: MessageBlock) -> None:
        """Collect the messages to copy from a block; write a chunk when enough are collected."""
        # Small chunks are merged, because each takes space in the index. They grow with the file.
        min_bytes = max(_MIN_CHUNK_BYTES, self._written_bytes // _CHUNKS_BEFORE_GROWTH)
        if self._collected_bytes >= min_bytes and (
            block.chunk_position != self._chunk_position
            or self._collected_bytes > _LONG_CHUNK_BYTES
        ):
            self._flush()
        self._chunk_position = block.chunk_position
        self._decoder.add_block(contents, block)
        is_duplicate = block.chunk_position in self._duplicate_chunks
        records = memoryview(block.records)
        for channel, size, start, count in block.runs:
            copied_ranges = [(start, count)]
            if self._decoder.is_of_topic(contents, channel):
                is_copied = self._is_copied[self._samples_read : self._samples_read + count]
                self._samples_read += count
                if count == 1:  # frequent where channels alternate: avoid a function call each
                    if not is_copied[0]:
                        continue
                elif not is_copied.all():
                    copied_ranges = [
                        (start + size * first, n) for first, n in _true_blocks(is_copied)
                    ]
            if is_duplicate or channel not in self._declared_channels:
                continue
            for first, number in copied_ranges:
                self._collected_records.append(bytes(records[first : first + size * number]))
                self._collected_runs.append((channel, size, number))
                self._collected_bytes += size * number

    def finish(self, contents: McapContents) -> SampleDigest:
        """Write the remaining messages, and return the checksum of the copied samples.

        Raises SessionError if the damaged file has changed since the first reading.
        """
        self._flush()
        self._decoder.finish(contents)
        if not self._samples_read == self._samples_decoded == len(self._is_copied):
            raise SessionError(
                f"{self._source} has changed while it was read. Recover it when nothing writes it."
            )
        return self._digest

    def _flush(self) -> None:
        """Write the collected messages as a chunk with a new message index."""
        if not self._collected_runs:
            return
        data = b"".join(self._collected_records)
        runs = np.array(self._collected_runs, np.int64)
        self._written_bytes += len(data)
        self._collected_records, self._collected_runs, self._collected_bytes = [], [], 0
        starts = message_starts(runs)
        index = np.empty(len(starts), INDEX_DTYPE)
        log_times = np.ndarray(len(data) - 7, "<u8", data, 0, (1,))
        index["log_time"] = log_times[starts + LOG_TIME_OFFSET]
        index["offset"] = starts
        channels = np.repeat(runs[:, 0], runs[:, 2])
        order = np.argsort(channels, kind="stable")
        channel_numbers, first_entries = np.unique(channels[order], return_index=True)
        channel_indexes = np.split(index[order], first_entries[1:])
        self._mcap.add_chunk(
            data, dict(zip(channel_numbers.tolist(), channel_indexes, strict=True))
        )


def _true_blocks(mask: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return start index and length of each block of consecutive True values."""
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    return list(zip(edges[::2].tolist(), (edges[1::2] - edges[::2]).tolist(), strict=True))


def _channels_to_copy(
    contents: McapContents, records: Mapping[str, Mapping[str, str]]
) -> list[Channel]:
    """Return the channels to copy; the channel of the samples repeats the session's metadata."""
    only_protected = bool(_metadata_from_chunk(contents)) and not contents.verified
    metadata = metadata_for_channel(records.get("session", {}), records.get("segments", {}))
    candidates = [
        channel
        for channel in contents.channels.values()
        if channel.id in contents.declared_in_chunks or not only_protected
    ]
    own_channels = [channel for channel in candidates if channel.topic in OWN_TOPICS]
    other_channels = [channel for channel in candidates if channel.topic not in OWN_TOPICS]
    return [
        replace(channel, metadata={**channel.metadata, **metadata})
        if channel.topic == SAMPLE_TOPIC
        else channel
        for channel in (
            *own_channels[:_MAX_COPIED_CHANNELS],
            *other_channels[:_MAX_COPIED_CHANNELS],
        )
    ]
