"""Series of latency measurements for ``rigd bench``, and their results."""

import os
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from rigd.bench import _cyclictest as cyclictest
from rigd.bench import _loops as loops
from rigd.bench.measure import MIN_HELD_FRACTION, LoopMeasurement, percentiles, pool_measurements
from rigd.checks.machine import granted_realtime_settings
from rigd.engine.realtime import REFUSED_PREFIX
from rigd.profile import Profile

MEASUREMENT_ROUNDS = 3
"""Number of alternating measurements of loop and cyclictest.

They alternate because the load of the computer varies."""
LOOP_MEASUREMENT_NAME = "loop alone"
"""Name of the measurement without a recorder."""
RECORDER_MEASUREMENT_NAME = "with recorder"
"""Name of the measurement of a session with a recorder."""
LIVE_VIEW_MEASUREMENT_NAME = "with recorder and live view"
"""Name of the measurement of a session with recorder and live view."""
LOADED_MEASUREMENT_NAME = "… and load on other cores"
"""Name of the measurement of a session with live view and a busy program on other cores."""
HIGHEST_LOOP_RATE_HZ = 16_000.0
"""Highest rate of the search in Hz."""
LOWEST_LOOP_RATE_HZ = 100.0
"""Lowest rate of the search in Hz."""

BenchProgressCallback = Callable[[str, float], None]
"""Type of a function that receives the present measurement's name and the remaining time in s."""


@dataclass(slots=True)
class BenchResults:
    """Results of all measurements of ``rigd bench``."""

    profile_name: str
    """Name of the profile."""
    rate_hz: float
    """Requested rate of the loop."""
    measurement_duration_s: float
    """Duration of each measurement."""
    spin_us: float
    """Time in µs at the end of each wait in which the loop polls the clock instead of sleeping."""
    granted_settings: dict[str, str]
    """Value that the system granted for each real-time setting."""
    load_average: tuple[float, float, float]
    """Load average of this computer before the measurements."""
    rounds: list[tuple[LoopMeasurement, LoopMeasurement | None]] = field(default_factory=list)
    """Measurements of the loop alone, each with the following one of cyclictest."""
    session_measurements: list[LoopMeasurement] = field(default_factory=list)
    """Measurements of sessions with the recorder and increasing load."""
    search_measurements: list[LoopMeasurement] = field(default_factory=list)
    """Best measurement at the requested rate, followed by measurements at other rates."""
    missing_cyclictest_reason: str = ""
    """Reason why there is no measurement with cyclictest, or an empty string."""

    @property
    def pooled_loop_measurement(self) -> LoopMeasurement:
        """Measurements of the loop alone, pooled over the rounds."""
        return pool_measurements(
            LOOP_MEASUREMENT_NAME, [loop_alone for loop_alone, _ in self.rounds]
        )

    @property
    def cyclictest_measurement(self) -> LoopMeasurement | None:
        """Measurements with cyclictest, pooled over the rounds, or None if there are none."""
        cyclictest_measurements = [peer for _, peer in self.rounds if peer is not None]
        return (
            pool_measurements(cyclictest.PROGRAM_NAME, cyclictest_measurements)
            if cyclictest_measurements
            else None
        )

    @property
    def highest_rate_hz(self) -> float | None:
        """Highest measured rate in Hz at which 99.9 % of the ticks ran in time, or None."""
        held_rates_hz = [
            search_measurement.rate_hz
            for search_measurement in self.search_measurements
            if search_measurement.held_fraction >= MIN_HELD_FRACTION
        ]
        return max(held_rates_hz, default=None)

    @property
    def highest_rate_between_stalls_hz(self) -> float | None:
        """Highest rate in Hz at which 99.9 % of ticks outside of stalls ran in time, or None."""
        held_rates_hz = [
            search_measurement.rate_hz
            for search_measurement in self.search_measurements
            if _holds_rate(search_measurement)
        ]
        return max(held_rates_hz, default=None)

    def latency_ratios(self) -> tuple[float, float] | None:
        """Return the ratios of the loop's to cyclictest's wake-up latency, p50 and p99.

        They are medians over the rounds. Return None if cyclictest did not run.
        """
        percentile_pairs = [
            (percentiles(loop_alone.latencies_us), percentiles(peer.latencies_us))
            for loop_alone, peer in self.rounds
            if peer is not None
        ]
        if not percentile_pairs:
            return None
        return (
            _median([loop_alone.p50 / max(peer.p50, 1.0) for loop_alone, peer in percentile_pairs]),
            _median([loop_alone.p99 / max(peer.p99, 1.0) for loop_alone, peer in percentile_pairs]),
        )


