"""Protocol of a CiA 402 drive over CANopen: drive states, frames and error codes.

The statusword encodes the `DriveState`; controlwords command transitions between the states.

`NodeFrames` holds the frames to one CANopen node, and the CAN identifiers of the frames from it.
CANopen is little-endian. Identifiers are those of the predefined connection set (CiA 301). Frames
are packed once, except for the torque. Indices of objects are in
:mod:`rigd.devices.cia402.objects`.
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
    SYNC_CAN_ID,
)

# States of CiA 402


class DriveState(Enum):
    """State of a CiA 402 drive; the value is its name in messages."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch-on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"
    UNKNOWN = "not a state of CiA 402"


DISABLE_VOLTAGE_COMMAND: Final = 0x00
"""Controlword that switches the drive off."""
SHUTDOWN_COMMAND: Final = 0x06
"""Controlword that commands the drive to ready to switch on."""
SWITCH_ON_COMMAND: Final = 0x07
"""Controlword that commands the drive to switched on."""
ENABLE_OPERATION_COMMAND: Final = 0x0F
"""Controlword that commands the drive to operation enabled."""
FAULT_RESET_COMMAND: Final = 0x80
"""Controlword that resets a fault, by the rise of its bit 7."""

FAULT_BIT: Final = 0x0008
"""Statusword bit that is set in the states fault and fault reaction active."""
VOLTAGE_ENABLED_BIT: Final = 0x0010
"""Statusword bit that is set while the power stage is supplied; STO cuts the supply of most
drives."""
FOLLOWS_TARGET_BIT: Final = 0x1000
"""Statusword bit 12 in cyclic torque mode: without it the drive ignores the target torque."""
STATE_BITS: Final = 0x006F
"""Statusword bits that encode the drive's state."""
OPERATION_ENABLED_BITS: Final = 0x0027
"""Value of the statusword's state bits in operation enabled."""

_STATE_CODES: Final = (
    (0x4F, 0x00, DriveState.NOT_READY),
    (0x4F, 0x40, DriveState.SWITCH_ON_DISABLED),
    (0x6F, 0x21, DriveState.READY),
    (0x6F, 0x23, DriveState.SWITCHED_ON),
    (0x6F, 0x27, DriveState.OPERATION_ENABLED),
    (0x6F, 0x07, DriveState.QUICK_STOP),
    (0x4F, 0x0F, DriveState.FAULT_REACTION),
    (0x4F, 0x08, DriveState.FAULT),
)
"""Drive state by the value of masked statusword bits: mask, value, state."""


TORQUE_FREE_STATES: Final = (
    DriveState.NOT_READY,
    DriveState.SWITCH_ON_DISABLED,
    DriveState.READY,
    DriveState.SWITCHED_ON,
    DriveState.FAULT,
)
"""States in which the motor exerts no torque."""


def drive_state(statusword: int) -> DriveState:
    """Return the drive state that a statusword encodes."""
    for state_mask, state_code, state in _STATE_CODES:
        if statusword & state_mask == state_code:
            return state
    return DriveState.UNKNOWN


# Frames

NMT_START: Final = 0x01
"""NMT command that brings a node to operational."""
NMT_STOP: Final = 0x02
"""NMT command that stops a node."""
NMT_PRE_OPERATIONAL: Final = 0x80
"""NMT command that brings a node to pre-operational."""

BOOT_UP_STATE: Final = 0x00
"""NMT state in the first heartbeat after the start of a node."""
STOPPED_STATE: Final = 0x04
"""NMT state of a stopped node, in its heartbeat."""
OPERATIONAL_STATE: Final = 0x05
"""NMT state of an operational node, in its heartbeat."""
PRE_OPERATIONAL_STATE: Final = 0x7F
"""NMT state of a pre-operational node, in its heartbeat."""
NMT_STATES: Final = {
    BOOT_UP_STATE: "starting up",
    STOPPED_STATE: "stopped",
    OPERATIONAL_STATE: "operational",
    PRE_OPERATIONAL_STATE: "pre-operational",
}
"""Names of the NMT states in messages, by the value in a heartbeat."""

unpack_tpdo = Struct("<Hih").unpack
"""Unpack a TPDO: statusword, position in counts, torque in 1/1000 of the rated torque.

Raises ``struct.error`` if the length is not 8 bytes."""
unpack_short_tpdo = Struct("<Hi").unpack
"""Unpack the TPDO of a drive that does not report its torque: statusword, position in counts."""
_unpack_emergency = Struct("<HB").unpack_from
"""Unpack error code and error register from the beginning of an emergency message."""
_pack_rpdo = Struct("<Hh4x").pack
"""Pack controlword and target torque into the data half of a raw CAN frame."""
_pack_sdo = Struct("<BHBI").pack
"""Pack an expedited SDO request: command, index, sub-index, value."""
_unpack_sdo = Struct("<BHB4s").unpack
"""Unpack an expedited SDO reply: command, index, sub-index, data."""

_SDO_READ_COMMAND: Final = 0x40
"""Command byte of an SDO request to read an object."""
_SDO_WRITE_2_BYTES_COMMAND: Final = 0x2B
"""Command byte of an SDO request to write 2 bytes."""
_SDO_WRITE_4_BYTES_COMMAND: Final = 0x23
"""Command byte of an SDO request to write 4 bytes."""
_SDO_WRITE_REPLY: Final = 0x60
"""Command byte of the SDO reply that confirms a write request."""
_SDO_READ_REPLY: Final = 0x40
"""Upper three bits of the command byte in the SDO reply to a read request."""


