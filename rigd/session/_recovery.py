"""Recovery of damaged session files: the intact messages are written to a new valid file.

Only verified data is used: messages, channels and schemas are in chunks with a checksum each, the
records ``session`` and ``segments`` are taken from the copy in such a chunk, and each attachment
has its own checksum. The record ``outcome`` is used only if the checksum of the whole data section
is correct. A file of another program, which may lack some checksums, is recovered and marked as
unprotected.
"""

import contextlib
import hashlib
import os
import secrets
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from mcap.records import Channel

import rigd
from rigd.session import limits
from rigd.session._contents import load_contents, recovered_path
from rigd.session._errors import SessionError, SessionExistsError
from rigd.session._mcap_reader import McapContents, MessageBlock, message_starts
from rigd.session._mcap_writer import INDEX_DTYPE, LOG_TIME_OFFSET, McapWriter
from rigd.session._message_decoder import SAMPLES, MessageDecoder
from rigd.session._reader import (
    ORDER_AND_FLAG_FIELDS,
    TopicBuffer,
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
    rename_without_replacing,
)
from rigd.session.layout import SAMPLE_DTYPE, SAMPLE_FIELDS, Status

RECOVERED_FROM: Final = "recovered_from"
"""Key of the record ``outcome`` of a recovered file; its value is the damaged file's name."""

_MIN_CHUNK_BYTES: Final = 1 << 14
_MAX_COLLECTED_BYTES: Final = 4 << 20
"""Maximum length in bytes of the collected messages, above which they are written as a chunk."""
_CHUNKS_BEFORE_GROWTH: Final = 10_000
"""Number of chunks after which new chunks become longer, to limit the size of the chunk index."""
_MAX_COPIED_CHANNELS: Final = 32
"""Maximum number of copied channels with topics of this program, and of those with other topics."""
_FIRST_READING_FRACTION: Final = 0.3
"""Fraction of the total progress that is reported when the damaged file has been read once."""


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
    """Descriptions, in the form of `damage`, of damaged records that were not copied."""
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
    recovered_file = recovered_path(path)
    if is_being_written(path):
        raise SessionError(f"{path} is still being recorded. Wait for the end of the session.")
    sample_selection = _SampleSelection(path)
    mcap_contents = load_contents(
        path, None, on_block=sample_selection.add_block, is_salvage=True,
        on_progress=_scaled_progress(on_progress, 0.0, _FIRST_READING_FRACTION),
    )  # fmt: skip
    sample_selection.finish(mcap_contents)
    if (
        mcap_contents.damage is None
        and not mcap_contents.skipped_record_texts
        and sample_selection.order_error is None
    ):
        return _copy_intact_file(path, recovered_file)
    damage_texts = [
        mcap_contents.damage,
        *mcap_contents.skipped_record_texts,
        sample_selection.order_error,
    ]
    first_damage, *further_damages = [
        damage_text for damage_text in damage_texts if damage_text is not None
    ]
    if not sample_selection.is_copied.any():
        raise SessionError(
            f"{path} {first_damage}; no sample is intact before that, so there is nothing to "
            "recover."
        )
    recovery = _planned_recovery(
        path, recovered_file, mcap_contents, sample_selection, first_damage, further_damages
    )
    _require_target_absent(path, recovered_file)
    with _temporary_target(path, recovered_file) as temporary_path:
        written_digest = _write_recovered_file(
            temporary_path,
            path,
            mcap_contents,
            sample_selection,
            recovery,
            _scaled_progress(on_progress, _FIRST_READING_FRACTION, 1.0),
        )
        read_back_digest = SampleDigest()
        try:
            read_session(
                temporary_path,
                max_samples=limits.MAX_RECORDED_SAMPLES,
                on_samples=read_back_digest.add_samples,
            )
        except SessionError as error:
            failure_reason = str(error).replace(str(temporary_path), str(path))
            raise SessionError(
                f"{path} cannot be recovered to a session. {failure_reason}"
            ) from None
        if read_back_digest.digest() != written_digest.digest():
            raise SessionError(
                f"{recovered_file} was not made: what was written for it does not read back as "
                f"it is in {path}. Check the disk."
            )
    return recovery


class SampleDigest:
    """Checksum of all bits of all fields of samples that arrive in blocks of any size."""

    def __init__(self) -> None:
        self._sums = {field_name: hashlib.blake2b() for field_name in SAMPLE_FIELDS}

    def add_samples(self, samples: npt.NDArray[np.void]) -> None:
        """Include further samples, an array of ``SAMPLE_DTYPE``, in the checksum."""
        for field_name, field_checksum in self._sums.items():
            field_checksum.update(samples[field_name].tobytes())

    def digest(self) -> bytes:
        """Return the checksum of the samples that were added so far."""
        return b"".join(field_checksum.digest() for field_checksum in self._sums.values())


