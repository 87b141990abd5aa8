"""Sessions that end themselves: accuracy of the online fit if its precision decides the end.

The beams are known (`independent_records`): all seven structures, damping ratios of 0.1 to 3 %,
bending stiffness and density each up to 20 % off what the session states, torque noise of 3 to
20 mN·m. A session is a chirp of 5 s (0.5-50 Hz), then narrow sweeps of 2 s around one mode after
the other, until the damping ratio of every visible mode has the requested standard deviation (1 or
3 %), or after 16 sweeps.

The program reports whether the first fit finds the modes (each within 5 of its standard deviations,
and no strongly excited mode missed); and the coverage of the 95 % intervals and the mean error, in
standard deviations, of the first fits, at the stop, and after a fixed number of sweeps.
"""

import argparse
import math
import time
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from gate import Gate, Row, percent
from independent_records import (
    DENSITY_KG_PER_M,
    LENGTH_M,
    RATE_HZ,
    STIFFNESS_N_M2,
    Exact,
    Truth,
    characteristic,
    driven,
)
from numpy.typing import NDArray

from analysis.models import STRUCTURES
from analysis.online import OnlineEstimate, OnlineEstimator
from rigd.session.layout import SAMPLE_DTYPE

Real = NDArray[np.float64]

FINE_HZ = 4 * RATE_HZ
REST_S, CHIRP_S, DECAY_S, NARROW_SWEEP_S = 0.5, 5.0, 1.0, 2.0
FIRST_HZ, LAST_HZ, AMPLITUDE_RAD = 0.5, 50.0, 0.025
MOST_SWEEPS = 16
FIXED_SWEEPS = 6
TARGETS = (0.01, 0.03)
BAND_HZ = 48.0
ROWS = (
    # Measured 0 of 84, and 95 to 97 % at the stop: docs/validation/online_fit.md.
    Row("first fits with a mode beyond 5 standard deviations", most=0),
    Row("first fits that miss mode 1 or 2", most=0),
    Row("95 % intervals at the stop that hold the truth", least=85, unit="%"),
    # Measured 8 of 84.
    Row("sessions that do not reach all", most=40, unit="%"),
)


def beam_of(generator: np.random.Generator, name: str, off: float) -> Truth:
    """Draw a beam of a structure.

    Parameters
    ----------
    generator : Generator
    name : str
    off : float
        Largest relative deviation of stiffness and density from those stated by the session.
    """
    structure = STRUCTURES[name]
    stiffness, density = (
        nominal * (1 + off * generator.uniform(-1, 1))
        for nominal in (STIFFNESS_N_M2, DENSITY_KG_PER_M)
    )
    ratio = density / stiffness
    first, second = ((characteristic(n) / LENGTH_M) ** 2 / math.sqrt(ratio) for n in (1, 2))
    alpha = structure.fixed.get("alpha", generator.uniform(0.6, 1.3)) or 1.0
    lambda_ = structure.fixed.get("lambda", generator.uniform(0.4, 1.4)) or 1.0
    inner, outer = np.exp(generator.uniform(*np.log([0.001, 0.03]), size=2))
    if structure.has_internal_damping and structure.has_external_damping:
        inner, outer = inner / 2, outer / 2
    zeta = 2 * inner / (second**alpha * math.sin(math.pi / 2 * alpha))
    gamma = 2 * outer * ratio * first ** (2 - lambda_) / math.sin(math.pi / 2 * lambda_)
    return Truth(
        zeta=zeta if structure.has_internal_damping else 0.0,
        alpha=alpha,
        gamma=gamma if structure.has_external_damping else 0.0,
        lambda_=lambda_,
        density_over_stiffness=ratio,
        bending_stiffness_n_m2=stiffness,
        tool_inertia_kg_m2=1e-5,
    )


def eased(seconds: float, ramp_s: float) -> Real:
    """Return a window that begins and ends with zero slope and curvature."""
    t = np.arange(round(seconds * FINE_HZ)) / FINE_HZ
    u = np.clip(np.minimum(t, seconds - t) / ramp_s, 0, 1)
    window: Real = u**3 * (10 - 15 * u + 6 * u**2)
    return window


def sweep(first_hz: float, last_hz: float, seconds: float, ramp_s: float) -> Real:
    """Return a linear sweep at the fine rate."""
    t = np.arange(round(seconds * FINE_HZ)) / FINE_HZ
    phase = 2 * np.pi * (first_hz * t + (last_hz - first_hz) * t**2 / (2 * seconds))
    return AMPLITUDE_RAD * eased(seconds, ramp_s) * np.sin(phase)


