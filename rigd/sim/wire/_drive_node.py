"""Simulated drive: a CANopen node by CiA 301 and CiA 402 that drives the simulated plant.

It supports only the cyclic synchronous torque mode. It has no velocity loop: where a real drive
decelerates by a ramp (quick stop, fault reaction), the shaft coasts. The torque is zero and the
plant's drive off at once, and only the state follows later.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from enum import IntEnum
from functools import partial
from typing import TYPE_CHECKING

from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import RigParameters
from rigd.sim import SimulatedRig
from rigd.sim.wire._canopen_services import (
    COB_ID_DISABLED_BIT,
    DEFAULT_MONITOR_COUNT,
    MAX_MAPPING_ENTRIES,
    EmergencyMessages,
    HeartbeatProducer,
    ReceivePdo,
    TransmitPdo,
    add_heartbeat_monitors,
)
from rigd.sim.wire._drive_objects import (
    CYCLIC_SYNCHRONOUS_TORQUE,
    NO_MODE,
    PdsState,
    PdsStateMachine,
    add_drive_objects,
    adopt_device_file,
    peak_per_mille,
)
from rigd.sim.wire._object_dictionary import ObjectDictionary, SdoServer

if TYPE_CHECKING:
    from rigd.sim.wire._object_dictionary import DeviceFile

Log = Callable[..., None]
"""Function that logs an event of the drive, with values by name."""

SYNC_TIMEOUT_PERIODS = 30
"""Default number of periods without a SYNC after which a drive in operation goes to fault.

A host whose profile lets it omit SYNCs omits fewer, and the host's heartbeat timeout is longer.
Real drives have values from 2 upwards."""

# Error codes of CiA 301 and 402.
_CONNECTION_ENDED_CODE = 0x8100
"""Error code: the connection to the host has ended."""
_HEARTBEAT_LOST_CODE = 0x8130
"""Error code: the heartbeat of a monitored node is missing."""
_PDO_TOO_SHORT_CODE = 0x8210
"""Error code: a received PDO is too short."""
_PDO_TOO_LONG_CODE = 0x8220
"""Error code: a received PDO is too long."""
_SYNC_LENGTH_CODE = 0x8240
"""Error code: SYNC has the wrong length."""
_RPDO_TIMEOUT_CODE = 0x8250
"""Error code: an RPDO has missed its deadline."""
_SYNC_LOST_CODE = 0x8700
"""Error code: SYNC is missing."""
_GENERIC_ERROR_BIT, _COMMUNICATION_ERROR_BIT = 0x01, 0x10  # bits of the error register

_VOLTAGE_AND_REMOTE_BITS, _REMOTE_BIT = 0x0210, 0x0200
_WARNING_BIT, _TARGET_REACHED_BIT, _INTERNAL_LIMIT_BIT, _FOLLOWS_TARGET_BIT = (
    0x0080,
    0x0400,
    0x0800,
    0x1000,
)
_HALT_BIT = 0x0100
"""Controlword bit that halts the motor."""
_UNCHANGED_OPERATION_BITS = 0x8F, 0x0F
"""Mask and value of a controlword that changes nothing in operation enabled."""

_LAST_COMMUNICATION_INDEX, _LAST_INDEX = 0x1FFF, 0xFFFF
_DEFAULT_PDO_COUNT = 4
"""Number of PDOs per direction of a drive without a device file."""
_MAX_PDO_INDEX_OFFSET = 0x1FF
"""Largest offset of a PDO's index from that of the first PDO."""
_TIME_TOLERANCE_S = 1e-9
"""Tolerance in seconds for rounding errors of times."""


