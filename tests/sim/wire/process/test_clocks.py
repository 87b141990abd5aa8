"""The world's clock under SYNCs that are early, late, missing or drifting."""

from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.sim.wire._bus_simulation import LockStep, WallClock

T = 1_000_000
quiet = settings(max_examples=60)


def test_a_regular_sync_moves_the_world_by_one_period():
    clock = WallClock(T, 0)
    assert [clock.sync(tick * T) for tick in range(1, 50)] == [1] * 49


@quiet
@given(
    start=st.floats(0, 1000),
    jitter=st.lists(st.floats(-0.24, 0.24), min_size=2, max_size=400),
)
def test_jitter_of_a_quarter_period_is_tolerated_from_the_start(start, jitter):
    clock = WallClock(T, 0)
    moves = [clock.sync((start + tick + off) * T) for tick, off in enumerate(jitter)]
    assert set(moves[1:]) == {1}


@quiet
@given(
    phase=st.floats(-0.5, 0.5),
    jitter=st.lists(st.floats(-0.45, 0.45), min_size=1, max_size=8),
)
def test_jitter_of_half_a_period_is_tolerated_with_known_phase(phase, jitter):
    clock = WallClock(T, 0)
    for tick in range(500):
        clock.sync((10 + tick + phase) * T)
    moves = [clock.sync((510 + tick + phase + off) * T) for tick, off in enumerate(jitter)]
    assert set(moves) == {1}


@quiet
@given(events=st.lists(st.tuples(st.floats(-0.4, 0.4), st.booleans()), min_size=10, max_size=300))
def test_the_world_follows_the_syncs_despite_losses(events):
    clock = WallClock(T, 0)
    for tick in range(500):
        clock.sync(tick * T)
    for tick, (off, missing) in enumerate(events, start=500):
        # The loop reads the clock often; half a period after a tick it has passed.
        clock.elapse(round((tick - 0.51) * T))
        if missing:
            clock.elapse(round((tick + 0.49) * T))
            assert clock.tick == tick - 1
            clock.elapse(round((tick + 0.53) * T))
        else:
            clock.sync((tick + 0.1 * off) * T)
        assert clock.tick == tick


@settings(max_examples=10)
@given(drift=st.floats(-3e-4, 3e-4), noise=st.lists(st.floats(-0.3, 0.3), min_size=16, max_size=16))
def test_a_host_with_another_clock_rate_is_followed(drift, noise):
    clock = WallClock(T, 0)
    moves = [
        clock.sync((tick * (1 + drift) + (noise[tick % 16] if tick > 300 else 0.0)) * T)
        for tick in range(4000)
    ]
    assert set(moves[1:]) == {1}


def test_periods_pass_without_a_sync():
    clock = WallClock(T, 0)
    assert clock.elapse(round(0.4 * T)) == 0
    assert clock.elapse(round(10.4 * T)) == 9
    assert clock.elapse(round(10.6 * T)) == 1
    assert clock.due_ns == round(11.5 * T)


def test_a_second_sync_in_a_period_moves_nothing():
    clock = WallClock(T, 0)
    for tick in range(100):
        clock.sync(tick * T)
    assert clock.sync(100 * T) == 1
    assert clock.sync(100.3 * T) == 0
    assert clock.sync(101 * T) == 1


def test_the_phase_is_reset_after_a_silence():
    clock = WallClock(T, 0)
    for tick in range(500):
        clock.sync(tick * T)
    assert not clock.is_idle
    clock.elapse(1000 * T)
    assert clock.is_idle
    first = clock.sync(1000.4 * T)
    moves = [clock.sync((1000.4 + tick + off) * T) for tick, off in ((1, 0.2), (2, -0.2), (3, 0.2))]
    assert first in (0, 1)
    assert moves == [1, 1, 1]


def test_each_sync_is_one_period_in_lock_step():
    clock = LockStep(T, 0)
    assert [clock.sync(now) for now in (5 * T, 5 * T + 1, 900 * T, 901 * T)] == [1] * 4


def test_lock_step_waits_for_a_host_with_a_timeout():
    clock = LockStep(T, 0)
    clock.sync(0)
    assert clock.elapse(5_000_000_000) == 0
    assert clock.elapse(5_000_000_000 + 5 * T) == 5
    assert clock.elapse(5_000_000_000 + 6 * T) == 1
    clock.sync(5_000_000_000 + 7 * T)
    assert clock.elapse(10_000_000_000) == 0


def test_lock_step_does_not_wait_without_a_host():
    clock = LockStep(T, 0)
    clock.sync(0)
    clock.stop_waiting(10 * T)
    assert clock.elapse(14 * T) == 4


def test_time_passes_before_the_first_sync_in_lock_step():
    clock = LockStep(T, 0)
    assert clock.elapse(100 * T) == 100