@dataclass
class Case:
    """One beam, its noise, and its session so far."""

    truth: Truth
    noise_nm: float
    seed: int
    reference: Real

    def estimate(self, *, whole: bool = False) -> OnlineEstimate:
        """Fit the session and the free decay of its last segment."""
        rest = np.zeros(round(DECAY_S * FINE_HZ))
        made = driven(self.truth, np.concatenate([self.reference, rest]))
        return estimate_of(made, self.noise_nm, self.seed, whole=whole)

    def add(self, segment: Real) -> None:
        """Append a segment."""
        self.reference = np.concatenate([self.reference, segment])


def estimate_of(made: Exact, noise_nm: float, seed: int, *, whole: bool) -> OnlineEstimate:
    """Fit a record."""
    angle_rad, torque_nm = made.noisy(noise_nm, seed)
    samples = np.zeros(angle_rad.size, SAMPLE_DTYPE)
    samples["tick"] = np.arange(angle_rad.size)
    samples["t_ns"] = np.arange(angle_rad.size) * round(1e9 / RATE_HZ)
    samples["angle_reference_rad"] = made.reference_rad
    samples["angle_rad"], samples["coupling_torque_nm"] = angle_rad, torque_nm
    stated = {
        "rate_hz": repr(RATE_HZ),
        "beam_length_m": repr(LENGTH_M),
        "beam_density_kg_per_m": repr(DENSITY_KG_PER_M),
        "beam_bending_stiffness_n_m2": repr(STIFFNESS_N_M2),
    }
    fit = OnlineEstimator(stated)
    fit.feed(samples)
    return fit.estimate(whole=whole)


@dataclass
class Errors:
    """Errors of one kind of number, in standard deviations."""

    values: list[float]

    def line(self) -> str:
        """Return coverage, mean and scatter as a line."""
        z = np.array(self.values)
        if not z.size:
            return "none"
        inside = np.abs(z) < 1.96
        half = 1.96 * math.sqrt(max(inside.mean() * (1 - inside.mean()), 0.01) / z.size)
        return (
            f"{100 * inside.mean():5.1f} ± {100 * half:.1f} % covered, mean {z.mean():+.2f} ± "
            f"{1.96 * z.std() / math.sqrt(z.size):.2f}, rms {math.sqrt((z**2).mean()):.2f}, "
            f"worst {np.abs(z).max():.1f} ({z.size})"
        )


def deviations(estimate: OnlineEstimate, truth: Truth) -> dict[str, list[float]]:
    """Return the errors of unflagged numbers in their standard deviations, by kind."""
    found: dict[str, list[float]] = defaultdict(list)
    headline = estimate.headline
    if headline is None:
        return found
    for mode in headline.modes:
        at = {
            "frequency": (mode.frequency_hz, truth.frequency_hz(mode.number)),
            "damping": (mode.damping_ratio, truth.damping_ratio(mode.number)),
        }
        for kind, (quantity, true) in at.items():
            if mode.shown and quantity.flag is None and quantity.std:
                found[kind].append((quantity.value - true) / quantity.std)
    for name, true in truth.parameters.items():
        quantity = headline.parameters.get(name)
        if quantity is None or quantity.flag or not quantity.std or not quantity.value or not true:
            continue
        if name in ("zeta", "gamma", "density_over_stiffness", "bending_stiffness_n_m2"):
            found[name].append(math.log(quantity.value / true) * quantity.value / quantity.std)
        elif name in ("alpha", "lambda"):
            there = truth.zeta if name == "alpha" else truth.gamma
            kind = name if there else f"{name} of no damping"
            found[kind].append((quantity.value - true) / quantity.std)
    return found


def precise(estimate: OnlineEstimate, target: float) -> bool:
    """Whether the damping of every visible mode reaches a relative standard deviation."""
    headline = estimate.headline
    if headline is None:
        return False
    ratios = [mode.damping_ratio for mode in headline.modes if mode.shown]
    return all(r.flag is None and r.std is not None and r.std < target * r.value for r in ratios)


def next_sweep(estimate: OnlineEstimate) -> Real:
    """Return a sweep around the mode with the least precise damping."""
    headline = estimate.headline
    if headline is None:
        return sweep(FIRST_HZ, LAST_HZ, CHIRP_S, 0.05)
    mode = max(
        (mode for mode in headline.modes if mode.shown),
        key=lambda m: (m.damping_ratio.std or math.inf) / abs(m.damping_ratio.value),
    )
    hz = mode.frequency_hz.value
    reach_hz = max(2 * mode.damping_ratio.value * hz, 0.5 / NARROW_SWEEP_S, 0.02 * hz)
    return sweep(max(hz - reach_hz, 0.1), hz + reach_hz, NARROW_SWEEP_S, min(0.25, 1 / hz))


