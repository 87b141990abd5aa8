"""ATI sensor with a NETCANOEM box on CAN: set up once, then polled once a tick."""

import time
from collections.abc import Sequence
from functools import partial
from math import ceil

from rigd.devices.ati import _netcanoem as netcanoem
from rigd.devices.ati._calibration import (
    CAN_BAD_CALIBRATION,
    CAN_BUS_ERROR,
    CAN_CRITICAL,
    CAN_WATCHDOG_RESET,
    Calibration,
    Rows,
    can_status,
    same_serial_number,
    wrench_function,
)
from rigd.devices.ati._netcanoem import REPLY_LENGTHS, Answer, GaugePolls, identifier
from rigd.devices.canbus import CanExchange, CanLink
from rigd.devices.contracts import DeviceError, LineHealth, Wrench
from rigd.devices.parameters import RigParameters

_REPLY_TIMEOUT_S = 0.2
_TRIES = 3
# A repeated request may be answered twice, and no reply states which row of the matrix it holds.
_LATE_REPLY_S = 0.5
_LOST_POLL_S = 0.02
# A box that was silent for this long may have restarted; no box starts faster.
_RESTART_S = 0.005

_ASSUMED = (
    f"{netcanoem.COUNTS_BEFORE_SCALE} counts per N and per N·m: firmware before "
    f"{'.'.join(map(str, netcanoem.FIRST_FIRMWARE_WITH_SCALE))} tells neither counts per unit nor "
    "units"
)
"""Scale assumed for old firmware, for the session file and the operator."""


