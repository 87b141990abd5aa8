"""Fits of whole records: their time, a global search as a peer, and errors over many sessions.

The program fits N sessions of 136 s (8, ``--sessions N``) of each of three plants and prints for
each parameter the mean error and the coverage of the 95 % intervals; then the CPU time of fitting
all seven structures over that of the true structure alone. ``--times`` prints the CPU time of every
structure on one session of each plant. ``--peer IV --plant VI`` compares with scipy's differential
evolution on the same sum of squares within the same bounds (minutes per structure; ``--peer`` is
repeatable). With ``--undeclared`` rho/EI is off by 1 % and EI by 2 % in the file, which also omits
a delay of 0.3 ms and a clamp of 1e-5 kg m²; with ``--ringing`` the beam rings when the record
begins. The last row is the tool inertia from a descent in which it may be negative; the estimate
itself cannot be, which shifts it by 0.40 standard deviations if the true value is 0.

The sessions are made in the frequency domain on a separate grid: chirp 0.025 rad, 0.05-50 Hz in
120 s behind a motor loop of 20 Hz, at 1 kHz, 1 s of rest before and 15 s after; encoder steps of
7e-5 rad, torque noise of 1e-2 N·m and steps of 1.25e-4 N·m.
"""

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from gate import Gate, Row, percent
from numpy.typing import NDArray

from analysis.identify import (
    SETTINGS,
    Comparison,
    Measurement,
    Objective,
    RecordAnalysis,
    RecordFit,
    fit_record,
)
from analysis.identify.parametrization import StepRule, Unknowns
from analysis.models import STRUCTURES
from analysis.optimizer import descend
from rigd.beam import Beam, Damping, Plant, transfer

RATE_HZ = 1000.0
NOISE_NM = 1e-2
LINK = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
OFF = Beam(0.98, 4.7e-3 * 1.01 * 1.02, 0.090275 * 1.02)
PLANTS = {
    "VI": Damping(zeta=7.1e-5, alpha=0.996, gamma=5.5e-2, lambda_=0.594),
    "III": Damping(zeta=0.54e-4, alpha=1.0, gamma=0.02, lambda_=1.0),
    "IV": Damping(zeta=2.49e-4, alpha=0.8, gamma=0.0, lambda_=0.0),
}


ROWS = (
    # Measured 1.05 with 4 sessions, whose scatter is uncertain, and below 0.8 with 200
    # (docs/validation/whole_record.md).
    Row("largest mean error", most=1.6, unit="of what bias and chance allow"),
    # 23 parameters of 8 sessions: 90 % is significantly low (95 % expected, standard error 1.6 %).
    Row("95 % intervals that hold the truth", least=90, unit="%"),
    # Measured 1.9.
    Row("all seven structures", most=4, unit="times the plant's own"),
)


@dataclass(frozen=True, slots=True)
class Session:
    """Measured angle, and torque without noise."""

    plant: Plant
    angle_rad: NDArray[np.float64]
    torque_nm: NDArray[np.float64]

    def measured(self, seed: int) -> Measurement:
        """Return the session with noise; the file states the nominal link and no delay."""
        noise = np.random.default_rng(seed).normal(scale=NOISE_NM, size=self.torque_nm.size)
        everywhere = np.ones(self.torque_nm.size, dtype=bool)
        return Measurement(
            name="session",
            angle_rad=np.round(self.angle_rad / 7e-5) * 7e-5,
            torque_nm=np.round((self.torque_nm + noise) / 1.25e-4) * 1.25e-4,
            rate_hz=RATE_HZ,
            beam=LINK,
            angle_known=everywhere,
            torque_known=everywhere,
            rest_angle_rad=0.0,
        )


def session(plant: Plant, *, ringing: bool = False) -> Session:
    """Return the exact response to the chirp.

    With `ringing` the beam is shaken for 4 s, until 1 s before the record.
    """
    before_s = 5.0 if ringing else 0.0
    n = round((before_s + 136) * RATE_HZ)
    t = np.arange(n) / RATE_HZ - before_s - 1
    chirp = 0.025 * np.sin(2 * np.pi * (0.05 * t + (50 - 0.05) * t**2 / 240))
    reference = np.where((t >= 0) & (t < 120), chirp, 0.0)
    shaken = t < -2
    reference[shaken] = 0.01 * np.sin(2 * np.pi * 2.6 * (t[shaken] - t[0]))
    padded = 4 * n
    decay = np.exp(-5.0 * np.arange(n) / n)
    s = 5.0 * RATE_HZ / n + 2j * np.pi * np.fft.rfftfreq(padded, 1 / RATE_HZ)
    loop = 2 * np.pi * 20
    angle = np.fft.rfft(reference * decay, padded) / (1 + 1.4 * s / loop + (s / loop) ** 2)
    torque = angle * (transfer(s, plant.beam, plant.damping) + plant.tool_inertia_kg_m2 * s**2)
    torque *= np.exp(-s * plant.delay_s)
    first = round(before_s * RATE_HZ)
    return Session(plant, *((np.fft.irfft(x, padded)[:n] / decay)[first:] for x in (angle, torque)))


