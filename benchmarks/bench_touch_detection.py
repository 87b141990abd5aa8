"""Detection of touches: delay after contact, false detections in free motion, cost per tick.

Run as ``python benchmarks/bench_touch_detection.py [TOUCHES] [HOURS]`` (40 and 0.1). Motor, beam,
noise, friction and encoder are those of the simulated rig, in this process; the detector is the one
of the control loop. In free motion (slews, moves and chirps) the model has an error of 1 % in two
of three runs, and the torque has a hum of 2 mN·m.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from gate import Gate, Row, percent
from numpy.typing import NDArray
from timing import least_in_turn_s

from rigd.control import PidController, design_pid
from rigd.excitation import chirp
from rigd.excitation.moves import slew, vibration_free_path
from rigd.identified_beam import TOUCH_USE
from rigd.profile import Profile, load_profile
from rigd.runner.planning import RigPreview
from rigd.sim import SimulatedRig
from rigd.touch import ChannelNoise, DetectorSettings, TouchDetector, TouchModel, detector_model

Real = NDArray[np.float64]

HUM_NM, HUM_HZ = 2e-3, 50.0
REST = 1000
ROWS = (
    # Measured 5 to 7 µs, some 250 calls; 399 of 400, median 5 ms, 89 and 99 %; none in 10 hours:
    # docs/validation/touch.md.
    Row("tick of the detector", most=600, unit="times a call of abs()"),
    Row("touches detected after contact", least=95, unit="%"),
    Row("delay, median", most=8, unit="ms"),
    Row("within 10 ms", least=75, unit="%"),
    Row("within 20 ms", least=92, unit="%"),
    Row("false touches", most=0),
    Row("free motion", least=0.05, unit="h"),
)


class Loop:
    """Simulated rig under its controller, watched by a detector."""

    def __init__(self, profile: Profile, watched: Profile, hum_nm: float = 0.0) -> None:
        rig, motor = profile.rig, profile.control_motor
        self.rig = SimulatedRig(rig)
        self.rig.plant.enable()
        gains = design_pid(
            motor.inertia_kg_m2, motor.viscous_nm_s_per_rad, profile.control.pole_rad_s
        )
        self.pid = PidController(gains, profile.control, rig.rate_hz, motor.peak_torque_nm)
        self.pid.reset(0.0)
        self.offset = np.array(rig.simulation.offset)
        self.torque, self.shear = (
            np.array(row).tolist() for row in (rig.sensor.projection, rig.sensor.shear_projection)
        )
        self.tare = [float(self.offset @ row) for row in (self.torque, self.shear)]
        self.detector = detector_of(watched)
        self.hum_nm, self.tick = hum_nm, 0

    def run(self, reference: Real) -> Iterator[tuple[bool, float]]:
        """Yield for each tick whether a touch was detected, and the force on the beam."""
        plant, sensor, detector = self.rig.plant, self.rig.sensor, self.detector
        for reference_rad in reference.tolist():
            if self.tick == REST:
                detector.arm()
            wrench = sensor.measure()
            torque, shear = (
                sum(p * w for p, w in zip(row, wrench, strict=True)) - tare
                for row, tare in zip((self.torque, self.shear), self.tare, strict=True)
            )
            torque += self.hum_nm * np.sin(2e-3 * np.pi * HUM_HZ * self.tick)
            angle = self.rig.read_angle()
            touched = detector.step(angle, torque, shear)
            plant.command(self.pid.step(reference_rad, angle, torque))
            self.rig.advance(1)
            self.tick += 1
            yield touched, float(np.abs(plant.contact_forces_n).max(initial=0.0))


def detector_of(profile: Profile) -> TouchDetector:
    """Return a detector for the beam of a profile."""
    rig, simulation = profile.rig, profile.rig.simulation
    assert simulation is not None
    noise = ChannelNoise(simulation.torque_noise_nm, simulation.force_noise_n, 2e-5)
    beam = detector_model(TouchModel(profile.plant), rig.rate_hz, noise)
    return TouchDetector(beam, rig.rate_hz, DetectorSettings())


def with_rig(profile: Profile, **changes: object) -> Profile:
    """Return a profile with another rig."""
    return replace(profile, rig=replace(profile.rig, **changes))


def detection(touches: int, gate: Gate) -> None:
    """Slew into obstacles of random position and stiffness at random speed."""
    profile = load_profile("sim")
    poles = RigPreview(profile).move_plant("", TOUCH_USE).poles_rad_s
    random = np.random.default_rng(1)
    delays, peaks, missed = [], [], 0
    for number in range(touches):
        x_m = random.uniform(0.05, 0.97)
        stiffness = 10 ** random.uniform(2, 5)
        speed = random.uniform(0.3, 2.0)
        simulation = replace(
            profile.rig.simulation,
            seed=number,
            obstacles=(f"x={x_m:.4f},angle=0.6,stiffness={stiffness:.1f}",),
        )
        out = slew(
            0.9, speed_rad_s=speed, acceleration_rad_s2=20.0, rate_hz=1000.0, poles_rad_s=poles
        )
        begin = None
        delay = None
        peak = 0.0
        for tick, (touched, force) in enumerate(
            Loop(with_rig(profile, simulation=simulation), profile).run(
                np.concatenate([np.zeros(REST), out])
            )
        ):
            if force != 0.0 and begin is None:
                begin = tick
            peak = max(peak, abs(force))
            if touched:
                delay = None if begin is None else tick - begin
                break
        if delay is None:
            missed += 1
            print(f"not detected: x {x_m:.3f} m, {stiffness:.0f} N/m, {speed:.2f} rad/s")
        else:
            delays.append(delay)
            if delay > 10:
                print(f"{delay} ms: x {x_m:.3f} m, {stiffness:.0f} N/m, {speed:.2f} rad/s")
        peaks.append(peak)
    delays_ms = np.array(delays or [np.inf])
    print(
        f"{touches} touches, {missed} not detected or too early; delay median "
        f"{np.median(delays_ms):.0f} ms, 95 % {np.quantile(delays_ms, 0.95):.0f} ms, longest "
        f"{delays_ms.max()} ms"
    )
    gate.measured("touches detected after contact", percent(len(delays), touches))
    gate.measured("delay, median", np.median(delays_ms))
    for most_ms in (10, 20):
        gate.measured(f"within {most_ms} ms", 100 * np.mean(delays_ms <= most_ms))


def free_motion(hours: float, gate: Gate) -> None:
    """Slew, move and sweep without obstacles, and count detections."""
    profile = load_profile("sim")
    poles = RigPreview(profile).move_plant("", TOUCH_USE).poles_rad_s
    random = np.random.default_rng(2)
    false = ticks = 0
    number = 0
    began = time.perf_counter()
    while ticks < hours * 3.6e6:
        number += 1
        wrong = {}
        beam = profile.rig.beam
        if number % 3:
            # In chirps, which are every fourth run, both errors are then equally frequent.
            name = ("bending_stiffness_n_m2", "density_kg_per_m")[number // 4 % 2]
            wrong[name] = getattr(beam, name) * random.choice([0.99, 1.01])
        watched = with_rig(profile, beam=replace(beam, **wrong))
        simulation = replace(profile.rig.simulation, seed=number)
        parts: list[Real] = [np.zeros(REST + 200)]
        if number % 4 == 0:
            parts.append(
                chirp(rate_hz=1000, duration_s=60.0, rest_s=0, ring_down_s=5).reference_rad
            )
        else:
            at = 0.0
            for _ in range(20):
                to = random.uniform(-1.2, 1.2)
                if number % 4 == 2:
                    way = (to - at) * vibration_free_path(random.uniform(0.4, 1.2), 1000.0, poles)
                else:
                    way = slew(
                        to - at,
                        speed_rad_s=random.uniform(0.3, 2.0),
                        acceleration_rad_s2=random.uniform(10, 60),
                        rate_hz=1000.0,
                        poles_rad_s=poles,
                    )
                parts += [at + way, np.full(int(random.uniform(0, 1500)), at + way[-1])]
                at += way[-1]
        loop = Loop(with_rig(profile, simulation=simulation), watched, HUM_NM)
        highest = 0.0
        for touched, _ in loop.run(np.concatenate(parts)):
            ticks += 1
            highest = max(highest, loop.detector.level)
            if touched:
                false += 1
                print(f"false touch in run {number} ({'wrong model' if wrong else 'right model'})")
                break
    took = time.perf_counter() - began
    print(f"{ticks / 3.6e6:.2f} h of free motion: {false} false touches ({took:.0f} s)")
    gate.measured("false touches", false)
    gate.measured("free motion", ticks / 3.6e6)


def tick_cost(gate: Gate) -> None:
    """Measure the time of the detector in a tick."""
    profile = load_profile("sim")
    detector = detector_of(profile)
    detector.arm()
    rows = np.random.default_rng(0).standard_normal((20_000, 3)) * (1e-4, 5e-3, 0.02)
    values = rows.tolist()

    def steps() -> None:
        for angle, torque, shear in values:
            detector.step(angle, torque, shear)

    def nothing() -> None:
        for _ in values:
            abs(0.01)

    best, empty = least_in_turn_s(5, steps, nothing)
    print(f"a tick of the detector: {1e6 * best / len(rows):.1f} µs")
    gate.measured("tick of the detector", best / empty)


def main() -> None:
    """Measure and print the results, and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("touches", type=int, nargs="?", default=40)
    parser.add_argument("hours", type=float, nargs="?", default=0.1)
    gate = Gate(ROWS, parser)
    tick_cost(gate)
    detection(gate.given.touches, gate)
    free_motion(gate.given.hours, gate)
    gate.finish()


if __name__ == "__main__":
    main()
