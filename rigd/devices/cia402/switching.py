"""Up to operation enabled at zero torque, and down again."""

import time
from collections.abc import Callable
from contextlib import suppress
from math import ceil

from rigd.devices.cia402.frames import read_mode
from rigd.devices.cia402.node import Node
from rigd.devices.cia402.objects import CONTROLWORD, CYCLIC_TORQUE
from rigd.devices.cia402.states import (
    DISABLE_VOLTAGE,
    ENABLE_OPERATION,
    FOLLOWS_TARGET,
    OFF,
    SHUTDOWN,
    SWITCH_ON,
    DriveState,
    state_of,
)
from rigd.devices.contracts import DeviceError

_STEPS_UP = (
    (SHUTDOWN, DriveState.READY),
    (SWITCH_ON, DriveState.SWITCHED_ON),
    (ENABLE_OPERATION, DriveState.OPERATION_ENABLED),
)
_SILENT_TURNS = 10
_SILENT_TURNS_IN_LOCK_STEP = 3
"""SYNCs in a row without an answer after which stepping up gives up."""
_SWITCH_OFF_NS = 50_000_000


class StopAskedError(Exception):
    """The operator wants no enabled drive any more."""


def step_up(node: Node, stop: Callable[[], bool]) -> None:
    """Bring the drive to operation enabled; RPDO, SYNC and heartbeat go out once a period.

    Parameters
    ----------
    node
        Of the drive.
    stop
        Asked once a period whether to give up.

    Raises
    ------
    StopAskedError
        If it said so. The drive may be enabled then.
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
                "look at STO, motor supply and its own diagnosis"
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
                f"0x{inbox.statusword:04X} is not set; look at its own diagnosis, and if this "
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
        told = read_mode(inbox.reply)
        if told is None:
            return False
        mode, inbox.reply = told, b""
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
            raise StopAskedError
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
                f"{node.name}: it has stopped answering SYNC while being enabled; look at its "
                "supply and at the cable."
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
