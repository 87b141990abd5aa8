"""Time of a session of the simulated rig: whole processes, and the work of the loop per tick.

Peer of the whole: an interpreter that imports numpy and pydantic, as every session must. Peer of
the tick: the matrix product alone of the plant's step. Best of five in turn.
"""

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from gate import Gate, Row
from timing import least_in_turn_s

from rigd.control import PidController, design_pid
from rigd.devices import open_devices
from rigd.engine.cycle import Cycle, make_limit_monitor, make_reading_monitors
from rigd.engine.timing import TickScheduler, VirtualClock
from rigd.profile import load_profile

RIGD = Path(sys.executable).with_name("rigd")
TICKS = 20_000
ROWS = (
    # Measured 20 to 22, 11 to 12 and 11 to 16.
    Row("rigd run chirp --fast", most=35, unit="times an interpreter with numpy and pydantic"),
    Row("rigd --help", most=20, unit="times a bare interpreter"),
    Row("tick", most=24, unit="times the plant's matrix product"),
)


def run(*command: object) -> None:
    """Run a command to its end, without its output."""
    subprocess.run([*map(str, command)], check=True, capture_output=True)


def session() -> None:
    """Run the paper's chirp, 136 s of rig time, from the command line to the closed file."""
    with tempfile.TemporaryDirectory() as folder:
        run(RIGD, "run", "chirp", "--fast", "--no-look", "--output", folder)


def cycle() -> Callable[[], None]:
    """Return a function that runs ticks on the simulated rig, without recording."""
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
    """Return a function that makes as many matrix products of the plant's size."""
    matrix, vector, out = np.ones((64, 61)), np.ones(61), np.empty(64)

    def products() -> None:
        for _ in range(TICKS):
            np.dot(matrix, vector, out=out)

    return products


def main() -> None:
    """Print times and ratios, and check the limits."""
    gate = Gate(ROWS, argparse.ArgumentParser(description=__doc__))
    bare, whole, empty, shown = least_in_turn_s(
        5,
        lambda: run(sys.executable, "-c", "import numpy, pydantic"),
        session,
        lambda: run(sys.executable, "-c", "pass"),
        lambda: run(RIGD, "--help"),
    )
    print(f"rigd run chirp --fast, 136 s of rig time: {whole:.2f} s; rigd --help: {shown:.3f} s")
    gate.measured("rigd run chirp --fast", whole / bare)
    gate.measured("rigd --help", shown / empty)
    tick, products = least_in_turn_s(10, cycle(), product())
    print(f"one tick (plant, devices, limits, controller): {1e6 * tick / TICKS:.2f} µs")
    gate.measured("tick", tick / products)
    gate.finish()


if __name__ == "__main__":
    main()
