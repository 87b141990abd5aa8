"""Session file as arrays on a uniform time grid, with a report of missing and stale samples.

The estimators need uniform samples, but a session may have missing ticks, held (stale) values or an
incomplete sweep. This module interpolates such samples within limits, counts and reports them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.models import RECORD_BAND_HZ
from analysis.record_checks import (
    MAX_GAP_S,
    MAX_TICKS,
    MAX_UNKNOWN_FRACTION,
    RecordError,
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
from analysis.record_ticks import (
    FullRateSignals,
    Gaps,
    RecordSignals,
    TickGrid,
    TorqueExtreme,
)
from rigd.session import Session, limits, read_session, readable_texts

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from analysis.record_part import PartOption
    from analysis.signal_decimation import SignalDecimation
    from rigd.beam import Beam

__all__ = [
    "MAX_GAP_S",
    "MAX_SAMPLES",
    "MAX_UNKNOWN_FRACTION",
    "RECORD_FIELDS",
    "FullRate",
    "Gaps",
    "Record",
    "RecordError",
    "load_record",
    "record_of",
]

MAX_SAMPLES = MAX_TICKS
"""Largest number of samples of a session that are read."""

_TICK_FIELDS = ("t_ns", "tick", "status")
"""Fields of the samples that are read before the signals of a file that may be long."""

LONGEST_FULL_RATE_SAMPLES = 720_000
"""Maximum number of samples of a record that is analysed at its full rate: 12 minutes at 1 kHz,
which take 0.5 GB of memory. The signals of a longer record are decimated while they are read."""

_MIN_SAMPLE_BYTES = 60
"""Assumed minimum size of a sample in a file, in bytes after compression."""

RECORD_FIELDS = ("t_ns", "tick", "angle_reference_rad", "angle_rad", "coupling_torque_nm", "status")
"""Fields of the samples that an analysis needs."""


@dataclass(frozen=True, slots=True)
class FullRate:
    """Samples of a record as its file contains them.

    Attributes
    ----------
    rate_hz
        Ticks per second.
    samples
        Number of ticks from the first to the last sample.
    sweep
        Range of ticks with the excitation, relative to the first.
    """

    rate_hz: float
    samples: int
    sweep: slice


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
    outward_sweep
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
    decimated_from
        Rate, samples and sweep of a long record before it was decimated while it was read; None if
        all samples in the file are those of the record. `gaps` and `flags` count in the file.
    torque_extremes
        Largest and smallest torque in the file of a decimated record; empty for another.
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
    outward_sweep: slice | None
    rest_angle_rad: float | None
    gaps: Gaps
    flags: Mapping[str, int]
    warnings: tuple[str, ...]
    metadata: Mapping[str, str]
    outcome: str
    part_s: tuple[float, float] | None = None
    swept_hz: tuple[float, float] | None = None
    decimated_from: FullRate | None = None
    torque_extremes: tuple[TorqueExtreme, ...] = ()

    @property
    def full_rate(self) -> FullRate:
        """Rate, number of samples and sweep of the record as it is in the file."""
        return self.decimated_from or FullRate(self.rate_hz, len(self.time_s), self.sweep)

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
    def excited_hz(self) -> tuple[float, float] | None:
        """Lowest and highest stated frequency of the excitation, or of a part of a sweep.

        None if the file does not state them.
        """
        if self.swept_hz is not None:
            return self.swept_hz
        try:
            start_hz, stop_hz = float(self.metadata["start_hz"]), float(self.metadata["stop_hz"])
        except (KeyError, ValueError):
            return None
        return min(start_hz, stop_hz), max(start_hz, stop_hz)

    @property
    def first_sweep(self) -> slice:
        """Range of samples for Welch's method: the single sweep, or the first of two sweeps."""
        return self.sweep if self.outward_sweep is None else self.outward_sweep

    @property
    def first_sweep_samples(self) -> int:
        """Number of samples in the first sweep."""
        return int(self.first_sweep.stop - self.first_sweep.start)


