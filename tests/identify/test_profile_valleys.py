"""Local minima of a profile: values that the 95 % limit admits, and their number."""

import numpy as np
import pytest

from analysis.identify.deviance_curve import (
    CHI_SQUARE_95,
    local_minima,
    order_at_deviance_limit,
    order_interval_95,
    orders_outside_known_range,
    values_at_local_minima,
)
from analysis.identify.profile_likelihood import LikelihoodProfile

VALUES = np.linspace(0.1, 1.9, 361)


def double(depth):
    """Parabolas round 0.6 and 1.3, the second's bottom at `depth`."""
    first, second = ((VALUES - 0.6) / 0.05) ** 2, ((VALUES - 1.3) / 0.08) ** 2 + depth
    return np.minimum(first, second)


def profile_of(values, deviance):
    bottoms = local_minima(values, deviance)
    interval, below, above = order_interval_95(values, deviance)
    return LikelihoodProfile(
        "lambda", "VII", tuple(values), tuple(deviance), bottoms[0], bottoms, interval, below,
        above, 0.0,
    )  # fmt: skip


def test_one_minimum():
    found = profile_of(VALUES, double(30.0))
    half = 0.05 * CHI_SQUARE_95**0.5
    assert found.local_minima == pytest.approx([0.6])
    assert found.interval == pytest.approx((0.6 - half, 0.6 + half), abs=2e-3)
    assert found.identifiable


def test_second_minimum_within_the_limit_leaves_order_undecided():
    found = profile_of(VALUES, double(0.8))
    assert found.local_minima == pytest.approx([0.6, 1.3])  # the lower one first
    reach = 0.08 * (CHI_SQUARE_95 - 0.8) ** 0.5
    assert found.interval == pytest.approx((0.6 - 0.05 * CHI_SQUARE_95**0.5, 1.3 + reach), abs=2e-3)
    assert not found.identifiable


def test_narrow_adjacent_minima_are_distinguished():
    deviance = np.minimum(((VALUES - 0.9) / 0.01) ** 2, ((VALUES - 1.1) / 0.01) ** 2 + 1)
    found = profile_of(VALUES, deviance)
    assert found.relative_width < 0.15
    assert not found.identifiable


def test_minimum_beyond_the_limit_does_not_count():
    assert local_minima(VALUES, double(CHI_SQUARE_95 + 0.1)) == pytest.approx((0.6,))


def test_ripples_do_not_split_a_minimum():
    ripples = ((VALUES - 0.8) / 0.2) ** 2 + 0.1 * np.sin(VALUES * 200)
    assert len(local_minima(VALUES, ripples - ripples.min())) == 1


def test_curve_below_the_limit_is_open():
    interval, below, above = order_interval_95(VALUES, (VALUES - 1) ** 2)
    assert (interval, below, above) == ((0.1, 1.9), True, True)


def test_the_crossing_of_a_parabola_is_exact():
    assert order_at_deviance_limit(1.0, 3.0, 1.0, 9.0) == pytest.approx(CHI_SQUARE_95**0.5)


def test_proposed_points_lie_outside_known_ones():
    proposed = orders_outside_known_range([0.5, 0.9], (0.0, 2.0), 0.2)
    assert all(value < 0.5 or value > 0.9 for value in proposed)
    assert (min(proposed), max(proposed)) == pytest.approx((0.1, 1.9))


def test_dips_of_a_coarse_curve():
    assert values_at_local_minima({0.1: 1.0, 0.3: 2.0, 0.5: 1.5, 0.7: 3.0}) == [0.1, 0.5]
