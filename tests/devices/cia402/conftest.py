"""A scripted drive at the end of a Unix socket, written with struct alone, and a small bus."""

import select
import socket
import struct
import threading
import time
from collections import deque
from dataclasses import replace

import pytest

from rigd.devices.canbus import CanLink
from rigd.devices.cia402 import Cia402Drive
from rigd.devices.parameters import Acquisition, CanBus, ServoDrive
from rigd.devices.running_simulator import SimulatorAddress
from rigd.profile import load_profile

NODE, HOST = 5, 100
_STATUS = {
    "switch-on disabled": 0x0250,
    "switch-on disabled, no supply": 0x0240,
    "ready": 0x0231,
    "switched on": 0x0233,
    "enabled": 0x1237,
    "fault": 0x0218,
    "fault reaction": 0x021F,
    "quick stop": 0x0217,
    "not ready": 0x0200,
}
_UP = {
    ("switch-on disabled", 0x06): "ready",
    ("ready", 0x07): "switched on",
    ("switched on", 0x0F): "enabled",
}
_FORMATS = {
    0x6080: "<I",
    0x1007: "<I", 0x1014: "<I", 0x1019: "<B", 0x607E: "<B", 0x605A: "<h", 0x605E: "<h",
    0x3001: "<I", 0x6077: "<h",
    0x60B2: "<h",
    0x60E0: "<H",
    0x60E1: "<H",
    0x1005: "<I", 0x1006: "<I", 0x1016: "<I", 0x1017: "<H", 0x1018: "<I", 0x1029: "<B",
    0x6007: "<h", 0x603F: "<H", 0x6040: "<H", 0x6041: "<H", 0x6060: "<b", 0x6061: "<b",
    0x608F: "<I", 0x6091: "<I", 0x6092: "<I",
    0x6072: "<H", 0x6076: "<I", 0x60C2: "<B", 0x6502: "<I",
}  # fmt: skip


def _format(index, sub):
    if (index, sub) == (0x60C2, 2):
        return "<b"
    if 0x1400 <= index < 0x1B00:
        mapping = bool(index & 0x200)
        return ("<I" if sub else "<B") if mapping else {1: "<I", 2: "<B"}.get(sub, "<H")
    if (index, sub) == (0x1016, 0):
        return "<B"
    return _FORMATS[index]


