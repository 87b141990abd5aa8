"""Session file as arrays on a uniform time grid, with a report of missing and stale samples.

The estimators need uniform samples, but a session may have missing ticks, held (stale) values or an
incomplete sweep. This module interpolates such samples within limits, counts and reports them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.record_checks import (
    MAX_GAP_S,
    MAX_TICKS,
    MAX_UNKNOWN_FRACTION,
    RecordError,
    check_finite,
    check_sensor,
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
from analysis.record_part import check_part_length, part_of_session, swept_frequencies_hz
from analysis.record_ticks import Gaps, TickGrid
from rigd.session import Session, read_session, readable_texts

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from analysis.record_part import PartOption
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
    part_s
        Beginning and end of the part of the session that the record covers, in seconds since the
        session's start; None for the whole session. The angles of a part without the segment
        ``rest`` are relative to the angle held there.
    swept_hz
        Lowest and highest frequency of the sweep in a part of a session; None for the whole one.
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
    part_s: tuple[float, float] | None = None
    swept_hz: tuple[float, float] | None = None

    @property
    def part_json(self) -> dict[str, float] | None:
        """Part of the session as a JSON value; None for the whole session."""
        return None if self.part_s is None else {"from_s": self.part_s[0], "to_s": self.part_s[1]}

    @property
    def part_text(self) -> str | None:
        """Part of the session in words, such as "10 to 60 s of the session"; None for the whole."""
        if self.part_s is None:
            return None
        return f"{self.part_s[0]:g} to {self.part_s[1]:g} s of the session"

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


def load_record(path: Path, part_s: PartOption | None = None) -> Record:
    """Read a session file and return its record on a uniform time grid.

    Missing ticks, and values flagged as stale, are replaced by linear interpolation between their
    known neighbours, up to `MAX_UNKNOWN_FRACTION` of the sweep and gaps of `MAX_GAP_S`. The result
    has their counts and masks. Without segments, the whole record is the sweep. A sweep that was
    stopped ends with the recorded samples.

    Parameters
    ----------
    path
        Session file (docs/session_format.md).
    part_s
        Beginning and end of the part to be read, in seconds since the session's start; None for the
        session's beginning or end. By default, the whole session is read.

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
    return record_of(read_session(path, fields=RECORD_FIELDS, max_samples=MAX_SAMPLES), part_s)


def record_of(session: Session, part_s: PartOption | None = None) -> Record:
    """Return the record of a session on a uniform time grid (see `load_record`).

    Parameters
    ----------
    session
        Session from a file, or a running one so far. Its samples need the `RECORD_FIELDS`.
    part_s
        Part of the session, as for `load_record`.

    Raises
    ------
    rigd.session.SessionError
        The metadata lack a required key.
    RecordError
        The samples cannot be analysed.
    """
    path, whole_session = session.path, session
    if len(session.samples) == 0:
        raise RecordError(f"{path}: the session holds no samples, so there is nothing to analyse.")
    rate_hz = stated_rate_hz(session)
    covered_s = None
    if part_s is not None:
        session, covered_s = part_of_session(session, part_s, rate_hz)
    grid = TickGrid.of(session, rate_hz)
    samples = session.samples
    ticks = samples["tick"]
    for field_name in ("angle_reference_rad", "angle_rad", "coupling_torque_nm"):
        check_finite(path, field_name, samples[field_name], ticks)
    check_sensor(path, samples["coupling_torque_nm"])
    metadata, unread_metadata = readable_texts(session.metadata, "keys of the metadata")
    outcome, unread_outcome = readable_texts(session.outcome or {}, "keys of the outcome")
    record = Record(
        path=path,
        time_s=(grid.first_tick + np.arange(grid.count)) / rate_hz,
        reference_rad=_fill_grid(samples["angle_reference_rad"], grid.indices, grid.is_missing),
        angle_rad=_fill_grid(samples["angle_rad"], grid.indices, grid.is_angle_unknown),
        torque_nm=_fill_grid(samples["coupling_torque_nm"], grid.indices, grid.is_torque_unknown),
        angle_known=~grid.is_angle_unknown,
        torque_known=grid.is_torque_measured,
        rate_hz=rate_hz,
        beam=stated_beam(session, rate_hz, grid.count),
        angle_delay_s=stated_delay_s(session, "angle_delay_s"),
        torque_delay_s=stated_delay_s(session, "torque_delay_s"),
        tool_inertia_kg_m2=stated_tool_inertia_kg_m2(session),
        torque_filter_s=stated_torque_filter_s(session),
        uncertainty=stated_uncertainty(session),
        uniformity=stated_uniformity(session),
        tip_mass_kg=stated_tip_mass_kg(session),
        axis_tilt_deg=stated_axis_tilt_deg(session),
        sweep=grid.sweep,
        there=grid.there,
        rest_angle_rad=_rest_angle(session),
        gaps=grid.gaps(),
        flags=grid.flag_counts(),
        warnings=(
            *grid.fault_sentences(outcome),
            *(
                f"Of the file: {fault_sentence}."
                for fault_sentence in (*unread_metadata, *unread_outcome)
            ),
        ),
        metadata=metadata,
        outcome=outcome.get("outcome", "unknown"),
    )
    if covered_s is None:
        return record
    return _record_of_part(record, covered_s, whole_session, grid.first_tick)


def _record_of_part(
    record: Record, covered_s: tuple[float, float], session: Session, first_tick: int
) -> Record:
    """Return the record of a part with what only the whole session states.

    `first_tick` is the number of the part's first tick.
    """
    check_part_length(record.path, covered_s, record.beam)
    sweep = record.first_sweep
    rest_angle_rad = _rest_angle(session) if record.rest_angle_rad is None else None
    origin_rad = rest_angle_rad or 0.0
    return replace(
        record,
        reference_rad=record.reference_rad - origin_rad,
        angle_rad=record.angle_rad - origin_rad,
        part_s=covered_s,
        swept_hz=swept_frequencies_hz(session, first_tick + sweep.start, first_tick + sweep.stop),
    )


def _rest_angle(session: Session) -> float | None:
    """Return the median angle in rad over the segment ``rest``; None without this segment."""
    ticks = session.samples["tick"]
    first_tick, end_tick = session.segments.get("rest", (0, 0))
    is_at_rest = (ticks >= first_tick) & (ticks < end_tick)
    return float(np.median(session.samples["angle_rad"][is_at_rest])) if is_at_rest.any() else None


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
