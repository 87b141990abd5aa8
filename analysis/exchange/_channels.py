"""Channels of a third-party file: their fields in a session, units, and time base."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.exchange._source import ExchangeError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray


# Units

_INCH_M: Final = 0.0254
"""Length of an inch in metres."""
_POUND_N: Final = 4.4482216152605
"""Pound-force in newtons."""

UNIT_SIZES: Final[Mapping[str, Mapping[str, float]]] = MappingProxyType(
    {
        "angle": {
            "rad": 1.0,
            "mrad": 1e-3,
            "urad": 1e-6,
            "deg": math.pi / 180,
            "arcmin": math.pi / 10_800,
            "arcsec": math.pi / 648_000,
            "rev": 2 * math.pi,
        },
        "torque": {
            "N.m": 1.0,
            "mN.m": 1e-3,
            "uN.m": 1e-6,
            "N.cm": 1e-2,
            "N.mm": 1e-3,
            "kN.m": 1e3,
            "lbf.in": _POUND_N * _INCH_M,
            "ozf.in": _POUND_N * _INCH_M / 16,
        },
        "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3, "lbf": _POUND_N},
        "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    }
)
"""Size of each unit in rad, N·m, N or s, by the quantity it measures."""

_UNITS_BY_NAME_SUFFIX: Final = {
    "rad": "rad",
    "mrad": "mrad",
    "deg": "deg",
    "urad": "urad",
    "nm": "N.m",  # as in the fields of a session file
    "mnm": "mN.m",
    "unm": "uN.m",
    "ncm": "N.cm",
    "nmm": "N.mm",
    "knm": "kN.m",
    "n": "N",
    "mn": "mN",
    "kn": "kN",
    "s": "s",
    "ms": "ms",
    "us": "us",
    "ns": "ns",
}
"""Unit that the last word of a channel's name suggests."""

_LEADING_NUMBER_PATTERN: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?(?=\s*[^\s\d.])")
"""Pattern of a number that is followed by a unit."""


def canonical_unit(unit_text: str) -> str | None:
    """Return a unit as spelled in `UNIT_SIZES`, or None if it is unknown.

    ``Nm``, ``N·m`` and ``N*m`` become ``N.m``, words such as ``degrees`` and ``msec`` their units.
    The case of letters matters: ``mN.m`` is a thousandth of a newton metre, and ``nm`` is no
    torque.
    """
    plain_spelling = _plain_spelling(unit_text)
    return _UNITS_BY_SPELLING.get(plain_spelling) or _UNITS_BY_WORD.get(plain_spelling.lower())


def unit_factor(quantity: str, unit: str) -> float:
    """Return the size of a unit of a quantity in the base unit of the quantity: rad, N·m, N or s.

    The quantity is "angle", "torque", "force" or "time". The unit has any spelling of
    `canonical_unit`, with or without a number before it: ``0.02 N.m`` may be the value of one volt
    of a sensor's signal. Raise `ExchangeError` if it is no unit of that quantity, or if the number
    is not finite or is 0.
    """
    unit_count, unit_name = _split_unit_number(unit)
    canonical_name = canonical_unit(unit_name)
    if (
        canonical_name is None
        or canonical_name not in UNIT_SIZES[quantity]
        or not math.isfinite(unit_count)
        or unit_count == 0.0
    ):
        base_unit = next(iter(UNIT_SIZES[quantity]))
        raise ExchangeError(
            f"'{unit}' is not a unit of {quantity} that is known here; choose from "
            f"{', '.join(UNIT_SIZES[quantity])}. Of a signal in volts, counts or the like, state "
            f"the value of one of them, as a number and a unit: CHANNEL:0.02 {base_unit}."
        )
    return unit_count * UNIT_SIZES[quantity][canonical_name]


def canonical_unit_text(unit: str) -> str:
    """Return a unit as spelled in `UNIT_SIZES`, preceded by its number if one was stated."""
    unit_count, unit_spelling = _split_unit_number(unit)
    unit_name = canonical_unit(unit_spelling) or unit_spelling
    return unit_name if unit_spelling == unit else f"{unit_count!r} {unit_name}"