class _SampleSelection:
    """First reading of a damaged file, which selects the samples to copy to the new file."""

    def __init__(self, path: Path) -> None:
        self.order_error: str | None = None
        """Description of samples that repeat or are out of order, or None if there are none.

        It is the end of a sentence that begins with the file's name."""
        self.is_copied: npt.NDArray[np.bool_] = np.empty(0, np.bool_)
        """Mask of the samples in the damaged file that are copied to the new file."""
        self.samples: npt.NDArray[np.void] = np.empty(0, SAMPLE_DTYPE)
        """Time, tick and status of the samples that are copied."""
        self._samples = TopicBuffer(
            path, SAMPLES, ORDER_AND_FLAG_FIELDS, limits.MAX_RECORDED_SAMPLES
        )
        self._samples_per_chunk: dict[
            int, int
        ] = {}  # position of a chunk in the file → number of samples

    def add_block(self, contents: McapContents, block: MessageBlock) -> None:
        """Decode the samples of a block of messages, and count them for each chunk."""
        self._samples.decoder.add_block(contents, block)
        is_sample = self._samples.decoder.is_of_topic
        sample_count = sum(run[3] for run in block.runs if is_sample(contents, run[0]))
        self._samples_per_chunk[block.chunk_position] = (
            self._samples_per_chunk.get(block.chunk_position, 0) + sample_count
        )

    def finish(self, contents: McapContents) -> None:
        """Select the samples to copy, with increasing ticks, after all blocks were read."""
        samples = self._samples.finish(contents)
        ticks = samples["tick"]
        self.is_copied = _increasing_ticks_mask(ticks)
        (excluded_indices,) = np.nonzero(~self.is_copied)
        if len(excluded_indices):
            self.order_error = (
                f"has {len(excluded_indices)} samples that repeat or precede others, the first "
                f"of them with tick {ticks[excluded_indices[0]]}"
            )
            samples = samples[self.is_copied]
        self.samples = samples

    def duplicate_chunks(self) -> set[int]:
        """Return the file positions of chunks that contain samples, but none that is copied."""
        chunk_sample_counts = np.array(list(self._samples_per_chunk.values()), np.int64)
        # Number of copied samples up to each end of a chunk, and from it the number in each chunk.
        copied_samples_before = np.append(0, np.cumsum(self.is_copied))
        chunk_end_indices = np.cumsum(chunk_sample_counts)
        copied_samples_in_chunk = (
            copied_samples_before[chunk_end_indices]
            - copied_samples_before[chunk_end_indices - chunk_sample_counts]
        )
        has_no_copied_sample = (chunk_sample_counts > 0) & (copied_samples_in_chunk == 0)
        return {
            chunk_position
            for chunk_position, is_chunk_duplicate in zip(
                self._samples_per_chunk, has_no_copied_sample, strict=True
            )
            if is_chunk_duplicate
        }


def _increasing_ticks_mask(ticks: npt.NDArray[np.uint32]) -> npt.NDArray[np.bool_]:
    """Return a mask that selects strictly increasing ticks.

    It selects the ticks above all earlier ticks, or the ticks below all later ticks, whichever are
    more. A single tick that is far too high therefore does not exclude all ticks after it.
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
    """Return a callback for one step, which reports the step's progress as part of the total."""
    if on_progress is None:
        return None
    return lambda fraction: on_progress(start_fraction + (end_fraction - start_fraction) * fraction)


def _copy_intact_file(path: Path, final_path: Path) -> Recovery:
    """Copy a complete ``.part`` file to its final name; do nothing with any other intact file."""
    session = read_session(
        path, fields=ORDER_AND_FLAG_FIELDS, max_samples=limits.MAX_RECORDED_SAMPLES
    )
    is_part_file = path.name.endswith(PART_SUFFIX)
    if is_part_file:
        _require_target_absent(path, final_path)
        with _temporary_target(path, final_path, copied_path=path):
            pass
    return Recovery(
        source=path,
        path=final_path if is_part_file else None,
        samples=len(session.samples),
        outcome=session.outcome or {},
        damage=None,
        bytes_lost=0,
        skipped=(),
        protected=True,
    )


def _require_target_absent(path: Path, recovered_file: Path) -> None:
    """Raise if a file with the name of the new file exists."""
    if os.path.lexists(recovered_file):
        raise SessionExistsError(
            f"{recovered_file} exists and is not overwritten. Move it away to recover {path} again."
        )


