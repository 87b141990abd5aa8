"""A CiA 402 drive made from any EDS on canopen's LocalNode: an independent witness of rigd.

It has no code in common with rigd. Objects are those of the file, absent, read-only or limited as
the file has them; PDOs are those that the master maps, by the rules of CiA 301. It records the
orders that it received and its actions. Run as a process: `cia402_local_node.py SETTINGS.json`,
with orders as lines of JSON on its standard input, each answered with a line.
"""

import configparser
import dataclasses
import json
import os
import struct
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import canopen
from canopen import objectdictionary as od
from canopen.sdo import SdoAbortedError
from netcanoem_box import NetCanOemBox
from seqpacket_bus import SeqpacketHub
from shaft import Shaft

NOT_WRITABLE = 0x06010002
NOT_THERE = 0x06090011
CANNOT_BE_MAPPED = 0x06040041
TOO_LONG = 0x06040042
INCOMPATIBLE = 0x06040043
OUT_OF_RANGE, TOO_HIGH, TOO_LOW = 0x06090030, 0x06090031, 0x06090032
NOT_IN_THIS_STATE = 0x08000022

DISABLED, NO_REMOTE = 1 << 31, 1 << 30
CYCLIC_TORQUE = 10
RPM_PER_RAD_S = 9.5493
MODE_BITS = {1: 0, 2: 1, 3: 2, 4: 3, 6: 5, 7: 6, 8: 7, 9: 8, 10: 9}
OBJECTS_OF_MODE = {10: (0x6071, 0x6077), 9: (0x60FF,), 8: (0x607A, 0x6064), 4: (0x6071, 0x6087)}

SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED = 0x40, 0x21, 0x23, 0x27
QUICK_STOP, FAULT = 0x07, 0x08
WORDS = {
    SWITCH_ON_DISABLED: "switch-on disabled",
    READY: "ready to switch on",
    SWITCHED_ON: "switched on",
    ENABLED: "operation enabled",
    QUICK_STOP: "quick stop active",
    FAULT: "fault",
}
HEARTBEAT_LOST, PDO_TOO_SHORT, PDO_TOO_LONG, RPDO_TIMEOUT = 0x8130, 0x8210, 0x8220, 0x8250
SYNC_LENGTH = 0x8240
OPERATIONAL, STOPPED, PRE_OPERATIONAL = "OPERATIONAL", "STOPPED", "PRE-OPERATIONAL"


@dataclass
class Settings:
    """Settings that the file does not state."""

    eds: str
    socket: str
    log: str
    node_id: int = 5
    sensor_base: int = 0x68
    rated_torque_nm: float = 0.5
    """At the output shaft; 1000 per mille."""
    rated_torque_counts: int = 5000
    """Object 6076, if there is one."""
    gear: float = 100.0
    rad_per_count: float = 7.0e-5
    stored: dict[str, int] = field(default_factory=dict)
    """Values saved in the drive before: "1800:3" → value, instead of the file's."""
    pre_operational: str = "abort"
    """NMT pre-operational while enabled: "abort" acts as 6007 says, "keeps on" changes the NMT
    state and leaves the torque on, "ignored" does not even that."""
    without_6007: int = 1
    """Reaction of a drive without 6007 to a lost connection, in the numbers of 6007."""
    torque_lag_s: float = 0.0
    """First-order lag of 6077 behind the torque."""
    follows_bit: bool = True
    """Bit 12 of the statusword."""
    inhibits_synchronous: bool = True
    """The inhibit time holds for TPDOs on SYNC, too."""


class Log:
    """One line of JSON an event, times by time.monotonic."""

    def __init__(self, path: str) -> None:
        self._file = Path(path).open("w", encoding="utf-8")  # noqa: SIM115, as long as the process

    def note(self, what: str, **values: object) -> None:
        self._file.write(json.dumps({"t_s": time.monotonic(), "what": what, **values}) + "\n")

    def flush(self) -> None:
        self._file.flush()


