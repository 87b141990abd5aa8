"""Import: a measurement of another program becomes a session file, and is checked on the way.

Nothing is guessed: channels, units and circumstances are the user's to state (`ImportPlan`). Stated
units are compared with those of the file, the time stamps with a uniform rate, and the torque with
that of the undamped beam. Values that are not finite are held and flagged, as in the session
format.
"""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

import rigd
from analysis.exchange._file_statements import FileStatements, time_samples
from analysis.exchange._source import ExchangeError, read_source
from analysis.record_checks import first_mode_hz, too_much_unknown
from rigd.beam import Damping, transfer, undamped_frequencies_rad_s
from rigd.session import SessionWriter
from rigd.session.layout import Status, encode_samples

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from analysis.exchange._channels import ChannelChoice, Timebase
    from analysis.exchange._source import SourceChannel
    from analysis.exchange._specimen import SpecimenFile


# Import

REQUIRED: Final = ("angle_rad", "coupling_torque_nm")
"""Fields of a sample without which nothing can be analysed."""


@dataclass(frozen=True, slots=True)
class ImportPlan:
    """Channels, units and circumstances; nothing of it is guessed.

    Attributes
    ----------
    channels : mapping of str to ChannelChoice
        Field of a sample (`analysis.exchange._channels.QUANTITIES`) → channel and unit; those of
        `REQUIRED` must be among them.
    specimen : SpecimenFile
    time : ChannelChoice, optional
        Channel with the time of each sample.
    rate_hz : float, optional
        Samples per second of a record without gaps; this or `time`.
    segments_s : mapping of str to (float, float)
        Name (rest, sweep, ring_down) → begin and end in s after the first sample.
    angle_delay_s, torque_delay_s : float
        Age of either value at its time stamp.
    reverse_torque : bool
        Whether the coupling torque counts against the angle's sense, as a reaction does.
    note, label, operator : str
        From the operator; the label is what they call the specimen.
    ignore_file_metadata : bool
        Whether the plan counts where the file states another rate, time, start, unit or scale.
    """

    channels: Mapping[str, ChannelChoice]
    specimen: SpecimenFile
    time: ChannelChoice | None = None
    rate_hz: float | None = None
    segments_s: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    angle_delay_s: float = 0.0
    torque_delay_s: float = 0.0
    reverse_torque: bool = False
    note: str = ""
    label: str = ""
    operator: str = ""
    ignore_file_metadata: bool = False

    def __post_init__(self) -> None:
        if any(name not in self.channels for name in REQUIRED):
            raise ValueError(f"a plan needs channels for {' and '.join(REQUIRED)}")
        if (self.time is None) == (self.rate_hz is None):
            raise ValueError("a plan needs either a channel of times or a rate")

    @property
    def choices(self) -> tuple[ChannelChoice, ...]:
        """Every channel that is to be read."""
        return (*self.channels.values(), *(() if self.time is None else (self.time,)))