def load_record(
    path: Path,
    part_s: PartOption | None = None,
    *,
    highest_hz: float = RECORD_BAND_HZ[1],
    longest_samples: int = LONGEST_FULL_RATE_SAMPLES,
) -> Record:
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
    highest_hz
        Highest frequency of the analysis. A long record is decimated to 2.5 times this rate while
        it is read.
    longest_samples
        Maximum number of samples of a record that is not decimated.

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
    if not may_be_longer(path, longest_samples):
        session = read_session(path, fields=RECORD_FIELDS, max_samples=MAX_SAMPLES)
        return record_of(session, part_s, highest_hz=highest_hz, longest_samples=longest_samples)
    from analysis.record_part import read_session_part  # late: for a long record only

    # The signals are read after the ticks of all samples: they may take too much memory.
    session, interval_s = read_session_part(
        path, part_s, fields=_TICK_FIELDS, max_samples=limits.MAX_RECORDED_SAMPLES
    )
    grid, covered_interval_s = _tick_grid_of(session, part_s)
    # The grid replaces the ticks, of which a long record has many.
    session = replace(session, samples=session.samples[:0].copy())
    rest_angles_rad: list[NDArray[np.float64]] = []
    signal_collector = _collector_of_signals(grid, highest_hz, longest_samples)

    def add_samples(samples: NDArray[np.void]) -> None:
        rest_angles_rad.append(_rest_angles_rad(session, samples))
        signal_collector.add(samples)

    read_session(
        path,
        max_samples=limits.MAX_RECORDED_SAMPLES,
        on_samples=add_samples,
        part_s=interval_s,
    )
    return _make_record(
        session,
        grid,
        signal_collector.finish(),
        covered_interval_s,
        _median_angle_rad(rest_angles_rad),
    )


def may_be_longer(path: Path, sample_count: int) -> bool:
    """Return whether a file may contain more than a number of samples, by its size.

    Parameters
    ----------
    path
        File, which need not exist.
    sample_count
        Number of samples.
    """
    try:
        return path.stat().st_size > sample_count * _MIN_SAMPLE_BYTES
    except OSError:  # reported when the file is opened
        return False


def record_of(
    session: Session,
    part_s: PartOption | None = None,
    *,
    highest_hz: float = RECORD_BAND_HZ[1],
    longest_samples: int = LONGEST_FULL_RATE_SAMPLES,
) -> Record:
    """Return the record of a session on a uniform time grid (see `load_record`).

    Parameters
    ----------
    session
        Session from a file, or a running one so far. Its samples need the `RECORD_FIELDS`.
    part_s
        Part of the session, as for `load_record`.
    highest_hz, longest_samples
        Highest frequency of the analysis, and maximum number of samples that are not decimated, as
        for `load_record`.

    Raises
    ------
    rigd.session.SessionError
        The metadata lack a required key.
    RecordError
        The samples cannot be analysed.
    """
    grid, covered_interval_s = _tick_grid_of(session, part_s)
    signal_collector = _collector_of_signals(grid, highest_hz, longest_samples)
    signal_collector.add(session.samples)
    rest_angle_rad = _median_angle_rad([_rest_angles_rad(session, session.samples)])
    return _make_record(
        session, grid, signal_collector.finish(), covered_interval_s, rest_angle_rad
    )


def _collector_of_signals(
    grid: TickGrid, highest_hz: float, longest_samples: int
) -> FullRateSignals | SignalDecimation:
    """Return the collector for the signals of a record: decimated if the record is long."""
    if grid.tick_count <= longest_samples:
        return FullRateSignals(grid)
    from analysis.signal_decimation import SignalDecimation  # late: for a long record only

    decimation = SignalDecimation(grid, highest_hz)
    return decimation if decimation.downsampling_factor > 1 else FullRateSignals(grid)


def _rest_angles_rad(session: Session, samples: NDArray[np.void]) -> NDArray[np.float64]:
    """Return the angles of those samples of a session that are in its segment ``rest``."""
    first_tick, end_tick = session.segments.get("rest", (0, 0))
    is_at_rest = (samples["tick"] >= first_tick) & (samples["tick"] < end_tick)
    rest_angles_rad: NDArray[np.float64] = samples["angle_rad"][is_at_rest]
    return rest_angles_rad


