"""The queue for a stalled server, and the rig's health in the shared state."""

from functools import partial

import pytest

from rigd.beam import Beam
from rigd.engine.channels import TOPICS
from rigd.engine.shared_state import StateField
from rigd.live import publisher
from rigd.live.messages import LiveSession
from rigd.live.publisher import HEALTH_POLL_INTERVAL_S, Backlog, HealthReader
from rigd.view import SessionDescription

pytestmark = pytest.mark.process


def drawing(name):
    return partial(str, name)


def names(drawings):
    return [draw() for draw in drawings]


def test_drawings_are_sent_once_and_in_order():
    backlog = Backlog(max_samples=100)
    assert not backlog
    backlog.put([drawing("a"), drawing("b")], 50)
    backlog.put_required([drawing("note")])
    backlog.put([drawing("c")], 50)
    drawings, samples = backlog.take()
    assert (names(drawings), samples) == (["note", "a", "b", "c"], 100)
    assert not backlog
    assert backlog.take() == ([], 0)
    assert backlog.dropped_samples == 0


def test_oldest_samples_are_dropped_and_counted():
    backlog = Backlog(max_samples=100)
    backlog.put_required([drawing("note")])
    for number in range(5):
        backlog.put([drawing(number)], 40)
    assert backlog.dropped_samples == 120
    drawings, samples = backlog.take()
    assert (names(drawings), samples) == (["note", "3", "4"], 80)


def test_newest_samples_are_never_dropped():
    backlog = Backlog(max_samples=100)
    backlog.put([drawing("old")], 10)
    backlog.put([drawing("new")], 500)
    assert (backlog.dropped_samples, backlog.take()[1]) == (10, 500)


def test_required_drawings_can_be_dropped():
    backlog = Backlog(max_samples=100)
    backlog.put_required([drawing("note")])
    backlog.put([drawing("a")], 1)
    backlog.drop_required()
    assert names(backlog.take()[0]) == ["a"]


def test_overwritten_samples_are_counted(start_producer):
    producer = start_producer(capacity=1000)
    producer.stop()
    producer.write_more(3000)
    beam = Beam(length_m=0.5, density_kg_per_m=0.047, bending_stiffness_n_m2=0.2)
    description = SessionDescription("late", 1000.0, 10, (0, 10), beam, None)
    session = LiveSession(description, "id", (0,) * len(TOPICS))
    shown = publisher._ShownSession(session, producer.channels, None)
    shown.queue_new_records()
    # An observer reads half of a ring.
    assert producer.dropped == producer.tick - 500
    seen_count = producer.channels.shared_state[StateField.LIVE_SAMPLES_SEEN]
    assert seen_count == producer.tick - 500  # the others wait to be sent
    assert producer.refused == 0


def test_health_in_units_of_the_view(channels):
    shared_state = channels.shared_state
    for word, value in {
        StateField.RECORD_MAY_START: 1,
        StateField.MISSED_TICKS: 3,
        StateField.LATE_TICKS: 7,
        StateField.LOST_SAMPLES: 2,
        StateField.DISK_FREE_MB: 12_000,
        StateField.BUS_LOAD_PPM: 345_000,
        StateField.BUS_ERRORS: 4,
        StateField.SENSOR_STATUS: 0x8001,
    }.items():
        shared_state[word] = value
    for _ in range(5):
        channels.samples.publish()
    health = HealthReader(channels).read(0.0, view_dropped=11)
    assert (health.missed_ticks, health.late_ticks, health.lost_ticks) == (3, 7, 2)
    assert (health.disk_free_mb, health.recorder_lag_ticks, health.view_dropped) == (12_000, 5, 11)
    assert health.bus_load_percent == pytest.approx(34.5)
    assert (health.bus_errors, health.sensor_status) == (4, 0x8001)


def test_absent_values_of_health_are_unknown(channels):
    for word in (StateField.BUS_LOAD_PPM, StateField.BUS_ERRORS, StateField.SENSOR_STATUS):
        channels.shared_state[word] = -1
    health = HealthReader(channels).read(0.0, view_dropped=0)
    assert health.disk_free_mb is None
    assert (health.bus_load_percent, health.bus_errors, health.sensor_status) == (None, None, None)
    assert health.rate_hz is None


def test_counts_of_the_session_before_are_ignored(channels):
    channels.shared_state[StateField.MISSED_TICKS] = 5
    reader = HealthReader(channels)
    assert reader.read(0.0, view_dropped=0).missed_ticks == 0
    channels.shared_state[StateField.RECORD_MAY_START] = 1
    assert reader.read(1.0, view_dropped=0).missed_ticks == 5


def test_rate_is_that_of_the_last_second(channels):
    reader, shared_state = HealthReader(channels), channels.shared_state
    shared_state[StateField.RECORD_MAY_START] = 1
    rates = []
    for poll in range(20):
        now_s = poll * HEALTH_POLL_INTERVAL_S
        assert reader.is_due(now_s)
        shared_state[StateField.SCHEDULED_TICKS] = round(
            1000 * now_s if poll < 10 else 1250 + 500 * now_s
        )
        rates.append(reader.read(now_s, view_dropped=0).rate_hz)
        assert not reader.is_due(now_s + 0.9 * HEALTH_POLL_INTERVAL_S)
    assert rates[9] == pytest.approx(1000.0, abs=2.0)
    assert rates[-1] == pytest.approx(500.0, abs=2.0)
    shared_state[StateField.SCHEDULED_TICKS] = 10
    assert reader.read(6.0, view_dropped=0).rate_hz is None, "another session has begun"
