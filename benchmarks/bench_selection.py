"""Selection of structures: the share of verdicts that are right, over many simulated sessions.

``bench_selection.py --sessions N [--case NAME ...]`` judges N sessions of each case and prints the
share of right verdicts with its 95 % interval, and how often each structure was selected. A verdict
is right if the structure is, if everything that is in the record has been named, and if nothing
else has. Type VI of Table 5 has alpha = 0.996 with a standard deviation of 0.003: type VII, which
is it with alpha = 1, is right as well, and so is an alpha that stays open between the two; "VI,
alpha 0.8" shows the selection of type VI itself.

The sessions are those of ``bench_record_fit.py``. The stiffness that rises with the deflection is
simulated in time, mode 1 alone, by Runge and Kutta's method on its equation of motion; what it
differs by from the linear mode is added to the exact torque.
"""

import argparse
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from bench_record_fit import LINK, OFF, PLANTS, RATE_HZ, Session, session, wilson
from numpy.typing import NDArray

from analysis.selection import Selection, select
from analysis.whole_record import Plant
from rigd.beam import Beam, Damping, clamped_free_eigenvalues, participation, transfer

HALF_FRACTIONAL = Damping(zeta=2.49e-4, alpha=0.8, gamma=5.5e-2, lambda_=0.594)
HUM_NM = 0.03
RISE = 0.01
"""Share by which the stiffness of mode 1 is higher at its largest deflection."""


def swept(plant: Plant, highest_hz: float, offsets: tuple[float, ...] = ()) -> Session:
    """Sweep 0.05 Hz to `highest_hz`; modes 2, 3, … stiffer by `offsets`."""
    n = round(136 * RATE_HZ)
    t = np.arange(n) / RATE_HZ - 1
    chirp = 0.025 * np.sin(2 * np.pi * (0.05 * t + (highest_hz - 0.05) * t**2 / 240))
    reference = np.where((t >= 0) & (t < 120), chirp, 0.0)
    decay = np.exp(-5.0 * np.arange(n) / n)
    s = 5.0 * RATE_HZ / n + 2j * np.pi * np.fft.rfftfreq(4 * n, 1 / RATE_HZ)
    loop = 2 * np.pi * 20
    angle = np.fft.rfft(reference * decay, 4 * n) / (1 + 1.4 * s / loop + (s / loop) ** 2)
    beam, damping = plant.beam, plant.damping
    response = transfer(s, beam, damping)
    p = beam.density_kg_per_m * s**2
    p = p + damping.gamma * beam.bending_stiffness_n_m2 * s**damping.lambda_
    q = beam.bending_stiffness_n_m2 * (1 + damping.zeta * s**damping.alpha)
    modes = 1 + len(offsets)
    shares = participation(beam, modes)[1:]
    stiffness = (clamped_free_eigenvalues(modes)[1:] / beam.length_m) ** 4
    for share, k, offset in zip(shares, stiffness, offsets, strict=True):
        moved = k * (1 + offset)
        response = response + share * p * q * (moved / (q * moved + p) - k / (q * k + p))
    torque = angle * response
    return Session(plant, *(np.fft.irfft(x, 4 * n)[:n] / decay for x in (angle, torque)))


def stiffening(made: Session, rise: float) -> Session:
    """Let the stiffness of mode 1 rise with its deflection; damping of order 1 only."""
    linear, largest = _mode_1(made, 0.0)
    torque, _ = _mode_1(made, rise / largest**2)
    return replace(made, torque_nm=made.torque_nm + torque - linear)


def _mode_1(made: Session, cubic: float) -> tuple[NDArray[np.float64], float]:
    """Torque of mode 1 with a force ``k cubic r³``, and the largest relative deflection r."""
    beam, damping, angle_rad = made.plant.beam, made.plant.damping, made.angle_rad
    n, step = angle_rad.size, 1 / RATE_HZ
    spectrum = np.fft.rfft(angle_rad, 2 * n)
    s = 2j * np.pi * np.fft.rfftfreq(2 * n, step)
    angle, speed = (
        (np.fft.irfft(2 * x, 4 * n)[: 2 * n]).tolist() for x in (spectrum, s * spectrum)
    )
    k = float(clamped_free_eigenvalues(1)[0] / beam.length_m) ** 4
    ratio, gamma, zeta = beam.density_over_stiffness, damping.gamma, damping.zeta

    def force(y: float, v: float, a: float, w: float) -> float:
        r = y - a
        return k * (r + zeta * (v - w) + cubic * r * r * r)

    forces, largest, y, v = np.zeros(n), 0.0, 0.0, 0.0
    for i in range(n - 1):
        a, am, az = angle[2 * i : 2 * i + 3]
        w, wm, wz = speed[2 * i : 2 * i + 3]
        forces[i] = f = force(y, v, a, w)
        largest = max(largest, abs(y - a))
        v1, d1 = v, -(gamma * v + f) / ratio
        v2 = v + step / 2 * d1
        d2 = -(gamma * v2 + force(y + step / 2 * v1, v2, am, wm)) / ratio
        v3 = v + step / 2 * d2
        d3 = -(gamma * v3 + force(y + step / 2 * v2, v3, am, wm)) / ratio
        v4 = v + step * d3
        d4 = -(gamma * v4 + force(y + step * v3, v4, az, wz)) / ratio
        y += step / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
        v += step / 6 * (d1 + 2 * d2 + 2 * d3 + d4)
    forces[-1] = forces[-2]
    share = float(participation(beam, 1)[0]) * beam.bending_stiffness_n_m2
    return -share * forces, largest


