"""Comparison of what a file states (units, rate, times, starts, scales) with the import plan.

A contradiction raises an error that quotes both statements. With `ImportPlan.ignore_file_metadata`
the user's statement is used, and the contradiction becomes a warning and part of the session's
metadata.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.exchange._channels import (
    MAX_JITTER_PERIODS,
    canonical_unit,
    is_same_unit,
    timebase_from_stamps,
    timebase_of_rounded_stamps,
    uniform_timebase,
    unit_in_suffix,
)
from analysis.exchange._source import ExchangeError, check_lengths
from rigd.printable import printable
from rigd.text_table.titles import bare_unit, is_unit, unit_in_brackets

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from analysis.exchange._channels import Timebase
    from analysis.exchange._import_plan import ImportPlan
    from analysis.exchange._source import FileTimes, SourceChannel

IGNORE_OPTION: Final = "--ignore-file-metadata"
"""Option by which the user's statements override the file's."""

_RATE_TOLERANCE: Final = 2e-5
"""Largest relative difference between the file's rate and the user's that is no contradiction;
UFF58 files state six digits."""

_COARSE_RATE_TOLERANCE: Final = 1e-3
"""Largest relative difference that is no contradiction between the user's rate and that of times
with too few digits for a time base."""

_UNSET_RATE_HZ: Final = 1.0
"""Sampling rate that LabVIEW and other programs write if the user has given them none."""

_TIME_UNITS_S: Final = (1.0, 1e-3, 1e-6, 1e-9)
"""Units in seconds that times without a stated unit may have."""
_WRONG_UNIT_RATE_RATIOS: Final = (1e3, 1e6, 1e9)
"""Ratios between two rates that indicate a wrong unit of time."""

_NO_UNIT_TEXTS: Final = ("", "NONE", "none", "-")
"""Texts by which files state that a channel has no unit."""

_MIN_REPORTED_SHIFT_PERIODS: Final = 0.01
"""Smallest time shift between channels that is reported, in sample periods."""


def plan_timebase(path: Path, plan: ImportPlan, channels: Mapping[str, SourceChannel]) -> Timebase:
    """Return the time base of a record, from its channel of times or from the stated rate."""
    if plan.time is not None:
        time_s = channels[plan.time.channel].values * plan.time.factor
        return timebase_from_stamps(path, plan.time.channel, time_s)
    sample_count = len(next(iter(channels.values())).values)
    return uniform_timebase(path, sample_count, plan.rate_hz or 0.0)


@dataclass(slots=True)
class FileMetadataCheck:
    """Comparison of the statements of a file with an import plan.

    Attributes
    ----------
    path : Path
        Path of the file.
    plan : ImportPlan
        The user's statements.
    warnings : list of str
        Warnings for the user.
    ignored : list of str
        Statements of the file that the plan overrides.
    """

    path: Path
    plan: ImportPlan
    warnings: list[str] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)

    def report_contradiction(self, statement: str, remedy: str) -> None:
        """Raise an error for a contradiction, or record that the plan overrides the file."""
        if not self.plan.ignore_file_metadata:
            raise ExchangeError(
                f"{self.path}: {statement}; {remedy}, or let your options override the file with "
                f"{IGNORE_OPTION}."
            )
        self.ignored.append(statement)
        self.warnings.append(f"Ignored as requested: {statement}.")

    def check_units(self, channels: Mapping[str, SourceChannel]) -> None:
        """Compare the units stated by the user with those in the file.

        Raise `ExchangeError` if the file states another unit than the user, and the plan does not
        override it.
        """
        for choice in self.plan.channel_choices:
            channel = channels[choice.channel]
            channel_title = channel.title or choice.channel
            unit_label = bare_unit(channel.unit_label) or unit_in_brackets(channel_title)
            stated_unit = canonical_unit(unit_label)
            has_number = " " in choice.unit
            chosen_unit = choice.unit.removeprefix("1.0 ")
            if stated_unit not in (None, chosen_unit):
                self.report_contradiction(
                    f"the file says that '{choice.channel}' is in {stated_unit}, and {choice.unit} "
                    "was stated",
                    f"state '{choice.channel}:{stated_unit}', or correct the file",
                )
            elif stated_unit is None and unit_label not in _NO_UNIT_TEXTS:
                shown_label = printable(unit_label, 20)
                if is_unit(unit_label) and not (
                    has_number or is_same_unit(unit_label, choice.unit)
                ):
                    self.report_contradiction(
                        f"the file says that '{choice.channel}' is in {shown_label}, and "
                        f"{choice.unit} was stated",
                        f"state the value of one {shown_label} in {choice.unit}, as a number and a "
                        f"unit, such as '{choice.channel}:0.02 {choice.unit}'",
                    )
                self.warnings.append(
                    f"The file states '{shown_label}' for '{choice.channel}'; "
                    f"{choice.unit} was used as stated."
                )
            suffix_unit = unit_in_suffix(channel_title)
            if stated_unit is None and suffix_unit not in (None, chosen_unit):
                self.warnings.append(
                    f"The name '{printable(channel_title, 60)}' suggests {suffix_unit}; "
                    f"{choice.unit} was used as stated."
                )

    def check_scales(self, channels: Mapping[str, SourceChannel]) -> None:
        """Report a contradiction if the file states a scale that could not be applied."""
        for name, channel in channels.items():
            if channel.unapplied_scale:
                self.report_contradiction(
                    f"the values of '{name}' are raw, and the file asks for a scale that is not "
                    f"known here ({printable(channel.unapplied_scale, 60)})",
                    "export scaled values",
                )

    def timebase(self, channels: Mapping[str, SourceChannel]) -> Timebase:
        """Return the time base after comparing it with the rate and the times that the file states.

        Raise `ExchangeError` if the times give no uniform time base, or the file states another
        rate than the user.
        """
        time_choice = self.plan.time
        timebase = plan_timebase(self.path, self.plan, channels)
        for name, channel in channels.items():
            file_rate_hz = channel.rate_hz
            if (
                file_rate_hz is not None
                and abs(file_rate_hz / timebase.rate_hz - 1) > _RATE_TOLERANCE
            ):
                self._report_rate_difference(name, file_rate_hz, timebase.rate_hz)
        times_by_name = {c.times.name: c.times for c in channels.values() if c.times is not None}
        if time_choice is None:
            for file_times in times_by_name.values():
                self._check_times(file_times, timebase.rate_hz)
        return timebase

    def _report_rate_difference(
        self, source_name: str, file_rate_hz: float, rate_hz: float
    ) -> None:
        """Report that the file states another rate than the one used, as a warning or an error."""
        time_choice = self.plan.time
        statement = f"the file says that '{source_name}' was sampled at {file_rate_hz:.6g} Hz"
        is_unset_rate = file_rate_hz == _UNSET_RATE_HZ
        rate_ratio = max(file_rate_hz / rate_hz, rate_hz / file_rate_hz)
        is_wrong_unit = any(
            abs(rate_ratio / unit_ratio - 1) < _RATE_TOLERANCE
            for unit_ratio in _WRONG_UNIT_RATE_RATIOS
        )
        if is_unset_rate:
            statement += ", which programs write where no rate was given"
        if time_choice is not None and (
            time_choice.channel == source_name or is_unset_rate or not is_wrong_unit
        ):
            self.warnings.append(
                f"T{statement[1:]}; {rate_hz:.6g} Hz was used, as the times in "
                f"'{time_choice.channel}' show."
            )
        elif time_choice is not None:
            self.report_contradiction(
                f"{statement}, and the times in '{time_choice.channel}' as {time_choice.unit} show "
                f"{rate_hz:.6g} Hz",
                f"state the unit of '{time_choice.channel}' (s, ms, us, ns)",
            )
        else:
            self.report_contradiction(
                f"{statement}, and {rate_hz:.6g} Hz was stated",
                "give the channel of times with --time"
                if is_unset_rate
                else f"state --rate-hz {file_rate_hz:.6g}, or give the channel of times with "
                "--time",
            )

    def _check_times(self, file_times: FileTimes, rate_hz: float) -> None:
        """Compare the rate stated by the user with the times in the file."""
        finite_times = file_times.values[np.isfinite(file_times.values)]
        if len(finite_times) < 2:
            return
        if len(finite_times) < len(file_times.values):
            row_number = int(np.argmin(np.isfinite(file_times.values))) + 1
            self.report_contradiction(
                f"the times '{printable(file_times.name, 60)}' are missing from sample "
                f"{row_number} on, in {len(file_times.values) - len(finite_times)} samples, so "
                "these may not be samples",
                "repair or remove their lines",
            )
            return
        units_s = _TIME_UNITS_S if file_times.unit_s is None else (file_times.unit_s,)
        time_steps = np.diff(finite_times)
        times_name = f"'{printable(file_times.name, 60)}'"
        if (time_steps < 0.0).any():
            row_number = int(np.argmax(time_steps < 0.0)) + 2
            if (time_steps < 0.0).all():
                return  # decreasing values are no times, but an index or a countdown
            self.report_contradiction(
                f"the times {times_name} go back at sample {row_number}, so that another record "
                "begins there",
                "cut one record out of the file",
            )
            return
        typical_step = (
            float(np.median(time_steps[time_steps > 0.0])) if (time_steps > 0.0).any() else 0.0
        )
        if (time_steps == 0.0).any() and any(
            abs(rate_hz * typical_step * unit_s - 1) < _COARSE_RATE_TOLERANCE for unit_s in units_s
        ):
            self.report_contradiction(
                f"the time {times_name} of sample {int(np.argmax(time_steps == 0.0)) + 2} is that "
                "of the one before it",
                "remove what is stated twice",
            )
            return
        mean_step = float(finite_times[-1] - finite_times[0]) / (len(finite_times) - 1)
        if mean_step == 0.0 or (file_times.name == "#1" and mean_step == 1.0):
            return  # the values are constant or sample numbers
        best_unit_s = min(units_s, key=lambda unit_s: abs(np.log(rate_hz * mean_step * unit_s)))
        rate_tolerance = _COARSE_RATE_TOLERANCE + 2 * typical_step / float(
            finite_times[-1] - finite_times[0]
        )
        missing_ticks = 0
        file_rate_hz = 1 / (mean_step * best_unit_s)
        try:
            times_s = finite_times * best_unit_s
            has_repetitions = bool((time_steps == 0.0).any())
            file_timebase = (
                None if has_repetitions else timebase_of_rounded_stamps(times_s)
            ) or timebase_from_stamps(self.path, file_times.name, times_s)
        except ExchangeError:
            pass
        else:
            file_rate_hz, missing_ticks = file_timebase.rate_hz, file_timebase.missing_ticks
            rate_tolerance = _RATE_TOLERANCE + 2 * file_timebase.jitter / len(finite_times)
        if missing_ticks:
            self.report_contradiction(
                f"the times {times_name} have gaps of {missing_ticks} samples in all, and a record "
                "without gaps was stated",
                f"give --time '{file_times.name}:UNIT' instead of --rate-hz",
            )
        elif abs(file_rate_hz / rate_hz - 1) > rate_tolerance:
            self.report_contradiction(
                f"the times {times_name} show {file_rate_hz:.6g} Hz, and {rate_hz:.6g} Hz was "
                "stated",
                f"give --time '{file_times.name}:UNIT' instead of --rate-hz",
            )

    def align_channels(
        self, channels: Mapping[str, SourceChannel], timebase: Timebase
    ) -> tuple[Mapping[str, SourceChannel], Mapping[str, float]]:
        """Cut channels that begin at different times to their common interval.

        The channels returned have equal length. Return also the time in seconds by which each
        channel's values are older than the angle of the same index: the fraction of a sample period
        that remains after cutting whole samples. Raise `ExchangeError` if the channels have no
        common interval, or different lengths but the same start.
        """
        time_choice, plan = self.plan.time, self.plan
        starts_ns = {n: c.start_ns for n, c in channels.items() if c.start_ns is not None}
        measured_channels = {choice.channel for choice in plan.channels.values()}
        if len(set(starts_ns.values())) < 2:
            unknown_starts = sorted(measured_channels - set(starts_ns))
            start_ns = next(iter(starts_ns.values()), 0)
            if unknown_starts and start_ns and abs(start_ns) < _MIN_DATE_NS:
                self.report_contradiction(
                    f"the file says that '{next(iter(starts_ns))}' begins at "
                    f"{_time_text(start_ns)}, and does not say when '{unknown_starts[0]}' begins",
                    "give channels that begin together, or cut them to the same samples",
                )
            elif starts_ns and unknown_starts:
                self.warnings.append(
                    f"The file states when '{next(iter(starts_ns))}' begins, but not "
                    f"'{unknown_starts[0]}'; they were taken to begin together."
                )
            check_lengths(self.path, channels)
            return channels, {}
        first_channel, last_channel = (
            min(starts_ns, key=starts_ns.__getitem__),
            max(starts_ns, key=starts_ns.__getitem__),
        )
        statement = (
            f"the file says that '{first_channel}' begins at "
            f"{_time_text(starts_ns[first_channel])} and '{last_channel}' at "
            f"{_time_text(starts_ns[last_channel])}"
        )
        if plan.ignore_file_metadata:
            self.report_contradiction(statement, "")
            check_lengths(self.path, channels)
            return channels, {}
        alignment_remedy = "give channels that begin together, or cut them to the same samples"
        channels_without_start = sorted(set(channels) - set(starts_ns))
        if channels_without_start:
            self.report_contradiction(
                f"{statement}, and does not say when '{channels_without_start[0]}' begins",
                alignment_remedy,
            )
        if timebase.missing_ticks:
            self.report_contradiction(f"{statement}, and the times have gaps", alignment_remedy)
        period_ns = 1e9 / timebase.rate_hz
        skipped_samples = {
            n: round((starts_ns[last_channel] - channel_start_ns) / period_ns)
            for n, channel_start_ns in starts_ns.items()
        }
        common_sample_count = min(
            len(channel.values) - skipped_samples[n] for n, channel in channels.items()
        )
        if common_sample_count < 2:
            self.report_contradiction(
                f"{statement}, so that they have no time in common", alignment_remedy
            )
        angle_channel = plan.channels["angle_rad"].channel
        delays_s = {
            n: (
                starts_ns[angle_channel]
                - starts_ns[n]
                + (skipped_samples[angle_channel] - skipped_samples[n]) * period_ns
            )
            / 1e9
            for n in channels
        }
        self._report_shift(statement, skipped_samples, delays_s, timebase.rate_hz)
        aligned_channels = {
            n: replace(
                channel,
                values=channel.values[
                    skipped_samples[n] : skipped_samples[n] + common_sample_count
                ],
            )
            for n, channel in channels.items()
        }
        if time_choice is not None and len(set(skipped_samples.values())) > 1:
            self.warnings.append(
                f"The times in '{time_choice.channel}' were cut like the channels."
            )
        return aligned_channels, delays_s

    def _report_shift(
        self,
        statement: str,
        skipped_samples: Mapping[str, int],
        delays_s: Mapping[str, float],
        rate_hz: float,
    ) -> None:
        """Warn of cut samples and of added delays; raise if a delay cannot be stored."""
        channels_with_delay = {
            self.plan.channels[name].channel for name in ("angle_rad", "coupling_torque_nm")
        }
        for name, delay_s in delays_s.items():
            shift_periods = abs(delay_s) * rate_hz
            is_time_channel = self.plan.time is not None and name == self.plan.time.channel
            if (
                shift_periods > MAX_JITTER_PERIODS
                and name not in channels_with_delay
                and not is_time_channel
            ):
                self.report_contradiction(
                    f"{statement}, and '{name}' lies {shift_periods:.2g} periods between the "
                    "samples of the angle",
                    "leave this channel out: no analysis needs it",
                )
        skips_text = ", ".join(
            f"{skip_count} of '{name}'"
            for name, skip_count in skipped_samples.items()
            if skip_count
        )
        delays_text = ", ".join(
            f"{delay_s:.6g} s of '{name}'"
            for name, delay_s in delays_s.items()
            if abs(delay_s) * rate_hz > _MIN_REPORTED_SHIFT_PERIODS and name in channels_with_delay
        )
        self.warnings.append(
            f"T{statement[1:]}."
            + (f" Samples left out at the beginning: {skips_text}." if skips_text else "")
            + (f" Delay added: {delays_text}." if delays_text else "")
        )


_MIN_DATE_NS: Final = 10**17
"""Smallest time in ns that is a date (from 1973 on); smaller ones are relative to the record."""


def _time_text(time_ns: int) -> str:
    """Format a start time in nanoseconds: as a date if it counts from 1970, else in seconds.

    Times below `_EARLIEST_DATE_NS` are offsets, which do not count from 1970.
    """
    if abs(time_ns) < _MIN_DATE_NS:
        return f"{time_ns / 1e9:.9g} s"
    return str(np.datetime64(time_ns, "ns")).rstrip("0").rstrip(".")
