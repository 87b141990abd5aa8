"""Cost of touch detection for the control loop: lateness and work per tick.

    python benchmarks/bench_touch_loop.py [PASSES] [ROUNDS]

Each round runs two whole real-time sessions of the simulated rig with the same reference, 4 s per
pass, in alternating order: passes in search of an obstacle, of which there is none, and the same
passes without detection. Both have the recorder; the search adds the detector in each tick and the
waiting process of the estimates. Ratios of lateness are taken within a round, and their median
counts; the work per tick is that of the best session with and without. With 3 passes and 3 rounds
it takes two minutes.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from gate import Gate, Row
from loop_rounds import in_turn, lateness_ratio, median_work_us, show

from rigd.bench import _loops as loops
from rigd.bench.measure import (
    LoopMeasurement,
    UsageMeter,
    measurement_from_samples,
)
from rigd.checks.machine import granted_realtime_settings
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
ROWS = (
    # Measured 1.02, 0.95 and 13 µs: docs/validation/touch.md.
    Row("lateness p50, with detector", most=1.2, unit="times without"),
    Row("lateness p99, with detector", most=1.2, unit="times without"),
    Row("work of a tick, with detector", most=15, unit="µs more than without"),
)


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


def without_detector(searching: Excitation) -> Excitation:
    """Return the same motion, during which the loop does not watch for touches."""
    return Excitation(
        searching.kind,
        searching.parameters,
        searching.rate_hz,
        searching.reference_rad,
        searching.segments,
    )


def session(name: str, profile: Profile, excitation: Excitation) -> LoopMeasurement:
    """Run a session and measure its loop."""
    with (
        tempfile.TemporaryDirectory(prefix="rigd-bench-") as folder,
        loops.connected_rig(profile) as (rig, group),
    ):
        meter = UsageMeter(group.control.pid)

        def watch(progress: SessionProgress, _: object) -> None:
            meter.sample_usage(progress.phase)

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
    return measurement_from_samples(
        name,
        RATE_HZ,
        samples,
        scheduled_ticks=excitation.reference_rad.size,
        cpu_percent=meter.cpu_percent,
        page_faults=meter.page_faults,
    )


def main() -> None:
    """Print every session, then the cost of the detector, and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("passes", type=int, nargs="?", default=3)
    parser.add_argument("rounds", type=int, nargs="?", default=3)
    gate = Gate(ROWS, parser)
    use_one_thread()
    profile = loops.simulated_profile(load_profile("sim"), RATE_HZ, 0.0)
    granted = granted_realtime_settings(profile.realtime)
    print("; ".join(f"{name} {text}" for name, text in granted.items()))
    searching = search(profile, gate.given.passes)
    motions = {WITHOUT: without_detector(searching), WITH: searching}
    rounds = []
    for number in range(gate.given.rounds):
        rounds.append(
            {name: session(name, profile, motions[name]) for name in in_turn(list(motions), number)}
        )
        show(rounds[-1])
    for which in ("p50", "p99"):
        ratio = lateness_ratio(rounds, WITH, WITHOUT, which)
        gate.measured(f"lateness {which}, with detector", ratio)
    without, with_ = (min(median_work_us(each[name]) for each in rounds) for name in motions)
    gate.measured("work of a tick, with detector", with_ - without)
    gate.finish()


if __name__ == "__main__":
    main()
