"""What the detection of touches costs the control loop: lateness and work of a tick.

    python benchmarks/bench_touch_loop.py [PASSES] [ROUNDS]

In each round two whole real-time sessions of the simulated rig with the same reference, 4 s a pass,
in turn the one or the other first: passes in search of an obstacle, of which there is none, and the
same passes of which the loop is not told that they are a search. Both have the recorder; with the
search go the detector in each tick and the waiting process of the estimates. Ratios of the
lateness are of each round, and the best and their median are printed; the work of a tick is that of
the best session with and without.
"""

import statistics
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from rigd.bench import _loops as loops
from rigd.bench.measure import (
    LatencyPercentiles,
    LoopMeasurement,
    UsageMeter,
    percentiles,
    record_measurement,
)
from rigd.checks.machine import settings_granted
from rigd.excitation import Excitation, touch
from rigd.profile import Profile, load_profile
from rigd.runner._touch_search import touch_search
from rigd.runner.planning import RigPreview
from rigd.runner.request import SessionOrder
from rigd.runner.session import SessionProgress
from rigd.runtime import StopRequest
from rigd.runtime.background import use_one_thread
from rigd.session import read_session
from rigd.session.layout import Status

RATE_HZ = 1000.0
WITHOUT, WITH = "without detector", "with detector"
MOST_LATER, MOST_WORK_US = 1.2, 15.0
"""Targets: ratio of the lateness, and what is added to the work of a tick."""


def search(profile: Profile, passes: int) -> Excitation:
    """Return passes in search of an obstacle."""
    return touch(
        rate_hz=RATE_HZ,
        angle_rad=0.8,
        passes=passes,
        rest_s=0.5,
        ring_down_s=0.5,
        rig=RigPreview(profile),
    )


def session(name: str, profile: Profile, excitation: Excitation) -> LoopMeasurement:
    """Run a session and measure its loop."""
    with (
        tempfile.TemporaryDirectory(prefix="rigd-bench-") as folder,
        loops.connected_rig(profile) as (rig, group),
    ):
        meter = UsageMeter(group.control.pid)

        def watch(progress: SessionProgress, _: object) -> None:
            meter.sample(progress.phase)

        order = SessionOrder(
            profile,
            excitation,
            Path(folder) / "bench.mcap",
            touch=touch_search(profile, excitation),
        )
        result = rig.run(order, StopRequest(), watch)
        if result.outcome != "complete" or result.path is None:
            raise SystemExit(f"The session {name} was not completed: {result.reason}")
        samples = read_session(result.path).samples
    if np.any(samples["status"] & int(Status.TOUCHED)):
        raise SystemExit("A touch was detected where there was none: the motions differ.")
    return record_measurement(
        name,
        RATE_HZ,
        samples,
        scheduled_ticks=excitation.reference_rad.size,
        cpu_percent=meter.cpu_percent,
        page_faults=meter.page_faults,
    )


def show(one: LoopMeasurement) -> tuple[LatencyPercentiles, LatencyPercentiles]:
    """Print a session, in µs; return its lateness and work."""
    late, work = percentiles(one.lateness_us), percentiles(one.work_us)
    cpu = "" if one.cpu_percent is None else f"  CPU {one.cpu_percent:.1f} %"
    print(
        f"  {one.name:17s} late p50 {late.p50:5.1f} p99 {late.p99:6.1f} max {late.largest:6.0f}  "
        f"missed {one.missed} of {one.scheduled}  "
        f"work p50 {work.p50:5.1f} p99 {work.p99:5.1f}{cpu}",
        flush=True,
    )
    return late, work


def main() -> None:
    """Print every session, then what the detector adds."""
    passes = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    rounds = int(sys.argv[2]) if len(sys.argv) > 2 else 6
    use_one_thread()
    profile = loops.simulated_profile(load_profile("sim"), RATE_HZ, 0.0)
    granted = settings_granted(profile.realtime)
    print("; ".join(f"{name} {text}" for name, text in granted.items()))
    searching = search(profile, passes)
    motions = {WITHOUT: replace(searching, approach=None), WITH: searching}
    later: dict[str, list[float]] = {"p50": [], "p99": []}
    work_us: dict[str, list[tuple[float, float]]] = {"p50": [], "p99": []}
    for number in range(rounds):
        print(f"round {number + 1}")
        order = list(motions) if number % 2 == 0 else list(reversed(motions))
        found = {name: show(session(name, profile, motions[name])) for name in order}
        (late, work), (late_with, work_with) = found[WITHOUT], found[WITH]
        for which in ("p50", "p99"):
            later[which].append(getattr(late_with, which) / getattr(late, which))
            work_us[which].append((getattr(work, which), getattr(work_with, which)))
    for which in ("p50", "p99"):
        without, with_ = zip(*work_us[which], strict=True)
        print(
            f"{which}: lateness with the detector over without, best {min(later[which]):.2f}, "
            f"median {statistics.median(later[which]):.2f} (at most {MOST_LATER:g}); work of a "
            f"tick {min(without):.1f} and {min(with_):.1f} µs at best, so "
            f"{min(with_) - min(without):+.1f} µs (at most +{MOST_WORK_US:g})"
        )


if __name__ == "__main__":
    main()
