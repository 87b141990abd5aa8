"""Times of the benchmarks: the least of several runs, which is the least disturbed."""

import resource
import time
from collections.abc import Callable


def time_s(work: Callable[[], object]) -> float:
    """Return the wall time of one run, in s."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def spent_cpu_s() -> float:
    """Return the processor time of this process and of its children that have ended, in s."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in both)


def cpu_s(work: Callable[[], object]) -> float:
    """Return the processor time of one run, processes that it waits for included, in s."""
    start = spent_cpu_s()
    work()
    return spent_cpu_s() - start


def least_s(work: Callable[[], object], repeats: int) -> float:
    """Return the least wall time of several runs, in s."""
    return min(time_s(work) for _ in range(repeats))


def least_in_turn_s(repeats: int, *works: Callable[[], object]) -> list[float]:
    """Return the least wall time of each work, in s; they run in turn under the same load."""
    rounds = [[time_s(work) for work in works] for _ in range(repeats)]
    return [min(times) for times in zip(*rounds, strict=True)]
