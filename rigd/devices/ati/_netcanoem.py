"""Protocol of the NETCANOEM box on CAN: requests and replies, and the cyclic polls.

A CAN identifier consists of seven bits of base and four of opcode. A reply has the base of the
request, and one of the opcodes defined here. Numbers of several bytes are big-endian.

A poll is answered by two frames, which `GaugePolls` combines. Either may be lost or late, and
nothing in it states to which poll it belongs. So polls and the frames of each kind are counted
(`ReplyPairing` in `rigd.devices.canbus`). In case of doubt one tick is run without a poll.
"""

import time
from struct import Struct, unpack

from rigd.devices.ati._calibration import printable_text
from rigd.devices.canbus import CanExchange, ReplyPairing
from rigd.devices.canbus.port import pack_frame
from rigd.devices.contracts import DeviceError

GAUGES_OPCODE = 0x0
"""Opcode of a poll, and of its first reply with status word and gauges 0, 2, 4."""
REMAINING_GAUGES_OPCODE = 0x1
"""Opcode of the second reply to a poll, with gauges 1, 3, 5."""
MATRIX_ROW_OPCODE = 0x2
"""Opcode of the request for a row of the calibration matrix."""
MATRIX_ROW_REPLY_OPCODES = (0x2, 0x3, 0x4)
"""Opcodes of the three replies with a row of the calibration matrix."""
SERIAL_NUMBER_OPCODE = 0x5
"""Opcode of the request for the sensor's serial number."""
SELECT_CALIBRATION_OPCODE = 0x6
"""Opcode of the request to select a calibration."""
COUNTS_PER_UNIT_OPCODE = 0x7
"""Opcode of the request for the counts per unit of force and of torque."""
UNIT_CODES_OPCODE = 0x8
"""Opcode of the request for the codes of the units of force and torque."""
FIRMWARE_OPCODE = 0xF
"""Opcode of the request for the version of the firmware."""

REPLY_LENGTHS = {
    GAUGES_OPCODE: 8,
    REMAINING_GAUGES_OPCODE: 6,
    **dict.fromkeys(MATRIX_ROW_REPLY_OPCODES, 8),
    SERIAL_NUMBER_OPCODE: 8,
    SELECT_CALIBRATION_OPCODE: 1,
    COUNTS_PER_UNIT_OPCODE: 8,
    UNIT_CODES_OPCODE: 2,
    FIRMWARE_OPCODE: 4,
}
"""Number of data bytes in the reply with each opcode that the driver uses."""

FIRST_FIRMWARE_WITH_SCALE = (3, 7)
"""First firmware version (major, minor) that reports counts per unit and unit codes."""
OLD_FIRMWARE_COUNTS_PER_UNIT = 1_000_000
"""Counts per unit of force and of torque with older firmware, which does not report them."""
NEWTON_CODE, NEWTON_METRE_CODE = 2, 3
"""Unit codes of force and torque assumed for older firmware, which does not report them."""

read_gauges = Struct(">Hhhh").unpack
"""Unpack status word and gauges 0, 2, 4 from the first reply to a poll."""
read_remaining_gauges = Struct(">hhh").unpack
"""Unpack gauges 1, 3, 5 from the second reply to a poll."""


def can_identifier(base_id: int, opcode: int) -> int:
    """Return the CAN identifier of the box's messages with an opcode: 16 times base plus opcode."""
    return base_id << 4 | opcode


def request(base_id: int, opcode: int, *arguments: int) -> bytes:
    """Return the raw CAN frame of a request."""
    return pack_frame(can_identifier(base_id, opcode), bytes(arguments))


def matrix_row(reply_bytes: bytes) -> tuple[float, ...]:
    """Unpack the six entries of a calibration matrix row from three concatenated replies."""
    return unpack(">6f", reply_bytes)


def serial_number(reply: bytes) -> str:
    """Decode the sensor's serial number in a reply to text."""
    return printable_text(reply)


def counts_per_unit(reply: bytes) -> tuple[int, int]:
    """Unpack the counts per unit of force and per unit of torque from a reply."""
    counts_per_force, counts_per_torque = unpack(">II", reply)
    return counts_per_force, counts_per_torque


def firmware_version(reply: bytes) -> tuple[int, int, int]:
    """Unpack major, minor and build number of the NETCANOEM box's firmware from a reply."""
    major_number, minor_number, build_number = unpack(">BBH", reply)
    return major_number, minor_number, build_number


# Polls

PollReply = tuple[bytes, bytes]
"""Data of the two frames that answer a poll."""


