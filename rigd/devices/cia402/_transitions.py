"""State transitions of the drive: to operation enabled, back to off, and unexpected ones."""

import time
from collections.abc import Callable
from contextlib import suppress
from math import ceil, exp
from typing import Final

from rigd.devices.cia402._node import Node
from rigd.devices.cia402._protocol import (
    DISABLE_VOLTAGE_COMMAND,
    ENABLE_OPERATION_COMMAND,
    FOLLOWS_TARGET_BIT,
    SHUTDOWN_COMMAND,
    SWITCH_ON_COMMAND,
    TORQUE_FREE_STATES,
    VOLTAGE_ENABLED_BIT,
    DriveState,
    drive_state,
    read_mode,
)
from rigd.devices.cia402.objects import CONTROLWORD, CYCLIC_TORQUE_MODE
from rigd.devices.contracts import DeviceError, wired_stop_dropped

_OTHER_SENDER_HINT: Final = (
    "a command came over the bus that this computer did not give (a corrupt frame, a second master)"
)
"""Part of a message: another sender on the bus may have commanded the drive."""
_CHECK_BUS_ADVICE: Final = "check the bus cable, its termination, and what else is connected to it"
"""Part of a message: advice to check the bus."""


# Why a drive has left operation


def operation_left_error(drive_name: str, statusword: int) -> DeviceError:
    """Return the error for a drive that has left operation enabled without a command.

    The last statusword shows no fault, and no emergency message explains it either.
    """
    present_state = drive_state(statusword)
    transition_text = (
        f'it has left "{DriveState.OPERATION_ENABLED.value}" for "{present_state.value}" '
        f"(statusword 0x{statusword:04X})"
    )
    if present_state is DriveState.SWITCH_ON_DISABLED:
        # The usual cause is a lost motor supply; a bus command would leave the supply on.
        is_supplied = bool(statusword & VOLTAGE_ENABLED_BIT)
        supply_hint = (
            ", and its bit 4 says that the supply is there, so that such a command is possible"
        )
        sto_error = wired_stop_dropped(
            drive_name,
            f", or the motor's supply failed, or {_OTHER_SENDER_HINT}: {transition_text}"
            f"{supply_hint if is_supplied else ''}",
        )
        return DeviceError(f"{sto_error} If nobody pressed it, {_CHECK_BUS_ADVICE}.")
    if present_state in (DriveState.READY, DriveState.SWITCHED_ON):
        return DeviceError(
            f"{drive_name}: {transition_text}: {_OTHER_SENDER_HINT}; {_CHECK_BUS_ADVICE}."
        )
    return DeviceError(
        f"{drive_name}: {transition_text}, by itself or because {_OTHER_SENDER_HINT}; check STO, "
        f"supply and its own diagnosis. If these show nothing, {_CHECK_BUS_ADVICE}."
    )


_MAX_DEVIATING_TICKS = 10
"""Number of consecutive ticks with a wrong torque that raise an error.

A single lost command is no error, since the next tick repeats it."""


