"""python-can bus on one of this package's CAN ports, by which canopen configures a drive."""

import sys
import time

import can

from rigd.devices.canbus.port import (
    ERROR_CLASS_MASK,
    ERROR_FRAME_FLAG,
    EXTENDED_ID_FLAG,
    REMOTE_REQUEST_FLAG,
    STANDARD_ID_MASK,
    CanPort,
    pack_frame,
    unpack_frame,
    unpack_header,
)


class SetupBus(can.BusABC):
    """python-can bus on a CAN port; shutting the bus down leaves the port open."""

    def __init__(self, port: CanPort) -> None:
        self._port = port
        self.channel_info = port.name
        super().__init__(channel=port.name)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        """Send a message at once; the port does not block."""
        self._port.send(from_message(msg))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        """Return the next message or None, and False because the port does not filter frames."""
        raw_frame = self._port.receive()
        if raw_frame is None:
            self._port.wait(1.0 if timeout is None else timeout)
            raw_frame = self._port.receive()
        # canopen ignores the flags of a frame and checks only its identifier.
        if raw_frame is None or unpack_header(raw_frame)[0] & (
            EXTENDED_ID_FLAG | REMOTE_REQUEST_FLAG
        ):
            return None, False
        return to_message(raw_frame), False


def to_message(raw_frame: bytes) -> can.Message:
    """Convert a raw frame of 16 bytes to a python-can message."""
    can_id, data = unpack_frame(raw_frame)
    is_standard_id = not can_id & (EXTENDED_ID_FLAG | ERROR_FRAME_FLAG)
    return can.Message(
        timestamp=time.time(),
        arbitration_id=can_id & (STANDARD_ID_MASK if is_standard_id else ERROR_CLASS_MASK),
        is_extended_id=bool(can_id & EXTENDED_ID_FLAG),
        is_remote_frame=bool(can_id & REMOTE_REQUEST_FLAG),
        is_error_frame=bool(can_id & ERROR_FRAME_FLAG),
        data=data,
    )


def from_message(message: can.Message) -> bytes:
    """Convert a python-can message to a raw frame of 16 bytes.

    The flags in the identifier distinguish other kinds of frames from the frames of the rig, whose
    identifiers have no flags.
    """
    can_id = message.arbitration_id
    if message.is_error_frame:
        can_id |= ERROR_FRAME_FLAG
    if message.is_extended_id:
        can_id |= EXTENDED_ID_FLAG
    if message.is_remote_frame:
        can_id |= REMOTE_REQUEST_FLAG
    return can_id.to_bytes(4, sys.byteorder) + pack_frame(0, bytes(message.data))[4:]
