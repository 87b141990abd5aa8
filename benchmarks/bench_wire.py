"""Cost of the exchange with the devices in each tick of the loop, against plain sockets.

A simulated rig answers from another process. In alternating blocks of 250 ticks at 1 kHz, our
drivers and a plain loop of socket and struct do the same exchange with the same devices on the same
sockets: SYNC, RPDO and TPDO with the drive, request and two replies (or seven records) with the
sensor, and the values in N, N·m and rad. Between request and replies both sleep, so that no time is
spent waiting for the other process: only the work before and after is measured. The first ticks of
a block, which find replies to the other loop, do not count.
"""

import argparse
import os
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from gate import Gate, Row

from rigd.devices.ati import AtiCanSensor, AtiSerialSensor
from rigd.devices.canbus import CanExchange
from rigd.devices.canbus.adapters import SocketPort
from rigd.devices.cia402 import Cia402Drive
from rigd.devices.contracts import DeviceError, Wrench, WrenchSensor
from rigd.devices.running_simulator import SimulatorAddress, find_simulator
from rigd.engine.realtime import apply_realtime, disable_garbage_collection
from rigd.profile import load_profile

BLOCKS, TICKS, SETTLING = 20, 250, 20
PERIOD_NS = 1_000_000
PAUSE_S = 600e-6
TRIES = 5
"""A stall of this computer ends the exchange: the simulated drive misses its SYNC."""
ROWS = (
    # Measured 1.5 to 1.8 and 1.9: docs/validation/architecture.md.
    Row("antenna_can, median", most=2.5, unit="times a bare loop"),
    Row("antenna_serial, median", most=2.5, unit="times a bare loop"),
)
Exchange = tuple[Callable[[int], None], Callable[[], None]]
"""Functions that send the requests, and take the replies received."""


class OpenLink:
    """A link on a socket that the plain loop uses too."""

    def __init__(self, link: socket.socket) -> None:
        self.exchange = CanExchange(SocketPort(link, "benchmark"))

    def open(self) -> CanExchange:
        """Return the exchange."""
        return self.exchange

    def close(self) -> None:
        """Do nothing: the benchmark closes the socket."""


def ours(drive: Cia402Drive, sensor: WrenchSensor) -> Exchange:
    """Return the exchange of a tick by our drivers."""

    def ask(due_ns: int) -> None:
        drive.latch(due_ns)
        sensor.request(due_ns)

    def take() -> None:
        drive.read_angle()
        sensor.read_wrench()
        drive.command(0.0)

    return ask, take


class Bare:
    """Least implementation of the protocols: no checks, no routing beyond the identifier."""

    def __init__(self, link: socket.socket, calibration: dict, resolution_rad: float) -> None:
        frame = struct.Struct("=IB3x8s")
        self.link = link
        self.sync = frame.pack(0x80, 0, b"")
        self.request = frame.pack(calibration.get("base_id", 0) << 4, 0, b"")
        self.ids = (
            self.request[:4],
            frame.pack((calibration.get("base_id", 0) << 4) + 1, 0, b"")[:4],
        )
        self.rpdo = struct.Struct("=IB3xHh4x")
        self.tpdo = struct.Struct("<Hih").unpack_from
        self.heartbeat = frame.pack(0x77F, 1, b"\x05")
        counts = [calibration["counts_per_force"]] * 3 + [calibration["counts_per_torque"]] * 3
        matrix = np.array(calibration["matrix"]) / np.array(counts)[:, None]
        self.rows = [tuple(row) for row in matrix.tolist()]
        self.step = resolution_rad
        self.ticks = 0
        self.angle_rad = 0.0
        self.wrench: Wrench = (0.0,) * 6

    def ask_drive(self, due_ns: int) -> None:  # noqa: ARG002
        """Send requests to the drive; the sensor on the serial line needs none."""
        self.link.send(self.sync)

    def ask_both(self, due_ns: int) -> None:  # noqa: ARG002
        """Send requests to the drive and the sensor on the bus."""
        self.link.send(self.sync)
        self.link.send(self.request)

    def _frames(self) -> dict[bytes, bytes]:
        link = self.link
        self.ticks += 1
        if self.ticks % 10 == 0:
            link.send(self.heartbeat)
        found = {}
        while True:
            try:
                raw = link.recv(16)
            except BlockingIOError:
                break
            found[raw[:4]] = raw
        return found

    def take_can(self) -> None:
        """Take the replies of drive and sensor on the bus, and command a torque."""
        found = self._frames()
        for key, raw in found.items():
            if key == b"\x81\x01\0\0":
                self.angle_rad = self.tpdo(raw, 8)[1] * self.step
        first, second = found.get(self.ids[0]), found.get(self.ids[1])
        if first and second:
            _, g0, g2, g4 = struct.unpack_from(">Hhhh", first, 8)
            g1, g3, g5 = struct.unpack_from(">hhh", second, 8)
            self.wrench = tuple(
                a * g0 + b * g1 + c * g2 + d * g3 + e * g4 + f * g5
                for a, b, c, d, e, f in self.rows
            )
        self.link.send(self.rpdo.pack(0x201, 4, 0x0F, 0))

    def take_serial(self) -> None:
        """Take the drive's reply and the records on `self.port`, and command a torque."""
        found = self._frames()
        raw = found.get(b"\x81\x01\0\0")
        if raw:
            self.angle_rad = self.tpdo(raw, 8)[1] * self.step
        try:
            data = os.read(self.port, 4096)
        except BlockingIOError:
            data = b""
        n = len(data) // 13
        if n and all(sum(data[at : at + 12]) & 127 == data[at + 12] for at in range(0, 13 * n, 13)):
            gauges = struct.unpack_from(">" + "6hx" * n, data)
            g0, g2, g4, g1, g3, g5 = (sum(gauges[i::6]) / n for i in range(6))
            self.wrench = tuple(
                a * g0 + b * g1 + c * g2 + d * g3 + e * g4 + f * g5
                for a, b, c, d, e, f in self.rows
            )
        self.link.send(self.rpdo.pack(0x201, 4, 0x0F, 0))

    port = -1