class ScriptedDrive(threading.Thread):
    """A drive that follows its attributes. One client; time passes with SYNC.

    `drop` counts SYNCs that are left without an answer (`drop_at`: which ones), `hold` replies
    that are delayed until the next SYNC, and come before its own reply; `garble` replaces the
    next replies.
    """

    def __init__(self, path):
        super().__init__(daemon=True)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(path)
        self._listener.listen(1)
        self._wake, self._woken = socket.socketpair()
        self._link = None
        self.error = None
        self.state = "switch-on disabled"
        self.nmt = 0x7F
        self.stops = True
        self.position, self.torque = 1000, 0
        self.pending = None  # controlword and torque of an RPDO that waits for SYNC
        self.control = 0
        self.stays_in = None  # a state from which it makes no transition upwards
        self.on_ready = "ready"  # where it goes instead
        self.ignores_nmt = False
        self.off_delay_s = 0.0  # from the command on
        self.off_read_after = -1  # SDO frames, until the statusword was read as off
        self._off_at = None
        self.follows = True
        self.mode_follows = True
        self.sdo_works = True
        self.obeys = True
        self.drop = self.hold = 0
        self.drop_at = set()
        self.held = []
        self.garble = deque()
        self.silent = False
        self.heartbeat_every = 10
        self.syncs = 0
        self.on_sync = None
        self.reply_delay_s = 0.0
        self.refuse, self.fixed = {}, set()
        self.read_only, self.refuse_value = set(), {}
        self.write_only = set()
        self.formats = {}
        self.short_tpdo = False
        self.nmt_heartbeats = True
        self.seen = []  # everything that came: identifier, data
        self.writes = []  # SDO: index, sub, value
        self.objects = {
            (0x1005, 0): 0x80, (0x1006, 0): 0, (0x1016, 1): 0, (0x1017, 0): 0,
            (0x1018, 1): 0x1234, (0x1018, 2): 0xABCD, (0x1018, 3): 0x10002, (0x1018, 4): 77,
            (0x1029, 1): 0, (0x6007, 0): 1, (0x603F, 0): 0, (0x6040, 0): 0, (0x6060, 0): 0,
            (0x6072, 0): 1000, (0x6076, 0): 5, (0x60C2, 1): 20, (0x60C2, 2): -3,
            (0x6502, 0): 0x3ED,
        }  # fmt: skip
        for n in range(2):  # PDOs 3 and 4 do not exist
            self.objects |= {
                (0x1400 + n, 1): 0x200 + 0x100 * n + NODE, (0x1400 + n, 2): 255,
                (0x1800 + n, 1): 0x40000180 + 0x100 * n + NODE, (0x1800 + n, 2): 255,
                (0x1600 + n, 0): 1, (0x1600 + n, 1): 0x60400010,
                (0x1A00 + n, 0): 1, (0x1A00 + n, 1): 0x60410010,
            }  # fmt: skip
            for sub in (2, 3):
                self.objects[0x1600 + n, sub] = self.objects[0x1A00 + n, sub] = 0
        self._device_name = b"SCRIPTED DRIVE"
        self._rest = b""

    # Actions of a test.

    def send(self, can_id, data):
        self._link.sendall(struct.pack("=IB3x8s", can_id, len(data), data))

    def heartbeat(self, state=None):
        self.send(0x700 + NODE, bytes([self.nmt if state is None else state]))

    def emergency(self, code, vendor=bytes(5)):
        self.send(0x80 + NODE, struct.pack("<HB5s", code, 0x81, vendor))

    def cut(self):
        self._link.shutdown(socket.SHUT_RDWR)

    def frames(self, can_id):
        return [data for i, data in self.seen if i == can_id]

    def wait_for_frame(self, can_id, data):
        """Wait for a frame, and return whether it has come."""
        return self.wait_for(lambda it: (can_id, data) in it.seen)

    def wait_for(self, condition):
        """Wait for a condition, and return whether it is true."""
        deadline = time.monotonic() + 30
        while not condition(self) and time.monotonic() < deadline:
            time.sleep(0.001)
        return condition(self)

    def stop(self):
        self._wake.send(b".")
        self.join(30)
        assert not self.is_alive()
        for end in (self._listener, self._link, self._wake, self._woken):
            if end is not None:
                end.close()
        if self.error is not None:
            raise self.error

    # Internal functions.

    def run(self):
        try:
            self._serve()
        except (BrokenPipeError, ConnectionResetError):
            pass
        except Exception as error:  # a test must see it
            self.error = error

    def _serve(self):
        if self._woken in select.select([self._listener, self._woken], [], [])[0]:
            return
        self._link, _ = self._listener.accept()
        buffer = b""
        while True:
            ready = select.select([self._link, self._woken], [], [])[0]
            if self._woken in ready:
                return
            part = self._link.recv(4096)
            if not part:
                return
            buffer += part
            while len(buffer) >= 16:
                can_id, length, data = struct.unpack("=IB3x8s", buffer[:16])
                buffer = buffer[16:]
                self.seen.append((can_id, data[:length]))
                if not self.silent:
                    self._take(can_id, data[:length])

    def _take(self, can_id, data):
        if self._off_at is not None and time.monotonic() >= self._off_at:
            self.state, self.torque, self._off_at = "switch-on disabled", 0, None
        if can_id == 0 and self.ignores_nmt:
            return
        if can_id == 0 and data[1] in (0, NODE):
            self.nmt = {1: 5, 2: 4, 128: 0x7F}[data[0]]
            if self.nmt == 4 and self.stops:
                self.state, self.torque = "switch-on disabled", 0
            if self.nmt_heartbeats:
                self.heartbeat()
        elif can_id == 0x80:
            self._sync()
        elif can_id == 0x200 + NODE and self.nmt == 5:
            assert len(data) == 4
            self.pending = struct.unpack("<Hh", data)
            if self.objects[0x1400, 2] == 255:
                self._apply()
        elif can_id == 0x600 + NODE and self.sdo_works:
            self._sdo(data)

    def _sync(self):
        self.syncs += 1
        if self.on_sync is not None:
            self.on_sync(self)
        self._apply()
        if self.syncs % self.heartbeat_every == 0:
            self.heartbeat()
        if self.nmt != 5:
            return
        if self.syncs in self.drop_at:
            return
        if self.drop:
            self.drop -= 1
            return
        if self.garble:
            self.send(0x180 + NODE, self.garble.popleft())
            return
        reply = struct.pack("<Hih", self.status(), self.position, self.torque)
        if self.short_tpdo:
            reply = reply[:6]
        if self.reply_delay_s:
            time.sleep(self.reply_delay_s)
        if self.hold:
            self.hold -= 1
            self.held.append(reply)
            return
        for late in self.held:
            self.send(0x180 + NODE, late)
            time.sleep(0.01)
        self.held = []
        self.send(0x180 + NODE, reply)

    def _apply(self):
        if self.pending is not None:
            controlword, torque = self.pending
            self.pending = None
            self._command(controlword)
            self.torque = torque if self.state == "enabled" else 0

    def _command(self, controlword):
        if not self.obeys:
            return
        rising = controlword & 0x80 and not self.control & 0x80
        self.control = controlword
        if self.state == "fault":
            if rising and not self.objects[0x603F, 0] & 1:  # an odd code remains
                self.state = "switch-on disabled"
            return
        low = controlword & 0x0F
        if self.state != self.stays_in and (self.state, low) in _UP:
            self.state = _UP[self.state, low]
            if self.state == "ready":
                self.state = self.on_ready
        elif not low & 0x02 and self.off_delay_s and self.state == "enabled":
            self._off_at = self._off_at or time.monotonic() + self.off_delay_s
        elif not low & 0x02 and "no supply" not in self.state:
            self.state, self.torque = "switch-on disabled", 0

    def status(self):
        word = _STATUS[self.state]
        return word & ~0x1000 if not self.follows else word

    def _sdo(self, data):
        command, index, sub = struct.unpack_from("<BHB", data)
        reply = struct.pack("<HB", index, sub)
        abort = self.refuse.get((index, sub))
        readable = (index, sub) in self.objects or index in (0x1008, 0x100A, 0x6041, 0x6061)
        if command >> 5 == 3:  # segment of a text
            toggle, part, self._rest = command & 0x10, self._rest[:7], self._rest[7:]
            head = toggle | (7 - len(part)) << 1 | (not self._rest)
            self.send(0x580 + NODE, bytes([head]) + part.ljust(7, b"\0"))
        elif command == 0x80:
            return
        elif abort or not readable:
            code = struct.pack("<I", abort or 0x06020000)
            self.send(0x580 + NODE, b"\x80" + reply + code)
        elif command == 0x40 and (index, sub) in self.write_only:
            self.send(0x580 + NODE, b"\x80" + reply + struct.pack("<I", 0x06010001))
        elif command == 0x40 and index in (0x1008, 0x100A):
            self._rest = self._device_name if index == 0x1008 else b"V2.10 beta"
            size = struct.pack("<I", len(self._rest))
            self.send(0x580 + NODE, b"\x41" + reply + size)
        elif command == 0x40:
            if index == 0x6041 and self.state != "enabled" and self.off_read_after < 0:
                self.off_read_after = len(self.frames(0x605))
            value = {0x6041: self.status(), 0x6061: self._mode()}.get(index)
            value = self.objects[index, sub] if value is None else value
            raw = struct.pack(self.formats.get(index) or _format(index, sub), value)
            head = 0x43 | (4 - len(raw)) << 2
            self.send(0x580 + NODE, bytes([head]) + reply + raw.ljust(4, b"\0"))
        else:
            size = 4 - (command >> 2 & 3)
            assert command & 0xE3 == 0x23, "an expedited download with its size"
            form = self.formats.get(index) or _format(index, sub)
            assert size == struct.calcsize(form), f"{index:04X} has another length"
            (value,) = struct.unpack(form, data[4 : 4 + size])
            no = (
                0x06010002
                if (index, sub) in self.read_only
                else self.refuse_value.get((index, sub))
            )
            if no:
                self.send(0x580 + NODE, b"\x80" + reply + struct.pack("<I", no))
                return
            self.writes.append((index, sub, value))
            if (index, sub) not in self.fixed:
                self.objects[index, sub] = value
            if index == 0x6040:
                self._command(value)
            self.send(0x580 + NODE, b"\x60" + reply + bytes(4))

    def _mode(self):
        enabled_only = self.mode_follows == "enabled"
        if self.mode_follows is False or (enabled_only and self.state != "enabled"):
            return 0
        return self.objects[0x6060, 0]