def unit_in_suffix(channel_name: str) -> str | None:
    """Return the unit that the last word of a name suggests, as in ``angle_rad``, or None."""
    _, underscore, last_word = channel_name.strip().rpartition("_")
    return _UNITS_BY_NAME_SUFFIX.get(last_word.lower()) if underscore else None


def is_same_unit(unit_label: str, unit: str) -> bool:
    """Return whether a unit in a file may be a unit of `UNIT_SIZES`, in another case or language.

    ``Deg`` is the degree, ``nm`` at a torque the newton metre. ``Grad`` is the degree in German,
    but elsewhere the gon.
    """
    plain_label = _plain_spelling(unit_label).lower()
    return plain_label == _plain_spelling(unit).lower() or (plain_label, unit) == ("grad", "deg")


def _split_unit_number(unit: str) -> tuple[float, str]:
    """Split a text such as ``0.02 N.m`` into number and unit; the number is 1 by default."""
    number_match = _LEADING_NUMBER_PATTERN.match(unit.strip())
    return (
        (float(number_match[0]), unit.strip()[number_match.end() :])
        if number_match
        else (1.0, unit)
    )


def _plain_spelling(text: str) -> str:
    """Return a unit without spaces, dots and hyphens, and with special characters replaced."""
    return re.sub(
        r"[\s.·⋅*-]", "", text.strip().replace("µ", "u").replace("μ", "u").replace("°", "deg")
    )


_UNITS_BY_SPELLING: Final = {
    _plain_spelling(name): name for names in UNIT_SIZES.values() for name in names
}
"""Units as spelled in `UNIT_SIZES` by their spelling without dots."""

_UNITS_BY_WORD: Final = {
    "degree": "deg",
    "degrees": "deg",
    "radian": "rad",
    "radians": "rad",
    "sec": "s",
    "secs": "s",
    "second": "s",
    "seconds": "s",
    "sekunden": "s",
    "msec": "ms",
    "millisecond": "ms",
    "milliseconds": "ms",
    "usec": "us",
    "microsecond": "us",
    "microseconds": "us",
    "newtonmeter": "N.m",
    "newtonmetre": "N.m",
    "newton": "N",
}
"""Words for units, in lower case, with the units that they mean."""


# Fields

QUANTITIES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "angle_reference_rad": "angle",
        "angle_rad": "angle",
        "torque_command_nm": "torque",
        "coupling_torque_nm": "torque",
        "fx_n": "force",
        "fy_n": "force",
        "fz_n": "force",
        "tx_nm": "torque",
        "ty_nm": "torque",
        "tz_nm": "torque",
    }
)
"""Quantity that each field of a sample measures."""


@dataclass(frozen=True, slots=True)
class ChannelChoice:
    """User's choice of a channel in a file, with the unit of its values.

    Attributes
    ----------
    channel : str
        Name of the channel in the file.
    unit : str
        Unit as spelled by `canonical_unit`, after a number if the user stated one.
    factor : float
        Size of that unit in rad, N·m, N or s.
    """

    channel: str
    unit: str
    factor: float

    def __str__(self) -> str:
        """Return the choice in the form ``CHANNEL:UNIT``."""
        return f"{self.channel}:{self.unit}"


def parse_choice(text: str, quantity: str) -> ChannelChoice:
    """Parse the text ``CHANNEL:UNIT`` of an option; the last colon separates the two.

    Parameters
    ----------
    text : str
        Text such as ``Motor/Angle:deg``.
    quantity : {"angle", "torque", "force", "time"}
        Quantity that the unit must measure.

    Raises
    ------
    ExchangeError
        If the unit is missing or unknown, or no name precedes it.

    Examples
    --------
    >>> from analysis.exchange import parse_choice
    >>> parse_choice("Motor/Angle:mrad", "angle")
    ChannelChoice(channel='Motor/Angle', unit='mrad', factor=0.001)
    """
    channel, colon, unit = text.rpartition(":")
    if not colon or not channel.strip():
        raise ExchangeError(
            f"'{text}' does not state channel and unit; write CHANNEL:UNIT with one of the units "
            f"{', '.join(UNIT_SIZES[quantity])}. A unit is never guessed."
        )
    unit_size = unit_factor(quantity, unit)
    return ChannelChoice(channel.strip(), canonical_unit_text(unit), unit_size)


# Time base

