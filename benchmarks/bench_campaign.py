"""Time and memory of a campaign on 2 cores, and processor time of its Welch fits.

Usage: python benchmarks/bench_campaign.py [FOLDER] [--sessions 6]

FOLDER contains the sessions; if it is empty, they are recorded into it, without FOLDER into a
temporary folder. They come from the simulated rig under its virtual clock. The published figures
are of twenty sessions, which take minutes to record.

Wall time depends on the other programs on the computer. CPU time, of this process and its workers,
does not; half of it is the least wall time on two otherwise idle cores.

Peers: the same Welch fits one after the other in this process; and, for the minima found,
Nelder-Mead from random starts on all points of the same cost (scipy), compared in CPU time too.
The global search is repeated for every session.
"""

import argparse
import math
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from gate import Gate, Row
from numpy.typing import NDArray
from timing import spent_cpu_s

from analysis.campaigns import SessionTask, analyse_session, campaign
from analysis.campaigns.workers import process_pool
from analysis.identify import BAND_HZ
from analysis.models import (
    DampingUnknowns,
    WelchSettings,
    weights,
)
from analysis.paper import fit_many
from analysis.record_part import RecordSource
from analysis.report.campaign_report import write_campaign
from rigd.beam import Damping, Plant, ResponseGrid

JOBS = 2
STARTS = 4
ROWS = (
    # For twenty sessions, a minute on two idle cores; the time of the validation is constant.
    Row("campaign, CPU time a session", most=6, unit="s"),
    Row("memory of a worker", most=1000, unit="MB"),
    # Measured 8e-14 and 0.075.
    Row("cost of the Welch fits over that of random starts, - 1", most=1e-6),
    Row("slowest of the Welch fits, CPU time", most=0.2, unit="times the random starts"),
)


def recorded(folder: Path, sessions: int) -> list[Path]:
    """Return the sessions of a folder; record them if it has none."""
    if not any(folder.glob("*.mcap")):
        rigd = Path(sys.executable).with_name("rigd")
        command = [
            rigd,
            "run",
            "chirp",
            "--fast",
            "--no-look",
            "--seed",
            "1",
            "--repeat",
            str(sessions),
        ]
        subprocess.run([*command, "--output", folder], check=True, stdout=subprocess.DEVNULL)
    return sorted(folder.glob("*.mcap"))


def welch_only(paths: list[Path]) -> int:
    """Fit by the Welch method alone, on two workers; their start is part of the time."""
    task = SessionTask(WelchSettings(), (), (), BAND_HZ)
    with process_pool(JOBS) as pool:
        results = pool.run(analyse_session, [(RecordSource(path), task) for path in paths])
    return sum(len(result.welch_models) for result in results)


def _cost(
    measured: NDArray[np.complex128],
    response_grid: ResponseGrid,
    plant: Plant,
    unknowns: DampingUnknowns,
    weight: NDArray[np.float64],
    x: NDArray[np.float64],
) -> float:
    """Return the cost of Eq. (26)."""
    (response,) = response_grid.evaluate(replace(plant, damping=unknowns.damping(x)))
    return float(weight @ np.abs(response - measured) ** 2)


