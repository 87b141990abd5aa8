"""All fits of one session: their times, and their minima against other searches on the same cost.

Peers, on all points: scipy.optimize.least_squares with analytic derivatives from random starts (12,
``--starts N``), and a fine grid around the minimum. With ``--peer TYPE`` (repeatable) the only peer
is scipy.optimize.differential_evolution, on the same cost and bounds: processor time of one run of
it, and the least of five of ours.
"""

import argparse
import itertools
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from gate import Gate, Row
from scipy.optimize import differential_evolution, least_squares
from timing import least_s

from analysis.models import STRUCTURES, Structure
from analysis.paper import fit_frf, fit_many
from rigd.beam import Beam, Damping, TransferGrid
from rigd.session import read_session
from rigd.spectral import FrequencyResponse, welch_response

LINK = Beam(length_m=0.98, density_kg_per_m=4.7e-3, bending_stiffness_n_m2=0.090275)
ORDERS = ("alpha", "lambda")
ROWS = (
    # Measured 0.76 to 1.5.
    Row("slowest fit", most=2, unit="times a random start"),
    # Beyond 1e-9 a minimum would be missed.
    Row("cost over the lowest of the random starts, - 1", most=1e-9),
    Row("cost over the lowest of the grid, - 1", most=1e-9),
    # Measured 0.99: they share the grid of frequencies.
    Row("twelve fits", most=1.2, unit="times one after the other"),
)
GRID_STEPS = {1: 201, 2: 41, 3: 13, 4: 7}  # points an axis, by the number of unknowns


def session() -> FrequencyResponse:
    """Return Welch's estimate of a session of the shipped simulated rig."""
    with tempfile.TemporaryDirectory() as folder:
        rigd = Path(sys.executable).with_name("rigd")
        command = [rigd, "run", "chirp", "--fast", "--no-look", "--seed", "1", "--output", folder]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        (path,) = Path(folder).glob("*.mcap")
        found = read_session(path)
    samples = found.samples[slice(*found.segments["sweep"])]
    angle, torque = samples["angle_rad"], samples["coupling_torque_nm"]
    return welch_response(angle, torque, found.number("rate_hz")).band(0.5875, 50.0)


class Peer:
    """The cost in ln zeta, alpha, ln gamma and lambda, for one structure and weighting."""

    def __init__(self, frf: FrequencyResponse, structure: Structure, weighting: str) -> None:
        omega = 2 * np.pi * frf.frequency_hz
        p = np.ones_like(omega) if weighting == "const" else 1 / omega
        self.weights = p / p.sum()
        self.measured = frf.response
        self.grid = TransferGrid(1j * omega)
        self.structure = structure
        self.low = np.array([0.001 if name in ORDERS else -16.0 for name in structure.free])
        self.high = np.array([1.999 if name in ORDERS else 4.0 for name in structure.free])

    def damping(self, x: np.ndarray) -> Damping:
        """Return the damping at `x`."""
        free = zip(self.structure.free, map(float, x), strict=True)
        return self.structure.damping(
            {name: v if name in ORDERS else math.exp(v) for name, v in free}
        )

    def cost(self, x: np.ndarray) -> float:
        """Return the cost of Eq. (26) on all points."""
        deviation = self.grid.evaluate(LINK, self.damping(x)) - self.measured
        return float(self.weights @ np.abs(deviation) ** 2)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return weighted residuals, real parts before imaginary ones."""
        r = np.sqrt(self.weights) * (self.grid.evaluate(LINK, self.damping(x)) - self.measured)
        return np.concatenate((r.real, r.imag))

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Return the derivative of `residual` with respect to `x`."""
        _, gradient = self.grid.evaluate_with_gradient(LINK, self.damping(x), self.structure.free)
        named = zip(self.structure.free, x, strict=True)
        chain = np.array([1.0 if name in ORDERS else math.exp(v) for name, v in named])
        j = (np.sqrt(self.weights) * chain[:, None] * gradient).T
        return np.concatenate((j.real, j.imag))

    def random_starts(self, rng: np.random.Generator, starts: int) -> list[float]:
        """Return the costs at which descents from random starts end."""
        return [
            2
            * least_squares(
                self.residual,
                rng.uniform(self.low, self.high),
                self.jacobian,
                bounds=(self.low, self.high),
                max_nfev=60,
            ).cost
            for _ in range(starts)
        ]

    def local_grid(self, parameters: Mapping[str, float]) -> float:
        """Return the lowest cost on a grid: damping at the modes ±5 %, orders ±0.05."""
        names = self.structure.free
        centre = [parameters[n] if n in ORDERS else math.log(parameters[n]) for n in names]
        axis = np.linspace(-0.05, 0.05, GRID_STEPS[len(names)])
        lowest = math.inf
        for steps in itertools.product(axis, repeat=len(names)):
            x = np.array(centre) + steps
            for coefficient, order, rad_s in (("zeta", "alpha", 134.0), ("gamma", "lambda", 19.0)):
                if coefficient in names and order in names:
                    x[names.index(coefficient)] -= steps[names.index(order)] * math.log(rad_s)
            lowest = min(lowest, self.cost(np.clip(x, self.low, self.high)))
        return lowest


