"""The simulated drive: a CANopen node by CiA 301 and CiA 402 that pushes the simulated plant.

It supports one mode, cyclic synchronous torque. It has no velocity loop, so what a real drive does
by a ramp (quick stop, fault reaction) is here a coasting shaft: the torque goes to zero and the
drive off at once, and only the state follows later.
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
    DISABLED,
    MAX_ENTRIES,
    WATCHES,
    Emergencies,
    HeartbeatProducer,
    ReceivePdo,
    TransmitPdo,
    add_watches,
)
from rigd.sim.wire._drive_objects import (
    CYCLIC_SYNCHRONOUS_TORQUE,
    NO_MODE,
    PdsState,
    PdsStateMachine,
    add_drive_objects,
    follow_file,
    peak_per_mille,
)
from rigd.sim.wire._object_dictionary import ObjectDictionary, SdoServer

if TYPE_CHECKING:
    from rigd.sim.wire._object_dictionary import DeviceFile

Log = Callable[..., None]

SYNC_TIMEOUT_PERIODS = 30
"""Default number of periods without a SYNC after which a drive in operation faults: more than a
host may miss by its profile, and less than its heartbeat timeout. Real drives differ from 2
upwards."""

# Error codes of CiA 301 and 402.
_CONNECTION_ENDED = 0x8100
_HEARTBEAT_LOST = 0x8130
_PDO_TOO_SHORT = 0x8210
_PDO_TOO_LONG = 0x8220
_SYNC_LENGTH = 0x8240
_RPDO_TIMEOUT = 0x8250
_SYNC_LOST = 0x8700
_GENERIC, _COMMUNICATION = 0x01, 0x10  # bits of the error register

_VOLTAGE_AND_REMOTE, _REMOTE = 0x0210, 0x0200
_WARNING, _STANDING, _INTERNAL_LIMIT, _FOLLOWS = 0x0080, 0x0400, 0x0800, 0x1000
_HALT = 0x0100
_OPERATE = 0x8F, 0x0F
"""Mask and value of the controlword that leaves operation enabled as it is."""

_LAST_COMMUNICATION_INDEX, _LAST_INDEX = 0x1FFF, 0xFFFF
_PDOS = 4
_LAST_PDO = 0x1FF
_TOLERANCE_S = 1e-9


class Nmt(IntEnum):
    """NMT state, as a heartbeat states it."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class DriveNode:
    """A CiA 402 drive on the simulated bus.

    Single-threaded: it acts within `receive` and `tick` only. It boots in the first of these
    calls.

    Parameters
    ----------
    rig
        Parameters with a section [cia402].
    simulated
        Plant that the drive pushes and measures.
    advance
        Moves the simulated rig on to this SYNC. It is called at each valid SYNC, in every state,
        frozen or not: simulated time goes on.
    send
        Takes identifier and data of a frame.
    log
        Takes the source "drive", what happened, and values by name. It is the witness of torque
        and drive: "torque" with torque_nm and enabled at every change of either.
    sync_timeout_s
        After how long without a SYNC a drive in operation faults; by default
        `SYNC_TIMEOUT_PERIODS` of its SYNC period.
    file
        Device file of the drive that it simulates: it has the objects of that one, with types,
        access rights, limits and values at power-on, and no others.

    Attributes
    ----------
    frozen : bool
        It receives and sends nothing, as if its plug were out; its own watchdogs go on.
    torque_lag_s : float
        Time constant with which its actual torque (6077) follows what it exerts, as one that is
        measured and filtered does; 0 shows it at once. The profile's ``torque_response_s``, until
        it is set.
    stays_operational : bool
        It does not take the NMT command to pre-operational.
    never_follows : bool
        Its statusword has no bit 12, which says that the drive follows its target; by the
        profile's ``follows_target_bit``, until it is set.
    watchless : bool
        It does not notice that its host is silent: no heartbeat, SYNC or RPDO is missed.
    angle_offset_counts : int
        Added to the position: an encoder that jumped.
    sto_dropped : bool
        The wired stop is pressed: it removes the torque at once, and the drive stays off for as
        long as it lasts. The drive goes to fault with the profile's ``sto_error_code``, or where
        there is none to switch on disabled.

    Raises
    ------
    DeviceError
        If the profile has no section [cia402], or nothing to count angles in.

    Notes
    -----
    A SYNC in NMT operational first lets a waiting RPDO take effect, then calls `advance`, then
    sends the TPDOs. Since the plant's own delay covers the whole way of a torque, a torque that
    comes in after SYNC k and takes effect at SYNC k + 1 is handed over while the plant is still at
    tick k.

    Before it calls `tick` the owner has to hand over the frames that came before that time, else a
    pause of the owner appears as a silent host.
    """

    def __init__(
        self,
        rig: RigParameters,
        simulated: SimulatedRig,
        advance: Callable[[], None],
        send: Callable[[int, bytes], None],
        log: Log,
        sync_timeout_s: float | None = None,
        file: "DeviceFile | None" = None,
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
        self.never_follows = not rig.cia402.follows_target_bit
        self.stays_operational = self.watchless = False
        self._sto_dropped = False
        self._sto_error_code = rig.cia402.sto_error_code
        self._simulated = simulated
        self._plant = simulated.plant
        self._advance = advance
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
        self._limited = self._following = self._too_fast = False

        objects = self._objects = ObjectDictionary()
        own = self._own = add_drive_objects(
            objects, rig.motor, rig.cia402, rig.rate_hz, rig.encoder.resolution_rad
        )
        self._emergencies = Emergencies(objects, node_id, self._send_emergency)
        self._producer = HeartbeatProducer(objects)
        watches = WATCHES if file is None else file.subs(0x1016)
        self._watches = add_watches(objects, watches, self._forgive_heartbeats)
        self._receive_pdos = [
            ReceivePdo(objects, *pdo, self._arm)
            for pdo in _pdos(0x1400, 0x200 + node_id, 0x6040, file)
        ]
        self._transmit_pdos = [
            TransmitPdo(objects, *pdo, self._arm)
            for pdo in _pdos(0x1800, 0x180 + node_id, 0x6041, file)
        ]
        self._sdo = SdoServer(objects, partial(self._transmit, 0x580 + node_id), self._wrote)

        own.sync_cob_id.wrote = own.sync_overflow.wrote = self._arm
        own.controlword.wrote = self._on_controlword
        own.statusword.live = self._statusword
        own.mode.wrote = self._on_mode
        own.mode_display.live = own.mode.get
        own.position.live = self._position
        own.velocity.live = self._velocity
        own.actual_torque.live = self._actual_torque
        for entry in (
            own.target_torque,
            own.torque_offset,
            own.max_torque,
            own.positive_limit,
            own.negative_limit,
        ):
            entry.wrote = self._refresh_torque
        self._machine = PdsStateMachine(
            own.quick_stop_option,
            own.fault_option,
            entered=self._entered,
            may_switch_on=lambda: self._is_guarded() and not self._sto_dropped,
            may_enable=lambda: self._nmt is Nmt.OPERATIONAL and self._is_guarded(),
            may_reset=self._may_reset,
        )
        if file is not None:
            follow_file(objects, file)
        self._compile()

    def receive(self, can_id: int, data: bytes) -> None:
        """Receive a frame."""
        if self._nmt is Nmt.INITIALISING:
            self._boot()
        if can_id == self._sync_id:
            self._on_sync(data)
        elif not self.frozen:
            handler = self._handlers.get(can_id)
            if handler is not None:
                handler(data)

    def tick(self, now_s: float) -> None:
        """Let time pass: watchdogs, heartbeat, ramps, PDOs on events.

        Parameters
        ----------
        now_s
            On the simulator's clock, at least once a millisecond.
        """
        self._now_s = now_s
        if self._nmt is Nmt.INITIALISING:
            self._boot()
        if not self.watchless:
            self._watch_heartbeats(now_s)
            self._watch_sync(now_s)
            self._watch_rpdos(now_s)
        self._machine.tick(now_s)
        if self._producer.is_due(now_s):
            self._transmit(0x700 + self._node_id, bytes([self._nmt]))
        if self._nmt is Nmt.OPERATIONAL and not self.frozen:
            for pdo in self._event_tpdos:
                data = pdo.at_event(now_s)
                if data is not None:
                    self._transmit(pdo.can_id, data)

    def emergency(self, code: int, register: int, vendor: bytes) -> None:
        """Put the drive in fault with an error code, error register bits, and vendor's bytes."""
        self._fail(code, register, vendor)

    def reset(self) -> None:
        """Restart by itself: it boots, and remembers nothing."""
        self._boot()

    def power_cycle(self) -> None:
        """Simulate a power cycle, which equals a reset here."""
        self.reset()

    def state_object(self, index: int, sub: int, value: int | None) -> None:
        """Set an object to another value, or make it absent."""
        self._objects.override(index, sub, value)

    @property
    def sto_dropped(self) -> bool:
        """Whether the wired stop is pressed."""
        return self._sto_dropped

    @sto_dropped.setter
    def sto_dropped(self, dropped: bool) -> None:
        self._sto_dropped = dropped
        self._log("sto", dropped=dropped)
        if not dropped:
            return
        if self._sto_error_code:
            self._fail(self._sto_error_code, _GENERIC)
        else:
            self._machine.disable_voltage()

    # NMT ---------------------------------------------------------------------------------------

    def _boot(self, last: int = _LAST_INDEX) -> None:
        """Start with the power-on values of all objects, or of those up to an index."""
        self._log("nmt", state="initialising")
        if last == _LAST_INDEX:
            self._emergencies.reset()
            self._machine.start()
        self._nmt = Nmt.INITIALISING
        self._sync_alive = False
        self._objects.reset(last)
        self._on_mode()
        self._compile()
        self._sdo.reset()
        for watch in self._watches:
            watch.restart()
        self._transmit(0x700 + self._node_id, bytes([Nmt.INITIALISING]))
        self._enter_nmt(Nmt.PRE_OPERATIONAL)

    def _on_nmt(self, data: bytes) -> None:
        if len(data) != 2 or data[1] not in (0, self._node_id):
            return
        command = data[0]
        if command == 128 and self.stays_operational:
            return
        if command == 1:
            self._enter_nmt(Nmt.OPERATIONAL)
        elif command in (2, 128):
            self._end_connection()
            self._enter_nmt(Nmt.STOPPED if command == 2 else Nmt.PRE_OPERATIONAL)
        elif command == 129:
            self._boot()
        elif command == 130:
            self._end_connection()
            self._boot(_LAST_COMMUNICATION_INDEX)

    def _enter_nmt(self, state: Nmt) -> None:
        if state is self._nmt:
            return
        self._nmt = state
        self._sync_alive = False
        self._sdo.reset()
        for pdo in (*self._receive_pdos, *self._transmit_pdos):
            pdo.forget()
        self._log("nmt", state=state.name.lower().replace("_", "-"))

    def _end_connection(self) -> None:
        """Leave operation before the NMT state changes: no target can come any more."""
        if self._machine.state is not PdsState.OPERATION_ENABLED:
            return
        option = self._own.abort_option.value
        if option == 1:
            self._fail(_CONNECTION_ENDED, _COMMUNICATION)
        elif option == 3:
            self._machine.quick_stop()
        else:
            self._machine.disable_voltage()

    # Frames ------------------------------------------------------------------------------------

    def _on_sync(self, data: bytes) -> None:
        operational = self._nmt is Nmt.OPERATIONAL and not self.frozen
        if len(data) != self._sync_length:
            if operational:
                self._report(_SYNC_LENGTH, _COMMUNICATION, bytes([len(data)]))
            return
        if operational:
            if self._emergencies.active:
                self._clear(_SYNC_LENGTH)
            self._last_sync_s = self._now_s
            revived, self._sync_alive = not self._sync_alive, True
            for rpdo in self._sync_rpdos:
                pending = rpdo.pending
                if pending is not None:
                    rpdo.pending = None
                    rpdo.apply(pending)
            if revived:
                self._refresh_torque()
        self._advance()
        if self.torque_lag_s:
            self._measure_torque()
        if operational:
            limit_rad_s = self._own.max_speed_rpm.value * self._rad_s_per_rpm
            too_fast = not -limit_rad_s <= self._plant.velocity_rad_s <= limit_rad_s
            if too_fast or self._too_fast:
                self._too_fast = too_fast
                self._refresh_torque()
            for tpdo in self._sync_tpdos:
                sample = tpdo.at_sync(self._now_s)
                if sample is not None:
                    self._transmit(tpdo.can_id, sample)

    def _on_rpdo(self, pdo: ReceivePdo, data: bytes) -> None:
        if self._nmt is not Nmt.OPERATIONAL:
            return
        if len(data) < pdo.size:
            vendor = bytes([len(data), pdo.size])
            if self._machine.state is PdsState.OPERATION_ENABLED:
                self._fail(_PDO_TOO_SHORT, _COMMUNICATION, vendor)
            else:
                self._report(_PDO_TOO_SHORT, _COMMUNICATION, vendor)
            return
        if len(data) > pdo.size:  # the first bytes count (CiA 301)
            self._report(_PDO_TOO_LONG, _COMMUNICATION, bytes([len(data), pdo.size]))
            data = data[: pdo.size]
        elif self._emergencies.active:
            self._clear(_PDO_TOO_SHORT, _PDO_TOO_LONG)
        pdo.received_s = self._now_s
        if pdo.is_synchronous:
            pdo.pending = data
        else:
            pdo.apply(data)

    def _on_sdo(self, data: bytes) -> None:
        if self._nmt is not Nmt.STOPPED:
            self._sdo.receive(data)

    def _on_heartbeat(self, node_id: int, data: bytes) -> None:
        if len(data) != 1 or data[0] & 0x7F == Nmt.INITIALISING:  # a boot-up is not a heartbeat
            return
        for watch in self._watches:
            if watch.node_id == node_id:
                watch.beat(self._now_s)
        if self._emergencies.active:
            self._forgive_heartbeats()

    def _transmit(self, can_id: int, data: bytes) -> None:
        if not self.frozen:
            self._send(can_id, data)

    def _wrote(self, index: int, sub: int, value: int | str) -> None:
        self._log("sdo write", index=f"{index:04X}", sub=sub, value=value)

    def _compile(self) -> None:
        for pdo in (*self._receive_pdos, *self._transmit_pdos):
            pdo.compile()
        self._arm()

    def _arm(self) -> None:
        """Build the table of identifiers, and the list of synchronous PDOs."""
        self._sync_id = self._own.sync_cob_id.value
        self._sync_length = 1 if self._own.sync_overflow.value else 0
        active = [pdo for pdo in self._receive_pdos if pdo.can_id >= 0]
        self._sync_rpdos = [pdo for pdo in active if pdo.is_synchronous]
        target = self._own.target_torque
        self._target_pdos = [pdo for pdo in active if any(e is target for e in pdo.entries)]
        sending = [pdo for pdo in self._transmit_pdos if pdo.can_id >= 0]
        self._sync_tpdos = [pdo for pdo in sending if pdo.is_synchronous]
        self._event_tpdos = [pdo for pdo in sending if not pdo.is_synchronous]
        handlers: dict[int, Callable[[bytes], None]] = {
            0x700 + node_id: partial(self._on_heartbeat, node_id) for node_id in range(1, 128)
        }
        handlers.update({pdo.can_id: partial(self._on_rpdo, pdo) for pdo in active})
        handlers[0x600 + self._node_id] = self._on_sdo
        handlers[0x000] = self._on_nmt
        self._handlers = handlers

    # Watchdogs and errors ----------------------------------------------------------------------

    def _watch_heartbeats(self, now_s: float) -> None:
        for watch in self._watches:
            if not watch.check(now_s):
                continue
            option, state = self._own.abort_option.value, self._machine.state
            if option == 1 and state not in (PdsState.READY, PdsState.SWITCH_ON_DISABLED):
                self._machine.fail()
            elif option == 3:
                self._machine.quick_stop()
            elif option:
                self._machine.disable_voltage()
            self._log("heartbeat lost", node_id=watch.node_id)
            self._report(_HEARTBEAT_LOST, _COMMUNICATION, bytes([watch.node_id]))
            reaction = self._own.communication_error.value
            if reaction == 2:
                self._end_connection()
                self._enter_nmt(Nmt.STOPPED)
            elif reaction == 0 and self._nmt is Nmt.OPERATIONAL:
                self._end_connection()
                self._enter_nmt(Nmt.PRE_OPERATIONAL)

    def _watch_sync(self, now_s: float) -> None:
        if not self._sync_alive:
            return
        timeout_s = self._sync_timeout_s or SYNC_TIMEOUT_PERIODS * self._own.sync_period_s
        if now_s - self._last_sync_s > timeout_s + _TOLERANCE_S:
            self._sync_alive = False
            if self._machine.state is PdsState.OPERATION_ENABLED:
                self._fail(_SYNC_LOST, _COMMUNICATION)
                self._log("sync lost", timeout_s=timeout_s)

    def _watch_rpdos(self, now_s: float) -> None:
        if self._machine.state is not PdsState.OPERATION_ENABLED:
            return
        for number, pdo in enumerate(self._receive_pdos, 1):
            deadline_s = pdo.deadline_s
            if (
                deadline_s
                and pdo.received_s is not None
                and now_s - pdo.received_s > deadline_s + _TOLERANCE_S
            ):
                self._fail(_RPDO_TIMEOUT, _COMMUNICATION, bytes([number]))
                self._log("rpdo lost", number=number, deadline_s=deadline_s)
                return

    def _forgive_heartbeats(self) -> None:
        if not any(watch.lost for watch in self._watches):
            self._clear(_HEARTBEAT_LOST)

    def _is_guarded(self) -> bool:
        """Whether no watched heartbeat is missing that the drive would have to stop for."""
        return not (self._own.abort_option.value and any(watch.lost for watch in self._watches))

    def _may_reset(self) -> bool:
        allowed = self._is_guarded() and not self._sto_dropped
        self._log("fault reset", accepted=allowed)
        return allowed

    def _fail(self, code: int, register: int, vendor: bytes = b"") -> None:
        self._machine.fail()
        self._report(code, register, vendor)

    def _report(self, code: int, register: int, vendor: bytes = b"") -> None:
        if self._emergencies.report(code, register, vendor):
            self._own.error_code.value = code

    def _clear(self, *codes: int) -> None:
        """Clear errors whose cause is gone; those of a fault stay until its reset."""
        if self._machine.state not in (PdsState.FAULT, PdsState.FAULT_REACTION):
            self._emergencies.clear(*codes)

    def _send_emergency(self, can_id: int, data: bytes) -> None:
        sent = self._nmt in (Nmt.OPERATIONAL, Nmt.PRE_OPERATIONAL) and not self.frozen
        self._log(
            "emcy",
            code=int.from_bytes(data[:2], "little"),
            register=data[2],
            vendor=data[3:].hex(),
            sent=sent,
        )
        if sent:
            self._send(can_id, data)

    # Drive -------------------------------------------------------------------------------------

    def _on_controlword(self) -> None:
        word = self._own.controlword.value
        mask, operate = _OPERATE
        if self._machine.state is not PdsState.OPERATION_ENABLED or word & mask != operate:
            self._machine.control(word)
        self._refresh_torque()

    def _on_mode(self) -> None:
        if self._own.mode.value != self._mode:
            self._mode = self._own.mode.value
            self._log("mode", mode=self._mode)
            self._refresh_torque()

    def _entered(self, left: PdsState) -> None:
        state = self._machine.state
        if left is PdsState.OPERATION_ENABLED:
            self._plant.disable()
            self._per_mille = 0
            self._limited = self._following = False
            self._log("torque", torque_nm=0.0, enabled=False)
        self._log("state", state=state.label)
        if state is PdsState.OPERATION_ENABLED:
            self._plant.enable()
            self._log("torque", torque_nm=0.0, enabled=True)
            self._refresh_torque()
        elif left is PdsState.FAULT:
            self._own.error_code.value = 0
            standing = {_HEARTBEAT_LOST} if any(watch.lost for watch in self._watches) else set()
            self._emergencies.clear(*(self._emergencies.active.keys() - standing))

    def _refresh_torque(self) -> None:
        """Pass the torque that follows from the dictionary to the plant, if it has changed."""
        if self._machine.state is not PdsState.OPERATION_ENABLED:
            return
        own = self._own
        self._following = (
            self._sync_alive
            and own.mode.value == CYCLIC_SYNCHRONOUS_TORQUE
            and not own.controlword.value & _HALT
            and (not self._target_pdos or any(pdo.applied for pdo in self._target_pdos))
        )
        wanted = own.target_torque.value + own.torque_offset.value if self._following else 0
        limit = min(own.max_torque.value, self._peak_per_mille)
        high = min(limit, abs(own.positive_limit.value))
        low = -min(limit, abs(own.negative_limit.value))  # some drives have it with its sign
        per_mille = low if wanted < low else min(wanted, high)
        if self._too_fast and per_mille * self._direction * self._plant.velocity_rad_s > 0:
            per_mille = 0
        self._limited = per_mille != wanted
        if per_mille != self._per_mille:
            self._per_mille = per_mille
            torque_nm = per_mille * self._nm_per_mille
            self._plant.command(torque_nm)
            self._log("torque", torque_nm=torque_nm, enabled=True)

    def _statusword(self) -> int:
        state = self._machine.state
        word = state.bits | (_REMOTE if self._sto_dropped else _VOLTAGE_AND_REMOTE)
        if state is PdsState.OPERATION_ENABLED:
            if self._following:
                word |= 0 if self.never_follows else _FOLLOWS
            elif self._own.controlword.value & _HALT and self._is_at_rest():
                word |= _STANDING
            if self._limited:
                word |= _INTERNAL_LIMIT
        elif state is PdsState.QUICK_STOP and self._is_at_rest():
            word |= _STANDING
        if self._emergencies.active and state not in (PdsState.FAULT, PdsState.FAULT_REACTION):
            word |= _WARNING
        return word

    def _is_at_rest(self) -> bool:
        """Whether the shaft turns by less than a count a second."""
        return abs(self._plant.velocity_rad_s) < self._resolution_rad

    def _position(self) -> int:
        steps = round(self._simulated.read_angle() / self._resolution_rad)
        counts = steps * self._direction + self.angle_offset_counts
        return (counts + 0x8000_0000) % 0x1_0000_0000 - 0x8000_0000

    def _measure_torque(self) -> None:
        elapsed_s, self._measured_at_s = self._now_s - self._measured_at_s, self._now_s
        fraction = -math.expm1(-elapsed_s / self.torque_lag_s)
        self._measured_per_mille += fraction * (self._per_mille - self._measured_per_mille)

    def _actual_torque(self) -> int:
        return round(self._measured_per_mille) if self.torque_lag_s else self._per_mille

    def _velocity(self) -> int:
        counts = round(self._plant.velocity_rad_s / self._resolution_rad) * self._direction
        return max(-0x8000_0000, min(counts, 0x7FFF_FFFF))


def _pdos(
    communication: int, cob_id: int, word: int, file: "DeviceFile | None"
) -> Iterator[tuple[int, int, int, tuple[int, ...], int]]:
    """Yield the PDOs of one direction: both indices, identifier, mapping and room for entries.

    The first carries one word. Of a drive with a file there are those that the file has; only the
    first four have identifiers beforehand.
    """
    numbers: Iterable[int] = range(_PDOS)
    if file is not None:
        numbers = file.numbers(communication, communication + _LAST_PDO)
    for number in numbers:
        mapping = communication + 0x200 + number
        slots = MAX_ENTRIES if file is None else file.subs(mapping)
        given = cob_id + 0x100 * number if number < _PDOS else 0
        mapped = () if number else (word << 16 | 16,)
        yield communication + number, mapping, given | (DISABLED if number else 0), mapped, slots