MAX_JITTER_PERIODS: Final = 0.1
"""Largest permitted distance of a time stamp from its tick, in sample periods. Beyond it, the tick
of the sample is doubtful."""

MAX_TICKS_PER_SAMPLE: Final = 10
"""Largest permitted ratio of ticks to samples, as in the analysis: beyond it, most samples are
missing."""

MAX_GAP_FRACTION: Final = 0.05
"""Largest permitted fraction of the steps between samples that are longer than one tick. With more,
the times are too coarse to determine the rate, as whole milliseconds are at 700 Hz."""

_MIN_ROUNDED_STEPS: Final = 3
"""Smallest number of steps of two periods from which their distances show that time stamps are
rounded."""

_MAX_ROUNDED_DEVIATION: Final = 1e-3
"""Largest range of the distances of rounded time stamps from ticks, in sample periods."""

SESSION_RATE_RANGE_HZ: Final = (0.1, 1e6)
"""Lowest and highest sampling rate of a session."""

_RATE_SIGNIFICANT_DIGITS: Final = 9
"""Number of digits to which a rate from time stamps is rounded: 1000.0000000002 becomes 1000."""


@dataclass(frozen=True, slots=True)
class Timebase:
    """Sampling rate of a record, and the tick of each of its samples.

    Attributes
    ----------
    ticks : ndarray of int, shape (n,)
        Tick of each sample, increasing from 0.
    rate_hz : float
        Ticks per second.
    jitter : float
        Largest distance of a time stamp from its tick, in sample periods.
    """

    ticks: NDArray[np.int64]
    rate_hz: float
    jitter: float

    @property
    def missing_ticks(self) -> int:
        """Number of ticks without a sample between the first and the last sample."""
        return int(self.ticks[-1]) + 1 - len(self.ticks)


def uniform_timebase(path: Path, sample_count: int, rate_hz: float) -> Timebase:
    """Return the time base of samples without gaps, at the rate that the user states."""
    _check_rate(path, rate_hz)
    return Timebase(np.arange(sample_count), rate_hz, 0.0)


def timebase_from_stamps(path: Path, channel: str, time_s: NDArray[np.float64]) -> Timebase:
    """Return the sampling rate and the tick of each sample, determined from time stamps.

    There are at least two time stamps. Path and name of the channel are for messages. Raise
    `ExchangeError` if times are not finite, do not increase, or are not equidistant apart from
    gaps.
    """
    not_finite_indices = np.flatnonzero(~np.isfinite(time_s))
    if not_finite_indices.size:
        raise ExchangeError(
            f"{path}: the time '{channel}' of sample {not_finite_indices[0] + 1} is "
            f"{time_s[not_finite_indices[0]]}, so its "
            "position is unknown; repair the times, or give --rate-hz instead of --time if no "
            "sample is missing."
        )
    steps_s = np.diff(time_s)
    decreasing_indices = np.flatnonzero(steps_s <= 0.0)
    if decreasing_indices.size:
        first_bad_index = int(decreasing_indices[0])
        raise ExchangeError(
            f"{path}: the time '{channel}' does not increase from sample {first_bad_index + 1} "
            f"({time_s[first_bad_index]:.9g} s) to sample {first_bad_index + 2} "
            f"({time_s[first_bad_index + 1]:.9g} s); repair "
            "the times, or give --rate-hz instead of --time if the samples are equidistant."
        )
    tick_steps = _tick_steps(steps_s)
    gap_fraction = np.count_nonzero(tick_steps > 1) / len(tick_steps)
    if gap_fraction > MAX_GAP_FRACTION:
        raise ExchangeError(
            f"{path}: the times '{channel}' advance unevenly, by {steps_s.min():.6g} to "
            f"{steps_s.max():.6g} s: {100 * gap_fraction:.2g} % of the steps would be gaps. Write "
            "the times with more digits, resample the record to one rate, or give --rate-hz "
            "instead of --time if the samples are equidistant."
        )
    rounded_timebase = timebase_of_rounded_stamps(time_s)
    if rounded_timebase is not None:
        raise ExchangeError(
            f"{path}: the times '{channel}' have too few digits: steps of two periods follow at "
            f"regular distances, as if they were rounded at {rounded_timebase.rate_hz:.9g} Hz. "
            f"Write the times with more digits, or give --rate-hz {rounded_timebase.rate_hz:.9g} "
            "instead of --time if no sample is missing."
        )
    ticks = np.concatenate(([0.0], np.cumsum(tick_steps)))
    if ticks[-1] + 1 > MAX_TICKS_PER_SAMPLE * len(ticks):
        raise ExchangeError(
            f"{path}: the times '{channel}' of the {len(ticks)} samples span {ticks[-1] + 1:.0f} "
            "periods, so most of the record is missing; cut the session out of the file."
        )
    period_s = _regression_slope(ticks, time_s)
    rate_hz = float(f"{1 / period_s:.{_RATE_SIGNIFICANT_DIGITS}g}")
    _check_rate(path, rate_hz)
    tick_deviation = (time_s - time_s[0]) * rate_hz - ticks
    tick_deviation = np.abs(tick_deviation - np.median(tick_deviation))
    worst_index = int(np.argmax(tick_deviation))
    if tick_deviation[worst_index] > MAX_JITTER_PERIODS:
        raise ExchangeError(
            f"{path}: the times '{channel}' are not equidistant: sample {worst_index + 1} lies "
            f"{tick_deviation[worst_index]:.2g} periods from its position at {rate_hz:g} Hz. "
            "Resample the record to one rate, or give --rate-hz instead of --time if only the "
            "stamps are off."
        )
    return Timebase(ticks.astype(np.int64), rate_hz, float(tick_deviation[worst_index]))


