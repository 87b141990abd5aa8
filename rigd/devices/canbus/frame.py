"""The kernel's ``struct can_frame``: identifier, length, up to eight bytes; 16 bytes in all.

Classical CAN with identifiers of 11 bits is all that the rig speaks.
"""

from struct import Struct

FRAME_SIZE = 16
ERROR_FLAG = 0x2000_0000
"""In the identifier of a frame by which a controller reports on itself (linux/can/error.h)."""
LONG_FLAG = 0x8000_0000
"""In the identifier of a frame that has 29 bits of it; no device of the rig sends such."""
REMOTE_FLAG = 0x4000_0000
"""In the identifier of a request for data; no device of the rig sends such either."""
ERROR_MASK = 0x1FFF_FFFF
SFF_MASK = 0x7FF

BUS_OFF = 0x40
"""Class of an error frame: the controller has switched itself off after too many errors."""
_PROTOCOL_VIOLATION = 0x08

_FRAME = Struct("=IB3x8s")
BUS_OFF_FRAME = _FRAME.pack(ERROR_FLAG | BUS_OFF, 8, bytes(8))
"""What the kernel reports then."""
DAMAGED_FRAME = _FRAME.pack(ERROR_FLAG | _PROTOCOL_VIOLATION, 8, bytes(8))
"""What stands in for a frame that came damaged; it is counted, and nothing else follows."""
LENGTH_AT = 4
"""Where the number of data bytes stands in a raw frame."""
read_head = Struct("=IB").unpack_from
"""Identifier with flags, and length, from raw frame."""


def pack_frame(can_id: int, data: bytes = b"") -> bytes:
    """Return the 16 bytes of a frame.

    Raises
    ------
    ValueError
        If the identifier has more than 11 bits, or there are more than eight bytes.
    """
    if not 0 <= can_id <= SFF_MASK:
        raise ValueError(f"{can_id:#x} is no CAN identifier of 11 bits.")
    if len(data) > 8:
        raise ValueError(f"{len(data)} bytes do not fit into a CAN frame, which has 8.")
    return _FRAME.pack(can_id, len(data), data)


def unpack_frame(raw: bytes) -> tuple[int, bytes]:
    """Return identifier (flags included) and data of 16 bytes; a length beyond 8 counts as 8."""
    can_id, length, data = _FRAME.unpack(raw)
    return can_id, data[: min(length, 8)]
