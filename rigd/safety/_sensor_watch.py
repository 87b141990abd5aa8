"""Sensor watch: detects a force-torque sensor, or a channel of it, that repeats its readings.

Every reading of a working sensor contains noise, so that readings rarely repeat. How rarely depends
on noise and resolution, and is measured at the tare for each channel. Afterwards an improbably long
run of identical readings is a fault: of all channels together (a frozen sensor) or of one (a broken
gauge, or one clipped at a plausible value).
"""

from collections.abc import Sequence
from math import ceil, log, sqrt
from operator import eq

from rigd.safety.limits import BY_NAME, Violation

_FROZEN_S = 0.02
_FROZEN_READINGS = 3
"""Least duration and number of identical readings of a fault."""
_CHANNEL_FACTOR = 3
"""A single channel causes a warning at its limit, and a fault after this many times as long."""
_CHANCE = 1e-12
"""Probability of a run of repeated readings that counts as impossible."""
_QUIET = 0.98
"""Fraction of repeated readings at the tare above which repetitions mean nothing."""
_COUNTED = 256
"""Ticks over which repeated readings are counted."""
_LEAST_FRACTION = 0.1
_SIGNIFICANT = 8.0
_LARGEST_FRACTION = 0.45
"""Fraction of repeated readings above which the sensor repeats them: an absolute margin, and so
many standard deviations, above that at the tare. Above the largest, a sensor that repeats every
second reading cannot be detected."""
_LEARNED = 100
"""Number of readings at the tare from which the fractions are known."""


class SensorWatch:
    """Compares each reading of the sensor with the previous one.

    Parameters
    ----------
    channels
        Names of the channels for messages.
    noisy
        Whether each channel has noise; a simulated one may have none.
    rate_hz
        Ticks a second.
    """

    __slots__ = (
        "_before",
        "_channels",
        "_counted",
        "_fractions",
        "_learned",
        "_limits",
        "_noisy",
        "_notices",
        "_rate_hz",
        "_repeated",
        "_running",
        "_runs",
        "_warned",
    )

    def __init__(self, channels: Sequence[str], noisy: Sequence[bool], rate_hz: float) -> None:
        self._channels = (*channels, "")
        self._noisy = (*noisy, all(noisy))
        self._rate_hz = rate_hz
        self._notices: list[str] = []
        self.learn()

    def learn(self) -> None:
        """Start over: the next readings, at rest, give the frequency of repetitions."""
        n = len(self._channels)
        self._before: tuple[float, ...] = ()
        self._learned = self._counted = 0
        # For each channel, and last for all together.
        self._repeated = [0] * n
        self._runs = [0] * n
        self._running = False
        self._limits: list[int] | None = None
        self._fractions: list[float] = []
        self._warned: set[str] = set()

    def finish_learning(self) -> Violation | None:
        """End learning: derive the limits of the runs, and check the readings at rest."""
        n = max(1, self._learned)
        if n < _LEARNED:
            return None
        fractions = [repeated / n for repeated in self._repeated]
        least = max(_FROZEN_READINGS, ceil(_FROZEN_S * self._rate_hz)) - 1
        never = 2**62
        self._limits = []
        for fraction, noisy in zip(fractions, self._noisy, strict=True):
            if not noisy or fraction > _QUIET:
                self._limits.append(never)
            else:
                chance = max(fraction, 1.0 / n)
                self._limits.append(max(least, ceil(log(_CHANCE) / log(chance))))
        self._fractions = [
            fraction
            + max(_LEAST_FRACTION, _SIGNIFICANT * sqrt(fraction * (1.0 - fraction) / _COUNTED))
            if noisy
            else 1.0
            for fraction, noisy in zip(fractions, self._noisy, strict=True)
        ]
        self._repeated = [0] * len(fractions)
        self._counted = 0
        if self._noisy[-1] and fractions[-1] > _QUIET:
            return BY_NAME["frozen sensor"].violated(self._runs[-1], least)
        for channel, fraction, noisy in zip(
            self._channels[:-1], fractions, self._noisy, strict=False
        ):
            if noisy and fraction > _QUIET:
                self._notices.append(
                    f"The sensor's {channel} shows no noise at rest: a broken gauge or cable is "
                    "not detected there. Check the sensor."
                )
        return None

    def step(self, reading: tuple[float, ...]) -> Violation | None:
        """Compare a new reading with the previous one."""
        before, self._before = self._before, reading
        if not before:
            return None
        self._learned += 1
        if self._running or any(map(eq, reading, before)):
            runs, repeated = self._runs, self._repeated
            same = [*map(eq, reading, before), reading == before]
            for number, repeats in enumerate(same):
                if repeats:
                    runs[number] += 1
                    repeated[number] += 1
                else:
                    runs[number] = 0
            self._running = any(same)
        elif self._limits is None or self._counted + 1 < _COUNTED:
            self._counted += 1
            return None
        return None if self._limits is None else self._check()

    def _check(self) -> Violation | None:
        runs, limits = self._runs, self._limits
        assert limits is not None
        if runs[-1] > limits[-1]:
            return BY_NAME["frozen sensor"].violated(runs[-1], limits[-1])
        self._counted += 1
        if self._counted >= _COUNTED:
            repeated, self._repeated, self._counted = self._repeated, [0] * len(runs), 0
            for number, count in enumerate(repeated):
                fraction, limit = count / _COUNTED, self._fractions[number]
                if (
                    limit < fraction
                    and limit < _LARGEST_FRACTION
                    and runs[number] <= limits[number]
                ):
                    together = 2 * repeated[-1] > count
                    part = "whole wrench" if together else self._channels[number]
                    return BY_NAME["repeated wrench"].violated(
                        100.0 * fraction, 100.0 * limit, part
                    )
        if max(runs) <= min(limits):
            return None
        for channel, run, limit in zip(self._channels[:-1], runs, limits, strict=False):
            if run <= limit:
                continue
            if run > _CHANNEL_FACTOR * limit:
                return BY_NAME["frozen channel"].violated(run, _CHANNEL_FACTOR * limit, channel)
            if channel not in self._warned:
                self._warned.add(channel)
                self._notices.append(
                    f"The sensor's {channel} has not changed for {run} ticks. "
                    f"{BY_NAME['frozen channel'].remedy}"
                )
        return None

    def take_notices(self) -> list[str]:
        """Return the warnings since the last call."""
        notices, self._notices = self._notices, []
        return notices
