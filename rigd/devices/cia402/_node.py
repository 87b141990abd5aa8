"""CANopen node of the drive: start, SYNC, heartbeat, SDO requests, and the received frames."""

import time
from collections.abc import Callable
from math import ceil
from struct import error as LengthError  # noqa: N812

from rigd.devices.canbus import CanExchange, ReplyPairing
from rigd.devices.cia402._protocol import (
    BOOT_UP_STATE,
    NMT_STATES,
    OPERATIONAL_STATE,
    TORQUE_FREE_STATES,
    DriveState,
    NodeFrames,
    confirms_write,
    describe_error,
    drive_state,
    read_emergency,
    read_statusword,
    unpack_short_tpdo,
    unpack_tpdo,
)
from rigd.devices.contracts import DeviceError, wired_stop_dropped
from rigd.devices.parameters import RigParameters

_HEARTBEAT_TOGGLE_BIT = 0x80
"""Bit of a heartbeat's data that is not part of the NMT state (toggle bit of node guarding)."""


# What has come


class ReceivedFrames:
    """Latest contents of the frames received from the drive.

    Frames of the wrong length are only counted. The drive's name is for messages. `sto_error_code`
    is the error code of the drive's emergency message for a dropped STO; 0 if it sends none.

    Attributes
    ----------
    statusword, position, torque
        Contents of the last TPDO: statusword, position in encoder counts, torque in 1/1000 of the
        rated torque.
    unexpected_statusword : int or None
        First statusword that violated the requirement of :meth:`require_status`; None if there was
        none. It is stored even if a later TPDO shows the required state again.
    reply_count : int
        Number of TPDOs received since this was last set to zero, valid or not.
    is_last_tpdo_valid : bool
        Whether the last TPDO had the right length.
    nmt_state : int or None
        NMT state in the last heartbeat; None if none has been received.
    heartbeat_received : bool
        Whether a heartbeat has arrived since this was last set to False.
    must_stay_operational : bool
        Whether leaving the NMT state operational raises an alarm.
    alarm : str
        Reason to end the session, as a sentence for the operator: an emergency message, a restart,
        or a drive that has left operational. The first reason is retained; empty if there is none.
    emergency_received : bool
        Whether an emergency message has been received.
    sdo_reply : bytes
        Data of the last SDO reply.
    malformed_frames : int
        Number of received frames of the wrong length.
    tpdo_has_torque : bool
        Whether the TPDO contains the actual torque, which not every drive reports.
    """

    __slots__ = (
        "_required_mask",
        "_required_value",
        "alarm",
        "emergency_received",
        "heartbeat_received",
        "is_last_tpdo_valid",
        "malformed_frames",
        "must_stay_operational",
        "name",
        "nmt_state",
        "position",
        "reply_count",
        "sdo_reply",
        "statusword",
        "sto_error_code",
        "torque",
        "tpdo_has_torque",
        "unexpected_statusword",
    )

    def __init__(self, name: str, sto_error_code: int = 0) -> None:
        self.name = name
        self.sto_error_code = sto_error_code
        self.malformed_frames = 0
        self.tpdo_has_torque = True
        self.clear()

    def clear(self) -> None:
        """Reset the contents of all received frames, except the number of malformed frames."""
        self.statusword = 0
        self.require_status(0, 0)
        self.position = 0
        self.torque = 0
        self.reply_count = 0
        self.is_last_tpdo_valid = False
        self.nmt_state: int | None = None
        self.heartbeat_received = False
        self.must_stay_operational = False
        self.alarm = ""
        self.emergency_received = False
        self.sdo_reply = b""

    def require_status(self, status_mask: int, required_bits: int) -> None:
        """Require that every later statusword has `required_bits` in the bits of `status_mask`."""
        self._required_mask, self._required_value = status_mask, required_bits
        self.unexpected_statusword: int | None = None
        if self.statusword & status_mask != required_bits:
            self.unexpected_statusword = self.statusword

    def store_tpdo(self, tpdo_data: bytes) -> None:
        """Store statusword, position and torque of a received TPDO."""
        self.reply_count += 1
        try:
            if self.tpdo_has_torque:
                self.statusword, self.position, self.torque = unpack_tpdo(tpdo_data)
            else:
                self.statusword, self.position = unpack_short_tpdo(tpdo_data)
            self.is_last_tpdo_valid = True
            if (
                self.statusword & self._required_mask != self._required_value
                and self.unexpected_statusword is None
            ):
                self.unexpected_statusword = self.statusword
        except LengthError:
            self.is_last_tpdo_valid = False
            self.malformed_frames += 1

    def store_emergency(self, emergency_data: bytes) -> None:
        """Store a received emergency message as an alarm; error code zero means no error."""
        emergency_fields = read_emergency(emergency_data)
        if emergency_fields is None:
            self.malformed_frames += 1
            return
        error_code, _, vendor_bytes = emergency_fields
        if error_code >> 8 == 0:
            return
        self.emergency_received = True
        if self.alarm:
            return
        if error_code == self.sto_error_code:
            code_text = f" (emergency message, error code 0x{error_code:04X})"
            self.alarm = str(wired_stop_dropped(self.name, code_text))
        else:
            vendor_text = f", vendor's bytes {vendor_bytes.hex(' ')}" if any(vendor_bytes) else ""
            self.alarm = (
                f"{self.name}: emergency message: {describe_error(error_code)}{vendor_text}."
            )

    def store_heartbeat(self, heartbeat_data: bytes) -> None:
        """Store the NMT state of a received heartbeat; set an alarm if it is not operational."""
        if not heartbeat_data:
            self.malformed_frames += 1
            return
        nmt_state = heartbeat_data[0] & ~_HEARTBEAT_TOGGLE_BIT
        self.nmt_state = nmt_state
        self.heartbeat_received = True
        if self.must_stay_operational and nmt_state != OPERATIONAL_STATE and not self.alarm:
            if nmt_state == BOOT_UP_STATE:
                event_text = "it has restarted by itself; check its supply"
            else:
                state_name = NMT_STATES.get(nmt_state, f"state {nmt_state}")
                event_text = (
                    f"it has left operational for {state_name}, as it does when it misses "
                    "heartbeats, or when another master on the bus commands it to"
                )
            self.alarm = f"{self.name}: {event_text}."

    def store_sdo_reply(self, reply_data: bytes) -> None:
        """Store the data of a received SDO reply."""
        self.sdo_reply = reply_data


