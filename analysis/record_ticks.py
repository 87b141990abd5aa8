"""Grid of a session's ticks (missing and stale samples, flags, sweep), and signals on this grid.

The grid needs no signals, so that a long record can be checked before its signals are read.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.record_checks import (
    RecordError,
    check_clock,
    check_fillable,
    check_finite,
    check_sensor,
    check_span,
    longest_run,
)
from rigd.session.layout import Status

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from rigd.session import Session

SIGNAL_FIELDS = ("angle_reference_rad", "angle_rad", "coupling_torque_nm")
"""Fields of a sample that are filtered, in the order of the rows of a record's signal values."""

_REPORTED_FLAGS = (
    (Status.TORQUE_SATURATED, "torque command saturated"),
    (Status.WRENCH_SATURATED, "wrench saturated"),
    (Status.ANGLE_STALE, "angle stale"),
    (Status.WRENCH_STALE, "wrench stale"),
    (Status.LIMIT_WARNING, "limit warning"),
    (Status.TORQUE_OFF, "torque off"),
    (Status.LATE, "late tick"),
)
"""Flags of a sample that are counted, with their meanings."""

_UNKNOWN_SAMPLES_TEXT = (
    "do not count in the whole-record fits; for the Welch fits they are interpolated."
)
"""End of the sentence on missing or stale samples."""

_FLAG_CONSEQUENCES: tuple[tuple[str, str], ...] = (
    ("wrench saturated", "The torque is clipped there and the estimate is wrong near it."),
    ("torque command saturated", "The angle did not follow its reference there."),
    ("torque off", "The motor was not driven there."),
)
"""Consequence for the analysis of each flag that causes a warning."""


@dataclass(frozen=True, slots=True)
class Gaps:
    """Counts of the samples that were filled by linear interpolation.

    Attributes
    ----------
    missing_ticks
        Ticks between the first and the last sample that have no sample.
    longest_gap_ticks
        Number of ticks in the longest gap.
    sweep_missing_ticks
        Missing ticks inside the sweep.
    sweep_stale_angles, sweep_stale_torques
        Recorded samples of the sweep whose angle or torque is flagged as a repeated older value.
    """

    missing_ticks: int
    longest_gap_ticks: int
    sweep_missing_ticks: int
    sweep_stale_angles: int
    sweep_stale_torques: int