class AtiCanSensor:
    """Sensor of a profile with a section ``ati_can``.

    Parameters
    ----------
    rig
        Parameters with sections ``ati_can`` and ``acquisition``.
    link
        The bus, shared with the drive.

    Attributes
    ----------
    wrench_stale, wrench_saturated, wrench_time_ns
        State of the last reading; the time (``time.monotonic_ns``) is when its poll was sent.
    polls : GaugePolls
        Polls, with the last turn-round time and the count of lost replies.
    late_replies : int
        Replies that came after the deadline, but before the next tick.
    bus_errors : int
        Readings with which the sensor reported errors on the bus.

    Raises
    ------
    DeviceError
        If the profile lacks a section.
    """

    def __init__(self, rig: RigParameters, link: CanLink) -> None:
        settings, acquisition = rig.ati_can, rig.acquisition
        if settings is None or acquisition is None:
            missing = "ati_can" if settings is None else "acquisition"
            raise DeviceError(
                f"The profile has no section [{missing}], which a sensor on CAN needs."
            )
        self._settings = settings
        self._link = link
        self._name = f"Sensor ATI NETCANOEM (base id {settings.base_id:#04x})"
        self._limit = settings.saturation_counts
        self._deadline_ns = int(acquisition.deadline_us * 1e3)
        self._waits = acquisition.mode == "same_tick"
        self._lock_step = acquisition.deadline_us * rig.rate_hz > 1e6
        poll_frame = netcanoem.request(settings.base_id, netcanoem.GAUGES)
        self.polls = GaugePolls(poll_frame, self._name)
        self._connected = False
        self._subscribed_to: CanExchange | None = None
        self._inbox: dict[int, bytes] = {}
        self._restart_ticks = max(1, ceil(_RESTART_S * rig.rate_hz))
        self._unanswered = 0
        self._in_doubt = False
        self._shown = b""
        self._calibration: Calibration | None = None
        self._firmware: tuple[int, int, int] = (0, 0, 0)
        self._status: list[str] = []
        self._status_word = 0
        self._convert = wrench_function(((0.0,) * 6,) * 6)
        self._previous: Answer | None = None
        self._previous_ns = 0
        self._give_up_ns = 0
        self._given_up = False
        self._wrench: Wrench = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self.wrench_stale = True
        self.wrench_saturated = False
        self.gauges: tuple[int, ...] = (0,) * 6
        self.wrench_time_ns = 0
        self.late_replies = 0
        self.bus_errors = 0

    def connect(self) -> None:
        """Open the bus, select the calibration and read it.

        Raises
        ------
        DeviceError
            If the sensor is absent, is not the one of the profile, or reports a fault.
        """
        self.close()
        exchange = self._link.open()
        self._connected = True
        self.polls.open(exchange)
        try:
            self._subscribe(exchange)
            self._firmware = netcanoem.firmware(
                self._ask("its firmware version", netcanoem.FIRMWARE)
            )
            self._select_calibration()
            serial_number = self._read_serial_number()  # of the calibration, not of the box
            matrix = self._read_matrix()
            # A wrong entry would bend every result, and the protocol has no checksum of its own.
            if self._read_matrix() != matrix:
                raise DeviceError(
                    f"{self._name}: its calibration matrix read differently the second time; "
                    "check cable and termination."
                )
            self._calibration = self._read_scale(serial_number, matrix)
            self._convert = wrench_function(self._calibration.wrench_per_wire_count())
            self._evaluate(self._first_reading())
            self.polls.forget()
            self._previous = None
            self._unanswered = 0
            self._in_doubt = False
        except BaseException:
            self.close()
            raise

    def calibration(self) -> dict[str, object]:
        """Return identity and calibration as found, for the session file.

        Raises
        ------
        DeviceError
            If the sensor is not connected.
        """
        if self._calibration is None:
            raise DeviceError(f"{self._name}: it is not connected.")
        major, minor, build = self._firmware
        return {
            "sensor": "ATI NETCANOEM",
            **self._calibration.as_dict(),
            "calibration": self._settings.calibration,
            "firmware": f"{major}.{minor}.{build}",
            **({} if self._reports_scale else {"assumed": _ASSUMED}),
            "status": self._status,
            "base_id": self._settings.base_id,
        }

    def request(self, due_ns: int) -> None:  # noqa: ARG002
        """Poll the sensor, unless the pairing of replies or the sensor's calibration is uncertain.

        Raises
        ------
        DeviceError
            If the bus is gone, or the sensor has restarted.
        """
        polls = self.polls
        if self._lock_step and not self._waits:
            # No time passes between two ticks: the reply to the last poll is still in preparation.
            polls.wait(time.monotonic_ns() + self._deadline_ns)
        polls.drain()
        if not self._waits:
            self._previous, self._previous_ns = polls.process_replies(), polls.sent_ns
        elif self._given_up:
            self.late_replies += polls.process_replies() is not None
        if self._in_doubt and not self._is_the_same():
            polls.register_pause()
        else:
            polls.send_or_pause()
        self._give_up_ns = polls.sent_ns + self._deadline_ns

    def read_wrench(self) -> Wrench:
        """Return the wrench in N and N·m.

        Raises
        ------
        DeviceError
            If the bus is gone or the sensor reports an error.
        """
        if self._waits:
            answer, sent_ns = self.polls.wait(self._give_up_ns), self.polls.sent_ns
            self._given_up = answer is None
        else:
            answer, sent_ns = self._previous, self._previous_ns
        if answer is None:
            self.wrench_stale = True
            self._unanswered += 1
            return self._wrench
        if self._unanswered >= self._restart_ticks:
            # It answers again: its calibration is verified before a reading counts.
            self._in_doubt = True
            self._shown = b""
            self._inbox.clear()
        self._unanswered = 0
        if self._in_doubt:
            self.wrench_stale = True
            return self._wrench
        self.wrench_stale = False
        self.wrench_time_ns = sent_ns
        return self._evaluate(answer)

    def health(self) -> LineHealth:
        """Return the health of the line to the sensor, and the sensor's status word."""
        errors = self.polls.lost + self.bus_errors
        return LineHealth(errors=errors, status=self._status_word)

    def measure(self, duration_s: float) -> dict[str, float]:
        """Poll back to back for a while, between `connect` and the first tick.

        Returns
        -------
        dict
            ``polls_hz`` (readings a second), ``turnaround_median_s``, ``turnaround_p99_s`` (from
            poll to reply; not a number where none came), ``lost`` (polls without a reply).

        Raises
        ------
        DeviceError
            If the bus is gone or the sensor reports an error.
        """
        turnarounds_ns: list[int] = []
        lost = 0
        begin_ns = time.monotonic_ns()
        end_ns = begin_ns + int(duration_s * 1e9)
        while time.monotonic_ns() < end_ns:
            answer = self._poll(_LOST_POLL_S)
            if answer is None:
                lost += 1
                continue
            self._evaluate(answer)
            turnarounds_ns.append(self.polls.turnaround_ns)
        elapsed_s = (time.monotonic_ns() - begin_ns) * 1e-9
        self.polls.forget()
        turnarounds_ns.sort()
        return {
            "polls_hz": len(turnarounds_ns) / elapsed_s,
            "turnaround_median_s": _quantile_s(turnarounds_ns, 0.5),
            "turnaround_p99_s": _quantile_s(turnarounds_ns, 0.99),
            "lost": float(lost),
        }

    def close(self) -> None:
        """Release the bus. Never raises."""
        if self._connected:
            self._connected = False
            self.polls.close()
            self._link.close()
        self._calibration = None

    def _subscribe(self, exchange: CanExchange) -> None:
        if exchange is not self._subscribed_to:
            base = self._settings.base_id
            self.polls.subscribe(
                identifier(base, netcanoem.GAUGES), identifier(base, netcanoem.GAUGES_REST)
            )
            for opcode in REPLY_LENGTHS:
                if opcode not in (netcanoem.GAUGES, netcanoem.GAUGES_REST):
                    store = partial(self._inbox.__setitem__, opcode)
                    exchange.subscribe(identifier(base, opcode), store)
            self._subscribed_to = exchange
        exchange.start()

    def _evaluate(self, answer: Answer) -> Wrench:
        status, g0, g2, g4 = netcanoem.read_gauges(answer[0])
        g1, g3, g5 = netcanoem.read_gauges_rest(answer[1])
        before, self._status_word = self._status_word, status
        if status:
            self._check_status(status, before)
        limit = self._limit
        self.wrench_saturated = (
            max(g0, g2, g4, g1, g3, g5) >= limit or min(g0, g2, g4, g1, g3, g5) <= -limit
        )
        self.gauges = g0, g1, g2, g3, g4, g5
        self._wrench = wrench = self._convert(g0, g2, g4, g1, g3, g5)
        return wrench

    def _check_status(self, status: int, before: int) -> None:
        if status & CAN_BUS_ERROR:
            self.bus_errors += 1
        if status & ~before & CAN_WATCHDOG_RESET:
            raise self._restarted(f"its watchdog has reset it (status word {status:#06x})")
        if status & CAN_CRITICAL:
            remedy = (
                "choose another (ati_can.calibration)"
                if status & CAN_BAD_CALIBRATION
                else "it does not measure properly: check sensor, cable and supply"
            )
            raise DeviceError(
                f"{self._name}: its status word {status:#06x} says that "
                f"{'; '.join(can_status(status & CAN_CRITICAL))}; {remedy}."
            )

    def _restarted(self, how: str) -> DeviceError:
        return DeviceError(
            f"{self._name}: {how}; it is back at calibration 0, and what it measures since is not "
            f"measured with calibration {self._settings.calibration} (ati_can.calibration). "
            "Reconnecting (rigd reset, or another rigd run) selects it again. Check the box's "
            "supply and cable; if it happens again, have the box replaced."
        )

    def _is_the_same(self) -> bool:
        """Whether a box that was silent still has the calibration that was read from it.

        A box that was without power for a moment does not report it: bit 0 of its status is for the
        watchdog only.
        """
        inbox, calibration = self._inbox, self._calibration
        parts = [inbox.get(opcode, b"") for opcode in netcanoem.MATRIX_ROW_REPLIES]
        if all(len(part) == REPLY_LENGTHS[netcanoem.MATRIX_ROW] for part in parts):
            shown, before = b"".join(parts), self._shown
            if calibration is None or netcanoem.matrix_row(shown) == calibration.matrix[0]:
                self._in_doubt = False
                return True
            if shown == before:
                raise self._restarted(
                    "it was silent for a moment and answers with another calibration matrix since"
                )
            # A single mismatch may be a damaged reply, as at connecting.
            self._shown = shown
            inbox.clear()
        base = self._settings.base_id
        self.polls.exchange.send(netcanoem.request(base, netcanoem.MATRIX_ROW, 0))
        return False

    def _poll(self, timeout_s: float) -> Answer | None:
        """Poll the sensor outside the cycle."""
        polls = self.polls
        polls.drain()
        polls.forget()
        polls.send()
        return polls.wait(polls.sent_ns + int(timeout_s * 1e9))

    def _first_reading(self) -> Answer:
        for _ in range(_TRIES):
            answer = self._poll(_REPLY_TIMEOUT_S)
            if answer is not None:
                self._status = can_status(netcanoem.read_gauges(answer[0])[0])
                return answer
        raise self._no_reply("a reading")

    def _ask(self, what: str, opcode: int, *arguments: int, replies: Sequence[int] = ()) -> bytes:
        """Return the reply to a request, its frames concatenated."""
        exchange, inbox = self.polls.exchange, self._inbox
        wanted = replies or (opcode,)
        frame = netcanoem.request(self._settings.base_id, opcode, *arguments)
        for again in range(_TRIES):
            inbox.clear()
            exchange.send(frame)
            if exchange.wait_until(
                lambda: all(each in inbox for each in wanted), _in(_REPLY_TIMEOUT_S)
            ):
                found = [inbox[each] for each in wanted]
                if again:
                    exchange.wait_until(lambda: False, _in(_LATE_REPLY_S))  # all is dropped
                break
        else:
            raise self._no_reply(what)
        for each, data in zip(wanted, found, strict=True):
            if len(data) != REPLY_LENGTHS[each]:
                raise DeviceError(
                    f"{self._name}: asked for {what}, it sent {len(data)} bytes instead of "
                    f"{REPLY_LENGTHS[each]}. Check that the box is a NETCANOEM and that no other "
                    "device uses its identifiers."
                )
        return b"".join(found)

    def _no_reply(self, what: str) -> DeviceError:
        return DeviceError(
            f"{self._name}: asked for {what}, it gave no complete reply within {_REPLY_TIMEOUT_S} "
            f"s in {_TRIES} tries. Check its power, cable and termination, can.bitrate_bit_s and "
            "ati_can.base_id."
        )

    def _read_serial_number(self) -> str:
        found = netcanoem.serial_number(self._ask("its serial number", netcanoem.SERIAL_NUMBER))
        wanted = self._settings.serial_number
        if not same_serial_number(wanted, found):
            raise DeviceError(
                f"{self._name}: its serial number is {found or 'empty'}, where the profile asks "
                f"for {wanted} (ati_can.serial_number). Check which sensor is on the rig."
            )
        return found

    @property
    def _reports_scale(self) -> bool:
        return self._firmware[:2] >= netcanoem.FIRST_FIRMWARE_WITH_SCALE

    def _select_calibration(self) -> None:
        wanted = self._settings.calibration
        what = f"calibration {wanted}"
        selected = self._ask(what, netcanoem.SELECT_CALIBRATION, wanted)[0]
        if selected != wanted:
            raise DeviceError(
                f"{self._name}: asked for calibration {wanted}, it selected {selected}. Choose "
                "one that it has (ati_can.calibration)."
            )
        # The status shows whether the selected calibration is valid.
        status = self._status_word = netcanoem.read_gauges(self._first_reading()[0])[0]
        if status & CAN_BAD_CALIBRATION:
            self._check_status(status, status)

    def _read_matrix(self) -> Rows:
        return tuple(
            netcanoem.matrix_row(
                self._ask(
                    f"row {axis} of its calibration matrix",
                    netcanoem.MATRIX_ROW,
                    axis,
                    replies=netcanoem.MATRIX_ROW_REPLIES,
                )
            )
            for axis in range(6)
        )

    def _read_scale(self, serial_number: str, matrix: Rows) -> Calibration:
        force = torque = netcanoem.COUNTS_BEFORE_SCALE
        force_unit, torque_unit = netcanoem.NEWTON, netcanoem.NEWTON_METRE
        if self._reports_scale:
            force, torque = netcanoem.counts_per_unit(
                self._ask("its counts per unit", netcanoem.COUNTS_PER_UNIT)
            )
            force_unit, torque_unit = self._ask("its unit codes", netcanoem.UNIT_CODES)
        try:
            return Calibration(
                serial_number=serial_number,
                force_unit=force_unit,
                torque_unit=torque_unit,
                counts_per_force=force,
                counts_per_torque=torque,
                matrix=matrix,
            )
        except ValueError as error:
            raise DeviceError(
                f"{self._name}, ati_can.calibration {self._settings.calibration}: {error}"
            ) from None


def _in(duration_s: float) -> int:
    return time.monotonic_ns() + int(duration_s * 1e9)


def _quantile_s(sorted_ns: list[int], fraction: float) -> float:
    if not sorted_ns:
        return float("nan")
    return sorted_ns[int(fraction * (len(sorted_ns) - 1))] * 1e-9
