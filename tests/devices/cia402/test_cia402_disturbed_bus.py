"""A drive on a disturbed bus, or behind an adapter with damaged lines.

The torque is off in the end.
"""

import os
import pty
import socket
import struct
import threading
import time
import tty
from contextlib import suppress
from dataclasses import replace

import pytest

from rigd.devices.canbus import CanLink
from rigd.devices.cia402 import Cia402Drive
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import Acquisition, CanBus

RATE_HZ = 50.0


class SlcanAdapter:
    """A pseudo-terminal that speaks slcan on one side and the scripted drive's frames on the other.

    `garbage` is sent once, as it is, before the next frame of the drive.
    """

    def __init__(self, path):
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave = slave
        self._link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._link.connect(path)
        self.garbage = b""
        self._threads = [
            threading.Thread(target=self._from_host, daemon=True),
            threading.Thread(target=self._from_drive, daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def _from_host(self):
        buffer = b""
        while part := self._read():
            buffer += part
            *lines, buffer = buffer.split(b"\r")
            for line in lines:
                if line[:1] == b"t":
                    length = int(line[4:5])
                    data = bytes.fromhex(line[5 : 5 + 2 * length].decode())
                    with suppress(OSError):  # at the end of a test the drive has gone
                        self._link.sendall(struct.pack("=IB3x8s", int(line[1:4], 16), length, data))

    def _read(self):
        try:
            return os.read(self._master, 4096)
        except OSError:
            return b""

    def _from_drive(self):
        try:
            while True:
                raw = self._link.recv(16, socket.MSG_WAITALL)
                if len(raw) < 16:
                    return
                can_id, length, data = struct.unpack("=IB3x8s", raw)
                garbage, self.garbage = self.garbage, b""
                line = f"t{can_id:03X}{length}{data[:length].hex().upper()}\r"
                os.write(self._master, garbage + line.encode())
        except OSError:
            return

    def close(self):
        self._link.shutdown(socket.SHUT_RDWR)
        os.close(self._slave)
        os.close(self._master)
        self._link.close()


@pytest.fixture
def adapter(scripted, tmp_path):
    made = SlcanAdapter(str(tmp_path / "can"))
    yield made
    made.close()


@pytest.fixture
def behind_adapter(adapter, rig, settings):
    slow = replace(
        settings,
        heartbeat_timeout_s=0.5,
        drive_heartbeat_timeout_s=5.0,
        enable_timeout_s=2.0,
    )
    rig = replace(
        rig,
        rate_hz=RATE_HZ,
        can=CanBus("slcan", adapter.port, 1_000_000),
        acquisition=Acquisition("same_tick", 16000.0),
        cia402=slow,
    )
    made = Cia402Drive(rig, CanLink(rig.can, None))
    yield made
    made.close()


def ticks(drive, count):
    due_ns = time.monotonic_ns()
    for _ in range(count):
        due_ns += int(1e9 / RATE_HZ)
        time.sleep(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9))
        drive.latch(due_ns)
        drive.read_angle()
        drive.command(0.2)


def test_unreadable_lines(behind_adapter, adapter, scripted):
    drive = behind_adapter
    drive.connect()
    drive.enable()
    ticks(drive, 5)
    assert scripted.wait_for(lambda it: it.torque > 0)
    before = drive.health().errors
    adapter.garbage = b"tZZZ812\r"  # one of them is an error on the line, and the loop goes on
    ticks(drive, 5)
    assert drive.health().errors > before
    assert scripted.state == "enabled"

    adapter.garbage = b"tZZZ812\r" * 60
    with pytest.raises(DeviceError) as failure:
        ticks(drive, 20)
    assert "(slcan)" in str(failure.value)
    assert "ValueError" in str(failure.value)
    assert scripted.torque > 0
    drive.disable()
    assert (scripted.state, scripted.torque) == ("switch-on disabled", 0)
    assert drive.off_doubt == ""


def test_endless_lines_do_not_prevent_switching_off(behind_adapter, adapter, scripted):
    drive = behind_adapter
    drive.connect()
    drive.enable()
    ticks(drive, 5)

    class AlwaysDamaged:
        """Behaves like python-can with an adapter that sends only unreadable lines."""

        def __init__(self, bus):
            self._bus = bus

        def recv(self, timeout):
            self._bus.recv(timeout)
            raise ValueError("non-hexadecimal number found in fromhex() arg at position 4")

        def __getattr__(self, name):
            return getattr(self._bus, name)

    port = drive._link.exchange.port
    port._bus = AlwaysDamaged(port._bus)
    with pytest.raises(DeviceError, match=r"20 invalid CAN frames in a row \(ValueError: non-hex"):
        ticks(drive, 100)
    drive.disable()
    assert scripted.wait_for(lambda it: it.torque == 0)
    assert scripted.state == "switch-on disabled"
    assert "does not show that it is off" in drive.off_doubt


@pytest.mark.parametrize("report", [(0x020, bytes(8)), (0x004, b"\0\x10" + bytes(6))])
def test_an_error_passive_controller_sends_the_sync_of_zero_torque(drive, scripted, report):
    drive.connect()
    drive.enable()
    ticks(drive, 3)
    kind, data = report
    scripted.send(0x2000_0000 | kind, data)
    with pytest.raises(DeviceError, match=r"error-passive|no device acknowledges"):
        ticks(drive, 100)
    writes, syncs = len(scripted.writes), scripted.syncs
    drive.disable()
    assert (scripted.state, scripted.torque) == ("switch-on disabled", 0)
    assert scripted.syncs > syncs
    assert scripted.writes[writes:] == []  # it did not take the SDO, which comes 50 ms later
    assert drive.off_doubt == ""
