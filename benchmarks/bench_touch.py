"""Touches: error of the estimated point, coverage of its intervals, and estimated kinds.

``bench_touch.py [--cases N] [--after-ms 50,100] [--noise 1] [--seed S]`` simulates N slews into an
obstacle at rest (`touch_records.py`: modes, fine steps, independent of the estimator) at positions
of 0.05 to 0.97 m, with stiffnesses of 100 to 100 000 N/m and speeds of 0.3 to 2 rad/s. Each is
estimated with a model whose errors have its stated standard deviations (as identified from one
session). ``--torque-alone`` omits the base shear, ``--exact`` uses the true model. ``--kinds
moving,yielding,knock,two`` simulates instead obstacles that move, give way or strike, and two at
once; of two, the one that is met first counts, and pairs of which the second is not met within
100 ms are left out.

Printed: median, root mean square and 90th percentile of the error of the point (all cases, and
those between 0.1 and 0.95 m), the percentage within the 95 % interval and beyond four standard
deviations, kinds, and processor time per fit.
"""

import argparse
import time
from collections import Counter
from dataclasses import replace

import numpy as np
from gate import Gate, Row, percent
from numpy.typing import NDArray
from touch_records import DAMPED, LINK, RATE_HZ, Obstacle, Slew, Struck, simulate

from rigd.beam import Plant
from rigd.touch import TouchEstimate, TouchEstimator, TouchModel, TouchRecord

Case = tuple[str, Obstacle | tuple[Obstacle, ...], Slew]

RELATIVE_STD = {
    "bending_stiffness_n_m2": 2e-3,
    "density_over_stiffness": 5e-4,
    "zeta": 0.05,
    "gamma": 0.1,
}
"""Relative standard deviations of the errors of the model."""

ROWS = tuple(
    row
    for after_ms in (50, 100)
    for row in (
        # Measured 0.5 to 0.8 mm, 95 to 98 % of 80, 0: docs/validation/touch.md.
        Row(f"{after_ms} ms: median error", most=1.5, unit="mm"),
        Row(f"{after_ms} ms: 95 % intervals that hold the point", least=80, unit="%"),
        Row(f"{after_ms} ms: beyond 4 standard deviations", most=0, unit="%"),
        Row(f"{after_ms} ms: touches with a point", least=85, unit="%"),
    )
)
DURATION_S = 0.85
_TOGETHER_S = 0.1
"""Largest time between the first contacts with two obstacles; other pairs are left out."""


def at_rest(count: int, rng: np.random.Generator) -> list[Case]:
    """Draw elastic obstacles at rest."""
    cases: list[Case] = []
    for _ in range(count):
        speed = rng.uniform(0.3, 2.0)
        obstacle = Obstacle(
            x_m=rng.uniform(0.05, 0.97),
            angle_rad=speed * rng.uniform(0.38, 0.55),
            stiffness_n_per_m=float(np.exp(rng.uniform(np.log(1e2), np.log(1e5)))),
        )
        cases.append(("rigid", obstacle, Slew(speed, rng.uniform(15, 40))))
    return cases


def other_kinds(count: int, kinds: list[str], rng: np.random.Generator) -> list[Case]:
    """Draw `count` obstacles that move, give way or strike, and pairs."""

    def stiffness() -> float:
        return float(np.exp(rng.uniform(np.log(300), np.log(3e4))))

    cases: list[Case] = []
    for i in range(count):
        speed = rng.uniform(0.6, 1.5)
        plain = Obstacle(
            x_m=rng.uniform(0.15, 0.93), angle_rad=0.5 * speed, stiffness_n_per_m=stiffness()
        )
        kind = kinds[i % len(kinds)]
        obstacle: Obstacle | tuple[Obstacle, ...]
        if kind == "moving":
            rate = speed * rng.choice([-1.0, -0.5, 0.3, 0.5])
            obstacle = replace(plain, angle_rad=0.5 * (speed - rate), rate_rad_s=rate)
        elif kind == "yielding":
            mobility = float(np.exp(rng.uniform(np.log(0.03), np.log(0.5))))
            obstacle = replace(plain, mobility_m_per_n_s=mobility)
        elif kind == "knock":
            peak = rng.choice([-1, 1]) * rng.uniform(0.5, 4.0)
            obstacle = replace(plain, knock_n=peak, knock_s=rng.uniform(0.002, 0.02))
        elif kind == "soft":  # two near the axis, met at about the same time
            first, second = (
                Obstacle(
                    rng.uniform(0.03, 0.6),
                    plain.angle_rad + rng.uniform(-0.006, 0.006),
                    float(np.exp(rng.uniform(np.log(200), np.log(3000)))),
                )
                for _ in range(2)
            )
            obstacle = (first, second)
        else:
            angle = plain.angle_rad + rng.uniform(-0.03, 0.03)
            obstacle = (plain, Obstacle(rng.uniform(0.05, 0.97), angle, stiffness()))
        cases.append((kind, obstacle, Slew(speed, 30.0)))
    return cases


def first_met(obstacle: Obstacle | tuple[Obstacle, ...], struck: Struck) -> Obstacle:
    """Return the obstacle that is met first."""
    if isinstance(obstacle, Obstacle):
        return obstacle
    return obstacle[int(np.argmin(struck.met_s))]


def record_of(struck: Struck, after: int, noticed: int, *, shear: bool) -> TouchRecord:
    """Return the record until `after` samples past detection, `noticed` samples after the touch."""
    detected = int(struck.touch_s * RATE_HZ) + noticed
    end = detected + after
    return TouchRecord(
        RATE_HZ,
        struck.angle_rad[:end],
        struck.torque_nm[:end],
        struck.shear_n[:end] if shear else None,
        detected,
    )


