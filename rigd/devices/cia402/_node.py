"""The drive as a node on the bus: start, SYNC, heartbeat, requests, and what has come from it."""

import time
from collections.abc import Callable
from math import ceil
from struct import error as LengthError  # noqa: N812

from rigd.devices.canbus import CanExchange, ReplyPairing
from rigd.devices.cia402._protocol import (
    BOOT_UP,
    NMT_STATES,
    OFF,
    OPERATIONAL,
    DriveState,
    NodeFrames,
    describe_error,
    is_written,
    read_emergency,
    read_statusword,
    state_of,
    unpack_short_tpdo,
    unpack_tpdo,
)
from rigd.devices.contracts import DeviceError, wired_stop_dropped
from rigd.devices.parameters import RigParameters

_TOGGLE_BIT = 0x80


# What has come


class ReceivedFrames:
    """Latest content of the drive's frames. A frame of the wrong length only counts.

    Parameters
    ----------
    name
        Name of the drive, for messages.
    sto_error_code
        Error code of the emergency message for a dropped STO; 0 if the drive has none.

    Attributes
    ----------
    statusword, position, torque
        Content of the last TPDO; position in counts, torque in 1/1000 of the rated one.
    strayed : int or None
        First statusword that was not as :meth:`guard` asks, in whichever TPDO it came: the drive
        may be back in the next one.
    replies : int
        TPDOs since this was last set to zero, regardless of their content.
    legible : bool
        The last TPDO had the right length.
    nmt_state : int or None
        NMT state in the last heartbeat.
    received : bool
        Whether a heartbeat has arrived since this was last set to False.
    watching : bool
        The drive is meant to stay operational.
    alarm : str
        Why a session has to end, as a sentence for the operator: an emergency message, a restart,
        a drive that has left operational. The first reason stays; empty: none.
    emergency : bool
        An emergency message has come.
    reply : bytes
        The last SDO reply.
    malformed : int
        Frames of the wrong length.
    with_torque : bool
        Whether TPDOs end in the actual torque, which not every drive reports.
    """

    __slots__ = (
        "_mask",
        "_value",
        "alarm",
        "emergency",
        "legible",
        "malformed",
        "name",
        "nmt_state",
        "position",
        "received",
        "replies",
        "reply",
        "statusword",
        "sto_error_code",
        "strayed",
        "torque",
        "watching",
        "with_torque",
    )

    def __init__(self, name: str, sto_error_code: int = 0) -> None:
        self.name = name
        self.sto_error_code = sto_error_code
        self.malformed = 0
        self.with_torque = True
        self.clear()

    def clear(self) -> None:
        """Forget everything but the number of malformed frames."""
        self.statusword = 0
        self.guard(0, 0)
        self.position = 0
        self.torque = 0
        self.replies = 0
        self.legible = False
        self.nmt_state: int | None = None
        self.received = False
        self.watching = False
        self.alarm = ""
        self.emergency = False
        self.reply = b""

    def guard(self, mask: int, value: int) -> None:
        """Monitor every statusword from now on: it must have `value` in the bits of `mask`."""
        self._mask, self._value = mask, value
        self.strayed: int | None = None
        if self.statusword & mask != value:
            self.strayed = self.statusword

    def take_tpdo(self, data: bytes) -> None:
        """Store statusword and position of a TPDO."""
        self.replies += 1
        try:
            if self.with_torque:
                self.statusword, self.position, self.torque = unpack_tpdo(data)
            else:
                self.statusword, self.position = unpack_short_tpdo(data)
            self.legible = True
            if self.statusword & self._mask != self._value and self.strayed is None:
                self.strayed = self.statusword
        except LengthError:
            self.legible = False
            self.malformed += 1

    def take_emergency(self, data: bytes) -> None:
        """Store an emergency message; code zero ends an earlier one."""
        message = read_emergency(data)
        if message is None:
            self.malformed += 1
            return
        code, _, vendor = message
        if code >> 8 == 0:
            return
        self.emergency = True
        if self.alarm:
            return
        if code == self.sto_error_code:
            shown = f" (emergency message, error code 0x{code:04X})"
            self.alarm = str(wired_stop_dropped(self.name, shown))
        else:
            own = f", vendor's bytes {vendor.hex(' ')}" if any(vendor) else ""
            self.alarm = f"{self.name}: emergency message: {describe_error(code)}{own}."

    def take_heartbeat(self, data: bytes) -> None:
        """Take a heartbeat, or the message that the drive has started."""
        if not data:
            self.malformed += 1
            return
        state = data[0] & ~_TOGGLE_BIT
        self.nmt_state = state
        self.received = True
        if self.watching and state != OPERATIONAL and not self.alarm:
            if state == BOOT_UP:
                what = "it has restarted by itself; check its supply"
            else:
                words = NMT_STATES.get(state, f"state {state}")
                what = (
                    f"it has left operational for {words}, as it does when it misses heartbeats, "
                    "or when another master on the bus commands it to"
                )
            self.alarm = f"{self.name}: {what}."

    def take_reply(self, data: bytes) -> None:
        """Take an SDO reply."""
        self.reply = data


