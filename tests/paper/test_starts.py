"""Starts lie in the hollows of the coarse sweep."""

import numpy as np

from analysis.models import STRUCTURES
from analysis.paper._fit import starts


def test_one_valley_one_start():
    target = np.array([np.log(1e-3), 0.8, np.log(0.1), 1.3])
    found = starts(STRUCTURES["VI"], lambda x: float(np.sum((x - target) ** 2)))
    assert len(found) == 1
    np.testing.assert_allclose(found[0], target)


def test_two_valleys_two_starts_the_deeper_first():
    def cost(x):
        left, right = (x[0] - np.log(1e-4)) ** 2, (x[0] - np.log(1e-1)) ** 2
        return float(min(left + 0.5, right) + (x[1] - 1.3) ** 2)

    found = starts(STRUCTURES["IV"], cost)
    np.testing.assert_allclose(found, [[np.log(1e-1), 1.3], [np.log(1e-4), 1.3]])


def test_rugged_costs_give_the_lowest_eight():
    rng = np.random.default_rng(909)
    seen = []

    def cost(_x):
        seen.append(rng.random())
        return seen[-1]

    found = starts(STRUCTURES["VI"], cost)
    assert len(found) == 8
    assert len(seen) == 256
