"""Why a drive has left operation enabled, as far as its statusword tells."""

from typing import Final

from rigd.devices.cia402.states import VOLTAGE_ENABLED, DriveState, state_of
from rigd.devices.contracts import DeviceError, wired_stop_dropped

_FOREIGN_COMMAND: Final = (
    "a command came over the bus that this computer did not give (a corrupt frame, a second master)"
)
_LOOK_AT_THE_BUS: Final = (
    "look at the cable of the bus, its termination, and at who else is connected to it"
)


def left_operation(name: str, statusword: int) -> DeviceError:
    """Return the error of an enabled drive that is not in operation enabled any more.

    Parameters
    ----------
    name
        Of the drive.
    statusword
        Which names no fault, and which no emergency message explains.
    """
    state = state_of(statusword)
    left = (
        f'it has left "{DriveState.OPERATION_ENABLED.value}" for "{state.value}" '
        f"(statusword 0x{statusword:04X})"
    )
    if state is DriveState.SWITCH_ON_DISABLED:
        # It has lost its supply there, mostly; a command leaves that on.
        supplied = bool(statusword & VOLTAGE_ENABLED)
        hint = ", and its bit 4 says that the supply is there, which speaks for such a command"
        dropped = wired_stop_dropped(
            name,
            f", or the motor's supply failed, or {_FOREIGN_COMMAND}: {left}"
            f"{hint if supplied else ''}",
        )
        return DeviceError(f"{dropped} If nobody pressed it, {_LOOK_AT_THE_BUS}.")
    if state in (DriveState.READY, DriveState.SWITCHED_ON):
        return DeviceError(f"{name}: {left}: {_FOREIGN_COMMAND}; {_LOOK_AT_THE_BUS}.")
    return DeviceError(
        f"{name}: {left}, by itself or because {_FOREIGN_COMMAND}; look at STO, supply and its "
        f"own diagnosis. If these tell nothing, {_LOOK_AT_THE_BUS}."
    )
