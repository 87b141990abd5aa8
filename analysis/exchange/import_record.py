"""A measurement of another program becomes a session file."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

import rigd
from analysis.exchange.errors import ExchangeError
from analysis.exchange.held_values import hold
from analysis.exchange.import_checks import check_units, timebase
from analysis.exchange.plausibility import unlikely_torque
from analysis.exchange.source import read_source
from analysis.exchange.write_session import write_session
from rigd.session import Status

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from analysis.exchange.import_plan import ImportPlan
    from analysis.exchange.source import SourceChannel

_JITTER_TOLD: Final = 0.01
"""Distance of a time stamp from its tick, in periods, from which on it is worth a word."""


@dataclass(frozen=True, slots=True)
class ImportedRecord:
    """What became of a file.

    Attributes
    ----------
    path : Path
        The session file.
    samples : int
    rate_hz : float
    segments : mapping of str to (int, int)
        Name → first tick and end, as stated.
    warnings : tuple of str
        Sentences to be read before any result; the session has them as events.
    """

    path: Path
    samples: int
    rate_hz: float
    segments: Mapping[str, tuple[int, int]]
    warnings: tuple[str, ...]


def import_record(source: Path, target: Path, plan: ImportPlan) -> ImportedRecord:
    """Read channels of a file and write them as a new session.

    Gaps in the time become missing ticks. Values that are not finite are held from the sample
    before and flagged as stale, which every analysis masks. Nothing is resampled.

    Parameters
    ----------
    source : Path
        A file that `analysis.exchange.source.read_source` reads.
    target : Path
        The session, ``NAME.mcap``, which must not exist.
    plan : ImportPlan

    Raises
    ------
    ExchangeError
        If the file cannot be read, is no record, or contradicts the plan.
    rigd.session.SessionError
        If the session exists or cannot be written.
    """
    names = list(dict.fromkeys(choice.channel for choice in plan.choices))
    file_format, channels = read_source(source, names)
    remarks = dict.fromkeys(channel.remark for channel in channels.values() if channel.remark)
    warnings = [*remarks, *check_units(source, plan, channels)]
    base = timebase(source, plan, channels)
    segments = _segments(source, plan.segments_s, base.rate_hz, int(base.ticks[-1]) + 1)
    columns = _columns(plan, channels)
    del channels  # of the largest files, a quarter of a gigabyte
    titles = {name: choice.channel for name, choice in plan.channels.items()}
    columns, status, first = hold(source, titles, columns)
    ticks = base.ticks[first:]
    after_gap = np.diff(ticks, prepend=-1) > 1
    if base.jitter > _JITTER_TOLD:
        warnings.append(
            f"The time stamps lie up to {base.jitter:.2g} periods from equidistant ones."
        )
    warnings += _told(titles, status, first, ticks)
    odd = unlikely_torque(
        _on_grid(ticks, columns["angle_rad"]),
        _on_grid(ticks, columns["coupling_torque_nm"]),
        base.rate_hz,
        plan.specimen,
    )
    warnings += [odd] if odd else []
    status[after_gap] |= np.uint32(Status.AFTER_LOST)
    write_session(
        target,
        {**columns, "tick": ticks, "status": status},
        base.rate_hz,
        max(source.stat().st_mtime_ns, 0),
        _metadata(source, target, file_format, plan, base.rate_hz),
        segments,
        warnings,
    )
    return ImportedRecord(target, len(ticks), base.rate_hz, segments, tuple(warnings))


def _columns(
    plan: ImportPlan, channels: Mapping[str, SourceChannel]
) -> dict[str, NDArray[np.float64]]:
    """Fields of the samples in their units; what becomes infinite is for others to judge."""
    columns = {}
    with np.errstate(over="ignore"):
        for name, choice in plan.channels.items():
            reverse = plan.reverse_torque and name == "coupling_torque_nm"
            size = -choice.factor if reverse else choice.factor
            values = channels[choice.channel].values
            columns[name] = values if size == 1.0 else values * size
    return columns


def _segments(
    path: Path, segments_s: Mapping[str, tuple[float, float]], rate_hz: float, ticks: int
) -> dict[str, tuple[int, int]]:
    """Segments in ticks, all of them inside the record."""
    found = {}
    for name, (begin_s, end_s) in segments_s.items():
        first, end = round(begin_s * rate_hz), round(end_s * rate_hz)
        if not 0 <= first < end <= ticks:
            raise ExchangeError(
                f"{path}: the segment {name} from {begin_s:g} to {end_s:g} s is not inside the "
                f"record, which lasts {ticks / rate_hz:g} s; count from the first sample."
            )
        found[name] = (first, end)
    return found


def _told(
    titles: Mapping[str, str], status: NDArray[np.uint32], first: int, ticks: NDArray[np.int64]
) -> list[str]:
    """Sentences on what of the record is missing."""
    found = []
    if first:
        found.append(
            f"The first {first} samples were left out: angle or torque is not finite there."
        )
    for flag, name in (
        (Status.ANGLE_STALE, titles["angle_rad"]),
        (Status.WRENCH_STALE, titles["coupling_torque_nm"]),
    ):
        count = int(np.count_nonzero(status & flag))
        if count:
            found.append(f"{count} samples of '{name}' are not finite; they were flagged as stale.")
    steps = np.diff(ticks)
    missing = int(steps.sum()) - len(steps)
    if missing:
        found.append(
            f"{missing} samples are missing in {np.count_nonzero(steps > 1)} gaps of the time, the "
            f"longest of {int(steps.max()) - 1}."
        )
    return found


def _on_grid(ticks: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    if ticks[-1] - ticks[0] + 1 == len(ticks):
        return values
    return np.interp(np.arange(ticks[0], ticks[-1] + 1), ticks, values)


def _metadata(
    source: Path, target: Path, file_format: str, plan: ImportPlan, rate_hz: float
) -> dict[str, str]:
    """Everything that the session is to say of itself and of where it came from."""
    beam = plan.specimen.beam
    numbers = {
        "rate_hz": rate_hz,
        "beam_length_m": beam.length_m,
        "beam_density_kg_per_m": beam.density_kg_per_m,
        "beam_bending_stiffness_n_m2": beam.bending_stiffness_n_m2,
        "tool_inertia_kg_m2": plan.specimen.tool_inertia_kg_m2,
        "angle_delay_s": plan.angle_delay_s,
        "torque_delay_s": plan.torque_delay_s,
    }
    with source.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    mapping = {f"import_{name}": str(choice) for name, choice in plan.channels.items()}
    if plan.reverse_torque:
        mapping["import_coupling_torque_nm"] += ", reversed"
    return {
        "id": target.stem,
        **{name: repr(float(value)) for name, value in numbers.items()},
        **{
            key: text
            for key, text in (
                ("operator", plan.operator),
                ("specimen", plan.label),
                ("note", plan.note),
            )
            if text
        },
        "software": f"rigd {rigd.__version__}",
        "imported_from": source.name.encode("utf-8", "replace").decode("utf-8"),
        "import_format": file_format,
        "import_sha256": digest,
        "import_time": "rate stated" if plan.time is None else str(plan.time),
        **mapping,
    }
