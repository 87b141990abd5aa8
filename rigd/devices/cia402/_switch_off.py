"""Reset a drive's fault while the loop does not run: switch off, reset, check that it gets ready.

All commands are sent by SDO, which a drive answers in every NMT state except stopped. Whether the
motor has torque is decided by the statusword, never by what was commanded.
"""

import time
from collections.abc import Callable
from contextlib import suppress

from rigd.devices.canbus.port import CanPort
from rigd.devices.cia402 import objects
from rigd.devices.cia402._protocol import (
    DISABLE_VOLTAGE_COMMAND,
    FAULT_BIT,
    FAULT_RESET_COMMAND,
    SHUTDOWN_COMMAND,
    TORQUE_FREE_STATES,
    VOLTAGE_ENABLED_BIT,
    DriveState,
    describe_error,
    drive_state,
)
from rigd.devices.cia402._sdo import SdoAbortError, SdoAccess
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import RigParameters

_STATE_POLL_INTERVAL_S = 0.01
"""Interval in seconds between two readings of the drive's state."""
_SWITCH_OFF_TIMEOUT_S = 0.2
"""Time in seconds within which a drive that answers has to report that it is off."""
_FIRST_ANSWER_TIMEOUT_S = 1.0
"""Time in seconds to wait for any answer of a drive that has not answered yet."""


_PRESS_STO_ADVICE = (
    "the motor may still turn: press the wired stop (STO) and keep clear of the beam, then switch "
    "the drive off and on"
)
"""Advice in messages about a drive that is not known to be off."""


def reset_fault(port: CanPort, rig: RigParameters, drive_name: str) -> str | None:
    """Switch the drive off, reset its fault, and check that it can get ready to switch on.

    Return the description of the fault; None if the drive was not in fault. The motor has no torque
    at any time. The drive is left pre-operational and disabled. Its monitoring of this computer's
    heartbeat is cleared only after its statusword has shown that it is off. No other code receives
    from the open port meanwhile. The profile needs a section ``cia402``. Raise `DeviceError` if the
    drive does not answer, does not report that it is off within 0.2 s, the fault persists, or the
    drive is disabled and does not become ready.
    """
    settings = rig.cia402
    assert settings is not None
    with SdoAccess(port, settings.node_id, drive_name) as sdo:
        _confirm_off(sdo, drive_name)
        sdo.enter_pre_operational()
        with suppress(SdoAbortError):
            # No heartbeat is sent now, whose absence would be the next fault.
            sdo.write(objects.HEARTBEAT_CONSUMER, 1, 0)
        max_wait_s = settings.enable_timeout_s
        fault_text = (
            _reset_reported_fault(sdo, drive_name, max_wait_s) if _is_in_fault(sdo) else None
        )
        _confirm_ready(sdo, drive_name, max_wait_s, fault_text, f"rigd reset --profile {rig.name}")
    return fault_text


def command_voltage_off(sdo: SdoAccess) -> None:
    """Command the drive to switch off (controlword 0) and ignore its answer; never raises."""
    # An adapter's library may raise anything; switching off must continue.
    with suppress(Exception), sdo.short_timeouts():
        sdo.write(objects.CONTROLWORD, 0, DISABLE_VOLTAGE_COMMAND)


def wait_until_disabled(sdo: SdoAccess, rig: RigParameters, drive_name: str) -> None:
    """Wait until a drive that was commanded off is disabled.

    Raise `DeviceError` if the drive is in fault, or stays in another state.
    """
    settings = rig.cia402
    assert settings is not None
    disabled_states = (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT)
    wait_for(lambda: _read_state(sdo) in disabled_states, settings.enable_timeout_s)
    statusword = sdo.read(objects.STATUSWORD)
    present_state = drive_state(statusword)
    if present_state is DriveState.SWITCH_ON_DISABLED:
        return
    if statusword & FAULT_BIT:
        raise DeviceError(
            f"{drive_name}: it is in fault: {_describe_fault(sdo)}. Remove the cause, then: rigd "
            f"reset --profile {rig.name}"
        )
    remedy = "switch it off and on" if present_state in TORQUE_FREE_STATES else _PRESS_STO_ADVICE
    raise DeviceError(
        f'{drive_name}: expected in the state "{DriveState.SWITCH_ON_DISABLED.value}", it is in '
        f'"{present_state.value}" (statusword 0x{statusword:04X}); {remedy}.'
    )


def describe_remaining_torque(sdo: SdoAccess) -> str:
    """Return a warning that a drive that was commanded off still has torque, or an empty text.

    The text is empty if the drive reports that it is off, or does not answer.
    """
    try:
        statusword = sdo.read(objects.STATUSWORD)
    except DeviceError:
        return ""
    present_state = drive_state(statusword)
    if present_state in TORQUE_FREE_STATES:
        return ""
    return (
        f' It is in "{present_state.value}" (statusword 0x{statusword:04X}): {_PRESS_STO_ADVICE}.'
    )


def wait_for(is_fulfilled: Callable[[], bool], max_wait_s: float) -> bool:
    """Poll a condition, at least twice, and return whether it became true in time."""
    deadline_s = time.monotonic() + max_wait_s
    while not is_fulfilled():
        if time.monotonic() > deadline_s:
            return is_fulfilled()
        time.sleep(_STATE_POLL_INTERVAL_S)
    return True


