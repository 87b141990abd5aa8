"""A session of the simulated rig: whole processes, and the loop's own time a tick.

Peer of the whole: an interpreter that imports numpy and pydantic, as every session must. Peer of
the tick: the bare matrix product of the plant's step, without which nothing can be simulated.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from timing import least_s

from rigd.control import PidController, design_pid
from rigd.devices import open_devices
from rigd.engine.cycle import Cycle, make_limit_monitor, make_reading_monitors
from rigd.engine.timing import TickScheduler, VirtualClock
from rigd.profile import load_profile

RIGD = Path(sys.executable).with_name("rigd")
TICKS = 20_000


def run(*command: object) -> None:
    """Run a command to its end, without its output."""
    subprocess.run([*map(str, command)], check=True, capture_output=True)


def session() -> None:
    """Run the paper's chirp, 136 s of rig time, from the command line to the closed file."""
    with tempfile.TemporaryDirectory() as folder:
        run(RIGD, "run", "chirp", "--fast", "--no-look", "--output", folder)


def cycle() -> Callable[[], None]:
    """Return the work of a tick on the simulated rig, recording apart."""
    profile = load_profile("sim")
    rig = profile.rig
    motor = rig.motor
    gains = design_pid(motor.inertia_kg_m2, motor.viscous_nm_s_per_rad, profile.control.pole_rad_s)
    controller = PidController(gains, profile.control, rig.rate_hz, motor.peak_torque_nm)
    devices = open_devices(rig)
    devices.drive.enable()
    watch = make_limit_monitor(profile)
    tick = Cycle(
        devices, rig.sensor.projection, controller, watch, make_reading_monitors(profile, devices)
    )
    metronome = TickScheduler(VirtualClock(), rig.rate_hz)

    def ticks() -> None:
        for _ in range(TICKS):
            metronome.wait()
            tick.step(metronome.due_ns, 0.0)

    return ticks


def product() -> Callable[[], None]:
    """Return as many products of a matrix of the plant's size with a vector."""
    matrix, vector, out = np.ones((64, 61)), np.ones(61), np.empty(64)

    def products() -> None:
        for _ in range(TICKS):
            np.dot(matrix, vector, out=out)

    return products


def main() -> None:
    """Print times and ratios."""
    bare = least_s(lambda: run(sys.executable, "-c", "import numpy, pydantic"), 10)
    whole = least_s(session, 10)
    print(f"rigd run chirp --fast, 136 s of rig time, best of ten: {whole:.2f} s")
    print(f"  peer, interpreter with numpy and pydantic: {bare:.2f} s, ratio {whole / bare:.1f}")
    empty = least_s(lambda: run(sys.executable, "-c", "pass"), 10)
    shown = least_s(lambda: run(RIGD, "--help"), 10)
    print(f"rigd --help, best of ten: {shown:.3f} s")
    print(f"  peer, bare interpreter: {empty:.3f} s, ratio {shown / empty:.1f}")
    tick_us = least_s(cycle(), 10) / TICKS * 1e6
    product_us = least_s(product(), 10) / TICKS * 1e6
    print(f"one tick (plant, devices, limits, controller), best of ten: {tick_us:.2f} µs")
    print(
        f"  peer, the plant's matrix product: {product_us:.2f} µs, ratio {tick_us / product_us:.1f}"
    )


if __name__ == "__main__":
    main()
