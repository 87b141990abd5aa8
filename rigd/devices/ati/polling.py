"""Polls of a NETCANOEM box, and the two frames of each reply brought together.

The protocol has no counter: nothing in a reply says to which poll it belongs. Hence only one poll
is on its way at a time. One that is given up leaves its reply a period to come and be dropped; a
reply that is later than that cannot be told from the reply to a newer poll.
"""

import time

from rigd.devices.ati.netcanoem import GAUGES, GAUGES_REST, REPLY_LENGTHS
from rigd.devices.canbus import CanExchange
from rigd.devices.contracts import DeviceError

Answer = tuple[bytes, bytes]
"""The data of both frames of a reading."""

_FIRST_LENGTH = REPLY_LENGTHS[GAUGES]
_SECOND_LENGTH = REPLY_LENGTHS[GAUGES_REST]


class GaugePolls:
    """The poll on its way, and what came of it.

    Parameters
    ----------
    frame
        The request, of 16 bytes.
    name
        Of the sensor, for messages.

    Attributes
    ----------
    answer : tuple of bytes, or None
        To the last poll.
    expected : bool
        The last poll has no answer yet and has not been given up.
    sent_ns, turnaround_ns : int
        When the last poll was sent (``time.monotonic_ns``); from a poll to its answer.
    surplus_frames : int
        Frames that belonged to no poll, lacked their other half or had the wrong length.
    """

    __slots__ = (
        "_exchange",
        "_first",
        "_frame",
        "_name",
        "answer",
        "expected",
        "sent_ns",
        "surplus_frames",
        "turnaround_ns",
    )

    def __init__(self, frame: bytes, name: str) -> None:
        self._frame = frame
        self._name = name
        self.surplus_frames = 0
        self.turnaround_ns = 0
        self.sent_ns = 0
        self._exchange: CanExchange | None = None
        self._first: bytes | None = None
        self.answer: Answer | None = None
        self.expected = False

    def open(self, exchange: CanExchange) -> None:
        """Use this exchange from now on."""
        self._exchange = exchange
        self.forget()

    def close(self) -> None:
        """Use none."""
        self._exchange = None
        self.forget()

    @property
    def exchange(self) -> CanExchange:
        """The open one.

        Raises
        ------
        DeviceError
            If there is none.
        """
        if self._exchange is None:
            raise DeviceError(f"{self._name}: it is not connected.")
        return self._exchange

    def settle(self) -> bool:
        """Take or drop all that has come; say whether no poll is without an answer."""
        self.exchange.drain()
        return not self.expected

    def send(self) -> None:
        """Poll the sensor."""
        self._first = None
        self.answer = None
        self.expected = True
        self.sent_ns = time.monotonic_ns()
        self.exchange.send(self._frame)

    def wait(self, deadline_ns: int) -> Answer | None:
        """Return the answer to the last poll as soon as it has come, or None at the deadline."""
        if self.expected:
            self.exchange.wait_until(self._has_answer, deadline_ns)
        return self.answer

    def forget(self) -> None:
        """Give the last poll up; what still comes is dropped."""
        self._first = None
        self.answer = None
        self.expected = False

    def take_first(self, data: bytes) -> None:
        """Take the first frame of a reply; it replaces one whose second frame was lost."""
        if self.expected and len(data) == _FIRST_LENGTH:
            self._first = data
        else:
            self.surplus_frames += 1

    def take_second(self, data: bytes) -> None:
        """Take the second frame of a reply."""
        first = self._first
        if first is None or len(data) != _SECOND_LENGTH:
            self.surplus_frames += 1
            return
        self.answer = (first, data)
        self._first = None
        self.expected = False
        self.turnaround_ns = time.monotonic_ns() - self.sent_ns

    def _has_answer(self) -> bool:
        return self.answer is not None