@contextlib.contextmanager
def _temporary_target(
    path: Path, target_path: Path, copied_path: Path | None = None
) -> Iterator[Path]:
    """Yield the path of a temporary file, which becomes `target_path` if no error is raised.

    The temporary file is in the folder of `target_path`, and starts as a copy of `copied_path` if
    given.
    """
    temporary_path = target_path.with_name(f".{target_path.name}.{secrets.token_hex(4)}")
    try:
        if copied_path is not None:
            with copied_path.open("rb") as source:
                copy_new(source.fileno(), temporary_path)
        yield temporary_path
        rename_without_replacing(temporary_path, target_path)
        fsync_directory(target_path.parent)
    except FileExistsError:
        _require_target_absent(path, target_path)  # the target may have been created meanwhile
        raise
    except OSError as error:
        raise SessionError(
            f"{target_path} cannot be written: {error.strerror or error}. Check that the folder is "
            f"writable and has space left, or copy {path} to one that is."
        ) from error
    finally:
        temporary_path.unlink(missing_ok=True)


def _planned_recovery(
    path: Path,
    recovered_file: Path,
    contents: McapContents,
    sample_selection: _SampleSelection,
    damage: str,
    skipped_record_texts: list[str],
) -> Recovery:
    """Return the result of a recovery before the new file is written."""
    copied_samples = sample_selection.samples
    bytes_lost = path.stat().st_size - contents.intact_bytes
    # The recorded outcome describes all samples: it is used only if none is missing.
    is_outcome_valid = contents.has_correct_checksum and sample_selection.order_error is None
    planned_recovery = Recovery(
        source=path,
        path=recovered_file,
        samples=len(copied_samples),
        outcome={},
        damage=damage,
        bytes_lost=bytes_lost,
        skipped=tuple(skipped_record_texts),
        protected=contents.has_correct_checksum or bool(_metadata_from_chunk(contents)),
    )
    recovered_outcome: dict[str, str] = {}
    if is_outcome_valid:
        recovered_outcome |= merged_metadata(contents, "outcome") or {}
    else:
        recovered_outcome["outcome"] = "fault"
        recovered_outcome["reason"] = (
            f"Recovered from {path.name}, which {damage}{_loss_text(bytes_lost)}."
        )
        stated_sample_count = _sample_count(contents.stated_message_counts, contents)
        recovered_outcome |= _tick_counts(
            copied_samples, max(stated_sample_count - len(copied_samples), 0)
        )
    recovered_outcome |= {
        RECOVERED_FROM: path.name,
        "recovered_by": f"rigd {rigd.__version__}",
        "recovered_damage": damage,
        "recovered_bytes_lost": str(bytes_lost),
        "recovered_protected": str(planned_recovery.protected).lower(),
    }
    if planned_recovery.skipped:
        recovered_outcome["recovered_left_out"] = "; ".join(planned_recovery.skipped)
    return replace(planned_recovery, outcome=recovered_outcome)


def _loss_text(lost_byte_count: int) -> str:
    """Return text for an error message that states the number of lost bytes, or "" for 0."""
    return f"; {lost_byte_count} bytes from there on were lost" if lost_byte_count else ""


def _sample_count(message_count_by_channel: Mapping[int, int], contents: McapContents) -> int:
    """Return the number of samples, given ``channel number → number of messages``."""
    return sum(
        message_count_by_channel.get(channel.id, 0)
        for channel in contents.channels.values()
        if channel.topic == SAMPLE_TOPIC
    )


def _tick_counts(samples: npt.NDArray[np.void], unrecovered_sample_count: int) -> dict[str, str]:
    """Return the tick counts for the record ``outcome`` of a recovered file.

    The ticks of a gap count as missed if the flags of the next sample state so, otherwise as lost.
    `unrecovered_sample_count` is the number of samples that were in the file before it was damaged,
    and could not be recovered.
    """
    status_flags = samples["status"]
    missing_ticks_before = np.diff(samples["tick"].astype(np.int64), prepend=-1) - 1
    follows_lost_samples = (status_flags & Status.AFTER_LOST) != 0
    follows_missed_ticks = ~follows_lost_samples & ((status_flags & Status.AFTER_MISSED) != 0)
    missed_ticks = int(missing_ticks_before[follows_missed_ticks].sum())
    unexplained_ticks = int(
        missing_ticks_before[~follows_lost_samples & ~follows_missed_ticks].sum()
    )
    lost_ticks = int(missing_ticks_before[follows_lost_samples].sum()) + max(
        unexplained_ticks, unrecovered_sample_count
    )
    return {
        "scheduled": str(len(samples) + missed_ticks + lost_ticks),
        "recorded": str(len(samples)),
        "missed": str(missed_ticks),
        "lost": str(lost_ticks),
        "late": str(int(np.count_nonzero(status_flags & Status.LATE))),
        "stale_angles": str(int(np.count_nonzero(status_flags & Status.ANGLE_STALE))),
        "stale_wrenches": str(int(np.count_nonzero(status_flags & Status.WRENCH_STALE))),
    }