class TorqueFollowingCheck:
    """Check of each tick whether the drive's actual torque follows the commands.

    All torques are in 1/1000 of the rated torque.

    The drive may sample its torque before or after it applies the command of the previous tick, so
    the torque is compared with the last two commands. If the drive measures its torque, the torque
    follows the command with a first-order lag; the commands are then filtered by the same lag.

    A tolerance of 0 disables the comparison; otherwise it is in percent of the rated torque.
    `torque_response_s` is the time constant of the lag; 0 for a drive that reports the commanded
    torque. `tick_period_s` is the time between two commands.

    Attributes
    ----------
    is_active : bool
        Whether the drive reports its torque, so that the check is active.
    """

    def __init__(
        self,
        drive_name: str,
        tolerance_percent: float,
        torque_response_s: float = 0.0,
        tick_period_s: float = 1e-3,
    ) -> None:
        self._name = drive_name
        self._tolerance_per_mille = 10.0 * tolerance_percent
        # Fraction of a step that a command reaches after one period.
        self._step_fraction = (
            1.0 - exp(-tick_period_s / torque_response_s) if torque_response_s else 1.0
        )
        self.is_active = True
        self.reset()

    def reset(self) -> None:
        """Restart the check of the torque, for a drive whose commanded torque is zero."""
        self._commanded_per_mille = 0
        self._last_per_mille = 0.0
        self._previous_per_mille = 0.0
        self._deviating_ticks = 0

    def register_command(self, torque_per_mille: int) -> None:
        """Register the commanded torque of this tick, in 1/1000 of the rated torque."""
        self._commanded_per_mille = torque_per_mille
        previous_per_mille = self._previous_per_mille = self._last_per_mille
        self._last_per_mille = previous_per_mille + self._step_fraction * (
            torque_per_mille - previous_per_mille
        )

    def check_torque(self, actual_torque_per_mille: int) -> None:
        """Compare the actual torque, in 1/1000 of the rated torque, with the commands.

        Raise `DeviceError` if the torque has differed for too many consecutive ticks.
        """
        tolerance_per_mille = self._tolerance_per_mille
        if (
            abs(actual_torque_per_mille - self._last_per_mille) <= tolerance_per_mille
            or abs(actual_torque_per_mille - self._previous_per_mille) <= tolerance_per_mille
            or not tolerance_per_mille
            or not self.is_active
        ):
            self._deviating_ticks = 0
            return
        self._deviating_ticks += 1
        if self._deviating_ticks >= _MAX_DEVIATING_TICKS:
            raise DeviceError(
                f"{self._name}: it exerts {actual_torque_per_mille / 10:g} % of the rated torque "
                f"(object 6077) where {self._commanded_per_mille / 10:g} % were commanded, for "
                f"{_MAX_DEVIATING_TICKS} ticks; commands are lost, or the drive limits them. Check "
                "its diagnosis and cia402.torque_tolerance_percent; if it measures this torque, "
                "check cia402.torque_response_s."
            )


# Up and down

_ENABLING_STEPS = (
    (SHUTDOWN_COMMAND, DriveState.READY),
    (SWITCH_ON_COMMAND, DriveState.SWITCHED_ON),
    (ENABLE_OPERATION_COMMAND, DriveState.OPERATION_ENABLED),
)
"""Controlwords that enable the drive in steps, each with the state that the drive then reaches."""
_MAX_UNANSWERED_SYNCS = 10
"""Number of consecutive unanswered SYNCs after which enabling fails."""
_MAX_UNANSWERED_SYNCS_IN_LOCK_STEP = 3
"""Number of consecutive unanswered SYNCs after which enabling fails, for a drive in lock-step."""
_SWITCH_OFF_TIMEOUT_NS = 50_000_000
"""Time in nanoseconds within which the drive has to confirm that it is off."""


class StopRequestedError(Exception):
    """Error: the operator requested a stop while the drive was being enabled."""


def enable_operation(node: Node, is_stop_requested: Callable[[], bool]) -> None:
    """Bring the drive to operation enabled; send RPDO, SYNC and heartbeat once a period.

    `is_stop_requested` is called once a period; True aborts the transition. Raise
    `StopRequestedError` if `is_stop_requested` returned True. The drive may be enabled then. Raise
    `DeviceError` if a step takes longer than ``cia402.enable_timeout_s``, or the enabled drive
    ignores the target torque or is in another mode of operation. It may be enabled then.
    """
    inbox = node.inbox
    sync_grid_start_ns = node.sync_ns
    for controlword, state in _ENABLING_STEPS:

        def describe_failure(state: DriveState = state) -> str:
            return (
                f'it does not get to "{state.value}" and stays in '
                f'"{drive_state(inbox.statusword).value}" (statusword 0x{inbox.statusword:04X}); '
                "check STO, motor supply and its own diagnosis"
            )

        def is_reached(state: DriveState = state) -> bool:
            return drive_state(inbox.statusword) is state

        _send_controlword_until(
            node, controlword, sync_grid_start_ns, is_reached, describe_failure, is_stop_requested
        )
    if node.settings.follows_target_bit:
        _send_controlword_until(
            node,
            ENABLE_OPERATION_COMMAND,
            sync_grid_start_ns,
            lambda: inbox.statusword & FOLLOWS_TARGET_BIT != 0,
            lambda: (
                "it is enabled and ignores the target torque: bit 12 of its statusword "
                f"0x{inbox.statusword:04X} is not set; check its own diagnosis, and if this "
                "drive has no such bit: cia402.follows_target_bit = false"
            ),
            is_stop_requested,
        )
    _check_mode(node, sync_grid_start_ns, is_stop_requested)


