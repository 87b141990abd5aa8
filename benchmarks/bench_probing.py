"""Probing move: detected errors of scale and sign, travel of the shaft, and false alarms.

``bench_probing.py [--sound N] [--frictions C …]`` moves a simulated plant that differs from its
profile. The Markdown table has a row for each mismatch and friction: the end of the move, the
largest true speed and true angle of the shaft until it is at rest again, the ratios, and the
verdict. Then N sound rigs, each with one quantity of the motor within 25 % and a friction of 0.02
to 0.1 N·m, and the number of them that are refused. A row is wrong if an error beyond 50 % passes,
a smaller one is refused, or a true limit is exceeded.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from gate import Gate, Row, percent

from rigd.engine import probed_rig
from rigd.profile import load_profile
from rigd.safety.probe_estimate import ProbeEstimate, contradiction, estimate_probe
from rigd.safety.probing_move import ProbeEnd, ProbingMove, plan_probe
from rigd.sim import SimulatedPlant

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rigd.devices.parameters import RigParameters
    from rigd.profile import Profile

LONGEST_TICKS = 30_000
COASTING_TICKS = 1000
ROWS = (
    Row("mismatches probed", least=46),
    Row("rows that are wrong", most=0),
    Row("sound rigs refused", most=0, unit="%"),
)


@dataclass(frozen=True, slots=True)
class Mismatch:
    """Mismatch between a rig and its profile."""

    name: str = "none"
    profile: dict[str, float] = field(default_factory=dict)
    """Factors on values of the profile, by key."""
    truth: dict[str, float] = field(default_factory=dict)
    """Factors on values of the rig, by key."""
    encoder_sign: int = 1
    torque_sign: int = 1
    sensor_sign: int = 1
    frozen_from: int | None = None
    """Tick from which the encoder is frozen."""
    must_fail: bool = True


@dataclass(frozen=True, slots=True)
class Probed:
    """Result of a probing move."""

    end: ProbeEnd | None
    estimate: ProbeEstimate
    contradiction: str
    speed_rad_s: float
    """Largest true speed."""
    angle_rad: float
    """Largest true angle from the start, or from where the encoder froze."""
    duration_s: float


def scaled(rig: RigParameters, factors: dict[str, float]) -> RigParameters:
    """Return a rig with some values multiplied."""
    for key, factor in factors.items():
        section, _, name = key.partition(".")
        part = getattr(rig, section)
        rig = replace(rig, **{section: replace(part, **{name: factor * getattr(part, name)})})
    return rig


def probe(
    profile: Profile,
    mismatch: Mismatch,
    *,
    coulomb_nm: float = 0.03,
    noise_nm: float = 5e-3,
    seed: int = 0,
) -> Probed:
    """Make the probing move of a profile on a plant with a mismatch."""
    truth = scaled(profile.rig, mismatch.truth)
    truth = replace(truth, motor=replace(truth.motor, coulomb_nm=coulomb_nm))
    stated = replace(profile, rig=scaled(profile.rig, mismatch.profile))
    rig, plant = probed_rig(stated), SimulatedPlant(truth)
    plant.enable()
    move = ProbingMove(rig, plan_probe(rig), noise_nm)
    noise = noise_nm * np.random.default_rng(seed).standard_normal(LONGEST_TICKS)
    angle_rad = from_rad = 0.0
    speeds, angles = [0.0], [0.0]
    ticks = 0
    while move.end is None and ticks < LONGEST_TICKS:
        if mismatch.frozen_from is None or ticks < mismatch.frozen_from:
            counts = round(plant.sensed_angle_rad / truth.encoder.resolution_rad)
            angle_rad = mismatch.encoder_sign * counts * stated.rig.encoder.resolution_rad
            from_rad = plant.angle_rad if mismatch.frozen_from else 0.0
        coupling_nm = mismatch.sensor_sign * plant.sensed_torque_nm + float(noise[ticks])
        torque_nm = move.step(0.0, angle_rad, coupling_nm)
        per_mille = int(1000 * torque_nm / stated.rig.motor.rated_torque_nm)
        true_nm = mismatch.torque_sign * per_mille / 1000 * truth.motor.rated_torque_nm
        plant.command(min(max(true_nm, -truth.motor.peak_torque_nm), truth.motor.peak_torque_nm))
        plant.advance()
        speeds.append(plant.velocity_rad_s)
        angles.append(plant.angle_rad - from_rad)
        ticks += 1
    plant.command(0.0)
    for _ in range(COASTING_TICKS):
        plant.advance()
        speeds.append(plant.velocity_rad_s)
        angles.append(plant.angle_rad - from_rad)
    if mismatch.frozen_from:
        angles = angles[mismatch.frozen_from :]
    estimate = estimate_probe(rig, move)
    return Probed(
        move.end,
        estimate,
        contradiction(rig, move.end, estimate),
        float(np.max(np.abs(speeds))),
        float(np.max(np.abs(angles))),
        ticks / truth.rate_hz,
    )


def mismatches() -> Iterator[Mismatch]:
    """Yield the mismatches of the survey."""
    step, rated, inertia = "encoder.resolution_rad", "motor.rated_torque_nm", "motor.inertia_kg_m2"
    peak = "motor.peak_torque_nm"
    for factor in (0.1, 0.25, 0.5, 0.75, 1.25, 2.0, 4.0, 10.0):
        beyond = not 0.5 < factor < 1.5
        yield Mismatch(f"profile's encoder step × {factor:g}", {step: factor}, must_fail=beyond)
    for factor in (0.2, 0.5, 0.75, 1.25, 1.6, 2.0, 5.0):
        beyond = not 0.5 < factor < 1.5
        yield Mismatch(f"profile's rated torque × {factor:g}", {rated: factor}, must_fail=beyond)
        true = {rated: factor, peak: factor}
        yield Mismatch(f"true rated torque × {factor:g}", truth=true, must_fail=beyond)
        yield Mismatch(f"profile's inertia × {factor:g}", {inertia: factor}, must_fail=beyond)
        yield Mismatch(f"true inertia × {factor:g}", truth={inertia: factor}, must_fail=beyond)
    yield Mismatch("sign of the encoder", encoder_sign=-1)
    yield Mismatch("sign of the torque", torque_sign=-1)
    yield Mismatch("sign of the sensor", sensor_sign=-1)
    yield Mismatch("signs of encoder and torque", encoder_sign=-1, torque_sign=-1)
    for tick in (0, 200, 600, 1400, 1700, 2300):
        yield Mismatch(f"encoder frozen from {tick} ms on", frozen_from=tick)


def sound(count: int) -> Iterator[tuple[Mismatch, float]]:
    """Yield rigs with one quantity of the motor within 25 %, and their frictions."""
    draw = np.random.default_rng(1)
    keys = ("encoder.resolution_rad", "motor.rated_torque_nm", "motor.inertia_kg_m2")
    for _ in range(count):
        factors = {keys[draw.integers(3)]: float(draw.uniform(0.75, 1.25))}
        both = draw.integers(2)
        mismatch = Mismatch(profile={} if both else factors, truth=factors if both else {})
        yield mismatch, float(draw.uniform(0.02, 0.1))


def _cell(ratio: float | None, std: float | None) -> str:
    return "–" if ratio is None or std is None else f"{ratio:.2f} ± {std:.2f}"


def main() -> None:
    """Print the table and the counts, and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sound", type=int, default=20)
    parser.add_argument("--frictions", type=float, nargs="*", default=[0.03, 0.1])
    gate = Gate(ROWS, parser)
    given = gate.given
    profile = load_profile("antenna_can")
    wrong = probed = 0
    print("| mismatch | friction | end | true speed | true angle | coupling | torque | inertia | |")
    print("|---|---|---|---|---|---|---|---|---|")
    for coulomb_nm in given.frictions:
        for mismatch in mismatches():
            done = probe(profile, mismatch, coulomb_nm=coulomb_nm)
            probed += 1
            estimate = done.estimate
            refused = bool(done.contradiction)
            limits = profile.limits
            left = done.speed_rad_s > limits.velocity_rad_s or done.angle_rad > limits.angle_rad
            wrong += refused is not mismatch.must_fail or left
            cells = (
                mismatch.name,
                f"{coulomb_nm:g} N·m",
                "–" if done.end is None else done.end.name.lower(),
                f"{done.speed_rad_s:.2f} rad/s",
                f"{done.angle_rad:.2f} rad",
                _cell(estimate.coupling_ratio, estimate.coupling_std),
                _cell(estimate.torque_ratio, estimate.torque_std),
                _cell(estimate.inertia_ratio, estimate.inertia_std),
                "refused" if refused else "passed",
            )
            print(f"| {' | '.join(cells)} |", flush=True)
    alarms = sum(
        bool(probe(profile, mismatch, coulomb_nm=coulomb_nm, seed=seed).contradiction)
        for seed, (mismatch, coulomb_nm) in enumerate(sound(given.sound))
    )
    print()
    gate.measured("mismatches probed", probed)
    gate.measured("rows that are wrong", wrong)
    gate.measured("sound rigs refused", percent(alarms, given.sound))
    gate.finish()


if __name__ == "__main__":
    main()