class Bench:
    """Series of latency measurements with the real-time settings of a profile.

    Parameters
    ----------
    profile
        Profile with the real-time settings; its hardware is not used.
    rate_hz
        Rate of the loop.
    measurement_duration_s
        Duration of each measurement.
    spin_us
        Time at the end of each wait in which the loop polls the clock instead of sleeping.
    on_progress
        Function that receives the progress about ten times a second.
    """

    def __init__(
        self,
        profile: Profile,
        *,
        rate_hz: float,
        measurement_duration_s: float,
        spin_us: float,
        on_progress: BenchProgressCallback,
    ) -> None:
        self._profile = profile
        self._rate_hz = rate_hz
        self._measurement_duration_s = measurement_duration_s
        self._spin_us = spin_us
        self._on_progress = on_progress
        self._remaining_s = (2 * MEASUREMENT_ROUNDS + 5) * (
            measurement_duration_s + loops.MEASUREMENT_OVERHEAD_S
        )
        self._present_name = ""
        self._present_end_s = 0.0

    def run(self) -> BenchResults:
        """Run all measurements, and return their results.

        Raises
        ------
        LoopError
            If the loop cannot be run.
        """
        results = BenchResults(
            self._profile.name,
            self._rate_hz,
            self._measurement_duration_s,
            self._spin_us,
            self._granted_settings(),
            os.getloadavg(),
        )
        self.measure_alternately(results)
        self.run_sessions(results)
        self.search_highest_rate(results)
        return results

    def measure_alternately(self, results: BenchResults) -> None:
        """Measure the loop alone and cyclictest in turn, and add the results."""
        for _ in range(MEASUREMENT_ROUNDS):
            loop_measurement = self._measure_loop_alone()
            results.rounds.append((loop_measurement, self._measure_cyclictest(results)))

    def run_sessions(self, results: BenchResults) -> None:
        """Measure complete sessions with increasing additional load, and add the results."""
        results.session_measurements.append(self.measure_session(RECORDER_MEASUREMENT_NAME))
        results.session_measurements.append(
            self.measure_session(LIVE_VIEW_MEASUREMENT_NAME, with_live_view=True)
        )
        with loops.busy_program(cores_without_loop(results.granted_settings)):
            results.session_measurements.append(
                self.measure_session(LOADED_MEASUREMENT_NAME, with_live_view=True)
            )

    def search_highest_rate(self, results: BenchResults) -> None:
        """Search in steps of a factor 2 for the highest rate that the loop holds, and add results.

        Stalls are ignored, because they affect every rate. The best of several attempts counts,
        because other programs only degrade the result.
        """
        results.search_measurements.append(
            max(results.session_measurements, key=_measurement_sort_key)
        )
        is_searched_upwards = _holds_rate(results.search_measurements[0])
        rate_hz = self._rate_hz
        while True:
            rate_hz = rate_hz * 2.0 if is_searched_upwards else rate_hz / 2.0
            if not LOWEST_LOOP_RATE_HZ <= rate_hz <= HIGHEST_LOOP_RATE_HZ:
                return
            measurement = self.measure_session(f"{rate_hz:g} Hz", rate_hz=rate_hz)
            if measurement.held_fraction < MIN_HELD_FRACTION:
                measurement = max(
                    measurement,
                    self.measure_session(f"{rate_hz:g} Hz", rate_hz=rate_hz),
                    key=_measurement_sort_key,
                )
            results.search_measurements.append(measurement)
            if _holds_rate(measurement) is not is_searched_upwards:
                return

    def measure_session(
        self, measurement_name: str, *, rate_hz: float | None = None, with_live_view: bool = False
    ) -> LoopMeasurement:
        """Measure the loop in a complete session like that of ``rigd run``.

        Parameters
        ----------
        measurement_name
            Name of the measurement.
        rate_hz
            Rate of the loop, or None for that of the series.
        with_live_view
            Whether the session is shown in a live view.
        """
        rate_hz = rate_hz or self._rate_hz
        self._register_start(measurement_name)
        simulated_profile = loops.simulated_profile(self._profile, rate_hz, self._spin_us)
        return loops.run_session(
            measurement_name,
            simulated_profile,
            self._measurement_duration_s,
            self._show_progress,
            with_live_view=with_live_view,
        )

    def _measure_loop_alone(self) -> LoopMeasurement:
        """Measure the loop without a recorder."""
        self._register_start(LOOP_MEASUREMENT_NAME)
        simulated_profile = loops.simulated_profile(self._profile, self._rate_hz, self._spin_us)
        return loops.run_without_recorder(
            LOOP_MEASUREMENT_NAME,
            simulated_profile,
            self._measurement_duration_s,
            self._show_progress,
        )

    def _measure_cyclictest(self, results: BenchResults) -> LoopMeasurement | None:
        """Measure with cyclictest; return None and add the reason to `results` if it fails."""
        self._register_start(cyclictest.PROGRAM_NAME)
        self._show_progress()
        if not cyclictest.is_installed():
            results.missing_cyclictest_reason = "not installed (package rt-tests)"
            return None
        is_realtime_granted = not results.granted_settings.get(
            "scheduling", REFUSED_PREFIX
        ).startswith(REFUSED_PREFIX)
        try:
            return cyclictest.run_cyclictest(
                self._rate_hz,
                self._measurement_duration_s,
                core_number=loop_core(results.granted_settings),
                priority=self._profile.realtime.priority if is_realtime_granted else 0,
            )
        except cyclictest.CyclictestError as error:
            results.missing_cyclictest_reason = str(error)
            return None

    def _granted_settings(self) -> dict[str, str]:
        """Return the real-time settings that the system grants, or raise LoopError."""
        try:
            return granted_realtime_settings(self._profile.realtime)
        except (OSError, subprocess.SubprocessError, ValueError) as error:
            raise loops.LoopError(f"The real-time settings cannot be tried ({error}).") from error

    def _register_start(self, measurement_name: str) -> None:
        """Register name and start of a measurement, from which the progress follows."""
        self._present_name = measurement_name
        duration_s = self._measurement_duration_s + loops.MEASUREMENT_OVERHEAD_S
        self._remaining_s = max(0.0, self._remaining_s - duration_s)
        self._present_end_s = time.monotonic() + duration_s

    def _show_progress(self) -> None:
        """Report the present measurement's name and the remaining time of the series in s."""
        self._on_progress(
            self._present_name, self._remaining_s + max(0.0, self._present_end_s - time.monotonic())
        )


