"""A session file as arrays on a uniform time grid, with what is known of their faults.

The estimators want uniform samples; a session may have missed ticks, held (stale) values or a
sweep that was cut short. What is done about each is decided here, bounded, counted and reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rigd.beam import Beam
from rigd.session import Session, Status, read_session

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

MAX_FILLED_SHARE = 0.01
"""Largest share of the sweep that may be interpolated, in each of angle and torque."""

MAX_GAP_S = 0.1
"""Longest single gap in the sweep that is interpolated; a longer one is refused."""

MAX_SPAN = 10
"""Most ticks per recorded sample: a file with next to no samples in its span would only fill the
memory, and no sweep in it could be analysed."""

MAX_CLOCK_ERROR = 1e-3
"""Largest relative difference between the rate stated and the rate of the time stamps."""

_REPORTED_FLAGS = (
    (Status.TORQUE_SATURATED, "torque command saturated"),
    (Status.WRENCH_SATURATED, "wrench saturated"),
    (Status.ANGLE_STALE, "angle stale"),
    (Status.WRENCH_STALE, "wrench stale"),
    (Status.LIMIT_WARNING, "limit warning"),
    (Status.TORQUE_OFF, "torque off"),
    (Status.LATE, "late tick"),
)

_CONSEQUENCES: tuple[tuple[str, str], ...] = (
    ("wrench saturated", "The torque is clipped there and the estimate is wrong near it."),
    ("torque command saturated", "The angle did not follow its reference there."),
    ("torque off", "The motor was not driven there."),
)


class RecordError(ValueError):
    """A session that was read but cannot be analysed; the message names file, cause and remedy."""


@dataclass(frozen=True, slots=True)
class Gaps:
    """What of the record was filled by linear interpolation.

    Attributes
    ----------
    missing_ticks
        Ticks between the first and the last sample that have no sample.
    longest_gap_ticks
        Length of the longest run of them.
    sweep_missing_ticks
        Those of them inside the sweep.
    sweep_stale_angles, sweep_stale_torques
        Recorded samples of the sweep whose value was flagged as held from an earlier tick.
    """

    missing_ticks: int
    longest_gap_ticks: int
    sweep_missing_ticks: int
    sweep_stale_angles: int
    sweep_stale_torques: int


@dataclass(frozen=True, slots=True)
class Record:
    """One session on a uniform time grid.

    Attributes
    ----------
    path
        The file.
    time_s
        (n,) scheduled time of each tick since the session's start.
    reference_rad, angle_rad
        (n,) angle asked for and angle measured at the output shaft.
    torque_nm
        (n,) coupling torque, positive when the motor pushes the beam.
    angle_known, torque_known
        (n,) whether the value was measured at that very tick, and within the sensor's range.
    rate_hz
        Ticks per second.
    beam
        The specimen as the file states it.
    angle_delay_s, torque_delay_s
        Age of either value at its time stamp.
    tool_inertia_kg_m2
        Inertia between torque sensor and beam.
    sweep
        Range of samples with the excitation.
    rest_angle_rad
        Angle held before the sweep, None if the file has no segment ``rest``.
    gaps
        What was interpolated.
    flags
        Count of flagged samples in the sweep, by the flag's meaning, only those that occur.
    warnings
        Sentences an analyst should read beside the results.
    metadata
        Metadata `session` of the file, as strings.
    outcome
        How the session ended: ``complete``, ``stopped``, ``fault`` or ``unknown``.
    """

    path: Path
    time_s: NDArray[np.float64]
    reference_rad: NDArray[np.float64]
    angle_rad: NDArray[np.float64]
    torque_nm: NDArray[np.float64]
    angle_known: NDArray[np.bool_]
    torque_known: NDArray[np.bool_]
    rate_hz: float
    beam: Beam
    angle_delay_s: float
    torque_delay_s: float
    tool_inertia_kg_m2: float
    sweep: slice
    rest_angle_rad: float | None
    gaps: Gaps
    flags: Mapping[str, int]
    warnings: tuple[str, ...]
    metadata: Mapping[str, str]
    outcome: str

    @property
    def sweep_samples(self) -> int:
        """Number of samples in the sweep."""
        return int(self.sweep.stop - self.sweep.start)


def load_record(path: Path) -> Record:
    """Read a session file and put it on a uniform time grid.

    Missing ticks, and values flagged as stale, are replaced by linear interpolation between their
    fresh neighbours, up to `MAX_FILLED_SHARE` of the sweep and `MAX_GAP_S` at a time; the counts
    are in the result. Without segments the whole record is the sweep, and a sweep that was
    stopped is cut to what was recorded.

    Parameters
    ----------
    path
        A session file (docs/session_format.md).

    Raises
    ------
    rigd.session.SessionError
        The file is missing, unreadable, foreign, or lacks a required key.
    RecordError
        It was read, but its samples cannot be analysed.
    """
    session = read_session(path)
    samples = session.samples
    if len(samples) == 0:
        raise RecordError(f"{path}: the session holds no samples, so there is nothing to analyse.")
    rate_hz = _positive(session, "rate_hz", "Hz")
    ticks = samples["tick"].astype(np.int64)
    _check_span(path, ticks)
    _check_clock(path, ticks, samples["t_ns"], rate_hz)
    for field in ("angle_reference_rad", "angle_rad", "coupling_torque_nm"):
        _check_finite(path, field, samples[field], ticks)

    first_tick = int(ticks[0])
    index = ticks - first_tick
    length = int(index[-1]) + 1
    sweep, cut = _sweep(session, first_tick, length)
    status = np.zeros(length, dtype=np.uint32)  # bits of `Status`; 0 where a tick is missing
    status[index] = samples["status"]
    missing = np.ones(length, dtype=bool)
    missing[index] = False
    stale_angle = (status & Status.ANGLE_STALE) != 0
    stale_torque = (status & Status.WRENCH_STALE) != 0
    for channel, unknown in (
        ("angle", missing | stale_angle),
        ("torque", missing | stale_torque),
    ):
        _check_fillable(path, channel, unknown[sweep], first_tick + sweep.start, rate_hz)

    gaps = Gaps(
        missing_ticks=int(missing.sum()),
        longest_gap_ticks=_longest_run(missing)[0],
        sweep_missing_ticks=int(missing[sweep].sum()),
        sweep_stale_angles=int(stale_angle[sweep].sum()),
        sweep_stale_torques=int(stale_torque[sweep].sum()),
    )
    flags = _flag_counts(status[sweep])
    outcome = session.outcome or {}
    return Record(
        path=path,
        time_s=(first_tick + np.arange(length)) / rate_hz,
        reference_rad=_filled(samples["angle_reference_rad"], index, missing),
        angle_rad=_filled(samples["angle_rad"], index, missing | stale_angle),
        torque_nm=_filled(samples["coupling_torque_nm"], index, missing | stale_torque),
        angle_known=~(missing | stale_angle),
        torque_known=~(missing | stale_torque | ((status & Status.WRENCH_SATURATED) != 0)),
        rate_hz=rate_hz,
        beam=_beam(session),
        angle_delay_s=session.number("angle_delay_s", 0.0),
        torque_delay_s=session.number("torque_delay_s", 0.0),
        tool_inertia_kg_m2=_tool_inertia(session),
        sweep=sweep,
        rest_angle_rad=_rest_angle(session, ticks),
        gaps=gaps,
        flags=flags,
        warnings=_warnings(gaps, flags, cut, outcome, rate_hz, sweep),
        metadata=session.metadata,
        outcome=outcome.get("outcome", "unknown"),
    )


def _positive(session: Session, key: str, unit: str) -> float:
    value = session.number(key)
    if not value > 0.0:
        raise RecordError(
            f"{session.path}: {key} is {value:g} {unit}, but must be positive; "
            "correct the file's metadata."
        )
    return value


def _beam(session: Session) -> Beam:
    return Beam(
        length_m=_positive(session, "beam_length_m", "m"),
        density_kg_per_m=_positive(session, "beam_density_kg_per_m", "kg/m"),
        bending_stiffness_n_m2=_positive(session, "beam_bending_stiffness_n_m2", "N·m²"),
    )


def _tool_inertia(session: Session) -> float:
    inertia_kg_m2 = session.number("tool_inertia_kg_m2", 0.0)
    if inertia_kg_m2 < 0.0:
        raise RecordError(
            f"{session.path}: tool_inertia_kg_m2 is {inertia_kg_m2:g} kg·m², but an inertia cannot "
            "be negative; correct the file's metadata."
        )
    return inertia_kg_m2


def _check_span(path: Path, ticks: NDArray[np.int64]) -> None:
    """Refuse a span of ticks that is all but empty."""
    span = int(ticks[-1] - ticks[0]) + 1
    if span > MAX_SPAN * len(ticks):
        raise RecordError(
            f"{path}: only {len(ticks)} of the {span} ticks from {ticks[0]} to {ticks[-1]} have a "
            "sample, too few to analyse; record the session again."
        )


def _check_clock(
    path: Path, ticks: NDArray[np.int64], t_ns: NDArray[np.int64], rate_hz: float
) -> None:
    """Refuse time stamps that contradict the rate."""
    if len(ticks) < 2:
        return
    elapsed_ns = max(int(t_ns[-1]) - int(t_ns[0]), 1)
    rate_of_stamps_hz = 1e9 * int(ticks[-1] - ticks[0]) / elapsed_ns
    if abs(rate_of_stamps_hz / rate_hz - 1.0) > MAX_CLOCK_ERROR:
        raise RecordError(
            f"{path}: rate_hz is {rate_hz:g} Hz, but the time stamps t_ns advance at "
            f"{rate_of_stamps_hz:g} ticks per second; correct whichever is wrong."
        )


def _check_finite(
    path: Path, field: str, values: NDArray[np.float64], ticks: NDArray[np.int64]
) -> None:
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise RecordError(
            f"{path}: {field} is {values[bad[0]]} at tick {ticks[bad[0]]} and not finite in "
            f"{bad.size} of {len(values)} samples; no estimate is made from such a record."
        )


def _sweep(session: Session, first_tick: int, length: int) -> tuple[slice, int]:
    """Find the samples of the sweep, and how many of its ticks were not recorded."""
    if "sweep" not in session.segments:
        return slice(0, length), 0
    first, end = session.segments["sweep"]
    start = max(first - first_tick, 0)
    stop = min(end - first_tick, length)
    if stop <= start:
        raise RecordError(
            f"{session.path}: segment 'sweep' covers ticks {first} to {end - 1}, but the record "
            f"holds ticks {first_tick} to {first_tick + length - 1}, so nothing of the sweep was "
            "recorded."
        )
    return slice(start, stop), (end - first) - (stop - start)


def _rest_angle(session: Session, ticks: NDArray[np.int64]) -> float | None:
    """Median of the angle over the segment ``rest``, None without one."""
    first, end = session.segments.get("rest", (0, 0))
    at_rest = (ticks >= first) & (ticks < end)
    return float(np.median(session.samples["angle_rad"][at_rest])) if at_rest.any() else None


def _longest_run(mask: NDArray[np.bool_]) -> tuple[int, int]:
    """Length and start of the longest run of True, (0, 0) without any."""
    edges = np.diff(np.concatenate(([0], mask.astype(np.int8), [0])))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    if starts.size == 0:
        return 0, 0
    longest = int(np.argmax(ends - starts))
    return int(ends[longest] - starts[longest]), int(starts[longest])


def _flag_counts(status: NDArray[np.uint32]) -> dict[str, int]:
    counts = {meaning: int(np.count_nonzero(status & flag)) for flag, meaning in _REPORTED_FLAGS}
    return {meaning: count for meaning, count in counts.items() if count}


def _check_fillable(
    path: Path, channel: str, unknown: NDArray[np.bool_], first_tick: int, rate_hz: float
) -> None:
    count = int(unknown.sum())
    share = count / len(unknown)
    if share > MAX_FILLED_SHARE:
        raise RecordError(
            f"{path}: {count} of {len(unknown)} samples ({100 * share:.2g} %) of the {channel} in "
            f"the sweep are missing or stale, more than the {100 * MAX_FILLED_SHARE:g} % that are "
            "interpolated; record the session again."
        )
    run, start = _longest_run(unknown)
    if run > MAX_GAP_S * rate_hz:
        raise RecordError(
            f"{path}: {run} ticks of the {channel} in a row are missing or stale from tick "
            f"{first_tick + start} on ({1e3 * run / rate_hz:.0f} ms), longer than the "
            f"{1e3 * MAX_GAP_S:g} ms that are interpolated; record the session again."
        )


def _filled(
    values: NDArray[np.float64], index: NDArray[np.int64], unknown: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Values on the whole grid, those unknown by linear interpolation (held at the ends)."""
    full = np.zeros(len(unknown))
    full[index] = values
    if unknown.any() and not unknown.all():
        known = np.flatnonzero(~unknown)
        full[unknown] = np.interp(np.flatnonzero(unknown), known, full[known])
    return full


