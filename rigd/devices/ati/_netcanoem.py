"""The NETCANOEM protocol: requests and replies, and the polls of a box.

An identifier is seven bits of base and four of opcode; a reply has the request's base, and the
opcodes named here. Everything of several bytes is big-endian.

A poll is answered by two frames, which `GaugePolls` brings together. The protocol has no counter:
nothing in a reply says to which poll it belongs. So both frames are counted (`ReplyPairing` in
`rigd.devices.canbus`), each for itself, for either may be lost or late; where it is in doubt whose
they are, a tick is left without a poll.
"""

import time
from struct import Struct, unpack

from rigd.devices.ati._calibration import text_of
from rigd.devices.canbus import CanExchange, ReplyPairing
from rigd.devices.canbus.port import pack_frame
from rigd.devices.contracts import DeviceError

GAUGES = 0x0
GAUGES_REST = 0x1
MATRIX_ROW = 0x2
MATRIX_ROW_REPLIES = (0x2, 0x3, 0x4)
SERIAL_NUMBER = 0x5
SELECT_CALIBRATION = 0x6
COUNTS_PER_UNIT = 0x7
UNIT_CODES = 0x8
FIRMWARE = 0xF

REPLY_LENGTHS = {
    GAUGES: 8,
    GAUGES_REST: 6,
    **dict.fromkeys(MATRIX_ROW_REPLIES, 8),
    SERIAL_NUMBER: 8,
    SELECT_CALIBRATION: 1,
    COUNTS_PER_UNIT: 8,
    UNIT_CODES: 2,
    FIRMWARE: 4,
}
"""Bytes in the reply of each opcode that the driver uses."""

FIRST_FIRMWARE_WITH_SCALE = (3, 7)
"""First firmware (major, minor) that reports counts per unit and unit codes."""
COUNTS_BEFORE_SCALE = 1_000_000
"""Counts per unit of force and of torque with older firmware."""
NEWTON, NEWTON_METRE = 2, 3
"""Unit codes assumed for older firmware, which does not report them."""

read_gauges = Struct(">Hhhh").unpack
"""Status word and gauges 0, 2, 4 from the first reply to GAUGES."""
read_gauges_rest = Struct(">hhh").unpack
"""Gauges 1, 3, 5 from the second."""


def identifier(base: int, opcode: int) -> int:
    """Return the CAN identifier of a message."""
    return base << 4 | opcode


def request(base: int, opcode: int, *arguments: int) -> bytes:
    """Return the frame of a request, ready to send."""
    return pack_frame(identifier(base, opcode), bytes(arguments))


def matrix_row(replies: bytes) -> tuple[float, ...]:
    """Return the six entries of three concatenated replies, two in each."""
    return unpack(">6f", replies)


def serial_number(reply: bytes) -> str:
    """Return it as text."""
    return text_of(reply)


def counts_per_unit(reply: bytes) -> tuple[int, int]:
    """Return counts per unit of force and of torque."""
    force, torque = unpack(">II", reply)
    return force, torque


def firmware(reply: bytes) -> tuple[int, int, int]:
    """Return major, minor and build number."""
    major, minor, build = unpack(">BBH", reply)
    return major, minor, build


# Polls

Answer = tuple[bytes, bytes]
"""The data of both frames of a reading."""


class _Frames:
    """One of the two frames of a reply: the last one received, and the count."""

    __slots__ = ("_length", "data", "replies")

    def __init__(self, length: int) -> None:
        self._length = length
        self.data = b""
        self.replies = 0

    def take(self, data: bytes) -> None:
        """Store a frame; one of the wrong length counts as empty."""
        self.replies += 1
        self.data = data if len(data) == self._length else b""


class GaugePolls:
    """Polls of a box, and their answers.

    Parameters
    ----------
    frame
        The request, of 16 bytes.
    name
        Name of the sensor, for messages.

    Attributes
    ----------
    answer : tuple of bytes, or None
        Answer to the last poll, as of the last `process_replies`.
    sent_ns, turnaround_ns : int
        Time of the last poll (``time.monotonic_ns``), and time from a poll to its answer.
    """

    __slots__ = (
        "_exchange",
        "_first",
        "_firsts",
        "_frame",
        "_name",
        "_second",
        "_seconds",
        "answer",
        "sent_ns",
        "turnaround_ns",
    )

    def __init__(self, frame: bytes, name: str) -> None:
        self._frame = frame
        self._name = name
        self.turnaround_ns = 0
        self.sent_ns = 0
        self._exchange: CanExchange | None = None
        self._first = _Frames(REPLY_LENGTHS[GAUGES])
        self._second = _Frames(REPLY_LENGTHS[GAUGES_REST])
        self._firsts = ReplyPairing(self._first)
        self._seconds = ReplyPairing(self._second)
        self.answer: Answer | None = None

    def open(self, exchange: CanExchange) -> None:
        """Start to use an exchange."""
        self._exchange = exchange
        self.forget()

    def close(self) -> None:
        """Stop using the exchange."""
        self._exchange = None
        self.forget()

    @property
    def exchange(self) -> CanExchange:
        """The open exchange.

        Raises
        ------
        DeviceError
            If there is none.
        """
        if self._exchange is None:
            raise DeviceError(f"{self._name}: it is not connected.")
        return self._exchange

    @property
    def lost(self) -> int:
        """Number of replies known to be lost."""
        return max(self._firsts.lost, self._seconds.lost)

    def subscribe(self, first_id: int, second_id: int) -> None:
        """Subscribe to the frames of these identifiers."""
        self.exchange.subscribe(first_id, self._first.take)
        self.exchange.subscribe(second_id, self._second.take)

    def drain(self) -> None:
        """Deliver everything that has arrived."""
        self.exchange.drain()

    def send(self) -> None:
        """Poll the sensor."""
        self._firsts.register_request()
        self._seconds.register_request()
        self.answer = None
        self.sent_ns = time.monotonic_ns()
        self.exchange.send(self._frame)

    def send_or_pause(self) -> None:
        """Poll, or leave the poll out for one tick to restore the pairing of replies."""
        firsts, seconds = self._firsts, self._seconds
        if (
            firsts.outstanding or seconds.outstanding
        ) and firsts.needs_pause() | seconds.needs_pause():
            self.register_pause()
        else:
            self.send()

    def register_pause(self) -> None:
        """Leave a tick without a poll."""
        self._firsts.register_pause()
        self._seconds.register_pause()
        self.answer = None
        self.sent_ns = time.monotonic_ns()

    def wait(self, deadline_ns: int) -> Answer | None:
        """Return the answer to the last poll as soon as it has come, or None at the deadline."""
        if self.answer is None:
            self.exchange.wait_until(self._have_caught_up, deadline_ns)
        return self.process_replies()

    def process_replies(self) -> Answer | None:
        """Return the answer to the last poll if it has been delivered, else None."""
        if self._firsts.process_replies() & self._seconds.process_replies():
            first, second = self._first.data, self._second.data
            if first and second:
                self.answer = (first, second)
                self.turnaround_ns = time.monotonic_ns() - self.sent_ns
        return self.answer

    def forget(self) -> None:
        """Reset the pairing: no reply is outstanding."""
        self._firsts.start()
        self._seconds.start()
        self.answer = None

    def _have_caught_up(self) -> bool:
        return self._firsts.is_up_to_date() and self._seconds.is_up_to_date()
