"""Readings that grow older from tick to tick: those of a sensor whose own clock is slower."""

_STENCIL = 4


class OtherClock:
    """Line of readings, appended at each tick, of which the first is the one to be seen.

    Between ticks a cubic through the nearest four is taken.

    Parameters
    ----------
    periods
        Age of the first reading, in ticks.
    growth
        By which the age grows each tick, in ticks; not negative.
    """

    __slots__ = ("_age", "_growth", "_readings")

    def __init__(self, periods: int, growth: float) -> None:
        self._age = float(periods)
        self._growth = growth
        self._readings = [0.0] * (periods + _STENCIL)

    def append(self, value: float) -> None:
        """Take the reading of the next tick."""
        self._age += self._growth
        readings = self._readings
        readings.append(value)
        if len(readings) > self._age + _STENCIL:
            del readings[0]

    def __getitem__(self, index: int) -> float:
        """Return the reading that is as old as the first has come to be (`index` 0)."""
        assert index == 0
        readings = self._readings
        place = len(readings) - 1 - self._age
        first = min(max(int(place) - 1, 0), len(readings) - _STENCIL)
        x = place - first
        a, b, c, d = readings[first : first + _STENCIL]
        return (
            -a * (x - 1) * (x - 2) * (x - 3) / 6
            + b * x * (x - 2) * (x - 3) / 2
            - c * x * (x - 1) * (x - 3) / 2
            + d * x * (x - 1) * (x - 2) / 6
        )