# The node

_EARLIEST_TIME_NS = -(1 << 62)
"""Time in nanoseconds before any clock reading: the next heartbeat is due at once."""
_OPERATIONAL_TIMEOUT_NS = 1_000_000_000
"""Time in nanoseconds to become operational, in addition to three periods of the drive's
heartbeat."""
_FIRST_REPLY_TIMEOUT_NS = 100_000_000
"""Time in nanoseconds to wait for the reply to one of the first SYNCs."""
_FIRST_REPLY_ATTEMPTS = 20
"""Number of SYNCs among which one must be answered within a period.

One late reply does not suffice to refuse the drive, since this computer may be the slow one."""
_SDO_REPLY_TIMEOUT_NS = 50_000_000
"""Time in nanoseconds to wait for the reply to an SDO request."""
_EMERGENCY_TIMEOUT_NS = 5_000_000
"""Time in nanoseconds to wait for the emergency message of a drive in fault."""


class Node:
    """Connection to the CANopen node of a drive that has been set up.

    The profile needs the sections ``cia402`` and ``acquisition``. The exchange has been started and
    delivers the drive's frames to `inbox`; `frames` are the prepared frames to the drive.

    Attributes
    ----------
    pairing : ReplyPairing
        Pairing of TPDOs with SYNCs: distinguishes a late TPDO from the reply to the last SYNC.
    lock_step : bool
        Whether the drive is simulated and its time advances with each SYNC. The driver then waits
        for every reply, and does not wait for the clock.
    sync_ns : int
        Time in nanoseconds (``time.monotonic_ns``) at which the last SYNC was sent.
    now_ns : int
        Time in nanoseconds by which heartbeats become due: that of the last tick, or in lock-step
        the drive's own time.
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
        may_omit_request = self.settings.sync_gaps and not self.lock_step
        self.pairing = ReplyPairing(inbox, may_omit_request=may_omit_request)
        self.sync_ns = 0
        self.now_ns = 0
        self._reset_command = f"rigd reset --profile {rig.name}"
        self._heartbeat_ns = round(self.settings.heartbeat_period_s * 1e9)
        self._next_heartbeat_ns = _EARLIEST_TIME_NS

    def go_operational(self, *, has_heartbeat: bool = True) -> None:
        """Start the drive's CANopen node and wait for the heartbeat that confirms it.

        The first TPDO of a drive that sends no heartbeat has to confirm the start. Raise
        `DeviceError` if the drive's heartbeat does not confirm the start in time.
        """
        inbox = self.inbox
        inbox.nmt_state = None
        self.exchange.send(self.frames.start)
        if not has_heartbeat:
            inbox.must_stay_operational = True
            return
        heartbeat_period_s = self.settings.drive_heartbeat_period_s
        if self.lock_step:
            # Without SYNC the drive's time does not advance, not even to its next heartbeat.
            remaining_syncs = ceil(3 * heartbeat_period_s * self.rate_hz)
            while (
                not self._is_operational() and remaining_syncs > 0 and self.sync_and_await_reply()
            ):
                remaining_syncs -= 1
        else:
            max_wait_ns = _OPERATIONAL_TIMEOUT_NS + round(3e9 * heartbeat_period_s)
            self.exchange.wait_until(self._is_operational, time.monotonic_ns() + max_wait_ns)
        if not self._is_operational():
            heartbeat_text = (
                "no heartbeat came"
                if inbox.nmt_state is None
                else f"its heartbeat says {inbox.nmt_state}"
            )
            raise DeviceError(
                f"{self.name}: it does not become operational ({heartbeat_text}, "
                f"{OPERATIONAL_STATE} was expected); check its own diagnosis."
            )
        inbox.must_stay_operational = True

    def await_first_reply(self) -> None:
        """Send SYNC repeatedly until the drive answers within a period.

        Raise `DeviceError` if the drive does not answer within a period, or is in fault.
        """
        shortest_reply_delay_ns = None
        for _ in range(_FIRST_REPLY_ATTEMPTS):
            if not self.sync_and_await_reply(_FIRST_REPLY_TIMEOUT_NS):
                break
            reply_delay_ns = time.monotonic_ns() - self.sync_ns
            shortest_reply_delay_ns = (
                reply_delay_ns
                if shortest_reply_delay_ns is None
                else min(shortest_reply_delay_ns, reply_delay_ns)
            )
            if reply_delay_ns <= self.period_ns or self.lock_step:
                self.raise_if_alarmed()
                return
        if shortest_reply_delay_ns is None:
            raise DeviceError(
                f"{self.name}: it does not answer SYNC with its TPDO, although it is operational; "
                "check its own diagnosis."
            )
        raise DeviceError(
            f"{self.name}: it answers SYNC only after {shortest_reply_delay_ns * 1e-6:.2g} ms, "
            f"more than the period of {self.period_ns * 1e-6:g} ms; check bit rate and adapter, or "
            "choose a lower rig.rate_hz."
        )

    def send_sync(self) -> None:
        """Send SYNC; frames that have arrived before do not count as its reply."""
        self.exchange.deliver_frames()
        self.pairing.register_request()
        self.sync_ns = time.monotonic_ns()
        self.exchange.send(self.frames.sync)

    def send_sync_or_pause(self) -> None:
        """Send SYNC, or omit it in this tick to find out if a missing reply is late or lost."""
        if self.pairing.outstanding:
            self.exchange.deliver_frames()
            if self.pairing.needs_pause():
                self.pairing.register_pause()
                return
        self.send_sync()

    def send_heartbeat(self) -> None:
        """Send this computer's heartbeat if it is due."""
        if self.now_ns >= self._next_heartbeat_ns:
            self.exchange.send(self.frames.heartbeat)
            self._next_heartbeat_ns = self.now_ns + self._heartbeat_ns

    def restart_heartbeat_timing(self) -> None:
        """Restart the timing of the heartbeats of computer and drive after a time without ticks."""
        self._next_heartbeat_ns = _EARLIEST_TIME_NS
        self.inbox.heartbeat_received = True

    def await_reply(self, max_wait_ns: int = 0) -> bool:
        """Wait for a TPDO after the last SYNC, and return whether one has arrived in time.

        The time is `max_wait_ns`, one period if that is 0, or in lock-step the profile's deadline.
        """
        max_wait_ns = self.deadline_ns if self.lock_step else max_wait_ns or self.period_ns
        return self.exchange.wait_until(self._is_sync_answered, self.sync_ns + max_wait_ns)

    def sync_and_await_reply(self, max_wait_ns: int = 0) -> bool:
        """Send SYNC, wait for its reply, and return whether a reply has arrived in time."""
        self.send_sync()
        return self.await_reply(max_wait_ns)

    def sync_if_possible(self) -> bool:
        """Send SYNC despite bus errors; return whether a TPDO answered it. Never raises."""
        with self.exchange.ignore_errors():
            self.exchange.deliver_frames()  # frames that have already arrived are no reply
            self.pairing.register_request()
            self.sync_ns = time.monotonic_ns()
            return self.send_if_possible(self.frames.sync) and self.await_reply()

    def sleep_until_next_period(self, sync_grid_start_ns: int) -> None:
        """Sleep until the next whole period after the given time, when the next SYNC is due."""
        if self.lock_step:
            return
        wait_ns = self.period_ns - (time.monotonic_ns() - sync_grid_start_ns) % self.period_ns
        time.sleep(wait_ns * 1e-9)

    def send_write_request(self, request: bytes, index: int, subindex: int) -> bool:
        """Send an SDO write request, and return whether the drive confirmed it in time."""
        inbox = self.inbox
        inbox.sdo_reply = b""
        return self._request_if_possible(
            request, lambda: confirms_write(inbox.sdo_reply, index, subindex)
        )

    def is_torque_off(self) -> bool:
        """Read the statusword by SDO; return whether it shows that the motor has no torque."""
        inbox = self.inbox
        inbox.sdo_reply = b""
        self._request_if_possible(
            self.frames.read_statusword_request,
            lambda: read_statusword(inbox.sdo_reply) is not None,
        )
        statusword = read_statusword(inbox.sdo_reply)
        return statusword is not None and drive_state(statusword) in TORQUE_FREE_STATES

    def send_if_possible(self, frame: bytes) -> bool:
        """Send a frame, and return whether the bus accepted it; never raises."""
        try:
            self.exchange.send(frame)
        except Exception:  # an adapter's library may raise anything; switching off must continue
            return False
        return True

    def await_emergency_message(self) -> None:
        """Wait briefly for the emergency message of a drive that has left operation enabled."""
        inbox = self.inbox
        if not inbox.alarm:
            self.exchange.wait_until(
                lambda: bool(inbox.alarm), time.monotonic_ns() + _EMERGENCY_TIMEOUT_NS
            )

    def raise_if_alarmed(self) -> None:
        """Raise if the drive sent an emergency message, has left operational, or is in fault."""
        inbox = self.inbox
        is_in_fault = drive_state(inbox.statusword) in (DriveState.FAULT, DriveState.FAULT_REACTION)
        if is_in_fault:
            self.await_emergency_message()
        if not (is_in_fault or inbox.alarm):
            return
        alarm_reason = inbox.alarm or (
            f'{self.name}: it is in the state "{drive_state(inbox.statusword).value}" (statusword '
            f"0x{inbox.statusword:04X}) and names no cause."
        )
        if is_in_fault:
            alarm_reason += f" Remove the cause, then: {self._reset_command}"
        elif inbox.emergency_received:
            # The message may be from a drive that was off; one that was on reports its state later.
            alarm_reason += (
                f" Remove the cause; if drive or daemon are in fault then: {self._reset_command}"
            )
        raise DeviceError(alarm_reason)

    def _request_if_possible(self, request: bytes, is_reply_received: Callable[[], bool]) -> bool:
        """Send an SDO request despite bus errors; return whether the reply came in time."""
        with self.exchange.ignore_errors():
            return self.send_if_possible(request) and self.exchange.wait_until(
                is_reply_received, time.monotonic_ns() + _SDO_REPLY_TIMEOUT_NS
            )

    def _is_operational(self) -> bool:
        """Return whether the drive's last heartbeat shows the NMT state operational."""
        return self.inbox.nmt_state == OPERATIONAL_STATE

    def _is_sync_answered(self) -> bool:
        """Return whether a TPDO has arrived since the last SYNC."""
        return self.inbox.reply_count > 0