def humming(made: Session) -> Session:
    """Hum of the mains, just beyond the end of the band."""
    t = np.arange(made.torque_nm.size) / RATE_HZ
    hum = HUM_NM * np.sin(2 * np.pi * 50.01 * t)
    return replace(made, torque_nm=made.torque_nm + hum)


@dataclass(frozen=True, slots=True)
class Case:
    """What is simulated, and what the verdict should be."""

    make: Callable[[], Session]
    structures: frozenset[str]
    uniform: bool = True
    named: frozenset[str] = field(default_factory=frozenset)
    alpha: frozenset[str] = frozenset({"integer", "fractional", "not supported"})

    def right(self, selection: Selection) -> bool:
        """Whether structure, names and what is said of alpha are as they should be."""
        verdict = selection.verdict
        return (
            verdict.structure in self.structures
            and verdict.uniform == self.uniform
            and {found.kind for found in verdict.findings} == self.named
            and verdict.alpha.status in self.alpha
        )


def plant_of(name: str, beam: Beam = LINK, delay_s: float = 0.0, tool: float = 0.0) -> Plant:
    """One of the three plants of the evidence."""
    return Plant(beam, PLANTS[name], delay_s, tool)


RIGHT = {"VI": frozenset({"VI", "VII"}), "III": frozenset({"III"}), "IV": frozenset({"IV"})}
EVERY = frozenset({"I", "II", "III", "IV", "V", "VI", "VII"})
UNDECLARED = frozenset({"delay", "tool inertia", "beam data"})
CASES: dict[str, Case] = {
    **{n: Case(lambda n=n: session(plant_of(n)), RIGHT[n]) for n in PLANTS},
    **{
        f"{n}, undeclared": Case(
            lambda n=n: session(plant_of(n, OFF, 3e-4, 1e-5)), RIGHT[n], named=UNDECLARED
        )
        for n in PLANTS
    },
    "VI, alpha 0.8": Case(
        lambda: session(Plant(LINK, HALF_FRACTIONAL)),
        frozenset({"VI"}),
        alpha=frozenset({"fractional"}),
    ),
    **{
        f"{n}, ringing start": Case(
            lambda n=n: session(plant_of(n), ringing=True),
            RIGHT[n],
            named=frozenset({"ringing start"}),
        )
        for n in PLANTS
    },
    **{
        f"{n}, one visible mode": Case(
            lambda n=n: swept(plant_of(n), 10.0), EVERY, alpha=frozenset({"not identifiable"})
        )
        for n in PLANTS
    },
    **{
        f"{n}, 50 Hz hum": Case(
            lambda n=n: humming(session(plant_of(n))), RIGHT[n], named=frozenset({"hum"})
        )
        for n in PLANTS
    },
    "III, 1 % cubic stiffness": Case(
        lambda: stiffening(session(plant_of("III")), RISE),
        RIGHT["III"],
        named=frozenset({"nonlinear stiffness"}),
        alpha=frozenset({"integer"}),
    ),
    "III, not uniform": Case(
        lambda: swept(plant_of("III"), 50.0, (0.006, -0.013)),
        RIGHT["III"],
        uniform=False,
        named=frozenset({"not uniform"}),
        alpha=frozenset({"integer"}),
    ),
}


def judge(name: str, count: int) -> None:
    """Print how many verdicts of a case are right."""
    case = CASES[name]
    make = cache(case.make)
    hits, spent = 0, 0.0
    chosen: Counter[str] = Counter()
    wrong: Counter[str] = Counter()
    named: dict[str, list[float]] = {}
    for seed in range(1000, 1000 + count):
        measurement = make().measured(seed)
        start = time.process_time()
        selection = select(measurement)
        spent += time.process_time() - start
        verdict = selection.verdict
        chosen[selection.candidates[0].name] += 1
        for found in verdict.findings:
            if found.value is not None:
                named.setdefault(f"{found.kind} ({found.unit})", []).append(found.value)
        if case.right(selection):
            hits += 1
        else:
            kinds = ", ".join(sorted({f.kind for f in verdict.findings})) or "nothing"
            wrong[f"{selection.candidates[0].name}; alpha {verdict.alpha.status}; {kinds}"] += 1
    low, high = wilson(hits, count)
    print(
        f"{name:26} right {hits}/{count} = {hits / count:.3f} [{low:.3f}, {high:.3f}]  "
        f"{spent / count:.2f} s of CPU each; selected {dict(chosen)}"
    )
    for kind, values in named.items():
        print(
            f"    named {kind}: {len(values)} times, mean {np.mean(values):.4g}, "
            f"scatter {np.std(values):.2g}"
        )
    for what, times in wrong.items():
        print(f"    wrong {times} times: {what}", flush=True)


def main() -> None:
    """Judge the cases asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=20, help="how many of each case")
    parser.add_argument("--case", choices=CASES, action="append", help="only this one")
    given = parser.parse_args()
    for name in given.case or CASES:
        judge(name, given.sessions)


if __name__ == "__main__":
    main()
