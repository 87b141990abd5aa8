"""Parts of a session that are analysed instead of the whole: samples, segments, equal blocks."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.record_checks import RecordError, first_mode_hz, stated_beam, stated_rate_hz
from rigd.session import (
    SessionError,
    limits,
    linear_sweep_band_hz,
    read_session,
    read_summary,
    sweep_frequency_hz,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from rigd.beam import Beam
    from rigd.session import Session

PartOption = tuple[float | None, float | None]
"""Requested part of a session, from and to a time in seconds; None for its beginning or end."""

_MIN_PART_PERIODS: Final = 10.0
"""Minimum length of a part, in periods of the first mode. The beam may ring at the beginning of a
part, and a shorter part does not distinguish this ringing from the response to the motor."""

_TICK_TOLERANCE: Final = 1e-3
"""Tolerance in ticks for the rounding of a time that is stated in seconds."""

_MAX_GAP_BEFORE_PART_S: Final = 1.0
"""Longest time without a sample before a part that was read by the times of its chunks."""

_SINGLE_MOTIONS: Final = ("step", "move", "touch")
"""Excitations that are one motion: blocks of them have nothing in common."""

BLOCK_S: Final = 900.0
"""Default length in seconds of the blocks of a long session."""


@dataclass(frozen=True, slots=True)
class RecordSource:
    """Session file of which all or a part is analysed as one record.

    Attributes
    ----------
    path : Path
        Session file.
    part_s : tuple of float or None
        Beginning and end of the part in seconds since the session's start, None for the beginning
        or end of the session. None for the whole session.
    """

    path: Path
    part_s: PartOption | None = None

    @property
    def part_name(self) -> str:
        """Beginning and end of the part as a name, such as "0 to 900 s"; empty for the whole."""
        if self.part_s is None:
            return ""
        from_s, to_s = self.part_s
        return f"{from_s or 0.0:g} s to end" if to_s is None else f"{from_s or 0.0:g} to {to_s:g} s"

    @property
    def name(self) -> str:
        """Name of the part, or of the file if its whole session is analysed."""
        return self.part_name or self.path.name

    def __str__(self) -> str:
        return f"{self.path}, {self.part_name}" if self.part_s else str(self.path)

    def as_json(self) -> dict[str, Any]:
        """Return file and part as the first columns of a table in a file."""
        return {
            "file": str(self.path),
            **(dict(zip(("from_s", "to_s"), self.part_s, strict=True)) if self.part_s else {}),
        }


def blocks_of_session(path: Path, block_s: float = BLOCK_S) -> tuple[RecordSource, ...]:
    """Divide a session into consecutive blocks of equal length, each with some of the excitation.

    The first block also contains the rest before the excitation, and the last one the ring-down
    after it, and up to half a block more or less of the excitation.

    Parameters
    ----------
    path : Path
        Session file.
    block_s : float
        Length of the blocks in seconds.

    Raises
    ------
    SessionError
        The file cannot be read or is damaged.
    RecordError
        The blocks are too short for an estimate, the session is too short for two of them, or it
        is a linear sweep or a single motion.
    """
    summary = read_summary(path)
    if summary.samples is None:
        raise SessionError(f"{path}: {summary.problem}")
    metadata = summary.metadata
    if metadata.get("excitation") in _SINGLE_MOTIONS:
        raise RecordError(
            f"{path}: a {metadata['excitation']} is one motion, whose blocks cannot be compared. "
            "Record several and analyse them together."
        )
    if linear_sweep_band_hz(metadata.get("excitation", ""), metadata) is not None:
        raise RecordError(
            f"{path}: blocks of one sweep have different frequencies, so they do not show what "
            "changes with time. Record several sweeps (rigd run chirp --repeat) and analyse them "
            "together, or a part of this one (--from, --to)."
        )
    read_ticks = partial(
        read_session, path, fields=("t_ns", "tick"), max_samples=limits.MAX_RECORDED_SAMPLES
    )
    beginning = read_ticks(part_s=(0.0, 0.0))
    if len(beginning.samples) == 0:  # the record begins later
        beginning = read_ticks()
    rate_hz, first_tick = stated_rate_hz(beginning), int(beginning.samples["tick"][:1].sum())
    check_part_length(path, (0.0, block_s), stated_beam(beginning, rate_hz, summary.samples))
    first_s, end_s = first_tick / rate_hz, (first_tick + summary.samples) / rate_hz
    excited_ticks = beginning.segments.get("sweep", (0, math.inf))
    excited_from_s, excited_to_s = (
        min(max(tick / rate_hz, first_s), end_s) for tick in excited_ticks
    )
    limits_s = [
        first_s + block_s * number
        for number in range(
            math.ceil((excited_from_s - first_s) / block_s + 0.5),
            math.floor((excited_to_s - first_s) / block_s - 0.5) + 1,
        )
    ]
    if not limits_s:
        raise RecordError(
            f"{path}: {excited_to_s - excited_from_s:g} s of excitation are too short for two "
            f"blocks of {block_s:g} s; choose a shorter --block."
        )
    return tuple(
        RecordSource(path, part_s)
        for part_s in zip([None, *limits_s], [*limits_s, None], strict=True)
    )


def read_session_part(
    path: Path, part_s: PartOption | None, *, fields: Sequence[str], max_samples: int
) -> tuple[Session, tuple[float, float] | None]:
    """Read a session, or only those of its chunks that contain samples of a part.

    Parameters
    ----------
    path : Path
        Session file.
    part_s : tuple of float or None
        Beginning and end of the part in seconds since the session's start, None for the beginning
        or end of the session. None for the whole session.
    fields : sequence of str
        Fields of the samples, as for `rigd.session.read_session`.
    max_samples : int
        Maximum number of samples.

    Returns
    -------
    session : Session
        Session with at least the samples of the part, and those of its rest.
    interval_s : tuple of float or None
        Beginning and end in seconds of the interval that was read; None for all samples.

    Raises
    ------
    RecordError
        The part does not end after its beginning, or a time is no finite number.
    """
    _check_times_of_part(path, part_s)
    read = partial(read_session, path, fields=fields, max_samples=max_samples)
    if part_s is not None:
        interval_s = (part_s[0] or 0.0, math.inf if part_s[1] is None else part_s[1])
        with suppress(SessionError):  # raised again if the whole file has the error
            session = read(part_s=interval_s)
            if _contains_part(session.samples["tick"], part_s, stated_rate_hz(session)):
                return session, interval_s
    return read(), None


def _check_times_of_part(path: Path, part_s: PartOption | None) -> None:
    """Raise if a part has a time that is no finite number, or does not end after its beginning."""
    from_s, to_s = part_s or (None, None)
    for option_name, time_s in (("--from", from_s), ("--to", to_s)):
        if time_s is not None and not math.isfinite(time_s):
            raise RecordError(
                f"{path}: {option_name} {time_s:g} s must be a time since the session's start, 0 "
                "or more."
            )
    if from_s is not None and to_s is not None and not from_s < to_s:
        raise RecordError(
            f"{path}: the part from {from_s:g} to {to_s:g} s is empty; --from must be less than "
            "--to."
        )


def _contains_part(ticks: NDArray[np.int64], part_s: PartOption, rate_hz: float) -> bool:
    """Return whether the ticks that were read begin shortly before a part, and end after it.

    If not, the file states wrong times of its chunks, or the part is not in the record.
    """
    first_tick, end_tick = (None if time_s is None else time_s * rate_hz for time_s in part_s)
    if len(ticks) == 0 or not (end_tick is None or end_tick <= ticks[-1] + 1):
        return False
    if first_tick is None or first_tick <= ticks[0]:
        return True
    earlier_ticks = ticks[ticks < first_tick]
    longest_gap_ticks = max(_MAX_GAP_BEFORE_PART_S * rate_hz, 1.0)
    return bool(
        len(earlier_ticks) < len(ticks) and first_tick - earlier_ticks[-1] <= longest_gap_ticks
    )


def part_of_session(
    session: Session,
    requested_part_s: PartOption,
    rate_hz: float,
    *,
    needs_sweep: bool = True,
) -> tuple[Session, tuple[float, float]]:
    """Return the part of a session between two times, and these times.

    Segments are cut at the limits of the part, and segments outside the part are omitted.

    Parameters
    ----------
    session : Session
        Session with at least one sample.
    requested_part_s : tuple of float or None
        Beginning and end of the part in seconds since the session's start; None for the beginning
        or end of the session.
    rate_hz : float
        Sampling rate.
    needs_sweep : bool
        Whether a part that contains nothing of the sweep is an error.

    Returns
    -------
    session : Session
        Session with the samples and segments of the part.
    part_s : tuple of float
        Beginning and end of the part in seconds.

    Raises
    ------
    RecordError
        The part is empty, reaches beyond the record, or contains nothing of the sweep.
    """
    path, ticks = session.path, session.samples["tick"]
    first_s, end_s = int(ticks[0]) / rate_hz, (int(ticks[-1]) + 1) / rate_hz
    from_s, to_s = (
        limit_s if requested is None else requested
        for requested, limit_s in zip(requested_part_s, (first_s, end_s), strict=True)
    )
    tolerance_s = _TICK_TOLERANCE / rate_hz
    if not (first_s - tolerance_s <= from_s < end_s and to_s <= end_s + tolerance_s):
        raise RecordError(
            f"{path}: the part from {from_s:g} to {to_s:g} s reaches beyond the record, which "
            f"covers {first_s:g} to {end_s:g} s; choose --from and --to inside it."
        )
    if not from_s < to_s:
        raise RecordError(
            f"{path}: the part from {from_s:g} to {to_s:g} s is empty; --from must be less than "
            f"--to. The record covers {first_s:g} to {end_s:g} s."
        )
    first_tick, end_tick = (
        math.ceil(time_s * rate_hz - _TICK_TOLERANCE) for time_s in (from_s, to_s)
    )
    part_segments = {
        segment_name: (max(segment_first, first_tick), min(segment_end, end_tick))
        for segment_name, (segment_first, segment_end) in session.segments.items()
        if max(segment_first, first_tick) < min(segment_end, end_tick)
    }
    if needs_sweep and "sweep" in session.segments and "sweep" not in part_segments:
        sweep_limits_s = [tick / rate_hz for tick in session.segments["sweep"]]
        raise RecordError(
            f"{path}: the part from {from_s:g} to {to_s:g} s contains nothing of the sweep, which "
            f"lasts from {sweep_limits_s[0]:g} to {sweep_limits_s[1]:g} s; choose a part that does."
        )
    part_samples = session.samples[slice(*np.searchsorted(ticks, (first_tick, end_tick)))]
    if len(part_samples) == 0:
        raise RecordError(
            f"{path}: no sample was recorded from {from_s:g} to {to_s:g} s; choose another part."
        )
    return replace(session, samples=part_samples, segments=part_segments), (from_s, to_s)


def check_part_length(path: object, part_s: tuple[float, float], beam: Beam) -> None:
    """Raise if a part is too short for an estimate.

    Parameters
    ----------
    path : Path
        File that the message names.
    part_s : tuple of float
        Beginning and end of the part in seconds.
    beam : Beam
        Beam that the file states.

    Raises
    ------
    RecordError
        The part has fewer than ten periods of the beam's first mode.
    """
    min_part_s = _MIN_PART_PERIODS / first_mode_hz(beam)
    if part_s[1] - part_s[0] < min_part_s:
        raise RecordError(
            f"{path}: the part from {part_s[0]:g} to {part_s[1]:g} s is too short for an estimate, "
            f"which needs {_MIN_PART_PERIODS:g} periods of the first mode, {min_part_s:.3g} s; "
            "choose a longer part."
        )


def swept_frequencies_hz(
    session: Session, first_tick: int, end_tick: int
) -> tuple[float, float] | None:
    """Return the lowest and highest frequency that a linear sweep covers between two ticks.

    Return None if the session has no linear sweep there.

    Parameters
    ----------
    session : Session
        Whole session, with the segment of the whole sweep.
    first_tick, end_tick : int
        First tick inside one direction of the sweep, and the tick after the last.
    """
    sweep_ends_hz = linear_sweep_band_hz(session.metadata.get("excitation", ""), session.metadata)
    if sweep_ends_hz is None or "sweep" not in session.segments:
        return None
    swept_hz = [
        sweep_frequency_hz(session.segments, sweep_ends_hz, tick)
        for tick in (first_tick, end_tick - 1)
    ]
    known_hz = [frequency_hz for frequency_hz in swept_hz if frequency_hz is not None]
    return (min(known_hz), max(known_hz)) if len(known_hz) == len(swept_hz) else None
