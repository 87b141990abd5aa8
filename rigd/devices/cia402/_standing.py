"""Fault reset without the loop: switch the drive off, reset it, and check that it becomes ready.

Everything goes by SDO, which a drive answers in each NMT state but stopped. Whether the motor has
torque is what the statusword says, never what was commanded.
"""

import time
from collections.abc import Callable
from contextlib import suppress

from rigd.devices.canbus.port import CanPort
from rigd.devices.cia402 import objects
from rigd.devices.cia402._protocol import (
    DISABLE_VOLTAGE,
    FAULT_BIT,
    FAULT_RESET,
    OFF,
    SHUTDOWN,
    VOLTAGE_ENABLED,
    DriveState,
    describe_error,
    state_of,
)
from rigd.devices.cia402._sdo import SdoAccess, SdoRefusal
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import RigParameters

_POLL_S = 0.01
_OFF_S = 0.2
"""Time from the first command after which a drive that answers but has torque is an error."""
_SILENT_S = 1.0
"""How long a drive that answers nothing at all is waited for."""


_PRESS_STO = (
    "the motor may still turn: press the wired stop (STO) and keep clear of the beam, then switch "
    "the drive off and on"
)


def reset_fault(port: CanPort, rig: RigParameters, name: str) -> str | None:
    """Switch the drive off, check that it is, reset its fault, and check that it would get ready.

    No torque on any way. The drive is left pre-operational and disabled. Its watch over our
    heartbeat is taken away only after its statusword has shown it off.

    Parameters
    ----------
    port
        Open port; no other code receives from it meanwhile.
    rig
        Parameters with a section ``cia402``.
    name
        Name of the drive, for messages.

    Returns
    -------
    str or None
        What the fault was, in words; None if there was none.

    Raises
    ------
    DeviceError
        If the drive does not answer, does not report that it is off within 0.2 s, the fault
        persists, or the drive is disabled and does not become ready.
    """
    settings = rig.cia402
    assert settings is not None
    with SdoAccess(port, settings.node_id, name) as sdo:
        _see_off(sdo, name)
        sdo.to_pre_operational()
        with suppress(SdoRefusal):
            # No heartbeat is sent now, whose absence would be the next fault.
            sdo.write(objects.HEARTBEAT_CONSUMER, 1, 0)
        patience_s = settings.enable_timeout_s
        fault = _reset(sdo, name, patience_s) if _in_fault(sdo) else None
        _see_ready(sdo, name, patience_s, fault, f"rigd reset --profile {rig.name}")
    return fault


def command_off(sdo: SdoAccess) -> None:
    """Send controlword 0 and ignore the answer; never raises."""
    # An adapter's library may raise anything, and this is the way off.
    with suppress(Exception), sdo.hurried():
        sdo.write(objects.CONTROLWORD, 0, DISABLE_VOLTAGE)


def require_off(sdo: SdoAccess, rig: RigParameters, name: str) -> None:
    """Wait until a drive that was commanded off is disabled.

    Raises
    ------
    DeviceError
        If it is in fault, or stays in another state.
    """
    settings = rig.cia402
    assert settings is not None
    ends = (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT)
    wait_for(lambda: _state(sdo) in ends, settings.enable_timeout_s)
    statusword = sdo.read(objects.STATUSWORD)
    state = state_of(statusword)
    if state is DriveState.SWITCH_ON_DISABLED:
        return
    if statusword & FAULT_BIT:
        raise DeviceError(
            f"{name}: it is in fault: {_fault(sdo)}. Remove the cause, then: rigd reset --profile "
            f"{rig.name}"
        )
    remedy = "switch it off and on" if state in OFF else _PRESS_STO
    raise DeviceError(
        f'{name}: expected in the state "{DriveState.SWITCH_ON_DISABLED.value}", it is in '
        f'"{state.value}" (statusword 0x{statusword:04X}); {remedy}.'
    )


def still_on(sdo: SdoAccess) -> str:
    """Describe a drive that was commanded off and does not report it; empty if it does."""
    try:
        statusword = sdo.read(objects.STATUSWORD)
    except DeviceError:
        return ""
    state = state_of(statusword)
    if state in OFF:
        return ""
    return f' It is in "{state.value}" (statusword 0x{statusword:04X}): {_PRESS_STO}.'


def wait_for(reached: Callable[[], bool], patience_s: float) -> bool:
    """Poll a condition, at least twice, and return whether it became true in time."""
    deadline = time.monotonic() + patience_s
    while not reached():
        if time.monotonic() > deadline:
            return reached()
        time.sleep(_POLL_S)
    return True


