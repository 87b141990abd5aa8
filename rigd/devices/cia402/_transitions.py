"""Transitions of the drive: up to operation enabled, down again, and unexpected ones."""

import time
from collections.abc import Callable
from contextlib import suppress
from math import ceil, exp
from typing import Final

from rigd.devices.cia402._node import Node
from rigd.devices.cia402._protocol import (
    DISABLE_VOLTAGE,
    ENABLE_OPERATION,
    FOLLOWS_TARGET,
    OFF,
    SHUTDOWN,
    SWITCH_ON,
    VOLTAGE_ENABLED,
    DriveState,
    read_mode,
    state_of,
)
from rigd.devices.cia402.objects import CONTROLWORD, CYCLIC_TORQUE
from rigd.devices.contracts import DeviceError, wired_stop_dropped

_OTHER_COMMANDER: Final = (
    "a command came over the bus that this computer did not give (a corrupt frame, a second master)"
)
_CHECK_THE_BUS: Final = "check the bus cable, its termination, and what else is connected to it"


# Why a drive has left operation


def left_operation(name: str, statusword: int) -> DeviceError:
    """Return the error of an enabled drive that is not in operation enabled any more.

    Parameters
    ----------
    name
        Name of the drive, for messages.
    statusword
        Last statusword; it shows no fault, and no emergency message explains it.
    """
    state = state_of(statusword)
    left = (
        f'it has left "{DriveState.OPERATION_ENABLED.value}" for "{state.value}" '
        f"(statusword 0x{statusword:04X})"
    )
    if state is DriveState.SWITCH_ON_DISABLED:
        # It has lost its supply there, mostly; a command leaves that on.
        supplied = bool(statusword & VOLTAGE_ENABLED)
        hint = ", and its bit 4 says that the supply is there, which indicates such a command"
        dropped = wired_stop_dropped(
            name,
            f", or the motor's supply failed, or {_OTHER_COMMANDER}: {left}"
            f"{hint if supplied else ''}",
        )
        return DeviceError(f"{dropped} If nobody pressed it, {_CHECK_THE_BUS}.")
    if state in (DriveState.READY, DriveState.SWITCHED_ON):
        return DeviceError(f"{name}: {left}: {_OTHER_COMMANDER}; {_CHECK_THE_BUS}.")
    return DeviceError(
        f"{name}: {left}, by itself or because {_OTHER_COMMANDER}; check STO, supply and its "
        f"own diagnosis. If these show nothing, {_CHECK_THE_BUS}."
    )


_TICKS = 10
"""Ticks in a row; a single lost command is repeated by the next."""


class TorqueFollowing:
    """Compares actual torques with commands, in 1/1000 of the rated torque.

    A TPDO may be made before or after the drive takes over the command of the tick before, so it is
    compared with the last two. Where the drive measures its torque, that follows the command with a
    lag of first order; the commands are then filtered alike before they are compared.

    Parameters
    ----------
    name
        Name of the drive, for messages.
    tolerance_percent
        Tolerance in percent of the rated torque; 0 disables the comparison.
    response_s
        Time constant of that lag; 0 for a drive that reports the commanded torque.
    period_s
        Time between two commands.

    Attributes
    ----------
    compares : bool
        Whether the drive reports its torque.
    """

    def __init__(
        self, name: str, tolerance_percent: float, response_s: float = 0.0, period_s: float = 1e-3
    ) -> None:
        self._name = name
        self._tolerance = 10.0 * tolerance_percent
        # Fraction of a step that a command reaches after one period.
        self._step_fraction = 1.0 - exp(-period_s / response_s) if response_s else 1.0
        self.compares = True
        self.start()

    def start(self) -> None:
        """Start with a drive whose commanded torque is zero."""
        self._commanded = 0
        self._last = 0.0
        self._before = 0.0
        self._departed = 0

    def command(self, per_mille: int) -> None:
        """Note the torque that is commanded."""
        self._commanded = per_mille
        before = self._before = self._last
        self._last = before + self._step_fraction * (per_mille - before)

    def compare(self, actual_per_mille: int) -> None:
        """Compare the drive's torque with the last commands.

        Raises
        ------
        DeviceError
            If they have differed for too many ticks in a row.
        """
        tolerance = self._tolerance
        if (
            abs(actual_per_mille - self._last) <= tolerance
            or abs(actual_per_mille - self._before) <= tolerance
            or not tolerance
            or not self.compares
        ):
            self._departed = 0
            return
        self._departed += 1
        if self._departed >= _TICKS:
            raise DeviceError(
                f"{self._name}: it exerts {actual_per_mille / 10:g} % of the rated torque (object "
                f"6077) where {self._commanded / 10:g} % were commanded, for {_TICKS} ticks; "
                "commands are lost, or the drive limits them. Check its diagnosis and "
                "cia402.torque_tolerance_percent; where it measures this torque, check "
                "cia402.torque_response_s."
            )


# Up and down

_STEPS_UP = (
    (SHUTDOWN, DriveState.READY),
    (SWITCH_ON, DriveState.SWITCHED_ON),
    (ENABLE_OPERATION, DriveState.OPERATION_ENABLED),
)
_SILENT_TURNS = 10
_SILENT_TURNS_IN_LOCK_STEP = 3
"""SYNCs in a row without an answer after which stepping up gives up."""
_SWITCH_OFF_NS = 50_000_000