def model_near(rng: np.random.Generator, *, exact: bool) -> TouchModel:
    """Return the true beam (`exact`), or one with errors of its stated standard deviations."""
    model = TouchModel(Plant(LINK, DAMPED), source="benchmark")
    if exact:
        return model
    values = {
        "bending_stiffness_n_m2": LINK.bending_stiffness_n_m2,
        "density_over_stiffness": LINK.density_over_stiffness,
        "zeta": DAMPED.zeta,
        "gamma": DAMPED.gamma,
    }
    std = {name: fraction * values[name] for name, fraction in RELATIVE_STD.items()}
    model = replace(model, std_by_parameter=std)
    for name, deviation in std.items():
        model = model.with_changed_parameter(name, deviation * rng.standard_normal())
    return model


def table(rows: NDArray[np.float64]) -> str:
    """Return statistics of rows of position, error, standard deviation, inside, seconds."""
    error = np.abs(rows[:, 1]) * 1e3
    return (
        f"{len(rows):4d} cases: median {np.median(error):.2f} mm, rms "
        f"{np.sqrt(np.mean(error**2)):.2f}, 90 % {np.percentile(error, 90):.2f}, largest "
        f"{error.max():.1f}; within 95 % interval {rows[:, 3].mean():.0%}, beyond 4 std "
        f"{np.mean(np.abs(rows[:, 1]) > 4 * rows[:, 2]):.1%}; median std "
        f"{np.median(rows[:, 2]) * 1e3:.2f} mm; {np.median(rows[:, 4]):.2f} s a fit"
    )


def main() -> None:
    """Simulate, estimate, print, and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--after-ms", default="50,100")
    parser.add_argument("--noise", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=160, help="of the simulation, a sample")
    parser.add_argument("--torque-alone", action="store_true")
    parser.add_argument("--exact", action="store_true")
    parser.add_argument("--kinds", default="", help="instead of obstacles at rest")
    parser.add_argument("--verbose", action="store_true")
    gate = Gate(ROWS, parser)
    given = gate.given
    plain = not (given.kinds or given.torque_alone or given.noise != 1.0)
    rng = np.random.default_rng(given.seed)
    cases = (
        other_kinds(given.cases, given.kinds.split(","), rng)
        if given.kinds
        else at_rest(given.cases, rng)
    )
    records = simulate(
        [obstacle for _, obstacle, _ in cases],
        [slew for *_, slew in cases],
        duration_s=DURATION_S,
        steps=given.steps,
        modes=40,
        seed=given.seed,
        noise=given.noise,
    )
    estimator = TouchEstimator(model_near(rng, exact=given.exact), RATE_HZ)
    noticed = rng.integers(2, 9, len(cases))
    for after in map(int, given.after_ms.split(",")):
        rows, kinds, seconds = [], Counter[tuple[str, str]](), list[float]()
        for (kind, obstacle, _), struck, late in zip(cases, records, noticed, strict=True):
            if max(struck.met_s) > struck.touch_s + _TOGETHER_S:
                continue
            record = record_of(struck, after, int(late), shear=not given.torque_alone)
            begin = time.process_time()
            estimate = estimator.estimate(record)
            spent = time.process_time() - begin
            kinds[kind, estimate.kind] += 1
            seconds.append(spent)
            first = first_met(obstacle, struck)
            if given.verbose:
                print(sentence(first, kind, estimate))
            if estimate.x_m is not None:
                low, high = estimate.x_m.interval_95
                rows.append(
                    [
                        first.x_m,
                        estimate.x_m.value - first.x_m,
                        estimate.x_m.std,
                        low <= first.x_m <= high,
                        spent,
                    ]
                )
        found = np.array(rows, dtype=np.float64)
        print(f"{after} ms after detection: position reported in {len(found)} of {len(seconds)}")
        print("  all positions  ", table(found))
        inner = (found[:, 0] >= 0.1) & (found[:, 0] <= 0.95)
        print("  0.1 to 0.95 m  ", table(found[inner]))
        print("  kinds          ", {f"{a} -> {b}": n for (a, b), n in sorted(kinds.items())})
        print(f"  seconds         {np.median(seconds):.2f} (median), {np.mean(seconds):.2f} (mean)")
        if plain and f"{after} ms: median error" in gate.rows:
            error = np.abs(found[:, 1])
            gate.measured(f"{after} ms: median error", 1e3 * np.median(error))
            held = percent(found[:, 3].sum(), len(found))
            gate.measured(f"{after} ms: 95 % intervals that hold the point", held)
            far = percent(np.sum(error > 4 * found[:, 2]), len(found))
            gate.measured(f"{after} ms: beyond 4 standard deviations", far)
            gate.measured(f"{after} ms: touches with a point", percent(len(found), len(seconds)))
    gate.finish(part=not plain or given.after_ms != parser.get_default("after_ms"))


def sentence(obstacle: Obstacle, kind: str, estimate: TouchEstimate) -> str:
    """Return a line on one case."""
    x = estimate.x_m
    point = "unknown" if x is None else f"{(x.value - obstacle.x_m) * 1e3:+.2f} ± {x.std * 1e3:.2f}"
    return (
        f"{kind} at {obstacle.x_m:.3f} m, {obstacle.stiffness_n_per_m:.0f} N/m: {estimate.kind}, "
        f"{point} mm, chi² {estimate.chi2_per_degree:.2f}"
    )


if __name__ == "__main__":
    main()
