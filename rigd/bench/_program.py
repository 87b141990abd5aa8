"""Programme of the measurements: which, in which order, and the time left."""

import os
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from rigd.bench import _cyclictest as cyclictest
from rigd.bench import _loops as loops
from rigd.bench.measure import HELD, Measurement, figures, pooled
from rigd.checks.machine import settings_granted
from rigd.engine.realtime import REFUSED
from rigd.profile import Profile

ROUNDS = 3
"""Rounds of loop and cyclictest in turn: the computer changes from one second to the next."""
ALONE = "loop alone"
RECORDED = "with recorder"
SHOWN = "with recorder and live view"
LOADED = "… and load on other cores"
HIGHEST_HZ = 16_000.0
LOWEST_HZ = 100.0

OnProgress = Callable[[str, float], None]
"""Told what is measured and for how many seconds the whole will still take, about."""


@dataclass(slots=True)
class Results:
    """All measurements."""

    profile: str
    """Name of the profile."""
    rate_hz: float
    """Rate that was asked for."""
    seconds: float
    """Length of each measurement."""
    spin_us: float
    """Last part of each wait that was spent polling."""
    granted: dict[str, str]
    """Real-time setting → what the system granted."""
    load_average: tuple[float, float, float]
    """Load average of this computer before the measurements."""
    rounds: list[tuple[Measurement, Measurement | None]] = field(default_factory=list)
    """The loop alone, and cyclictest right after it."""
    sessions: list[Measurement] = field(default_factory=list)
    """Sessions with the recorder, and with each further load."""
    search: list[Measurement] = field(default_factory=list)
    """Sessions at other rates, and the best at this."""
    no_peer: str = ""
    """Why there is no cyclictest."""

    @property
    def alone(self) -> Measurement:
        """The rounds of the loop together."""
        return pooled(ALONE, [ours for ours, _ in self.rounds])

    @property
    def peer(self) -> Measurement | None:
        """The rounds of cyclictest together."""
        theirs = [their for _, their in self.rounds if their is not None]
        return pooled(cyclictest.NAME, theirs) if theirs else None

    @property
    def highest_rate_hz(self) -> float | None:
        """The highest rate of those tried that held."""
        held = [one.rate_hz for one in self.search if one.held >= HELD]
        return max(held, default=None)

    @property
    def highest_rate_between_stalls_hz(self) -> float | None:
        """The highest that held but for the ticks while the computer stood still."""
        held = [one.rate_hz for one in self.search if _holds(one)]
        return max(held, default=None)

    def ratios(self) -> tuple[float, float] | None:
        """Return the loop's lateness over cyclictest's, p50 and p99: medians over the rounds."""
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
    """The measurements for one profile.

    Parameters
    ----------
    profile
        Its real-time settings count; nothing of its hardware is touched.
    rate_hz
        Rate of the loop.
    seconds
        Duration of each measurement.
    spin_us
        Last part of each wait that is spent polling the clock.
    tell
        Told of the progress, some ten times a second.
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
        """Measure everything.

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
        """Measure whole sessions, with more and more beside the loop."""
        results.sessions.append(self.session(RECORDED))
        results.sessions.append(self.session(SHOWN, live=True))
        with loops.busy_stranger(cores_beside(results.granted)):
            results.sessions.append(self.session(LOADED, live=True))

    def search(self, results: Results) -> None:
        """Look for the highest rate that holds: up by factors of 2, or down if this one does not.

        Stalls do not count: no rate escapes them. The best of several tries does: what others do to
        this computer only ever makes it worse.
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
    ) -> Measurement:
        """Measure a whole session, at the usual rate unless told otherwise.

        Parameters
        ----------
        name
            What the results call it.
        rate_hz
            Rate of the loop, by default the bench's.
        live
            With the live view.
        """
        rate_hz = rate_hz or self._rate_hz
        self._begin(name)
        profile = loops.rig_for(self._profile, rate_hz, self._spin_us)
        return loops.run_session(name, profile, self._seconds, self._show_progress, live=live)

    def _alone(self) -> Measurement:
        self._begin(ALONE)
        profile = loops.rig_for(self._profile, self._rate_hz, self._spin_us)
        return loops.run_alone(ALONE, profile, self._seconds, self._show_progress)

    def _peer(self, results: Results) -> Measurement | None:
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
    """Return the core that the loop runs on."""
    text = granted["cpu"]
    return max(os.sched_getaffinity(0)) if text.startswith(REFUSED) else int(text.split(",")[0])


def cores_beside(granted: dict[str, str]) -> set[int]:
    """Return the cores that the loop does not run on; all where there is only one."""
    allowed = os.sched_getaffinity(0)
    return allowed - {core_of(granted)} or allowed


def _merit(one: Measurement) -> tuple[bool, float]:
    return one.held >= HELD, one.held_between_stalls


def _holds(one: Measurement) -> bool:
    return one.held_between_stalls >= HELD


def _median(values: list[float]) -> float:
    ordered = sorted(values)
    half = len(ordered) // 2
    return ordered[half] if len(ordered) % 2 else (ordered[half - 1] + ordered[half]) / 2
