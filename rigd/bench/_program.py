"""Series of measurements: their order, and the remaining time."""

import os
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from rigd.bench import _cyclictest as cyclictest
from rigd.bench import _loops as loops
from rigd.bench.measure import HELD, LoopMeasurement, figures, pooled
from rigd.checks.machine import settings_granted
from rigd.engine.realtime import REFUSED
from rigd.profile import Profile

ROUNDS = 3
"""Alternating rounds of loop and cyclictest, because the load of the computer varies."""
ALONE = "loop alone"
RECORDED = "with recorder"
SHOWN = "with recorder and live view"
LOADED = "… and load on other cores"
HIGHEST_HZ = 16_000.0
LOWEST_HZ = 100.0

OnProgress = Callable[[str, float], None]
"""Receives the name of the present measurement and the approximate remaining time in s."""


@dataclass(slots=True)
class Results:
    """Results of all measurements."""

    profile: str
    """Name of the profile."""
    rate_hz: float
    """Requested rate."""
    seconds: float
    """Length of each measurement."""
    spin_us: float
    """Last part of each wait, spent polling the clock."""
    granted: dict[str, str]
    """Value granted by the system for each real-time setting."""
    load_average: tuple[float, float, float]
    """Load average of this computer before the measurements."""
    rounds: list[tuple[LoopMeasurement, LoopMeasurement | None]] = field(default_factory=list)
    """The loop alone, each followed by cyclictest."""
    sessions: list[LoopMeasurement] = field(default_factory=list)
    """Sessions with the recorder and increasing load."""
    search: list[LoopMeasurement] = field(default_factory=list)
    """Sessions at other rates, and the best one at this rate."""
    no_peer: str = ""
    """Why there is no cyclictest."""

    @property
    def alone(self) -> LoopMeasurement:
        """Pooled rounds of the loop."""
        return pooled(ALONE, [ours for ours, _ in self.rounds])

    @property
    def peer(self) -> LoopMeasurement | None:
        """Pooled rounds of cyclictest."""
        theirs = [their for _, their in self.rounds if their is not None]
        return pooled(cyclictest.NAME, theirs) if theirs else None

    @property
    def highest_rate_hz(self) -> float | None:
        """Highest measured rate that held."""
        held = [one.rate_hz for one in self.search if one.held >= HELD]
        return max(held, default=None)

    @property
    def highest_rate_between_stalls_hz(self) -> float | None:
        """Highest measured rate that held without the ticks during stalls."""
        held = [one.rate_hz for one in self.search if _holds(one)]
        return max(held, default=None)

    def ratios(self) -> tuple[float, float] | None:
        """Return the ratio of loop to cyclictest latency, p50 and p99: medians over the rounds."""
        pairs = [
            (figures(ours.lateness_us), figures(their.lateness_us))
            for ours, their in self.rounds
            if their is not None
        ]
        if not pairs:
            return None
        return (
            _median([ours.p50 / max(their.p50, 1.0) for ours, their in pairs]),
            _median([ours.p99 / max(their.p99, 1.0) for ours, their in pairs]),
        )


