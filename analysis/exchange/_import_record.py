"""Conversion of a measurement of another program to a session file, with checks.

The user states channels, units and circumstances in an `ImportPlan`; none of them is guessed. The
stated units are compared with the units in the file, the time stamps with a uniform rate, and the
torque with the torque of the undamped beam. Values that are not finite are replaced by the last
finite value and flagged, as in the session format.
"""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

import rigd
from analysis.exchange._file_statements import FileMetadataCheck, plan_timebase
from analysis.exchange._import_plan import REQUIRED_FIELDS, ImportPlan
from analysis.exchange._source import ExchangeError, read_source
from analysis.record_checks import first_mode_hz, unknown_fraction_message
from rigd.beam import Damping, transfer, undamped_frequencies_rad_s
from rigd.session import SessionWriter
from rigd.session.layout import Status, encode_samples

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from analysis.exchange._channels import Timebase
    from analysis.exchange._source import SourceChannel
    from analysis.exchange._specimen import SpecimenFile


@dataclass(frozen=True, slots=True)
class ImportedRecord:
    """Session file that results from an import.

    Attributes
    ----------
    path : Path
        Path of the session file.
    samples : int
        Number of samples.
    rate_hz : float
        Sampling rate.
    segments : mapping of str to (int, int)
        First and end tick by the segment's name, as stated in the plan.
    warnings : tuple of str
        Warnings for the user, which are also stored as events of the session.
    """

    path: Path
    samples: int
    rate_hz: float
    segments: Mapping[str, tuple[int, int]]
    warnings: tuple[str, ...]


_JITTER_WARNING_LIMIT: Final = 0.01
"""Distance of a time stamp from its tick, in sample periods, above which the user is warned."""


def import_record(source: Path, target: Path, plan: ImportPlan) -> ImportedRecord:
    """Read channels of a file and write them as a new session.

    Gaps in the times become missing ticks. Values that are not finite are replaced by the value
    before and flagged as stale, so that every analysis masks them. Nothing is resampled.

    Parameters
    ----------
    source : Path
        File in a format of `analysis.exchange.read_source`.
    target : Path
        New session file ``NAME.mcap``, which must not exist.
    plan : ImportPlan
        The user's statements on the record.

    Raises
    ------
    ExchangeError
        If the file cannot be read, contains no record, or contradicts the plan.
    rigd.session.SessionError
        If the session exists or cannot be written.
    """
    channel_names = list(dict.fromkeys(choice.channel for choice in plan.channel_choices))
    file_format, channels = read_source(source, channel_names)
    channel_remarks = dict.fromkeys(
        channel.remark for channel in channels.values() if channel.remark
    )
    metadata_check = FileMetadataCheck(source, plan, [*channel_remarks])
    metadata_check.check_scales(channels)
    metadata_check.check_units(channels)
    timebase = metadata_check.timebase(channels)
    channels, delays_s = metadata_check.align_channels(channels, timebase)
    timebase = plan_timebase(source, plan, channels)
    warnings = metadata_check.warnings
    warnings += _check_duration(source, plan, timebase)
    segments = _segment_ticks(
        source, plan.segments_s, timebase.rate_hz, int(timebase.ticks[-1]) + 1
    )
    si_columns = _si_columns(plan, channels)
    del channels  # frees up to a quarter of a gigabyte
    channel_titles = {field_name: choice.channel for field_name, choice in plan.channels.items()}
    si_columns, status_bits, first_sample = hold_last_values(source, channel_titles, si_columns)
    ticks = timebase.ticks[first_sample:]
    is_after_gap = np.diff(ticks, prepend=-1) > 1
    if timebase.jitter > _JITTER_WARNING_LIMIT:
        warnings.append(
            f"The time stamps lie up to {timebase.jitter:.2g} periods from equidistant ones."
        )
    warnings += _describe_missing_samples(channel_titles, status_bits, first_sample, ticks)
    anomaly_text = torque_anomaly(
        _interpolate_gaps(ticks, si_columns["angle_rad"]),
        _interpolate_gaps(ticks, si_columns["coupling_torque_nm"]),
        timebase.rate_hz,
        plan.specimen,
    )
    warnings += [anomaly_text] if anomaly_text else []
    status_bits[is_after_gap] |= np.uint32(Status.AFTER_LOST)
    start_utc_ns, start_warning = _session_start(source, int(ticks[-1]) / timebase.rate_hz)
    warnings += [start_warning] if start_warning else []
    metadata = _session_metadata(source, target, file_format, plan, timebase.rate_hz)
    for key, field_name in (
        ("angle_delay_s", REQUIRED_FIELDS[0]),
        ("torque_delay_s", REQUIRED_FIELDS[1]),
    ):
        delay_s = delays_s.get(plan.channels[field_name].channel, 0.0)
        metadata[key] = repr(float(metadata[key]) + delay_s)
    if metadata_check.ignored:
        metadata["import_ignored"] = "; ".join(metadata_check.ignored)
    write_session(
        target,
        {**si_columns, "tick": ticks, "status": status_bits},
        timebase.rate_hz,
        start_utc_ns,
        metadata,
        segments,
        warnings,
    )
    return ImportedRecord(target, len(ticks), timebase.rate_hz, segments, tuple(warnings))


