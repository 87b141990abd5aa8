"""Which SYNC the last TPDO answers: a TPDO does not say, so both are counted.

A drive answers every SYNC with one TPDO, in order. Where one is missing, the next to come may be
the missing one, late, or the next one, the missing one being lost. Late ones catch up: then there
are more replies than SYNCs for a while. After a loss there is one reply to each SYNC from then on,
and the deficit stays. So readings are not trusted until the replies have caught up, or the deficit
has stood for some periods with one reply in each.

What counting cannot tell: replies that are all late by the same whole number of periods, for good.
"""

from rigd.devices.cia402.inbox import Inbox

_STEADY_PERIODS = 3
"""Periods with one reply each after which what is still missing counts as lost."""


class ReplyPairing:
    """Counts SYNCs and their replies.

    Parameters
    ----------
    inbox
        Where TPDOs are counted as they come.

    Attributes
    ----------
    owed : int
        Replies that have not come yet, to the last SYNC or to earlier ones.
    """

    __slots__ = ("_heard", "_inbox", "_steady", "owed")

    def __init__(self, inbox: Inbox) -> None:
        self._inbox = inbox
        self._heard = 0
        self._steady = 0
        self.owed = 0

    def ask(self) -> None:
        """Note a new SYNC, right before it is sent; all that has come is delivered by now."""
        self._take()
        if self.owed and self._heard == 1:
            self._steady += 1
            if self._steady >= _STEADY_PERIODS:
                self.owed = 0
        else:
            self._steady = 0
        self._heard = 0
        self.owed += 1

    def has_caught_up(self) -> bool:
        """Whether the last TPDO is the reply to the last SYNC."""
        return 0 < self.owed <= self._inbox.replies

    def settle(self) -> bool:
        """Take what has come; return whether the last TPDO is the reply to the last SYNC."""
        return self._take() > 0 and self.owed == 0 and self._inbox.legible

    def _take(self) -> int:
        replies, self._inbox.replies = self._inbox.replies, 0
        self._heard += replies
        self.owed = max(0, self.owed - replies)
        return replies