@dataclass(frozen=True, slots=True)
class TickGrid:
    """All ticks from the first to the last sample of a session or of a part of it.

    Attributes
    ----------
    session : Session
        Session or part of it, without its samples.
    rate_hz : float
        Ticks per second.
    first_tick : int
        Number of the first tick.
    tick_count : int
        Number of ticks.
    status_bits : ndarray of uint16, shape (tick_count,)
        Bits of `Status`; 0 where a tick is missing.
    is_missing : ndarray of bool, shape (tick_count,)
        Whether a tick has no sample.
    sweep : slice
        Ticks of the segment ``sweep``, relative to the first tick; all ticks without this segment.
    unrecorded_ticks : int
        Number of ticks of the sweep before the first and after the last sample.
    """

    session: Session
    rate_hz: float
    first_tick: int
    tick_count: int
    status_bits: NDArray[np.uint16]
    is_missing: NDArray[np.bool_]
    sweep: slice
    unrecorded_ticks: int

    @classmethod
    def from_session(cls, session: Session, rate_hz: float) -> TickGrid:
        """Return the grid of a session, after checks of its ticks, times and gaps.

        Parameters
        ----------
        session : Session
            Session or part; its samples need tick, time and status.
        rate_hz : float
            Sampling rate.

        Raises
        ------
        RecordError
            The ticks or the time stamps cannot be used, or too many samples are missing.
        """
        path, samples = session.path, session.samples
        ticks = samples["tick"]
        check_span(path, ticks)
        check_clock(path, ticks, samples["t_ns"], rate_hz)
        first_tick = int(ticks[0])
        tick_indices = ticks - ticks[0]
        tick_count = int(tick_indices[-1]) + 1
        sweep, unrecorded_ticks = _sweep_range(session, first_tick, tick_count)
        # A long record has many ticks: no flag needs more than 16 bits, and the samples are let go.
        status_bits = np.zeros(tick_count, dtype=np.uint16)
        status_bits[tick_indices] = samples["status"]
        is_missing = np.ones(tick_count, dtype=bool)
        is_missing[tick_indices] = False
        grid = cls(
            replace(session, samples=samples[:0].copy()), rate_hz, first_tick, tick_count,
            status_bits, is_missing, sweep, unrecorded_ticks,
        )  # fmt: skip
        for channel_name, is_unknown in (
            ("angle", grid.is_angle_unknown),
            ("torque", grid.is_torque_unknown),
        ):
            check_fillable(path, channel_name, is_unknown[sweep], first_tick + sweep.start, rate_hz)
        return grid

    @property
    def is_angle_unknown(self) -> NDArray[np.bool_]:
        """Whether the angle of each tick is missing or stale, shape (tick_count,)."""
        return self.is_missing | self._has_flag(Status.ANGLE_STALE)

    @property
    def is_torque_unknown(self) -> NDArray[np.bool_]:
        """Whether the torque of each tick is missing or stale, shape (tick_count,)."""
        return self.is_missing | self._has_flag(Status.WRENCH_STALE)

    @property
    def is_torque_measured(self) -> NDArray[np.bool_]:
        """Whether the torque was measured at its tick and within the range, shape (tick_count,)."""
        return ~(self.is_torque_unknown | self._has_flag(Status.WRENCH_SATURATED))

    def _has_flag(self, flag: Status) -> NDArray[np.bool_]:
        """Return whether each tick has a flag, shape (tick_count,)."""
        is_flagged: NDArray[np.bool_] = (self.status_bits & flag) != 0
        return is_flagged

    @property
    def outward_sweep(self) -> slice | None:
        """Ticks of the first of two sweeps; None if there is only one sweep."""
        segment_first_tick, segment_end_tick = self.session.segments.get("there", (0, 0))
        first_index, end_index = (
            max(segment_first_tick - self.first_tick, self.sweep.start),
            min(segment_end_tick - self.first_tick, self.sweep.stop),
        )
        return slice(first_index, end_index) if end_index > first_index else None

    def gaps(self) -> Gaps:
        """Return the counts of missing and stale samples."""
        return Gaps(
            missing_ticks=int(self.is_missing.sum()),
            longest_gap_ticks=longest_run(self.is_missing)[0],
            sweep_missing_ticks=int(self.is_missing[self.sweep].sum()),
            sweep_stale_angles=int(self._has_flag(Status.ANGLE_STALE)[self.sweep].sum()),
            sweep_stale_torques=int(self._has_flag(Status.WRENCH_STALE)[self.sweep].sum()),
        )

    def flag_counts(self) -> dict[str, int]:
        """Return the number of samples of the sweep with each flag that occurs there."""
        sample_count_by_meaning = {
            meaning: int(np.count_nonzero(self.status_bits[self.sweep] & status_flag))
            for status_flag, meaning in _REPORTED_FLAGS
        }
        return {
            meaning: sample_count
            for meaning, sample_count in sample_count_by_meaning.items()
            if sample_count
        }

    def fault_sentences(self, outcome: Mapping[str, str]) -> tuple[str, ...]:
        """Return sentences on an incomplete session, missing samples and flags.

        Parameters
        ----------
        outcome : mapping of str to str
            Metadata record ``outcome`` of the file, which states how the session ended.
        """
        return _describe_faults(
            self.gaps(), self.flag_counts(), self.unrecorded_ticks, outcome, self.rate_hz,
            self.sweep,
        )  # fmt: skip


def _sweep_range(session: Session, first_tick: int, tick_count: int) -> tuple[slice, int]:
    """Return the sweep's range of ticks, and the number of its ticks outside the record."""
    if "sweep" not in session.segments:
        return slice(0, tick_count), 0
    first_sweep_tick, end_sweep_tick = session.segments["sweep"]
    first_index = max(first_sweep_tick - first_tick, 0)
    end_index = min(end_sweep_tick - first_tick, tick_count)
    if end_index <= first_index:
        raise RecordError(
            f"{session.path}: segment 'sweep' covers ticks {first_sweep_tick} to "
            f"{end_sweep_tick - 1}, but the record "
            f"holds ticks {first_tick} to {first_tick + tick_count - 1}, so nothing of the sweep "
            "was recorded."
        )
    return slice(first_index, end_index), (end_sweep_tick - first_sweep_tick) - (
        end_index - first_index
    )


