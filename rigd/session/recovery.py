"""What is left of a torn or damaged session file, made into a sound one.

Nothing is taken that is not proven: messages, channels and schemas stand in chunks with a checksum
each, the records ``session`` and ``segments`` are taken from the copy in such a chunk, attachments
have a checksum of their own, and the outcome counts only if that of the whole data section is
right. A file of another writer may lack some of this; it is recovered and marked as unprotected.
"""

import contextlib
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
from rigd.session.durable import copy_new, fsync_directory, is_being_written, rename_new
from rigd.session.errors import SessionError, SessionExistsError
from rigd.session.format import Status
from rigd.session.mcap_reader import McapContents, Run
from rigd.session.mcap_writer import INDEX_DTYPE, LOG_TIME_OFFSET, McapWriter
from rigd.session.reader import (
    load_contents,
    load_samples,
    merged_metadata,
    read_session,
)
from rigd.session.schema import SAMPLE_TOPIC, protected_metadata, unprotected_metadata
from rigd.session.writer import PART_SUFFIX

RECOVERED_FROM: Final = "recovered_from"
"""Key of the record ``outcome`` that marks a recovered file: the name of the one it is from."""

_SESSION_SUFFIX: Final = ".mcap"
_RECOVERED_SUFFIX: Final = ".recovered.mcap"
_READING_SHARE: Final = 0.3
"""Of the time that recovering takes."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """What was made of a file."""

    source: Path
    path: Path | None
    """The new file; None if `source` is a sound session already."""
    samples: int
    outcome: Mapping[str, str]
    """The record ``outcome`` of the new file, with what was lost."""
    damage: str | None
    """What is wrong with `source`, a sentence's predicate; None if nothing is."""
    bytes_lost: int
    """Bytes of `source` behind the last intact record."""
    skipped: tuple[str, ...]
    """Damaged records before that which were left out, predicates as well."""
    protected: bool
    """Whether checksums cover rate, beam and segments, so that they are certainly right."""

    def as_dict(self) -> dict[str, Any]:
        """Return it as a document of JSON types."""
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
        """Return it as lines of text."""
        if self.path is None:
            return [f"{self.source} is complete and sound; there is nothing to recover."]
        if self.damage is None:
            return [
                f"{self.path}: {self.source} is complete and sound, and was copied under this name."
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
    """Name the file that `recover` writes: ``X.mcap.part`` → ``X.mcap``, otherwise a new name."""
    if path.name.endswith(_SESSION_SUFFIX + PART_SUFFIX):
        return path.with_name(path.name.removesuffix(PART_SUFFIX))
    return path.with_name(path.name.removesuffix(_SESSION_SUFFIX) + _RECOVERED_SUFFIX)


def recover(
    path: str | os.PathLike[str], on_progress: Callable[[float], None] | None = None
) -> Recovery:
    """Write what is intact of a session file, up to the damage, to a new file beside it.

    The file itself is left as it is. The new one appears under its name when it is complete, on
    the disk, and was read back.

    Parameters
    ----------
    path : a torn ``.part`` or a damaged session file
    on_progress : called now and then with the share of the work that is done

    Raises
    ------
    SessionExistsError
        If the new name is taken.
    SessionError
        If the file cannot be read, is still being recorded, or holds no sample before the damage;
        or if the new one cannot be written.
    """
    path = Path(path)
    if path.exists() and not path.is_file():  # a pipe would be waited for
        raise SessionError(f"{path} is not a file. Give the path of a session file.")
    target = recovered_path(path)
    if is_being_written(path):
        raise SessionError(f"{path} is still being recorded. Wait for the end of the session.")
    contents = load_contents(
        path, (SAMPLE_TOPIC,), salvage=True, on_progress=_part(on_progress, 0.0, _READING_SHARE)
    )
    if contents.damage is None and not contents.skipped:
        return _recover_sound(path, target)
    damage = contents.damage or contents.skipped[0]
    samples = load_samples(path, contents)
    if len(samples) == 0:
        raise SessionError(
            f"{path} {damage}; no sample is intact before that, so there is nothing to recover."
        )
    recovery = _plan(path, target, contents, samples, damage)
    _refuse_taken(path, target)
    with _new_file(path, target) as temporary:
        _write(temporary, contents, recovery, _part(on_progress, _READING_SHARE, 1.0))
        try:
            written = read_session(temporary).samples
        except SessionError as error:
            named = str(error).replace(str(temporary), str(path))
            raise SessionError(f"{path} cannot be recovered to a session. {named}") from None
        if not _identical(written, samples):
            raise SessionError(
                f"{target} was not made: what was written for it does not read back as it is in "
                f"{path}. Check the disk."
            )
    return recovery


def _identical(first: npt.NDArray[np.void], second: npt.NDArray[np.void]) -> bool:
    """Compare bit by bit, but not what lies between the fields."""
    names = first.dtype.names or ()
    return all(first[name].tobytes() == second[name].tobytes() for name in names)


def _part(
    on_progress: Callable[[float], None] | None, first: float, end: float
) -> Callable[[float], None] | None:
    """Make a part's share of the work a share of the whole."""
    if on_progress is None:
        return None
    return lambda share: on_progress(first + (end - first) * share)


def _recover_sound(path: Path, target: Path) -> Recovery:
    """Give a file that is complete its name, if it has not got one."""
    session = read_session(path)
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
    """Give a name beside `target` to write to, and rename it once that went well."""
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}")
    try:
        if like is not None:
            with like.open("rb") as source:
                copy_new(source.fileno(), temporary)
        yield temporary
        rename_new(temporary, target)
        fsync_directory(target.parent)
    except FileExistsError:
        _refuse_taken(path, target)  # it has appeared meanwhile
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
    samples: npt.NDArray[np.void],
    damage: str,
) -> Recovery:
    """Decide what the new file says of itself."""
    bytes_lost = path.stat().st_size - contents.sound_bytes
    recovery = Recovery(
        source=path,
        path=target,
        samples=len(samples),
        outcome={},
        damage=damage,
        bytes_lost=bytes_lost,
        skipped=tuple(contents.skipped if contents.damage else contents.skipped[1:]),
        protected=contents.verified or bool(_protected_records(contents)),
    )
    outcome: dict[str, str] = {}
    if contents.verified:
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

    A gap that the first sample after it does not call missed was lost, in the loop or with the
    damage. `known_to_be_gone` samples were in the file once.
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
    """Return ``session`` and ``segments`` as a chunk has them; empty if none has."""
    for channel in contents.channels.values():
        if channel.topic == SAMPLE_TOPIC and channel.id in contents.declared_in_chunks:
            records = unprotected_metadata(channel.metadata)
            if "session" in records:
                return records
    return {}


