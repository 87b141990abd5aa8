"""Short stretches of the record that figures enlarge: where each mode rings most."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from analysis.paper import loudest_moment_s
from analysis.report import style
from rigd.beam import undamped_frequencies_rad_s

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from analysis.record import Record

_PERIODS_SHOWN: Final = 12
_SHORTEST_S: Final = 0.3
_LARGEST_SHARE: Final = 1 / 8


@dataclass(frozen=True, slots=True)
class Moment:
    """One stretch of the record.

    Attributes
    ----------
    name
        What is seen there.
    samples
        Range of samples.
    first_s, last_s
        Its ends in the record's time.
    """

    name: str
    samples: slice
    first_s: float
    last_s: float


def resonance_moments(record: Record, count: int) -> tuple[Moment, ...]:
    """Where the torque rings most at each of the first modes that the sampling can show."""
    duration_s = len(record.time_s) / record.rate_hz
    moments = []
    modes_hz = undamped_frequencies_rad_s(record.beam, count) / (2 * math.pi)
    for number, frequency_hz in enumerate(modes_hz.tolist(), start=1):
        if frequency_hz >= record.rate_hz / 2:
            break
        centre_s = loudest_moment_s(record.torque_nm, record.rate_hz, frequency_hz)
        length_s = min(_PERIODS_SHOWN / frequency_hz, _LARGEST_SHARE * duration_s)
        length_s = max(length_s, _SHORTEST_S)
        samples = min(round(length_s * record.rate_hz), len(record.time_s))
        first = round((centre_s - length_s / 2) * record.rate_hz)
        first = min(max(first, 0), len(record.time_s) - samples)
        stretch = slice(first, first + samples)
        times_s = record.time_s[stretch]
        moments.append(
            Moment(
                name=f"Mode {number}, {frequency_hz:.3g} Hz",
                samples=stretch,
                first_s=float(times_s[0]),
                last_s=float(times_s[-1]),
            )
        )
    return tuple(moments)


def mark(axes: Axes, moments: tuple[Moment, ...]) -> None:
    """Shade the stretches in the panel of the whole record, numbered from 1."""
    for number, moment in enumerate(moments, start=1):
        axes.axvspan(moment.first_s, moment.last_s, color=style.SHADE, linewidth=0, zorder=0)
        axes.text(
            (moment.first_s + moment.last_s) / 2, 1.01, str(number),
            transform=axes.get_xaxis_transform(), ha="center", va="bottom", fontsize=7.5,
            color="#8A7A4A",
        )  # fmt: skip


def enlarge(axes: Axes, number: int, moment: Moment) -> None:
    """Make a panel the enlargement of one stretch, which is numbered like its mark."""
    axes.set_title(f"{number}  {moment.name}", fontsize=8.5, fontweight="normal")
    axes.set_xlim(moment.first_s, moment.last_s)
    axes.set_facecolor("#FCFAF4")
