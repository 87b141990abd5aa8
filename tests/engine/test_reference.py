"""References that are extended while they are followed."""

import threading
import time
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from processes import eventually

from rigd.devices.contracts import LineHealth
from rigd.engine import shared_memory_fd
from rigd.engine.messages import SessionJob
from rigd.engine.reference import (
    ReferenceReader,
    ReferenceSpec,
    ReferenceWriter,
    covers_reference,
    map_reference,
    write_reference,
)
from rigd.engine.shared_state import SharedState, StateField, StopReason
from rigd.excitation import chirp

UNIT_RAD = 1e-7
"""Unit of the angles here: segments begin and end at rest."""


class ScaledReference:
    """Writer and reader of angles that are whole numbers of `UNIT_RAD`."""

    def __init__(self, writer, reader):
        self.append = lambda angles: writer.append(angles * UNIT_RAD)
        self.at = lambda tick: round(reader.reference_at(tick) / UNIT_RAD)
        self.waits, self.over = reader.must_wait, reader.is_after_end


def test_a_long_chirp_is_planned_and_shared_without_copies():
    tracemalloc.start()
    try:
        reference_rad = chirp(rate_hz=1000, duration_s=1000.0).reference_rad
        planning_bytes = tracemalloc.get_traced_memory()[1]
        fd = shared_memory_fd()
        tracemalloc.reset_peak()
        before_bytes = tracemalloc.get_traced_memory()[0]
        reference = write_reference(fd, reference_rad)
        sharing_bytes = tracemalloc.get_traced_memory()[1] - before_bytes
    finally:
        tracemalloc.stop()
    assert np.array_equal(map_reference(reference), reference_rad)
    assert planning_bytes < 3 * reference_rad.nbytes
    assert sharing_bytes < 0.1 * reference_rad.nbytes


def growing(planned=3, space=40):
    shared_state = SharedState.create(shared_memory_fd())
    reference_rad = np.zeros(planned + space)
    reference_rad[:planned] = UNIT_RAD * np.arange(1, planned + 1)
    spec = write_reference(shared_memory_fd(), reference_rad, planned)
    reader = ReferenceReader(map_reference(spec), planned, shared_state)
    both = ScaledReference(ReferenceWriter(spec, shared_state), reader)
    return both, both, shared_state


def test_segments_follow_each_other_without_a_gap():
    writer, reader, shared_state = growing()
    writer.append(np.array([10.0, 11.0]))
    writer.append(np.array([20.0]))
    assert [reader.at(tick) for tick in range(6)] == [1, 2, 3, 10, 11, 20]
    assert shared_state[StateField.HELD_TICKS] == 0


def test_a_record_is_whole_after_its_last_segment():
    writer, reader, shared_state = growing(planned=3, space=40)
    assert [reader.at(tick) for tick in range(5)] == [1, 2, 3, 3, 3]
    writer.append(np.array([10.0, 11.0]))
    assert [reader.at(tick) for tick in range(5, 7)] == [10, 11]
    assert not covers_reference(shared_state, 7, 43)  # there may come more
    shared_state[StateField.LAST_SEGMENT] = 1
    assert reader.over(7)
    assert covers_reference(shared_state, 7, 43)
    assert not covers_reference(shared_state, 6, 43)
    assert not covers_reference(shared_state, 0, 43)


def test_a_given_reference_is_whole_at_its_end():
    shared_state = SharedState.create(shared_memory_fd())
    assert [covers_reference(shared_state, scheduled, 9) for scheduled in (0, 8, 9)] == [
        False,
        False,
        True,
    ]


def test_the_last_angle_is_held_until_the_next_segment():
    writer, reader, shared_state = growing()
    assert [reader.at(tick) for tick in range(6)] == [1, 2, 3, 3, 3, 3]
    assert shared_state[StateField.HELD_TICKS] == 3
    writer.append(np.array([10.0, 11.0, 12.0]))
    assert [reader.at(tick) for tick in range(6, 10)] == [10, 11, 12, 12]
    assert shared_state[StateField.HELD_TICKS] == 4


def test_the_segment_after_a_hold_is_reported():
    writer, reader, shared_state = growing()
    before = []
    for tick in range(12):
        if tick in (2, 6):
            writer.append(np.array([10.0, 11.0]))
        reader.at(tick)
        before.append(shared_state[StateField.HELD_TICKS_BEFORE_SEGMENT])
    assert before == [0] * 6 + [1] * 6  # the first segment at tick 3, the second at tick 6
    assert shared_state[StateField.BEGUN_REFERENCE_TICKS] == 7
    assert shared_state[StateField.HELD_TICKS] == 5


@pytest.mark.parametrize(("space", "expected"), [(4, [10, 11]), (3, [3])])
def test_a_segment_beyond_the_record_is_not_begun(space, expected):
    """The motor would have to stop at full swing."""
    writer, reader, shared_state = growing(space=space)
    assert [reader.at(tick) for tick in range(5)] == [1, 2, 3, 3, 3]
    writer.append(np.array([10.0, 11.0]))
    assert not reader.waits(5)
    assert [reader.at(tick) for tick in range(5, 3 + space)] == expected
    assert shared_state[StateField.BEGUN_REFERENCE_TICKS] == (5 if len(expected) > 1 else 0)


def test_missed_ticks_are_skipped_in_the_reference():
    writer, reader, shared_state = growing()
    writer.append(np.array([10.0, 11.0, 12.0]))
    assert [reader.at(tick) for tick in (0, 4)] == [1, 11]
    assert reader.at(8) == 12  # three ticks after the end
    writer.append(np.array([20.0, 21.0]))
    assert [reader.at(tick) for tick in (9, 10)] == [20, 21]
    assert shared_state[StateField.HELD_TICKS] == 3