@dataclass(frozen=True, slots=True)
class ImportedRecord:
    """Result of an import.

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


_JITTER_REPORTED: Final = 0.01
"""Distance of a time stamp from its tick, in periods, from which it is reported."""


def import_record(source: Path, target: Path, plan: ImportPlan) -> ImportedRecord:
    """Read channels of a file and write them as a new session.

    Gaps in the time become missing ticks. Values that are not finite are held from the sample
    before and flagged as stale, which every analysis masks. Nothing is resampled.

    Parameters
    ----------
    source : Path
        A file that `analysis.exchange._source.read_source` reads.
    target : Path
        The session, ``NAME.mcap``, which must not exist.
    plan : ImportPlan

    Raises
    ------
    ExchangeError
        If the file cannot be read, is not a record, or contradicts the plan.
    rigd.session.SessionError
        If the session exists or cannot be written.
    """
    names = list(dict.fromkeys(choice.channel for choice in plan.choices))
    file_format, channels = read_source(source, names)
    remarks = dict.fromkeys(channel.remark for channel in channels.values() if channel.remark)
    statements = FileStatements(source, plan, [*remarks])
    statements.check_scales(channels)
    statements.check_units(channels)
    base = statements.timebase(channels)
    channels, delays_s = statements.align(channels, base)
    base = time_samples(source, plan, channels)
    warnings = statements.warnings
    warnings += _check_rate(source, plan, base)
    segments = _segments(source, plan.segments_s, base.rate_hz, int(base.ticks[-1]) + 1)
    columns = _columns(plan, channels)
    del channels  # of the largest files, a quarter of a gigabyte
    titles = {name: choice.channel for name, choice in plan.channels.items()}
    columns, status, first = hold(source, titles, columns)
    ticks = base.ticks[first:]
    after_gap = np.diff(ticks, prepend=-1) > 1
    if base.jitter > _JITTER_REPORTED:
        warnings.append(
            f"The time stamps lie up to {base.jitter:.2g} periods from equidistant ones."
        )
    warnings += _missing_sentences(titles, status, first, ticks)
    odd = unlikely_torque(
        _on_grid(ticks, columns["angle_rad"]),
        _on_grid(ticks, columns["coupling_torque_nm"]),
        base.rate_hz,
        plan.specimen,
    )
    warnings += [odd] if odd else []
    status[after_gap] |= np.uint32(Status.AFTER_LOST)
    start_utc_ns, doubt = _start_utc_ns(source, int(ticks[-1]) / base.rate_hz)
    warnings += [doubt] if doubt else []
    metadata = _metadata(source, target, file_format, plan, base.rate_hz)
    for key, field_name in (("angle_delay_s", REQUIRED[0]), ("torque_delay_s", REQUIRED[1])):
        found_s = delays_s.get(plan.channels[field_name].channel, 0.0)
        metadata[key] = repr(float(metadata[key]) + found_s)
    if statements.ignored:
        metadata["import_ignored"] = "; ".join(statements.ignored)
    write_session(
        target,
        {**columns, "tick": ticks, "status": status},
        base.rate_hz,
        start_utc_ns,
        metadata,
        segments,
        warnings,
    )
    return ImportedRecord(target, len(ticks), base.rate_hz, segments, tuple(warnings))


_LATEST_NS: Final = 2**63 - 1
"""Latest time that a session file can have, in the year 2262."""


def _start_utc_ns(source: Path, duration_s: float) -> tuple[int, str]:
    """Return when the file was changed last, or now with a warning if no session can have that."""
    changed_ns = source.stat().st_mtime_ns
    if changed_ns >= 0 and changed_ns + duration_s * 1e9 < _LATEST_NS:
        return changed_ns, ""
    year = 1970 + changed_ns / (365.2425 * 86_400e9)
    return time.time_ns(), (
        f"By its time stamp the file was changed about the year {year:.0f}, which a session cannot "
        "state; the time of this import is used as the session's start."
    )


def _check_rate(path: Path, plan: ImportPlan, base: Timebase) -> list[str]:
    """Raise if no record at this rate shows the beam; warn of a very short time."""
    beam, times = plan.specimen.beam, plan.time
    first_hz, duration_s = first_mode_hz(beam), (int(base.ticks[-1]) + 1) / base.rate_hz
    remedy = (
        f"state the unit of '{times.channel}', which was taken to be {times.unit}, with --time "
        f"{times.channel}:UNIT (s, ms, us, ns)"
        if times
        else "state the true rate with --rate-hz"
    )
    if first_hz >= base.rate_hz / 2:
        raise ExchangeError(
            f"{path}: the record lasts {duration_s:.6g} s at {base.rate_hz:g} Hz, but the first "
            f"mode of this beam is at {first_hz:.3g} Hz, beyond the Nyquist frequency of "
            f"{base.rate_hz / 2:g} Hz; {remedy}, or correct the beam in --profile."
        )
    if duration_s * first_hz < 1:
        return [
            f"The record lasts {duration_s:.3g} s at {base.rate_hz:g} Hz, less than one period of "
            f"the first mode of this beam, {first_hz:.3g} Hz; if that is wrong, {remedy}."
        ]
    return []


def _columns(
    plan: ImportPlan, channels: Mapping[str, SourceChannel]
) -> dict[str, NDArray[np.float64]]:
    """Return the fields of the samples in SI units; infinite values are handled later."""
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


def _missing_sentences(
    titles: Mapping[str, str], status: NDArray[np.uint32], first: int, ticks: NDArray[np.int64]
) -> list[str]:
    """Return sentences on missing parts of the record."""
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
    """Return the metadata of the session and of its source."""
    beam = plan.specimen.beam
    numbers = {
        "rate_hz": rate_hz,
        "beam_length_m": beam.length_m,
        "beam_density_kg_per_m": beam.density_kg_per_m,
        "beam_bending_stiffness_n_m2": beam.bending_stiffness_n_m2,
        "tool_inertia_kg_m2": plan.specimen.tool_inertia_kg_m2,
        "angle_delay_s": plan.angle_delay_s,
        "torque_delay_s": plan.torque_delay_s,
        **{f"uncertainty_{k}_percent": v for k, v in plan.specimen.uncertainty_percent.items()},
    }
    for key in ("uniformity_percent", "tip_mass_kg", "axis_tilt_deg"):
        stated = getattr(plan.specimen, key)
        if stated is not None:
            numbers[key] = stated
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


# Values that are not finite

_FLAGS: Final = {
    "angle_rad": Status.ANGLE_STALE,
    "coupling_torque_nm": Status.WRENCH_STALE,
}
"""Field of a sample → the flag that says its value is that of the sample before."""


def hold(
    path: Path, names: Mapping[str, str], columns: Mapping[str, NDArray[np.float64]]
) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.uint32], int]:
    """Replace values that are not finite as the session format does: by the last good one.

    Parameters
    ----------
    path : Path
        For messages.
    names : mapping of str to str
        Field → name of its channel in the file, for messages.
    columns : mapping of str to ndarray of float, shape (n,)
        Field → values.

    Returns
    -------
    columns : dict of str to ndarray of float, shape (n - first,)
    status : ndarray of uint32, shape (n - first,)
        Bits of `rigd.session.layout.Status`.
    first : int
        Samples at the beginning that had to be left out, having nothing to hold.

    Raises
    ------
    ExchangeError
        If it is too many values, or those of a channel that cannot be flagged.
    """
    bad = {name: ~np.isfinite(values) for name, values in columns.items()}
    for name, mask in bad.items():
        count = int(mask.sum())
        if count and name not in _FLAGS:
            raise ExchangeError(
                f"{path}: '{names[name]}' is not finite in {count} of {len(mask)} samples, first "
                f"in sample {int(np.argmax(mask)) + 1}; repair it, or leave this channel out: no "
                "analysis needs it."
            )
        much = too_much_unknown(f"'{names[name]}'", count, len(mask))
        if much:
            raise ExchangeError(
                f"{path}: {much} Or choose another channel, or cut the session out of the file."
            )
    first = max(int(np.argmin(mask)) for mask in bad.values())
    held = {name: _held(values, bad[name])[first:] for name, values in columns.items()}
    status = np.zeros(len(next(iter(held.values()))), dtype=np.uint32)
    for name, flag in _FLAGS.items():
        if name in bad:
            status[bad[name][first:]] |= np.uint32(flag)
    return held, status, first


def _held(values: NDArray[np.float64], bad: NDArray[np.bool_]) -> NDArray[np.float64]:
    if not bad.any():
        return values
    last_good = np.maximum.accumulate(np.where(bad, 0, np.arange(len(values))))
    return values[last_good]


# Plausibility of the torque

_BANDS: Final = ((0.25, 0.6), (1.5, 3.5))
"""In first natural frequencies: on either side of the first resonance, far enough from it and from
the first antiresonance (at 4.4) for damping not to matter, and above the frequencies at which the
paper's external damping outweighs the inertia."""

