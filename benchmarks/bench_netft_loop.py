"""Cost of the Net F/T box for the control loop: lateness, work per tick, and processor time.

    python benchmarks/bench_netft_loop.py [SECONDS] [ROUNDS]

A simulated box streams 7000 records a second from a separate process, on cores that the loop does
not use. Each round runs four whole real-time sessions of the simulated rig, in changing order: with
its own sensor; the same while the box streams to a socket that nobody reads, to measure the
disturbance by the box itself; with the driver of the box as the sensor; and with the driver and the
box that it simulates in its process. Ratios are taken within a round, and their median counts,
because other programs disturb single rounds. With 5 s and 4 rounds it takes two minutes; published
figures are of 10 s and 20 rounds.
"""

import argparse
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from gate import Gate, Row
from loop_rounds import in_turn, lateness_ratio, median_difference, median_work_us, show
from rigd_netft.protocol import STOP_REQUEST, STREAM_REQUEST
from rigd_netft.settings import NetFtSettings

from rigd.bench import _loops as loops
from rigd.bench import cores_without_loop
from rigd.bench.measure import LoopMeasurement
from rigd.checks.machine import granted_realtime_settings
from rigd.profile import Profile, load_profile
from rigd.runtime.background import use_one_thread

RATE_HZ = 1000.0
ALONE, STREAMING, READ, SIMULATED = "no box", "box not read", "box read", "box simulated"
ROWS = (
    # Measured 0.98, 3.1 % and 30 µs on a quiet computer (plugins/rigd-netft/README.md); medians of
    # few rounds scatter by a tenth.
    Row("lateness p99, box read", most=1.25, unit="times no box"),
    Row("CPU, box read", most=4.5, unit="% of a core more than without"),
    Row("work of a tick, box read", most=50, unit="µs more than without"),
)
BOX = """
import os, random, sys
from loopback_netft import UdpBox
from rigd_netft.box import SimulatedBox
os.sched_setaffinity(0, {int(core) for core in sys.argv[1].split(",")})
try:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(30))
except OSError:
    pass
box = UdpBox(SimulatedBox(lambda: tuple(random.gauss(0.0, 0.005) for _ in range(6))))
print(box.port, flush=True)
box.stream(lambda: False, 1 / 7000)
"""
"""Program of the box, with a priority that makes it stream as evenly as a separate device."""
PACKAGE = """
from dataclasses import replace
from rigd_netft.kind import NETFT
from rigd_netft.sensor import NetFtSensor
from rigd_netft.settings import NetFtSettings

def open_sensor(rig, opened):
    return NetFtSensor(rig, rig.settings_of(NetFtSettings))

DEVICE = replace(NETFT, name="distant_netft", open_sensor=open_sensor, contradictions=None)
"""
"""Package with the driver of a box in another process, to be used with the simulated drive."""


def install(folder: Path) -> None:
    """Install the package for this process and its children."""
    metadata = folder / "distant_netft-1.dist-info"
    metadata.mkdir()
    (folder / "distant_netft.py").write_text(PACKAGE)
    (metadata / "METADATA").write_text("Name: distant-netft\nVersion: 1\n")
    (metadata / "entry_points.txt").write_text(
        "[rigd.devices]\ndistant_netft = distant_netft:DEVICE\n"
    )
    sys.path.insert(0, str(folder))
    os.environ["PYTHONPATH"] = str(folder)


@contextmanager
def box(cores: set[int]) -> Iterator[int]:
    """Run the box in this context, and yield its port."""
    command = [sys.executable, "-c", BOX, ",".join(map(str, cores))]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parent
    ) as process:
        try:
            assert process.stdout is not None
            yield int(process.stdout.readline())
        finally:
            process.kill()


def measure(name: str, seconds: float, cores: set[int]) -> LoopMeasurement:
    """Measure the loop in one session."""
    plain = loops.simulated_profile(load_profile("sim"), RATE_HZ, 0.0)
    plain = replace(plain, limits=replace(plain.limits, stale_ticks_in_a_row=10**9))

    def with_sensor(sensor: str, settings: NetFtSettings) -> Profile:
        devices = replace(plain.rig.devices, sensor=sensor)
        rig = replace(plain.rig, devices=devices, added_settings=(settings,))
        return replace(plain, rig=rig)

    if name == ALONE:
        return loops.run_session(name, plain, seconds, lambda: None)
    if name == SIMULATED:
        profile = with_sensor("netft", NetFtSettings("127.0.0.1"))
        return loops.run_session(name, profile, seconds, lambda: None)
    with box(cores) as port, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reader:
        if name == STREAMING:
            reader.connect(("127.0.0.1", port))
            reader.send(STREAM_REQUEST)
            measurement = loops.run_session(name, plain, seconds, lambda: None)
            reader.send(STOP_REQUEST)
            return measurement
        settings = NetFtSettings("127.0.0.1", port=port, counts_per_n=1e6, counts_per_nm=1e6)
        profile = with_sensor("distant_netft", settings)
        return loops.run_session(name, profile, seconds, lambda: None)


def main() -> None:
    """Print every round, then the cost of the box, and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seconds", type=float, nargs="?", default=5.0)
    parser.add_argument("rounds", type=int, nargs="?", default=4)
    gate = Gate(ROWS, parser)
    use_one_thread()
    granted = granted_realtime_settings(load_profile("sim").realtime)
    print("; ".join(f"{name} {text}" for name, text in granted.items()))
    cores, rounds = cores_without_loop(granted), []
    names = (ALONE, STREAMING, READ, SIMULATED)
    with tempfile.TemporaryDirectory(prefix="rigd-bench-") as folder:
        install(Path(folder))
        for number in range(gate.given.rounds):
            found = {
                name: measure(name, gate.given.seconds, cores) for name in in_turn(names, number)
            }
            rounds.append({name: found[name] for name in names})
            show(rounds[-1])
    for over, under in (
        (STREAMING, ALONE), (READ, STREAMING), (READ, ALONE), (SIMULATED, ALONE)
    ):  # fmt: skip
        p50, p99 = (lateness_ratio(rounds, over, under, which) for which in ("p50", "p99"))
        cpu_percent = median_difference(rounds, over, under, lambda one: one.cpu_percent)
        work_us = median_difference(rounds, over, under, median_work_us)
        print(
            f"{over} over {under}: lateness p50 {p50:.2f}, p99 {p99:.2f}; "
            f"work {work_us:+.1f} µs, CPU {cpu_percent:+.1f} %"
        )
        if (over, under) == (READ, ALONE):
            gate.measured("lateness p99, box read", p99)
            gate.measured("CPU, box read", cpu_percent)
            gate.measured("work of a tick, box read", work_us)
    gate.finish()


if __name__ == "__main__":
    main()
