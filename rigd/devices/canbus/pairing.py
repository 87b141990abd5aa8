"""Which request the last reply answers, on a bus whose replies do not say so: both are counted.

A device answers every request with one reply, in order. Where one is missing, the next to come may
be the missing one, late, or the next one, the missing one being lost; and from then on there is one
reply to each request either way. So one tick is left without a request: if no reply comes in it,
none is on its way, and what is missing is lost. If one comes, replies are late by whole periods,
and no reading counts until they have caught up.
"""

from typing import Protocol

_STEADY_PERIODS = 3
"""Periods with one reply each after which what is missing is given up where there is no pause."""


class Counter(Protocol):
    """Where replies are counted as they come."""

    replies: int
    """Since somebody set this to zero, whatever was in them."""


class ReplyPairing:
    """Counts requests and their replies.

    Parameters
    ----------
    inbox
        Of the replies.
    pauses
        A tick may be left without a request. Not so with a device whose time passes with the
        requests: there what is missing is taken for lost in the end, unproven.

    Attributes
    ----------
    owed : int
        Replies that have not come yet, to the last request or to earlier ones.
    lost : int
        Replies that were taken for lost.
    unproven : int
        Those of them that may also be late for good.
    """

    __slots__ = (
        "_alone",
        "_asked",
        "_heard",
        "_inbox",
        "_pauses",
        "_steady",
        "lost",
        "owed",
        "unproven",
    )

    def __init__(self, inbox: Counter, *, pauses: bool = True) -> None:
        self._inbox = inbox
        self._pauses = pauses
        self.lost = 0
        self.unproven = 0
        self.start()

    def start(self) -> None:
        """Begin anew, with nothing on its way."""
        self._inbox.replies = 0
        self._asked = self._alone = True
        self._heard = 0
        self._steady = 0
        self.owed = 0

    def wants_pause(self) -> bool:
        """Whether the next tick is to make no request; all that has come has been delivered."""
        if not (self.owed and self._pauses):
            return False
        self._take()
        # A pause in which a reply came goes on until they have all come, or none does.
        return self.owed > 0 and (self._heard == 1 if self._asked else self._heard > 0)

    def ask(self) -> None:
        """Note a new request, right before it is made; all that has come has been delivered."""
        self._close()
        self._asked = True
        self._alone = not self.owed
        self.owed += 1

    def pause(self) -> None:
        """Note a tick without a request, likewise."""
        self._close()
        self._asked = self._alone = False

    def has_caught_up(self) -> bool:
        """Whether the last reply is the one to the last request."""
        return 0 < self.owed <= self._inbox.replies

    def settle(self) -> bool:
        """Take what has come; return whether it is the reply to this tick's request.

        Where older ones were owed as well the next tick is the first to count: what a fault on the
        line delays may come after what was sent later.
        """
        return self._take() > 0 and self.owed == 0 and self._alone

    def _close(self) -> None:
        """End the period of the last tick."""
        self._take()
        if self.owed:
            if not self._asked:
                if not self._heard:
                    self.lost += self.owed
                    self.owed = 0
            elif not self._pauses:
                self._steady = self._steady + 1 if self._heard == 1 else 0
                if self._steady >= _STEADY_PERIODS:
                    self.lost += self.owed
                    self.unproven += self.owed
                    self.owed = self._steady = 0
        else:
            self._steady = 0
        self._heard = 0

    def _take(self) -> int:
        replies, self._inbox.replies = self._inbox.replies, 0
        self._heard += replies
        self.owed = max(0, self.owed - replies)
        return replies
