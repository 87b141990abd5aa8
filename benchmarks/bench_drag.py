"""Air drag: whether it is identified, the precision of C_D d, and false findings.

``bench_drag.py [--every K] [--count N] [--first SEED] [--none N] [--processes P]`` evaluates N
records of every K-th cell (wires of 0.5, 1 and 2 mm, chirps of 0.025, 0.0125 and 0.00625 rad, C_D
constant or White's, with external damping or without), made with independent equations of motion
(`wrong_models.py`), and N records of the beam without air, alternately of integer and fractional
orders. A line for each record: C_D d over the true value at the speed for which it is reported, its
standard deviation, its error in standard deviations, other findings, and the worst error of a
number reported without a flag. Then the counts.
"""

from __future__ import annotations

import argparse
import itertools
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

from bench_wrong_models import Verdict, errors_of
from gate import Gate, Row, percent
from wrong_models import RIGS, Drag, Record, drags, record

from analysis.identify import select

AMPLITUDES_RAD = (0.025, 0.0125, 0.00625)
DIAMETERS_M = (0.5e-3, 1e-3, 2e-3)
FALSE = ("delay", "beam data", "tool inertia", "rival explanations")
"""Kinds of findings for which drag was mistaken."""
ROWS = (
    # Measured values: docs/validation/structure_selection.md.
    Row("drag named", least=100, unit="% of the records with air"),
    Row("95 % intervals of C_D d that hold the truth", least=75, unit="%"),
    Row("worst error without a flag", most=5, unit="standard deviations"),
    Row("false delay, density, stiffness or modes", most=5, unit="% of the records with air"),
    Row("drag named without air", most=0, unit="%"),
)


@dataclass(frozen=True, slots=True)
class Line:
    """Result of one record."""

    wire: Drag | None
    drag: tuple[float, float, float] | None
    """C_D d, its standard deviation, and the speed for which it is reported."""
    kinds: tuple[str, ...]
    worst: tuple[float, str]
    cpu_s: float

    @property
    def error(self) -> float:
        """Error of C_D d, in standard deviations."""
        assert self.drag is not None and self.wire is not None
        value, std, speed = self.drag
        return (value - self.wire.true_m(speed)) / std

    @property
    def known_to(self) -> float:
        """Standard deviation of C_D d over the true value."""
        assert self.drag is not None and self.wire is not None
        _, std, speed = self.drag
        return std / self.wire.true_m(speed)

    def text(self) -> str:
        """Return a row of the table."""
        where = "none" if self.wire is None else (
            f"{1e3 * self.wire.diameter_m:3g} mm, {self.wire.amplitude_rad:7g} rad, "
            f"{'White' if self.wire.cylinder else 'const'}, gamma {self.wire.rig.gamma:5g}"
        )  # fmt: skip
        found = "not named"
        if self.drag is not None and self.wire is not None:
            value, std, speed = self.drag
            true = self.wire.true_m(speed)
            found = (
                f"{value / true:.4f} ± {std / true:.4f} at {speed:4.2f} m/s, {self.error:+.1f} std"
            )
        return f"{where:44} {found:44} {self.cpu_s:5.1f} s  {', '.join(self.kinds)}  {self.worst}"


def evaluate(wire: Drag | None, made: Record) -> Line:
    """Evaluate one record."""
    start = time.process_time()
    selection = select(made.measurement())
    cpu_s = time.process_time() - start
    one = Verdict(selection, dict(errors_of(made, selection)), cpu_s)
    drag = selection.headline.parameters.get("drag")
    speed_m_s = selection.headline.drag_speed_m_s
    return Line(
        wire,
        None if drag is None or speed_m_s is None else (drag.value, drag.std, speed_m_s),
        tuple(dict.fromkeys(finding.kind for finding in selection.verdict.findings)),
        one.worst,
        cpu_s,
    )


def main() -> None:
    """Evaluate the requested records."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--every", type=int, default=7, help="which of the 36 cells")
    parser.add_argument("--count", type=int, default=1, help="records of each of these")
    parser.add_argument("--none", type=int, default=3, help="records without air")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--processes", type=int, default=1)
    gate = Gate(ROWS, parser)
    given = gate.given
    beam = RIGS["III"]
    cells = [
        Drag(replace(beam, gamma=gamma), diameter_m, amplitude_rad, cylinder)
        for amplitude_rad, diameter_m, cylinder, gamma in itertools.product(
            AMPLITUDES_RAD, DIAMETERS_M, (False, True), (beam.gamma, 0.0)
        )
    ]
    wires = cells[:: given.every] * given.count
    seeds = [given.first + number for number in range(len(wires))]
    jobs: list[tuple[Drag | None, Record]] = list(zip(wires, drags(wires, seeds), strict=True))
    rigs = itertools.cycle(RIGS.values())
    jobs += [(None, record(next(rigs), given.first + seed)) for seed in range(given.none)]
    lines = []
    with ProcessPoolExecutor(given.processes) as pool:
        for line in pool.map(evaluate, *zip(*jobs, strict=True)):
            lines.append(line)
            print(line.text(), flush=True)
    there = [line for line in lines if line.wire is not None]
    named = [line for line in there if line.drag is not None]
    held = [abs(line.error) < 1.959964 for line in named]
    free = [line for line in lines if line.wire is None]
    for amplitude_rad in AMPLITUDES_RAD:
        known_to = [
            line.known_to
            for line in named
            if line.wire is not None and line.wire.amplitude_rad == amplitude_rad
        ]
        least, most = min(known_to, default=0.0), max(known_to, default=0.0)
        print(f"standard deviation at {amplitude_rad:g} rad: {least:.2%} to {most:.2%}")
    print(f"processor: median {sorted(line.cpu_s for line in lines)[len(lines) // 2]:.1f} s")
    gate.measured("drag named", percent(len(named), len(there)))
    gate.measured("95 % intervals of C_D d that hold the truth", percent(sum(held), len(held)))
    gate.measured("worst error without a flag", max(line.worst for line in lines)[0])
    false = sum(_false(line) for line in there)
    gate.measured("false delay, density, stiffness or modes", percent(false, len(there)))
    named_free = sum(line.drag is not None for line in free)
    gate.measured("drag named without air", percent(named_free, len(free)))
    gate.finish()


def _false(line: Line) -> bool:
    return any(kind in FALSE for kind in line.kinds)


if __name__ == "__main__":
    main()