def _describe_faults(
    gaps: Gaps,
    flag_counts: Mapping[str, int],
    unrecorded_ticks: int,
    outcome: Mapping[str, str],
    rate_hz: float,
    sweep: slice,
) -> tuple[str, ...]:
    """Return sentences on an incomplete session, missing samples and flags."""
    sentences = []
    outcome_text = outcome.get("outcome", "unknown")
    if outcome_text in ("stopped", "fault"):
        stop_reason = outcome.get("reason")
        sentences.append(
            f"The session's outcome is '{outcome_text}', not 'complete'"
            + (f": {stop_reason}" if stop_reason else ".")
        )
    elif "recovered_from" in outcome:
        sentences.append(
            f"The file was recovered from {outcome['recovered_from']}, without loss of samples."
        )
    if outcome.get("recovered_protected") == "false":
        sentences.append(
            "The file was recovered from one whose metadata no checksum covered: compare rate, "
            "beam and segments with what is known of the session."
        )
    if unrecorded_ticks:
        recorded_s = (sweep.stop - sweep.start) / rate_hz
        sentences.append(
            f"The sweep was cut short: {recorded_s:.6g} s of it were recorded, "
            f"{unrecorded_ticks / rate_hz:.6g} s were not."
        )
    if gaps.sweep_missing_ticks:
        sentences.append(
            f"{gaps.sweep_missing_ticks} missing ticks in the sweep (longest gap of the record "
            f"{gaps.longest_gap_ticks} ticks) {_UNKNOWN_SAMPLES_TEXT}"
        )
    for channel_name, sample_count in (
        ("angle", gaps.sweep_stale_angles),
        ("torque", gaps.sweep_stale_torques),
    ):
        if sample_count:
            sentences.append(
                f"{sample_count} stale values of the {channel_name} {_UNKNOWN_SAMPLES_TEXT}"
            )
    for flag_name, flag_consequence in _FLAG_CONSEQUENCES:
        if flag_name in flag_counts:
            sentences.append(
                f"{flag_counts[flag_name]} samples of the sweep: {flag_name}. {flag_consequence}"
            )
    return tuple(sentences)


# Signals

_COUNTED_LEVELS: Final = 3
"""Number of different values, the outermost of a torque, that are counted: the extreme, and two
with which clipping is distinguished from a coarse resolution."""


@dataclass(frozen=True, slots=True)
class TorqueExtreme:
    """Largest or smallest measured torque, and how often it was measured.

    Attributes
    ----------
    limit_nm : float
        Torque.
    sample_count : int
        Number of samples with exactly this torque.
    repeated_count : int
        Number of these samples whose neighbour also has this torque.
    inner_counts : tuple of int
        Numbers of samples with exactly the next torque further inside, and with the one after it;
        0 if there is no such torque.
    """

    limit_nm: float
    sample_count: int
    repeated_count: int
    inner_counts: tuple[int, int]


class ExtremeCount:
    """Counter of the samples at the maximum (or minimum) of a torque that arrives in blocks.

    NaN marks an unknown torque.

    Parameters
    ----------
    sign_of_extreme : int
        1 for the largest value, -1 for the smallest.
    """

    def __init__(self, sign_of_extreme: int) -> None:
        self._sign = sign_of_extreme
        self._counts_by_level: dict[float, int] = {}  # levels in descending order
        self._repeated = 0
        self._last_nm = np.full(2, np.nan)

    def add(self, torque_nm: NDArray[np.float64]) -> None:
        """Include the next values."""
        signed_torque_nm = np.concatenate([self._last_nm, self._sign * torque_nm])
        new_torque_nm = signed_torque_nm[2:]
        self._last_nm = signed_torque_nm[-2:]
        is_known = ~np.isnan(new_torque_nm)
        if not is_known.any():
            return
        former_limit_nm = next(iter(self._counts_by_level), -np.inf)
        self._count_levels(new_torque_nm[is_known])
        limit_nm = next(iter(self._counts_by_level))
        if limit_nm > former_limit_nm:
            self._repeated = 0
        is_at_limit = signed_torque_nm == limit_nm
        follows_limit_sample = is_at_limit[2:] & is_at_limit[1:-1]
        # The first of a run of such values counts when the second arrives.
        self._repeated += int(np.count_nonzero(follows_limit_sample))
        self._repeated += int(np.count_nonzero(follows_limit_sample & ~is_at_limit[:-2]))

    def _count_levels(self, torque_nm: NDArray[np.float64]) -> None:
        """Add the numbers of known values at the outermost levels."""
        counts_by_level = dict(self._counts_by_level)
        upper_end_nm = np.inf
        for _ in range(_COUNTED_LEVELS):
            level_nm = float(np.max(torque_nm, initial=-np.inf, where=torque_nm < upper_end_nm))
            if level_nm == -np.inf:
                break
            value_count = int(np.count_nonzero(torque_nm == level_nm))
            counts_by_level[level_nm] = counts_by_level.get(level_nm, 0) + value_count
            upper_end_nm = level_nm
        levels_nm = sorted(counts_by_level, reverse=True)[:_COUNTED_LEVELS]
        self._counts_by_level = {level_nm: counts_by_level[level_nm] for level_nm in levels_nm}

    def torque_extreme(self) -> TorqueExtreme:
        """Return the extreme of all values."""
        limit_nm = next(iter(self._counts_by_level), -np.inf)
        limit_count, *inner_counts = (*self._counts_by_level.values(), 0, 0, 0)[:_COUNTED_LEVELS]
        return TorqueExtreme(
            self._sign * limit_nm, limit_count, self._repeated, (inner_counts[0], inner_counts[1])
        )


