"""Trend of a specimen: modes are followed through sessions, and changes against intervals."""

from pathlib import Path

import pytest
from library_folders import DAY_NS, mode, quantity

from rigd.estimates import Estimate, change_between, modes_from_json
from rigd.library import SessionRow
from rigd.library.trend import mode_trends


def row(day, *modes):
    found = tuple(modes_from_json(list(modes)))
    return SessionRow(f"day-{day}", Path(f"day-{day}.mcap"), 0, day * DAY_NS, modes=found)


@pytest.mark.parametrize(
    ("before", "after", "beyond"),
    [
        (quantity(2.60, 0.03), quantity(2.656, 0.02), True),  # beyond 0.0552, 3 / 1.96 of 0.0361
        (quantity(2.60, 0.03), quantity(2.654, 0.02), False),
        (quantity(2.656, 0.02), quantity(2.60, 0.03), True),
        (quantity(2.60, 0.03), {"value": 9.0, "interval_95": None}, None),
        (quantity(2.60, 0.03, flag="doubtful"), quantity(9.0, 0.03), None),
        # The halves that face each other count: 0.01 and 0.01, not 0.09 and 0.01.
        ({"value": 1.0, "interval_95": [0.91, 1.01]}, quantity(1.05, 0.01), True),
        ({"value": 1.0, "interval_95": [0.99, 1.09]}, quantity(1.05, 0.01), False),
    ],
)
def test_a_change_is_significant_beyond_three_standard_deviations(before, after, beyond):
    change = change_between(Estimate.from_json(before), Estimate.from_json(after))
    assert change.difference == pytest.approx(after["value"] - before["value"])
    assert change.significant is beyond


def test_modes_are_followed_by_their_frequency():
    rows = [
        row(3, mode(2.70), mode(16.0)),
        row(1, mode(2.60), mode(16.1), mode(45.0)),
        row(2, mode(16.1)),
        row(4),
    ]
    first, second, third = mode_trends(rows)
    assert [point.row.id for point in first.points] == ["day-1", "day-3"]
    assert [point.row.id for point in second.points] == ["day-1", "day-2", "day-3"]
    assert [point.row.id for point in third.points] == ["day-1"]
    assert first.points[0].frequency_change is None
    assert first.points[1].frequency_change.difference == pytest.approx(0.1)
    assert first.points[1].frequency_change.significant is True
    assert first.points[1].damping_change.significant is False
    assert second.points[1].frequency_change.significant is False


def test_two_modes_of_a_session_are_never_merged():
    trends = mode_trends([row(1, mode(2.60)), row(2, mode(2.60), mode(2.65))])
    assert [len(trend.points) for trend in trends] == [2, 1]


def test_trend_is_a_json_document():
    (trend,) = mode_trends([row(1, mode(2.60)), row(2, mode(2.70))])
    first, second = trend.as_dict()["points"]
    assert (first["id"], first["frequency_change"]) == ("day-1", None)
    assert second["frequency_change"]["significant"] is True
