"""Identifiers and bus load of a profile on the CAN bus, checked before anything is connected.

CANopen's predefined connection set derives a node's identifiers from its number, and an ATI sensor
uses sixteen consecutive identifiers. If they overlap, the drive takes gauge readings as controlword
and torque, or a torque command resets the sensor (base 0x20 is RPDO1 of the nodes 1 to 15). No
frame may be sent then.

The bus load counts every cyclic frame with the largest possible number of stuff bits.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from rigd.devices.parameters import AtiCan, RigParameters, ServoDrive

# Identifiers

_FREE_SENSOR_BASE_ID = 0x68
"""Base of an ATI sensor whose identifiers no CANopen node uses."""

# CiA 301 and, for the last, CiA 305: what every CANopen device listens to.
_BROADCAST_SERVICE_BY_ID = {
    0x000: "NMT",
    0x080: "SYNC",
    0x100: "TIME",
    0x7E4: "LSS",
    0x7E5: "LSS",
}
"""Services of CiA 301 (and CiA 305: LSS) that address all CANopen nodes, by identifier."""
_NODE_SERVICE_BY_BASE_ID = {
    0x080: "EMCY",
    0x180: "TPDO1",
    0x200: "RPDO1",
    0x280: "TPDO2",
    0x300: "RPDO2",
    0x380: "TPDO3",
    0x400: "RPDO3",
    0x480: "TPDO4",
    0x500: "RPDO4",
    0x580: "SDO reply",
    0x600: "SDO request",
    0x700: "heartbeat",
}
"""Services of one CANopen node by identifier, to which the node number is added."""


def sensor_identifiers(sensor: AtiCan) -> range:
    """Return the 16 CAN identifiers that an ATI sensor uses: its base with every opcode."""
    first_id = sensor.base_id << 4
    return range(first_id, first_id + 16)


def drive_identifiers(drive: ServoDrive) -> dict[int, str]:
    """Return the names of the drive's CANopen services by CAN identifier.

    The services that address all nodes are included, and so are PDOs that are not configured: they
    may be enabled in the drive's factory settings.
    """
    drive_service_by_id = {
        base_id + drive.node_id: service_name
        for base_id, service_name in _NODE_SERVICE_BY_BASE_ID.items()
    }
    return _BROADCAST_SERVICE_BY_ID | drive_service_by_id


def check_identifiers(rig: RigParameters) -> list[str]:
    """Find CAN identifiers that two devices of a rig would use.

    Returns
    -------
    list of str
        One sentence per collision, with the remedy; empty if there is none.
    """
    return list(_collision_sentences(rig))


def _collision_sentences(rig: RigParameters) -> Iterator[str]:
    """Yield a sentence with the remedy for each collision of CAN identifiers."""
    drive, sensor = rig.cia402, rig.ati_can
    if drive is not None and drive.node_id == drive.host_node_id:
        yield (
            f"cia402.node_id and cia402.host_node_id are both {drive.node_id}: the drive and this "
            f"computer would send the same heartbeat ({0x700 + drive.node_id:#x}); choose another "
            "host_node_id."
        )
    if drive is None or sensor is None:
        return
    used_service_by_id = drive_identifiers(drive) | {0x700 + drive.host_node_id: "host's heartbeat"}
    sensor_ids = sensor_identifiers(sensor)
    colliding_service_by_id = {
        can_id: service_name
        for can_id, service_name in sorted(used_service_by_id.items())
        if can_id in sensor_ids
    }
    if colliding_service_by_id:
        collisions_text = ", ".join(
            f"{can_id:#05x} ({service_name})"
            for can_id, service_name in colliding_service_by_id.items()
        )
        yield (
            f"ati_can.base_id = {sensor.base_id:#04x} takes the identifiers "
            f"{sensor_ids[0]:#05x} to {sensor_ids[-1]:#05x}, of which the drive's bus "
            f"uses {collisions_text} with cia402.node_id = {drive.node_id}; give the sensor a free "
            f"base such as {_FREE_SENSOR_BASE_ID:#04x}, or the drive another node id."
        )


# Bus load

SYNC_LENGTH = 0
"""Number of data bytes in a SYNC frame."""
RPDO_LENGTH = 4
"""Number of data bytes in the drive's RPDO: controlword and target torque."""
TPDO_LENGTH = 8
"""Number of data bytes in the drive's TPDO: statusword, position and actual torque."""
HEARTBEAT_LENGTH = 1
"""Number of data bytes in a heartbeat frame."""
SENSOR_REQUEST_LENGTH = 0
"""Number of data bytes in a request to an ATI sensor."""
SENSOR_REPLY_LENGTHS = (8, 6)
"""Numbers of data bytes in the two replies of an ATI sensor to one request.

The first contains the status word and gauges 0, 2, 4, the second gauges 1, 3, 5."""

