"""Frames of one CANopen node, to send and to read; CANopen is little-endian.

Identifiers are those that CiA 301 sets beforehand. What is sent is made once, but for the torque.
"""

from struct import Struct
from typing import Final

from rigd.devices.canbus import FRAME_SIZE, pack_frame
from rigd.devices.cia402.objects import (
    CONTROLWORD,
    HEARTBEAT_CONSUMER,
    MODE_DISPLAY,
    STATUSWORD,
    SYNC_ID,
)

NMT_START: Final = 0x01
NMT_STOP: Final = 0x02
NMT_PRE_OPERATIONAL: Final = 0x80

BOOT_UP: Final = 0x00
STOPPED: Final = 0x04
OPERATIONAL: Final = 0x05
PRE_OPERATIONAL: Final = 0x7F
NMT_STATES: Final = {
    BOOT_UP: "starting up",
    STOPPED: "stopped",
    OPERATIONAL: "operational",
    PRE_OPERATIONAL: "pre-operational",
}
"""Contents of a heartbeat."""

unpack_tpdo = Struct("<Hih").unpack
"""Statusword, position in counts, torque in 1/1000 of the rated one; ``struct.error`` if the
length is not 8."""
unpack_short_tpdo = Struct("<Hi").unpack
"""The same of a drive that does not tell its torque."""
_unpack_emergency = Struct("<HB").unpack_from
_pack_rpdo = Struct("<Hh4x").pack
_pack_sdo = Struct("<BHBI").pack
_unpack_sdo = Struct("<BHB4s").unpack

_SDO_UPLOAD: Final = 0x40
_SDO_DOWNLOAD_2: Final = 0x2B
_SDO_DOWNLOAD_4: Final = 0x23
_SDO_WRITTEN: Final = 0x60
_SDO_READ: Final = 0x40
"""Upper three bits of an upload's answer."""


class NodeFrames:
    """Everything that is sent to one drive, as 16 bytes each.

    Parameters
    ----------
    node_id
        Of the drive.
    host_node_id
        Of this computer.

    Attributes
    ----------
    sync, heartbeat
        SYNC without counter; heartbeat of this computer, operational.
    start, stop, pre_operational
        NMT commands.
    disable_voltage, forget_heartbeat, ask_mode, ask_statusword
        SDO requests: 6040 = 0; 1016:1 = 0, no more heartbeat expected; read 6061; read 6041.
    tpdo_id, rpdo_id, emergency_id, heartbeat_id, reply_id
        Identifiers of the drive's frames.
    """

    def __init__(self, node_id: int, host_node_id: int) -> None:
        self.tpdo_id = 0x180 + node_id
        self.rpdo_id = 0x200 + node_id
        self.emergency_id = 0x080 + node_id
        self.heartbeat_id = 0x700 + node_id
        self.reply_id = 0x580 + node_id
        request_id = 0x600 + node_id
        self.sync = pack_frame(SYNC_ID)
        self.heartbeat = pack_frame(0x700 + host_node_id, bytes([OPERATIONAL]))
        self.start = pack_frame(0, bytes([NMT_START, node_id]))
        self.stop = pack_frame(0, bytes([NMT_STOP, node_id]))
        self.pre_operational = pack_frame(0, bytes([NMT_PRE_OPERATIONAL, node_id]))
        self.disable_voltage = pack_frame(request_id, _pack_sdo(_SDO_DOWNLOAD_2, CONTROLWORD, 0, 0))
        self.forget_heartbeat = pack_frame(
            request_id, _pack_sdo(_SDO_DOWNLOAD_4, HEARTBEAT_CONSUMER, 1, 0)
        )
        self.ask_mode = pack_frame(request_id, _pack_sdo(_SDO_UPLOAD, MODE_DISPLAY, 0, 0))
        self.ask_statusword = pack_frame(request_id, _pack_sdo(_SDO_UPLOAD, STATUSWORD, 0, 0))
        self._rpdo_head = pack_frame(self.rpdo_id, bytes(4))[: FRAME_SIZE // 2]

    def rpdo(self, controlword: int, torque_per_mille: int) -> bytes:
        """Return the RPDO with controlword and torque in 1/1000 of the rated one (i16)."""
        return self._rpdo_head + _pack_rpdo(controlword, torque_per_mille)


def read_emergency(data: bytes) -> tuple[int, int, bytes] | None:
    """Return error code, error register and the vendor's bytes, or None if it is too short."""
    if len(data) < 3:
        return None
    code, register = _unpack_emergency(data)
    return code, register, data[3:]


def is_written(data: bytes, index: int, sub: int) -> bool:
    """Whether an SDO reply says that an object was written."""
    return len(data) == 8 and _unpack_sdo(data)[:3] == (_SDO_WRITTEN, index, sub)


def read_mode(data: bytes) -> int | None:
    """Return the mode of operation in an SDO reply, or None if it is not one of 6061."""
    value = _read(data, MODE_DISPLAY)
    return None if value is None else int.from_bytes(value[:1], "little", signed=True)


def read_statusword(data: bytes) -> int | None:
    """Return the statusword in an SDO reply, or None if it is not one of 6041."""
    value = _read(data, STATUSWORD)
    return None if value is None else int.from_bytes(value[:2], "little")


def _read(data: bytes, wanted: int) -> bytes | None:
    if len(data) != 8:
        return None
    command, index, sub, value = _unpack_sdo(data)
    if (index, sub) != (wanted, 0) or command & 0xE0 != _SDO_READ:
        return None
    return bytes(value)
