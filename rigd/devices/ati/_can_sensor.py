"""Driver of an ATI sensor with a NETCANOEM box on CAN: set up once, then polled once per tick."""

import time
from collections.abc import Sequence
from functools import partial
from math import ceil

from rigd.devices.ati import _netcanoem as netcanoem
from rigd.devices.ati._calibration import (
    CAN_BAD_CALIBRATION_BIT,
    CAN_BUS_ERROR_BIT,
    CAN_WATCHDOG_RESET_BIT,
    CRITICAL_CAN_STATUS_BITS,
    Calibration,
    MatrixRows,
    describe_can_status,
    same_serial_number,
    wrench_from_counts_function,
)
from rigd.devices.ati._netcanoem import REPLY_LENGTHS, GaugePolls, PollReply, can_identifier
from rigd.devices.canbus import CanExchange, CanLink
from rigd.devices.contracts import DeviceError, LineHealth, Wrench
from rigd.devices.parameters import RigParameters

_REPLY_TIMEOUT_S = 0.2
"""Time in seconds to wait for the reply to one request during set-up."""
_REQUEST_ATTEMPTS = 3
"""Number of attempts of one request during set-up."""
_LATE_REPLY_WAIT_S = 0.5
"""Time in seconds in which late replies are discarded after a repeated request.

A repeated request may be answered twice, and no reply states which row of the matrix it holds."""
_POLL_TIMEOUT_S = 0.02
"""Time in seconds after which a poll of `measure` counts as lost."""
_MIN_RESTART_DURATION_S = 0.005
"""Time in seconds without reply after which a box may have restarted; no box starts faster."""

_ASSUMED_SCALE_TEXT = (
    f"{netcanoem.OLD_FIRMWARE_COUNTS_PER_UNIT} counts per N and per N·m: firmware before "
    f"{'.'.join(map(str, netcanoem.FIRST_FIRMWARE_WITH_SCALE))} reports neither counts per unit "
    "nor units"
)
"""Counts per unit assumed for old firmware, as text for the session file and the operator."""