def _confirm_off(sdo: SdoAccess, drive_name: str) -> None:
    """Command the drive off, from any state, until its statusword confirms it.

    Raise `DeviceError` if the drive does not report that it is off within 0.2 s, or does not
    answer.
    """
    start_s = time.monotonic()
    statusword: int | None = None
    is_switch_off_requested = False
    with sdo.short_timeouts():
        while True:
            command_voltage_off(sdo)
            if not is_switch_off_requested:
                # A drive whose node was stopped answers again; another may ignore it.
                with suppress(Exception):
                    sdo.request_pre_operational()
                    is_switch_off_requested = True
            with suppress(Exception):
                statusword = sdo.read(objects.STATUSWORD)
                if drive_state(statusword) in TORQUE_FREE_STATES:
                    return
            max_wait_s = _FIRST_ANSWER_TIMEOUT_S if statusword is None else _SWITCH_OFF_TIMEOUT_S
            if time.monotonic() - start_s > max_wait_s:
                break
            time.sleep(_STATE_POLL_INTERVAL_S)
    if statusword is None:
        try:
            sdo.enter_pre_operational()  # with the normal timeout; its error names other nodes
            sdo.write(objects.CONTROLWORD, 0, DISABLE_VOLTAGE_COMMAND)
            statusword = sdo.read(objects.STATUSWORD)
        except Exception as error:
            failure_cause = (
                str(error) if isinstance(error, DeviceError) else f"{drive_name}: {error!r}."
            )
            raise DeviceError(
                f"{failure_cause} It has not shown that it is off: keep clear of the beam, and "
                "press the wired stop (STO) if anything moves."
            ) from None
        if drive_state(statusword) in TORQUE_FREE_STATES:
            return
    raise DeviceError(
        f"{drive_name}: it was commanded to switch off and has not done so within "
        f'{_SWITCH_OFF_TIMEOUT_S:g} s: it is in "{drive_state(statusword).value}" (statusword '
        f"0x{statusword:04X}); {_PRESS_STO_ADVICE}. Its heartbeat watchdog (object 1016) was left "
        "unchanged."
    )


def _reset_reported_fault(sdo: SdoAccess, drive_name: str, max_wait_s: float) -> str:
    """Reset the drive's fault and return its description; raise if the fault persists."""
    fault_text = _describe_fault(sdo)
    for controlword in (DISABLE_VOLTAGE_COMMAND, FAULT_RESET_COMMAND):
        sdo.write(objects.CONTROLWORD, 0, controlword)
    is_fault_reset = wait_for(lambda: _read_state(sdo) is DriveState.SWITCH_ON_DISABLED, max_wait_s)
    sdo.write(objects.CONTROLWORD, 0, DISABLE_VOLTAGE_COMMAND)
    if not is_fault_reset:
        raise DeviceError(
            f"{drive_name}: the fault cannot be reset: {_describe_fault(sdo)}. It is in the state "
            f'"{_read_state(sdo).value}"; remove the cause, or switch the drive off and on.'
        )
    return fault_text


def _confirm_ready(
    sdo: SdoAccess, drive_name: str, max_wait_s: float, fault_text: str | None, reset_command: str
) -> None:
    """Check that the drive can get ready to switch on (without torque), and disable it again.

    Raise `DeviceError` if the drive does not get ready, so that no session could be started.
    """
    with suppress(SdoAbortError):
        sdo.write(objects.CONTROLWORD, 0, SHUTDOWN_COMMAND)
    is_ready_to_switch_on = wait_for(lambda: _read_state(sdo) is DriveState.READY, max_wait_s)
    statusword = sdo.read(objects.STATUSWORD)
    sdo.write(objects.CONTROLWORD, 0, DISABLE_VOLTAGE_COMMAND)
    is_disabled = wait_for(lambda: _read_state(sdo) is DriveState.SWITCH_ON_DISABLED, max_wait_s)
    if is_ready_to_switch_on and is_disabled:
        return
    progress_text = f"its fault is reset ({fault_text})" if fault_text else "it is not in fault"
    present_state = drive_state(statusword)
    if is_ready_to_switch_on:
        raise DeviceError(
            f"{drive_name}: {progress_text}; it got ready and is now in "
            f'"{_read_state(sdo).value}", not in "{DriveState.SWITCH_ON_DISABLED.value}"; switch '
            "it off and on."
        )
    if statusword & FAULT_BIT:
        raise DeviceError(
            f"{drive_name}: {progress_text}; when it was commanded to get ready it went to fault: "
            f"{_describe_fault(sdo)}. Remove the cause, then: {reset_command}"
        )
    supply_text = "is there" if statusword & VOLTAGE_ENABLED_BIT else "is not there"
    raise DeviceError(
        f"{drive_name}: {progress_text}, and it is disabled, but it does not get ready: on that "
        "command "
        f'it stays in "{present_state.value}" (statusword 0x{statusword:04X}, bit 4: the motor '
        f"supply {supply_text}). STO is open or the motor supply is off; release or switch it on, "
        f"then: {reset_command}"
    )


def _is_in_fault(sdo: SdoAccess) -> bool:
    """Return whether the drive's statusword, read by SDO, shows a fault."""
    return bool(sdo.read(objects.STATUSWORD) & FAULT_BIT)


def _read_state(sdo: SdoAccess) -> DriveState:
    """Read the drive's statusword by SDO and return the state that it shows."""
    return drive_state(sdo.read(objects.STATUSWORD))


def _describe_fault(sdo: SdoAccess) -> str:
    """Return a description of the cause of the drive's fault."""
    try:
        error_code = sdo.read(objects.ERROR_CODE)
    except SdoAbortError:
        error_code = 0
    error_code = error_code or sdo.last_emergency()
    return describe_error(error_code) if error_code else "the drive names no cause"
