"""Which SYNC a TPDO answers: a reading counts as fresh only if it is the last SYNC's."""

from collections import deque

from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.devices.cia402.inbox import Inbox
from rigd.devices.cia402.pairing import ReplyPairing


class Line:
    """A drive that answers with the number of the SYNC, and a line that loses or holds replies."""

    def __init__(self):
        self.inbox = Inbox("Drive")
        self.pairing = ReplyPairing(self.inbox)
        self.waiting = deque()
        self.sync = 0

    def deliver(self, n=None):
        for _ in range(len(self.waiting) if n is None else min(n, len(self.waiting))):
            number = self.waiting.popleft()
            self.inbox.take_tpdo(bytes([0, 0]) + number.to_bytes(4, "little") + bytes(2))

    def tick(self, event, *, before=False):
        """One period; returns whether the reading counts as fresh."""
        if before:
            self.deliver()  # between the last reading and this SYNC
        self.pairing.ask()
        self.sync += 1
        if event != "lost":
            self.waiting.append(self.sync)
        if event in ("whole", "lost"):
            self.deliver()
        return self.pairing.settle()


@settings(max_examples=300)
@given(
    st.lists(
        st.tuples(st.sampled_from(["whole"] * 3 + ["held", "lost"]), st.booleans()), max_size=60
    )
)
def test_no_old_reading_counts_as_fresh_while_late_replies_catch_up(events):
    line = Line()
    for event, before in events:
        if line.tick(event, before=before):
            assert line.inbox.position == line.sync


def test_without_trouble_every_reading_is_fresh():
    line = Line()
    assert all(line.tick("whole") for _ in range(100))


def test_after_a_loss_readings_are_fresh_again():
    line = Line()
    line.tick("whole")
    fresh = [line.tick(event) for event in ("lost", "lost", *["whole"] * 5)]
    assert fresh == [False] * 2 + [False] * 3 + [True] * 2


def test_replies_that_are_read_too_late_are_not_taken_for_those_of_the_next_tick():
    # The host was slow once: from then on each reply would be found a tick later.
    line = Line()
    line.tick("whole")
    assert not line.tick("held")
    for _ in range(20):
        assert not line.tick("held", before=True)
    assert line.tick("whole", before=True)
    assert line.inbox.position == line.sync


def test_several_periods_of_replies_at_once():
    line = Line()
    line.tick("whole")
    assert [line.tick("held") for _ in range(3)] == [False] * 3
    assert line.tick("whole")
    assert line.inbox.position == line.sync
