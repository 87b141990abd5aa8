"""Which CAN identifiers each device of a rig uses, and where two of them would meet.

CANopen's predefined set ties a node's identifiers to its number, and an ATI sensor takes sixteen in
a row. Where they overlap, raw gauges are obeyed as controlword and torque, or a torque command
resets the sensor (base 0x20 is RPDO1 of the nodes 1 to 15): no device may be talked to then.
"""

from collections.abc import Iterator

from rigd.devices.parameters import AtiCan, RigParameters, ServoDrive

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
    """Return what an ATI sensor sends and listens to: its base and any of sixteen opcodes."""
    first = sensor.base_id << 4
    return range(first, first + 16)


def drive_identifiers(drive: ServoDrive) -> dict[int, str]:
    """Return what the drive uses, by identifier, and CANopen services that reach all nodes.

    The PDOs that are not configured count too: a drive may have them on from the factory.
    """
    own = {base + drive.node_id: what for base, what in _OF_A_NODE.items()}
    return _OF_ALL_NODES | own


def check_identifiers(rig: RigParameters) -> list[str]:
    """Find the identifiers that two devices of a rig would use.

    Returns
    -------
    list of str
        One sentence a collision, with what to change; empty if all is well.
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
