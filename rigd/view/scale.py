"""Labels beside the axes of plots over time, whatever the amplitude.

Rerun makes an axis as long as its values need, and labels multiples of a power of ten where they
are far enough apart to be read. So ±0.06 would have a single label, 0. Where it comes to this, the
next multiple is put among the values, invisibly, which makes the axis a little longer. In time it
is put where an extreme value is, and leaves the picture with it.
"""

import collections
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from rigd.view.plots import Values, send_columns

if TYPE_CHECKING:
    from rigd.view.layout import TimeView
    from rigd.view.picture import Drawing
    from rigd.view.plots import Source

LEAST_SPACING: Final = 24.0
"""Between labels, in points: Rerun shows none that are nearer than 20, and hardly those of 21."""
MARGINS: Final = 1.1
"""How many times longer than its values need an axis is."""

_STEP_NS: Final = 100_000_000
"""Of what lies within so much time, the extremes are looked at."""
_ABSURDLY_SMALL, _ABSURDLY_LARGE = 1e-300, 1e300
_Mark = tuple[int, float]
"""Time since the start of the session in ns, and a value."""


class Scale:
    """Follows the extremes of what views show of one source.

    Parameters
    ----------
    source
        Of the values.
    views
        Those of other sources are passed over, and those whose axis has fixed ends.
    """

    def __init__(self, source: "Source", views: "Sequence[TimeView]") -> None:
        self._entity = source.ticks
        self._axes = [
            _Axis(view) for view in views if view.source is source and view.plot.span is None
        ]

    def frame(self) -> list["Drawing"]:
        """Return what each new connection needs first: a view complains of what it never got."""
        nothing = {axis.view.ticks: np.array([[np.nan]]) for axis in self._axes}
        start_ns = np.array([0])
        return [partial(send_columns, entity=self._entity, t_ns=start_ns, columns=nothing)]

    def draw(self, t_ns: npt.NDArray[np.int64], columns: Mapping[str, Values]) -> list["Drawing"]:
        """Take values (n, k) by component, at times (n,) of the session; draw the ticks they lack.

        What is not a finite number is passed over, as Rerun does.
        """
        steps = (t_ns - t_ns[0]) // _STEP_NS
        begins = np.append(0, np.flatnonzero(np.diff(steps)) + 1)
        times_ns = t_ns[np.append(begins[1:], len(t_ns)) - 1].tolist()
        lows, highs = (
            {
                component: extreme.reduceat(values.ravel(), begins * values.shape[1]).tolist()
                for component, values in columns.items()
            }
            for extreme in (np.fmin, np.fmax)
        )
        drawings: list[Drawing] = []
        for axis in self._axes:
            component = axis.view.plot.component
            marks = [
                mark
                for moment in zip(times_ns, lows[component], highs[component], strict=True)
                for mark in axis.take(*moment)
            ]
            if marks:
                drawings.append(self._ticks(axis.view.ticks, marks))
        return drawings

    def _ticks(self, component: str, marks: Sequence[_Mark]) -> "Drawing":
        times_ns, values = zip(*marks, strict=True)
        columns = {component: np.array(values)[:, None]}
        return partial(send_columns, entity=self._entity, t_ns=np.array(times_ns), columns=columns)


class _Axis:
    """Of one view: the extremes within its window, and the ticks it was given last."""

    def __init__(self, view: "TimeView") -> None:
        self.view = view
        self._window_ns = round(1e9 * view.window_s)
        self._greatest, self._least = _Greatest(self._window_ns), _Greatest(self._window_ns)
        self._below: _Mark | None = None
        self._above: _Mark | None = None

    def take(self, t_ns: int, low: float, high: float) -> list[_Mark]:
        """Take the extremes of a moment; return the ticks that are to be added."""
        if not (math.isfinite(low) and math.isfinite(high)):
            return []
        high_ns, high = self._greatest.take(t_ns, high)
        low_ns, minus_low = self._least.take(t_ns, -low)
        below, above = missing_ticks(-minus_low, high, self.view.height)
        # When either extreme leaves, it is seen anew what is missing.
        earlier_ns = min(low_ns, high_ns)
        added = []
        if above is not None and self._lacks(self._above, above, t_ns):
            self._above = earlier_ns, above
            added.append(self._above)
        if below is not None and self._lacks(self._below, below, t_ns):
            self._below = earlier_ns, below
            added.append(self._below)
        return added

    def _lacks(self, last: _Mark | None, value: float, t_ns: int) -> bool:
        """Whether the last tick is another one, or about to leave the window."""
        return last is None or last[1] != value or last[0] <= t_ns - self._window_ns + _STEP_NS


class _Greatest:
    """The greatest value within a window of time that moves on."""

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        # Each is greater than all that come after it.
        self._marks: collections.deque[_Mark] = collections.deque()

    def take(self, t_ns: int, value: float) -> _Mark:
        """Take the newest value; return the greatest one, and when it was."""
        while self._marks and self._marks[-1][1] <= value:
            self._marks.pop()
        self._marks.append((t_ns, value))
        while self._marks[0][0] <= t_ns - self._window_ns:
            self._marks.popleft()
        return self._marks[0]


def missing_ticks(low: float, high: float, height: float) -> tuple[float | None, float | None]:
    """Return what an axis must hold besides its values for two labels to be seen beside it.

    Parameters
    ----------
    low, high
        Extremes of the values.
    height
        Of the plot, in points.

    Returns
    -------
    below, above
        Values that are labelled if the axis holds them; None where none is needed.
    """
    spacing = MARGINS * (high - low) / height * LEAST_SPACING
    # Of a single value Rerun shows one unit to either side; of what is absurd, whatever it can.
    if not _ABSURDLY_SMALL < spacing < _ABSURDLY_LARGE:
        return None, None
    step = 10.0 ** math.ceil(math.log10(spacing))
    first, last = math.ceil(low / step), math.floor(high / step)
    if last > first:
        return None, None
    below, above = (first - 1) * step, (last + 1) * step
    if last < first:
        return below, above
    # Rather above, so that it stays there while a signal swings, and makes room for the legend.
    return (None, above) if above - high <= 2.0 * (low - below) else (below, None)
