"""How far beyond chance a statistic is, in standard deviations of a normal variable."""

from __future__ import annotations

import math
from typing import Final

SURE: Final = 5.0
"""Standard deviations from which chance is ruled out: 3 in 10 million, whatever was looked at."""


def of_chi_square(value: float, degrees_of_freedom: float) -> float:
    """Turn a chi-square into a normal deviate, by the cube root of Wilson and Hilferty.

    PNAS 17 (1931) 684-688.
    """
    spread = 2 / (9 * degrees_of_freedom)
    cube_root = (max(value, 0.0) / degrees_of_freedom) ** (1 / 3)
    return float((cube_root - 1 + spread) / math.sqrt(spread))


def largest_of(count: int) -> float:
    """Add to `SURE`, squared and halved, what the largest of `count` may exceed: ln count."""
    return SURE**2 / 2 + math.log(max(count, 1))


def kolmogorov(statistic: float) -> float:
    """Probability that the Kolmogorov statistic, times the root of the count, exceeds a value."""
    if statistic < 0.3:
        return 1.0
    total: float = sum((-1) ** (k - 1) * math.exp(-2 * (k * statistic) ** 2) for k in range(1, 20))
    return min(max(2 * total, 0.0), 1.0)