def test_the_end_is_after_the_last_planned_segment():
    writer, reader, shared_state = growing()
    assert reader.waits(3)
    writer.append(np.array([10.0]))
    assert not reader.waits(3)
    shared_state[StateField.LAST_SEGMENT] = 1
    over = []
    for tick in range(4):
        over.append(reader.over(tick))
        reader.at(tick)
    assert over == [False] * 4
    assert reader.over(4)
    assert not reader.waits(4)


def test_a_segment_without_space_is_refused():
    writer, _, shared_state = growing(space=2)
    with pytest.raises(ValueError, match="room for 2"):
        writer.append(np.zeros(3))
    assert shared_state[StateField.PLANNED_TICKS] == 0


@pytest.mark.parametrize(
    "segment_rad",
    [[0.01, 0.0], [0.0, 0.01], [0.0, np.nan, 0.0], [np.nan, 0.0], [0.0, np.inf], [0.0, 7.0, 0.0]],
)
def test_a_segment_not_beginning_and_ending_at_rest_is_refused(segment_rad):
    writer, _, shared_state = growing()
    with pytest.raises(ValueError, match="a segment from"):
        writer.append(np.array(segment_rad) / UNIT_RAD)
    assert shared_state[StateField.PLANNED_TICKS] == 0


@given(
    segments=st.lists(
        st.tuples(st.integers(1, 9), st.integers(0, 20)), max_size=8
    ),  # length, and tick at which it is appended
    missed=st.lists(st.integers(0, 3), min_size=60, max_size=60),
)
def test_angles_of_segments_are_followed_in_order(segments, missed):
    """With any lateness: segments are followed and held in between, without missed ticks."""
    writer, reader, shared_state = growing(space=100)
    arrivals = sorted(segments, key=lambda segment: segment[1])
    appended, tick, followed = 3, -1, []
    for skipped in missed:
        before = tick
        tick += 1 + skipped
        while arrivals and arrivals[0][1] <= before + 1:
            length, _ = arrivals.pop(0)
            writer.append(np.arange(appended + 1, appended + length + 1))
            appended += length
        followed.append((tick, reader.at(tick)))
        held = shared_state[StateField.HELD_TICKS]
        assert followed[-1][1] == min(tick - held + 1, appended)
    values = [value for _, value in followed]
    assert values == sorted(values)
    for (first, a), (then, b) in pairwise(followed):
        assert b - a <= then - first


def wait_until_followed(session, ticks):
    """Wait until a session has followed so many ticks of its reference."""
    assert eventually(lambda: session.shared_state[StateField.SCHEDULED_TICKS] >= ticks)


def test_a_session_follows_segments_appended_while_running(make_session):
    """The virtual clock is paused until the next segment is there."""
    session = make_session()
    begun = np.zeros(400)
    segments_rad = [0.01 * np.sin(np.linspace(0, 2 * np.pi, 301)) ** 3, np.zeros(100)]
    whole = np.concatenate([begun, np.zeros(2000)])
    spec = write_reference(shared_memory_fd(), whole, begun.size)
    writer = ReferenceWriter(spec, session.shared_state)

    def plan():
        for segment_rad in segments_rad:
            time.sleep(0.1)
            writer.append(segment_rad)
        session.shared_state[StateField.LAST_SEGMENT] = 1

    planner = threading.Thread(target=plan)
    planner.start()
    session.obey(SessionJob(session.profile, spec))
    planner.join()
    samples = session.samples
    expected = np.concatenate([begun, *segments_rad])
    assert session.finished.outcome == "complete"
    assert session.finished.counts["scheduled"] == len(samples) == expected.size
    reference_rad = samples["angle_reference_rad"]
    assert reference_rad - reference_rad[0] == pytest.approx(expected, abs=1e-12)
    assert session.shared_state[StateField.HELD_TICKS] == 0
    session.assert_safe()


@pytest.mark.parametrize(("bits", "held"), [(None, False), (0, True)])
def test_virtual_pauses_are_short_for_a_drive_with_heartbeat(make_session, monkeypatch, bits, held):
    """A drive on a line takes a host that is silent for 5 s for dead, the torque being on."""
    monkeypatch.setattr("rigd.engine._session_sequence.MAX_VIRTUAL_PAUSE_S", 0.1)
    session = make_session()
    session.drive.health = lambda: LineHealth(bits)
    spec = write_reference(shared_memory_fd(), np.zeros(2000), 300)
    writer = ReferenceWriter(spec, session.shared_state)

    def plan():
        wait_until_followed(session, 300)
        time.sleep(0.3)
        writer.append(np.zeros(100))
        session.shared_state[StateField.LAST_SEGMENT] = 1

    planner = threading.Thread(target=plan)
    planner.start()
    session.obey(SessionJob(session.profile, spec))
    planner.join()
    ticks_held = session.shared_state[StateField.HELD_TICKS]
    assert (ticks_held > 0) == held
    assert ticks_held < 12
    assert session.finished.outcome == "complete"
    assert session.finished.counts["scheduled"] == len(session.samples) == 400 + ticks_held
    session.assert_safe()


def test_a_stop_ends_the_wait_for_a_segment(make_session):
    session = make_session()
    spec = ReferenceSpec(write_reference(shared_memory_fd(), np.zeros(900)).fd, 900, 300)

    def stop():
        wait_until_followed(session, 300)
        session.shared_state[StateField.STOP_REASON] = StopReason.OPERATOR

    stopping = threading.Thread(target=stop)
    stopping.start()
    session.obey(SessionJob(session.profile, spec))
    stopping.join()
    assert session.finished.outcome == "stopped"
    assert len(session.samples) == session.finished.counts["scheduled"] >= 300
    session.assert_safe()