def searched(path: Path) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the excess cost of each fit over the best of Nelder-Mead, and the ratio of CPU times.

    Nelder-Mead starts at random points and uses all points of the response. The excess is relative.
    """
    from scipy.optimize import minimize

    result = analyse_session(RecordSource(path), SessionTask(WelchSettings(), (), (), BAND_HZ))
    response_grid = ResponseGrid(2j * np.pi * result.frequency_hz)
    plant = Plant(result.beam, Damping(), tool_inertia_kg_m2=result.tool_inertia_kg_m2)
    rng = np.random.default_rng(0)
    found = {}
    for fit in (model.fit for model in result.welch_models):
        structure = fit.structure
        unknowns = DampingUnknowns.for_beam(structure, result.beam)
        low, high = unknowns.bounds
        low = np.maximum(low, math.log(1e-5))
        weight = weights(2 * np.pi * result.frequency_hz, fit.weighting)
        cost = partial(_cost, result.response, response_grid, plant, unknowns, weight)
        begun = time.process_time()
        ends = [
            minimize(
                cost, rng.uniform(low, np.minimum(high, 2.0)), method="Nelder-Mead",
                bounds=list(zip(low, high, strict=True)),
                options={"maxfev": 600, "xatol": 1e-5, "fatol": 1e-9},
            ).fun
            for _ in range(STARTS)
        ]  # fmt: skip
        peer_s = time.process_time() - begun
        begun = time.process_time()
        fit_many(
            result.frequency_hz, result.response, result.beam, [structure], [fit.weighting],
            tool_inertia_kg_m2=result.tool_inertia_kg_m2,
        )  # fmt: skip
        ratio = peer_s / (time.process_time() - begun)
        found[structure.name, fit.weighting] = fit.cost / min(ends) - 1, ratio
    return found


class Watch:
    """Stopwatch of wall and CPU time."""

    def __init__(self) -> None:
        self.wall, self.cpu = time.perf_counter(), spent_cpu_s()

    def __str__(self) -> str:
        """Return both times; half of the CPU time is the wall time on two idle cores."""
        wall, cpu = time.perf_counter() - self.wall, spent_cpu_s() - self.cpu
        return f"{wall:.1f} s, {cpu:.1f} s of CPU time"


def main() -> None:
    """Print the times and their ratios to the peers, and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--sessions", type=int, default=6, help="that are made")
    gate = Gate(ROWS, parser)
    with tempfile.TemporaryDirectory() as name:
        folder = gate.given.folder or Path(name) / "sessions"
        paths = recorded(folder, gate.given.sessions)
        watch = Watch()
        fits = welch_only(paths)
        print(
            f"{len(paths)} sessions, {fits} Welch fits on {JOBS} workers, reading and all: {watch}"
        )
        task = SessionTask(WelchSettings(), (), (), BAND_HZ)
        begun = time.process_time()
        analyse_session(RecordSource(paths[0]), task)
        alone_s = time.process_time() - begun
        print(f"  in this process {alone_s:.2f} s of CPU time a session")
        report = Path(name) / "report"
        report.mkdir()
        watch = Watch()
        found = campaign(paths, jobs=JOBS)
        cpu = spent_cpu_s() - watch.cpu
        print(f"Campaign with selection on every whole record and validation: {watch}")
        gate.measured("campaign, CPU time a session", cpu / len(paths))
        if found.verdict is not None:
            print(*(f"  {sentence}" for sentence in found.verdict.sentences), sep="\n")
        watch = Watch()
        write_campaign(found, report)
        print(f"Figures and tables: {watch}")
        for who, what in (
            ("this process", resource.RUSAGE_SELF),
            ("a worker", resource.RUSAGE_CHILDREN),
        ):
            print(f"  most memory of {who}: {resource.getrusage(what).ru_maxrss / 1024:.0f} MB")
        worker_kib = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
        gate.measured("memory of a worker", worker_kib / 1024)
        print(
            f"Cost over that of {STARTS} random starts with Nelder-Mead - 1 (0: the same minimum), "
            "and CPU time of these over that of the fit"
        )
        found_costs = searched(paths[0])
        for (structure, weighting), (excess, ratio) in found_costs.items():
            print(f"  {structure:4} {weighting:6} {excess:+.1e} {ratio:6.0f}", flush=True)
        excesses, ratios = zip(*found_costs.values(), strict=True)
        gate.measured("cost of the Welch fits over that of random starts, - 1", max(excesses))
        gate.measured("slowest of the Welch fits, CPU time", 1 / min(ratios))
    gate.finish()


if __name__ == "__main__":
    main()