_CERTAIN: Final = 6.0
"""Distance from zero, in standard deviations, that the factor between torque and model must have
for a decision: a motion that does not reach these frequencies gives none."""

_TAPER: Final = 0.05
"""Fraction of the record at either end over which it is faded: a record may begin and end in
motion, and the paper's chirp passes these frequencies early."""

_FACTOR: Final = 3.0
"""Largest factor between torque and model that damping and a wrong mass may account for. The units
that are easily mixed up differ by more than ten."""


def unlikely_torque(
    angle_rad: NDArray[np.float64],
    torque_nm: NDArray[np.float64],
    rate_hz: float,
    specimen: SpecimenFile,
) -> str | None:
    """Compare the torque with that of the undamped beam on either side of its first resonance.

    Parameters
    ----------
    angle_rad, torque_nm : ndarray of float, shape (n,)
        The whole record, finite.
    rate_hz : float
    specimen : SpecimenFile

    Returns
    -------
    str or None
        Anomaly and remedy; None if there is none, or the motion does not decide it.
    """
    frequency_hz = np.fft.rfftfreq(len(angle_rad), 1 / rate_hz)
    first_hz = undamped_frequencies_rad_s(specimen.beam, 1)[0] / (2 * np.pi)
    band = np.zeros(frequency_hz.shape, dtype=np.bool_)
    for low, high in _BANDS:
        band |= (frequency_hz >= low * first_hz) & (frequency_hz <= high * first_hz)
    s = 2j * np.pi * frequency_hz[band]
    from_middle = np.abs(np.linspace(-1.0, 1.0, len(angle_rad)))  # 0 in the middle, 1 at either end
    window = np.sin(np.pi / 2 * np.minimum((1 - from_middle) / (2 * _TAPER), 1)) ** 2
    with np.errstate(over="ignore", invalid="ignore"):
        angle, torque = (
            np.fft.rfft(window * (values - values.mean()))[band]
            for values in (angle_rad, torque_nm)
        )
        model = (transfer(s, specimen.beam, Damping()) + specimen.tool_inertia_kg_m2 * s**2) * angle
        power, total = (float(np.vdot(each, each).real) for each in (model, torque))
        if not (0.0 < power < np.inf and 0.0 < total < np.inf):
            return None
        ratio = complex(np.vdot(model, torque) / power)
    size = abs(ratio)
    explained = size**2 * power
    unexplained_per_bin = max(total - explained, 0.0) / np.count_nonzero(band)
    if explained < _CERTAIN**2 * unexplained_per_bin:
        return None
    if not 1 / _FACTOR < size < _FACTOR:
        return (
            f"The torque is {size:.3g} times that of this beam: check the units of "
            "angle and torque, and the beam's length and density."
        )
    if ratio.real < 0.0:
        return (
            "The torque has the opposite sign to that of this beam: import a sensor that measures "
            "the reaction with --reverse-torque."
        )
    return None


