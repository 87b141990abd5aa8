"""A python-can bus on one of our ports, with which the canopen library sets a drive up."""

import sys
import time

import can

from rigd.devices.canbus.port import (
    ERROR_FLAG,
    ERROR_MASK,
    LONG_FLAG,
    REMOTE_FLAG,
    SFF_MASK,
    CanPort,
    pack_frame,
    read_head,
    unpack_frame,
)


class SetupBus(can.BusABC):
    """Bus of python-can on a port; shutting it down leaves the port open."""

    def __init__(self, port: CanPort) -> None:
        self._port = port
        self.channel_info = port.name
        super().__init__(channel=port.name)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:  # noqa: ARG002
        """Send at once; the port does not block."""
        self._port.send(from_message(msg))

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        raw = self._port.receive()
        if raw is None:
            self._port.wait(1.0 if timeout is None else timeout)
            raw = self._port.receive()
        # canopen ignores the kind of a frame and checks only its identifier.
        if raw is None or read_head(raw)[0] & (LONG_FLAG | REMOTE_FLAG):
            return None, False
        return to_message(raw), False


def to_message(raw: bytes) -> can.Message:
    """Return python-can's message of 16 bytes."""
    can_id, data = unpack_frame(raw)
    short = not can_id & (LONG_FLAG | ERROR_FLAG)
    return can.Message(
        timestamp=time.time(),
        arbitration_id=can_id & (SFF_MASK if short else ERROR_MASK),
        is_extended_id=bool(can_id & LONG_FLAG),
        is_remote_frame=bool(can_id & REMOTE_FLAG),
        is_error_frame=bool(can_id & ERROR_FLAG),
        data=data,
    )


def from_message(message: can.Message) -> bytes:
    """Return the 16 bytes of python-can's message.

    The flags keep frames of other kinds apart from those of the rig, whose identifiers have none.
    """
    can_id = message.arbitration_id
    if message.is_error_frame:
        can_id |= ERROR_FLAG
    if message.is_extended_id:
        can_id |= LONG_FLAG
    if message.is_remote_frame:
        can_id |= REMOTE_FLAG
    return can_id.to_bytes(4, sys.byteorder) + pack_frame(0, bytes(message.data))[4:]
