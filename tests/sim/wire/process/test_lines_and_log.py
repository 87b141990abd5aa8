"""The serial line, the control socket, the log, and the delays that are left to simulate."""

import json
import os
import select
import socket
from dataclasses import replace
from pathlib import Path

import pytest

from rigd.devices.contracts import DeviceError
from rigd.devices.running_simulator import SimulatorAddress, ask_simulator
from rigd.profile import load_profile
from rigd.sim.wire._faults import EventLog
from rigd.sim.wire._links import PtyLine, without_transport
from rigd.sim.wire._simulator import ControlSocket

# The serial line


class Line:
    def __init__(self):
        self.handlers = {}
        self.heard = b""
        self.told = []
        self.pty = PtyLine(self.handlers, self._hear, self.told.append)
        self.port = None

    def _hear(self, data):
        self.heard += data

    def open(self):
        self.port = os.open(self.pty.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self.pty.look()

    def turn(self):
        for descriptor in select.select(self.handlers, (), (), 30.0 if self.handlers else 0)[0]:
            self.handlers[descriptor]()

    def read(self):
        select.select([self.port], (), (), 30.0)
        return os.read(self.port, 65536)

    def close(self):
        self.pty.close()
        if self.port is not None:
            os.close(self.port)


@pytest.fixture
def line():
    line = Line()
    yield line
    line.close()


def test_bytes_go_both_ways_unchanged(line):
    line.open()
    every = bytes(range(256))
    line.pty.write(every)
    assert line.read() == every
    os.write(line.port, every)
    line.turn()
    assert line.heard == every
    assert line.told == [True]


def test_an_open_line_with_nothing_on_it_keeps_nobody_busy(line):
    line.pty.look()
    assert line.handlers == {}
    line.open()
    assert select.select(line.handlers, (), (), 0)[0] == []


def test_what_is_sent_while_nobody_listens_is_lost(line):
    line.pty.write(b"nobody hears this")
    line.open()
    line.pty.write(b"this is heard")
    assert line.read() == b"this is heard"
    assert line.pty.lost == 0


def test_a_host_that_does_not_read_loses_bytes_and_nobody_waits(line):
    line.open()
    for _ in range(1000):
        line.pty.write(bytes(91))
    assert 0 < line.pty.lost < 91_000


def test_the_port_can_be_closed_and_opened_again(line):
    line.open()
    os.write(line.port, b"first")
    line.turn()
    os.close(line.port)
    line.turn()
    assert line.handlers == {}
    line.open()
    os.write(line.port, b", second")
    line.turn()
    assert line.heard == b"first, second"
    assert line.told == [True, False, True]


def test_a_cut_line_is_dead(line):
    line.open()
    line.pty.close()
    line.pty.write(b"lost")
    line.pty.look()
    assert line.handlers == {}
    assert os.read(line.port, 10) == b""


# The control socket


class Control:
    def __init__(self, path):
        self.handlers = {}
        self.asked = []
        self.socket = ControlSocket(path, self.handlers, self._answer)
        self.link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.link.connect(os.fspath(path))
        self.link.setblocking(False)
        self.turn()

    def _answer(self, request):
        self.asked.append(request)
        return {"heard": request}

    def turn(self):
        while ready := select.select(self.handlers, (), (), 0)[0]:
            for descriptor in ready:
                self.handlers[descriptor]()

    def close(self):
        self.socket.close()
        self.link.close()


@pytest.fixture
def control(tmp_path):
    control = Control(tmp_path / "control")
    yield control
    control.close()


def test_each_line_is_a_request_however_it_comes(control):
    for piece in (b'{"a": 1}\n{"b"', b": 2}", b"\n"):
        control.link.send(piece)
        control.turn()
    assert control.asked == [{"a": 1}, {"b": 2}]
    replies = control.link.recv(1000).splitlines()
    assert [json.loads(line) for line in replies] == [{"heard": {"a": 1}}, {"heard": {"b": 2}}]


@pytest.mark.parametrize("line", [b"hello\n", b"[1]\n", b"\xff\n", b"\n"])
def test_other_lines_are_refused(control, line):
    control.link.send(line)
    control.turn()
    assert "error" in json.loads(control.link.recv(1000))
    assert control.asked == []


def test_who_only_looks_whether_it_runs_does_no_harm(control):
    control.link.close()
    control.turn()
    assert len(control.handlers) == 1


def test_a_simulator_that_is_gone_is_told(tmp_path):
    address = SimulatorAddress(pid=4711, control_socket=str(tmp_path / "gone"))
    with pytest.raises(DeviceError, match="process 4711"):
        ask_simulator(address, {"status": True})


# The log


def test_every_event_is_a_line_with_its_time(tmp_path, capsys):
    path = tmp_path / "log"
    log = EventLog(path, quiet=False)
    log("drive", "state", state="operation enabled")
    log.time_s = 0.001
    log("drive", "torque", torque_nm=0.1, enabled=True)
    log.time_s = 0.002
    log("drive", "state", state="fault")
    # What matters is in the file although it is still open.
    assert [json.loads(line) for line in path.read_text().splitlines()] == [
        {"t_s": 0.0, "device": "drive", "what": "state", "state": "operation enabled"},
        {"t_s": 0.001, "device": "drive", "what": "torque", "torque_nm": 0.1, "enabled": True},
        {"t_s": 0.002, "device": "drive", "what": "state", "state": "fault"},
    ]
    log("drive", "torque", torque_nm=0.2, enabled=True)
    log.close()
    assert len(path.read_text().splitlines()) == 4
    assert capsys.readouterr().out == (
        "     0.000 s  drive: state  state operation enabled\n"
        "     0.002 s  drive: state  state fault\n"
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a disk that is always full")
def test_a_full_disk_ends_the_log_and_nothing_else(capsys):
    log = EventLog(Path("/dev/full"), quiet=False)
    for _ in range(3):
        log("drive", "state", state="fault")
    log.close()
    assert capsys.readouterr().out.count("cannot be written any more (No space left") == 1


# Delays


def test_what_the_exchange_takes_is_not_simulated_on_top():
    rig = load_profile("antenna_can").rig
    assert without_transport(rig) is rig
    late = replace(
        rig,
        acquisition=replace(rig.acquisition, mode="previous_tick"),
        encoder=replace(rig.encoder, delay_s=1.055e-3),
        sensor=replace(rig.sensor, delay_s=1.0e-3),
    )
    left = without_transport(late)
    assert left.encoder.delay_s == pytest.approx(5.5e-5)
    assert left.sensor.delay_s == pytest.approx(0.0, abs=1e-12)
    assert left.actuation == late.actuation


@pytest.mark.parametrize("device", ["encoder", "sensor"])
def test_a_profile_that_states_less_than_the_exchange_takes_is_refused(device):
    rig = load_profile("antenna_can").rig
    rig = replace(
        rig,
        acquisition=replace(rig.acquisition, mode="previous_tick"),
        encoder=replace(rig.encoder, delay_s=1.0e-3),
        sensor=replace(rig.sensor, delay_s=1.0e-3),
    )
    rig = replace(rig, **{device: replace(getattr(rig, device), delay_s=0.5e-3)})
    with pytest.raises(DeviceError, match=rf"{device}\.delay_s = 0\.0005 s"):
        without_transport(rig)