class NodeFrames:
    """Prepared CAN frames to one drive (16 bytes each), and identifiers of the drive's frames.

    `node_id` is the drive's node number, and `host_node_id` that of this computer.

    Attributes
    ----------
    sync, heartbeat
        SYNC without counter; heartbeat of this computer in the NMT state operational.
    start, stop, pre_operational
        NMT commands to the drive.
    disable_voltage, end_heartbeat_monitoring, read_mode_request, read_statusword_request
        SDO requests: write controlword 0; end the monitoring of this computer's heartbeat (1016:1 =
        0); read the mode (6061); read the statusword (6041).
    tpdo_id, rpdo_id, emergency_id, heartbeat_id, reply_id
        CAN identifiers of the drive's PDOs, emergency messages, heartbeats and SDO replies.
    """

    def __init__(self, node_id: int, host_node_id: int) -> None:
        self.tpdo_id = 0x180 + node_id
        self.rpdo_id = 0x200 + node_id
        self.emergency_id = 0x080 + node_id
        self.heartbeat_id = 0x700 + node_id
        self.reply_id = 0x580 + node_id
        request_id = 0x600 + node_id
        self.sync = pack_frame(SYNC_CAN_ID)
        self.heartbeat = pack_frame(0x700 + host_node_id, bytes([OPERATIONAL_STATE]))
        self.start = pack_frame(0, bytes([NMT_START, node_id]))
        self.stop = pack_frame(0, bytes([NMT_STOP, node_id]))
        self.pre_operational = pack_frame(0, bytes([NMT_PRE_OPERATIONAL, node_id]))
        self.disable_voltage = pack_frame(
            request_id, _pack_sdo(_SDO_WRITE_2_BYTES_COMMAND, CONTROLWORD, 0, 0)
        )
        self.end_heartbeat_monitoring = pack_frame(
            request_id, _pack_sdo(_SDO_WRITE_4_BYTES_COMMAND, HEARTBEAT_CONSUMER, 1, 0)
        )
        self.read_mode_request = pack_frame(
            request_id, _pack_sdo(_SDO_READ_COMMAND, MODE_DISPLAY, 0, 0)
        )
        self.read_statusword_request = pack_frame(
            request_id, _pack_sdo(_SDO_READ_COMMAND, STATUSWORD, 0, 0)
        )
        self._rpdo_header = pack_frame(self.rpdo_id, bytes(4))[: FRAME_SIZE // 2]

    def rpdo_frame(self, controlword: int, torque_per_mille: int) -> bytes:
        """Return the RPDO frame with controlword and torque in 1/1000 of the rated torque (i16)."""
        return self._rpdo_header + _pack_rpdo(controlword, torque_per_mille)


def read_emergency(emergency_data: bytes) -> tuple[int, int, bytes] | None:
    """Return error code, error register and vendor's bytes of an emergency message, or None.

    The result is None if the message is too short.
    """
    if len(emergency_data) < 3:
        return None
    error_code, error_register = _unpack_emergency(emergency_data)
    return error_code, error_register, emergency_data[3:]


def confirms_write(sdo_reply: bytes, index: int, subindex: int) -> bool:
    """Return whether an SDO reply confirms that an object was written."""
    return len(sdo_reply) == 8 and _unpack_sdo(sdo_reply)[:3] == (_SDO_WRITE_REPLY, index, subindex)


def read_mode(sdo_reply: bytes) -> int | None:
    """Return the mode of operation in an SDO reply, or None if the reply is not for object 6061."""
    mode_bytes = _object_bytes_in_reply(sdo_reply, MODE_DISPLAY)
    return None if mode_bytes is None else int.from_bytes(mode_bytes[:1], "little", signed=True)


def read_statusword(sdo_reply: bytes) -> int | None:
    """Return the statusword in an SDO reply, or None if the reply is not for object 6041."""
    status_bytes = _object_bytes_in_reply(sdo_reply, STATUSWORD)
    return None if status_bytes is None else int.from_bytes(status_bytes[:2], "little")


def _object_bytes_in_reply(sdo_reply: bytes, expected_index: int) -> bytes | None:
    """Return the data of an SDO reply to a read request, or None if it is for another object."""
    if len(sdo_reply) != 8:
        return None
    sdo_command, reply_index, subindex, value_bytes = _unpack_sdo(sdo_reply)
    if (reply_index, subindex) != (expected_index, 0) or sdo_command & 0xE0 != _SDO_READ_REPLY:
        return None
    return bytes(value_bytes)


# Error codes

# Specific codes precede classes. Classes: CiA 301; codes: those on which vendors' manuals agree.
_ERROR_MEANINGS: Final = (
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
    (0xFF00, 0xFF00, "device-specific: see its manual"),
    (0xF000, 0xF000, "additional function"),
)
"""Meanings of error codes: mask, masked value, meaning; the most specific masks come first."""


def describe_error(error_code: int) -> str:
    """Describe a 16-bit CiA 402 error code in words, followed by the code."""
    for code_mask, code_value, meaning in _ERROR_MEANINGS:
        if error_code & code_mask == code_value:
            return f"{meaning} (error code 0x{error_code:04X})"
    return f"error code 0x{error_code:04X}"