class StopRequestedError(Exception):
    """The operator requested a stop while the drive was being enabled."""


def step_up(node: Node, stop: Callable[[], bool]) -> None:
    """Bring the drive to operation enabled; RPDO, SYNC and heartbeat go out once a period.

    Parameters
    ----------
    node
        The drive's node.
    stop
        Called once a period; True aborts the transition.

    Raises
    ------
    StopRequestedError
        If `stop` returned True. The drive may be enabled then.
    DeviceError
        If a step takes longer than ``cia402.enable_timeout_s``, the drive then ignores the torque,
        or is in another mode. It may be enabled then.
    """
    inbox = node.inbox
    grid_ns = node.sync_ns
    for controlword, state in _STEPS_UP:

        def stuck(state: DriveState = state) -> str:
            return (
                f'it does not get to "{state.value}" and stays in '
                f'"{state_of(inbox.statusword).value}" (statusword 0x{inbox.statusword:04X}); '
                "check STO, motor supply and its own diagnosis"
            )

        def reached(state: DriveState = state) -> bool:
            return state_of(inbox.statusword) is state

        _turn_until(node, controlword, grid_ns, reached, stuck, stop)
    if node.settings.follows_target_bit:
        _turn_until(
            node,
            ENABLE_OPERATION,
            grid_ns,
            lambda: inbox.statusword & FOLLOWS_TARGET != 0,
            lambda: (
                "it is enabled and ignores the target torque: bit 12 of its statusword "
                f"0x{inbox.statusword:04X} is not set; check its own diagnosis, and if this "
                "drive has no such bit: cia402.follows_target_bit = false"
            ),
            stop,
        )
    _check_mode(node, grid_ns, stop)


def switch_off(node: Node) -> bool:
    """Zero the torque and disable the drive. Never raises.

    Returns
    -------
    bool
        Whether the drive has shown it in its statusword. If not, its node has been stopped, as far
        as it takes frames at all.
    """
    if _switch_off_by_pdo(node):
        return True
    # That the drive has taken the command by SDO does not say that it has followed it.
    if node.write(node.frames.disable_voltage, CONTROLWORD, 0):
        give_up_ns = time.monotonic_ns() + _SWITCH_OFF_NS
        while time.monotonic_ns() < give_up_ns:
            if node.is_off():
                return True
    node.send_if_possible(node.frames.stop)
    return False


def _check_mode(node: Node, grid_ns: int, stop: Callable[[], bool]) -> None:
    """Ask the enabled drive for its mode: before, some drives do not show it."""
    inbox, frames, send = node.inbox, node.frames, node.exchange.send
    mode: int | None = None

    def in_cyclic_torque() -> bool:
        nonlocal mode
        mode_read = read_mode(inbox.reply)
        if mode_read is None:
            return False
        mode, inbox.reply = mode_read, b""
        if mode != CYCLIC_TORQUE:
            send(frames.ask_mode)
        return mode == CYCLIC_TORQUE

    inbox.reply = b""
    send(frames.ask_mode)
    _turn_until(
        node,
        ENABLE_OPERATION,
        grid_ns,
        in_cyclic_torque,
        lambda: (
            f"its mode of operation (object 6061) is {mode}, not {CYCLIC_TORQUE} (cyclic "
            "synchronous torque)"
        ),
        stop,
    )


def _turn_until(
    node: Node,
    controlword: int,
    grid_ns: int,
    reached: Callable[[], bool],
    stuck: Callable[[], str],
    stop: Callable[[], bool],
) -> None:
    """Send a controlword with zero torque, period by period, until the drive follows."""
    frame = node.frames.rpdo(controlword, 0)
    timeout_s = node.settings.enable_timeout_s
    limit = _SILENT_TURNS_IN_LOCK_STEP if node.lock_step else _SILENT_TURNS
    silent = 0
    for _ in range(ceil(timeout_s * node.rate_hz)):
        if stop():
            raise StopRequestedError
        node.exchange.send(frame)
        node.await_grid(grid_ns)
        node.now_ns += node.period_ns
        node.send_sync()
        node.send_heartbeat()
        answered = node.await_reply()
        node.refuse_alarm()
        if answered and reached():
            return
        silent = 0 if answered else silent + 1
        if silent >= limit:
            raise DeviceError(
                f"{node.name}: it has stopped answering SYNC while being enabled; check its supply "
                "and the cable."
            )
    raise DeviceError(f"{node.name}: {stuck()} (cia402.enable_timeout_s = {timeout_s:g} s).")


def _switch_off_by_pdo(node: Node) -> bool:
    """Return whether the statusword showed the drive off; never raises."""
    idle = node.frames.rpdo(DISABLE_VOLTAGE, 0)
    started_ns = time.monotonic_ns()
    while time.monotonic_ns() - started_ns <= _SWITCH_OFF_NS:
        # At SYNC the torque of the RPDO takes effect, and the statusword is read.
        taken = node.send_if_possible(idle)
        answered = node.sync_if_possible()
        # The drive may take its time, for a ramp, and must not miss the loop meanwhile.
        node.now_ns += node.period_ns
        with suppress(Exception):  # an adapter's library may raise anything
            node.send_heartbeat()
        if answered and state_of(node.inbox.statusword) in OFF:
            return True
        if not taken:
            break  # the bus is gone
        node.await_grid(node.sync_ns)
    return False
