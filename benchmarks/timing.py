"""How the benchmarks take a time: the least of several runs, what the work costs undisturbed."""

import time
from collections.abc import Callable


def least_s(work: Callable[[], object], repeats: int) -> float:
    """Least wall time of several runs, in s."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)