class AtiCanSensor:
    """Driver of an ATI sensor with a NETCANOEM box on the CAN bus.

    Parameters
    ----------
    rig
        Parameters with sections ``ati_can`` and ``acquisition``.
    link
        CAN bus, which the drive uses, too.

    Attributes
    ----------
    wrench_stale, wrench_saturated, wrench_time_ns
        Whether the last wrench is stale, whether one of its gauges is saturated, and the time in
        nanoseconds (``time.monotonic_ns``) at which it was requested.
    polls : GaugePolls
        Polls of the box, with the time from the last poll to its reply and the number of lost
        replies.
    late_replies : int
        Number of replies that arrived after the deadline, but before the next tick.
    bus_errors : int
        Number of readings with which the sensor reported errors on the bus.

    Raises
    ------
    DeviceError
        If the profile lacks a section.
    """

    def __init__(self, rig: RigParameters, link: CanLink) -> None:
        settings, acquisition = rig.ati_can, rig.acquisition
        if settings is None or acquisition is None:
            missing_section = "ati_can" if settings is None else "acquisition"
            raise DeviceError(
                f"The profile has no section [{missing_section}], which a sensor on CAN requires."
            )
        self._settings = settings
        self._link = link
        self._name = f"Sensor ATI NETCANOEM (base id {settings.base_id:#04x})"
        self._saturation_counts = settings.saturation_counts
        self._deadline_ns = int(acquisition.deadline_us * 1e3)
        self._waits_for_reply = acquisition.mode == "same_tick"
        self._lock_step = acquisition.deadline_us * rig.rate_hz > 1e6
        poll_frame = netcanoem.request(settings.base_id, netcanoem.GAUGES_OPCODE)
        self.polls = GaugePolls(poll_frame, self._name)
        self._is_connected = False
        self._subscribed_to: CanExchange | None = None
        self._inbox: dict[int, bytes] = {}
        self._restart_ticks = max(1, ceil(_MIN_RESTART_DURATION_S * rig.rate_hz))
        self._unanswered_ticks = 0
        self._calibration_in_doubt = False
        self._row_read_before = b""
        self._calibration: Calibration | None = None
        self._firmware: tuple[int, int, int] = (0, 0, 0)
        self._status_texts: list[str] = []
        self._status_word = 0
        self._wrench_from_counts = wrench_from_counts_function(((0.0,) * 6,) * 6)
        self._previous_reply: PollReply | None = None
        self._previous_ns = 0
        self._reply_deadline_ns = 0
        self._missed_deadline = False
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
        self._is_connected = True
        self.polls.open(exchange)
        try:
            self._subscribe(exchange)
            self._firmware = netcanoem.firmware_version(
                self._request_reply("its firmware version", netcanoem.FIRMWARE_OPCODE)
            )
            self._select_calibration()
            serial_number = self._read_serial_number()  # belongs to the calibration, not to the box
            calibration_matrix = self._read_calibration_matrix()
            # A wrong entry would falsify every result, and the protocol has no checksum of its own.
            if self._read_calibration_matrix() != calibration_matrix:
                raise DeviceError(
                    f"{self._name}: its calibration matrix read differently the second time; "
                    "check cable and termination."
                )
            self._calibration = self._calibration_with_units(serial_number, calibration_matrix)
            self._wrench_from_counts = wrench_from_counts_function(
                self._calibration.wrench_per_wire_count()
            )
            self._wrench_of_reply(self._await_first_reading())
            self.polls.reset_pairing()
            self._previous_reply = None
            self._unanswered_ticks = 0
            self._calibration_in_doubt = False
        except BaseException:
            self.close()
            raise

    def calibration(self) -> dict[str, object]:
        """Return identity and calibration as read from the sensor, for the session file.

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
            **({} if self._reports_counts_per_unit else {"assumed": _ASSUMED_SCALE_TEXT}),
            "status": self._status_texts,
            "base_id": self._settings.base_id,
        }

    def request(self, due_ns: int) -> None:  # noqa: ARG002
        """Poll the sensor, unless the pairing of replies or the sensor's calibration is uncertain.

        Raises
        ------
        DeviceError
            If the bus has failed, or the sensor has restarted.
        """
        gauge_polls = self.polls
        if self._lock_step and not self._waits_for_reply:
            # No time passes between two ticks: the reply to the last poll is still in preparation.
            gauge_polls.wait(time.monotonic_ns() + self._deadline_ns)
        gauge_polls.deliver_frames()
        if not self._waits_for_reply:
            self._previous_reply, self._previous_ns = (
                gauge_polls.process_replies(),
                gauge_polls.sent_ns,
            )
        elif self._missed_deadline:
            self.late_replies += gauge_polls.process_replies() is not None
        if self._calibration_in_doubt and not self._has_same_calibration():
            gauge_polls.register_pause()
        else:
            gauge_polls.send_or_pause()
        self._reply_deadline_ns = gauge_polls.sent_ns + self._deadline_ns

    def read_wrench(self) -> Wrench:
        """Return the wrench in N and N·m from the latest valid reply.

        Raises
        ------
        DeviceError
            If the bus has failed or the sensor reports an error.
        """
        if self._waits_for_reply:
            poll_reply, sent_ns = self.polls.wait(self._reply_deadline_ns), self.polls.sent_ns
            self._missed_deadline = poll_reply is None
        else:
            poll_reply, sent_ns = self._previous_reply, self._previous_ns
        if poll_reply is None:
            self.wrench_stale = True
            self._unanswered_ticks += 1
            return self._wrench
        if self._unanswered_ticks >= self._restart_ticks:
            # The box answers again: verify its calibration before a reading counts.
            self._calibration_in_doubt = True
            self._row_read_before = b""
            self._inbox.clear()
        self._unanswered_ticks = 0
        if self._calibration_in_doubt:
            self.wrench_stale = True
            return self._wrench
        self.wrench_stale = False
        self.wrench_time_ns = sent_ns
        return self._wrench_of_reply(poll_reply)

    def health(self) -> LineHealth:
        """Return the number of errors on the bus to the sensor, and the sensor's status word."""
        error_count = self.polls.lost_reply_count + self.bus_errors
        return LineHealth(errors=error_count, status=self._status_word)

    def measure(self, duration_s: float) -> dict[str, float]:
        """Poll the sensor continuously for a while, before the first tick; return statistics.

        Returns
        -------
        dict
            ``polls_hz`` (readings per second), ``turnaround_median_s`` and ``turnaround_p99_s``
            (time from poll to reply; NaN without replies), ``lost`` (polls without a
            reply).

        Raises
        ------
        DeviceError
            If the bus has failed or the sensor reports an error.
        """
        reply_times_ns: list[int] = []
        lost_polls = 0
        begin_ns = time.monotonic_ns()
        end_ns = begin_ns + int(duration_s * 1e9)
        while time.monotonic_ns() < end_ns:
            poll_reply = self._poll(_POLL_TIMEOUT_S)
            if poll_reply is None:
                lost_polls += 1
                continue
            self._wrench_of_reply(poll_reply)
            reply_times_ns.append(self.polls.turnaround_ns)
        elapsed_s = (time.monotonic_ns() - begin_ns) * 1e-9
        self.polls.reset_pairing()
        reply_times_ns.sort()
        return {
            "polls_hz": len(reply_times_ns) / elapsed_s,
            "turnaround_median_s": _quantile_s(reply_times_ns, 0.5),
            "turnaround_p99_s": _quantile_s(reply_times_ns, 0.99),
            "lost": float(lost_polls),
        }

    def close(self) -> None:
        """Release the bus; never raises."""
        if self._is_connected:
            self._is_connected = False
            self.polls.close()
            self._link.close()
        self._calibration = None

    def _subscribe(self, exchange: CanExchange) -> None:
        """Subscribe to the sensor's replies, unless this was done, and discard queued frames."""
        if exchange is not self._subscribed_to:
            base_id = self._settings.base_id
            self.polls.subscribe(
                can_identifier(base_id, netcanoem.GAUGES_OPCODE),
                can_identifier(base_id, netcanoem.REMAINING_GAUGES_OPCODE),
            )
            for opcode in REPLY_LENGTHS:
                if opcode not in (netcanoem.GAUGES_OPCODE, netcanoem.REMAINING_GAUGES_OPCODE):
                    store_reply = partial(self._inbox.__setitem__, opcode)
                    exchange.subscribe(can_identifier(base_id, opcode), store_reply)
            self._subscribed_to = exchange
        exchange.start()

    def _wrench_of_reply(self, poll_reply: PollReply) -> Wrench:
        """Store status word, gauge counts and wrench of a reply; return the wrench in N and N·m."""
        status_word, g0, g2, g4 = netcanoem.read_gauges(poll_reply[0])
        g1, g3, g5 = netcanoem.read_remaining_gauges(poll_reply[1])
        previous_word, self._status_word = self._status_word, status_word
        if status_word:
            self._check_status(status_word, previous_word)
        saturation_counts = self._saturation_counts
        self.wrench_saturated = (
            max(g0, g2, g4, g1, g3, g5) >= saturation_counts
            or min(g0, g2, g4, g1, g3, g5) <= -saturation_counts
        )
        self.gauges = g0, g1, g2, g3, g4, g5
        self._wrench = wrench = self._wrench_from_counts(g0, g2, g4, g1, g3, g5)
        return wrench

    def _check_status(self, status_word: int, previous_status_word: int) -> None:
        """Count bus errors in a status word, and raise on a restart or a critical status bit."""
        if status_word & CAN_BUS_ERROR_BIT:
            self.bus_errors += 1
        if status_word & ~previous_status_word & CAN_WATCHDOG_RESET_BIT:
            raise self._restart_error(f"its watchdog has reset it (status word {status_word:#06x})")
        if status_word & CRITICAL_CAN_STATUS_BITS:
            remedy = (
                "choose another (ati_can.calibration)"
                if status_word & CAN_BAD_CALIBRATION_BIT
                else "it does not measure properly: check sensor, cable and supply"
            )
            raise DeviceError(
                f"{self._name}: its status word {status_word:#06x} says that "
                f"{'; '.join(describe_can_status(status_word & CRITICAL_CAN_STATUS_BITS))}; "
                f"{remedy}."
            )

    def _restart_error(self, cause: str) -> DeviceError:
        """Return the error for a box that has restarted and lost its selected calibration."""
        return DeviceError(
            f"{self._name}: {cause}; it is back at calibration 0, so that its readings since then "
            f"are not those of calibration {self._settings.calibration} (ati_can.calibration). "
            "Reconnecting (rigd reset, or another rigd run) selects it again. Check the box's "
            "supply and cable; if it happens again, have the box replaced."
        )

    def _has_same_calibration(self) -> bool:
        """Return whether a box that was silent still has the calibration that was read from it.

        Row 0 of the calibration matrix is read again for this, because a box does not report a
        short loss of power: bit 0 of its status means a restart by its watchdog only.
        """
        inbox, calibration = self._inbox, self._calibration
        matrix_row_frames = [
            inbox.get(opcode, b"") for opcode in netcanoem.MATRIX_ROW_REPLY_OPCODES
        ]
        if all(
            len(row_entry) == REPLY_LENGTHS[netcanoem.MATRIX_ROW_OPCODE]
            for row_entry in matrix_row_frames
        ):
            row_read, earlier_row = b"".join(matrix_row_frames), self._row_read_before
            if calibration is None or netcanoem.matrix_row(row_read) == calibration.matrix[0]:
                self._calibration_in_doubt = False
                return True
            if row_read == earlier_row:
                raise self._restart_error(
                    "it was silent for a moment and has answered with another calibration matrix "
                    "since then"
                )
            # A single mismatch may be a damaged reply, as at connecting.
            self._row_read_before = row_read
            inbox.clear()
        base_id = self._settings.base_id
        self.polls.exchange.send(netcanoem.request(base_id, netcanoem.MATRIX_ROW_OPCODE, 0))
        return False

    def _poll(self, timeout_s: float) -> PollReply | None:
        """Poll the sensor once outside the control loop; return the reply, or None on timeout."""
        gauge_polls = self.polls
        gauge_polls.deliver_frames()
        gauge_polls.reset_pairing()
        gauge_polls.send()
        return gauge_polls.wait(gauge_polls.sent_ns + int(timeout_s * 1e9))

    def _await_first_reading(self) -> PollReply:
        """Poll the sensor repeatedly after set-up; return the first reply, or raise without one."""
        for _ in range(_REQUEST_ATTEMPTS):
            poll_reply = self._poll(_REPLY_TIMEOUT_S)
            if poll_reply is not None:
                self._status_texts = describe_can_status(netcanoem.read_gauges(poll_reply[0])[0])
                return poll_reply
        raise self._no_reply_error("a reading")

    def _request_reply(
        self, requested_item: str, opcode: int, *arguments: int, reply_opcodes: Sequence[int] = ()
    ) -> bytes:
        """Send a request and return its reply frames, concatenated; repeat it if unanswered."""
        exchange, inbox = self.polls.exchange, self._inbox
        expected_reply_opcodes = reply_opcodes or (opcode,)
        request_frame = netcanoem.request(self._settings.base_id, opcode, *arguments)
        for attempt in range(_REQUEST_ATTEMPTS):
            inbox.clear()
            exchange.send(request_frame)
            if exchange.wait_until(
                lambda: all(reply_opcode in inbox for reply_opcode in expected_reply_opcodes),
                _deadline_ns_after(_REPLY_TIMEOUT_S),
            ):
                reply_frames = [inbox[reply_opcode] for reply_opcode in expected_reply_opcodes]
                if attempt:
                    # All frames that arrive are dropped.
                    exchange.wait_until(lambda: False, _deadline_ns_after(_LATE_REPLY_WAIT_S))
                break
        else:
            raise self._no_reply_error(requested_item)
        for reply_opcode, reply_data in zip(expected_reply_opcodes, reply_frames, strict=True):
            if len(reply_data) != REPLY_LENGTHS[reply_opcode]:
                raise DeviceError(
                    f"{self._name}: asked for {requested_item}, it sent {len(reply_data)} bytes "
                    f"instead of {REPLY_LENGTHS[reply_opcode]}. Check that the box is a NETCANOEM "
                    "and that no other device uses its identifiers."
                )
        return b"".join(reply_frames)

    def _no_reply_error(self, requested_item: str) -> DeviceError:
        """Return the error for a request without a complete reply."""
        return DeviceError(
            f"{self._name}: asked for {requested_item}, it gave no complete reply within "
            f"{_REPLY_TIMEOUT_S} s in {_REQUEST_ATTEMPTS} tries. Check its power, cable and "
            "termination, can.bitrate_bit_s and ati_can.base_id."
        )

    def _read_serial_number(self) -> str:
        """Read the sensor's serial number, compare it with the profile, and return it."""
        reported_number = netcanoem.serial_number(
            self._request_reply("its serial number", netcanoem.SERIAL_NUMBER_OPCODE)
        )
        profile_number = self._settings.serial_number
        if not same_serial_number(profile_number, reported_number):
            raise DeviceError(
                f"{self._name}: its serial number is {reported_number or 'empty'}, but the profile "
                f"requires {profile_number} (ati_can.serial_number). Check which sensor is on the "
                "rig."
            )
        return reported_number

    @property
    def _reports_counts_per_unit(self) -> bool:
        """Whether the firmware reports counts per unit and unit codes."""
        return self._firmware[:2] >= netcanoem.FIRST_FIRMWARE_WITH_SCALE

    def _select_calibration(self) -> None:
        """Select the calibration that the profile names; raise if the sensor reports it as bad."""
        calibration_index = self._settings.calibration
        requested_item = f"calibration {calibration_index}"
        selected_index = self._request_reply(
            requested_item, netcanoem.SELECT_CALIBRATION_OPCODE, calibration_index
        )[0]
        if selected_index != calibration_index:
            raise DeviceError(
                f"{self._name}: asked for calibration {calibration_index}, it selected "
                f"{selected_index}. Choose one that it has (ati_can.calibration)."
            )
        # The status shows whether the selected calibration is valid.
        status_word = self._status_word = netcanoem.read_gauges(self._await_first_reading()[0])[0]
        if status_word & CAN_BAD_CALIBRATION_BIT:
            self._check_status(status_word, status_word)

    def _read_calibration_matrix(self) -> MatrixRows:
        """Read the six rows of the calibration matrix."""
        return tuple(
            netcanoem.matrix_row(
                self._request_reply(
                    f"row {axis} of its calibration matrix",
                    netcanoem.MATRIX_ROW_OPCODE,
                    axis,
                    reply_opcodes=netcanoem.MATRIX_ROW_REPLY_OPCODES,
                )
            )
            for axis in range(6)
        )

    def _calibration_with_units(
        self, serial_number: str, calibration_matrix: MatrixRows
    ) -> Calibration:
        """Read counts per unit and unit codes, and return the complete calibration."""
        counts_per_force = counts_per_torque = netcanoem.OLD_FIRMWARE_COUNTS_PER_UNIT
        force_unit, torque_unit = netcanoem.NEWTON_CODE, netcanoem.NEWTON_METRE_CODE
        if self._reports_counts_per_unit:
            counts_per_force, counts_per_torque = netcanoem.counts_per_unit(
                self._request_reply("its counts per unit", netcanoem.COUNTS_PER_UNIT_OPCODE)
            )
            force_unit, torque_unit = self._request_reply(
                "its unit codes", netcanoem.UNIT_CODES_OPCODE
            )
        try:
            return Calibration(
                serial_number=serial_number,
                force_unit=force_unit,
                torque_unit=torque_unit,
                counts_per_force=counts_per_force,
                counts_per_torque=counts_per_torque,
                matrix=calibration_matrix,
            )
        except ValueError as error:
            raise DeviceError(
                f"{self._name}, ati_can.calibration {self._settings.calibration}: {error}"
            ) from None


def _deadline_ns_after(duration_s: float) -> int:
    """Return the time in nanoseconds (``time.monotonic_ns``) at which a duration will be over."""
    return time.monotonic_ns() + int(duration_s * 1e9)


def _quantile_s(sorted_times_ns: list[int], fraction: float) -> float:
    """Return a quantile in seconds of sorted durations in nanoseconds; NaN if there are none."""
    if not sorted_times_ns:
        return float("nan")
    return sorted_times_ns[int(fraction * (len(sorted_times_ns) - 1))] * 1e-9
