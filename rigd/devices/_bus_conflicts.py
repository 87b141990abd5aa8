"""Whether the devices of a rig can be on one CAN bus."""

from rigd.devices.parameters import RigParameters
from rigd.extras import require_extra


def bus_conflicts(rig: RigParameters) -> list[str]:
    """Return the reasons why the devices of a rig cannot use one CAN bus, as sentences.

    The list is empty if they can. Nothing is sent on the bus.
    """
    if rig.can is None:
        return []
    require_extra("rig", f"The rig {rig.name}")
    from rigd.devices.canbus import MAX_BUS_LOAD, bus_load, check_identifiers

    conflict_reasons = check_identifiers(rig)
    worst_bus_load = bus_load(rig).worst_case_load
    if worst_bus_load > MAX_BUS_LOAD:
        conflict_reasons.append(
            f"The frames of a tick take up to {100 * worst_bus_load:.0f} % of the CAN bus at "
            f"{rig.can.bitrate_bit_s} bit/s, more than {100 * MAX_BUS_LOAD:.0f} %; choose a higher "
            "can.bitrate_bit_s or a lower rig.rate_hz."
        )
    return conflict_reasons
