"""Comparison of a file's statements (units, rate, times, starts, scales) with the user's.

A contradiction is refused, with both statements. `ImportPlan.ignore_file_metadata` lets the user's
count; then it is a warning, and the session's metadata have it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.exchange._channels import (
    MAX_JITTER,
    canonical_unit,
    from_time_stamps,
    uniform,
    unit_in_brackets,
    unit_in_suffix,
)
from analysis.exchange._source import ExchangeError, check_lengths
from rigd.printable import printable

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from analysis.exchange._channels import Timebase
    from analysis.exchange._import_record import ImportPlan
    from analysis.exchange._source import FileTimes, SourceChannel

IGNORE_OPTION: Final = "--ignore-file-metadata"

_RATE_TOLERANCE: Final = 2e-5
"""Largest relative difference between the rate stated and the file's own, of which UFF58 has six
digits."""

_COARSE_TOLERANCE: Final = 1e-3
"""The same for times that are no time base by themselves, having too few digits for it."""

_DEFAULT_RATE_HZ: Final = 1.0
"""Rate that LabVIEW and others write where none was given."""

_UNITS_OF_TIME_S: Final = (1.0, 1e-3, 1e-6, 1e-9)
_THOUSANDS: Final = (1e3, 1e6, 1e9)

_NO_UNIT: Final = ("", "NONE", "none", "-")

_JITTER_SHOWN: Final = 0.01
"""Shift between channels, in periods, below which it is not worth a warning."""


def time_samples(path: Path, plan: ImportPlan, channels: Mapping[str, SourceChannel]) -> Timebase:
    """Return the time base, by the channel of times or by the rate stated."""
    if plan.time is not None:
        time_s = channels[plan.time.channel].values * plan.time.factor
        return from_time_stamps(path, plan.time.channel, time_s)
    samples = len(next(iter(channels.values())).values)
    return uniform(path, samples, plan.rate_hz or 0.0)


@dataclass(slots=True)
class FileStatements:
    """Comparison of a file with a plan.

    Attributes
    ----------
    path : Path
    plan : ImportPlan
    warnings : list of str
        Sentences for the user.
    ignored : list of str
        Statements of the file that the plan overrides.
    """

    path: Path
    plan: ImportPlan
    warnings: list[str] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)

    def contradict(self, statement: str, remedy: str) -> None:
        """Raise if a file contradicts the plan, or note that the plan overrides it."""
        if not self.plan.ignore_file_metadata:
            raise ExchangeError(
                f"{self.path}: {statement}; {remedy}, or let your options count with "
                f"{IGNORE_OPTION}."
            )
        self.ignored.append(statement)
        self.warnings.append(f"Ignored as requested: {statement}.")

    def check_units(self, channels: Mapping[str, SourceChannel]) -> None:
        """Compare the units stated with those that the file has for its channels.

        Raises
        ------
        ExchangeError
            If the file clearly states another unit.
        """
        for choice in self.plan.choices:
            label = channels[choice.channel].unit_label.strip()
            stated_unit = canonical_unit(label) if label else unit_in_brackets(choice.channel)
            if stated_unit is not None and stated_unit != choice.unit:
                self.contradict(
                    f"the file says that '{choice.channel}' is in {stated_unit}, and {choice.unit} "
                    "was stated",
                    f"state '{choice.channel}:{stated_unit}', or correct the file",
                )
            if stated_unit is None and label not in _NO_UNIT:
                self.warnings.append(
                    f"The file states '{printable(label, 20)}' for '{choice.channel}'; "
                    f"{choice.unit} was used as stated."
                )
            suffix = unit_in_suffix(choice.channel)
            if stated_unit is None and suffix not in (None, choice.unit):
                self.warnings.append(
                    f"The name '{choice.channel}' suggests {suffix}; {choice.unit} was used as "
                    "stated."
                )

    def check_scales(self, channels: Mapping[str, SourceChannel]) -> None:
        """Raise if a scale of the file could not be applied to the values."""
        for name, channel in channels.items():
            if channel.unapplied_scale:
                self.contradict(
                    f"the values of '{name}' are raw, and the file asks for a scale that is not "
                    f"known here ({printable(channel.unapplied_scale, 60)})",
                    "export scaled values",
                )

    def timebase(self, channels: Mapping[str, SourceChannel]) -> Timebase:
        """Return the time base; compare it with the rate and the times of the file.

        Raises
        ------
        ExchangeError
            If the times are not a time base, or the file has another rate than was stated.
        """
        time = self.plan.time
        found = time_samples(self.path, self.plan, channels)
        for name, channel in channels.items():
            own_hz = channel.rate_hz
            if own_hz is not None and abs(own_hz / found.rate_hz - 1) > _RATE_TOLERANCE:
                self._another_rate(name, own_hz, found.rate_hz)
        times = {c.times.name: c.times for c in channels.values() if c.times is not None}
        if time is None:
            for each in times.values():
                self._check_times(each, found.rate_hz)
        return found

    def _another_rate(self, name: str, own_hz: float, rate_hz: float) -> None:
        """Handle a rate of the file that is not the one used."""
        time = self.plan.time
        statement = f"the file says that '{name}' was sampled at {own_hz:.6g} Hz"
        is_default = own_hz == _DEFAULT_RATE_HZ
        ratio = max(own_hz / rate_hz, rate_hz / own_hz)
        wrong_unit = any(abs(ratio / each - 1) < _RATE_TOLERANCE for each in _THOUSANDS)
        if is_default:
            statement += ", which programs write where no rate was given"
        if time is not None and (time.channel == name or is_default or not wrong_unit):
            self.warnings.append(
                f"T{statement[1:]}; {rate_hz:.6g} Hz was used, as the times in '{time.channel}' "
                "show."
            )
        elif time is not None:
            self.contradict(
                f"{statement}, and the times in '{time.channel}' as {time.unit} show "
                f"{rate_hz:.6g} Hz",
                f"state the unit of '{time.channel}' (s, ms, us, ns)",
            )
        else:
            self.contradict(
                f"{statement}, and {rate_hz:.6g} Hz was stated",
                "give the channel of times with --time"
                if is_default
                else f"state --rate-hz {own_hz:.6g}, or give the channel of times with --time",
            )

    def _check_times(self, times: FileTimes, rate_hz: float) -> None:
        """Compare the rate stated with times that the file has."""
        values = times.values[np.isfinite(times.values)]
        if len(values) < 2:
            return
        if len(values) < len(times.values):
            row_number = int(np.argmin(np.isfinite(times.values))) + 1
            self.contradict(
                f"the times '{printable(times.name, 60)}' are missing from sample {row_number} on, "
                f"in {len(times.values) - len(values)} samples, so that these may be none",
                "repair or remove their lines",
            )
            return
        units_s = _UNITS_OF_TIME_S if times.unit_s is None else (times.unit_s,)
        steps = np.diff(values)
        name = f"'{printable(times.name, 60)}'"
        if (steps < 0.0).any():
            row_number = int(np.argmax(steps < 0.0)) + 2
            if (steps < 0.0).all():
                return  # it runs backwards, as an index or a countdown may
            self.contradict(
                f"the times {name} go back at sample {row_number}, so that another record begins "
                "there",
                "cut one record out of the file",
            )
            return
        usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
        if (steps == 0.0).any() and any(
            abs(rate_hz * usual * unit_s - 1) < _COARSE_TOLERANCE for unit_s in units_s
        ):
            self.contradict(
                f"the time {name} of sample {int(np.argmax(steps == 0.0)) + 2} is that of the one "
                "before it",
                "remove what is stated twice",
            )
            return
        step = float(values[-1] - values[0]) / (len(values) - 1)
        if step == 0.0 or (times.name == "#1" and step == 1.0):
            return  # no times, or the numbers of the samples
        unit_s = min(units_s, key=lambda unit: abs(np.log(rate_hz * step * unit)))
        tolerance = _COARSE_TOLERANCE + 2 * usual / float(values[-1] - values[0])
        missing = 0
        own_hz = 1 / (step * unit_s)
        try:
            base = from_time_stamps(self.path, times.name, values * unit_s)
        except ExchangeError:
            pass
        else:
            own_hz, missing = base.rate_hz, base.missing
            tolerance = _RATE_TOLERANCE + 2 * base.jitter / len(values)
        if missing:
            self.contradict(
                f"the times {name} have gaps of {missing} samples in all, and a record without "
                "gaps was stated",
                f"give --time '{times.name}:UNIT' instead of --rate-hz",
            )
        elif abs(own_hz / rate_hz - 1) > tolerance:
            self.contradict(
                f"the times {name} show {own_hz:.6g} Hz, and {rate_hz:.6g} Hz was stated",
                f"give --time '{times.name}:UNIT' instead of --rate-hz",
            )

    def align(
        self, channels: Mapping[str, SourceChannel], base: Timebase
    ) -> tuple[Mapping[str, SourceChannel], Mapping[str, float]]:
        """Trim channels that begin at different times to their common interval.

        Returns
        -------
        channels : mapping of str to SourceChannel
            Channels of one length.
        delays_s : mapping of str to float
            Channel → age of its values relative to those of the angle at the same index: the
            remainder after whole samples.

        Raises
        ------
        ExchangeError
            If the channels have no common time, or different lengths without a reason.
        """
        time, plan = self.plan.time, self.plan
        starts = {n: c.start_ns for n, c in channels.items() if c.start_ns is not None}
        measured = {choice.channel for choice in plan.channels.values()}
        if len(set(starts.values())) < 2:
            unknown = sorted(measured - set(starts))
            start_ns = next(iter(starts.values()), 0)
            if unknown and start_ns and abs(start_ns) < _ABSOLUTE_NS:
                self.contradict(
                    f"the file says that '{next(iter(starts))}' begins at {_instant(start_ns)}, "
                    f"and does not say when '{unknown[0]}' begins",
                    "give channels that begin together, or cut them to the same samples",
                )
            elif starts and unknown:
                self.warnings.append(
                    f"The file states when '{next(iter(starts))}' begins, but not "
                    f"'{unknown[0]}'; they were taken to begin together."
                )
            check_lengths(self.path, channels)
            return channels, {}
        first, last = min(starts, key=starts.__getitem__), max(starts, key=starts.__getitem__)
        statement = (
            f"the file says that '{first}' begins at {_instant(starts[first])} and '{last}' at "
            f"{_instant(starts[last])}"
        )
        if plan.ignore_file_metadata:
            self.contradict(statement, "")
            check_lengths(self.path, channels)
            return channels, {}
        cut = "give channels that begin together, or cut them to the same samples"
        absent = sorted(set(channels) - set(starts))
        if absent:
            self.contradict(f"{statement}, and does not say when '{absent[0]}' begins", cut)
        if base.missing:
            self.contradict(f"{statement}, and the times have gaps", cut)
        period_ns = 1e9 / base.rate_hz
        skips = {n: round((starts[last] - start) / period_ns) for n, start in starts.items()}
        common = min(len(channel.values) - skips[n] for n, channel in channels.items())
        if common < 2:
            self.contradict(f"{statement}, so that they have no time in common", cut)
        angle = plan.channels["angle_rad"].channel
        delays_s = {
            n: (starts[angle] - starts[n] + (skips[angle] - skips[n]) * period_ns) / 1e9
            for n in channels
        }
        self._note_shift(statement, skips, delays_s, base.rate_hz)
        found = {
            n: replace(channel, values=channel.values[skips[n] : skips[n] + common])
            for n, channel in channels.items()
        }
        if time is not None and len(set(skips.values())) > 1:
            self.warnings.append(f"The times in '{time.channel}' were cut like the channels.")
        return found, delays_s

    def _note_shift(
        self,
        statement: str,
        skips: Mapping[str, int],
        delays_s: Mapping[str, float],
        rate_hz: float,
    ) -> None:
        stored = {self.plan.channels[name].channel for name in ("angle_rad", "coupling_torque_nm")}
        for name, delay_s in delays_s.items():
            rest = abs(delay_s) * rate_hz
            is_time = self.plan.time is not None and name == self.plan.time.channel
            if rest > MAX_JITTER and name not in stored and not is_time:
                self.contradict(
                    f"{statement}, and '{name}' lies {rest:.2g} periods between the samples of the "
                    "angle",
                    "leave this channel out: no analysis needs it",
                )
        shifted = ", ".join(f"{skip} of '{name}'" for name, skip in skips.items() if skip)
        rest_text = ", ".join(
            f"{delay_s:.6g} s of '{name}'"
            for name, delay_s in delays_s.items()
            if abs(delay_s) * rate_hz > _JITTER_SHOWN and name in stored
        )
        self.warnings.append(
            f"T{statement[1:]}."
            + (f" Samples left out at the beginning: {shifted}." if shifted else "")
            + (f" Delay added: {rest_text}." if rest_text else "")
        )


_ABSOLUTE_NS: Final = 10**17
"""Times from 1973 on are taken for instants, smaller ones for times of a record."""


def _instant(time_ns: int) -> str:
    """Return a time as messages have it."""
    if abs(time_ns) < _ABSOLUTE_NS:
        return f"{time_ns / 1e9:.9g} s"
    return str(np.datetime64(time_ns, "ns")).rstrip("0").rstrip(".")
