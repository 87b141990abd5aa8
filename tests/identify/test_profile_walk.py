"""Walks along an order: a second minimum beyond a high maximum is found."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from analysis.identify.deviance_curve import local_minima, order_interval_95
from analysis.identify.profile_likelihood import OrderProfiler
from analysis.models import STRUCTURES
from analysis.optimizer import NormalEquations

COUNT = 1000
BOTTOMS = {0.6: 0.0, 1.4: 1.0}
WIDTH = 0.05


def deviance(order):
    return min(((order - at) / WIDTH) ** 2 + depth for at, depth in BOTTOMS.items())


def cost(order):
    return COUNT * math.exp(deviance(order) / COUNT)


class DoubleWell(OrderProfiler):
    """A walk on a deviance that is known, begun in one of its minima."""

    def __init__(self, start):
        self.order, self.structure = "lambda", None
        self._value_count, self._order_index = COUNT, 0
        self.costs, self._refits = {}, {}
        self._start_at(self._descend(np.array([start]), 1))

    def _descend(self, start, max_evaluations, *, held_unknowns=(), hopeless=None):
        order = float(start[0])
        if not held_unknowns:
            order = min(BOTTOMS, key=lambda at: ((order - at) / WIDTH) ** 2 + BOTTOMS[at])
        at = NormalEquations(cost(order), np.zeros(1), np.array([[1 / WIDTH**2]]))
        return SimpleNamespace(x=np.array([order]), cost=at.cost, equations=at)

    def _extrapolated_unknowns(self, value, near):
        return np.array([value])


@pytest.mark.parametrize("start", BOTTOMS)
def test_both_minima_are_found_from_either(start):
    walk = DoubleWell(start)
    walk.extend_both_ways()
    assert len(local_minima(*walk.curve())) == 1
    walk.extend_from_other_minima()
    values, found = walk.curve()
    assert local_minima(values, found) == pytest.approx((0.6, 1.4))
    (low, high), *is_open = order_interval_95(values, found)
    limit = 3.841458820694124
    assert low == pytest.approx(0.6 - WIDTH * limit**0.5, abs=3e-3)
    assert high == pytest.approx(1.4 + WIDTH * (limit - 1) ** 0.5, abs=3e-3)
    assert is_open == [False, False]


@pytest.mark.parametrize(("behind", "found"), [(1.0, True), (5.0, False)])
def test_equally_good_special_case_starts_a_walk(behind, found):
    """As where order 1 fits as well, beyond a maximum that no refit crosses."""
    at = 1.4
    walk = DoubleWell(0.6)
    walk.structure, walk._kind = STRUCTURES["VI"], "a rig"
    walk._unknowns = SimpleNamespace(vector=lambda plant: np.array([plant]))
    fit = SimpleNamespace(
        cost=COUNT * math.exp(behind / COUNT), parameters={"lambda": at}, plant=at
    )
    special = SimpleNamespace(kind="a rig", structure=STRUCTURES["III"], fit=fit)
    walk._candidate_set = SimpleNamespace(candidates=[special])
    walk.extend_both_ways()
    walk.extend_from_candidates()
    assert (len(local_minima(*walk.curve())) == 2) == found


class Astray(DoubleWell):
    """The same, where descents from the tangent end nowhere beyond an order of 1.9."""

    BEYOND = 1.9

    def _descend(self, start, max_evaluations, *, held_unknowns=(), hopeless=None):
        found = super()._descend(start, max_evaluations, held_unknowns=held_unknowns)
        if hopeless is not None and found.x[0] > self.BEYOND:
            found.cost = 1e3 * COUNT
            assert found.cost > hopeless[1]
        return found

    @property
    def _without_damping(self):
        return SimpleNamespace(x=np.array([1.4]), cost=cost(1.5))


def test_failed_descent_does_not_exclude_an_order():
    walk = Astray(1.4)
    near = walk._refits[1.4]
    assert walk._refit_at(1.95, near) == pytest.approx((deviance(1.95) - deviance(1.4)) ** 0.5)


class TangentAstray(DoubleWell):
    """The same, where only the tangent leads astray."""

    def _extrapolated_unknowns(self, value, near):
        return np.array([value + 8.0])

    @property
    def _without_damping(self):
        raise AssertionError("there is a lower minimum with the damping")


def test_failed_tangent_alone_leaves_the_damping():
    walk = TangentAstray(1.4)
    near = walk._refits[1.4]
    assert walk._refit_at(1.45, near) == pytest.approx((deviance(1.45) - deviance(1.4)) ** 0.5)
