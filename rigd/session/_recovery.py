"""Recovery of damaged session files: the intact part of one is written to a valid file.

Only verified data is used: messages, channels and schemas are in chunks with a checksum each, the
records ``session`` and ``segments`` are taken from the copy in such a chunk, and attachments have a
checksum of their own. The outcome counts only if the checksum of the whole data section is correct.
A file of another writer may lack some checksums; it is recovered and marked as unprotected.

`remedy` states how much of an incomplete file can be recovered, and by which command.
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
    SURVEY_FIELDS,
    TopicBuffer,
    load_contents,
    merged_metadata,
    read_session,
)
from rigd.session._schema import OWN_TOPICS, SAMPLE_TOPIC, protected_metadata, unprotected_metadata
from rigd.session._writer import (
    PART_SUFFIX,
    copy_new,
    fsync_directory,
    is_being_written,
    rename_new,
)
from rigd.session.layout import SAMPLE_DTYPE, SAMPLE_FIELDS, Status

RECOVERED_FROM: Final = "recovered_from"
"""Key of the record ``outcome`` that marks a recovered file: the name of the one it is from."""

_SESSION_SUFFIX: Final = ".mcap"
_RECOVERED_SUFFIX: Final = ".recovered.mcap"
_LEAST_CHUNK_BYTES: Final = 1 << 14
_LONG_CHUNK: Final = 4 << 20
_MOST_CHUNKS: Final = 10_000
"""Number of chunks after which they are made longer."""
_MOST_CHANNELS: Final = 32
"""Most channels that are copied, of the session's own topics and of others each."""
_READING_FRACTION: Final = 0.3
"""Fraction of the time of a recovery for reading."""

_BEGINNING_BYTES: Final = 1 << 20
"""Length of the beginning that contains the first samples, if there are any."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """Result of a recovery."""

    source: Path
    """The given file."""
    path: Path | None
    """The new file; None if `source` is a sound session already."""
    samples: int
    """Number of intact samples."""
    outcome: Mapping[str, str]
    """The record ``outcome`` of the new file, with the losses."""
    damage: str | None
    """Damage of `source`, a sentence's predicate; None if it is sound."""
    bytes_lost: int
    """Bytes of `source` after the last intact record."""
    skipped: tuple[str, ...]
    """Damaged records before it that were left out, as predicates."""
    protected: bool
    """Whether checksums cover rate, beam and segments."""

    def as_dict(self) -> dict[str, Any]:
        """Return the result as a document of JSON types."""
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
        """Return the result as lines of text."""
        if self.path is None:
            return [f"{self.source} is complete and intact; there is nothing to recover."]
        if self.damage is None:
            return [
                f"{self.path}: {self.source} is complete and intact, and was copied under this "
                "name."
            ]
        lines = [
            f"{self.path}: {self.samples} samples recovered from {self.source}, which "
            f"{self.damage}{_loss(self.bytes_lost)}."
        ]
        lines += [f"Left out: {self.source} {skipped}." for skipped in self.skipped]
        if not self.protected:
            lines.append(
                "Warning: no checksum covers the metadata of this file; compare rate, beam and "
                "segments (rigd info) with what you know of the session."
            )
        return lines


def recovered_path(path: Path) -> Path:
    """Return the path of the recovered file: ``X.mcap.part`` → ``X.mcap``, else a new name."""
    if path.name.endswith(_SESSION_SUFFIX + PART_SUFFIX):
        return path.with_name(path.name.removesuffix(PART_SUFFIX))
    return path.with_name(path.name.removesuffix(_SESSION_SUFFIX) + _RECOVERED_SUFFIX)