class Nmt(IntEnum):
    """NMT state of a CANopen node, with its value in a heartbeat."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class DriveNode:
    """Simulated CiA 402 drive on the simulated CAN bus.

    The class is single-threaded: it acts only within `receive` and `tick`. It boots in the first of
    these calls.

    The profile needs a section [cia402]. The drive moves and measures the plant of `simulated_rig`.
    `advance_rig` advances the simulated rig to the present SYNC. It is called at each valid SYNC,
    in every state, frozen or not, because simulated time goes on. `send` sends a frame with
    identifier and data.
    `log` logs an event, with the source "drive", the event and values by name. It records the
    torque: event "torque" with torque_nm and enabled at every change of either.

    `sync_timeout_s` is the time without a SYNC after which a drive in operation goes to fault; by
    default `SYNC_TIMEOUT_PERIODS` SYNC periods. With a `device_file`, the drive has exactly
    the objects of this file, with their types, access rights, limits and values at power-on. The
    constructor raises `DeviceError` if the profile has no section [cia402], or no encoder
    resolution.

    Attributes
    ----------
    frozen : bool
        Whether the drive receives and sends nothing, as if unplugged; its watchdogs continue.
    torque_lag_s : float
        Time constant in seconds with which the actual torque (6077) follows the exerted torque, as
        if it were measured and filtered; 0: at once. Initially the profile's ``torque_response_s``.
    stays_operational : bool
        Whether the drive ignores the NMT command to pre-operational.
    never_sets_bit_12 : bool
        Whether the drive never sets bit 12 of its statusword, which means that it follows the
        target. Initially as the profile's ``follows_target_bit`` states.
    ignores_silent_host : bool
        Whether the drive ignores missing heartbeats, SYNCs and RPDOs.
    angle_offset_counts : int
        Offset added to the position in counts, as of an encoder that has jumped.
    sto_dropped : bool
        Whether the wired stop (STO) is dropped. It removes the torque at once, and the drive stays
        off while it is dropped. The drive goes to fault with the profile's ``sto_error_code``, or
        to switch on disabled if there is no such code.

    Notes
    -----
    At a SYNC in the NMT state operational, first a pending RPDO takes effect, then `advance_rig`
    is called, and then the TPDOs are sent. The plant's own delay covers the whole path of a torque.
    So a torque that arrives after SYNC k and takes effect at SYNC k + 1 is passed to the plant
    while the plant is still at tick k.

    Before the owner calls `tick`, it has to pass the frames that arrived before that time.
    Otherwise a pause of the owner would have the same effect as a silent host.
    """

    def __init__(
        self,
        rig: RigParameters,
        simulated_rig: SimulatedRig,
        advance_rig: Callable[[], None],
        send: Callable[[int, bytes], None],
        log: Log,
        sync_timeout_s: float | None = None,
        device_file: "DeviceFile | None" = None,
    ) -> None:
        if rig.cia402 is None:
            raise DeviceError("Simulated drive: the profile has no section [cia402]; add one.")
        if rig.encoder.resolution_rad <= 0:
            raise DeviceError(
                "Simulated drive: encoder.resolution_rad is 0, but a drive counts encoder steps; "
                "give it the step at the output shaft."
            )
        self.frozen = False
        self.angle_offset_counts = 0
        self.torque_lag_s = rig.cia402.torque_response_s
        self.never_sets_bit_12 = not rig.cia402.follows_target_bit
        self.stays_operational = self.ignores_silent_host = False
        self._sto_dropped = False
        self._sto_error_code = rig.cia402.sto_error_code
        self._simulated_rig = simulated_rig
        self._plant = simulated_rig.plant
        self._advance = advance_rig
        self._send = send
        self._log = partial(log, "drive")
        self._sync_timeout_s = sync_timeout_s
        self._resolution_rad = rig.encoder.resolution_rad
        self._direction = rig.cia402.direction
        self._nm_per_mille = rig.cia402.direction * rig.motor.rated_torque_nm / 1000
        self._peak_per_mille = peak_per_mille(rig.motor)
        self._rad_s_per_rpm = math.tau / 60 / rig.cia402.gear_ratio

        node_id = self._node_id = rig.cia402.node_id
        self._now_s = 0.0
        self._nmt = Nmt.INITIALISING
        self._last_sync_s = 0.0
        self._sync_alive = False
        self._per_mille = 0
        self._measured_per_mille = 0.0
        self._measured_at_s = 0.0
        self._mode = NO_MODE
        self._is_limited = self._follows_target = self._is_too_fast = False

        object_dictionary = self._objects = ObjectDictionary()
        drive_entries = self._entries = add_drive_objects(
            object_dictionary, rig.motor, rig.cia402, rig.rate_hz, rig.encoder.resolution_rad
        )
        self._emergencies = EmergencyMessages(object_dictionary, node_id, self._send_emergency)
        self._producer = HeartbeatProducer(object_dictionary)
        heartbeat_monitor_count = (
            DEFAULT_MONITOR_COUNT if device_file is None else device_file.sub_index_count(0x1016)
        )
        self._heartbeat_monitors = add_heartbeat_monitors(
            object_dictionary, heartbeat_monitor_count, self._clear_heartbeat_error
        )
        self._receive_pdos = [
            ReceivePdo(object_dictionary, *pdo, self._rebuild_tables)
            for pdo in _pdo_parameters(0x1400, 0x200 + node_id, 0x6040, device_file)
        ]
        self._transmit_pdos = [
            TransmitPdo(object_dictionary, *pdo, self._rebuild_tables)
            for pdo in _pdo_parameters(0x1800, 0x180 + node_id, 0x6041, device_file)
        ]
        self._sdo = SdoServer(
            object_dictionary, partial(self._transmit, 0x580 + node_id), self._log_sdo_write
        )

        drive_entries.sync_cob_id.after_write = drive_entries.sync_overflow.after_write = (
            self._rebuild_tables
        )
        drive_entries.controlword.after_write = self._on_controlword
        drive_entries.statusword.read_value = self._statusword
        drive_entries.mode.after_write = self._on_mode
        drive_entries.mode_display.read_value = drive_entries.mode.read_integer
        drive_entries.position.read_value = self._position_counts
        drive_entries.velocity.read_value = self._velocity_counts_per_s
        drive_entries.actual_torque.read_value = self._actual_torque_per_mille
        for torque_entry in (
            drive_entries.target_torque,
            drive_entries.torque_offset,
            drive_entries.max_torque,
            drive_entries.positive_torque_limit,
            drive_entries.negative_torque_limit,
        ):
            torque_entry.after_write = self._refresh_torque
        self._state_machine = PdsStateMachine(
            drive_entries.quick_stop_option,
            drive_entries.fault_option,
            on_state_change=self._on_state_change,
            may_switch_on=lambda: self._has_all_heartbeats() and not self._sto_dropped,
            may_enable=lambda: self._nmt is Nmt.OPERATIONAL and self._has_all_heartbeats(),
            may_reset=self._may_reset,
        )
        if device_file is not None:
            adopt_device_file(object_dictionary, device_file)
        self._rebuild_pdos()

    def receive(self, can_id: int, data: bytes) -> None:
        """Process a CAN frame that the simulated drive has received."""
        if self._nmt is Nmt.INITIALISING:
            self._boot()
        if can_id == self._sync_id:
            self._on_sync(data)
        elif not self.frozen:
            frame_handler = self._handlers.get(can_id)
            if frame_handler is not None:
                frame_handler(data)

    def tick(self, now_s: float) -> None:
        """Advance the simulated drive in time: watchdogs, heartbeat, ramps, event-driven PDOs.

        Simulated time advances by at most a millisecond per call.
        """
        self._now_s = now_s
        if self._nmt is Nmt.INITIALISING:
            self._boot()
        if not self.ignores_silent_host:
            self._check_heartbeats(now_s)
            self._check_sync(now_s)
            self._check_rpdos(now_s)
        self._state_machine.tick(now_s)
        if self._producer.is_due(now_s):
            self._transmit(0x700 + self._node_id, bytes([self._nmt]))
        if self._nmt is Nmt.OPERATIONAL and not self.frozen:
            for pdo in self._event_tpdos:
                tpdo_data = pdo.data_at_event(now_s)
                if tpdo_data is not None:
                    self._transmit(pdo.can_id, tpdo_data)

    def emergency(self, error_code: int, register_bits: int, vendor_bytes: bytes) -> None:
        """Bring the simulated drive to fault, and report an error by an emergency message.

        The message contains error code, bits of the error register and vendor's bytes.
        """
        self._fail(error_code, register_bits, vendor_bytes)

    def reset(self) -> None:
        """Restart the drive as by its own watchdog, with the values at power-on."""
        self._boot()

    def power_cycle(self) -> None:
        """Restart the drive as after a loss of power; it equals `reset` here."""
        self.reset()

    def override_object(self, index: int, sub_index: int, value: int | None) -> None:
        """Set an object to another value, or make it absent if `value` is None."""
        self._objects.override_entry(index, sub_index, value)

    @property
    def sto_dropped(self) -> bool:
        """Whether the wired stop (STO) is dropped; it can be set."""
        return self._sto_dropped

    @sto_dropped.setter
    def sto_dropped(self, dropped: bool) -> None:
        self._sto_dropped = dropped
        self._log("sto", dropped=dropped)
        if not dropped:
            return
        if self._sto_error_code:
            self._fail(self._sto_error_code, _GENERIC_ERROR_BIT)
        else:
            self._state_machine.disable_voltage()

    # NMT ---------------------------------------------------------------------------------------

    def _boot(self, last_index: int = _LAST_INDEX) -> None:
        """Start the node: set objects up to index `last_index` to their values at power-on."""
        self._log("nmt", state="initialising")
        if last_index == _LAST_INDEX:
            self._emergencies.reset()
            self._state_machine.start()
        self._nmt = Nmt.INITIALISING
        self._sync_alive = False
        self._objects.reset(last_index)
        self._on_mode()
        self._rebuild_pdos()
        self._sdo.reset()
        for heartbeat_monitor in self._heartbeat_monitors:
            heartbeat_monitor.restart()
        self._transmit(0x700 + self._node_id, bytes([Nmt.INITIALISING]))
        self._enter_nmt(Nmt.PRE_OPERATIONAL)

    def _on_nmt(self, frame_data: bytes) -> None:
        """Process an NMT command: start, stop, pre-operational or reset."""
        if len(frame_data) != 2 or frame_data[1] not in (0, self._node_id):
            return
        nmt_command = frame_data[0]
        if nmt_command == 128 and self.stays_operational:
            return
        if nmt_command == 1:
            self._enter_nmt(Nmt.OPERATIONAL)
        elif nmt_command in (2, 128):
            self._end_connection()
            self._enter_nmt(Nmt.STOPPED if nmt_command == 2 else Nmt.PRE_OPERATIONAL)
        elif nmt_command == 129:
            self._boot()
        elif nmt_command == 130:
            self._end_connection()
            self._boot(_LAST_COMMUNICATION_INDEX)

    def _enter_nmt(self, new_state: Nmt) -> None:
        """Change the NMT state, and discard pending transfers and PDOs."""
        if new_state is self._nmt:
            return
        self._nmt = new_state
        self._sync_alive = False
        self._sdo.reset()
        for pdo in (*self._receive_pdos, *self._transmit_pdos):
            pdo.reset_exchange()
        self._log("nmt", state=new_state.name.lower().replace("_", "-"))

    def _end_connection(self) -> None:
        """Leave operation enabled before the NMT state changes, as the abort option (6007) says."""
        if self._state_machine.state is not PdsState.OPERATION_ENABLED:
            return
        abort_option = self._entries.abort_option.value
        if abort_option == 1:
            self._fail(_CONNECTION_ENDED_CODE, _COMMUNICATION_ERROR_BIT)
        elif abort_option == 3:
            self._state_machine.quick_stop()
        else:
            self._state_machine.disable_voltage()

    # Frames ------------------------------------------------------------------------------------

    def _on_sync(self, frame_data: bytes) -> None:
        """Process a SYNC: apply pending RPDOs, advance the rig, send TPDOs."""
        is_operational = self._nmt is Nmt.OPERATIONAL and not self.frozen
        if len(frame_data) != self._sync_length:
            if is_operational:
                self._report(_SYNC_LENGTH_CODE, _COMMUNICATION_ERROR_BIT, bytes([len(frame_data)]))
            return
        if is_operational:
            if self._emergencies.active_errors:
                self._clear(_SYNC_LENGTH_CODE)
            self._last_sync_s = self._now_s
            is_first_sync, self._sync_alive = not self._sync_alive, True
            for rpdo in self._sync_rpdos:
                pending_data = rpdo.pending
                if pending_data is not None:
                    rpdo.pending = None
                    rpdo.apply(pending_data)
            if is_first_sync:
                self._refresh_torque()
        self._advance()
        if self.torque_lag_s:
            self._measure_torque()
        if is_operational:
            speed_limit_rad_s = self._entries.max_speed_rpm.value * self._rad_s_per_rpm
            is_too_fast = not -speed_limit_rad_s <= self._plant.velocity_rad_s <= speed_limit_rad_s
            if is_too_fast or self._is_too_fast:
                self._is_too_fast = is_too_fast
                self._refresh_torque()
            for tpdo in self._sync_tpdos:
                tpdo_data = tpdo.data_at_sync(self._now_s)
                if tpdo_data is not None:
                    self._transmit(tpdo.can_id, tpdo_data)

    def _on_rpdo(self, pdo: ReceivePdo, frame_data: bytes) -> None:
        """Process a received RPDO: check its length, and apply it now or at the next SYNC."""
        if self._nmt is not Nmt.OPERATIONAL:
            return
        if len(frame_data) < pdo.size:
            vendor_bytes = bytes([len(frame_data), pdo.size])
            if self._state_machine.state is PdsState.OPERATION_ENABLED:
                self._fail(_PDO_TOO_SHORT_CODE, _COMMUNICATION_ERROR_BIT, vendor_bytes)
            else:
                self._report(_PDO_TOO_SHORT_CODE, _COMMUNICATION_ERROR_BIT, vendor_bytes)
            return
        if len(frame_data) > pdo.size:  # the first bytes are used (CiA 301)
            self._report(
                _PDO_TOO_LONG_CODE, _COMMUNICATION_ERROR_BIT, bytes([len(frame_data), pdo.size])
            )
            frame_data = frame_data[: pdo.size]
        elif self._emergencies.active_errors:
            self._clear(_PDO_TOO_SHORT_CODE, _PDO_TOO_LONG_CODE)
        pdo.received_s = self._now_s
        if pdo.is_synchronous:
            pdo.pending = frame_data
        else:
            pdo.apply(frame_data)

    def _on_sdo(self, frame_data: bytes) -> None:
        """Process an SDO request, unless the node is stopped."""
        if self._nmt is not Nmt.STOPPED:
            self._sdo.receive(frame_data)

    def _on_heartbeat(self, node_id: int, frame_data: bytes) -> None:
        """Process the heartbeat of another node."""
        if (
            len(frame_data) != 1 or frame_data[0] & 0x7F == Nmt.INITIALISING
        ):  # a boot-up is not a heartbeat
            return
        for heartbeat_monitor in self._heartbeat_monitors:
            if heartbeat_monitor.node_id == node_id:
                heartbeat_monitor.register_heartbeat(self._now_s)
        if self._emergencies.active_errors:
            self._clear_heartbeat_error()

    def _transmit(self, can_id: int, data: bytes) -> None:
        """Send a frame unless the drive is frozen."""
        if not self.frozen:
            self._send(can_id, data)

    def _log_sdo_write(self, index: int, sub_index: int, value: int | str) -> None:
        """Log a successful SDO write."""
        self._log("sdo write", index=f"{index:04X}", sub=sub_index, value=value)

    def _rebuild_pdos(self) -> None:
        """Rebuild the mappings of all PDOs from the dictionary."""
        for pdo in (*self._receive_pdos, *self._transmit_pdos):
            pdo.compile_mapping()
        self._rebuild_tables()

    def _rebuild_tables(self) -> None:
        """Rebuild the table of frame handlers by identifier, and the lists of PDOs."""
        self._sync_id = self._entries.sync_cob_id.value
        self._sync_length = 1 if self._entries.sync_overflow.value else 0
        active_rpdos = [pdo for pdo in self._receive_pdos if pdo.can_id >= 0]
        self._sync_rpdos = [pdo for pdo in active_rpdos if pdo.is_synchronous]
        target_torque_entry = self._entries.target_torque
        self._target_pdos = [
            pdo for pdo in active_rpdos if any(e is target_torque_entry for e in pdo.entries)
        ]
        active_tpdos = [pdo for pdo in self._transmit_pdos if pdo.can_id >= 0]
        self._sync_tpdos = [pdo for pdo in active_tpdos if pdo.is_synchronous]
        self._event_tpdos = [pdo for pdo in active_tpdos if not pdo.is_synchronous]
        frame_handlers: dict[int, Callable[[bytes], None]] = {
            0x700 + node_id: partial(self._on_heartbeat, node_id) for node_id in range(1, 128)
        }
        frame_handlers.update({pdo.can_id: partial(self._on_rpdo, pdo) for pdo in active_rpdos})
        frame_handlers[0x600 + self._node_id] = self._on_sdo
        frame_handlers[0x000] = self._on_nmt
        self._handlers = frame_handlers

    # Watchdogs and errors ----------------------------------------------------------------------

    def _check_heartbeats(self, now_s: float) -> None:
        """React to heartbeats that have just been lost, as objects 6007 and 1029:1 prescribe."""
        for heartbeat_monitor in self._heartbeat_monitors:
            if not heartbeat_monitor.check(now_s):
                continue
            error_option, pds_state = self._entries.abort_option.value, self._state_machine.state
            if error_option == 1 and pds_state not in (PdsState.READY, PdsState.SWITCH_ON_DISABLED):
                self._state_machine.fail()
            elif error_option == 3:
                self._state_machine.quick_stop()
            elif error_option:
                self._state_machine.disable_voltage()
            self._log("heartbeat lost", node_id=heartbeat_monitor.node_id)
            self._report(
                _HEARTBEAT_LOST_CODE, _COMMUNICATION_ERROR_BIT, bytes([heartbeat_monitor.node_id])
            )
            communication_option = self._entries.communication_error_option.value
            if communication_option == 2:
                self._end_connection()
                self._enter_nmt(Nmt.STOPPED)
            elif communication_option == 0 and self._nmt is Nmt.OPERATIONAL:
                self._end_connection()
                self._enter_nmt(Nmt.PRE_OPERATIONAL)

    def _check_sync(self, now_s: float) -> None:
        """Go to fault if SYNC has been missing for too long in operation enabled."""
        if not self._sync_alive:
            return
        timeout_s = self._sync_timeout_s or SYNC_TIMEOUT_PERIODS * self._entries.sync_period_s
        if now_s - self._last_sync_s > timeout_s + _TIME_TOLERANCE_S:
            self._sync_alive = False
            if self._state_machine.state is PdsState.OPERATION_ENABLED:
                self._fail(_SYNC_LOST_CODE, _COMMUNICATION_ERROR_BIT)
                self._log("sync lost", timeout_s=timeout_s)

    def _check_rpdos(self, now_s: float) -> None:
        """Go to fault if an RPDO has missed its deadline in operation enabled."""
        if self._state_machine.state is not PdsState.OPERATION_ENABLED:
            return
        for pdo_number, pdo in enumerate(self._receive_pdos, 1):
            deadline_s = pdo.deadline_s
            if (
                deadline_s
                and pdo.received_s is not None
                and now_s - pdo.received_s > deadline_s + _TIME_TOLERANCE_S
            ):
                self._fail(_RPDO_TIMEOUT_CODE, _COMMUNICATION_ERROR_BIT, bytes([pdo_number]))
                self._log("rpdo lost", number=pdo_number, deadline_s=deadline_s)
                return

    def _clear_heartbeat_error(self) -> None:
        """Clear the heartbeat error if no monitored heartbeat is missing any more."""
        if not any(heartbeat_monitor.lost for heartbeat_monitor in self._heartbeat_monitors):
            self._clear(_HEARTBEAT_LOST_CODE)

    def _has_all_heartbeats(self) -> bool:
        """Return whether no heartbeat is missing, or object 6007 ignores missing heartbeats."""
        return not (
            self._entries.abort_option.value
            and any(heartbeat_monitor.lost for heartbeat_monitor in self._heartbeat_monitors)
        )

    def _may_reset(self) -> bool:
        """Return whether a fault may be reset, and log the attempt."""
        is_reset_allowed = self._has_all_heartbeats() and not self._sto_dropped
        self._log("fault reset", accepted=is_reset_allowed)
        return is_reset_allowed

    def _fail(self, error_code: int, register_bits: int, vendor_bytes: bytes = b"") -> None:
        """Bring the simulated drive to fault, and report an error code by an emergency message."""
        self._state_machine.fail()
        self._report(error_code, register_bits, vendor_bytes)

    def _report(self, error_code: int, register_bits: int, vendor_bytes: bytes = b"") -> None:
        """Report an error by an emergency message, unless it is active already."""
        if self._emergencies.report(error_code, register_bits, vendor_bytes):
            self._entries.error_code.value = error_code

    def _clear(self, *codes_to_clear: int) -> None:
        """Clear active errors whose cause has ended; errors of a fault remain until its reset."""
        if self._state_machine.state not in (PdsState.FAULT, PdsState.FAULT_REACTION):
            self._emergencies.clear(*codes_to_clear)

    def _send_emergency(self, can_id: int, data: bytes) -> None:
        """Log an emergency message, and send it if the NMT state allows."""
        is_sent = self._nmt in (Nmt.OPERATIONAL, Nmt.PRE_OPERATIONAL) and not self.frozen
        self._log(
            "emcy",
            code=int.from_bytes(data[:2], "little"),
            register=data[2],
            vendor=data[3:].hex(),
            sent=is_sent,
        )
        if is_sent:
            self._send(can_id, data)

    # Drive -------------------------------------------------------------------------------------

    def _on_controlword(self) -> None:
        """Process a changed controlword."""
        controlword = self._entries.controlword.value
        operation_mask, unchanged_value = _UNCHANGED_OPERATION_BITS
        if (
            self._state_machine.state is not PdsState.OPERATION_ENABLED
            or controlword & operation_mask != unchanged_value
        ):
            self._state_machine.control(controlword)
        self._refresh_torque()

    def _on_mode(self) -> None:
        """Process a changed mode of operation."""
        if self._entries.mode.value != self._mode:
            self._mode = self._entries.mode.value
            self._log("mode", mode=self._mode)
            self._refresh_torque()

    def _on_state_change(self, previous_state: PdsState) -> None:
        """Process a change of the drive's state: switch the plant on or off, and log it."""
        pds_state = self._state_machine.state
        if previous_state is PdsState.OPERATION_ENABLED:
            self._plant.disable()
            self._per_mille = 0
            self._is_limited = self._follows_target = False
            self._log("torque", torque_nm=0.0, enabled=False)
        self._log("state", state=pds_state.label)
        if pds_state is PdsState.OPERATION_ENABLED:
            self._plant.enable()
            self._log("torque", torque_nm=0.0, enabled=True)
            self._refresh_torque()
        elif previous_state is PdsState.FAULT:
            self._entries.error_code.value = 0
            remaining_codes = (
                {_HEARTBEAT_LOST_CODE}
                if any(heartbeat_monitor.lost for heartbeat_monitor in self._heartbeat_monitors)
                else set()
            )
            self._emergencies.clear(*(self._emergencies.active_errors.keys() - remaining_codes))

    def _refresh_torque(self) -> None:
        """Compute the torque from the object dictionary; pass a changed torque to the plant."""
        if self._state_machine.state is not PdsState.OPERATION_ENABLED:
            return
        drive_entries = self._entries
        self._follows_target = (
            self._sync_alive
            and drive_entries.mode.value == CYCLIC_SYNCHRONOUS_TORQUE
            and not drive_entries.controlword.value & _HALT_BIT
            and (not self._target_pdos or any(pdo.applied for pdo in self._target_pdos))
        )
        target_per_mille = (
            drive_entries.target_torque.value + drive_entries.torque_offset.value
            if self._follows_target
            else 0
        )
        limit_per_mille = min(drive_entries.max_torque.value, self._peak_per_mille)
        highest_per_mille = min(limit_per_mille, abs(drive_entries.positive_torque_limit.value))
        lowest_per_mille = -min(
            limit_per_mille, abs(drive_entries.negative_torque_limit.value)
        )  # some drives state a negative limit
        torque_per_mille = (
            lowest_per_mille
            if target_per_mille < lowest_per_mille
            else min(target_per_mille, highest_per_mille)
        )
        if (
            self._is_too_fast
            and torque_per_mille * self._direction * self._plant.velocity_rad_s > 0
        ):
            torque_per_mille = 0
        self._is_limited = torque_per_mille != target_per_mille
        if torque_per_mille != self._per_mille:
            self._per_mille = torque_per_mille
            torque_nm = torque_per_mille * self._nm_per_mille
            self._plant.command(torque_nm)
            self._log("torque", torque_nm=torque_nm, enabled=True)

    def _statusword(self) -> int:
        """Return the present statusword."""
        pds_state = self._state_machine.state
        statusword = pds_state.bits | (
            _REMOTE_BIT if self._sto_dropped else _VOLTAGE_AND_REMOTE_BITS
        )
        if pds_state is PdsState.OPERATION_ENABLED:
            if self._follows_target:
                statusword |= 0 if self.never_sets_bit_12 else _FOLLOWS_TARGET_BIT
            elif self._entries.controlword.value & _HALT_BIT and self._is_at_rest():
                statusword |= _TARGET_REACHED_BIT
            if self._is_limited:
                statusword |= _INTERNAL_LIMIT_BIT
        elif pds_state is PdsState.QUICK_STOP and self._is_at_rest():
            statusword |= _TARGET_REACHED_BIT
        if self._emergencies.active_errors and pds_state not in (
            PdsState.FAULT,
            PdsState.FAULT_REACTION,
        ):
            statusword |= _WARNING_BIT
        return statusword

    def _is_at_rest(self) -> bool:
        """Return whether the shaft turns by less than one count per second."""
        return abs(self._plant.velocity_rad_s) < self._resolution_rad

    def _position_counts(self) -> int:
        """Return the position in encoder counts as a 32-bit integer."""
        encoder_steps = round(self._simulated_rig.read_angle() / self._resolution_rad)
        position_counts = encoder_steps * self._direction + self.angle_offset_counts
        return (position_counts + 0x8000_0000) % 0x1_0000_0000 - 0x8000_0000

    def _measure_torque(self) -> None:
        """Update the torque that the drive reports as measured, by a first-order lag."""
        elapsed_s, self._measured_at_s = self._now_s - self._measured_at_s, self._now_s
        lag_fraction = -math.expm1(-elapsed_s / self.torque_lag_s)
        self._measured_per_mille += lag_fraction * (self._per_mille - self._measured_per_mille)

    def _actual_torque_per_mille(self) -> int:
        """Return the torque that the drive reports, in 1/1000 of the rated torque."""
        return round(self._measured_per_mille) if self.torque_lag_s else self._per_mille

    def _velocity_counts_per_s(self) -> int:
        """Return the speed in encoder counts per second as a 32-bit integer."""
        counts_per_s = round(self._plant.velocity_rad_s / self._resolution_rad) * self._direction
        return max(-0x8000_0000, min(counts_per_s, 0x7FFF_FFFF))


