"""When the touch process estimates, and from which samples; the estimates have their own tests."""

from types import SimpleNamespace

import numpy as np
import pytest

from rigd.engine.messages import TouchJob
from rigd.engine.touch_estimator import RunningTouchEstimator
from rigd.session.layout import SAMPLE_DTYPE, Status

TOUCH = 2000
RATE_HZ = 1000.0


class RecordingFollower:
    """Records its calls, each with the number of samples after the detection."""

    def __init__(self, requests):
        self.requests = requests

    def preview(self, record):
        self.requests.append(("look", record.angle_rad.size - record.detection_index))

    def update(self, record, *, includes_likelihoods, is_first):
        assert not includes_likelihoods
        after = record.angle_rad.size - record.detection_index
        self.requests.append(("first" if is_first else "last", after))
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
    """Return a function that passes on blocks of samples and returns the calls and reports."""

    def follow(ends, *touches, realtime=True, off=False):
        requests, reports = [], []
        job = TouchJob(None, 0, RATE_HZ, None, None, SimpleNamespace() if realtime else None)
        follower = RunningTouchEstimator(
            SimpleNamespace(growing_estimator=lambda: RecordingFollower(requests)), job
        )
        for first, last in zip([0, *ends], ends, strict=False):
            follower.add_samples(samples(first, last, *touches, off=off and last == ends[-1]))
            while some := follower.reports():
                reports += some
        return requests, reports

    return follow


def test_a_preview_precedes_the_first_and_last_estimate(followed):
    requests, reports = followed(range(5, 2300, 5), TOUCH)
    assert requests == [("look", 25), ("first", 50), ("last", 200)]
    assert [(each.number, each.tick, each.final) for each in reports] == [
        (1, TOUCH, False),
        (1, TOUCH, True),
    ]
    assert [each.document["start_s"] for each in reports] == [0.5, 0.5]


def test_later_samples_do_not_change_the_first_estimate(followed):
    requests, _ = followed([1000, 2000, 2040, 2300], TOUCH)
    assert requests == [("look", 25), ("first", 50), ("last", 200)]
    assert followed([1000, 2300], TOUCH)[0] == [("first", 50), ("last", 200)]


def test_only_the_last_estimate_without_realtime(followed):
    assert followed([1000, 2300], TOUCH, realtime=False)[0] == [("last", 200)]


@pytest.mark.parametrize(
    ("end", "requests"),
    [(2031, [("last", 31)]), (2050, [("first", 50), ("last", 50)])],
)
def test_a_record_is_estimated_to_its_end(followed, end, requests):
    assert followed([1000, end], TOUCH, off=True)[0] == requests


def test_the_beam_stays_in_contact_after_a_touch(followed):
    _, reports = followed(range(50, 3400, 50), TOUCH, TOUCH + 900)
    assert [(each.number, each.final) for each in reports] == [
        (1, False), (1, True), (2, False), (2, True),
    ]  # fmt: skip
    assert reports[-1].document["start_s"] == (TOUCH + 800) / RATE_HZ


def test_a_touch_soon_after_another_starts_at_its_detection(followed):
    requests, reports = followed(range(25, 3000, 25), TOUCH, TOUCH + 300)
    assert requests[3:] == [("look", 25), ("first", 50), ("last", 200)]
    assert reports[-1].document["start_s"] == (TOUCH + 300) / RATE_HZ