_MAX_START_UTC_NS: Final = 2**63 - 1
"""Latest time that a session file can state, in nanoseconds since 1970 (the year 2262)."""


def _session_start(source: Path, duration_s: float) -> tuple[int, str]:
    """Return the file's modification time in ns, or the present time with a warning."""
    modification_ns = source.stat().st_mtime_ns
    if modification_ns >= 0 and modification_ns + duration_s * 1e9 < _MAX_START_UTC_NS:
        return modification_ns, ""
    modification_year = 1970 + modification_ns / (365.2425 * 86_400e9)
    return time.time_ns(), (
        f"By its time stamp the file was changed about the year {modification_year:.0f}, which a "
        "session cannot state; the time of this import is used as the session's start."
    )


def _check_duration(path: Path, plan: ImportPlan, timebase: Timebase) -> list[str]:
    """Raise if the rate is too low for the beam's first mode; warn if the record is very short."""
    beam, time_choice = plan.specimen.beam, plan.time
    first_hz, duration_s = first_mode_hz(beam), (int(timebase.ticks[-1]) + 1) / timebase.rate_hz
    unit_remedy = (
        f"state the unit of '{time_choice.channel}', which was taken to be {time_choice.unit}, "
        f"with --time {time_choice.channel}:UNIT (s, ms, us, ns)"
        if time_choice
        else "state the true rate with --rate-hz"
    )
    if first_hz >= timebase.rate_hz / 2:
        raise ExchangeError(
            f"{path}: the record lasts {duration_s:.6g} s at {timebase.rate_hz:g} Hz, but the "
            f"first mode of this beam is at {first_hz:.3g} Hz, beyond the Nyquist frequency of "
            f"{timebase.rate_hz / 2:g} Hz; {unit_remedy}, or correct the beam in --profile."
        )
    if duration_s * first_hz < 1:
        return [
            f"The record lasts {duration_s:.3g} s at {timebase.rate_hz:g} Hz, less than one period "
            f"of the first mode of this beam, {first_hz:.3g} Hz; if that is wrong, {unit_remedy}."
        ]
    return []


def _si_columns(
    plan: ImportPlan, channels: Mapping[str, SourceChannel]
) -> dict[str, NDArray[np.float64]]:
    """Return the values of each field in SI units, including those that are not finite."""
    si_columns = {}
    with np.errstate(over="ignore"):
        for field_name, choice in plan.channels.items():
            is_reversed = plan.reverse_torque and field_name == "coupling_torque_nm"
            unit_factor = -choice.factor if is_reversed else choice.factor
            si_values = channels[choice.channel].values
            si_columns[field_name] = si_values if unit_factor == 1.0 else si_values * unit_factor
    return si_columns


def _segment_ticks(
    path: Path, segments_s: Mapping[str, tuple[float, float]], rate_hz: float, tick_count: int
) -> dict[str, tuple[int, int]]:
    """Return first and end tick of each segment; raise if a segment is not inside the record."""
    segment_ticks = {}
    for segment_name, (start_s, end_s) in segments_s.items():
        first_tick, end_tick = round(start_s * rate_hz), round(end_s * rate_hz)
        if not 0 <= first_tick < end_tick <= tick_count:
            raise ExchangeError(
                f"{path}: the segment {segment_name} from {start_s:g} to {end_s:g} s is not inside "
                f"the record, which lasts {tick_count / rate_hz:g} s; count from the first sample."
            )
        segment_ticks[segment_name] = (first_tick, end_tick)
    return segment_ticks