def _see_off(sdo: SdoAccess, name: str) -> None:
    """Command the drive off, from any state, until its statusword confirms it.

    Raises
    ------
    DeviceError
        If it does not show it within 0.2 s, or does not answer.
    """
    began = time.monotonic()
    statusword: int | None = None
    requested = False
    with sdo.hurried():
        while True:
            command_off(sdo)
            if not requested:
                # A drive whose node was stopped answers again; another may ignore it.
                with suppress(Exception):
                    sdo.request_pre_operational()
                    requested = True
            with suppress(Exception):
                statusword = sdo.read(objects.STATUSWORD)
                if state_of(statusword) in OFF:
                    return
            patience_s = _SILENT_S if statusword is None else _OFF_S
            if time.monotonic() - began > patience_s:
                break
            time.sleep(_POLL_S)
    if statusword is None:
        try:
            sdo.to_pre_operational()  # patiently, and it names what else is on the bus
            sdo.write(objects.CONTROLWORD, 0, DISABLE_VOLTAGE)
            statusword = sdo.read(objects.STATUSWORD)
        except Exception as error:
            cause = str(error) if isinstance(error, DeviceError) else f"{name}: {error!r}."
            raise DeviceError(
                f"{cause} It has not shown that it is off: keep clear of the beam, and press the "
                "wired stop (STO) if anything moves."
            ) from None
        if state_of(statusword) in OFF:
            return
    raise DeviceError(
        f"{name}: it was commanded to switch off and has not done so within {_OFF_S:g} s: it is in "
        f'"{state_of(statusword).value}" (statusword 0x{statusword:04X}); {_PRESS_STO}. Its watch '
        "over the heartbeat (object 1016) was left as it was."
    )


def _reset(sdo: SdoAccess, name: str, patience_s: float) -> str:
    """Reset the fault of a drive, and return what it was."""
    fault = _fault(sdo)
    for controlword in (DISABLE_VOLTAGE, FAULT_RESET):
        sdo.write(objects.CONTROLWORD, 0, controlword)
    gone = wait_for(lambda: _state(sdo) is DriveState.SWITCH_ON_DISABLED, patience_s)
    sdo.write(objects.CONTROLWORD, 0, DISABLE_VOLTAGE)
    if not gone:
        raise DeviceError(
            f"{name}: the fault cannot be reset: {_fault(sdo)}. It is in the state "
            f'"{_state(sdo).value}"; remove the cause, or switch the drive off and on.'
        )
    return fault


def _see_ready(
    sdo: SdoAccess, name: str, patience_s: float, fault: str | None, command: str
) -> None:
    """Check that the drive gets to ready to switch on, where it has no torque yet, and back.

    Raises
    ------
    DeviceError
        If it does not: a session could not be started.
    """
    with suppress(SdoRefusal):
        sdo.write(objects.CONTROLWORD, 0, SHUTDOWN)
    ready = wait_for(lambda: _state(sdo) is DriveState.READY, patience_s)
    statusword = sdo.read(objects.STATUSWORD)
    sdo.write(objects.CONTROLWORD, 0, DISABLE_VOLTAGE)
    disabled = wait_for(lambda: _state(sdo) is DriveState.SWITCH_ON_DISABLED, patience_s)
    if ready and disabled:
        return
    done = f"its fault is reset ({fault})" if fault else "it is not in fault"
    state = state_of(statusword)
    if ready:
        raise DeviceError(
            f'{name}: {done}; it got ready and is now in "{_state(sdo).value}", not in '
            f'"{DriveState.SWITCH_ON_DISABLED.value}"; switch it off and on.'
        )
    if statusword & FAULT_BIT:
        raise DeviceError(
            f"{name}: {done}; when it was commanded to get ready it went to fault: {_fault(sdo)}. "
            f"Remove the cause, then: {command}"
        )
    supplied = "is there" if statusword & VOLTAGE_ENABLED else "is not there"
    raise DeviceError(
        f"{name}: {done}, and it is disabled, but it does not get ready: on that command it stays "
        f'in "{state.value}" (statusword 0x{statusword:04X}, bit 4: the motor supply {supplied}). '
        f"STO is open or the motor supply is off; release or switch it on, then: {command}"
    )


def _in_fault(sdo: SdoAccess) -> bool:
    return bool(sdo.read(objects.STATUSWORD) & FAULT_BIT)


def _state(sdo: SdoAccess) -> DriveState:
    return state_of(sdo.read(objects.STATUSWORD))


def _fault(sdo: SdoAccess) -> str:
    """Return in words why the drive is in fault."""
    try:
        code = sdo.read(objects.ERROR_CODE)
    except SdoRefusal:
        code = 0
    code = code or sdo.last_emergency()
    return describe_error(code) if code else "the drive names no cause"
