"""Time of a PID step, of a limit check, and of predicting a session, against a loop over ticks."""

import argparse

import numpy as np
from gate import Gate, Row
from timing import least_in_turn_s, least_s

from rigd.control import ClosedLoop, PidController, check_stability, close_loop, design_pid
from rigd.engine.cycle import make_limit_monitor
from rigd.excitation import chirp
from rigd.profile import load_profile

CALLS = 20_000
ROWS = (
    # Measured 38 to 50, and 32.
    Row("PID step", most=100, unit="times a call of abs()"),
    Row("limit check", most=65, unit="times a call of abs()"),
    # Measured 1.8 to 6.4.
    Row("closing the loop and its check", most=15, unit="times the prediction"),
    # Measured 0.027.
    Row("prediction of a session", most=0.06, unit="times tick by tick"),
    # Measured 9e-17.
    Row("prediction against tick by tick", most=1e-12, unit="rad"),
)


def tick_by_tick(loop: ClosedLoop, reference_rad: np.ndarray) -> np.ndarray:
    """Simulate the same state space tick by tick."""
    x, out = np.zeros(loop.b.size), np.empty((reference_rad.size, 5))
    for tick, value in enumerate(reference_rad.tolist()):
        out[tick] = loop.c @ x + loop.d * value
        x = loop.a @ x + loop.b * value
    return out


def main() -> None:
    """Measure and print the ratios, and check the limits."""
    gate = Gate(ROWS, argparse.ArgumentParser(description=__doc__))
    profile = load_profile("sim")
    model, motor = profile.loop_model(), profile.rig.motor
    gains = design_pid(motor.inertia_kg_m2, motor.viscous_nm_s_per_rad, profile.control.pole_rad_s)
    pid = PidController(gains, profile.control, profile.rig.rate_hz, motor.peak_torque_nm)
    watch = make_limit_monitor(profile)
    wrench = (0.1, 0.1, 0.1, 0.01, 0.01, 0.01)

    def steps() -> None:
        for _ in range(CALLS):
            pid.step(0.01, 0.0101, 0.02)

    def checks() -> None:
        for _ in range(CALLS):
            watch.check(0.01, 0.0101, wrench)

    def nothing() -> None:
        for _ in range(CALLS):
            abs(0.01)

    empty, step, check = least_in_turn_s(10, nothing, steps, checks)
    print(f"PID step {1e6 * step / CALLS:.2f} µs, limit check {1e6 * check / CALLS:.2f} µs")
    gate.measured("PID step", step / empty)
    gate.measured("limit check", check / empty)

    loop = close_loop(model)
    reference = chirp(rate_hz=profile.rig.rate_hz).reference_rad
    design, blocks = least_in_turn_s(
        5, lambda: check_stability(close_loop(model)), lambda: loop.simulate(reference)
    )
    plain = least_s(lambda: tick_by_tick(loop, reference), 1)
    print(f"close and check {design:.2f} s; {reference.size} ticks predicted in {blocks:.3f} s")
    gate.measured("closing the loop and its check", design / blocks)
    gate.measured("prediction of a session", blocks / plain)
    deviation = loop.simulate(reference).angle_rad - tick_by_tick(loop, reference).T[0]
    gate.measured("prediction against tick by tick", np.max(np.abs(deviation)))
    gate.finish()


if __name__ == "__main__":
    main()
