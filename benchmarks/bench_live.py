"""Cost of the live view: processor time of its processes, and wake-up latency of the loop.

    python benchmarks/bench_live.py [SECONDS] [ROUNDS]

Each round runs a chirp at 1 kHz with recorder without and with the complete live view, in turn. No
viewer is connected, so its drawing is not measured. The ratio is the median over the rounds. With
12 s and 3 rounds it takes two minutes.
"""

import argparse
import os
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from gate import Gate, Row
from loop_rounds import in_turn, lateness_ratio, show

from rigd.bench import _loops as loops
from rigd.bench.measure import LoopMeasurement, measurement_from_samples
from rigd.engine.shared_state import Phase
from rigd.engine.workers import LIVE
from rigd.excitation import make_excitation
from rigd.profile import load_profile
from rigd.runner.request import SessionOrder
from rigd.runtime import StopRequest
from rigd.runtime.background import use_one_thread
from rigd.session import read_session

RATE_HZ = 1000.0
WITHOUT, WITH = "without view", "with view"
ROWS = (
    # docs/decisions/0007-rerun-for-the-live-view.md has both limits.
    Row("publisher", most=6, unit="% of a core"),
    Row("lateness p99, with view", most=1.2, unit="times without"),
)


@dataclass
class Meter:
    """Processor time of all threads of a process between its first and last reading."""

    pid: int
    first: tuple[float, float] | None = None
    last: tuple[float, float] | None = None

    def take_reading(self) -> None:
        """Take a reading."""
        self.last = time.monotonic(), cpu_s(self.pid)
        self.first = self.first or self.last

    @property
    def percent(self) -> float:
        """Percentage of one core."""
        assert self.first is not None
        assert self.last is not None
        (begin_s, before_s), (end_s, after_s) = self.first, self.last
        return 100.0 * (after_s - before_s) / (end_s - begin_s)


def cpu_s(pid: int) -> float:
    """Return the processor time of all threads of a process, as the scheduler counts it."""
    total_ns = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        total_ns += int((task / "schedstat").read_text().split()[0])
    return total_ns * 1e-9


def resident_mb(pid: int) -> float:
    """Return the memory that a process has in use."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6


def child_of(pid: int) -> int:
    """Return the only child of a process."""
    (child,) = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return int(child)


def run(seconds: float, *, live: bool) -> tuple[LoopMeasurement, str, float]:
    """Run one chirp.

    Returns
    -------
    tuple
        Measurement of the loop; a text on the live view; processor time of the publisher, %.
    """
    profile = loops.simulated_profile(load_profile("sim"), RATE_HZ, 0.0)
    options = {"amplitude_rad": 0.005, "start_hz": 0.5, "stop_hz": 50.0, "duration_s": seconds}
    excitation = make_excitation("chirp", options | {"rest_s": 0.0, "ring_down_s": 0.0}, RATE_HZ)
    text, percent = "", 0.0
    with (
        tempfile.TemporaryDirectory(prefix="rigd-bench-") as folder,
        loops.connected_rig(profile, with_live_view=live) as (rig, group),
    ):
        order = SessionOrder(profile, excitation, Path(folder) / "bench.mcap")
        meters, stop = [], StopRequest()
        if live:
            rig.show_session(order, stop)
            pid = group[LIVE].pid
            meters = [Meter(pid), Meter(child_of(pid))]

        def watch(progress: object, _: object) -> None:
            if progress.phase == Phase.RUNNING:
                for meter in meters:
                    meter.take_reading()

        result = rig.run(order, stop, watch)
        if live:
            publisher, server = meters
            percent = publisher.percent
            text = (
                f"publisher {percent:.1f} % of a core, {resident_mb(publisher.pid):.0f} MB; "
                f"server {server.percent:.1f} %, {resident_mb(server.pid):.0f} MB; "
                f"{result.live_dropped} samples not shown"
            )
        if result.outcome != "complete" or result.path is None:
            raise SystemExit(f"The session was not completed: {result.reason}")
        samples = read_session(result.path).samples
    found = measurement_from_samples(
        WITH if live else WITHOUT,
        RATE_HZ,
        samples,
        scheduled_ticks=excitation.reference_rad.size,
        cpu_percent=None,
        page_faults=None,
    )
    return found, text, percent


def main() -> None:
    """Print every round, then the medians, and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seconds", type=float, nargs="?", default=12.0)
    parser.add_argument("rounds", type=int, nargs="?", default=3)
    gate = Gate(ROWS, parser)
    use_one_thread()
    rounds, costs = [], []
    for number in range(gate.given.rounds):
        found = {}
        for name in in_turn((WITHOUT, WITH), number):
            found[name], text, percent = run(gate.given.seconds, live=name == WITH)
            if name == WITH:
                print(text)
                costs.append(percent)
        rounds.append(found)
        show(found)
    gate.measured("publisher", statistics.median(costs))
    gate.measured("lateness p99, with view", lateness_ratio(rounds, WITH, WITHOUT, "p99"))
    gate.finish()


if __name__ == "__main__":
    main()