def recover(
    path: str | os.PathLike[str], on_progress: Callable[[float], None] | None = None
) -> Recovery:
    """Write the intact part of a session file, up to the damage, to a new file in its folder.

    The original file is not changed. The new one gets its name when it is complete, on the disk,
    and was read back.

    Parameters
    ----------
    path : an incomplete ``.part`` or a damaged session file
    on_progress : called now and then with the completed fraction of the work

    Raises
    ------
        If the new name exists already.
        If the new name is taken.
    SessionError
        If the file cannot be read, is still being recorded, or has no sample before the damage; or
        if the new one cannot be written.
    """
    path = Path(path)
    if path.exists() and not path.is_file():  # reading a pipe would block
        raise SessionError(f"{path} is not a file. Give the path of a session file.")
    target = recovered_path(path)
    if is_being_written(path):
        raise SessionError(f"{path} is still being recorded. Wait for the end of the session.")
    survey = _Survey(path)
    contents = load_contents(
        path, None, take=survey.take, salvage=True,
        on_progress=_part(on_progress, 0.0, _READING_FRACTION),
    )  # fmt: skip
    survey.finish(contents)
    if contents.damage is None and not contents.skipped and survey.left_out is None:
        return _recover_sound(path, target)
    found = [contents.damage, *contents.skipped, survey.left_out]
    damage, *others = [each for each in found if each is not None]
    if not survey.retained.any():
        raise SessionError(
            f"{path} {damage}; no sample is intact before that, so there is nothing to recover."
        )
    recovery = _plan(path, target, contents, survey, damage, others)
    _refuse_taken(path, target)
    with _new_file(path, target) as temporary:
        expected = _write(
            temporary, path, contents, survey, recovery, _part(on_progress, _READING_FRACTION, 1.0)
        )
        written = SampleDigest()
        try:
            read_session(
                temporary,
                fields=SURVEY_FIELDS,
                max_samples=limits.MAX_SURVEYED,
                on_samples=written.take,
            )
        except SessionError as error:
            named = str(error).replace(str(temporary), str(path))
            raise SessionError(f"{path} cannot be recovered to a session. {named}") from None
        if written.digest() != expected.digest():
            raise SessionError(
                f"{target} was not made: what was written for it does not read back as it is in "
                f"{path}. Check the disk."
            )
    return recovery


class SampleDigest:
    """Checksum of samples, all fields and bit by bit, independent of their blocks."""

    def __init__(self) -> None:
        self._sums = {name: hashlib.blake2b() for name in SAMPLE_FIELDS}

    def take(self, samples: npt.NDArray[np.void]) -> None:
        """Add samples."""
        for name, checksum in self._sums.items():
            checksum.update(samples[name].tobytes())

    def digest(self) -> bytes:
        """Return the checksum of the samples so far."""
        return b"".join(checksum.digest() for checksum in self._sums.values())


class _Survey:
    """First pass of a recovery: finds the samples to copy, and the units that contain them."""

    def __init__(self, path: Path) -> None:
        self.left_out: str | None = None
        """Error in the order of the samples, a sentence's predicate."""
        self.retained: npt.NDArray[np.bool_] = np.empty(0, np.bool_)
        """Whether each sample in the file is copied."""
        self.samples: npt.NDArray[np.void] = np.empty(0, SAMPLE_DTYPE)
        """Tick and status of the copied samples."""
        self._samples = TopicBuffer(path, SAMPLES, SURVEY_FIELDS, limits.MAX_SURVEYED)
        self._units: dict[int, int] = {}

    def take(self, contents: McapContents, block: MessageBlock) -> None:
        """Count the messages of a block."""
        self._samples.decoder.take(contents, block)
        is_sample = self._samples.decoder.is_of_topic
        count = sum(run[3] for run in block.runs if is_sample(contents, run[0]))
        self._units[block.unit] = self._units.get(block.unit, 0) + count

    def finish(self, contents: McapContents) -> None:
        """Decide which samples are copied.

        Raises
        ------
        SessionError
            If the samples cannot be decoded.
        """
        samples = self._samples.finish(contents)
        ticks = samples["tick"]
        self.retained = _increasing(ticks)
        (others,) = np.nonzero(~self.retained)
        if len(others):
            self.left_out = (
                f"has {len(others)} samples that repeat or precede others, the first of them with "
                f"tick {ticks[others[0]]}"
            )
            samples = samples[self.retained]
        self.samples = samples

    def dropped_units(self) -> set[int]:
        """Return the units with samples of which none is copied: they are duplicates."""
        counts = np.array(list(self._units.values()), np.int64)
        # Number of copied samples up to the end of each unit, and from it in each unit.
        retained = np.append(0, np.cumsum(self.retained))
        ends = np.cumsum(counts)
        retained_in = retained[ends] - retained[ends - counts]
        dropped = (counts > 0) & (retained_in == 0)
        return {unit for unit, is_dropped in zip(self._units, dropped, strict=True) if is_dropped}


