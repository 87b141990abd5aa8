"""Sensor watch: detects a force-torque sensor, or a channel of it, that repeats its readings.

Every reading of a working sensor contains noise, so that readings rarely repeat. The frequency of
repeats depends on noise and resolution; the tare measures it for each channel. Afterwards an
improbably long run of identical readings is a fault: of all channels together (a frozen sensor) or
of one (a broken gauge, or one clipped at a plausible value).
"""

from collections.abc import Sequence
from math import ceil, log, sqrt
from operator import eq

from rigd.safety.limits import INTERLOCKS_BY_NAME, Violation

_MIN_FROZEN_S = 0.02
"""Shortest duration in seconds of identical readings that is a fault."""
_MIN_FROZEN_READINGS = 3
"""Smallest number of identical readings that is a fault."""
_FAULT_TO_WARNING_RUN_RATIO = 3
"""Length of a single channel's run that is a fault, relative to the run that causes a warning."""
_MIN_RUN_PROBABILITY = 1e-12
"""Probability of a run of identical readings below which the run counts as a fault."""
_NO_NOISE_REPEAT_FRACTION = 0.98
"""Fraction of repeated readings at the tare above which a channel shows no noise."""
_REPEAT_COUNT_TICKS = 256
"""Number of ticks over which the fraction of repeated readings is computed."""
_MIN_EXCESS_REPEAT_FRACTION = 0.1
"""Smallest excess of the fraction of repeated readings over that at the tare that is a fault."""
_MIN_SIGNIFICANT_STDS = 8.0
"""Excess of the fraction of repeated readings over that at the tare that is a fault.

It is in standard deviations of a fraction that is counted over `_REPEAT_COUNT_TICKS`."""
_MAX_REPEAT_FRACTION_LIMIT = 0.45
"""Largest limit of the fraction of repeated readings that is checked.

Above it, a sensor that repeats every second reading cannot be detected."""
_MIN_LEARNED_READINGS = 100
"""Smallest number of readings at the tare that determines the fractions of repeated readings."""


