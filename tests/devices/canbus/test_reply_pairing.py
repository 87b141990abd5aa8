"""Pairing of replies and requests: a reading is fresh only if it answers the last request."""

from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.devices.canbus import ReplyPairing


class Box:
    """Number of replies received, and number of the request that the last one answers."""

    def __init__(self):
        self.reply_count = 0
        self.number = 0


class Line:
    """A device that answers with the number of the request, and a line that loses or holds."""

    def __init__(self, *, may_omit_request=True):
        self.inbox = Box()
        self.pairing = ReplyPairing(self.inbox, may_omit_request=may_omit_request)
        self.waiting = deque()
        self.period = 0
        self.number = 0
        self.paused = 0

    def deliver(self, until=None):
        """Let replies through that are due, all of them if no period is given."""
        while self.waiting and (until is None or self.waiting[0][0] <= until):
            self.inbox.number = self.waiting.popleft()[1]
            self.inbox.reply_count += 1

    def tick(self, event="whole", *, late=0, before=False):
        """One period; returns whether the reading counts as fresh.

        The reply is "lost", "held" until a later tick is "whole", or `late` by whole periods.
        """
        if before:
            self.deliver()  # between the last reading and this request
        self.period += 1
        if self.pairing.needs_pause():
            self.pairing.register_pause()
            self.paused += 1
        else:
            self.pairing.register_request()
            self.number += 1
            if event != "lost":
                self.waiting.append((self.period + late, self.number))
        if event != "held":
            self.deliver(self.period)
        return self.pairing.process_replies()

    def right(self):
        return self.inbox.number == self.number


@settings(max_examples=100)
@given(
    st.lists(
        st.tuples(st.sampled_from(["whole"] * 3 + ["held", "lost"]), st.booleans()), max_size=60
    )
)
def test_no_old_reading_is_fresh_while_late_replies_catch_up(events):
    line = Line()
    for event, before in events:
        if line.tick(event, before=before):
            assert line.right()


@settings(max_examples=100)
@given(
    late=st.integers(1, 8),
    before=st.lists(st.sampled_from(["whole"] * 5 + ["lost"]), max_size=20),
)
def test_replies_always_late_never_count(late, before):
    """Delayed from some tick on, after any losses: no reading counts, then or later."""
    line = Line()
    for event in before:
        if line.tick(event):
            assert line.right()
    for _ in range(30):
        assert not line.tick(late=late)


@given(late=st.integers(1, 8), ticks=st.integers(1, 30))
def test_replies_count_again_after_a_late_period(late, ticks):
    line = Line()
    line.tick()
    for _ in range(ticks):
        assert not line.tick(late=late)
    fresh = [line.tick() for _ in range(late + 6)]
    assert fresh[-1]
    assert line.right()
    assert line.pairing.lost_reply_count == 0


@pytest.mark.parametrize("losses", [1, 2, 3, 7])
def test_one_tick_without_request_resolves_a_loss(losses):
    line = Line()
    line.tick()
    assert not any(line.tick("lost") for _ in range(losses))
    assert [line.tick() for _ in range(4)] == [False, False, True, True]
    assert (line.paused, line.pairing.lost_reply_count, line.pairing.presumed_lost_count) == (
        1,
        losses,
        0,
    )
    assert line.right()


def test_every_reading_is_fresh_without_losses():
    line = Line()
    assert all(line.tick() for _ in range(100))
    assert line.paused == 0


def test_replies_read_late_do_not_count_for_the_next_tick():
    # After one pause of the host each reply would be found a tick later.
    line = Line()
    line.tick()
    assert not line.tick("held")
    for _ in range(20):
        assert not line.tick("held", before=True)
    assert line.tick(before=True)
    assert line.right()


def test_several_periods_of_replies_at_once():
    line = Line()
    line.tick()
    assert [line.tick("held") for _ in range(3)] == [False] * 3
    assert not line.tick(), "which of them came last is not sure"
    assert line.tick()
    assert line.right()


def test_a_loss_stays_unproven_in_lock_step():
    line = Line(may_omit_request=False)
    line.tick()
    fresh = [line.tick(event) for event in ("lost", "lost", *["whole"] * 5)]
    assert fresh == [False] * 2 + [False] * 3 + [True] * 2
    assert (line.paused, line.pairing.lost_reply_count, line.pairing.presumed_lost_count) == (
        0,
        2,
        2,
    )