def torque_extremes(torque_nm: NDArray[np.float64]) -> tuple[TorqueExtreme, ...]:
    """Return the largest and the smallest value of a torque in N·m; NaN is unknown."""
    extreme_counts = (ExtremeCount(1), ExtremeCount(-1))
    for extreme_count in extreme_counts:
        extreme_count.add(torque_nm)
    return tuple(extreme_count.torque_extreme() for extreme_count in extreme_counts)


@dataclass(frozen=True, slots=True)
class RecordSignals:
    """Signals of a record, with masks of their known values.

    Attributes
    ----------
    signal_values : ndarray, shape (3, n)
        Reference and measured angle in rad, and coupling torque in N·m.
    angle_known, torque_known : ndarray of bool, shape (n,)
        Whether angle and torque were measured at all ticks on which a sample depends.
    first_tick : int
        Tick of the first sample, relative to the first tick of the record.
    ticks_per_sample : int
        Number of ticks from one sample to the next.
    torque_extremes : tuple of TorqueExtreme
        Largest and smallest measured torque before the signals were decimated; empty if they were
        not.
    """

    signal_values: NDArray[np.float64]
    angle_known: NDArray[np.bool_]
    torque_known: NDArray[np.bool_]
    first_tick: int = 0
    ticks_per_sample: int = 1
    torque_extremes: tuple[TorqueExtreme, ...] = ()

    def samples_in(self, ticks: slice) -> slice:
        """Return the range of the samples inside a range of ticks of the record.

        Parameters
        ----------
        ticks : slice
            First tick, and the tick after the last, relative to the first tick of the record.
        """
        start, stop = (
            min(
                max(-((self.first_tick - tick) // self.ticks_per_sample), 0),
                self.signal_values.shape[1],
            )
            for tick in (ticks.start, ticks.stop)
        )
        return slice(start, stop)


class FullRateSignals:
    """Signals of a record at its full rate, with linear interpolation of unknown values.

    Parameters
    ----------
    grid : TickGrid
        Ticks of the record.
    """

    def __init__(self, grid: TickGrid) -> None:
        self.grid = grid
        self._values = np.zeros((len(SIGNAL_FIELDS), grid.tick_count))

    def add(self, samples: NDArray[np.void]) -> None:
        """Include samples of the record, as for `SignalDecimation`."""
        samples, ticks = samples_on_grid(self.grid, samples)
        for row, field_name in enumerate(SIGNAL_FIELDS):
            check_finite(self.grid.session.path, field_name, samples[field_name], samples["tick"])
            self._values[row, ticks] = samples[field_name]

    def finish(self) -> RecordSignals:
        """Return the signals after the last sample was added.

        Raises
        ------
        RecordError
            The torque is constant.
        """
        grid, is_missing = self.grid, self.grid.is_missing
        check_sensor(grid.session.path, self._values[2, ~is_missing])
        is_angle_unknown = grid.is_angle_unknown
        for row, is_unknown in enumerate((is_missing, is_angle_unknown, grid.is_torque_unknown)):
            if is_unknown.any() and not is_unknown.all():
                known_indices = np.flatnonzero(~is_unknown)
                self._values[row, is_unknown] = np.interp(
                    np.flatnonzero(is_unknown), known_indices, self._values[row, known_indices]
                )
        return RecordSignals(self._values, ~is_angle_unknown, grid.is_torque_measured)


def samples_on_grid(
    grid: TickGrid, samples: NDArray[np.void]
) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    """Return the samples whose ticks are on a grid, and their ticks relative to its first tick.

    Parameters
    ----------
    grid : TickGrid
        Ticks of the record.
    samples : ndarray of `rigd.session.layout.SAMPLE_DTYPE`, shape (n,)
        Samples in the order of their ticks.
    """
    ticks = samples["tick"].astype(np.int64) - grid.first_tick
    is_inside = (ticks >= 0) & (ticks < grid.tick_count)
    return (samples, ticks) if is_inside.all() else (samples[is_inside], ticks[is_inside])
