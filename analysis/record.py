"""Session file as arrays on a uniform time grid, with a report of missing and stale samples.

The estimators need uniform samples, but a session may have missing ticks, held (stale) values or an
incomplete sweep. This module interpolates such samples within limits, counts and reports them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.record_checks import (
    MAX_GAP_S,
    MAX_TICKS,
    MAX_UNKNOWN_FRACTION,
    RecordError,
    check_clock,
    check_fillable,
    check_finite,
    check_sensor,
    check_span,
    longest_run,
    stated_axis_tilt_deg,
    stated_beam,
    stated_delay_s,
    stated_rate_hz,
    stated_tip_mass_kg,
    stated_tool_inertia_kg_m2,
    stated_torque_filter_s,
    stated_uncertainty,
    stated_uniformity,
)
from rigd.session import Session, read_session, readable_texts
from rigd.session.layout import Status

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from rigd.beam import Beam

__all__ = [
    "MAX_GAP_S",
    "MAX_SAMPLES",
    "MAX_UNKNOWN_FRACTION",
    "RECORD_FIELDS",
    "Gaps",
    "Record",
    "RecordError",
    "load_record",
    "record_of",
]

MAX_SAMPLES = MAX_TICKS
"""Largest number of samples of a session that are read."""

RECORD_FIELDS = ("t_ns", "tick", "angle_reference_rad", "angle_rad", "coupling_torque_nm", "status")
"""Fields of the samples that an analysis needs."""

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
        Recorded samples of the sweep whose angle or torque is flagged as held from an earlier tick.
    """

    missing_ticks: int
    longest_gap_ticks: int
    sweep_missing_ticks: int
    sweep_stale_angles: int
    sweep_stale_torques: int


@dataclass(frozen=True, slots=True)
class Record:
    """Record of one session on a uniform time grid.

    Attributes
    ----------
    path
        Session file.
    time_s
        Scheduled time of each tick since the session's start, shape (n,).
    reference_rad, angle_rad
        Requested angle, and angle measured at the output shaft, shape (n,).
    torque_nm
        Coupling torque, positive when the motor pushes the beam, shape (n,).
    angle_known, torque_known
        Whether the value was measured at its tick, and within the sensor's range, shape (n,).
    rate_hz
        Ticks per second.
    beam
        Beam stated in the file.
    angle_delay_s, torque_delay_s
        Age of angle and torque at their time stamps.
    tool_inertia_kg_m2
        Inertia between torque sensor and beam.
    torque_filter_s
        Time constants of the torque channel's first- and second-order low-pass filter.
    uncertainty
        Relative standard uncertainties stated in the file, by quantity
        (`record_checks.UNCERTAIN_QUANTITIES`).
    uniformity
        Relative standard deviation of mode frequencies from those of a uniform beam; 0.001 if not
        stated.
    tip_mass_kg
        Point mass at the beam's tip; None if not stated.
    axis_tilt_deg
        Inclination of the plane of motion along the beam at rest, positive if the tip is lower than
        the motor's axis; None if not stated.
    sweep
        Range of samples with the excitation.
    there
        Range of samples of the first sweep of a chirp there and back; None if there is one sweep.
    rest_angle_rad
        Angle held before the sweep; None if the file has no segment ``rest``.
    gaps
        Counts of interpolated samples.
    flags
        Number of flagged samples in the sweep by the flag's meaning, for flags that occur.
    warnings
        Warnings for the analyst, in sentences.
    metadata
        Metadata `session` of the file, as strings.
    outcome
        End of the session: ``complete``, ``stopped``, ``fault`` or ``unknown``.
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
    torque_filter_s: tuple[float, float]
    uncertainty: Mapping[str, float]
    uniformity: float
    tip_mass_kg: float | None
    axis_tilt_deg: float | None
    sweep: slice
    there: slice | None
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

    @property
    def first_sweep(self) -> slice:
        """Range of samples for Welch's method: the single sweep, or the first of two sweeps."""
        return self.sweep if self.there is None else self.there

    @property
    def first_sweep_samples(self) -> int:
        """Number of samples in the first sweep."""
        return int(self.first_sweep.stop - self.first_sweep.start)


def load_record(path: Path) -> Record:
    """Read a session file and return its record on a uniform time grid.

    Missing ticks, and values flagged as stale, are replaced by linear interpolation between their
    known neighbours, up to `MAX_UNKNOWN_FRACTION` of the sweep and gaps of `MAX_GAP_S`. The result
    has their counts and masks. Without segments, the whole record is the sweep. A sweep that was
    stopped ends with the recorded samples.

    Parameters
    ----------
    path
        Session file (docs/session_format.md).

    Raises
    ------
    rigd.session.SessionError
        The file is missing, unreadable, of another format, or lacks a required key.
    RecordError
        The file was read, but its samples cannot be analysed.

    Examples
    --------
    >>> from pathlib import Path
    >>> from analysis.record import load_record
    >>> record = load_record(Path("session.mcap"))
    >>> print(record.sweep_samples, record.gaps.missing_ticks)
    20000 0
    """
    return record_of(read_session(path, fields=RECORD_FIELDS, max_samples=MAX_SAMPLES))