# The node

_LONG_AGO_NS = -(1 << 62)
_START_PATIENCE_NS = 1_000_000_000
"""Time limit to become operational, in addition to three periods of the drive's heartbeat."""
_FIRST_REPLY_NS = 100_000_000
_FIRST_REPLIES = 20
"""SYNCs on which a reply within a period is hoped for: this computer may be the slow one."""
_WRITTEN_NS = 50_000_000
_REASON_NS = 5_000_000
"""How long a drive in fault has to say why."""


class Node:
    """One connection to a drive that has been set up.

    Parameters
    ----------
    rig
        Parameters with the sections ``cia402`` and ``acquisition``.
    exchange
        Started exchange; it delivers the drive's frames to the inbox.
    frames, inbox
        Frames to the drive, and what has come from it.

    Attributes
    ----------
    pairing : ReplyPairing
        Determines whether the last TPDO answers the last SYNC.
    lock_step : bool
        The drive is a simulated one whose time passes with the SYNCs: replies are waited for, and
        nothing is paced.
    sync_ns : int
        ``time.monotonic_ns`` of the last SYNC.
    now_ns : int
        Time by which heartbeats go: that of the ticks, or in lock-step the drive's.
    """

    def __init__(
        self, rig: RigParameters, exchange: CanExchange, frames: NodeFrames, inbox: ReceivedFrames
    ) -> None:
        assert rig.cia402 is not None
        assert rig.acquisition is not None
        self.name = inbox.name
        self.exchange = exchange
        self.frames = frames
        self.inbox = inbox
        self.settings = rig.cia402
        self.rate_hz = rig.rate_hz
        self.period_ns = round(1e9 / rig.rate_hz)
        self.deadline_ns = round(rig.acquisition.deadline_us * 1000)
        self.lock_step = self.deadline_ns > self.period_ns
        pauses = self.settings.sync_gaps and not self.lock_step
        self.pairing = ReplyPairing(inbox, pauses=pauses)
        self.sync_ns = 0
        self.now_ns = 0
        self._reset_command = f"rigd reset --profile {rig.name}"
        self._heartbeat_ns = round(self.settings.heartbeat_period_s * 1e9)
        self._next_heartbeat_ns = _LONG_AGO_NS

    def go_operational(self, *, beats: bool = True) -> None:
        """Start the node and wait for the heartbeat that confirms it.

        Parameters
        ----------
        beats
            The drive has a heartbeat; without one its first TPDO has to say it.

        Raises
        ------
        DeviceError
            If none comes.
        """
        inbox = self.inbox
        inbox.nmt_state = None
        self.exchange.send(self.frames.start)
        if not beats:
            inbox.watching = True
            return
        period_s = self.settings.drive_heartbeat_period_s
        if self.lock_step:
            # Its time does not pass without SYNC, not even up to its next heartbeat.
            turns = ceil(3 * period_s * self.rate_hz)
            while not self._is_operational() and turns > 0 and self.sync():
                turns -= 1
        else:
            patience_ns = _START_PATIENCE_NS + round(3e9 * period_s)
            self.exchange.wait_until(self._is_operational, time.monotonic_ns() + patience_ns)
        if not self._is_operational():
            reported = (
                "no heartbeat came"
                if inbox.nmt_state is None
                else f"its heartbeat says {inbox.nmt_state}"
            )
            raise DeviceError(
                f"{self.name}: it does not become operational ({reported}, {OPERATIONAL} was "
                "expected); check its own diagnosis."
            )
        inbox.watching = True

    def await_first_reply(self) -> None:
        """Send SYNC until it is answered within a period.

        Raises
        ------
        DeviceError
            If that does not succeed, or the drive is in fault.
        """
        best_ns = None
        for _ in range(_FIRST_REPLIES):
            if not self.sync(_FIRST_REPLY_NS):
                break
            delay_ns = time.monotonic_ns() - self.sync_ns
            best_ns = delay_ns if best_ns is None else min(best_ns, delay_ns)
            if delay_ns <= self.period_ns or self.lock_step:
                self.refuse_alarm()
                return
        if best_ns is None:
            raise DeviceError(
                f"{self.name}: it does not answer SYNC with its TPDO, although it is operational; "
                "check its own diagnosis."
            )
        raise DeviceError(
            f"{self.name}: it answers SYNC only after {best_ns * 1e-6:.2g} ms, more than the "
            f"period of {self.period_ns * 1e-6:g} ms; check bit rate and adapter, or choose a "
            "lower rig.rate_hz."
        )

    def send_sync(self) -> None:
        """Send SYNC; what came before it is not an answer to it."""
        self.exchange.drain()
        self.pairing.ask()
        self.sync_ns = time.monotonic_ns()
        self.exchange.send(self.frames.sync)

    def send_sync_or_pause(self) -> None:
        """Send SYNC, or leave it out for a tick to see which reply is whose."""
        if self.pairing.owed:
            self.exchange.drain()
            if self.pairing.wants_pause():
                self.pairing.pause()
                return
        self.send_sync()

    def send_heartbeat(self) -> None:
        """Send this computer's heartbeat if it is due."""
        if self.now_ns >= self._next_heartbeat_ns:
            self.exchange.send(self.frames.heartbeat)
            self._next_heartbeat_ns = self.now_ns + self._heartbeat_ns

    def resume(self) -> None:
        """Resume the ticks after a gap: both heartbeats restart."""
        self._next_heartbeat_ns = _LONG_AGO_NS
        self.inbox.received = True

    def await_reply(self, patience_ns: int = 0) -> bool:
        """Wait for a TPDO: one period or as given, in lock-step for as long as it takes."""
        patience_ns = self.deadline_ns if self.lock_step else patience_ns or self.period_ns
        return self.exchange.wait_until(self._is_answered, self.sync_ns + patience_ns)

    def sync(self, patience_ns: int = 0) -> bool:
        """Send SYNC and return whether it was answered."""
        self.send_sync()
        return self.await_reply(patience_ns)

    def sync_if_possible(self) -> bool:
        """Send SYNC whatever the bus reports, and return whether it was answered; never raises."""
        with self.exchange.regardless():
            self.exchange.drain()  # what has come is not an answer
            self.pairing.ask()
            self.sync_ns = time.monotonic_ns()
            return self.send_if_possible(self.frames.sync) and self.await_reply()

    def await_grid(self, grid_ns: int) -> None:
        """Wait for the next SYNC as the ticks will go on: whole periods after `grid_ns`."""
        if self.lock_step:
            return
        wait_ns = self.period_ns - (time.monotonic_ns() - grid_ns) % self.period_ns
        time.sleep(wait_ns * 1e-9)

    def write(self, request: bytes, index: int, sub: int) -> bool:
        """Send an SDO request to write, and return whether it was confirmed in time."""
        inbox = self.inbox
        inbox.reply = b""
        return self._ask_if_possible(request, lambda: is_written(inbox.reply, index, sub))

    def is_off(self) -> bool:
        """Ask the drive for its statusword by SDO, and return whether it shows the drive off."""
        inbox = self.inbox
        inbox.reply = b""
        self._ask_if_possible(
            self.frames.ask_statusword, lambda: read_statusword(inbox.reply) is not None
        )
        statusword = read_statusword(inbox.reply)
        return statusword is not None and state_of(statusword) in OFF

    def send_if_possible(self, frame: bytes) -> bool:
        """Send a frame, and return whether the bus has taken it; never raises."""
        try:
            self.exchange.send(frame)
        except Exception:  # an adapter's library may raise anything, and this is the way off
            return False
        return True

    def await_alarm(self) -> None:
        """Wait briefly for the emergency message of a drive that has left operation."""
        inbox = self.inbox
        if not inbox.alarm:
            self.exchange.wait_until(lambda: bool(inbox.alarm), time.monotonic_ns() + _REASON_NS)

    def refuse_alarm(self) -> None:
        """Raise if the drive has sent an emergency message, or is in fault.

        Raises
        ------
        DeviceError
            With the reason.
        """
        inbox = self.inbox
        in_fault = state_of(inbox.statusword) in (DriveState.FAULT, DriveState.FAULT_REACTION)
        if in_fault:
            self.await_alarm()
        if not (in_fault or inbox.alarm):
            return
        reason = inbox.alarm or (
            f'{self.name}: it is in the state "{state_of(inbox.statusword).value}" (statusword '
            f"0x{inbox.statusword:04X}) and names no cause."
        )
        if in_fault:
            reason += f" Remove the cause, then: {self._reset_command}"
        elif inbox.emergency:
            # The message may be from a drive that was off; one that was on reports its state later.
            reason += (
                f" Remove the cause; if drive or daemon are in fault then: {self._reset_command}"
            )
        raise DeviceError(reason)

    def _ask_if_possible(self, request: bytes, answered: Callable[[], bool]) -> bool:
        """Send an SDO request whatever the bus reports; return whether the answer came in time."""
        with self.exchange.regardless():
            return self.send_if_possible(request) and self.exchange.wait_until(
                answered, time.monotonic_ns() + _WRITTEN_NS
            )

    def _is_operational(self) -> bool:
        return self.inbox.nmt_state == OPERATIONAL

    def _is_answered(self) -> bool:
        return self.inbox.replies > 0