def _pdo_parameters(
    first_communication_index: int,
    first_cob_id: int,
    first_mapped_index: int,
    device_file: "DeviceFile | None",
) -> Iterator[tuple[int, int, int, tuple[int, ...], int]]:
    """Yield the properties of each PDO: two indices, COB-ID, mapping entries, number of slots.

    The indices are those of the communication and mapping parameters. By default the first PDO
    carries one object of 16 bits, the others none. With a device file, the PDOs are those of the
    file. Only the first four have predefined identifiers.
    """
    pdo_numbers: Iterable[int] = range(_DEFAULT_PDO_COUNT)
    if device_file is not None:
        pdo_numbers = device_file.present_offsets(
            first_communication_index, first_communication_index + _MAX_PDO_INDEX_OFFSET
        )
    for pdo_number in pdo_numbers:
        mapping_index = first_communication_index + 0x200 + pdo_number
        slot_count = (
            MAX_MAPPING_ENTRIES
            if device_file is None
            else device_file.sub_index_count(mapping_index)
        )
        default_cob_id = first_cob_id + 0x100 * pdo_number if pdo_number < _DEFAULT_PDO_COUNT else 0
        default_mapping = () if pdo_number else (first_mapped_index << 16 | 16,)
        yield (
            first_communication_index + pdo_number,
            mapping_index,
            default_cob_id | (COB_ID_DISABLED_BIT if pdo_number else 0),
            default_mapping,
            slot_count,
        )