class Bench:
    """Series of measurements for one profile.

    Parameters
    ----------
    profile
        Profile with the real-time settings. Its hardware is not used.
    rate_hz
        Rate of the loop.
    seconds
        Duration of each measurement.
    spin_us
        Last part of each wait, spent polling the clock.
    on_progress
        Receives the progress about ten times a second.
    """

    def __init__(
        self,
        profile: Profile,
        *,
        rate_hz: float,
        seconds: float,
        spin_us: float,
        on_progress: OnProgress,
    ) -> None:
        self._profile = profile
        self._rate_hz = rate_hz
        self._seconds = seconds
        self._spin_us = spin_us
        self._on_progress = on_progress
        self._left_s = (2 * ROUNDS + 5) * (seconds + loops.AROUND_S)
        self._what = ""
        self._ends_s = 0.0

    def run(self) -> Results:
        """Run all measurements.

        Raises
        ------
        LoopError
            If the loop cannot be run.
        """
        results = Results(
            self._profile.name,
            self._rate_hz,
            self._seconds,
            self._spin_us,
            self._granted(),
            os.getloadavg(),
        )
        self.alternate(results)
        self.run_sessions(results)
        self.search(results)
        return results

    def alternate(self, results: Results) -> None:
        """Measure the loop alone and cyclictest, in turn."""
        for _ in range(ROUNDS):
            ours = self._alone()
            results.rounds.append((ours, self._peer(results)))

    def run_sessions(self, results: Results) -> None:
        """Measure whole sessions, with increasing load in addition to the loop."""
        results.sessions.append(self.session(RECORDED))
        results.sessions.append(self.session(SHOWN, live=True))
        with loops.busy_program(cores_without_loop(results.granted)):
            results.sessions.append(self.session(LOADED, live=True))

    def search(self, results: Results) -> None:
        """Search the highest rate that holds, in factors of 2 upwards or downwards.

        Stalls are ignored, because they affect every rate. The best of several attempts counts,
        because other programs only degrade the result.
        """
        results.search.append(max(results.sessions, key=_merit))
        up = _holds(results.search[0])
        rate_hz = self._rate_hz
        while True:
            rate_hz = rate_hz * 2.0 if up else rate_hz / 2.0
            if not LOWEST_HZ <= rate_hz <= HIGHEST_HZ:
                return
            tried = self.session(f"{rate_hz:g} Hz", rate_hz=rate_hz)
            if tried.held < HELD:
                tried = max(tried, self.session(f"{rate_hz:g} Hz", rate_hz=rate_hz), key=_merit)
            results.search.append(tried)
            if _holds(tried) is not up:
                return

    def session(
        self, name: str, *, rate_hz: float | None = None, live: bool = False
    ) -> LoopMeasurement:
        """Measure a whole session, by default at the rate of the bench.

        Parameters
        ----------
        name
            Name in the results.
        rate_hz
            Rate of the loop, by default the bench's.
        live
            Run with the live view.
        """
        rate_hz = rate_hz or self._rate_hz
        self._begin(name)
        profile = loops.rig_for(self._profile, rate_hz, self._spin_us)
        return loops.run_session(name, profile, self._seconds, self._show_progress, live=live)

    def _alone(self) -> LoopMeasurement:
        self._begin(ALONE)
        profile = loops.rig_for(self._profile, self._rate_hz, self._spin_us)
        return loops.run_alone(ALONE, profile, self._seconds, self._show_progress)

    def _peer(self, results: Results) -> LoopMeasurement | None:
        self._begin(cyclictest.NAME)
        self._show_progress()
        if not cyclictest.installed():
            results.no_peer = "not installed (package rt-tests)"
            return None
        scheduled = not results.granted.get("scheduling", REFUSED).startswith(REFUSED)
        try:
            return cyclictest.run(
                self._rate_hz,
                self._seconds,
                cpu=core_of(results.granted),
                priority=self._profile.realtime.priority if scheduled else 0,
            )
        except cyclictest.CyclictestError as error:
            results.no_peer = str(error)
            return None

    def _granted(self) -> dict[str, str]:
        try:
            return settings_granted(self._profile.realtime)
        except (OSError, subprocess.SubprocessError, ValueError) as error:
            raise loops.LoopError(f"The real-time settings cannot be tried ({error}).") from error

    def _begin(self, what: str) -> None:
        self._what = what
        duration_s = self._seconds + loops.AROUND_S
        self._left_s = max(0.0, self._left_s - duration_s)
        self._ends_s = time.monotonic() + duration_s

    def _show_progress(self) -> None:
        self._on_progress(self._what, self._left_s + max(0.0, self._ends_s - time.monotonic()))


def core_of(granted: dict[str, str]) -> int:
    """Return the core of the loop."""
    text = granted["cpu"]
    return max(os.sched_getaffinity(0)) if text.startswith(REFUSED) else int(text.split(",")[0])


def cores_without_loop(granted: dict[str, str]) -> set[int]:
    """Return the cores without the loop; all cores if there is only one."""
    allowed = os.sched_getaffinity(0)
    return allowed - {core_of(granted)} or allowed


def _merit(one: LoopMeasurement) -> tuple[bool, float]:
    return one.held >= HELD, one.held_between_stalls


def _holds(one: LoopMeasurement) -> bool:
    return one.held_between_stalls >= HELD


def _median(values: list[float]) -> float:
    ordered = sorted(values)
    half = len(ordered) // 2
    return ordered[half] if len(ordered) % 2 else (ordered[half - 1] + ordered[half]) / 2
