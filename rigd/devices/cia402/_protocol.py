"""CANopen and CiA 402 as the driver speaks them: states, frames and error codes.

`DriveState` follows from the statusword; a controlword leads from one state to the next.

`NodeFrames` holds the frames of one CANopen node, to send and to read; CANopen is little-endian.
Identifiers are those of the predefined connection set (CiA 301). Frames are packed once, except for
the torque. Indices of objects are in :mod:`rigd.devices.cia402.objects`.
"""

from enum import Enum
from struct import Struct
from typing import Final

from rigd.devices.canbus.port import FRAME_SIZE, pack_frame
from rigd.devices.cia402.objects import (
    CONTROLWORD,
    HEARTBEAT_CONSUMER,
    MODE_DISPLAY,
    STATUSWORD,
    SYNC_ID,
)

# States of CiA 402


class DriveState(Enum):
    """States of a drive, in the words of messages."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch-on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "no state of CiA 402"


DISABLE_VOLTAGE: Final = 0x00
SHUTDOWN: Final = 0x06
SWITCH_ON: Final = 0x07
ENABLE_OPERATION: Final = 0x0F
FAULT_RESET: Final = 0x80
"""Controlwords. A fault is reset by the rise of its bit."""

FAULT_BIT: Final = 0x0008
"""Set in fault and in fault reaction active."""
VOLTAGE_ENABLED: Final = 0x0010
"""The power stage is supplied; STO takes it from most drives."""
FOLLOWS_TARGET: Final = 0x1000
"""Bit 12 in cyclic synchronous torque mode: without it the drive ignores the target torque."""
STATE_BITS: Final = 0x006F
ENABLED: Final = 0x0027
"""Statusword in operation enabled, of its state bits."""

_TABLE: Final = (
    (0x4F, 0x00, DriveState.NOT_READY),
    (0x4F, 0x40, DriveState.SWITCH_ON_DISABLED),
    (0x6F, 0x21, DriveState.READY),
    (0x6F, 0x23, DriveState.SWITCHED_ON),
    (0x6F, 0x27, DriveState.OPERATION_ENABLED),
    (0x6F, 0x07, DriveState.QUICK_STOP),
    (0x4F, 0x0F, DriveState.FAULT_REACTION),
    (0x4F, 0x08, DriveState.FAULT),
)


OFF: Final = (
    DriveState.NOT_READY,
    DriveState.SWITCH_ON_DISABLED,
    DriveState.READY,
    DriveState.SWITCHED_ON,
    DriveState.FAULT,
)
"""States in which the motor exerts no torque."""


def state_of(statusword: int) -> DriveState:
    """Return the state that a statusword encodes."""
    for mask, value, state in _TABLE:
        if statusword & mask == value:
            return state
    return DriveState.UNKNOWN


# Frames

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
"""The same for a drive that does not report its torque."""
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
        Node number of the drive.
    host_node_id
        Node number of this computer.

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


# Error codes

# Most digits first. Classes: CiA 301; single codes: those on which vendors' manuals agree.
_WORDS: Final = (
    (0xFFFF, 0x3210, "over-voltage in the DC link"),
    (0xFFFF, 0x3220, "under-voltage in the DC link"),
    (0xFFFF, 0x4210, "the device is too hot"),
    (0xFFFF, 0x4310, "the power stage or the motor is too hot"),
    (0xFFFF, 0x8110, "CAN messages were lost (overrun)"),
    (0xFFFF, 0x8120, "its CAN controller is error-passive"),
    (0xFFFF, 0x8130, "heartbeat of this computer lost"),
    (0xFFFF, 0x8140, "it had been off the bus"),
    (0xFFFF, 0x8210, "PDO too short"),
    (0xFFFF, 0x8220, "PDO too long"),
    (0xFFFF, 0x8611, "following error"),
    (0xFF00, 0x0000, "no error"),
    (0xFF00, 0x1000, "generic error"),
    (0xFF00, 0x2100, "current at the input"),
    (0xFF00, 0x2200, "current inside the device"),
    (0xFF00, 0x2300, "current at the output"),
    (0xF000, 0x2000, "current"),
    (0xFF00, 0x3100, "mains voltage"),
    (0xFF00, 0x3200, "voltage inside the device"),
    (0xFF00, 0x3300, "voltage at the output"),
    (0xF000, 0x3000, "voltage"),
    (0xFF00, 0x4100, "ambient temperature"),
    (0xFF00, 0x4200, "temperature of the device"),
    (0xF000, 0x4000, "temperature"),
    (0xF000, 0x5000, "hardware of the device"),
    (0xFF00, 0x6100, "internal software"),
    (0xFF00, 0x6200, "user's software"),
    (0xFF00, 0x6300, "parameters"),
    (0xF000, 0x6000, "software"),
    (0xFF00, 0x7300, "encoder or other position sensor"),
    (0xF000, 0x7000, "additional module"),
    (0xFF00, 0x8100, "communication"),
    (0xFF00, 0x8200, "protocol"),
    (0xF000, 0x8000, "monitoring"),
    (0xF000, 0x9000, "external error"),
    (0xFF00, 0xFF00, "particular to the device: see its manual"),
    (0xF000, 0xF000, "additional function"),
)


def describe_error(code: int) -> str:
    """Return an error code of 16 bits in words, with the code."""
    for mask, value, words in _WORDS:
        if code & mask == value:
            return f"{words} (error code 0x{code:04X})"
    return f"error code 0x{code:04X}"
