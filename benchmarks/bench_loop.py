"""How late the control loop wakes up, against cyclictest in turn with it.

    python benchmarks/bench_loop.py [SECONDS] [ROUNDS]

In each round, 10 s each at 1 kHz, same core and policy: cyclictest (package rt-tests), the loop
alone, the loop with the last 100 µs of each wait busy-polled, and a whole session with recorder,
live view and a stranger that computes on the other cores. Ratios are medians over the rounds. Then
the highest rate that holds 99.9 % of its ticks, with the recorder: of all, and of those that did
not pass while the computer stood still for 2 ms or more, as virtual machines do.
"""

import os
import statistics
import sys
from pathlib import Path

from rigd.bench import HIGHEST_HZ, cores_without_loop, loop_core
from rigd.bench import _cyclictest as cyclictest
from rigd.bench import _loops as loops
from rigd.bench.measure import HELD_FRACTION, LatencyPercentiles, LoopMeasurement, percentiles
from rigd.checks.machine import settings_granted
from rigd.profile import load_profile
from rigd.runtime.background import use_one_thread

RATE_HZ = 1000.0
TRIES = 3
SPIN_US = 100.0
PEER, IDLE, SPUN, LOADED = (
    "cyclictest",
    "loop alone",
    f"spinning {SPIN_US:g} µs",
    "all and stranger",
)


def quiet() -> None:
    """Show no progress."""


def one_round(seconds: float, granted: dict[str, str]) -> dict[str, LoopMeasurement]:
    """Measure each once."""
    profile = load_profile("sim")
    plain = loops.simulated_profile(profile, RATE_HZ, 0.0)
    spinning = loops.simulated_profile(profile, RATE_HZ, SPIN_US)
    found = {
        PEER: cyclictest.run(
            RATE_HZ, seconds, cpu=loop_core(granted), priority=profile.realtime.priority
        ),
        IDLE: loops.run_alone(IDLE, plain, seconds, quiet),
        SPUN: loops.run_alone(SPUN, spinning, seconds, quiet),
    }
    with loops.busy_program(cores_without_loop(granted)):
        found[LOADED] = loops.run_session(LOADED, plain, seconds, quiet, live=True)
    return found


def show(found: dict[str, LoopMeasurement]) -> None:
    """Print a round, in µs."""
    print(f"load {os.getloadavg()[0]:.2f}, steal since boot {steal_s():.2f} s")
    for name, one in found.items():
        late = percentiles(one.lateness_us)
        line = (
            f"  {name:17s} late p50 {late.p50:5.0f} p90 {late.p90:5.0f} p99 {late.p99:6.0f} "
            f"p99.9 {late.p999:6.0f} max {late.largest:6.0f}  missed {100 * (1 - one.held):.2f} %"
        )
        if one.work_us.size:
            work = percentiles(one.work_us)
            line += f"  work p50 {work.p50:4.0f} p99 {work.p99:4.0f}  CPU {one.cpu_percent:.1f} %"
            line += f"  page faults {one.page_faults}"
        print(line, flush=True)


def steal_s() -> float:
    """Return the time that a hypervisor has kept the processors for others."""
    fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()
    return int(fields[8]) / os.sysconf("SC_CLK_TCK")


def ratio(rounds: list[dict[str, LoopMeasurement]], over: str, under: str, which: str) -> float:
    """Return the median over the rounds of the ratio of two lateness figures."""

    def value(late: LatencyPercentiles) -> float:
        # cyclictest counts whole microseconds.
        return max(1.0, getattr(late, which))

    return statistics.median(
        value(percentiles(found[over].lateness_us)) / value(percentiles(found[under].lateness_us))
        for found in rounds
    )


def highest_rate(seconds: float) -> None:
    """Print what becomes of higher and higher rates; the best of some tries counts."""
    profile = load_profile("sim")
    rate_hz = RATE_HZ
    highest_hz: dict[str, float] = {}
    while rate_hz <= HIGHEST_HZ:
        rig = loops.simulated_profile(profile, rate_hz, 0.0)
        tries = [loops.run_session("session", rig, seconds, quiet) for _ in range(TRIES)]
        held = max(one.held for one in tries)
        between = max(one.held_between_stalls for one in tries)
        best = max(tries, key=lambda one: one.held_between_stalls)
        late, work = percentiles(best.lateness_us), percentiles(best.work_us)
        print(
            f"  {rate_hz:6.0f} Hz held {100 * held:7.3f} %, but for stalls {100 * between:7.3f} %  "
            f"late p99 {late.p99:4.0f}  work p50 {work.p50:3.0f} p99 {work.p99:4.0f}  "
            f"CPU {best.cpu_percent:.1f} %",
            flush=True,
        )
        for what, share in (("all ticks", held), ("but for stalls", between)):
            if share >= HELD_FRACTION:
                highest_hz[what] = rate_hz
        rate_hz *= 2.0
    print(f"highest rate that holds {100 * HELD_FRACTION:g} %: {highest_hz}")


def main() -> None:
    """Print every round, then the ratios."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 3
    use_one_thread()
    granted = settings_granted(load_profile("sim").realtime)
    print("; ".join(f"{name} {text}" for name, text in granted.items()))
    if not cyclictest.is_installed():
        raise SystemExit("cyclictest is not installed (package rt-tests).")
    rounds = []
    for _ in range(count):
        rounds.append(one_round(seconds, granted))
        show(rounds[-1])
    for text, over, under, limit in (
        ("loop alone over cyclictest", IDLE, PEER, "at most 3"),
        (f"the same with {SPIN_US:g} µs spun", SPUN, PEER, "beside it"),
        ("recorder, live view and stranger over loop alone", LOADED, IDLE, "at most 2"),
    ):
        p50, p99 = (ratio(rounds, over, under, which) for which in ("p50", "p99"))
        print(f"lateness, {text}: p50 {p50:.2f}, p99 {p99:.2f} ({limit})")
    worst = max(percentiles(found[LOADED].work_us).p99 for found in rounds)
    print(f"work p99, worst of the rounds with all: {worst:.0f} µs (below 150)")
    costs = [
        statistics.median(found[name].cpu_percent for found in rounds) for name in (IDLE, SPUN)
    ]
    print(f"CPU of the loop: {costs[0]:.1f} %, spinning {costs[1]:.1f} %")
    highest_rate(min(seconds, 5.0))


if __name__ == "__main__":
    main()
