"""The NETCANOEM protocol: identifiers, requests and the content of replies.

An identifier is seven bits of base and four of opcode; a reply has the request's base, and the
opcodes named here. Everything of several bytes is big-endian.
"""

from struct import Struct, unpack

from rigd.devices.ati.calibration import text_of
from rigd.devices.canbus import pack_frame

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
"""Firmware (major, minor) from which on a box can be asked for counts per unit and unit codes."""
COUNTS_BEFORE_SCALE = 1_000_000
"""Counts per unit of force and of torque of older firmware."""
NEWTON, NEWTON_METRE = 2, 3
"""Unit codes that are assumed of older firmware, which has no request for them either."""

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
    """Return the six entries that three replies, end to end, hold two by two."""
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