def holds_samples(path: Path) -> bool:
    """Return whether `recover` finds a sample in the beginning of a file.

    Returns True for a file that cannot be read.
    """
    try:
        with path.open("rb") as file:
            beginning = file.read(_BEGINNING_BYTES)
            longer = bool(file.read(1))
    except OSError:
        return True
    try:
        contents = read_mcap(memoryview(beginning), (), salvage=True)
    except McapError:
        return False
    return longer or contents.count(SAMPLE_TOPIC) > 0


def remedy(path: Path, *, was_whole: bool) -> str:
    """Describe how much of an incomplete or damaged file is intact, and how to recover that.

    Parameters
    ----------
    path : the file
    was_whole : whether it was complete once, so that a sound copy may exist

    Returns
    -------
    Continuation of the sentence on the damage, from the mark after it.
    """
    try:
        count = load_contents(path, (), salvage=True).count(SAMPLE_TOPIC)
    except SessionError:
        count = 0
    again = ". Copy it again from where it was recorded"
    readable = f"; {count} complete samples are readable before that"
    if not count:
        nothing = ", so there is nothing to recover"
        if was_whole:
            return f"{readable}{nothing}{again}."
        return f"{readable}{nothing}. Copy it again if there is a complete one, or record it again."
    target = recovered_path(path)
    command = f"`rigd recover {shlex.quote(str(path))}`"
    if os.path.lexists(target):
        command += f", once {target}, which may hold it already, is moved away"
    if was_whole:
        return f"{again}, or save what is intact with {command}."
    return f"{readable}. Save them with {command}."


def _increasing(ticks: npt.NDArray[np.uint32]) -> npt.NDArray[np.bool_]:
    """Return which ticks to copy so that they increase.

    Those above all before them; or, if there are more, those below all after them: a single tick
    that is far too high then costs no others.
    """
    above, below = np.ones((2, len(ticks)), np.bool_)
    above[1:] = ticks[1:] > np.maximum.accumulate(ticks)[:-1]
    if above.all():
        return above
    below[:-1] = ticks[:-1] < np.minimum.accumulate(ticks[::-1])[::-1][1:]
    return below if below.sum() > above.sum() else above


def _part(
    on_progress: Callable[[float], None] | None, first: float, end: float
) -> Callable[[float], None] | None:
    """Scale the progress of one part of the work to its range of the whole."""
    if on_progress is None:
        return None
    return lambda fraction: on_progress(first + (end - first) * fraction)


def _recover_sound(path: Path, target: Path) -> Recovery:
    """Give a complete file its name, if it has another one."""
    session = read_session(path, fields=SURVEY_FIELDS, max_samples=limits.MAX_SURVEYED)
    is_part = path.name.endswith(PART_SUFFIX)
    if is_part:
        _refuse_taken(path, target)
        with _new_file(path, target, like=path):
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


def _refuse_taken(path: Path, target: Path) -> None:
    if os.path.lexists(target):
        raise SessionExistsError(
            f"{target} exists and is not overwritten. Move it away to recover {path} again."
        )


