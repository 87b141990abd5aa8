"""One PID step, one limit check, and the prediction of a session against a loop over its ticks."""

import numpy as np
from timing import least_s

from rigd.control import ClosedLoop, PidController, check_stability, close_loop, design_pid
from rigd.engine.cycle import make_limit_monitor
from rigd.excitation import chirp
from rigd.profile import load_profile

CALLS = 20_000


def tick_by_tick(loop: ClosedLoop, reference_rad: np.ndarray) -> np.ndarray:
    """Run the same state space one tick after the other."""
    x, out = np.zeros(loop.b.size), np.empty((reference_rad.size, 5))
    for tick, value in enumerate(reference_rad.tolist()):
        out[tick] = loop.c @ x + loop.d * value
        x = loop.a @ x + loop.b * value
    return out


def main() -> None:
    """Print the figures."""
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

    empty = least_s(nothing, 10) / CALLS * 1e6
    step, check = (least_s(work, 10) / CALLS * 1e6 for work in (steps, checks))
    print(f"PID step         {step:6.2f} µs   {step / empty:5.1f} × a call of abs()")
    print(f"limit check      {check:6.2f} µs   {check / empty:5.1f} × a call of abs()")

    loop = close_loop(model)
    design = least_s(lambda: check_stability(close_loop(model)), 5) * 1e3
    print(f"close and check  {design:6.1f} ms")
    reference = chirp(rate_hz=profile.rig.rate_hz).reference_rad
    blocks = least_s(lambda: loop.simulate(reference), 10) * 1e3
    plain = least_s(lambda: tick_by_tick(loop, reference), 1) * 1e3
    deviation = np.max(
        np.abs(loop.simulate(reference).angle_rad - tick_by_tick(loop, reference).T[0])
    )
    print(f"prediction       {blocks:6.1f} ms for {reference.size} ticks")
    print(f"  tick by tick   {plain:6.1f} ms   {plain / blocks:5.1f} × the prediction")
    print(f"  they differ by {deviation:.1g} rad at most")


if __name__ == "__main__":
    main()
