"""Frames on a CAN bus, and the port that every adapter offers (`rigd.devices.canbus.adapters`).

All ports use the layout of the kernel's ``struct can_frame``, 16 bytes with identifier, length and
up to eight data bytes. The rig uses only classical CAN with 11-bit identifiers.
"""

from collections.abc import Iterable
from struct import Struct
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import can

FRAME_SIZE = 16
"""Size of a raw CAN frame in bytes."""
ERROR_FRAME_FLAG = 0x2000_0000
"""Flag in the identifier of an error frame, with which the controller reports its state.

See linux/can/error.h."""
EXTENDED_ID_FLAG = 0x8000_0000
"""Flag in the identifier of a frame with 29 identifier bits; no device of the rig sends such
frames."""
REMOTE_REQUEST_FLAG = 0x4000_0000
"""Flag in the identifier of a remote request for data; no device of the rig sends such frames."""
ERROR_CLASS_MASK = 0x1FFF_FFFF
"""Mask of the error class in the identifier of an error frame."""
STANDARD_ID_MASK = 0x7FF
"""Mask of an 11-bit identifier (standard frame format)."""

BUS_OFF_ERROR_CLASS = 0x40
"""Class of an error frame: the controller has switched itself off after too many errors."""
_PROTOCOL_ERROR_CLASS = 0x08
"""Class of an error frame: a frame violated the protocol."""

_FRAME_LAYOUT = Struct("=IB3x8s")
"""Layout of a raw CAN frame: identifier with flags, length, data."""
BUS_OFF_FRAME = _FRAME_LAYOUT.pack(ERROR_FRAME_FLAG | BUS_OFF_ERROR_CLASS, 8, bytes(8))
"""Error frame with which the kernel reports that the controller is off the bus."""
DAMAGED_FRAME = _FRAME_LAYOUT.pack(ERROR_FRAME_FLAG | _PROTOCOL_ERROR_CLASS, 8, bytes(8))
"""Error frame that replaces an unreadable frame; it is counted, and has no other effect."""
DATA_LENGTH_OFFSET = 4
"""Offset of the number of data bytes in a raw frame."""
unpack_header = Struct("=IB").unpack_from
"""Unpack identifier (with flags) and number of data bytes from a raw frame."""


# Frames


def pack_frame(can_id: int, data: bytes = b"") -> bytes:
    """Return the raw frame of 16 bytes with an identifier and data.

    Parameters
    ----------
    can_id
        CAN identifier of 11 bits.
    data
        At most eight data bytes.

    Raises
    ------
    ValueError
        If the identifier has more than 11 bits, or there are more than eight bytes.

    Examples
    --------
    >>> from rigd.devices.canbus.port import pack_frame, unpack_frame
    >>> raw = pack_frame(0x181, b"rigd")
    >>> len(raw), unpack_frame(raw)
    (16, (385, b'rigd'))
    """
    if not 0 <= can_id <= STANDARD_ID_MASK:
        raise ValueError(f"{can_id:#x} is not an 11-bit CAN identifier.")
    if len(data) > 8:
        raise ValueError(f"{len(data)} bytes do not fit into a CAN frame, which has 8.")
    return _FRAME_LAYOUT.pack(can_id, len(data), data)


def unpack_frame(raw_frame: bytes) -> tuple[int, bytes]:
    """Return identifier (with flags) and data of a raw frame; a length above 8 counts as 8."""
    can_id, data_length, frame_data = _FRAME_LAYOUT.unpack(raw_frame)
    return can_id, frame_data[: min(data_length, 8)]


# Ports


class CanPort(Protocol):
    """Connection to a CAN bus, none of whose methods blocks except `wait`.

    Every error of an adapter's driver is raised as a `DeviceError`, except in `close`, which never
    raises.
    """

    name: str
    """Name of the bus, for messages."""

    def send(self, frame: bytes) -> None:
        """Send a raw frame of 16 bytes, made by :func:`rigd.devices.canbus.port.pack_frame`.

        Raises
        ------
        DeviceError
            If the bus does not accept the frame.
        """

    def receive(self) -> bytes | None:
        """Return the next received raw frame of 16 bytes, or None if no frame has arrived.

        An unreadable frame is returned as an error frame.

        Raises
        ------
        DeviceError
            If the bus is gone.
        """

    def wait(self, timeout_s: float) -> None:
        """Wait until a frame may have arrived, at most for the timeout.

        Raises
        ------
        DeviceError
            If the bus is gone.
        """

    def accept(self, can_ids: Iterable[int] | None) -> None:
        """Accept only frames with these identifiers, and error frames of the controller.

        If `can_ids` is None, all frames are accepted again.

        Raises
        ------
        DeviceError
            If the bus is gone.
        """

    def open_bus(self) -> "can.BusABC":
        """Return a python-can bus on this port, for set-up; closing the bus keeps the port open."""

    def close(self) -> None:
        """Close the port to the CAN bus; harmless when repeated."""