def _median_angle_rad(angle_blocks_rad: list[NDArray[np.float64]]) -> float | None:
    """Return the median of blocks of angles; None if there is no angle."""
    all_angles_rad = np.concatenate(angle_blocks_rad) if angle_blocks_rad else np.zeros(0)
    return float(np.median(all_angles_rad)) if all_angles_rad.size else None


def _tick_grid_of(
    session: Session, part_s: PartOption | None
) -> tuple[TickGrid, tuple[float, float] | None]:
    """Return the ticks of a session or of a part of it, and beginning and end of the part in s."""
    if len(session.samples) == 0:
        raise RecordError(
            f"{session.path}: the session holds no samples, so there is nothing to analyse."
        )
    rate_hz = stated_rate_hz(session)
    if part_s is None:
        return TickGrid.from_session(session, rate_hz), None
    from analysis.record_part import part_of_session

    part, covered_interval_s = part_of_session(session, part_s, rate_hz)
    return TickGrid.from_session(part, rate_hz), covered_interval_s


def _make_record(
    session: Session,
    grid: TickGrid,
    signals: RecordSignals,
    covered_interval_s: tuple[float, float] | None,
    rest_angle_rad: float | None,
) -> Record:
    """Return the record of a session, or of the part of it to which `grid` belongs.

    `rest_angle_rad` is the angle that is held in the session's segment ``rest``.
    """
    metadata, unread_metadata = readable_texts(session.metadata, "keys of the metadata")
    outcome, unread_outcome = readable_texts(session.outcome or {}, "keys of the outcome")
    reference_rad, angle_rad, torque_nm = signals.signal_values
    ticks = (
        grid.first_tick + signals.first_tick + signals.ticks_per_sample * np.arange(torque_nm.size)
    )
    beam = stated_beam(session, grid.rate_hz, grid.tick_count)
    swept_hz = None
    if covered_interval_s is not None:
        from analysis.record_part import check_part_length, swept_frequencies_hz

        check_part_length(session.path, covered_interval_s, beam)
        first_sweep = grid.outward_sweep or grid.sweep
        swept_hz = swept_frequencies_hz(
            session, grid.first_tick + first_sweep.start, grid.first_tick + first_sweep.stop
        )
        if "rest" not in grid.session.segments and rest_angle_rad is not None:
            reference_rad, angle_rad = reference_rad - rest_angle_rad, angle_rad - rest_angle_rad
            rest_angle_rad = None
    return Record(
        path=session.path,
        time_s=ticks / grid.rate_hz,
        reference_rad=reference_rad,
        angle_rad=angle_rad,
        torque_nm=torque_nm,
        angle_known=signals.angle_known,
        torque_known=signals.torque_known,
        rate_hz=grid.rate_hz / signals.ticks_per_sample,
        beam=beam,
        angle_delay_s=stated_delay_s(session, "angle_delay_s"),
        torque_delay_s=stated_delay_s(session, "torque_delay_s"),
        tool_inertia_kg_m2=stated_tool_inertia_kg_m2(session),
        torque_filter_s=stated_torque_filter_s(session),
        uncertainty=stated_uncertainty(session),
        uniformity=stated_uniformity(session),
        tip_mass_kg=stated_tip_mass_kg(session),
        axis_tilt_deg=stated_axis_tilt_deg(session),
        sweep=signals.samples_in(grid.sweep),
        outward_sweep=None
        if grid.outward_sweep is None
        else signals.samples_in(grid.outward_sweep),
        rest_angle_rad=rest_angle_rad,
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
        part_s=covered_interval_s,
        swept_hz=swept_hz,
        decimated_from=None
        if signals.ticks_per_sample == 1
        else FullRate(grid.rate_hz, grid.tick_count, grid.sweep),
        torque_extremes=signals.torque_extremes,
    )