def _records(contents: McapContents) -> dict[str, dict[str, str]]:
    """Return the metadata to take over, by name, without the outcome."""
    protected = _protected_records(contents)
    if protected and not contents.verified:
        return protected
    names = dict.fromkeys(record.name for record in contents.metadata if record.name != "outcome")
    return {name: merged_metadata(contents, name) or {} for name in names}


def _write(
    path: Path,
    contents: McapContents,
    recovery: Recovery,
    on_progress: Callable[[float], None] | None,
) -> None:
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
        wanted = {channel.id for channel in channels}
        for number, chunk in enumerate(contents.chunks, start=1):
            _write_chunk(mcap, [run for run in chunk if run.channel in wanted])
            if on_progress is not None:
                on_progress(number / len(contents.chunks))
        mcap.add_metadata("outcome", recovery.outcome)
        mcap.finish()
        stream.flush()
        os.fsync(stream.fileno())


def _channels(contents: McapContents, records: Mapping[str, Mapping[str, str]]) -> list[Channel]:
    """Return the channels to take over, that of the samples with what a reader needs."""
    only_proven = bool(_protected_records(contents)) and not contents.verified
    metadata = protected_metadata(records.get("session", {}), records.get("segments", {}))
    return [
        replace(channel, metadata={**channel.metadata, **metadata})
        if channel.topic == SAMPLE_TOPIC
        else channel
        for channel in contents.channels.values()
        if channel.id in contents.declared_in_chunks or not only_proven
    ]


def _write_chunk(mcap: McapWriter, runs: list[Run]) -> None:
    """Write message records as they are, with an index made anew."""
    pieces = [piece for run in runs for piece in run.pieces]
    indexes: dict[int, list[npt.NDArray[np.void]]] = {}
    offset = 0
    for run in runs:
        for piece in run.pieces:
            count = len(piece) // run.size
            index = np.empty(count, INDEX_DTYPE)
            index["log_time"] = np.ndarray(count, "<u8", piece, LOG_TIME_OFFSET, (run.size,))
            index["offset"] = offset + run.size * np.arange(count)
            indexes.setdefault(run.channel, []).append(index)
            offset += len(piece)
    if indexes:
        mcap.add_chunk(
            b"".join(pieces),
            {channel: np.concatenate(parts) for channel, parts in indexes.items()},
        )