class _FrameReceiver:
    """Receiver of one of the two frames that answer a poll; stores the last one and counts all."""

    __slots__ = ("_expected_length", "data", "reply_count")

    def __init__(self, expected_length: int) -> None:
        self._expected_length = expected_length
        self.data = b""
        self.reply_count = 0

    def store(self, frame_data: bytes) -> None:
        """Count a received frame and store its data, or no data if the length is wrong."""
        self.reply_count += 1
        self.data = frame_data if len(frame_data) == self._expected_length else b""


class GaugePolls:
    """Polls that the control loop sends to a NETCANOEM box, and the pairing of their replies.

    `poll_frame` is the raw CAN frame of a poll; the sensor's name is for messages.

    Attributes
    ----------
    answer : tuple of bytes, or None
        Reply to the last poll, or None if `process_replies` has not found it yet.
    sent_ns, turnaround_ns : int
        Time of the last poll (``time.monotonic_ns``), and duration from a poll to its reply.
    """

    __slots__ = (
        "_exchange",
        "_first_frame",
        "_first_pairing",
        "_frame",
        "_name",
        "_second_frame",
        "_second_pairing",
        "answer",
        "sent_ns",
        "turnaround_ns",
    )

    def __init__(self, poll_frame: bytes, sensor_name: str) -> None:
        self._frame = poll_frame
        self._name = sensor_name
        self.turnaround_ns = 0
        self.sent_ns = 0
        self._exchange: CanExchange | None = None
        self._first_frame = _FrameReceiver(REPLY_LENGTHS[GAUGES_OPCODE])
        self._second_frame = _FrameReceiver(REPLY_LENGTHS[REMAINING_GAUGES_OPCODE])
        self._first_pairing = ReplyPairing(self._first_frame)
        self._second_pairing = ReplyPairing(self._second_frame)
        self.answer: PollReply | None = None

    def open(self, exchange: CanExchange) -> None:
        """Start polling on an open CAN exchange; replies to earlier polls are not expected."""
        self._exchange = exchange
        self.reset_pairing()

    def close(self) -> None:
        """Stop using the CAN exchange."""
        self._exchange = None
        self.reset_pairing()

    @property
    def exchange(self) -> CanExchange:
        """CAN exchange in use; reading it raises `DeviceError` if there is none."""
        if self._exchange is None:
            raise DeviceError(f"{self._name}: it is not connected.")
        return self._exchange

    @property
    def lost_reply_count(self) -> int:
        """Number of polls whose reply counts as lost."""
        return max(self._first_pairing.lost_reply_count, self._second_pairing.lost_reply_count)

    def subscribe(self, first_reply_id: int, second_reply_id: int) -> None:
        """Subscribe to the two frames that answer a poll, by their CAN identifiers."""
        self.exchange.subscribe(first_reply_id, self._first_frame.store)
        self.exchange.subscribe(second_reply_id, self._second_frame.store)

    def deliver_frames(self) -> None:
        """Deliver all frames that have arrived on the CAN bus to their drivers."""
        self.exchange.deliver_frames()

    def send(self) -> None:
        """Send a poll to the sensor."""
        self._first_pairing.register_request()
        self._second_pairing.register_request()
        self.answer = None
        self.sent_ns = time.monotonic_ns()
        self.exchange.send(self._frame)

    def send_or_pause(self) -> None:
        """Send a poll, or omit it in this tick to find out if a missing reply is late or lost."""
        first_pairing, second_pairing = self._first_pairing, self._second_pairing
        if (
            first_pairing.outstanding or second_pairing.outstanding
        ) and first_pairing.needs_pause() | second_pairing.needs_pause():
            self.register_pause()
        else:
            self.send()

    def register_pause(self) -> None:
        """Register that this tick sends no poll."""
        self._first_pairing.register_pause()
        self._second_pairing.register_pause()
        self.answer = None
        self.sent_ns = time.monotonic_ns()

    def wait(self, deadline_ns: int) -> PollReply | None:
        """Return the reply to the last poll as soon as it arrives, or None at the deadline."""
        if self.answer is None:
            self.exchange.wait_until(self._are_up_to_date, deadline_ns)
        return self.process_replies()

    def process_replies(self) -> PollReply | None:
        """Return the reply to the last poll if it has been received, else None."""
        if self._first_pairing.process_replies() & self._second_pairing.process_replies():
            first_data, second_data = self._first_frame.data, self._second_frame.data
            if first_data and second_data:
                self.answer = (first_data, second_data)
                self.turnaround_ns = time.monotonic_ns() - self.sent_ns
        return self.answer

    def reset_pairing(self) -> None:
        """Reset the pairing of polls and replies; from then on no reply is outstanding."""
        self._first_pairing.reset()
        self._second_pairing.reset()
        self.answer = None

    def _are_up_to_date(self) -> bool:
        """Return whether both frames of the reply to the last poll have arrived."""
        return self._first_pairing.is_up_to_date() and self._second_pairing.is_up_to_date()
