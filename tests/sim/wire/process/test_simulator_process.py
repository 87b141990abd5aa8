"""``rigd simulate`` and ``rigd inject`` as an operator runs them; the host packs bytes by hand."""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest
import serial
import warm_start
from cases import further

from rigd.devices.contracts import DeviceError
from rigd.devices.running_simulator import SimulatorAddress, ask_simulator, find_simulator
from rigd.sim.wire import WrongUseError, parse_fault

pytestmark = pytest.mark.process

RIGD = Path(sys.executable).parent / "rigd"
START_S = 60.0


def rigd(*arguments):
    return warm_start.run([RIGD, *arguments], capture_output=True, text=True, timeout=300)


class Simulator:
    """A running ``rigd simulate``."""

    def __init__(self, folder, profile="antenna_can", *options):
        self.profile = profile
        number = len(list(folder.glob("*.jsonl")))
        self.log = folder / f"{profile}-{number}.jsonl"
        self.process = warm_start.start(
            [RIGD, "simulate", "--profile", profile, "--log", self.log, *map(str, options)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.address = None
        give_up = time.monotonic() + START_S
        while self.address is None and self.process.poll() is None:
            assert time.monotonic() < give_up
            time.sleep(0.01)
            self.address = find_simulator(profile)

    def end(self, how=signal.SIGTERM):
        """Returns exit code, standard output and standard error."""
        if self.process.poll() is None:
            self.process.send_signal(how)
        out, err = self.process.communicate(timeout=30)
        return self.process.returncode, out, err

    def events(self, device=None, what=None):
        whole, _, _ = self.log.read_text().rpartition("\n")  # it may be writing the next line
        entries = [json.loads(line) for line in whole.splitlines()]
        return [
            entry
            for entry in entries
            if device in (None, entry["device"]) and what in (None, entry["what"])
        ]

    def wait_for(self, device, what, **values):
        give_up = time.monotonic() + START_S
        while time.monotonic() < give_up:
            for entry in self.events(device, what):
                if entry.items() >= values.items():
                    return entry
            time.sleep(0.02)
        raise AssertionError(f"{device}: {what} {values} has not happened: {self.events()}")


class Host:
    """A master with a few fixed frames."""

    def __init__(self, path):
        self.link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self.link.connect(path)
        except OSError:
            self.link.close()
            raise
        self.link.settimeout(30.0)

    def send(self, *frames):
        self.link.sendall(
            b"".join(struct.pack("=IB3x8s", can_id, len(data), data) for can_id, data in frames)
        )

    def receive(self, *wanted):
        """Return identifier and data of the next of these frames."""
        while True:
            raw = self.link.recv(16, socket.MSG_WAITALL)
            if not raw:
                raise ConnectionError
            can_id, length, data = struct.unpack("=IB3x8s", raw)
            if can_id in wanted:
                return can_id, data[:length]

    def write(self, index, sub, value, size):
        command = {1: 0x2F, 2: 0x2B, 4: 0x23}[size]
        data = struct.pack("<BHB", command, index, sub) + value.to_bytes(size, "little")
        self.send((0x601, data.ljust(8, b"\0")))
        _, reply = self.receive(0x581)
        assert reply[0] == 0x60, (hex(index), sub, reply.hex())

    def set_up(self, heartbeat_ms=50):
        """TPDO1: statusword, position, torque; RPDO1: controlword, torque; both at SYNC."""
        for record, mapping, can_id, entries in (
            (0x1800, 0x1A00, 0x181, (0x60410010, 0x60640020, 0x60770010)),
            (0x1400, 0x1600, 0x201, (0x60400010, 0x60710010)),
        ):
            self.write(record, 1, 0x8000_0000 | can_id, 4)
            self.write(mapping, 0, 0, 1)
            for sub, entry in enumerate(entries, 1):
                self.write(mapping, sub, entry, 4)
            self.write(mapping, 0, len(entries), 1)
            self.write(record, 2, 1, 1)
            self.write(record, 1, can_id, 4)
        self.write(0x1016, 1, 127 << 16 | heartbeat_ms, 4)
        self.write(0x6060, 0, 10, 1)
        self.send((0x000, b"\x01\x01"), (0x77F, b"\x05"))

    def tick(self, controlword=None, torque=0):
        """One exchange: SYNC, its TPDO, then the RPDO for the next; returns the TPDO."""
        self.send((0x080, b""))
        _, data = self.receive(0x181)
        if controlword is not None:
            self.send((0x201, struct.pack("<Hh", controlword, torque)))
        return struct.unpack("<HiH", data)

    def enable(self):
        for word in (0x06, 0x07, 0x0F):
            self.tick(word)
        for _ in range(3):
            status, *_ = self.tick(0x0F)
        assert status & 0x6F == 0x27

    def close(self):
        self.link.close()


@pytest.fixture
def runtime(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    folder.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    return folder / "rigd"


@pytest.fixture
def simulate(tmp_path, runtime):
    started = []

    def start(*arguments):
        started.append(Simulator(tmp_path, *arguments))
        return started[-1]

    yield start
    for simulator in started:
        simulator.process.kill()
        simulator.process.communicate()


@pytest.fixture
def connect():
    hosts = []

    def connect(simulator):
        hosts.append(Host(simulator.address.can_socket))
        return hosts[-1]

    yield connect
    for host in hosts:
        host.close()


@pytest.mark.parametrize("how", [signal.SIGTERM, further(signal.SIGINT)])
def test_the_simulator_prints_its_address_and_cleans_up(simulate, runtime, how):
    simulator = simulate()
    address = simulator.address
    assert address.pid == simulator.process.pid
    code, out, err = simulator.end(how)
    assert (code, err) == (0, "")
    assert address.can_socket in out
    assert "rigd run chirp --profile antenna_can\n" in out
    assert [path.name for path in runtime.iterdir()] == ["antenna_can.lock"]
    assert simulator.events()[-1]["what"] == "ended"


def test_no_output_with_quiet(simulate):
    assert simulate("antenna_can", "--quiet").end() == (0, "", "")


def test_one_simulator_for_each_rig(simulate):
    first = simulate()
    second = rigd("simulate", "--profile", "antenna_can")
    assert second.returncode == 1
    assert f"is already running (process {first.process.pid})" in second.stderr
    assert first.process.poll() is None
    assert simulate("antenna_serial").address is not None


def test_a_killed_simulator_does_not_prevent_the_next(simulate, connect):
    first = simulate()
    first.end(signal.SIGKILL)
    assert find_simulator("antenna_can") is None
    again = simulate()
    assert again.address.pid == again.process.pid
    connect(again).set_up()


def test_a_host_drives_the_motor(simulate, connect):
    simulator = simulate("antenna_can", "--lock-step")
    host = connect(simulator)
    host.set_up()
    host.enable()
    start = host.tick()[1]
    for _ in range(100):
        host.send((0x77F, b"\x05"))
        _, counts, per_mille = host.tick(0x0F, 400)
    assert per_mille == 400
    # 0.2 N·m less 0.03 of friction on some 2 to 3 g·m² for 0.1 s.
    assert 0.1 < (counts - start) * 7e-5 < 0.5
    # Important entries are in the file although it is open; the others come at the end.
    (enabled,) = simulator.events("drive", "state")[-1:]
    assert enabled["state"] == "operation enabled"
    _, out, _ = simulator.end()
    torques = simulator.events("drive", "torque")
    assert {"torque_nm": 0.2, "enabled": True}.items() <= torques[-1].items()
    assert torques[-1]["t_s"] > enabled["t_s"] > 0
    assert f"{enabled['t_s']:10.3f} s  drive: state  state operation enabled\n" in out
    assert "torque" not in out.partition("rigd inject")[2]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a disk that is always full")
def test_a_full_disk_ends_the_log_only(simulate, connect):
    simulator = simulate("antenna_can", "--lock-step", "--log", "/dev/full")
    connect(simulator).set_up()
    assert ask_simulator(simulator.address, {"status": True})["clients"] == 1
    code, out, _ = simulator.end()
    assert code == 0
    assert out.count("cannot be written any more (No space left") == 1


def test_requests_are_lines_between_other_data(simulate):
    address = simulate().address

    def control():
        link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        link.connect(address.control_socket)
        link.settimeout(30.0)
        return link

    control().close()  # only tests whether it runs
    with control() as link, link.makefile("rb") as replies:
        for chunk in (b'{"status": true}\n{"inj', b'ect": "nonsense"}', b"\n"):
            link.sendall(chunk)
            time.sleep(0.02)
        assert json.loads(replies.readline())["rig"] == "antenna_can"
        assert "unknown fault" in json.loads(replies.readline())["error"]
        for line in (b"hello\n", b"[1]\n", b"\xff\n", b"\n"):
            link.sendall(line)
            assert "one JSON object" in json.loads(replies.readline())["error"]
        link.sendall(b'{"status": true}\n')
        assert json.loads(replies.readline())["rig"] == "antenna_can"


def test_a_missing_simulator_is_an_error(tmp_path):
    address = SimulatorAddress(pid=4711, control_socket=str(tmp_path / "gone"))
    with pytest.raises(DeviceError, match="process 4711"):
        ask_simulator(address, {"status": True})


@pytest.mark.further  # as test_lock_step.py
def test_lock_step_is_reproducible(simulate, connect):
    logs, replies = [], []
    for pause_s in (0.0, 0.002):
        simulator = simulate("antenna_can", "--lock-step", "--seed", "1")
        host = connect(simulator)
        host.set_up()
        host.enable()
        replies_of_host = []
        for tick in range(150):
            time.sleep(pause_s)
            host.send((0x680, b""), (0x77F, b"\x05"))
            replies_of_host.append(host.receive(0x680)[1] + host.receive(0x681)[1])
            replies_of_host.append(host.tick(0x0F, 300 if tick < 60 else -100))
        host.tick(0x00)
        host.tick()
        simulator.end()
        replies.append(replies_of_host)
        torques = simulator.events("drive", "torque")
        since = torques[0]["t_s"]
        logs.append([(round(e["t_s"] - since, 6), e["torque_nm"], e["enabled"]) for e in torques])
    assert replies[0] == replies[1]
    assert logs[0] == logs[1]
    assert [(torque, on) for _, torque, on in logs[0]] == [
        (0.0, True),
        (pytest.approx(0.15), True),
        (pytest.approx(-0.05), True),
        (0.0, False),
    ]


@pytest.mark.parametrize("options", [(), ("--lock-step",)])
def test_a_drive_switches_off_without_its_host(simulate, connect, options):
    simulator = simulate("antenna_can", *options)
    host = connect(simulator)
    host.set_up(50 if options else 1000)  # by the clock, the computer may pause
    host.enable()
    for _ in range(5):
        host.send((0x77F, b"\x05"))
        host.tick(0x0F, 300)
        time.sleep(0.0 if options else 0.001)
    host.close()
    off = simulator.wait_for("drive", "torque", torque_nm=0.0, enabled=False)
    pushed = simulator.events("drive", "torque")
    last = max(e["t_s"] for e in pushed if e["torque_nm"])
    if options:
        assert off["t_s"] - last < 0.08
    assert simulator.process.poll() is None


def test_time_passes_by_the_wall_clock(simulate, connect):
    simulator = simulate()
    before = simulator.events("simulator", "started")[0]
    time.sleep(0.3)
    simulator.end()
    ended = simulator.events("simulator", "ended")[0]
    assert "monotonic_ns" in before
    assert ended["t_s"] >= 0.3


def test_faults_are_injected_while_it_runs(simulate, connect, rigd_here):
    simulator = simulate("antenna_can", "--lock-step", "--fault", "drop,from=drive,frames=2@0")
    host = connect(simulator)
    done = rigd("inject", "--profile", "antenna_can", "jump,counts=-500", "drop,from=host,id=0x77f")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "jump,counts=-500\ndrop,from=host,id=0x77f,frames=1\n"
    wrong = rigd_here("inject", "--profile", "antenna_can", "dorp")
    assert wrong.returncode == 2
    assert "unknown fault 'dorp'; choose drop" in wrong.stderr
    standing = rigd_here("inject", "--profile", "antenna_can")
    assert "clients: 1\n" in standing.stdout
    assert "disturbed: ['host']\n" in standing.stdout
    host.set_up()
    assert host.tick()[1] == -500
    for word in (0x06, 0x07, 0x0F):
        host.tick(word)
    host.send((0x080, b""), (0x080, b""), (0x080, b""))
    host.receive(0x181)  # of the SYNC that enabled it, or the one after the two lost
    simulator.end()
    dropped = simulator.events("simulator", "drop")
    assert [entry["can_id"] for entry in dropped] == [0x77F, 0x181, 0x181]
    assert [entry["fault"] for entry in simulator.events("simulator", "fault")] == [
        "jump,counts=-500",
        "drop,from=host,id=0x77f,frames=1",
        "drop,from=drive,frames=2@0.0",
    ]


@pytest.mark.further  # as test_world.py
def test_obstacles_from_the_start_and_later(simulate, rigd_here):
    simulate("antenna_can", "--lock-step", "--obstacle", "x=0.6,angle=0.3")
    address = find_simulator("antenna_can")
    assert address.rig["simulation.obstacles"] == ["x=0.6,angle=0.3"]
    done = rigd_here("inject", "--profile", "antenna_can", "obstacle,x=0.4,angle=0.2,for=2")
    assert (done.returncode, done.stdout) == (0, "obstacle,x=0.4,angle=0.2,for=2.0\n")
    lasting = rigd_here("inject", "--profile", "antenna_can", "obstacle,x=0.4,angle=0.2")
    assert lasting.stdout.endswith("end,fault=obstacle\n")
    wrong = rigd_here("inject", "--profile", "antenna_can", "obstacle,x=1.4,angle=0.2")
    assert wrong.returncode in (1, 2)
    assert "beyond the tip of the beam" in wrong.stderr


def test_a_cut_bus_stays_cut(simulate, connect, rigd_here):
    simulator = simulate()
    host = connect(simulator)
    done = rigd_here("inject", "--profile", "antenna_can", "cut")
    end = "rigd inject --profile antenna_can end,fault=cut"
    assert (done.returncode, done.stdout) == (0, f"cut,device=bus; it lasts until: {end}\n")
    with pytest.raises(ConnectionError):
        host.receive(0x181)
    with pytest.raises(OSError, match=r"No such file|refused"):
        connect(simulator)
    assert find_simulator("antenna_can") is not None


def test_the_serial_sensor_streams_with_the_periods(simulate, connect, rigd_here):
    simulator = simulate("antenna_serial", "--lock-step")
    host = connect(simulator)
    with serial.Serial(simulator.address.serial_port, 1_250_000, parity="E", timeout=30.0) as line:
        line.write(bytes.fromhex("0A4655A39D"))
        assert line.read(5).hex() == "0a4601a262"
        host.set_up()
        for _ in range(3):
            host.tick()
        simulator.wait_for("sensor", "stream started")
        before = line.in_waiting
        for _ in range(4):
            host.tick()
        stream = line.read(before + 4 * 7 * 13)
        for at in range(0, len(stream), 13):
            record = stream[at : at + 13]
            assert record[12] == sum(record[:12]) & 0x7F
        cut = rigd_here("inject", "--profile", "antenna_serial", "cut,device=sensor")
        assert cut.returncode == 0
        with pytest.raises(serial.SerialException):
            line.read(1)
    simulator.end()
    assert simulator.events("line", "port opened")


def test_long_folder_names_get_short_sockets(simulate, connect, runtime, tmp_path, monkeypatch):
    folder = tmp_path / ("x" * 100)
    folder.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    simulator = simulate()
    connect(simulator).set_up()
    sockets = Path(simulator.address.can_socket).parent
    assert len(os.fsencode(simulator.address.control_socket)) < 108
    assert simulator.end()[0] == 0
    assert not sockets.exists()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("simulate", "--profile", "sim"), 2, "no bus messages"),
        (("inject", "--profile", "sim", "sto"), 2, "Use a profile of a rig with a bus"),
        (("simulate", "--profile", ""), 2, "No profile is named; known profiles are"),
        (("simulate", "--profile", "nothing"), 2, "There is no profile 'nothing'"),
        (("simulate", "--profile", "antenna_can", "--fault", "cut@x"), 2, "'@x'"),
        (
            ("simulate", "--profile", "antenna_can", "--fault", "cut,device=sensor"),
            2,
            "no serial line",
        ),
        (("simulate", "--profile", "antenna_can", "--log", "/nowhere/log"), 1, "cannot be written"),
        (("inject", "--profile", "antenna_can", "cut"), 1, "start it with: rigd simulate"),
        (("simulate", "--profile", "antenna_can", "--obstacle", "x=2,angle=1"), 2, "the tip"),
        (("simulate", "--profile", "antenna_can", "--fault", "knock,x=1"), 2, "needs force"),
    ],
)
def test_wrong_use_is_refused_in_a_sentence(runtime, rigd_here, arguments, code, message):
    done = rigd_here(*arguments)
    assert done.returncode == code
    assert done.stderr.startswith("Error: ")
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert find_simulator("antenna_can") is None