class DriveNode(canopen.LocalNode):
    """LocalNode with the access rules of the file, and a drive's own after-effects of a write."""

    drive: "Drive | None" = None

    def _find_object(self, index: int, subindex: int) -> od.ODVariable:
        found = super()._find_object(index, subindex)
        group = self.object_dictionary[index]
        if isinstance(group, od.ODVariable):
            if subindex:
                raise SdoAbortedError(NOT_THERE)
        elif subindex not in group.subindices:
            # canopen makes up the elements of an array; those of a compact one are meant so.
            count = group.subindices[0].default if 0 in group.subindices else 0
            if set(group.subindices) - {0, 1} or not 0 < subindex <= (count or 0):
                raise SdoAbortedError(NOT_THERE)
        return found

    def set_data(
        self, index: int, subindex: int, data: bytes, check_writable: bool = False
    ) -> None:
        entry = {"index": f"{index:04X}:{subindex}", "data": bytes(data).hex()}
        try:
            found = self._find_object(index, subindex)
            if check_writable and not found.writable:
                raise SdoAbortedError(NOT_WRITABLE)
            if found.data_type in od.INTEGER_TYPES and 8 * len(data) == len(found):
                value = found.decode_raw(bytes(data))
                # Of CiA 301's own objects files state limits that cannot be meant: 65535 for
                # an entry of 1016, whose bits 16 to 23 are the node.
                if index >= 0x2000 and found.max is not None and value > found.max:
                    raise SdoAbortedError(TOO_HIGH)
                if index >= 0x2000 and found.min is not None and value < found.min:
                    raise SdoAbortedError(TOO_LOW)
                if self.drive is not None and check_writable:
                    self.drive.before_write(index, subindex, value)
            super().set_data(index, subindex, data, check_writable)
        except SdoAbortedError as error:
            if self.drive is not None:
                self.drive.log.note("write refused", **entry, abort=f"0x{error.code:08X}")
            raise
        if self.drive is not None and check_writable:
            self.drive.log.note("write", **entry)
            self.drive.after_write(index, subindex)


@dataclass
class Pdo:
    """One PDO as it is configured now."""

    number: int
    can_id: int
    transmission: int
    entries: list[tuple[int, int, int]]
    inhibit_s: float
    timeout_s: float
    syncs: int = 0
    sent_s: float = -1e9
    received_s: float | None = None
    waiting: bytes | None = None

    @property
    def length(self) -> int:
        return sum(bits for _, _, bits in self.entries) // 8