def _describe_missing_samples(
    channel_titles: Mapping[str, str],
    status_bits: NDArray[np.uint32],
    omitted_samples: int,
    ticks: NDArray[np.int64],
) -> list[str]:
    """Return sentences on missing samples and on values that are not finite."""
    sentences = []
    if omitted_samples:
        sentences.append(
            f"The first {omitted_samples} samples were left out: angle or torque is not finite "
            "there."
        )
    for stale_flag, channel in (
        (Status.ANGLE_STALE, channel_titles["angle_rad"]),
        (Status.WRENCH_STALE, channel_titles["coupling_torque_nm"]),
    ):
        flagged_count = int(np.count_nonzero(status_bits & stale_flag))
        if flagged_count:
            sentences.append(
                f"{flagged_count} samples of '{channel}' are not finite; they were flagged as "
                "stale."
            )
    tick_steps = np.diff(ticks)
    missing_count = int(tick_steps.sum()) - len(tick_steps)
    if missing_count:
        sentences.append(
            f"{missing_count} samples are missing in {np.count_nonzero(tick_steps > 1)} gaps of "
            f"the time, the longest of {int(tick_steps.max()) - 1}."
        )
    return sentences


def _interpolate_gaps(
    ticks: NDArray[np.int64], known_values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return values at all ticks from the values at known ticks, by interpolation in gaps."""
    if ticks[-1] - ticks[0] + 1 == len(ticks):
        return known_values
    return np.interp(np.arange(ticks[0], ticks[-1] + 1), ticks, known_values)


def _session_metadata(
    source: Path, target: Path, file_format: str, plan: ImportPlan, rate_hz: float
) -> dict[str, str]:
    """Return the metadata of the new session, with name and checksum of its source file."""
    beam = plan.specimen.beam
    rig_numbers = {
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
        stated_number = getattr(plan.specimen, key)
        if stated_number is not None:
            rig_numbers[key] = stated_number
    with source.open("rb") as stream:
        file_digest = hashlib.file_digest(stream, "sha256").hexdigest()
    channel_texts = {
        f"import_{field_name}": str(choice) for field_name, choice in plan.channels.items()
    }
    if plan.reverse_torque:
        channel_texts["import_coupling_torque_nm"] += ", reversed"
    return {
        "id": target.stem,
        **{key: repr(float(number_value)) for key, number_value in rig_numbers.items()},
        **{
            key: stated_text
            for key, stated_text in (
                ("operator", plan.operator),
                ("specimen", plan.specimen_label),
                ("note", plan.note),
            )
            if stated_text
        },
        "software": f"rigd {rigd.__version__}",
        "imported_from": source.name.encode("utf-8", "replace").decode("utf-8"),
        "import_format": file_format,
        "import_sha256": file_digest,
        "import_time": "rate stated" if plan.time is None else str(plan.time),
        **channel_texts,
    }


# Values that are not finite

_STALE_FLAGS: Final = {
    "angle_rad": Status.ANGLE_STALE,
    "coupling_torque_nm": Status.WRENCH_STALE,
}
"""Status flag of a sample in which the last finite value is held, by the field of the value."""


def hold_last_values(
    path: Path, channel_names: Mapping[str, str], si_columns: Mapping[str, NDArray[np.float64]]
) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.uint32], int]:
    """Replace values that are not finite by the last finite value, and flag them as stale.

    `channel_names` has the channel in the file of each field, for messages. Return the fields,
    shape (n - first_sample,), the bits of `rigd.session.layout.Status`, and the number
    `first_sample` of initial samples that are left out because no finite value precedes them. Raise
    ExchangeError if too many values are not finite, or if the field of such a value has no flag.
    """
    bad_by_field = {
        field_name: ~np.isfinite(field_values) for field_name, field_values in si_columns.items()
    }
    for field_name, is_bad in bad_by_field.items():
        bad_count = int(is_bad.sum())
        if bad_count and field_name not in _STALE_FLAGS:
            raise ExchangeError(
                f"{path}: '{channel_names[field_name]}' is not finite in {bad_count} of "
                f"{len(is_bad)} samples, first "
                f"in sample {int(np.argmax(is_bad)) + 1}; repair it, or leave this channel out: no "
                "analysis needs it."
            )
        bad_message = unknown_fraction_message(
            f"'{channel_names[field_name]}'", bad_count, len(is_bad)
        )
        if bad_message:
            raise ExchangeError(
                f"{path}: {bad_message} Or choose another channel, or cut the session out of the "
                "file."
            )
    first_sample = max(int(np.argmin(is_bad)) for is_bad in bad_by_field.values())
    filled_columns = {
        field_name: _hold_last(field_values, bad_by_field[field_name])[first_sample:]
        for field_name, field_values in si_columns.items()
    }
    status_bits = np.zeros(len(next(iter(filled_columns.values()))), dtype=np.uint32)
    for field_name, stale_flag in _STALE_FLAGS.items():
        if field_name in bad_by_field:
            status_bits[bad_by_field[field_name][first_sample:]] |= np.uint32(stale_flag)
    return filled_columns, status_bits, first_sample


def _hold_last(samples: NDArray[np.float64], is_bad: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the values with each bad value replaced by the last good value before it."""
    if not is_bad.any():
        return samples
    last_good_index = np.maximum.accumulate(np.where(is_bad, 0, np.arange(len(samples))))
    return samples[last_good_index]


# Plausibility of the torque

_TORQUE_CHECK_BAND_RATIOS: Final = ((0.25, 0.6), (1.5, 3.5))
"""Frequency bands of the torque check, as multiples of the first natural frequency. They are on
both sides of the first resonance, far enough from it and from the first antiresonance (at 4.4) for
damping not to matter, and above the frequencies at which the paper's external damping torque
exceeds the inertial torque."""

_MIN_SIGNIFICANT_RATIO_STDS: Final = 6.0
"""Smallest ratio of measured to modelled torque that is significant, in standard deviations of the
ratio. It is not significant if the motion does not excite the bands."""

_TAPER_FRACTION: Final = 0.05
"""Fraction of the record that is tapered at each end, as a record may begin and end in motion. It
is short, because the paper's chirp passes the bands early."""

_MAX_PLAUSIBLE_TORQUE_RATIO: Final = 3.0
"""Largest ratio of measured to modelled torque that damping and a wrong mass may explain. Units
that are easily confused differ by a factor of more than ten."""

_MAX_TOOL_TO_BEAM_INERTIA: Final = 5.0
"""Largest tool inertia that the profile may have left out, relative to the moment of inertia of the
beam."""


def torque_anomaly(
    angle_rad: NDArray[np.float64],
    torque_nm: NDArray[np.float64],
    rate_hz: float,
    specimen: SpecimenFile,
) -> str | None:
    """Check sign and size of the torque against the undamped beam near its first resonance.

    Above the resonance, the torque of a tool is opposite to that of the beam. If a tool inertia
    that is not stated explains the torque better, sign and size are those of the beam's part.

    `angle_rad` and `torque_nm` are the whole record, all values finite. Return a sentence with
    anomaly and remedy, or None if the torque is plausible or the motion too small for the check.
    """
    frequency_hz = np.fft.rfftfreq(len(angle_rad), 1 / rate_hz)
    first_mode_hz = undamped_frequencies_rad_s(specimen.beam, 1)[0] / (2 * np.pi)
    in_band = np.zeros(frequency_hz.shape, dtype=np.bool_)
    for low_ratio, high_ratio in _TORQUE_CHECK_BAND_RATIOS:
        in_band |= (frequency_hz >= low_ratio * first_mode_hz) & (
            frequency_hz <= high_ratio * first_mode_hz
        )
    s = 2j * np.pi * frequency_hz[in_band]
    centre_distance = np.abs(
        np.linspace(-1.0, 1.0, len(angle_rad))
    )  # 0 in the middle, 1 at either end
    taper = np.sin(np.pi / 2 * np.minimum((1 - centre_distance) / (2 * _TAPER_FRACTION), 1)) ** 2
    with np.errstate(over="ignore", invalid="ignore"):
        angle_spectrum, torque_spectrum = (
            np.fft.rfft(taper * (channel_values - channel_values.mean()))[in_band]
            for channel_values in (angle_rad, torque_nm)
        )
        inertia_spectrum = s**2 * angle_spectrum
        model_spectrum = (
            transfer(s, specimen.beam, Damping()) * angle_spectrum
            + specimen.tool_inertia_kg_m2 * inertia_spectrum
        )
        model_spectrum = _add_unstated_tool(
            model_spectrum, specimen.beam.inertia_kg_m2 * inertia_spectrum, torque_spectrum
        )
        model_power, torque_power = (
            float(np.vdot(spectrum, spectrum).real)
            for spectrum in (model_spectrum, torque_spectrum)
        )
        if not (0.0 < model_power < np.inf and 0.0 < torque_power < np.inf):
            return None
        torque_ratio = complex(np.vdot(model_spectrum, torque_spectrum) / model_power)
    ratio_magnitude = abs(torque_ratio)
    explained_power = ratio_magnitude**2 * model_power
    noise_power_per_bin = max(torque_power - explained_power, 0.0) / np.count_nonzero(in_band)
    if explained_power < _MIN_SIGNIFICANT_RATIO_STDS**2 * noise_power_per_bin:
        return None
    if not 1 / _MAX_PLAUSIBLE_TORQUE_RATIO < ratio_magnitude < _MAX_PLAUSIBLE_TORQUE_RATIO:
        return (
            f"The torque is {ratio_magnitude:.3g} times that of this beam: check the units of "
            "angle and torque, and the beam's length and density."
        )
    if torque_ratio.real < 0.0:
        return (
            "The torque has the opposite sign to that of this beam: import a sensor that measures "
            "the reaction with --reverse-torque."
        )
    return None


def _add_unstated_tool(
    model_spectrum: NDArray[np.complex128],
    rigid_spectrum: NDArray[np.complex128],
    torque_spectrum: NDArray[np.complex128],
) -> NDArray[np.complex128]:
    """Return the modelled torque, with a tool inertia that is not stated if this fits much better.

    All arrays have shape (k,): modelled torque, torque of a rigid body with the moment of inertia
    of the beam, and measured torque.
    """
    columns = np.stack([model_spectrum, rigid_spectrum], axis=1)
    column_parts, torque_parts = (
        np.concatenate([spectrum.real, spectrum.imag]) for spectrum in (columns, torque_spectrum)
    )
    if not (np.isfinite(column_parts).all() and np.isfinite(torque_parts).all()):
        return model_spectrum
    misfits, fitted_gains = [], []
    for column_count in (1, 2):
        used_columns = column_parts[:, :column_count]
        gains = np.linalg.lstsq(used_columns, torque_parts)[0]
        misfits.append(float(np.linalg.norm(torque_parts - used_columns @ gains)))
        fitted_gains.append(gains)
    beam_gain, rigid_gain = map(float, fitted_gains[1])
    is_tool_inertia = (
        rigid_gain * beam_gain > 0
        and abs(rigid_gain) < _MAX_TOOL_TO_BEAM_INERTIA * abs(beam_gain)
        and misfits[1] < misfits[0] / 2
    )
    if not is_tool_inertia:
        return model_spectrum
    return model_spectrum + rigid_gain / beam_gain * rigid_spectrum


# Session file

_BLOCK_SAMPLES: Final = 25_000
"""Number of samples that are encoded at a time."""


def write_session(
    path: Path,
    samples: Mapping[str, NDArray[np.generic]],
    rate_hz: float,
    start_utc_ns: int,
    metadata: Mapping[str, str],
    segments: Mapping[str, tuple[int, int]],
    warnings: Sequence[str],
) -> None:
    """Write a record of another program as a session file.

    The outcome in the file has only the numbers of samples, because it is not known why the record
    ended. If writing fails, no file remains.

    Parameters
    ----------
    path : Path
        Path of the new file, which must not exist.
    samples : mapping of str to ndarray, shape (n,)
        Fields of the samples, including ``tick``; absent fields are 0.
    rate_hz, start_utc_ns, metadata, segments
        Sampling rate, start, metadata and segments as in docs/session_format.md.
    warnings : sequence of str
        Warnings, which become events of the session.

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
        for first_row in range(0, len(ticks), _BLOCK_SAMPLES):
            row_slice = slice(first_row, first_row + _BLOCK_SAMPLES)
            sample_block = {
                field_name: column_values[row_slice]
                for field_name, column_values in samples.items()
            }
            sample_block["t_ns"] = np.rint(np.multiply(sample_block["tick"], 1e9 / rate_hz))
            writer.write_samples(encode_samples(sample_block))
        scheduled_ticks = int(ticks[-1]) + 1
        sample_counts = {"scheduled": scheduled_ticks, "recorded": len(ticks), "missed": 0}
        sample_counts["lost"] = scheduled_ticks - len(ticks)
        writer.close(
            {count_name: str(row_count) for count_name, row_count in sample_counts.items()}
        )
    except BaseException:
        # The source still exists, so an incomplete copy of it is useless.
        try:
            writer.abandon()
        finally:
            writer.part.unlink(missing_ok=True)
        raise