def timebase_of_rounded_stamps(time_s: NDArray[np.float64]) -> Timebase | None:
    """Return the time base of increasing time stamps that are rounded to about one period.

    Return None for other time stamps. Rounded ones lie on ticks, and whenever the rounding adds up
    to a period, a step has two periods although no sample is missing. The distances between these
    steps are equal within one sample.
    """
    tick_steps = _tick_steps(np.diff(time_s))
    distances = np.diff(np.flatnonzero(tick_steps == 2))
    if (
        len(distances) < _MIN_ROUNDED_STEPS - 1
        or np.mean(np.abs(distances - np.median(distances)) <= 1.0) <= 0.5
    ):
        return None
    stamp_ticks = np.concatenate(([0.0], np.cumsum(tick_steps)))
    resolution_s = _regression_slope(stamp_ticks, time_s)
    deviation = (time_s - time_s[0]) / resolution_s - stamp_ticks
    if np.ptp(deviation) > _MAX_ROUNDED_DEVIATION:
        return None
    ticks = np.concatenate(([0.0], np.cumsum(np.where(tick_steps == 2, 1.0, tick_steps))))
    period_s = _regression_slope(ticks, time_s)
    deviation = (time_s - time_s.mean()) / period_s - (ticks - ticks.mean())
    # The stamps determine the rate to about half a period over their span, so further digits say
    # nothing.
    rate_hz = next(
        rate_hz
        for digits in range(1, 18)
        if abs((rate_hz := float(f"{1 / period_s:.{digits}g}")) * period_s - 1) <= 0.5 / ticks[-1]
    )
    return Timebase(ticks.astype(np.int64), rate_hz, float(np.abs(deviation).max()))


def _tick_steps(steps_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the steps between time stamps in whole ticks."""
    # The median distinguishes a step of one tick from a gap. The mean over all steps of one tick,
    # unlike the median, does not depend on the number of digits of the times.
    is_one_tick_step = steps_s < 1.5 * np.median(steps_s)
    tick_steps: NDArray[np.float64] = np.round(steps_s / steps_s[is_one_tick_step].mean())
    return tick_steps


def _regression_slope(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Return the slope of the least-squares straight line through points."""
    x, y = x - x.mean(), y - y.mean()
    return float(x @ y / (x @ x))


def _check_rate(path: Path, rate_hz: float) -> None:
    """Raise if a sampling rate is outside the range of sessions."""
    lowest_hz, highest_hz = SESSION_RATE_RANGE_HZ
    if not lowest_hz <= rate_hz <= highest_hz:
        raise ExchangeError(
            f"{path}: a rate of {rate_hz:g} Hz is outside the range of sessions, {lowest_hz:g} to "
            f"{highest_hz:g} Hz; check the unit of the time."
        )