def _metadata_from_chunk(contents: McapContents) -> dict[str, dict[str, str]]:
    """Return the records ``session`` and ``segments`` from their copy in a chunk.

    The metadata of the samples' channel contain the copy. Returns an empty dictionary if no chunk
    contains it.
    """
    for channel in contents.channels.values():
        if channel.topic == SAMPLE_TOPIC and channel.id in contents.channels_declared_in_chunks:
            metadata_records = metadata_from_channel(channel.metadata)
            if "session" in metadata_records:
                return metadata_records
    return {}


def _metadata_records(contents: McapContents) -> dict[str, dict[str, str]]:
    """Return the metadata records to copy, except ``outcome``: name → keys and values."""
    protected_records = _metadata_from_chunk(contents)
    if protected_records and not contents.has_correct_checksum:
        return protected_records
    record_names = dict.fromkeys(
        metadata_record.name
        for metadata_record in contents.metadata
        if metadata_record.name != "outcome"
    )
    return {
        record_name: merged_metadata(contents, record_name) or {} for record_name in record_names
    }


def _write_recovered_file(
    path: Path,
    damaged_path: Path,
    contents: McapContents,
    sample_selection: _SampleSelection,
    recovery: Recovery,
    on_progress: Callable[[float], None] | None,
) -> SampleDigest:
    """Write the recovered file to `path`, and return the checksum of its samples."""
    metadata_records = _metadata_records(contents)
    copied_channels = _channels_to_copy(contents, metadata_records)
    schema_ids = {channel.schema_id for channel in copied_channels}
    with path.open("xb") as output_stream:
        mcap_writer = McapWriter(output_stream, library=f"rigd {rigd.__version__}")
        for record_name, metadata_values in metadata_records.items():
            mcap_writer.add_metadata(record_name, metadata_values)
        for attachment in contents.attachments:
            mcap_writer.add_attachment(
                attachment.name, attachment.media_type, attachment.data, attachment.log_time
            )
        mcap_writer.declare(
            [schema for schema in contents.schemas.values() if schema.id in schema_ids],
            copied_channels,
        )
        message_copier = _MessageCopier(
            damaged_path, mcap_writer, sample_selection, {channel.id for channel in copied_channels}
        )
        # Second reading, up to the same damage as the first one, which selected the samples.
        contents_read_again = load_contents(
            damaged_path,
            None,
            on_block=message_copier.add_block,
            is_salvage=True,
            on_progress=on_progress,
        )
        sample_digest = message_copier.finish(contents_read_again)
        if on_progress is not None:
            on_progress(1.0)  # the damaged end is not read
        mcap_writer.add_metadata("outcome", recovery.outcome)
        mcap_writer.finish()
        output_stream.flush()
        os.fsync(output_stream.fileno())
    return sample_digest


