"""Rounds of real-time sessions in turn with their peers: printing and comparison."""

import os
import statistics
from collections.abc import Callable, Sequence

from rigd.bench.measure import LoopMeasurement, percentiles

Round = dict[str, LoopMeasurement]
"""Measurements of one round, by name."""


def show(found: Round) -> None:
    """Print a round, in µs."""
    print(f"load {os.getloadavg()[0]:.2f}")
    for name, one in found.items():
        late = percentiles(one.latencies_us)
        line = (
            f"  {name:17s} late p50 {late.p50:5.1f} p99 {late.p99:6.1f} p99.9 {late.p999:6.0f} "
            f"max {late.largest:6.0f}  missed {one.missed_ticks} of {one.scheduled_ticks}"
        )
        if one.execution_times_us.size:
            work = percentiles(one.execution_times_us)
            line += f"  work p50 {work.p50:5.1f} p99 {work.p99:5.1f}"
        if one.cpu_percent is not None:
            line += f"  CPU {one.cpu_percent:.1f} %"
        print(line, flush=True)


def lateness_ratio(rounds: Sequence[Round], over: str, under: str, which: str) -> float:
    """Return the median over the rounds of the ratio of two lateness figures, such as p99."""

    def value(one: LoopMeasurement) -> float:
        # cyclictest, one of the peers, counts whole microseconds.
        return max(1.0, getattr(percentiles(one.latencies_us), which))

    return statistics.median(value(found[over]) / value(found[under]) for found in rounds)


def median_difference(
    rounds: Sequence[Round], over: str, under: str, figure: Callable[[LoopMeasurement], float]
) -> float:
    """Return the median over the rounds of the difference of a figure."""
    return statistics.median(figure(found[over]) - figure(found[under]) for found in rounds)


def median_work_us(one: LoopMeasurement) -> float:
    """Return the median work of a tick."""
    return percentiles(one.execution_times_us).p50


def in_turn(names: Sequence[str], number: int) -> list[str]:
    """Return the order of a round, which starts with each name in turn."""
    first = number % len(names)
    return [*names[first:], *names[:first]]