class Drive:
    """The drive: state machine, PDOs, guards and the shaft behind it."""

    def __init__(self, settings: Settings, network: canopen.Network, log: Log) -> None:
        self.settings, self.network, self.log = settings, network, log
        dictionary = canopen.import_od(settings.eds, node_id=settings.node_id)
        self.node = DriveNode(settings.node_id, dictionary)
        self.shaft = Shaft()
        self.state = SWITCH_ON_DISABLED
        self.controlword = 0
        self.mode = 0
        self.error_code = 0
        self.torque_per_mille = 0
        self.shown_per_mille = 0.0
        self._shown_s = time.monotonic()
        self._latched = 0
        self._noted: tuple[int, int] = (0, SWITCH_ON_DISABLED)
        self._tpdos: list[Pdo] = []
        self._rpdos: dict[int, Pdo] = {}
        self._sync_s: float | None = None
        self._guarded: dict[int, tuple[float, float | None]] = {}
        self._quick_stop_until_s: float | None = None
        self._power_up()
        network.add_node(self.node)
        network.unsubscribe(0, self.node.nmt.on_command)
        network.unsubscribe(self.node.sdo.rx_cobid, self.node.sdo.on_request)
        network.subscribe(0, self._on_nmt)
        network.subscribe(self.node.sdo.rx_cobid, self._on_sdo)
        network.subscribe(0x80, self._on_sync)
        self.node.drive = self
        self.node.add_read_callback(self._live)
        self._boot()

    # Object dictionary

    def _power_up(self) -> None:
        """Give each object the value it has after power-up."""
        node, settings = self.node, self.settings
        node.data_store.clear()
        for entry in node.object_dictionary.values():
            group = [entry] if isinstance(entry, od.ODVariable) else entry.subindices.values()
            for each in group:
                if each.value is None and each.default is None:
                    blank = bytes(len(each) // 8) if each.data_type in od.NUMBER_TYPES else b"?"
                    self._store(each.index, each.subindex, blank)
        identity = node.object_dictionary.device_information
        numbers = (
            identity.vendor_number,
            identity.product_number,
            identity.revision_number,
        )
        for sub, number in enumerate(numbers, 1):
            if self._has(0x1018, sub) and not self._get(0x1018, sub) and number:
                self._put(0x1018, sub, number)
        if self._has(0x6502) and not self._get(0x6502):
            self._put(0x6502, 0, self._modes_of_the_objects())
        if self._has(0x6076):
            self._put(0x6076, 0, settings.rated_torque_counts)
        for name, value in settings.stored.items():
            index, _, sub = name.partition(":")
            self._put(int(index, 16), int(sub or 0), value)
        self.mode = self._get(0x6060) if self._has(0x6060) else 0
        self._read_pdos()
        self._read_guards()

    def _modes_of_the_objects(self) -> int:
        there = (m for m, needs in OBJECTS_OF_MODE.items() if all(map(self._has, needs)))
        return sum(1 << MODE_BITS[mode] for mode in there)

    def _has(self, index: int, sub: int = 0) -> bool:
        try:
            self.node._find_object(index, sub)
        except (SdoAbortedError, KeyError):
            return False
        return True

    def _get(self, index: int, sub: int = 0) -> int:
        found = self.node._find_object(index, sub)
        return int(found.decode_raw(self.node.get_data(index, sub)))

    def _get_or(self, index: int, sub: int, otherwise: int) -> int:
        return self._get(index, sub) if self._has(index, sub) else otherwise

    def _store(self, index: int, sub: int, data: bytes) -> None:
        self.node.data_store.setdefault(index, {})[sub] = data

    def _put(self, index: int, sub: int, value: int) -> None:
        self._store(index, sub, self.node._find_object(index, sub).encode_raw(value))

    def _live(self, index: int, subindex: int, **_: object) -> int | None:
        """Return the value of an object that is measured, not stored."""
        if index == 0x6041:
            return self.statusword
        if index == 0x6061:
            return self.mode
        if index == 0x6064:
            return self._latched
        if index == 0x606C:
            return round(self.shaft.speed_rad_s / self.settings.rad_per_count)
        if index == 0x6077:
            return round(self.shown_per_mille)
        if index == 0x603F:
            return self.error_code
        return None

    def before_write(self, index: int, sub: int, value: int) -> None:
        """Refuse writes that CiA 301 and 402 forbid."""
        if 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00:
            self._check_mapping(index, sub, value)
        elif 0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00:
            self._check_communication(index, sub, value)
        elif index == 0x1016 and sub and value & 0xFFFF:
            for other in range(1, 128):
                same = other != sub and self._has(0x1016, other)
                consumer_entry = self._get(0x1016, other) if same else 0
                if consumer_entry & 0xFFFF and consumer_entry >> 16 & 0x7F == value >> 16 & 0x7F:
                    raise SdoAbortedError(INCOMPATIBLE)
        elif index == 0x6060 and value:
            bit = MODE_BITS.get(value)
            if bit is None or not self._get_or(0x6502, 0, 0) >> bit & 1:
                raise SdoAbortedError(OUT_OF_RANGE)

    def _check_mapping(self, index: int, sub: int, value: int) -> None:
        communication = index - 0x200
        if not self._get_or(communication, 1, 0) & DISABLED:
            raise SdoAbortedError(NOT_IN_THIS_STATE)
        if sub:
            if self._get(index, 0):
                raise SdoAbortedError(NOT_IN_THIS_STATE)
            if value:
                self._check_entry(value, to_drive=index < 0x1800)
        else:
            entries = [self._get(index, n) for n in range(1, value + 1)]
            for entry in entries:
                self._check_entry(entry, to_drive=index < 0x1800)
            if sum(entry & 0xFF for entry in entries) > 64:
                raise SdoAbortedError(TOO_LONG)

    def _check_entry(self, entry: int, *, to_drive: bool) -> None:
        index, sub, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        if not self._has(index, sub):
            raise SdoAbortedError(CANNOT_BE_MAPPED)
        found = self.node._find_object(index, sub)
        wrong_way = not found.writable if to_drive else not found.readable
        if not found.pdo_mappable or wrong_way or len(found) != bits:
            raise SdoAbortedError(CANNOT_BE_MAPPED)

    def _check_communication(self, index: int, sub: int, value: int) -> None:
        before = self._get(index, 1)
        enabled = not before & DISABLED
        if sub == 1 and enabled and not value & DISABLED:
            if before & 0x3FFFFFFF != value & 0x3FFFFFFF:
                raise SdoAbortedError(OUT_OF_RANGE)
        elif sub == 3 and enabled:
            raise SdoAbortedError(NOT_IN_THIS_STATE)
        elif sub == 2 and 241 <= value <= 251:
            raise SdoAbortedError(OUT_OF_RANGE)

    def after_write(self, index: int, sub: int) -> None:
        """Apply a written value."""
        if 0x1400 <= index < 0x1C00:
            self._read_pdos()
        elif index == 0x1016:
            self._read_guards()
        elif index == 0x6060:
            self.mode = self._get(0x6060)
        elif index == 0x6040:
            self._command(self._get(0x6040))
        elif index in (0x6071, 0x60B2, 0x6072):
            self._exert()

    # Network management

    def _boot(self) -> None:
        self.node.nmt.state = "INITIALISING"
        self.node.nmt.state = PRE_OPERATIONAL

    @property
    def nmt(self) -> str:
        return str(self.node.nmt.state)

    def _on_nmt(self, can_id: int, data: bytes, at_s: float) -> None:
        if len(data) != 2 or data[1] not in (0, self.node.id):
            return
        self.log.note("nmt", command=data[0])
        if data[0] == 0x80 and self.settings.pre_operational == "ignored":
            return
        was = self.nmt
        remains_enabled = data[0] == 0x80 and self.settings.pre_operational == "keeps on"
        self.node.nmt.on_command(can_id, data, at_s)
        if was == OPERATIONAL and self.nmt != OPERATIONAL and not remains_enabled:
            self._lose_connection(0)
        if data[0] in (0x81, 0x82):
            self.state, self.error_code = SWITCH_ON_DISABLED, 0
            self._power_up()
            self._exert()
            self._boot()

    def _on_sdo(self, can_id: int, data: bytes, at_s: float) -> None:
        if self.nmt != STOPPED and len(data) == 8:
            self.log.note("sdo", data=bytes(data).hex())
            self.node.sdo.on_request(can_id, data, at_s)

    def _alarm(self, code: int, register: int) -> None:
        self.log.note("emergency", code=code)
        if self.nmt != STOPPED:
            self.network.send_message(0x80 + self.node.id, struct.pack("<HB5x", code, register))

    # PDOs

    def _read_pdos(self) -> None:
        for pdo in self._rpdos.values():
            self.network.unsubscribe(pdo.can_id, self._on_rpdo)
        before = {pdo.number: pdo for pdo in (*self._tpdos, *self._rpdos.values())}
        self._tpdos, self._rpdos = [], {}
        for index in sorted(i for i in self.node.object_dictionary if 0x1400 <= i < 0x1A00):
            cob_id = self._get_or(index, 1, DISABLED)
            mapping = index + 0x200
            if 0x1600 <= index < 0x1800 or cob_id & DISABLED or not self._has(mapping):
                continue
            entries = [self._get(mapping, n) for n in range(1, self._get(mapping) + 1)]
            pdo = Pdo(
                number=index,
                can_id=cob_id & 0x7FF,
                transmission=self._get_or(index, 2, 255),
                entries=[(e >> 16, e >> 8 & 0xFF, e & 0xFF) for e in entries],
                inhibit_s=self._get_or(index, 3, 0) * 1e-4,
                timeout_s=self._get_or(index, 5, 0) * 1e-3,
            )
            if index in before:
                pdo.received_s = before[index].received_s
            if index >= 0x1800:
                self._tpdos.append(pdo)
            else:
                self._rpdos[pdo.can_id] = pdo
                self.network.subscribe(pdo.can_id, self._on_rpdo)

    def _on_sync(self, can_id: int, data: bytes, at_s: float) -> None:
        if self._get_or(0x1019, 0, 0) and len(data) != 1:
            self._alarm(SYNC_LENGTH, 0x11)
        if self.nmt != OPERATIONAL:
            return
        now_s = time.monotonic()
        self._sync_s = now_s
        self._move(now_s)
        self._latched = self._position()
        for pdo in self._rpdos.values():
            if pdo.waiting is not None:
                self._apply(pdo, pdo.waiting)
                pdo.waiting = None
        for pdo in self._tpdos:
            if pdo.transmission > 240:
                continue
            pdo.syncs += 1
            inhibited = self.settings.inhibits_synchronous and now_s - pdo.sent_s < pdo.inhibit_s
            if pdo.syncs >= max(pdo.transmission, 1) and not inhibited:
                pdo.syncs, pdo.sent_s = 0, now_s
                data = b"".join(self.node.get_data(i, sub) for i, sub, _ in pdo.entries)
                self.network.send_message(pdo.can_id, data)

    def _on_rpdo(self, can_id: int, data: bytes, at_s: float) -> None:
        pdo = self._rpdos.get(can_id)
        if pdo is None or self.nmt != OPERATIONAL:
            return
        now_s = pdo.received_s = time.monotonic()
        if len(data) < pdo.length:
            self._alarm(PDO_TOO_SHORT, 0x11)
            return
        if len(data) > pdo.length:
            self._alarm(PDO_TOO_LONG, 0x11)
        if pdo.transmission > 240:
            self._apply(pdo, bytes(data))
            return
        window_us = self._get_or(0x1007, 0, 0)
        if not window_us or (self._sync_s is not None and now_s - self._sync_s <= window_us * 1e-6):
            pdo.waiting = bytes(data)

    def _apply(self, pdo: Pdo, data: bytes) -> None:
        at = 0
        for index, sub, bits in pdo.entries:
            self._store(index, sub, data[at : at + bits // 8])
            at += bits // 8
        written = {index for index, _, _ in pdo.entries}
        if 0x6060 in written:
            self.mode = self._get(0x6060)
        if 0x6040 in written:
            self._command(self._get(0x6040))
        self._exert()

    # Guards

    def _read_guards(self) -> None:
        """Watch the nodes of 1016; each from its first received heartbeat on."""
        for node_id in self._guarded:
            self.network.unsubscribe(0x700 + node_id, self._on_heartbeat)
        self._guarded = {}
        for sub in range(1, 128):
            consumer_entry = self._get(0x1016, sub) if self._has(0x1016, sub) else 0
            node_id, patience_s = consumer_entry >> 16 & 0x7F, (consumer_entry & 0xFFFF) * 1e-3
            if node_id and patience_s:
                self._guarded[node_id] = (patience_s, None)
                self.network.subscribe(0x700 + node_id, self._on_heartbeat)

    def _on_heartbeat(self, can_id: int, data: bytes, at_s: float) -> None:
        patience_s, _ = self._guarded[can_id - 0x700]
        self._guarded[can_id - 0x700] = (patience_s, time.monotonic())

    def _lose_connection(self, code: int) -> None:
        """Act according to objects 1029 and 6007."""
        self.log.note("connection lost", code=code)
        if code:
            self._alarm(code, 0x11)
            reaction = self._get_or(0x1029, 1, 0)
            if reaction == 2 or (reaction == 0 and self.nmt == OPERATIONAL):
                self.node.nmt.state = STOPPED if reaction == 2 else PRE_OPERATIONAL
        option = self._get_or(0x6007, 0, self.settings.without_6007)
        if self.state not in (ENABLED, QUICK_STOP):
            return
        if option == 1:
            self._fail(code or HEARTBEAT_LOST)
        elif option == 2:
            self._go(SWITCH_ON_DISABLED)
        elif option == 3:
            self._go(QUICK_STOP)

    def watch(self) -> None:
        """Check the timeouts; called often."""
        now_s = time.monotonic()
        self._move(now_s)
        for node_id, (patience_s, received_s) in self._guarded.items():
            if received_s is not None and now_s - received_s > patience_s:
                self._guarded[node_id] = (patience_s, None)
                self._lose_connection(HEARTBEAT_LOST)
        for pdo in self._rpdos.values():
            late = pdo.received_s is not None and pdo.timeout_s
            if late and now_s - pdo.received_s > pdo.timeout_s:
                pdo.received_s = None
                self._lose_connection(RPDO_TIMEOUT)
        if self._quick_stop_until_s is not None and now_s > self._quick_stop_until_s:
            self._quick_stop_until_s = None
            if self.state == QUICK_STOP and self._get_or(0x605A, 0, 2) < 5:
                self._go(SWITCH_ON_DISABLED)

    # The drive

    @property
    def statusword(self) -> int:
        word = self.state | 1 << 9
        if self.state != QUICK_STOP and self.state in (READY, SWITCHED_ON, ENABLED):
            word |= 1 << 4
        if self.state == ENABLED and self.settings.follows_bit and self.mode == CYCLIC_TORQUE:
            word |= 1 << 12
        return word

    def _command(self, word: int) -> None:
        """Go where a controlword leads from here."""
        rising = word & ~self.controlword
        self.controlword = word
        state = self.state
        if state == FAULT:
            if rising & 0x80:
                self.error_code = 0
                self._go(SWITCH_ON_DISABLED)
        elif not word & 0x02:
            self._go(SWITCH_ON_DISABLED)
        elif not word & 0x04:
            if state == ENABLED:
                self._go(QUICK_STOP)
            elif state in (READY, SWITCHED_ON):
                self._go(SWITCH_ON_DISABLED)
        elif word & 0x0F == 0x06:
            if state in (SWITCH_ON_DISABLED, SWITCHED_ON, ENABLED):
                self._go(READY)
        elif word & 0x0F == 0x07:
            if state in (READY, ENABLED):
                self._go(SWITCHED_ON)
        elif word & 0x0F == 0x0F:
            if state == READY:
                self._go(SWITCHED_ON)
            elif state == SWITCHED_ON:
                self._go(ENABLED)

    def _go(self, state: int) -> None:
        if state == self.state:
            return
        self.state = state
        self.log.note("state", state=WORDS[state])
        self._quick_stop_until_s = time.monotonic() + 0.05 if state == QUICK_STOP else None
        self._exert()

    def _fail(self, code: int) -> None:
        self.error_code = code
        self._go(FAULT)

    def _exert(self) -> None:
        """Take over the torque that is wanted now."""
        wanted = 0
        if self.state == ENABLED and self.mode == CYCLIC_TORQUE:
            wanted = self._get_or(0x6071, 0, 0) + self._get_or(0x60B2, 0, 0)
            for index, sign in ((0x6072, 0), (0x60E0, 1), (0x60E1, -1)):
                if self._has(index) and sign * wanted >= 0:
                    limit = abs(self._get(index))  # some makers state 60E1 below zero
                    wanted = max(-limit, min(limit, wanted))
        self._move(time.monotonic())
        self.torque_per_mille = wanted
        self._note_torque()

    def _note_torque(self) -> None:
        if (self.torque_per_mille, self.state) != self._noted:
            self._noted = (self.torque_per_mille, self.state)
            self.log.note(
                "torque",
                per_mille=self.torque_per_mille,
                enabled=self.state == ENABLED,
                angle_rad=self.shaft.angle_rad,
                speed_rad_s=self.shaft.speed_rad_s,
            )

    def _move(self, now_s: float) -> None:
        torque = self.torque_per_mille
        rpm = self._get_or(0x6080, 0, 0)
        speed_rad_s = self.shaft.speed_rad_s
        if (
            rpm
            and abs(speed_rad_s) * self.settings.gear * 9.5493 >= rpm
            and speed_rad_s * torque > 0
        ):
            torque = 0
        exerted_nm = torque * 1e-3 * self.settings.rated_torque_nm * self._sense(5)
        self.shaft.advance(now_s, exerted_nm)
        step_s, self._shown_s = now_s - self._shown_s, now_s
        lag_s = self.settings.torque_lag_s
        fraction = min(1.0, step_s / lag_s) if lag_s else 1.0
        self.shown_per_mille += fraction * (self.torque_per_mille - self.shown_per_mille)

    def _position(self) -> int:
        counts = round(self.shaft.angle_rad / self.settings.rad_per_count) * self._sense(7)
        return (counts + (1 << 31) & 0xFFFFFFFF) - (1 << 31)

    def _sense(self, bit: int) -> int:
        """Object 607E: bit 7 turns the position round, bit 5 the torque."""
        return -1 if self._get_or(0x607E, 0, 0) >> bit & 1 else 1

    # Orders from outside the bus

    def obey(self, order: dict[str, object]) -> dict[str, object]:
        """Cause an event in the drive; return its state."""
        what = order.get("do")
        if what == "fault":
            code = int(order.get("code", 0x2310))  # type: ignore[call-overload]
            self._alarm(code, 0x03)
            self._fail(code)
        elif what == "leave on":
            # As a killed host leaves it: operational, enabled, with the last torque.
            self.node.nmt.state = OPERATIONAL
            self.mode = CYCLIC_TORQUE
            self._put(0x6060, 0, CYCLIC_TORQUE)
            self._put(0x6071, 0, int(order["per_mille"]))  # type: ignore[call-overload]
            self.controlword = 0x0F
            self._go(ENABLED)
            self._exert()
        self._move(time.monotonic())
        return {
            "t_s": time.monotonic(),
            "state": WORDS[self.state],
            "nmt": self.nmt,
            "per_mille": self.torque_per_mille,
            "angle_rad": self.shaft.angle_rad,
            "speed_rad_s": self.shaft.speed_rad_s,
        }


def say(answer: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


def main() -> int:
    settings = Settings(**json.loads(Path(sys.argv[1]).read_text("utf-8")))
    log = Log(settings.log)
    hub = SeqpacketHub(settings.socket)
    network = canopen.Network(hub)
    try:
        drive = Drive(settings, network, log)
    except (ValueError, configparser.Error) as error:
        say({"ended": f"canopen cannot read {Path(settings.eds).name}: {error}"})
        hub.shutdown()
        return 1
    box = NetCanOemBox(
        settings.sensor_base,
        lambda: (0.0, 0.0, 0.0, 0.0, 0.0, drive.shaft.coupling_nm),
        network.send_message,
    )
    try:
        # Real drives and boxes are not slowed down by the load of this computer.
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(70))
    except OSError:
        log.note("ordinary scheduling")
    say({"ready": dataclasses.asdict(settings)})
    flushed_s = 0.0
    while True:
        messages, others = hub.poll(1e-3, sys.stdin.fileno())
        for message in messages:
            network.notify(message.arbitration_id, bytearray(message.data), time.monotonic())
            box.take(message.arbitration_id, bytes(message.data))
        drive.watch()
        if others:
            line = sys.stdin.readline()
            if not line:
                break
            answer = drive.obey(json.loads(line))
            log.flush()
            say(answer)
        if time.monotonic() - flushed_s > 0.02:
            flushed_s = time.monotonic()
            log.flush()
    drive.node.nmt.stop_heartbeat()
    log.flush()
    hub.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
