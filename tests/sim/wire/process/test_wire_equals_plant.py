"""A session's devices over the wire return what the direct simulation of the same profile does.

In lock-step every tick is determined, so angles have to be equal and wrenches equal but for the
gauges' resolution: pairing, order, scaling and every delay, through the drivers of the rig.
"""

import re
import sys
import time
from dataclasses import replace
from pathlib import Path
from subprocess import DEVNULL

import numpy as np
import pytest
import warm_start
from cases import further

from rigd.devices import open_devices
from rigd.devices.canbus import bus_load
from rigd.devices.running_simulator import ask_simulator, find_simulator
from rigd.profile import load_profile
from rigd.sim import SimulatedRig

pytestmark = pytest.mark.process

PERIOD_NS = 1_000_000
PROFILES = Path(__file__).parents[4] / "hw_profiles"
AND_AN_OBSTACLE = '0.0, source = "assumed" }\nobstacles = ["x=0.6,angle=0.01,stiffness=3000"]  # '
AND_A_HUM = '0.0, source = "assumed" }\nhum_nm = { value = 0.02, source = "assumed" }  # '
AND_A_DRIFT = (
    '0.0, source = "assumed" }\nstiffness_drift_per_s = { value = -1e-3, source = "assumed" }  # '
)
RIGD = Path(sys.executable).parent / "rigd"


def torque_nm(tick):
    """In whole steps of the drive, 1/1000 of 0.5 N·m; it changes in every tick."""
    return 0.0005 * (300 if tick < 60 else -250) + 0.0005 * (tick * 7 % 5)


def edit(text, key, value):
    """Set a key of a profile that is there once, or in the section given before a colon."""
    section, _, key = key.rpartition(":")
    start = text.index(f"[{section}]") if section else 0
    pattern = rf"^{key} = (\{{ value = )?[^,\n]*"
    found = re.search(pattern, text[start:], re.MULTILINE)
    assert found is not None, key
    head = f"{key} = {found[1] or ''}"
    return text[:start] + text[start:].replace(found[0], head + value, 1)


