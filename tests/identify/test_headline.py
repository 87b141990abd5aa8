"""What another kind of rig, which explains the record as well, does to a number."""

import math

import pytest

from analysis.identify._headline import Quantity
from analysis.identify._verdict import NOT_DETERMINED, ORDER_ONE_ELSEWHERE

ALPHA = Quantity(0.98, 0.01, (0.96, 1.0))
FLAG = "another kind of rig fits the record equally well with another value"


def test_a_rival_inside_the_interval_is_no_reason_for_doubt():
    told = ALPHA.with_rival(0.97, 0.0, FLAG)
    assert told.flag is None
    assert told.std_any_rig == pytest.approx(0.01)


def test_the_farthest_rival_counts_and_its_own_deviation_with_it():
    told = ALPHA.with_rival(1.03, 0.0, FLAG).with_rival(0.99, 0.02, FLAG)
    assert told.flag == FLAG
    assert told.std_any_rig == pytest.approx(0.05)
    assert told.std == ALPHA.std
    assert told.with_rival(0.99, 0.2, FLAG).std_any_rig == pytest.approx(math.hypot(0.2, 0.01))


def test_a_rival_that_does_not_tell_the_value_leaves_no_deviation():
    told = ALPHA.with_rival(1.03, None, FLAG)
    assert (told.flag, told.std_any_rig) == (FLAG, math.inf)


def test_an_order_that_is_1_on_another_kind_of_rig_has_a_deviation_too():
    told = ALPHA.flagged(ORDER_ONE_ELSEWHERE).with_rival(1.0, 0.0, FLAG)
    assert told.flag == ORDER_ONE_ELSEWHERE
    assert told.std_any_rig == pytest.approx(0.02)


def test_no_deviation_covers_another_reason_for_doubt():
    assert ALPHA.flagged(NOT_DETERMINED).with_rival(1.03, 0.0, FLAG).std_any_rig is None
    told = ALPHA.with_rival(1.03, 0.0, FLAG).flagged("part of the record is unexplained")
    assert (told.flag, told.std_any_rig) == (FLAG, None)
    assert told.flagged(None) is told


def test_without_a_flag_to_give_a_rival_widens_only():
    told = ALPHA.with_rival(1.03, 0.0, None)
    assert (told.flag, told.std_any_rig) == (None, pytest.approx(0.05))
