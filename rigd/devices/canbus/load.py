"""How busy the CAN bus is with what a profile puts on it, computed before anything is connected."""

from dataclasses import dataclass

from rigd.devices.parameters import RigParameters

SYNC_LENGTH = 0
RPDO_LENGTH = 4
"""Controlword and target torque."""
TPDO_LENGTH = 8
"""Statusword, position and actual torque."""
HEARTBEAT_LENGTH = 1
REQUEST_LENGTH = 0
REPLY_LENGTHS = (8, 6)
"""Of an ATI sensor to one request: status and gauges 0, 2, 4; gauges 1, 3, 5."""

FRAME_BITS = 47
"""Of a frame with an 11-bit identifier and no data: start, identifier, control, checksum,
acknowledgement, end, and the pause of 3 bits before the next frame."""
_STUFFED_BITS = 34
"""Of these, those from the start to the checksum, among which bits are stuffed."""


MAX_LOAD = 0.9
"""Of a bus or line, with the most stuffed bits: above, a frame may miss its period."""


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
    """All recurring frames of a bus, and the part of its time that they take."""

    traffic: tuple[Traffic, ...]
    plain: float
    """Part of the time, 0 to 1 and beyond, if no bit had to be stuffed."""
    worst: float
    """With as many stuffed bits as there can be."""
    frames_per_s: float


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
        Devices without a section of their own are not on the bus.

    Raises
    ------
    ValueError
        If the rig has no CAN bus.
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