def record_of(session: Session) -> Record:
    """Return the record of a session on a uniform time grid (see `load_record`).

    Parameters
    ----------
    session
        Session from a file, or a running one so far. Its samples need the `RECORD_FIELDS`.

    Raises
    ------
    rigd.session.SessionError
        The metadata lack a required key.
    RecordError
        The samples cannot be analysed.
    """
    path, samples = session.path, session.samples
    if len(samples) == 0:
        raise RecordError(f"{path}: the session holds no samples, so there is nothing to analyse.")
    rate_hz = stated_rate_hz(session)
    ticks = samples["tick"].astype(np.int64)
    check_span(path, ticks)
    check_clock(path, ticks, samples["t_ns"], rate_hz)
    for field_name in ("angle_reference_rad", "angle_rad", "coupling_torque_nm"):
        check_finite(path, field_name, samples[field_name], ticks)
    check_sensor(path, samples["coupling_torque_nm"])

    first_tick = int(ticks[0])
    tick_indices = ticks - first_tick
    tick_count = int(tick_indices[-1]) + 1
    sweep, unrecorded_ticks = _sweep_range(session, first_tick, tick_count)
    status_bits = np.zeros(
        tick_count, dtype=np.uint32
    )  # bits of `Status`; 0 where a tick is missing
    status_bits[tick_indices] = samples["status"]
    is_missing = np.ones(tick_count, dtype=bool)
    is_missing[tick_indices] = False
    is_angle_stale = (status_bits & Status.ANGLE_STALE) != 0
    is_torque_stale = (status_bits & Status.WRENCH_STALE) != 0
    for channel_name, is_unknown in (
        ("angle", is_missing | is_angle_stale),
        ("torque", is_missing | is_torque_stale),
    ):
        check_fillable(path, channel_name, is_unknown[sweep], first_tick + sweep.start, rate_hz)

    gaps = Gaps(
        missing_ticks=int(is_missing.sum()),
        longest_gap_ticks=longest_run(is_missing)[0],
        sweep_missing_ticks=int(is_missing[sweep].sum()),
        sweep_stale_angles=int(is_angle_stale[sweep].sum()),
        sweep_stale_torques=int(is_torque_stale[sweep].sum()),
    )
    flag_counts = _flag_counts(status_bits[sweep])
    metadata, unread_metadata = readable_texts(session.metadata, "keys of the metadata")
    outcome, unread_outcome = readable_texts(session.outcome or {}, "keys of the outcome")
    return Record(
        path=path,
        time_s=(first_tick + np.arange(tick_count)) / rate_hz,
        reference_rad=_fill_grid(samples["angle_reference_rad"], tick_indices, is_missing),
        angle_rad=_fill_grid(samples["angle_rad"], tick_indices, is_missing | is_angle_stale),
        torque_nm=_fill_grid(
            samples["coupling_torque_nm"], tick_indices, is_missing | is_torque_stale
        ),
        angle_known=~(is_missing | is_angle_stale),
        torque_known=~(
            is_missing | is_torque_stale | ((status_bits & Status.WRENCH_SATURATED) != 0)
        ),
        rate_hz=rate_hz,
        beam=stated_beam(session, rate_hz, tick_count),
        angle_delay_s=stated_delay_s(session, "angle_delay_s"),
        torque_delay_s=stated_delay_s(session, "torque_delay_s"),
        tool_inertia_kg_m2=stated_tool_inertia_kg_m2(session),
        torque_filter_s=stated_torque_filter_s(session),
        uncertainty=stated_uncertainty(session),
        uniformity=stated_uniformity(session),
        tip_mass_kg=stated_tip_mass_kg(session),
        axis_tilt_deg=stated_axis_tilt_deg(session),
        sweep=sweep,
        there=_first_sweep_range(session, first_tick, sweep),
        rest_angle_rad=_rest_angle(session, ticks),
        gaps=gaps,
        flags=flag_counts,
        warnings=(
            *_describe_faults(gaps, flag_counts, unrecorded_ticks, outcome, rate_hz, sweep),
            *(
                f"Of the file: {fault_sentence}."
                for fault_sentence in (*unread_metadata, *unread_outcome)
            ),
        ),
        metadata=metadata,
        outcome=outcome.get("outcome", "unknown"),
    )


def _sweep_range(session: Session, first_tick: int, tick_count: int) -> tuple[slice, int]:
    """Return the range of the sweep's samples, and the number of ticks not recorded at its ends."""
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


def _first_sweep_range(session: Session, first_tick: int, sweep: slice) -> slice | None:
    """Return the range of the first of two sweeps; None if there is only one sweep."""
    segment_first_tick, segment_end_tick = session.segments.get("there", (0, 0))
    first_index, end_index = (
        max(segment_first_tick - first_tick, sweep.start),
        min(segment_end_tick - first_tick, sweep.stop),
    )
    return slice(first_index, end_index) if end_index > first_index else None


def _rest_angle(session: Session, ticks: NDArray[np.int64]) -> float | None:
    """Return the median angle in rad over the segment ``rest``; None without this segment."""
    first_tick, end_tick = session.segments.get("rest", (0, 0))
    is_at_rest = (ticks >= first_tick) & (ticks < end_tick)
    return float(np.median(session.samples["angle_rad"][is_at_rest])) if is_at_rest.any() else None


def _flag_counts(status_bits: NDArray[np.uint32]) -> dict[str, int]:
    """Return the number of samples with each flag that occurs."""
    counts = {
        meaning: int(np.count_nonzero(status_bits & status_flag))
        for status_flag, meaning in _REPORTED_FLAGS
    }
    return {meaning: sample_count for meaning, sample_count in counts.items() if sample_count}


def _fill_grid(
    sample_values: NDArray[np.float64],
    tick_indices: NDArray[np.int64],
    is_unknown: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Return values on the whole grid, with linear interpolation of unknown ones."""
    grid_values = np.zeros(len(is_unknown))
    grid_values[tick_indices] = sample_values
    if is_unknown.any() and not is_unknown.all():
        known_indices = np.flatnonzero(~is_unknown)
        grid_values[is_unknown] = np.interp(
            np.flatnonzero(is_unknown), known_indices, grid_values[known_indices]
        )
    return grid_values


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