def _warnings(
    gaps: Gaps,
    flags: Mapping[str, int],
    cut: int,
    outcome: Mapping[str, str],
    rate_hz: float,
    sweep: slice,
) -> tuple[str, ...]:
    found = []
    ending = outcome.get("outcome", "unknown")
    if ending in ("stopped", "fault"):
        reason = outcome.get("reason")
        found.append(
            f"The session's outcome is '{ending}', not 'complete'"
            + (f": {reason}" if reason else ".")
        )
    elif "recovered_from" in outcome:
        found.append(
            f"The file was recovered from {outcome['recovered_from']}, without loss of samples."
        )
    if outcome.get("recovered_protected") == "false":
        found.append(
            "The file was recovered from one whose metadata no checksum covered: compare rate, "
            "beam and segments with what is known of the session."
        )
    if cut:
        recorded_s = (sweep.stop - sweep.start) / rate_hz
        found.append(
            f"The sweep was cut short: {recorded_s:.6g} s of it were recorded, "
            f"{cut / rate_hz:.6g} s were not."
        )
    if gaps.sweep_missing_ticks:
        found.append(
            f"{gaps.sweep_missing_ticks} missing ticks in the sweep were interpolated linearly "
            f"(longest gap of the record {gaps.longest_gap_ticks} ticks)."
        )
    for channel, count in (
        ("angle", gaps.sweep_stale_angles),
        ("torque", gaps.sweep_stale_torques),
    ):
        if count:
            found.append(f"{count} stale values of the {channel} were interpolated linearly.")
    for flag, consequence in _CONSEQUENCES:
        if flag in flags:
            found.append(f"{flags[flag]} samples of the sweep: {flag}. {consequence}")
    return tuple(found)