BITS_OF_EMPTY_FRAME = 47
"""Bits of a CAN frame with an 11-bit identifier and no data, without stuff bits.

They are start, identifier, control, checksum, acknowledgement, end, and the interframe space of 3
bits."""
_STUFFABLE_BITS_OF_EMPTY_FRAME = 34
"""Bits of a frame without data that are subject to bit stuffing: from the start to the checksum."""


MAX_BUS_LOAD = 0.9
"""Largest permitted load of a bus or line in the worst case of bit stuffing, 0 to 1.

Above it a frame may miss its period."""


@dataclass(frozen=True, slots=True)
class CyclicFrame:
    """Frame that is sent cyclically on the bus."""

    frame_name: str
    """Name of the frame."""
    can_id: int
    """CAN identifier of the frame."""
    data_length: int
    """Number of data bytes in the frame."""
    rate_hz: float
    """Number of these frames per second."""


@dataclass(frozen=True, slots=True)
class BusLoad:
    """Cyclic frames of a CAN bus, and the fraction of time in which they keep the bus busy."""

    cyclic_frames: tuple[CyclicFrame, ...]
    """Cyclic frames of the bus."""
    load_without_stuffing: float
    """Fraction of time in which the bus is busy without stuff bits; above 1 if overloaded."""
    worst_case_load: float
    """Fraction of time in which the bus is busy with the largest possible number of stuff bits."""
    frames_per_s: float
    """Total number of frames per second."""


def frame_bits(data_length: int) -> int:
    """Return the number of bits of a CAN frame with an 11-bit identifier, without stuff bits.

    There are 0 to 8 bytes of data.
    """
    return BITS_OF_EMPTY_FRAME + 8 * data_length


def max_frame_bits(data_length: int) -> int:
    """Return the largest number of bits of a CAN frame with `data_length` bytes, with stuff bits.

    After five equal bits a bit of the opposite value is inserted, which counts as the first of the
    next five. So at most one bit is inserted per four bits, after the first bit.
    """
    return frame_bits(data_length) + (_STUFFABLE_BITS_OF_EMPTY_FRAME + 8 * data_length - 1) // 4


def load_of_frames(cyclic_frames: tuple[CyclicFrame, ...], bitrate_bit_s: float) -> BusLoad:
    """Return the load that cyclic frames cause on a bus of the given bit rate, as a fraction."""
    return BusLoad(
        cyclic_frames=cyclic_frames,
        load_without_stuffing=sum(frame_bits(t.data_length) * t.rate_hz for t in cyclic_frames)
        / bitrate_bit_s,
        worst_case_load=sum(max_frame_bits(t.data_length) * t.rate_hz for t in cyclic_frames)
        / bitrate_bit_s,
        frames_per_s=sum(t.rate_hz for t in cyclic_frames),
    )


def bus_load(rig: RigParameters) -> BusLoad:
    """Return the load of the CAN bus while a session runs, as a fraction of its bit rate.

    Parameters
    ----------
    rig
        Parameters of the rig; a device without its own section is not on the bus.

    Raises
    ------
    ValueError
        If the rig has no CAN bus.

    Examples
    --------
    >>> from rigd.devices.canbus import bus_load
    >>> from rigd.profile import load_profile
    >>> load = bus_load(load_profile("antenna_can").rig)
    >>> print(f"{load.frames_per_s:.0f} frames/s, {load.worst_case_load:.0%} of the bus at worst")
    6150 frames/s, 60% of the bus at worst
    """
    if rig.can is None:
        raise ValueError("The rig has no CAN bus.")
    cyclic_frames: list[CyclicFrame] = []
    if (drive := rig.cia402) is not None:
        host_heartbeat_hz = min(rig.rate_hz, 1.0 / drive.heartbeat_period_s)
        drive_heartbeat_hz = 1.0 / drive.drive_heartbeat_period_s
        node_id, host_id = drive.node_id, drive.host_node_id
        cyclic_frames += [
            CyclicFrame("SYNC", 0x80, SYNC_LENGTH, rig.rate_hz),
            CyclicFrame("drive's TPDO1", 0x180 + node_id, TPDO_LENGTH, rig.rate_hz),
            CyclicFrame("drive's RPDO1", 0x200 + node_id, RPDO_LENGTH, rig.rate_hz),
            CyclicFrame("drive's heartbeat", 0x700 + node_id, HEARTBEAT_LENGTH, drive_heartbeat_hz),
            CyclicFrame("host's heartbeat", 0x700 + host_id, HEARTBEAT_LENGTH, host_heartbeat_hz),
        ]
    if (sensor := rig.ati_can) is not None:
        first_id = sensor.base_id << 4
        cyclic_frames.append(
            CyclicFrame("sensor's request", first_id, SENSOR_REQUEST_LENGTH, rig.rate_hz)
        )
        cyclic_frames += [
            CyclicFrame(
                f"sensor's reply {reply_index + 1}",
                first_id + reply_index,
                reply_length,
                rig.rate_hz,
            )
            for reply_index, reply_length in enumerate(SENSOR_REPLY_LENGTHS)
        ]
    return load_of_frames(tuple(cyclic_frames), rig.can.bitrate_bit_s)