def loop_core(granted_settings: dict[str, str]) -> int:
    """Return the number of the processor core on which the loop runs.

    `granted_settings` has the granted real-time settings by name.
    """
    core_text = granted_settings["cpu"]
    return (
        max(os.sched_getaffinity(0))
        if core_text.startswith(REFUSED_PREFIX)
        else int(core_text.split(",")[0])
    )


def cores_without_loop(granted_settings: dict[str, str]) -> set[int]:
    """Return the processor cores on which the loop does not run, or all cores if there is only one.

    `granted_settings` has the granted real-time settings by name.
    """
    allowed_cores = os.sched_getaffinity(0)
    return allowed_cores - {loop_core(granted_settings)} or allowed_cores


def _measurement_sort_key(measurement: LoopMeasurement) -> tuple[bool, float]:
    """Return the key by which the best measurement of the loop at a rate sorts last."""
    return measurement.held_fraction >= MIN_HELD_FRACTION, measurement.held_fraction_between_stalls


def _holds_rate(measurement: LoopMeasurement) -> bool:
    """Return whether 99.9 % or more of the ticks outside of stalls ran within their periods."""
    return measurement.held_fraction_between_stalls >= MIN_HELD_FRACTION


def _median(numbers: list[float]) -> float:
    """Return the median of at least one value."""
    ordered_values = sorted(numbers)
    middle_index = len(ordered_values) // 2
    return (
        ordered_values[middle_index]
        if len(ordered_values) % 2
        else (ordered_values[middle_index - 1] + ordered_values[middle_index]) / 2
    )