def alternate(exchanges: dict[str, Exchange]) -> dict[str, list[int]]:
    """Run alternating blocks at 1 kHz; return the times per tick of each exchange, in ns."""
    times: dict[str, list[int]] = {name: [] for name in exchanges}
    due_ns = time.monotonic_ns() + 2 * PERIOD_NS
    for _ in range(BLOCKS):
        for name, (ask, take) in exchanges.items():
            for index in range(TICKS):
                time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
                start = time.perf_counter_ns()
                ask(due_ns)
                spent = time.perf_counter_ns() - start
                time.sleep(PAUSE_S)
                start = time.perf_counter_ns()
                take()
                spent += time.perf_counter_ns() - start
                if index >= SETTLING:
                    times[name].append(spent)
                due_ns += PERIOD_NS
                if time.monotonic_ns() > due_ns:
                    due_ns = time.monotonic_ns()
    return times


def compare(profile_name: str) -> dict[str, list[int]]:
    """Set up the drivers on a simulated rig, run, and return the times of ticks in ns."""
    profile = load_profile(profile_name)
    rig = replace(
        profile.rig,
        # A stall of this computer must not end the comparison.
        cia402=replace(profile.rig.cia402, heartbeat_timeout_s=5.0, drive_heartbeat_timeout_s=5.0),
    )
    command = [Path(sys.executable).parent / "rigd", "simulate", "--profile", profile_name]
    simulator = subprocess.Popen([*command, "--quiet"])
    try:
        address = wait_for(rig.name)
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
            link.connect(address.can_socket)
            opened = OpenLink(link)
            drive = Cia402Drive(rig, opened)
            sensor = AtiCanSensor(rig, opened) if rig.ati_can else AtiSerialSensor(rig, address)
            drive.connect()
            sensor.connect()
            bare = Bare(link, sensor.calibration(), rig.encoder.resolution_rad)
            exchange: Exchange = bare.ask_both, bare.take_can
            if rig.ati_serial:
                bare.port = os.open(address.serial_port, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY)
                exchange = bare.ask_drive, bare.take_serial
            drive.enable()
            times = alternate({"rigd": ours(drive, sensor), "bare": exchange})
            drive.close()
            sensor.close()
            return times
    finally:
        simulator.terminate()
        simulator.wait()


def wait_for(name: str) -> SimulatorAddress:
    """Return the address of a simulated rig as soon as it answers."""
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline:
        address = find_simulator(name)
        if address is not None:
            return address
        time.sleep(0.05)
    raise SystemExit("The simulated rig does not start.")


def ratio(name: str, times: dict[str, list[int]]) -> float:
    """Print median and p99 of both, and return the ratio of the medians."""
    figures = {
        who: (statistics.median(values) / 1e3, statistics.quantiles(values, n=100)[98] / 1e3)
        for who, values in times.items()
    }
    (median, p99), (bare_median, bare_p99) = figures["rigd"], figures["bare"]
    print(
        f"{name:15s} rigd {median:6.1f} µs (p99 {p99:6.1f})   bare {bare_median:6.1f} µs "
        f"(p99 {bare_p99:6.1f})   ratio of the p99 {p99 / bare_p99:.2f}"
    )
    return median / bare_median


def main() -> None:
    """Compare with both sensors, and check the limits."""
    gate = Gate(ROWS, argparse.ArgumentParser(description=__doc__))
    with tempfile.TemporaryDirectory(prefix="rigd-") as folder:
        os.environ["XDG_RUNTIME_DIR"] = folder
        disable_garbage_collection()
        apply_realtime(priority=80, cpu=-1)
        for name in ("antenna_can", "antenna_serial"):
            for _ in range(TRIES):
                try:
                    times = compare(name)
                except DeviceError as error:
                    print(f"{name}: once more, for {error}")
                else:
                    gate.measured(f"{name}, median", ratio(name, times))
                    break
    gate.finish()


if __name__ == "__main__":
    main()