def main() -> None:
    """Run the sessions, print the results and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=7)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--off", type=float, default=0.2, help="Largest error of beam data.")
    parser.add_argument("--scan-only", action="store_true", help="First fits only.")
    parser.add_argument("--whole", action="store_true", help="Try every structure at the stop.")
    gate = Gate(ROWS, parser)
    given = gate.given
    generator = np.random.default_rng(given.seed)
    kinds: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    missed, lost, out_of_reach, ends_s = [], [], 0, defaultdict(list)
    began_s = time.monotonic()
    for number in range(given.sessions):
        name = list(STRUCTURES)[number % len(STRUCTURES)]
        truth = beam_of(generator, name, given.off)
        noise_nm = float(np.exp(generator.uniform(*np.log([3e-3, 20e-3]))))
        rest = np.zeros(round(REST_S * FINE_HZ))
        chirp = sweep(FIRST_HZ, LAST_HZ, CHIRP_S, 0.05)
        case = Case(truth, noise_nm, number, np.concatenate([rest, chirp]))
        first = case.estimate()
        where = (
            f"#{number} type {name}, EI {truth.bending_stiffness_n_m2 / STIFFNESS_N_M2 - 1:+.0%}, "
            f"rho/EI {truth.density_over_stiffness * STIFFNESS_N_M2 / DENSITY_KG_PER_M - 1:+.0%}, "
            f"{1e3 * noise_nm:.0f} mN·m, damping "
            + ", ".join(
                f"{100 * truth.damping_ratio(n):.2g} % at {truth.frequency_hz(n):.1f} Hz"
                for n in (1, 2, 3)
            )
        )
        errors = deviations(first, truth)
        for kind, values in errors.items():
            kinds["first fit"][kind] += values
        shown = () if first.headline is None else first.headline.visible_modes
        if any(abs(z) > 5 for z in [*errors["frequency"], *errors["damping"]]):
            missed.append(f"{where}: {dict(errors)}")
        if not {1, 2} <= set(shown) or first.doubt:
            lost.append(f"{where}: shows {shown} {first.problem or first.doubt or ''}")
        if given.scan_only:
            continue
        todo, estimate = set(TARGETS), first
        for count in range(1, MOST_SWEEPS + 1):
            case.add(next_sweep(estimate))
            estimate = case.estimate()
            if count == FIXED_SWEEPS:
                for kind, values in deviations(estimate, truth).items():
                    kinds[f"after {FIXED_SWEEPS} sweeps"][kind] += values
            for target in sorted(todo):
                if precise(estimate, target):
                    todo.remove(target)
                    stop = f"at the stop, {100 * target:g} %"
                    ended = case.estimate(whole=True) if given.whole else estimate
                    for kind, values in deviations(ended, truth).items():
                        kinds[stop][kind] += values
                    ends_s[stop].append(estimate.duration_s)
            if not todo and count >= FIXED_SWEEPS:
                break
        out_of_reach += bool(todo)
        print(f"{where}: {estimate.duration_s:.1f} s, left {sorted(todo)}", flush=True)
    print(f"\n{given.sessions} sessions in {time.monotonic() - began_s:.0f} s")
    print(f"First fits with a mode more than 5 standard deviations off: {len(missed)}")
    print(*(f"  {each}" for each in missed), sep="\n")
    print(f"First fits that do not show modes 1 and 2, or doubt everything: {len(lost)}")
    print(*(f"  {each}" for each in lost), sep="\n")
    for when, errors_by_kind in kinds.items():
        ends = ends_s[when]
        print(f"\n{when}" + (f" (median {np.median(ends):.1f} s)" if ends else ""))
        for kind, values in errors_by_kind.items():
            print(f"  {kind:24} {Errors(values).line()}")
    print()
    gate.measured("first fits with a mode beyond 5 standard deviations", len(missed))
    gate.measured("first fits that miss mode 1 or 2", len(lost))
    if not given.scan_only:
        errors = [
            abs(error)
            for when, by_kind in kinds.items()
            if when.startswith("at the stop")
            for kind in ("frequency", "damping")
            for error in by_kind[kind]
        ]
        held = percent(sum(error < 1.96 for error in errors), len(errors))
        gate.measured("95 % intervals at the stop that hold the truth", held)
        gate.measured("sessions that do not reach all", percent(out_of_reach, given.sessions))
    gate.finish(part=given.scan_only)


if __name__ == "__main__":
    main()