def switch_off(node: Node) -> bool:
    """Zero the torque and disable the drive; return whether it is off. Never raises.

    The drive is off if its statusword has shown it. If not, the command to stop its node has been
    sent.
    """
    if _switch_off_by_pdo(node):
        return True
    # A confirmed SDO request does not mean that the drive has executed the command.
    if node.send_write_request(node.frames.disable_voltage, CONTROLWORD, 0):
        deadline_ns = time.monotonic_ns() + _SWITCH_OFF_TIMEOUT_NS
        while time.monotonic_ns() < deadline_ns:
            if node.is_torque_off():
                return True
    node.send_if_possible(node.frames.stop)
    return False


def _check_mode(node: Node, sync_grid_start_ns: int, is_stop_requested: Callable[[], bool]) -> None:
    """Check that the enabled drive is in cyclic torque mode; some drives show it only then."""
    inbox, node_frames, send_frame = node.inbox, node.frames, node.exchange.send
    last_reported_mode: int | None = None

    def is_in_cyclic_torque_mode() -> bool:
        nonlocal last_reported_mode
        reported_mode = read_mode(inbox.sdo_reply)
        if reported_mode is None:
            return False
        last_reported_mode, inbox.sdo_reply = reported_mode, b""
        if last_reported_mode != CYCLIC_TORQUE_MODE:
            send_frame(node_frames.read_mode_request)
        return last_reported_mode == CYCLIC_TORQUE_MODE

    inbox.sdo_reply = b""
    send_frame(node_frames.read_mode_request)
    _send_controlword_until(
        node,
        ENABLE_OPERATION_COMMAND,
        sync_grid_start_ns,
        is_in_cyclic_torque_mode,
        lambda: (
            f"its mode of operation (object 6061) is {last_reported_mode}, not "
            f"{CYCLIC_TORQUE_MODE} (cyclic synchronous torque)"
        ),
        is_stop_requested,
    )


def _send_controlword_until(
    node: Node,
    controlword: int,
    sync_grid_start_ns: int,
    is_reached: Callable[[], bool],
    describe_failure: Callable[[], str],
    is_stop_requested: Callable[[], bool],
) -> None:
    """Send a controlword with zero torque once a period until `is_reached` returns True."""
    rpdo_frame = node.frames.rpdo_frame(controlword, 0)
    timeout_s = node.settings.enable_timeout_s
    max_unanswered_syncs = (
        _MAX_UNANSWERED_SYNCS_IN_LOCK_STEP if node.lock_step else _MAX_UNANSWERED_SYNCS
    )
    unanswered_syncs = 0
    for _ in range(ceil(timeout_s * node.rate_hz)):
        if is_stop_requested():
            raise StopRequestedError
        node.exchange.send(rpdo_frame)
        node.sleep_until_next_period(sync_grid_start_ns)
        node.now_ns += node.period_ns
        node.send_sync()
        node.send_heartbeat()
        is_answered = node.await_reply()
        node.raise_if_alarmed()
        if is_answered and is_reached():
            return
        unanswered_syncs = 0 if is_answered else unanswered_syncs + 1
        if unanswered_syncs >= max_unanswered_syncs:
            raise DeviceError(
                f"{node.name}: it has stopped answering SYNC while being enabled; check its supply "
                "and the cable."
            )
    raise DeviceError(
        f"{node.name}: {describe_failure()} (cia402.enable_timeout_s = {timeout_s:g} s)."
    )


def _switch_off_by_pdo(node: Node) -> bool:
    """Command the drive off by RPDO; return whether its statusword confirmed it; never raises."""
    idle_rpdo = node.frames.rpdo_frame(DISABLE_VOLTAGE_COMMAND, 0)
    started_ns = time.monotonic_ns()
    while time.monotonic_ns() - started_ns <= _SWITCH_OFF_TIMEOUT_NS:
        # At SYNC the drive applies the torque of the RPDO, and samples its statusword.
        is_rpdo_sent = node.send_if_possible(idle_rpdo)
        is_answered = node.sync_if_possible()
        # The drive may need time for a ramp; meanwhile it must not miss this computer's heartbeat.
        node.now_ns += node.period_ns
        with suppress(Exception):  # an adapter's library may raise anything
            node.send_heartbeat()
        if is_answered and drive_state(node.inbox.statusword) in TORQUE_FREE_STATES:
            return True
        if not is_rpdo_sent:
            break  # the bus has failed
        node.sleep_until_next_period(node.sync_ns)
    return False