@contextlib.contextmanager
def _new_file(path: Path, target: Path, like: Path | None = None) -> Iterator[Path]:
    """Yield a temporary path in the folder of `target`; rename it to `target` on success."""
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        if like is not None:
            with like.open("rb") as source:
                copy_new(source.fileno(), temporary)
        yield temporary
        rename_new(temporary, target)
        fsync_directory(target.parent)
    except FileExistsError:
        _refuse_taken(path, target)  # it may have appeared meanwhile
        raise
    except OSError as error:
        raise SessionError(
            f"{target} cannot be written: {error.strerror or error}. Check that the folder is "
            f"writable and has space left, or copy {path} to one that is."
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def _plan(
    path: Path,
    target: Path,
    contents: McapContents,
    survey: _Survey,
    damage: str,
    skipped: list[str],
) -> Recovery:
    """Return the result with outcome and protection of the new file."""
    samples = survey.samples
    bytes_lost = path.stat().st_size - contents.sound_bytes
    # The recorded outcome applies to all samples.
    is_whole = contents.verified and survey.left_out is None
    recovery = Recovery(
        source=path,
        path=target,
        samples=len(samples),
        outcome={},
        damage=damage,
        bytes_lost=bytes_lost,
        skipped=tuple(skipped),
        protected=contents.verified or bool(_protected_records(contents)),
    )
    outcome: dict[str, str] = {}
    if is_whole:
        outcome |= merged_metadata(contents, "outcome") or {}
    else:
        outcome["outcome"] = "fault"
        outcome["reason"] = f"Recovered from {path.name}, which {damage}{_loss(bytes_lost)}."
        stated = _count(contents.stated_counts, contents)
        outcome |= _counts(samples, max(stated - len(samples), 0))
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


def _loss(count: int) -> str:
    return f"; {count} bytes from there on were lost" if count else ""


def _count(counts: Mapping[int, int], contents: McapContents) -> int:
    """Sum a count of messages over the channels of samples."""
    return sum(
        counts.get(channel.id, 0)
        for channel in contents.channels.values()
        if channel.topic == SAMPLE_TOPIC
    )


def _counts(samples: npt.NDArray[np.void], known_to_be_gone: int) -> dict[str, str]:
    """Account for every tick that is known to have been due.

    A gap whose next sample is not flagged as missed was lost, in the loop or by the damage.
    `known_to_be_gone` samples were in the file once.
    """
    status = samples["status"]
    gaps = np.diff(samples["tick"].astype(np.int64), prepend=-1) - 1
    was_lost = (status & Status.AFTER_LOST) != 0
    was_missed = ~was_lost & ((status & Status.AFTER_MISSED) != 0)
    missed = int(gaps[was_missed].sum())
    unexplained = int(gaps[~was_lost & ~was_missed].sum())
    lost = int(gaps[was_lost].sum()) + max(unexplained, known_to_be_gone)
    return {
        "scheduled": str(len(samples) + missed + lost),
        "recorded": str(len(samples)),
        "missed": str(missed),
        "lost": str(lost),
        "late": str(int(np.count_nonzero(status & Status.LATE))),
        "stale_angles": str(int(np.count_nonzero(status & Status.ANGLE_STALE))),
        "stale_wrenches": str(int(np.count_nonzero(status & Status.WRENCH_STALE))),
    }


def _protected_records(contents: McapContents) -> dict[str, dict[str, str]]:
    """Return ``session`` and ``segments`` from a chunk; empty if no chunk has them."""
    for channel in contents.channels.values():
        if channel.topic == SAMPLE_TOPIC and channel.id in contents.declared_in_chunks:
            records = unprotected_metadata(channel.metadata)
            if "session" in records:
                return records
    return {}


def _records(contents: McapContents) -> dict[str, dict[str, str]]:
    """Return the metadata to copy, by name, without the outcome."""
    protected = _protected_records(contents)
    if protected and not contents.verified:
        return protected
    names = dict.fromkeys(record.name for record in contents.metadata if record.name != "outcome")
    return {name: merged_metadata(contents, name) or {} for name in names}


def _write(
    path: Path,
    source: Path,
    contents: McapContents,
    survey: _Survey,
    recovery: Recovery,
    on_progress: Callable[[float], None] | None,
) -> SampleDigest:
    """Write the new file; return the checksum of its samples."""
    records = _records(contents)
    channels = _channels(contents, records)
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
        copy = _Copy(source, mcap, survey, {channel.id for channel in channels})
        # Second pass, as far as the first one, which has found the samples to copy.
        again = load_contents(source, None, take=copy.take, salvage=True, on_progress=on_progress)
        digest = copy.finish(again)
        if on_progress is not None:
            on_progress(1.0)  # the damaged end is not read
        mcap.add_metadata("outcome", recovery.outcome)
        mcap.finish()
        stream.flush()
        os.fsync(stream.fileno())
    return digest


class _Copy:
    """Second pass of a recovery: copies the messages.

    Parameters
    ----------
    source : the file, for error messages
    mcap : the new file
    survey : first pass, with the samples to copy
    channels : declared channels
    """

    def __init__(self, source: Path, mcap: McapWriter, survey: _Survey, channels: set[int]) -> None:
        self._source = source
        self._mcap = mcap
        self._retained = survey.retained
        self._dropped = survey.dropped_units()
        self._channels = channels
        self._digest = SampleDigest()
        self._decoder = MessageDecoder(source, SAMPLES, self)
        self._read = 0  # samples of the file
        self._decoded = 0
        self._parts: list[bytes] = []
        self._runs: list[tuple[int, int, int]] = []  # channel, bytes of a record, count
        self._length = 0
        self._written = 0
        self._unit = 0

    def room(self, count: int) -> npt.NDArray[np.void]:
        """Return room for samples; see `rigd.session._message_decoder.MessageSink`."""
        return np.empty(count, SAMPLE_DTYPE)

    def store(self, messages: npt.NDArray[np.void]) -> None:
        """Add the copied samples to the checksum."""
        end = self._decoded + len(messages)
        retained = self._retained[self._decoded : end]
        self._digest.take(messages if retained.all() else messages[: len(retained)][retained])
        self._decoded = end

    def take(self, contents: McapContents, block: MessageBlock) -> None:
        """Copy the messages of a block."""
        # Small chunks are merged, to longer ones in longer files: each takes room in the index.
        least = max(_LEAST_CHUNK_BYTES, self._written // _MOST_CHUNKS)
        if self._length >= least and (block.unit != self._unit or self._length > _LONG_CHUNK):
            self._flush()
        self._unit = block.unit
        self._decoder.take(contents, block)
        is_dropped = block.unit in self._dropped
        records = memoryview(block.records)
        for channel, size, start, count in block.runs:
            parts = [(start, count)]
            if self._decoder.is_of_topic(contents, channel):
                retained = self._retained[self._read : self._read + count]
                self._read += count
                if count == 1:  # frequent where channels alternate: avoid a function call each
                    if not retained[0]:
                        continue
                elif not retained.all():
                    parts = [(start + size * first, n) for first, n in _retained_blocks(retained)]
            if is_dropped or channel not in self._channels:
                continue
            for first, number in parts:
                self._parts.append(bytes(records[first : first + size * number]))
                self._runs.append((channel, size, number))
                self._length += size * number

    def finish(self, contents: McapContents) -> SampleDigest:
        """Write the remaining messages; return the checksum of the samples.

        Raises
        ------
        SessionError
            If the file has changed since the first pass.
        """
        self._flush()
        self._decoder.finish(contents)
        if not self._read == self._decoded == len(self._retained):
            raise SessionError(
                f"{self._source} has changed while it was read. Recover it when nothing writes it."
            )
        return self._digest

    def _flush(self) -> None:
        """Write a chunk, with a rebuilt index."""
        if not self._runs:
            return
        data = b"".join(self._parts)
        runs = np.array(self._runs, np.int64)
        self._written += len(data)
        self._parts, self._runs, self._length = [], [], 0
        starts = message_starts(runs)
        index = np.empty(len(starts), INDEX_DTYPE)
        times = np.ndarray(len(data) - 7, "<u8", data, 0, (1,))
        index["log_time"] = times[starts + LOG_TIME_OFFSET]
        index["offset"] = starts
        channels = np.repeat(runs[:, 0], runs[:, 2])
        order = np.argsort(channels, kind="stable")
        numbers, firsts = np.unique(channels[order], return_index=True)
        parts = np.split(index[order], firsts[1:])
        self._mcap.add_chunk(data, dict(zip(numbers.tolist(), parts, strict=True)))


def _retained_blocks(retained: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return start and length of each block of retained samples."""
    edges = np.flatnonzero(np.diff(retained, prepend=False, append=False))
    return list(zip(edges[::2].tolist(), (edges[1::2] - edges[::2]).tolist(), strict=True))


def _channels(contents: McapContents, records: Mapping[str, Mapping[str, str]]) -> list[Channel]:
    """Return the channels to copy; that of the samples gets the metadata that readers need."""
    only_proven = bool(_protected_records(contents)) and not contents.verified
    metadata = protected_metadata(records.get("session", {}), records.get("segments", {}))
    proven = [
        channel
        for channel in contents.channels.values()
        if channel.id in contents.declared_in_chunks or not only_proven
    ]
    ours = [channel for channel in proven if channel.topic in OWN_TOPICS]
    others = [channel for channel in proven if channel.topic not in OWN_TOPICS]
    return [
        replace(channel, metadata={**channel.metadata, **metadata})
        if channel.topic == SAMPLE_TOPIC
        else channel
        for channel in (*ours[:_MOST_CHANNELS], *others[:_MOST_CHANNELS])
    ]
