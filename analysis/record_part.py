"""Part of a session that is analysed instead of the whole: its samples and segments."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.record_checks import RecordError, first_mode_hz
from rigd.session import linear_sweep_band_hz, sweep_frequency_hz

if TYPE_CHECKING:
    from rigd.beam import Beam
    from rigd.session import Session

PartOption = tuple[float | None, float | None]
"""Requested part of a session, from and to a time in seconds; None for its beginning or end."""

_MIN_PART_PERIODS: Final = 10.0
"""Minimum length of a part, in periods of the first mode. The beam may ring at the beginning of a
part, and a shorter part does not distinguish this ringing from the response to the motor."""

_TICK_TOLERANCE: Final = 1e-3
"""Tolerance in ticks for the rounding of a time that is stated in seconds."""


def part_of_session(
    session: Session, requested_part_s: PartOption, rate_hz: float
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
    if "sweep" in session.segments and "sweep" not in part_segments:
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