@pytest.fixture
def simulated_profile(tmp_path, monkeypatch):
    """Write a profile without noise, and run its simulator."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    processes = []

    def make(name, changes):
        text = (PROFILES / f"{name}.toml").read_text()
        changes = {"torque_noise_nm": "0.0", "force_noise_n": "0.0", "name": '"still"'} | changes
        for key, value in changes.items():
            text = edit(text, key, value)
        path = tmp_path / "still.toml"
        path.write_text(text)
        command = [RIGD, "simulate", "--profile", path, "--lock-step"]
        processes.append(warm_start.start(command, stdout=DEVNULL, stderr=DEVNULL))
        while find_simulator("still") is None:
            assert processes[-1].poll() is None
            time.sleep(0.01)
        return load_profile(path).rig

    yield make
    for process in processes:
        process.terminate()
        assert process.wait() == 0


def over_the_wire(rig, ticks):
    devices = open_devices(rig)
    address = find_simulator(rig.name)
    drive, sensor = devices.drive, devices.sensor
    readings = []
    try:
        drive.connect()
        sensor.connect()
        for tick in range(-20, ticks):
            if tick == -5:
                drive.enable()
            drive.latch(tick * PERIOD_NS)
            sensor.request(tick * PERIOD_NS)
            angle, wrench = drive.read_angle(), sensor.read_wrench()
            drive.command(torque_nm(tick) if tick >= 0 else 0.0)
            # Replies that are read a tick later have arrived by then, as in real time; the
            # simulator serves one after the other, so its second answer is behind all of this.
            ask_simulator(address, {"status": True})
            ask_simulator(address, {"status": True})
            if tick >= 0:
                assert not drive.angle_stale
                assert not sensor.wrench_stale
                readings.append((angle, wrench))
    finally:
        drive.close()
        sensor.close()
    return readings


def loads(rig, ticks):
    """Part of the time that each line is busy, from what was sent and received on it."""
    devices = open_devices(rig)
    drive, sensor = devices.drive, devices.sensor
    try:
        drive.connect()
        sensor.connect()
        before = [line.health().bits or 0 for line in (drive, sensor)]
        for tick in range(ticks):
            drive.latch(tick * PERIOD_NS)
            sensor.request(tick * PERIOD_NS)
            drive.read_angle()
            sensor.read_wrench()
            drive.command(0.0)
        after = [line.health() for line in (drive, sensor)]
    finally:
        drive.close()
        sensor.close()
    return [
        None if now.bits is None else (now.bits - then) / now.bit_rate_bit_s / (ticks * 1e-3)
        for then, now in zip(before, after, strict=True)
    ]


def test_the_measured_load_is_the_computed_one(simulated_profile):
    rig = simulated_profile("antenna_can", {})
    bus, none = loads(rig, 500)
    assert none is None  # the sensor is on the same bus
    assert bus == pytest.approx(bus_load(rig).load_without_stuffing, rel=0.02)


def test_the_load_of_a_serial_line_is_its_stream(simulated_profile):
    rig = simulated_profile("antenna_serial", {})
    _, line = loads(rig, 500)
    assert line == pytest.approx(rig.ati_serial.stream_hz * 143 / rig.ati_serial.baud, rel=0.02)


def simulate_directly(rig, ticks):
    simulated = SimulatedRig(rig)
    simulated.plant.enable()
    simulated.advance(20)
    readings = []
    for tick in range(ticks):
        readings.append((simulated.read_angle(), simulated.sensor.read_wrench()))
        simulated.plant.command(torque_nm(tick))
        simulated.advance(1)
    return readings


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("antenna_can", {}),
        further("antenna_can", {"direction": "-1", "torque_delivery": '"on_arrival"'}),
        further(
            "antenna_can",
            {
                "mode": '"previous_tick"',
                "encoder:delay_s": "1.055e-3",
                "sensor:delay_s": "1.3e-3",
                "actuation:delay_s": "1.4e-3",
            },
        ),
        further("antenna_serial", {"filter": '"triangle"', "sensor:delay_s": "1.0e-3"}),
        ("antenna_serial", {}),
        further("antenna_can", {"force_noise_n": AND_AN_OBSTACLE}),  # as test_world.py
        further("antenna_serial", {"force_noise_n": AND_AN_OBSTACLE}),
        further("antenna_can", {"force_noise_n": AND_A_DRIFT}),
        further("antenna_serial", {"force_noise_n": AND_A_DRIFT}),
    ],
)
def test_the_wire_changes_nothing(simulated_profile, name, changes):
    rig = simulated_profile(name, changes)
    ticks = 120
    expected = simulate_directly(rig, ticks)
    measured = over_the_wire(rig, ticks)
    assert [angle for angle, _ in measured] == pytest.approx(
        [angle for angle, _ in expected], abs=1e-9
    )
    assert max(abs(angle) for angle, _ in measured) > 0.01
    # The sensor's bias is its own; what counts is the change, as with a tare.
    changes = [np.subtract(wrench, measured[0][1]) for _, wrench in measured]
    wanted = [np.subtract(wrench, expected[0][1]) for _, wrench in expected]
    off = np.max(np.abs(np.subtract(changes, wanted)), axis=0)
    assert np.all(off <= rig.sensor.resolution)
    assert max(abs(change[5]) for change in changes) > 0.02


@pytest.mark.parametrize("name", [further("antenna_can"), "antenna_serial"])
def test_a_hum_comes_over_the_wire(simulated_profile, name):
    rig = simulated_profile(name, {"force_noise_n": AND_A_HUM})
    ticks = 120
    alone = replace(rig, simulation=replace(rig.simulation, hum_nm=0.0))
    torque = np.array([wrench[5] for _, wrench in over_the_wire(rig, ticks)])
    hum = torque - [wrench[5] for _, wrench in simulate_directly(alone, ticks)]
    # Its phase at the first tick is that of the time that the simulator has been running for.
    phase = 0.1 * np.pi * np.arange(ticks)
    columns = np.column_stack([np.sin(phase), np.cos(phase), np.ones(ticks)])
    found = np.linalg.lstsq(columns, hum)[0]
    assert np.abs(hum - columns @ found).max() < 2 * rig.sensor.resolution[5]
    gain = 1.0
    if rig.ati_serial is not None:
        turns = (
            50.0 / rig.ati_serial.stream_hz * np.arange(len(rig.ati_serial.filter_weights(1000.0)))
        )
        gain = abs(np.exp(2j * np.pi * turns) @ rig.ati_serial.filter_weights(1000.0))
    assert np.hypot(*found[:2]) == pytest.approx(0.02 * gain, abs=rig.sensor.resolution[5])
