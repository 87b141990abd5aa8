"""Delays over five powers of ten, in a few lines of text."""

from collections.abc import Sequence
from math import log10

import numpy as np
import numpy.typing as npt

_FIRST_US, _LAST_US = 1.0, 100_000.0
_STEPS = (1.0, 2.0, 5.0)
_LABEL = 18
_WIDTH = 20
_FULL = "█"


def edges_us() -> list[float]:
    """Return the bins' edges: 0, 1, 2, 5, 10, … µs; the last bin has no end."""
    decades = round(log10(_LAST_US / _FIRST_US))
    return [0.0, *(s * 10.0**d for d in range(decades) for s in _STEPS), _LAST_US]


def counts_of(delays_us: npt.NDArray[np.float64]) -> list[int]:
    """Return how many delays lie in each bin."""
    found = np.searchsorted(edges_us(), delays_us, side="right") - 1
    counts: list[int] = np.bincount(found, minlength=len(edges_us())).tolist()
    return counts


def histogram_lines(columns: Sequence[tuple[str, npt.NDArray[np.float64]]]) -> list[str]:
    """Return a histogram for each of some series of delays in µs, side by side.

    A bar is as long as the logarithm of its count, so that what is rare shows.

    Parameters
    ----------
    columns
        Name and delays.
    """
    counted = [counts_of(delays_us) for _, delays_us in columns]
    used = [index for index in range(len(edges_us())) if any(counts[index] for counts in counted)]
    if not used:
        return []
    longest = max(max(counts) for counts in counted)
    header = " " * (_LABEL + 3) + "".join(f"{name:<{_WIDTH + 9}}" for name, _ in columns)
    lines = [header.rstrip()]
    for index in range(used[0], used[-1] + 1):
        bars = (f"{_bar(counts[index], longest)}{counts[index]:>7}  " for counts in counted)
        lines.append(f"{_label(index):>{_LABEL}}   {''.join(bars)}".rstrip())
    return lines


def _bar(count: int, longest: int) -> str:
    length = round((_WIDTH - 1) * log10(1 + count) / log10(1 + longest))
    return f"{_FULL * max(length, int(count > 0)):<{_WIDTH}}"


def _label(index: int) -> str:
    edges = edges_us()
    if index + 1 == len(edges):
        return f"{edges[index]:.0f} µs and more"
    return f"{edges[index]:.0f}–{edges[index + 1]:.0f} µs"