class SensorMonitor:
    """Compares each reading of the force-torque sensor with the previous one to detect failures.

    Parameters
    ----------
    channels
        Names of the sensor's channels in messages.
    channel_has_noise
        Whether each channel has noise; a simulated channel may have none.
    rate_hz
        Loop rate in ticks per second.
    """

    __slots__ = (
        "_any_run",
        "_channels",
        "_counted_ticks",
        "_fraction_limits",
        "_has_noise",
        "_learned_readings",
        "_limits",
        "_notices",
        "_previous_reading",
        "_rate_hz",
        "_repeat_counts",
        "_runs",
        "_shortest_limit",
        "_warned_channels",
    )

    def __init__(
        self, channels: Sequence[str], channel_has_noise: Sequence[bool], rate_hz: float
    ) -> None:
        self._channels = (*channels, "")
        self._has_noise = (*channel_has_noise, all(channel_has_noise))
        self._rate_hz = rate_hz
        self._notices: list[str] = []
        self.start_learning()

    def start_learning(self) -> None:
        """Forget all readings, and learn from the next ones how often working channels repeat.

        The rig is at rest meanwhile.
        """
        n = len(self._channels)
        self._previous_reading: tuple[float, ...] = ()
        self._learned_readings = self._counted_ticks = 0
        # One entry for each channel, and last one for all channels together.
        self._repeat_counts = [0] * n
        self._runs = [0] * n
        self._any_run = False
        self._limits: list[int] | None = None
        self._shortest_limit = 0
        self._fraction_limits: list[float] = []
        self._warned_channels: set[str] = set()

    def finish_learning(self) -> Violation | None:
        """Derive the limits of identical readings from the readings at rest, and check the sensor.

        Returns
        -------
        Violation or None
            Violation if the sensor shows no noise at rest.
        """
        n = max(1, self._learned_readings)
        if n < _MIN_LEARNED_READINGS:
            return None
        repeat_fractions = [repeat_count / n for repeat_count in self._repeat_counts]
        min_run_length = max(_MIN_FROZEN_READINGS, ceil(_MIN_FROZEN_S * self._rate_hz)) - 1
        unlimited_run_length = 2**62
        self._limits = []
        for repeat_fraction, has_noise in zip(repeat_fractions, self._has_noise, strict=True):
            if not has_noise or repeat_fraction > _NO_NOISE_REPEAT_FRACTION:
                self._limits.append(unlimited_run_length)
            else:
                repeat_probability = max(repeat_fraction, 1.0 / n)
                self._limits.append(
                    max(min_run_length, ceil(log(_MIN_RUN_PROBABILITY) / log(repeat_probability)))
                )
        self._shortest_limit = min(self._limits)
        self._fraction_limits = [
            repeat_fraction
            + max(
                _MIN_EXCESS_REPEAT_FRACTION,
                _MIN_SIGNIFICANT_STDS
                * sqrt(repeat_fraction * (1.0 - repeat_fraction) / _REPEAT_COUNT_TICKS),
            )
            if has_noise
            else 1.0
            for repeat_fraction, has_noise in zip(repeat_fractions, self._has_noise, strict=True)
        ]
        self._repeat_counts = [0] * len(repeat_fractions)
        self._counted_ticks = 0
        if self._has_noise[-1] and repeat_fractions[-1] > _NO_NOISE_REPEAT_FRACTION:
            return INTERLOCKS_BY_NAME["frozen sensor"].violated(self._runs[-1], min_run_length)
        for channel_name, repeat_fraction, has_noise in zip(
            self._channels[:-1], repeat_fractions, self._has_noise, strict=False
        ):
            if has_noise and repeat_fraction > _NO_NOISE_REPEAT_FRACTION:
                self._notices.append(
                    f"The sensor's {channel_name} shows no noise at rest: a broken gauge or cable "
                    "is not detected there. Check the sensor."
                )
        return None

    def step(self, reading: tuple[float, ...]) -> Violation | None:
        """Return a violation if a new reading continues an improbable run of identical readings."""
        previous_reading, self._previous_reading = self._previous_reading, reading
        if not previous_reading:
            return None
        self._learned_readings += 1
        if self._any_run or any(map(eq, reading, previous_reading)):
            runs, repeat_counts = self._runs, self._repeat_counts
            repeat_flags = [*map(eq, reading, previous_reading), reading == previous_reading]
            for channel_index, channel_repeats in enumerate(repeat_flags):
                if channel_repeats:
                    runs[channel_index] += 1
                    repeat_counts[channel_index] += 1
                else:
                    runs[channel_index] = 0
            self._any_run = any(repeat_flags)
        elif self._limits is None or self._counted_ticks + 1 < _REPEAT_COUNT_TICKS:
            self._counted_ticks += 1
            return None
        return None if self._limits is None else self._check_repeats()

    def _check_repeats(self) -> Violation | None:
        """Compare the runs and the fraction of repeated readings with their limits."""
        runs, run_limits = self._runs, self._limits
        assert run_limits is not None
        is_run_long = max(runs) > self._shortest_limit
        if is_run_long and runs[-1] > run_limits[-1]:
            return INTERLOCKS_BY_NAME["frozen sensor"].violated(runs[-1], run_limits[-1])
        self._counted_ticks += 1
        if self._counted_ticks >= _REPEAT_COUNT_TICKS:
            repeat_counts, self._repeat_counts, self._counted_ticks = (
                self._repeat_counts,
                [0] * len(runs),
                0,
            )
            for channel_index, repeat_count in enumerate(repeat_counts):
                repeat_fraction, run_limit = (
                    repeat_count / _REPEAT_COUNT_TICKS,
                    self._fraction_limits[channel_index],
                )
                if (
                    run_limit < repeat_fraction
                    and run_limit < _MAX_REPEAT_FRACTION_LIMIT
                    and runs[channel_index] <= run_limits[channel_index]
                ):
                    affects_all_channels = 2 * repeat_counts[-1] > repeat_count
                    repeated_part = (
                        "whole wrench" if affects_all_channels else self._channels[channel_index]
                    )
                    return INTERLOCKS_BY_NAME["repeated wrench"].violated(
                        100.0 * repeat_fraction, 100.0 * run_limit, repeated_part
                    )
        if not is_run_long:
            return None
        for channel_name, run, run_limit in zip(
            self._channels[:-1], runs, run_limits, strict=False
        ):
            if run <= run_limit:
                continue
            if run > _FAULT_TO_WARNING_RUN_RATIO * run_limit:
                return INTERLOCKS_BY_NAME["frozen channel"].violated(
                    run, _FAULT_TO_WARNING_RUN_RATIO * run_limit, channel_name
                )
            if channel_name not in self._warned_channels:
                self._warned_channels.add(channel_name)
                self._notices.append(
                    f"The sensor's {channel_name} has not changed for {run} ticks. "
                    f"{INTERLOCKS_BY_NAME['frozen channel'].remedy}"
                )
        return None

    def take_notices(self) -> list[str]:
        """Return and clear the warnings on channels since the last call."""
        new_notices, self._notices = self._notices, []
        return new_notices