class Peer:
    """Independent computation of the same sum of squares, for a global search."""

    def __init__(self, measurement: Measurement, name: str, analysis: RecordAnalysis) -> None:
        self.comparison = Comparison.from_measurement(measurement, (0.0, 50.0))
        self.unknowns = Unknowns.for_structure(STRUCTURES[name], Plant(LINK, Damping()), SETTINGS)
        self.weight = analysis.noise.weight

    def cost(self, x: NDArray[np.float64]) -> float:
        """Return the sum of squares, with the free decay projected out."""
        comparison, plant = self.comparison, self.unknowns.plant(x)
        torque, _ = comparison.torque_predictor.torque(plant)
        residual = comparison.spectrum(torque - comparison.torque_nm[comparison.retained_samples])
        residual *= self.weight
        poles = plant.mode_poles(comparison.visible_mode_count, ())
        columns = comparison.decay_spectra.spectra(poles) * self.weight
        gram = (columns.conj() @ columns.T).real
        projection = (columns.conj() @ residual).real
        scale = np.sqrt(np.diag(gram))
        scale[scale == 0] = 1.0
        inside = np.linalg.solve(
            gram / np.outer(scale, scale) + 1e-12 * np.eye(scale.size), projection / scale
        )
        return float(np.vdot(residual, residual).real - inside @ (projection / scale))

    def costs(self, population: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the costs of a population, shape (k, members) or (k,)."""
        members = population.reshape(len(self.unknowns.names), -1).T
        return np.array([self.cost(x) for x in members])


def cpu_s(work: Callable[[], object], repeats: int = 5) -> float:
    """Return the least CPU time of several runs, in s."""
    spent = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        spent.append(time.process_time() - start)
    return min(spent)


def times(plant: str) -> None:
    """Print the time of every structure on one session, alone and together."""
    measurement = session(Plant(LINK, PLANTS[plant])).measured(1)
    print(f"\nPlant of type {plant}, CPU s")
    for name, structure in STRUCTURES.items():
        spent = cpu_s(lambda one=structure: fit_record(measurement, [one]))
        print(f"type {name:4} {spent:.3f}", flush=True)
    print(f"all seven {cpu_s(lambda: fit_record(measurement), 3):.3f}", flush=True)


def compare(plant: str, name: str) -> None:
    """Print the minimum and the time of a global search for one structure."""
    from scipy.optimize import differential_evolution

    measurement = session(Plant(LINK, PLANTS[plant])).measured(1)
    spent = cpu_s(lambda: fit_record(measurement, [STRUCTURES[name]]))
    analysis = fit_record(measurement, [STRUCTURES[name]])
    (fit,) = analysis.fits
    peer = Peer(measurement, name, analysis)
    start = time.process_time()
    found = differential_evolution(
        peer.costs,
        list(zip(*peer.unknowns.bounds, strict=True)),
        popsize=15,
        tol=1e-8,
        polish=True,
        vectorized=True,
        updating="deferred",
        seed=7,
    )
    elapsed = time.process_time() - start
    relative = fit.cost / found.fun - 1
    print(
        f"plant {plant}, type {name}: differential evolution {elapsed:.0f} s of CPU, {found.nfev} "
        f"evaluations, cost {found.fun:.6f}; ours {spent:.3f} s, cost {fit.cost:.6f}; ours / "
        f"theirs - 1 = {relative:.1e}{'' if relative < 1e-9 else ' <-- higher'}; "
        f"{elapsed / spent:.0f} times as fast",
        flush=True,
    )


def tool_inertia_of_either_sign(
    measurement: Measurement, analysis: RecordAnalysis, true: Damping
) -> float:
    """Estimate all parameters, with a tool inertia that may be negative, and return it."""
    comparison = Comparison.from_measurement(measurement, (0.0, 50.0))
    unknowns = Unknowns.for_structure(analysis.fits[0].structure, Plant(LINK, Damping()), SETTINGS)
    weight = analysis.noise.weight
    objective = Objective(comparison, unknowns)
    steps = StepRule.for_unknowns(unknowns)
    index = unknowns.names.index("tool_inertia_kg_m2")
    steps.lower[index] = -steps.upper[index]
    first, second = unknowns.omega_rad_s
    sizes = {
        "zeta": math.log(true.zeta * second**true.alpha),
        "alpha": true.alpha,
        "gamma": math.log(
            max(true.gamma, 1e-9) / LINK.density_over_stiffness * first ** (true.lambda_ - 2)
        ),
        "lambda": true.lambda_,
    }
    start = unknowns.start(np.array([sizes[name] for name in unknowns.structure.free]))
    found = descend(
        lambda x: objective.normal_equations(x, weight), start, steps, relative_tolerance=1e-9
    )
    return float(found.x[index]) * LINK.inertia_kg_m2


def wilson(hits: int, of: int) -> tuple[float, float]:
    """Return the 95 % interval of a proportion (E. B. Wilson, JASA 22 (1927) 209-212)."""
    z, fraction = 1.96, hits / of
    middle = (fraction + z * z / (2 * of)) / (1 + z * z / of)
    half = z / (1 + z * z / of) * math.sqrt(fraction * (1 - fraction) / of + z * z / (4 * of * of))
    return middle - half, middle + half


def errors(name: str, count: int, *, undeclared: bool, ringing: bool) -> tuple[float, int, int]:
    """Print the errors of one plant's sessions.

    Return the largest mean error over its limit, the number of intervals that contain the true
    value, and the number of intervals.
    """
    plant = Plant(LINK, PLANTS[name])
    if undeclared:
        plant = Plant(OFF, PLANTS[name], 3e-4, 1e-5)
    made = session(plant, ringing=ringing)
    fits: list[RecordFit] = []
    either_sign: list[float] = []
    spent = 0.0
    for seed in range(count):
        measurement = made.measured(seed)
        start = time.process_time()
        analysis = fit_record(measurement, [STRUCTURES[name]])
        spent += time.process_time() - start
        fits += analysis.fits
        either_sign.append(tool_inertia_of_either_sign(measurement, analysis, PLANTS[name]))
    print(f"\nType {name}, {count} sessions, {spent / count:.3f} s of CPU each")
    print("parameter                    truth  mean error/std  allowed  scatter/std  coverage")
    means, held, intervals_known = [], 0, 0
    for parameter, truth in plant.parameters.items():
        std = np.array([fit.std[parameter] or math.nan for fit in fits])
        if np.isnan(std).all():
            continue
        typical = float(np.nanmedian(std))
        error = np.array([fit.parameters[parameter] for fit in fits]) - truth
        shown = row(parameter, truth, error / typical)
        # A tool inertia of 0 is estimated too large on average; the descent below has no such bias.
        judged = error / typical
        intervals = [fit.interval[parameter] for fit in fits]
        covered = [ends[0] <= truth <= ends[1] for ends in intervals if ends is not None]
        low, high = wilson(sum(covered), len(covered))
        shown += f"  {sum(covered) / len(covered):.3f} [{low:.3f}, {high:.3f}] of {len(covered)}"
        held, intervals_known = held + sum(covered), intervals_known + len(covered)
        if parameter == "tool_inertia_kg_m2":
            shown += ", never negative"
            judged = free_error = (np.array(either_sign) - truth) / typical
            shown += "\n" + row("the same, either sign", truth, free_error)
        mean, allowed = mean_and_allowed(judged)
        means.append(abs(mean) / allowed)
        print(shown)
    return float(np.max(means)), held, intervals_known


def mean_and_allowed(error: NDArray[np.float64]) -> tuple[float, float]:
    """Return the mean of errors in standard deviations, and its limit."""
    return float(error.mean()), 0.25 + 3 * float(error.std()) / math.sqrt(error.size)


def row(name: str, truth: float, error: NDArray[np.float64]) -> str:
    """Return mean and scatter of errors in standard deviations, and the limit of the mean."""
    scatter = float(error.std())
    mean, allowed = mean_and_allowed(error)
    flag = " " if abs(mean) < allowed else "<"
    return f"{name:24} {truth:9.3g} {mean:15.2f} {allowed:7.2f}{flag} {scatter:12.2f}"


def main() -> None:
    """Print times, comparison with the peer, or errors, and check the limits of the errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=8, help="how many to fit of each plant")
    parser.add_argument("--times", action="store_true", help="of every structure, instead")
    parser.add_argument("--peer", choices=STRUCTURES, action="append", help="for this structure")
    parser.add_argument("--plant", choices=PLANTS, action="append", help="only this one")
    parser.add_argument("--undeclared", action="store_true", help="errors in the file's metadata")
    parser.add_argument("--ringing", action="store_true", help="the beam rings at the start")
    gate = Gate(ROWS, parser)
    given = gate.given
    plants = given.plant or list(PLANTS)
    if given.peer or given.times:
        for plant in plants:
            for name in given.peer or ():
                compare(plant, name)
            if given.times:
                times(plant)
        gate.finish(part=True)
        return
    found = [
        errors(plant, given.sessions, undeclared=given.undeclared, ringing=given.ringing)
        for plant in plants
    ]
    gate.measured("largest mean error", max(largest for largest, _, _ in found))
    held, known = (sum(each[index] for each in found) for index in (1, 2))
    gate.measured("95 % intervals that hold the truth", percent(held, known))
    measurement = session(Plant(LINK, PLANTS["VI"])).measured(1)
    own_s = cpu_s(lambda: fit_record(measurement, [STRUCTURES["VI"]]), 3)
    gate.measured("all seven structures", cpu_s(lambda: fit_record(measurement), 3) / own_s)
    gate.finish()


if __name__ == "__main__":
    main()