def test_a_log_replaces_no_other_file(simulate, runtime, rigd_here, tmp_path):
    session = tmp_path / "session.mcap"
    session.write_bytes(b"two minutes of the rig")
    nowhere = tmp_path / "link"
    nowhere.symlink_to("gone")
    for taken in (session, nowhere):
        done = rigd_here("simulate", "--profile", "antenna_can", "--log", taken)
        assert done.returncode == 2
        assert f"--log {taken} exists; choose another name or move it away" in done.stderr
    assert session.read_bytes() == b"two minutes of the rig"
    before = simulate()
    before.end()
    content = before.log.read_bytes()
    assert content
    assert rigd_here("simulate", "--profile", "antenna_can", "--log", before.log).returncode == 2
    assert before.log.read_bytes() == content


def test_no_log_of_a_rig_that_did_not_start(runtime, rigd_here, tmp_path):
    faults = ("--fault", "sto", "--fault", "cut,device=sensor")
    arguments = ("simulate", "--profile", "antenna_can", "--log", tmp_path / "log", *faults)
    assert rigd_here(*arguments).returncode == 2
    assert not (tmp_path / "log").exists()


def test_the_help_names_every_fault(rigd_here):
    with pytest.raises(WrongUseError) as refused:
        parse_fault("none")
    kinds = str(refused.value).partition("choose ")[2].rstrip(".").split(", ")
    shown = rigd_here("inject", "--help").stdout
    assert all(f"{kind}," in shown or f"{kind}[" in shown for kind in kinds)


def test_noise_differs_unless_a_seed_is_stated(simulate):
    def seeds(*options):
        simulator = simulate("antenna_can", "--lock-step", *options)
        found = [
            ask_simulator(simulator.address, {"renew_noise": seed})["seed"]
            for seed in (None, None, 12)
        ]
        with pytest.raises(DeviceError, match="whole number"):
            ask_simulator(simulator.address, {"renew_noise": "12"})
        assert simulator.end()[0] == 0
        return found

    stated, fresh = seeds("--seed", "7"), seeds()
    assert (stated[0], stated[2]) == (7, 12)
    assert len({*stated, *fresh}) == 5