# Session file

_BLOCK: Final = 25_000
"""Samples that are packed at a time."""


def write_session(
    path: Path,
    samples: Mapping[str, NDArray[np.generic]],
    rate_hz: float,
    start_utc_ns: int,
    metadata: Mapping[str, str],
    segments: Mapping[str, tuple[int, int]],
    warnings: Sequence[str],
) -> None:
    """Write a session that was recorded elsewhere.

    How it ended is not known, so the outcome has the counts and nothing else. If it cannot be
    written, nothing is left behind.

    Parameters
    ----------
    path : Path
        Its final name, which must not exist.
    samples : mapping of str to ndarray, shape (n,)
        Fields of a sample, ``tick`` among them; those that are absent are 0.
    rate_hz, start_utc_ns, metadata, segments
        As the format has them (docs/session_format.md).
    warnings : sequence of str
        Written as events.

    Raises
    ------
    rigd.session.SessionError
        If the file exists or cannot be written.
    """
    ticks = samples["tick"]
    writer = SessionWriter(path)
    try:
        writer.begin(start_utc_ns, metadata, segments, {})
        for warning in warnings:
            writer.log(0, "warning", warning, "import")
        for begin in range(0, len(ticks), _BLOCK):
            part = slice(begin, begin + _BLOCK)
            block = {name: values[part] for name, values in samples.items()}
            block["t_ns"] = np.rint(np.multiply(block["tick"], 1e9 / rate_hz))
            writer.write_samples(encode_samples(block))
        scheduled = int(ticks[-1]) + 1
        counts = {"scheduled": scheduled, "recorded": len(ticks), "missed": 0}
        counts["lost"] = scheduled - len(ticks)
        writer.close({name: str(count) for name, count in counts.items()})
    except BaseException:
        # Unlike a recording, the source is still there: an incomplete copy of it is useless.
        try:
            writer.abandon()
        finally:
            writer.part.unlink(missing_ok=True)
        raise