def main() -> None:
    """Print one line per fit, and check the limits of the worst."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peer", choices=STRUCTURES, action="append", help="for this structure")
    parser.add_argument("--starts", type=int, default=12, help="of each fit's peer")
    gate = Gate(ROWS, parser)
    frf = session()
    if gate.given.peer:
        for name in gate.given.peer:
            against_evolution(frf, STRUCTURES[name])
        gate.finish(part=True)
        return
    six = [STRUCTURES[name] for name in ("I", "II", "III", "IV", "V", "VI")]
    twelve = least_s(lambda: fit_many(frf.frequency_hz, frf.response, LINK, six), 10)
    print(f"Twelve fits of one session, best of ten: {twelve:.3f} s")
    print(
        f"Peer: {gate.given.starts} random starts of scipy least_squares on all points, "
        "and a local grid"
    )
    print("type weights       cost      ms   random ms  ratio  lowest/ours-1  reached  grid/ours-1")
    rng = np.random.default_rng(161_803)
    ratios, times, missed, grids = [], [], [], []
    for structure in STRUCTURES.values():
        for weighting in ("const", "omega"):
            ours = partial(fit_frf, frf.frequency_hz, frf.response, LINK, structure, weighting)
            fit, spent = ours(), least_s(ours, 3)
            peer = Peer(frf, structure, weighting)
            start = time.perf_counter()
            ends = np.array(peer.random_starts(rng, gate.given.starts))
            random_spent = time.perf_counter() - start
            reached = np.mean(ends < fit.cost * (1 + 1e-4))
            grid = peer.local_grid(fit.parameters)
            ratios.append(spent / random_spent * gate.given.starts)
            if structure in six:
                times.append(spent)
            missed.append(fit.cost / ends.min() - 1)
            grids.append(fit.cost / grid - 1)
            print(
                f"{structure.name:4} {weighting:6} {fit.cost:12.7f} {spent * 1e3:7.1f} "
                f"{random_spent * 1e3:11.0f} {random_spent / spent:6.0f} "
                f"{ends.min() / fit.cost - 1:14.1e} {reached:8.0%} "
                f"{grid / fit.cost - 1:12.1e}",
                flush=True,
            )
    gate.measured("slowest fit", max(ratios))
    gate.measured("cost over the lowest of the random starts, - 1", max(missed))
    gate.measured("cost over the lowest of the grid, - 1", max(grids))
    gate.measured("twelve fits", twelve / sum(times))
    gate.finish()


def against_evolution(frf: FrequencyResponse, structure: Structure) -> None:
    """Print cost and processor time of ours and of a global search on the same cost."""
    for weighting in ("const", "omega"):
        peer = Peer(frf, structure, weighting)
        spent = math.inf
        for _ in range(5):
            start = time.process_time()
            fit = fit_frf(frf.frequency_hz, frf.response, LINK, structure, weighting)
            spent = min(spent, time.process_time() - start)
        start = time.process_time()
        evolved = differential_evolution(
            lambda points, of=peer: np.array(
                [of.cost(x) for x in points.reshape(len(of.low), -1).T]
            ),
            list(zip(peer.low, peer.high, strict=True)),
            popsize=15,
            tol=1e-8,
            polish=True,
            vectorized=True,
            updating="deferred",
            seed=5,
        )
        took = time.process_time() - start
        found = peer.cost(evolved.x)
        print(
            f"{structure.name:4} {weighting:6} differential evolution {took:6.1f} s, "
            f"{evolved.nfev} calls; ours {spent:.3f} s, {took / spent:.0f} times as fast, "
            f"cost ours / theirs - 1 = {fit.cost / found - 1:.1e}",
            flush=True,
        )


if __name__ == "__main__":
    main()
