"""Reset of a drive's fault."""

from typing import Protocol, runtime_checkable

from rigd.devices._registry import ActuationTarget, open_devices
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import RigParameters


class ResetUnsupportedError(DeviceError):
    """Error: the driver of a drive cannot reset a fault."""


@runtime_checkable
class ResettableDrive(Protocol):
    """Drive whose faults can be reset, unlike a drive simulated in this process."""

    def reset_fault(self) -> str | None:
        """Switch off, reset the fault, check that the drive gets ready; return the fault or None.

        Raise `DeviceError` if the drive may still turn, the fault persists, or the drive does not
        get ready.
        """


def reset_drive(rig: RigParameters, target: ActuationTarget | None = None) -> str:
    """Reset the fault of a rig's drive, release the drive, and describe the result.

    Parameters
    ----------
    rig, target
        See :func:`rigd.devices._registry.open_devices`.

    Returns
    -------
    str
        Sentence for the operator with the fault that was found and the drive's present state.

    Raises
    ------
    ResetUnsupportedError
        If the driver of a real drive cannot reset a fault; nothing was sent.
    DeviceError
        If the drive does not answer, may still turn, the fault persists, or the drive does not
        become ready, for instance because STO is open.
    """
    devices = open_devices(rig, target)
    drive = devices.drive
    if not isinstance(drive, ResettableDrive):
        if devices.simulated:
            return (
                f"{rig.name} is simulated, and each session simulates a new drive: there is no "
                "fault to reset."
            )
        raise ResetUnsupportedError(
            f"{rig.name}: nothing was reset, because the driver {rig.devices.drive} cannot reset a "
            "fault. The drive may still be on: press the wired stop (STO), then reset the drive "
            "with its manufacturer's tool."
        )
    try:
        cleared_fault = drive.reset_fault()
    finally:
        drive.close()
    if cleared_fault is None:
        return (
            "The drive is not in fault, so there is nothing to reset. Its statusword shows it off "
            "and it gets ready to switch on: the next session can be started."
        )
    return (
        f"The drive was in fault: {cleared_fault}. The fault is reset. Its statusword shows it off "
        "and it gets ready to switch on: the next session can be started."
    )
