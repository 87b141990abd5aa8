"""``rigd reset``: the operator's reset of a fault, the only one there is."""

from typing import Protocol, runtime_checkable

from rigd.devices.parameters import RigParameters
from rigd.devices.registry import Reality, open_devices


@runtime_checkable
class ResettableDrive(Protocol):
    """A drive that can be in fault; simulated ones in this process cannot."""

    def reset_fault(self) -> str | None:
        """Switch off, reset a fault, see that it would get ready; return the fault, or None.

        Raises
        ------
        DeviceError
            If the drive may still turn, the fault stands, or no session could be started.
        """


def reset_drive(rig: RigParameters, moving: Reality | None = None) -> str:
    """Reset the drive of a rig, and let go of it.

    Parameters
    ----------
    rig, moving
        See :func:`rigd.devices.registry.open_devices`.

    Returns
    -------
    str
        What was found and how the drive stands now, for the operator.

    Raises
    ------
    DeviceError
        If the drive does not answer, may still turn, the fault stands, or it does not get ready,
        as with STO open.
    """
    drive = open_devices(rig, moving).drive
    if not isinstance(drive, ResettableDrive):
        return "The drive is simulated in each session anew: there is no fault to reset."
    try:
        fault = drive.reset_fault()
    finally:
        drive.close()
    if fault is None:
        return (
            "The drive is not in fault, so there is nothing to reset. Its statusword shows it off "
            "and it gets ready to switch on: the next session can be started."
        )
    return (
        f"The drive was in fault: {fault}. The fault is reset. Its statusword shows it off and it "
        "gets ready to switch on: the next session can be started."
    )
