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
_POUND_N: Final = 4.4482216152605

UNITS: Final[Mapping[str, Mapping[str, float]]] = MappingProxyType(
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
"""Quantity → unit → how many rad, N·m, N or s it is."""

_NAME_SUFFIXES: Final = {
    "rad": "rad",
    "mrad": "mrad",
    "deg": "deg",
    "nm": "N.m",  # as in the fields of a session file
    "mnm": "mN.m",
    "n": "N",
    "s": "s",
    "ms": "ms",
    "us": "us",
}
"""Last word of a channel's name → the unit it means."""

_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?(?=\s*[^\s\d.])")
_IN_BRACKETS: Final = re.compile(r"[\[(]([^\[\]()]*)[\])]\s*$")


def canonical_unit(text: str) -> str | None:
    """Return the table's spelling of a unit (``Nm``, ``N·m`` and ``N*m`` are ``N.m``), or None.

    Words such as ``degrees`` and ``msec``, as programs write them, are known too.
    Capitals matter: ``mN.m`` is a thousandth of a newton metre and ``nm`` no torque at all.
    """
    bare = _bare(text)
    return _SPELLINGS.get(bare) or _WORDS.get(bare.lower())


def factor(quantity: str, unit: str) -> float:
    """Size of a unit in rad, N·m, N or s.

    Parameters
    ----------
    quantity : {"angle", "torque", "force", "time"}
    unit : str
        In any spelling that `canonical_unit` knows, with a number before it or not: ``0.02 N.m`` is
        the value of one volt of a sensor's signal.

    Raises
    ------
    ExchangeError
        If it is not a unit of that quantity, or the number is not finite or 0.
    """
    size, name = _scaled(unit)
    known = canonical_unit(name)
    if known is None or known not in UNITS[quantity] or not math.isfinite(size) or size == 0.0:
        base = next(iter(UNITS[quantity]))
        raise ExchangeError(
            f"'{unit}' is not a unit of {quantity} that is known here; choose from "
            f"{', '.join(UNITS[quantity])}. Of a signal in volts, counts or the like, state what "
            f"one of them stands for, as a number and a unit: CHANNEL:0.02 {base}."
        )
    return size * UNITS[quantity][known]


def stated_unit(unit: str) -> str:
    """Spell a unit as the table does, with its number if it has one other than 1."""
    size, name = _scaled(unit)
    known = canonical_unit(name) or name
    return known if size == 1.0 else f"{size!r} {known}"


def unit_in_brackets(name: str) -> str | None:
    """Return the unit in brackets behind a name, as in ``Angle [deg]`` or ``Tz (mN.m)``."""
    found = _IN_BRACKETS.search(name)
    return canonical_unit(found[1]) if found else None


def unit_in_suffix(name: str) -> str | None:
    """Return the unit that the last word of a name suggests, as in ``angle_rad``, or None."""
    _, underscore, last = name.strip().rpartition("_")
    return _NAME_SUFFIXES.get(last) if underscore else None


def _scaled(unit: str) -> tuple[float, str]:
    """Take a number and a unit apart, ``0.02 N.m``; 1 where there is no number."""
    found = _NUMBER.match(unit.strip())
    return (float(found[0]), unit.strip()[found.end() :]) if found else (1.0, unit)


def _bare(text: str) -> str:
    return re.sub(
        r"[\s.·⋅*-]", "", text.strip().replace("µ", "u").replace("μ", "u").replace("°", "deg")
    )


_SPELLINGS: Final = {_bare(name): name for names in UNITS.values() for name in names}

_WORDS: Final = {
    "degree": "deg",
    "degrees": "deg",
    "grad": "deg",
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
"""Words for units, in any case of letters."""


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
"""Field of a sample → what is measured there."""


@dataclass(frozen=True, slots=True)
class ChannelChoice:
    """A channel of the file and the unit of its numbers.

    Attributes
    ----------
    channel : str
        Its name in the file.
    unit : str
        As `analysis.exchange._channels.UNITS` spells it, after a number if one was stated.
    factor : float
        Size of that unit in rad, N·m, N or s.
    """

    channel: str
    unit: str
    factor: float

    def __str__(self) -> str:
        return f"{self.channel}:{self.unit}"


def parse_choice(text: str, quantity: str) -> ChannelChoice:
    """Take ``CHANNEL:UNIT`` apart; the last colon counts.

    Parameters
    ----------
    text : str
        Such as ``Motor/Angle:deg``.
    quantity : {"angle", "torque", "force", "time"}

    Raises
    ------
    ExchangeError
        If the unit is missing or unknown, or there is no name before it.

    Examples
    --------
    >>> from analysis.exchange import parse_choice
    >>> parse_choice("Motor/Angle:mrad", "angle")
    ChannelChoice(channel='Motor/Angle', unit='mrad', factor=0.001)
    """
    channel, colon, unit = text.rpartition(":")
    if not colon or not channel.strip():
        raise ExchangeError(
            f"'{text}' does not say channel and unit; write CHANNEL:UNIT with one of the units "
            f"{', '.join(UNITS[quantity])}. A unit is never guessed."
        )
    size = factor(quantity, unit)
    return ChannelChoice(channel.strip(), stated_unit(unit), size)


# Time base

MAX_JITTER: Final = 0.1
"""Largest distance of a time stamp from its tick, in periods.

A stamp farther from the nearest tick makes the sample's position doubtful.
"""

MAX_SPAN: Final = 10
"""Most ticks for each sample, as for the analysis: beyond that there is more gap than record."""

MAX_GAPS: Final = 0.05
"""Largest fraction of steps from sample to sample that are longer than a tick. If there are more,
the times are too coarse to determine the rate: milliseconds of a record at 700 Hz, say."""

RATES_HZ: Final = (0.1, 1e6)
"""Rates that a session may have."""

_RATE_DIGITS: Final = 9
"""Digits to which time stamps determine a rate: 1000.0000000002 is read as 1000."""


@dataclass(frozen=True, slots=True)
class Timebase:
    """Ticks of the samples.

    Attributes
    ----------
    ticks : ndarray of int, shape (n,)
        From 0 on, increasing.
    rate_hz : float
        Ticks per second.
    jitter : float
        Largest distance of a time stamp from its tick, in periods.
    """

    ticks: NDArray[np.int64]
    rate_hz: float
    jitter: float

    @property
    def missing(self) -> int:
        """Ticks between the first and the last that have no sample."""
        return int(self.ticks[-1]) + 1 - len(self.ticks)


def uniform(path: Path, samples: int, rate_hz: float) -> Timebase:
    """Return the time base of samples without gaps, at the rate that the user states."""
    _check_rate(path, rate_hz)
    return Timebase(np.arange(samples), rate_hz, 0.0)


def from_time_stamps(path: Path, channel: str, time_s: NDArray[np.float64]) -> Timebase:
    """Find the rate and the tick of each sample from its time.

    Parameters
    ----------
    path : Path
        For messages.
    channel : str
        Name of the channel of times, for messages.
    time_s : ndarray of float, shape (n,)
        n at least 2.

    Raises
    ------
    ExchangeError
        If times are not finite, do not increase, or are not equidistant apart from gaps.
    """
    stray = np.flatnonzero(~np.isfinite(time_s))
    if stray.size:
        raise ExchangeError(
            f"{path}: the time '{channel}' of sample {stray[0] + 1} is {time_s[stray[0]]}, so its "
            "position is unknown; repair the times, or give --rate-hz instead of --time if no "
            "sample is missing."
        )
    steps_s = np.diff(time_s)
    backward = np.flatnonzero(steps_s <= 0.0)
    if backward.size:
        first = int(backward[0])
        raise ExchangeError(
            f"{path}: the time '{channel}' does not increase from sample {first + 1} "
            f"({time_s[first]:.9g} s) to sample {first + 2} ({time_s[first + 1]:.9g} s); repair "
            "the times, or give --rate-hz instead of --time if the samples are equidistant."
        )
    # The median distinguishes a step of one tick from a gap; the mean over all such steps is not at
    # the mercy of how finely the file writes its times, as the median itself is.
    single = steps_s < 1.5 * np.median(steps_s)
    steps = np.round(steps_s / steps_s[single].mean())
    gaps = np.count_nonzero(steps > 1) / len(steps)
    if gaps > MAX_GAPS:
        raise ExchangeError(
            f"{path}: the times '{channel}' advance unevenly, by {steps_s.min():.6g} to "
            f"{steps_s.max():.6g} s: {100 * gaps:.2g} % of the steps would be gaps. Write the "
            "times with more digits, resample the record to one rate, or give --rate-hz instead of "
            "--time if the samples are equidistant."
        )
    ticks = np.concatenate(([0.0], np.cumsum(steps)))
    if ticks[-1] + 1 > MAX_SPAN * len(ticks):
        raise ExchangeError(
            f"{path}: the times '{channel}' of the {len(ticks)} samples span {ticks[-1] + 1:.0f} "
            "periods, so most of the record is missing; cut the session out of the file."
        )
    period_s = _slope(ticks, time_s)
    rate_hz = float(f"{1 / period_s:.{_RATE_DIGITS}g}")
    _check_rate(path, rate_hz)
    deviation = (time_s - time_s[0]) * rate_hz - ticks
    deviation = np.abs(deviation - np.median(deviation))
    worst = int(np.argmax(deviation))
    if deviation[worst] > MAX_JITTER:
        raise ExchangeError(
            f"{path}: the times '{channel}' are not equidistant: sample {worst + 1} lies "
            f"{deviation[worst]:.2g} periods from where {rate_hz:g} Hz would have it. Resample the "
            "record to one rate, or give --rate-hz instead of --time if only the stamps are off."
        )
    return Timebase(ticks.astype(np.int64), rate_hz, float(deviation[worst]))


def _slope(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Slope of the straight line through points, by least squares."""
    x, y = x - x.mean(), y - y.mean()
    return float(x @ y / (x @ x))


def _check_rate(path: Path, rate_hz: float) -> None:
    lowest_hz, highest_hz = RATES_HZ
    if not lowest_hz <= rate_hz <= highest_hz:
        raise ExchangeError(
            f"{path}: a rate of {rate_hz:g} Hz is outside the range of sessions, {lowest_hz:g} to "
            f"{highest_hz:g} Hz; check the unit of the time."
        )
