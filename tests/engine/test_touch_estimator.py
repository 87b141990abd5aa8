"""When the touch process estimates, and from which samples; the estimates have their own tests."""

from types import SimpleNamespace

import numpy as np
import pytest

from rigd.engine.messages import TouchJob
from rigd.engine.touch_estimator import RunningTouchEstimator
from rigd.session.layout import SAMPLE_DTYPE, Status

TOUCH = 2000
RATE_HZ = 1000.0


class Growing:
    """Notes what it is asked, and with how many samples after the detection."""

    def __init__(self, asked):
        self.asked = asked

    def preview(self, record):
        self.asked.append(("look", record.angle_rad.size - record.detected))

    def update(self, record, *, scan, first):
        assert not scan
        after = record.angle_rad.size - record.detected
        self.asked.append(("first" if first else "last", after))
        return SimpleNamespace(as_dict=lambda start_s: {"start_s": start_s})


def samples(first, last, *touches, off=False):
    some = np.zeros(last - first, SAMPLE_DTYPE)
    some["tick"] = np.arange(first, last)
    for touch in touches:
        if first <= touch < last:
            some["status"][touch - first] |= Status.TOUCHED
    if off:
        some["status"][-1] |= Status.TORQUE_OFF
    return some


@pytest.fixture
def followed():
    """Return a function that hands on blocks of samples, and what comes of it."""

    def follow(ends, *touches, realtime=True, off=False):
        asked, told = [], []
        job = TouchJob(None, 0, RATE_HZ, None, None, SimpleNamespace() if realtime else None)
        follower = RunningTouchEstimator(SimpleNamespace(follow=lambda: Growing(asked)), job)
        for first, last in zip([0, *ends], ends, strict=False):
            follower.take(samples(first, last, *touches, off=off and last == ends[-1]))
            while some := follower.reports():
                told += some
        return asked, told

    return follow


def test_it_looks_then_answers_then_answers_again(followed):
    asked, told = followed(range(5, 2300, 5), TOUCH)
    assert asked == [("look", 25), ("first", 50), ("last", 200)]
    assert [(each.number, each.tick, each.final) for each in told] == [
        (1, TOUCH, False),
        (1, TOUCH, True),
    ]
    assert [each.document["start_s"] for each in told] == [0.5, 0.5]


def test_samples_that_came_meanwhile_do_not_change_the_first_answer(followed):
    asked, _ = followed([1000, 2000, 2040, 2300], TOUCH)
    assert asked == [("look", 25), ("first", 50), ("last", 200)]
    assert followed([1000, 2300], TOUCH)[0] == [("first", 50), ("last", 200)]


def test_where_nobody_waits_only_the_last_answer_is_made(followed):
    assert followed([1000, 2300], TOUCH, realtime=False)[0] == [("last", 200)]


@pytest.mark.parametrize(
    ("end", "asked"),
    [(2031, [("last", 31)]), (2050, [("first", 50), ("last", 50)])],
)
def test_a_record_that_ends_is_estimated_as_far_as_it_goes(followed, end, asked):
    assert followed([1000, end], TOUCH, off=True)[0] == asked


def test_the_beam_is_not_free_for_some_time_after_a_touch(followed):
    _, told = followed(range(50, 3400, 50), TOUCH, TOUCH + 900)
    assert [(each.number, each.final) for each in told] == [
        (1, False), (1, True), (2, False), (2, True),
    ]  # fmt: skip
    assert told[-1].document["start_s"] == (TOUCH + 800) / RATE_HZ


def test_of_a_touch_soon_after_another_nothing_is_known_before_it(followed):
    asked, told = followed(range(25, 3000, 25), TOUCH, TOUCH + 300)
    assert asked[3:] == [("look", 25), ("first", 50), ("last", 200)]
    assert told[-1].document["start_s"] == (TOUCH + 300) / RATE_HZ