class _MessageCopier:
    """Second reading of a damaged file, which copies the selected messages to the new file.

    `channels` are the numbers of the channels that are declared in the new file.
    """

    def __init__(
        self,
        damaged_path: Path,
        mcap_writer: McapWriter,
        sample_selection: _SampleSelection,
        channel_ids: set[int],
    ) -> None:
        self._source = damaged_path
        self._mcap = mcap_writer
        self._is_copied = sample_selection.is_copied
        self._duplicate_chunks = sample_selection.duplicate_chunks()
        self._declared_channels = channel_ids
        self._digest = SampleDigest()
        self._decoder = MessageDecoder(damaged_path, SAMPLES, self)
        self._samples_read = 0  # samples of the damaged file in the blocks so far
        self._samples_decoded = 0  # samples decoded so far
        self._collected_records: list[bytes] = []
        self._collected_runs: list[tuple[int, int, int]] = []  # channel, bytes of a record, count
        self._collected_bytes = 0  # bytes collected for the next chunk
        self._written_bytes = 0  # bytes in chunks so far
        self._chunk_position = 0  # position of the current chunk in the damaged file

    def next_message_array(self, message_count: int) -> npt.NDArray[np.void]:
        """Return an uninitialised array for the next `message_count` decoded samples."""
        return np.empty(message_count, SAMPLE_DTYPE)

    def store(self, messages: npt.NDArray[np.void]) -> None:
        """Add the samples that are copied to the checksum."""
        decoded_count = self._samples_decoded + len(messages)
        is_copied = self._is_copied[self._samples_decoded : decoded_count]
        self._digest.add_samples(
            messages if is_copied.all() else messages[: len(is_copied)][is_copied]
        )
        self._samples_decoded = decoded_count

    def add_block(self, contents: McapContents, block: MessageBlock) -> None:
        """Collect the messages to copy from a block; write a chunk when enough are collected."""
        # Small chunks are merged, because each takes space in the index. They grow with the file.
        min_chunk_bytes = max(_MIN_CHUNK_BYTES, self._written_bytes // _CHUNKS_BEFORE_GROWTH)
        if self._collected_bytes >= min_chunk_bytes and (
            block.chunk_position != self._chunk_position
            or self._collected_bytes > _MAX_COLLECTED_BYTES
        ):
            self._flush()
        self._chunk_position = block.chunk_position
        self._decoder.add_block(contents, block)
        is_duplicate_chunk = block.chunk_position in self._duplicate_chunks
        record_bytes = memoryview(block.records)
        for channel, message_size, start, message_count in block.runs:
            copied_ranges = [(start, message_count)]
            if self._decoder.is_of_topic(contents, channel):
                is_copied = self._is_copied[self._samples_read : self._samples_read + message_count]
                self._samples_read += message_count
                if (
                    message_count == 1
                ):  # frequent where channels alternate: avoid a function call each
                    if not is_copied[0]:
                        continue
                elif not is_copied.all():
                    copied_ranges = [
                        (start + message_size * first_sample, sample_count)
                        for first_sample, sample_count in _blocks_of_true(is_copied)
                    ]
            if is_duplicate_chunk or channel not in self._declared_channels:
                continue
            for range_start, range_length in copied_ranges:
                self._collected_records.append(
                    bytes(record_bytes[range_start : range_start + message_size * range_length])
                )
                self._collected_runs.append((channel, message_size, range_length))
                self._collected_bytes += message_size * range_length

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
        """Write the collected messages as a chunk with message indexes."""
        if not self._collected_runs:
            return
        chunk_records = b"".join(self._collected_records)
        message_runs = np.array(self._collected_runs, np.int64)
        self._written_bytes += len(chunk_records)
        self._collected_records, self._collected_runs, self._collected_bytes = [], [], 0
        message_offsets = message_starts(message_runs)
        message_index = np.empty(len(message_offsets), INDEX_DTYPE)
        log_times = np.ndarray(len(chunk_records) - 7, "<u8", chunk_records, 0, (1,))
        message_index["log_time"] = log_times[message_offsets + LOG_TIME_OFFSET]
        message_index["offset"] = message_offsets
        message_channels = np.repeat(message_runs[:, 0], message_runs[:, 2])
        channel_order = np.argsort(message_channels, kind="stable")
        channel_numbers, first_entries = np.unique(
            message_channels[channel_order], return_index=True
        )
        channel_indexes = np.split(message_index[channel_order], first_entries[1:])
        self._mcap.add_chunk(
            chunk_records, dict(zip(channel_numbers.tolist(), channel_indexes, strict=True))
        )


def _blocks_of_true(boolean_mask: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return start index and length of each block of consecutive True values."""
    block_edges = np.flatnonzero(np.diff(boolean_mask, prepend=False, append=False))
    return list(
        zip(block_edges[::2].tolist(), (block_edges[1::2] - block_edges[::2]).tolist(), strict=True)
    )


def _channels_to_copy(
    contents: McapContents, metadata_records: Mapping[str, Mapping[str, str]]
) -> list[Channel]:
    """Return the channels to copy; the samples' channel gets a copy of the session's metadata."""
    excludes_unprotected_channels = (
        bool(_metadata_from_chunk(contents)) and not contents.has_correct_checksum
    )
    channel_metadata = metadata_for_channel(
        metadata_records.get("session", {}), metadata_records.get("segments", {})
    )
    usable_channels = [
        channel
        for channel in contents.channels.values()
        if channel.id in contents.channels_declared_in_chunks or not excludes_unprotected_channels
    ]
    own_channels = [channel for channel in usable_channels if channel.topic in OWN_TOPICS]
    other_channels = [channel for channel in usable_channels if channel.topic not in OWN_TOPICS]
    return [
        replace(channel, metadata={**channel.metadata, **channel_metadata})
        if channel.topic == SAMPLE_TOPIC
        else channel
        for channel in (
            *own_channels[:_MAX_COPIED_CHANNELS],
            *other_channels[:_MAX_COPIED_CHANNELS],
        )
    ]
