"""Use of the CAN bus by a profile, before anything is connected: identifiers and bus load.

CANopen's predefined set ties a node's identifiers to its number, and an ATI sensor takes sixteen in
a row. Where they overlap, raw gauges are obeyed as controlword and torque, or a torque command
resets the sensor (base 0x20 is RPDO1 of the nodes 1 to 15): no device may be talked to then.

The bus load counts every cyclic frame with the most bits that may be stuffed into it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from rigd.devices.parameters import AtiCan, RigParameters, ServoDrive

# Identifiers

_FREE_BASE = 0x68
"""Base of a sensor whose identifiers the predefined set leaves free, whatever the nodes are."""

# CiA 301 and, for the last, CiA 305: what every CANopen device listens to.
_OF_ALL_NODES = {
    0x000: "NMT",
    0x080: "SYNC",
    0x100: "TIME",
    0x7E4: "LSS",
    0x7E5: "LSS",
}
_OF_A_NODE = {
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


def sensor_identifiers(sensor: AtiCan) -> range:
    """Return the identifiers that an ATI sensor uses: its base with any of sixteen opcodes."""
    first = sensor.base_id << 4
    return range(first, first + 16)


def drive_identifiers(drive: ServoDrive) -> dict[int, str]:
    """Return the services of the drive by identifier, including those that address all nodes.

    The PDOs that are not configured count too: a drive may have them on from the factory.
    """
    own = {base + drive.node_id: what for base, what in _OF_A_NODE.items()}
    return _OF_ALL_NODES | own


def check_identifiers(rig: RigParameters) -> list[str]:
    """Find the identifiers that two devices of a rig would use.

    Returns
    -------
    list of str
        One sentence per collision, with the remedy; empty if there is none.
    """
    return list(_collisions(rig))


def _collisions(rig: RigParameters) -> Iterator[str]:
    drive, sensor = rig.cia402, rig.ati_can
    if drive is not None and drive.node_id == drive.host_node_id:
        yield (
            f"cia402.node_id and cia402.host_node_id are both {drive.node_id}: the drive and this "
            f"computer would send the same heartbeat ({0x700 + drive.node_id:#x}); choose another "
            "host_node_id."
        )
    if drive is None or sensor is None:
        return
    taken = drive_identifiers(drive) | {0x700 + drive.host_node_id: "host's heartbeat"}
    mine = sensor_identifiers(sensor)
    met = {can_id: what for can_id, what in sorted(taken.items()) if can_id in mine}
    if met:
        named = ", ".join(f"{can_id:#05x} ({what})" for can_id, what in met.items())
        yield (
            f"ati_can.base_id = {sensor.base_id:#04x} takes the identifiers {mine[0]:#05x} to "
            f"{mine[-1]:#05x}, of which the drive's bus uses {named} with cia402.node_id = "
            f"{drive.node_id}; give the sensor a free base such as {_FREE_BASE:#04x}, or the "
            "drive another node id."
        )


# Bus load

SYNC_LENGTH = 0
RPDO_LENGTH = 4
"""Controlword and target torque."""
TPDO_LENGTH = 8
"""Statusword, position and actual torque."""
HEARTBEAT_LENGTH = 1
REQUEST_LENGTH = 0
REPLY_LENGTHS = (8, 6)
"""Replies of an ATI sensor to one request: status and gauges 0, 2, 4; gauges 1, 3, 5."""

FRAME_BITS = 47
"""Bits of a frame with an 11-bit identifier and no data: start, identifier, control, checksum,
acknowledgement, end, and the pause of 3 bits before the next frame."""
_STUFFED_BITS = 34
"""Bits among these from the start to the checksum, where bits are stuffed."""


MAX_LOAD = 0.9
"""Largest load of a bus or line, with the most stuffed bits: above, a frame may miss its period."""


@dataclass(frozen=True, slots=True)
class Traffic:
    """A frame that recurs."""

    what: str
    can_id: int
    length: int
    """Bytes of data."""
    rate_hz: float


@dataclass(frozen=True, slots=True)
class BusLoad:
    """All recurring frames of a bus, and the bus load."""

    traffic: tuple[Traffic, ...]
    """The frames."""
    plain: float
    """Part of the time, 0 to 1 and beyond, if no bit had to be stuffed."""
    worst: float
    """Load with as many stuffed bits as there can be."""
    frames_per_s: float
    """Frames a second, all together."""


def frame_bits(length: int) -> int:
    """Return the bits of a classical frame with an 11-bit identifier, nothing stuffed.

    Parameters
    ----------
    length
        Bytes of data, 0 to 8.
    """
    return FRAME_BITS + 8 * length


def worst_frame_bits(length: int) -> int:
    """Return the bits of such a frame with the most stuffed bits its data can bring about.

    After five equal bits an opposite one is stuffed, which counts as the first of the next five:
    one in four at most, after the first.
    """
    return frame_bits(length) + (_STUFFED_BITS + 8 * length - 1) // 4


def sum_up(traffic: tuple[Traffic, ...], bitrate_bit_s: float) -> BusLoad:
    """Return the load of some frames on a bus."""
    return BusLoad(
        traffic=traffic,
        plain=sum(frame_bits(t.length) * t.rate_hz for t in traffic) / bitrate_bit_s,
        worst=sum(worst_frame_bits(t.length) * t.rate_hz for t in traffic) / bitrate_bit_s,
        frames_per_s=sum(t.rate_hz for t in traffic),
    )


def bus_load(rig: RigParameters) -> BusLoad:
    """Return the load of the bus while a session runs.

    Parameters
    ----------
    rig
        Devices without their own section are not on the bus.

    Raises
    ------
    ValueError
        If the rig has no CAN bus.

    Examples
    --------
    >>> from rigd.devices.canbus import bus_load
    >>> from rigd.profile import load_profile
    >>> load = bus_load(load_profile("antenna_can").rig)
    >>> print(f"{load.frames_per_s:.0f} frames a second, {load.worst:.0%} of the bus at worst")
    6150 frames a second, 60% of the bus at worst
    """
    if rig.can is None:
        raise ValueError("The rig has no CAN bus.")
    traffic: list[Traffic] = []
    if (drive := rig.cia402) is not None:
        host_hz = min(rig.rate_hz, 1.0 / drive.heartbeat_period_s)
        drive_hz = 1.0 / drive.drive_heartbeat_period_s
        node, host = drive.node_id, drive.host_node_id
        traffic += [
            Traffic("SYNC", 0x80, SYNC_LENGTH, rig.rate_hz),
            Traffic("drive's TPDO1", 0x180 + node, TPDO_LENGTH, rig.rate_hz),
            Traffic("drive's RPDO1", 0x200 + node, RPDO_LENGTH, rig.rate_hz),
            Traffic("drive's heartbeat", 0x700 + node, HEARTBEAT_LENGTH, drive_hz),
            Traffic("host's heartbeat", 0x700 + host, HEARTBEAT_LENGTH, host_hz),
        ]
    if (sensor := rig.ati_can) is not None:
        first = sensor.base_id << 4
        traffic.append(Traffic("sensor's request", first, REQUEST_LENGTH, rig.rate_hz))
        traffic += [
            Traffic(f"sensor's reply {part + 1}", first + part, length, rig.rate_hz)
            for part, length in enumerate(REPLY_LENGTHS)
        ]
    return sum_up(tuple(traffic), rig.can.bitrate_bit_s)