SETTINGS = ServoDrive(
    node_id=NODE,
    vendor_id=0x1234,
    product_code=0xABCD,
    direction=1,
    gear_ratio=100.0,
    rated_torque_unit_nm=1e-3,
    torque_delivery="at_sync",
    heartbeat_period_s=0.02,
    heartbeat_timeout_s=0.05,
    drive_heartbeat_period_s=0.02,
    drive_heartbeat_timeout_s=0.05,
    host_node_id=HOST,
    abort_option=2,
    communication_error_option=0,
    enable_timeout_s=0.05,
)


@pytest.fixture(scope="session")
def settings():
    return SETTINGS


@pytest.fixture(scope="session")
def rig():
    """In lock-step, with a wait for replies."""
    return replace(
        load_profile("sim").rig,
        name="scripted",
        can=CanBus("socketcan", "can0", 1_000_000),
        acquisition=Acquisition("same_tick", 5e5),
        cia402=SETTINGS,
    )


@pytest.fixture
def scripted(tmp_path):
    drive = ScriptedDrive(str(tmp_path / "can"))
    drive.start()
    yield drive
    drive.stop()


@pytest.fixture
def link_to(tmp_path):
    links = []

    def make(path="can"):
        address = SimulatorAddress(pid=1, control_socket="", can_socket=str(tmp_path / path))
        links.append(CanLink(CanBus("socketcan", "can0", 1_000_000), address))
        return links[-1]

    yield make
    for link in links:
        link.close()


@pytest.fixture
def make_drive(scripted, link_to):
    drives = []

    def make(rig):
        drives.append(Cia402Drive(rig, link_to()))
        return drives[-1]

    yield make
    for drive in drives:
        drive.close()


@pytest.fixture
def drive(make_drive, rig):
    return make_drive(rig)


@pytest.fixture
def impatient(monkeypatch):
    """Wait for a missing reply for no time at all."""
    monkeypatch.setattr("rigd.devices.cia402._sdo._SDO_TIMEOUT_S", 0.05)
    monkeypatch.setattr("rigd.devices.cia402._switch_off._FIRST_ANSWER_TIMEOUT_S", 0.1)
