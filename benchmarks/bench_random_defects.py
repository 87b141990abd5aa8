"""Results of the analyzer on random defects: wrong numbers without a flag, and flagged ones.

``bench_random_defects.py [--records N] [--first-seed S] [--jobs J]`` draws N rigs (see
`random_defects`), writes the record of each as a session, analyses it as ``analyze --json`` does
and compares the document with the truth (see `defect_scores`). It prints the errors of each record,
a table by kind, the coverage of the 95 % intervals, and the limits that are exceeded. Seeds below
10000 serve development; published figures are of seeds from 100000 on.

``--file FILE`` appends a line for each record and does not evaluate again those already there;
``--kinds TEXT ...`` draws these kinds in turn instead of random ones; ``--command-line`` runs the
program itself with its report, which takes longer and prints the same document; ``--document DIR``
writes each document there. 400 records take about a quarter of an hour on two cores.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from defect_records import (
    DENSITY_KG_PER_M,
    LENGTH_M,
    RATE_HZ,
    REST_S,
    STIFFNESS_N_M2,
    SWEEP_S,
    DefectRecord,
)
from defect_scores import (
    ScoredDefect,
    complaints,
    coverage,
    gate_passes,
    score_document,
    table,
    totals,
)
from gate import Gate, Row, percent
from random_defects import KINDS, draw
from uniform_shift import headline_shift

from analysis.exchange import write_session
from analysis.models import WelchSettings
from analysis.report import document, document_text
from analysis.results import AnalysisOptions, record_result
from rigd.runtime.background import use_one_thread

_STATED = {
    "id": "defect",
    "excitation": "chirp",
    "rate_hz": f"{RATE_HZ:g}",
    "beam_length_m": repr(LENGTH_M),
    "beam_density_kg_per_m": repr(DENSITY_KG_PER_M),
    "beam_bending_stiffness_n_m2": repr(STIFFNESS_N_M2),
}
"""Metadata of the specimen in the file, the same for all true values."""
ROWS = (
    Row("limits of defect_scores.complaints exceeded", most=0),
    # 93 % is required for many records; six have some 36 such intervals. Measured 89 % of three.
    Row("95 % intervals of modes that hold the truth", least=80, unit="%"),
)
HEADLINE_UNIFORMITY = 1e-3
"""Tolerance of the geometry that the analyzer uses by default."""


@dataclass(frozen=True, slots=True)
class DefectTask:
    """A record to evaluate, and options."""

    seed: int
    kind: str | None
    command_line: bool
    documents: Path | None


def write_record(made: DefectRecord, path: Path) -> None:
    """Write a record as a session file.

    Parameters
    ----------
    made : DefectRecord
    path : Path
        New file.
    """
    end = made.torque_nm.size
    first, last = (min(round(t * RATE_HZ), end) for t in (REST_S, REST_S + SWEEP_S))
    segments = {"rest": (0, first), "sweep": (first, last), "ring_down": (last, end)}
    write_session(
        path,
        {
            "tick": np.arange(end),
            "angle_reference_rad": made.reference_rad,
            "angle_rad": made.angle_rad,
            "coupling_torque_nm": made.torque_nm,
        },
        rate_hz=RATE_HZ,
        start_utc_ns=0,
        metadata=_STATED,
        segments={name: ends for name, ends in segments.items() if ends[0] < ends[1]},
        warnings=(),
    )


def analyzer_document(path: Path, *, command_line: bool) -> tuple[str, float]:
    """Return the document that ``analyze --json -`` prints, and the processor time in seconds.

    Parameters
    ----------
    path : Path
        Session file.
    command_line : bool
        Run the program, which also draws a report, instead of its functions in this process.
    """
    if command_line:
        options = ("--method", "record", "--report", str(path.with_suffix("")), "--json", "-")
        start = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", "analysis", str(path), *options],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
        return done.stdout, time.monotonic() - start
    options = AnalysisOptions(
        WelchSettings(), with_welch_fits=False, whole_record=True, fixed_parameters=()
    )
    start = time.process_time()
    result = record_result(path, options)
    spent_s = time.process_time() - start
    return document_text(document([result]), ascii_only=True), spent_s


def evaluate(task: DefectTask) -> ScoredDefect:
    """Draw a rig, make and analyse its record, and compare the document with the truth."""
    use_one_thread()
    warnings.simplefilter("ignore")
    made = draw(task.seed, task.kind)
    truth = json.loads(json.dumps(made.truth()))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"defect-{task.seed}.mcap"
        write_record(made, path)
        try:
            text, spent_s = analyzer_document(path, command_line=task.command_line)
        except Exception as error:  # counted; the next record is evaluated
            noise = truth["noise"]
            return ScoredDefect(
                task.seed, truth["kind"], truth["linear_constant"],
                bool(noise["corner_hz"] or noise["bumps"]), 0.0,
                error=f"{type(error).__name__}: {error}",
            )  # fmt: skip
    if task.documents is not None:
        name = f"{task.seed}-{truth['kind'].replace(', ', '-').replace(' ', '-')}"
        (task.documents / f"{name}.json").write_text(text)
        (task.documents / f"{name}.truth.json").write_text(json.dumps(truth, indent=2))
    (headline,) = json.loads(text)["headlines"]
    found = score_document(truth, headline, spent_s)
    return replace(
        found,
        shift=headline_shift(truth, headline, HEADLINE_UNIFORMITY),
        exact_shift=headline_shift(truth, headline, 0.0),
    )


def tasks(given: argparse.Namespace, done: set[tuple[int, str | None]]) -> list[DefectTask]:
    """List the tasks that are not done yet."""
    kinds = [
        kind for kind in KINDS
        if any(kind == text if text in KINDS else text in kind for text in given.kinds)
    ]  # fmt: skip
    seeds = range(given.first_seed, given.first_seed + given.records)
    pairs = zip(seeds, itertools.cycle(kinds or [None]), strict=False)
    evaluated = {seed for seed, _ in done}
    return [
        DefectTask(seed, kind, given.command_line, given.document)
        for seed, kind in pairs
        if seed not in evaluated
    ]


def evaluate_all(wanted: list[DefectTask], jobs: int) -> Iterator[ScoredDefect]:
    """Yield the scores of tasks, from several processes."""
    if jobs == 1:
        yield from map(evaluate, wanted)
        return
    with ProcessPoolExecutor(jobs) as pool:
        for future in as_completed([pool.submit(evaluate, task) for task in wanted]):
            yield future.result()


def described(record: ScoredDefect) -> str:
    """Return one line on a record: its wrong, false and missing results."""
    parts = [f"{each.name} {each.deviation:.1f} std" for each in record.wrong]
    parts += [f"false: {fact}" for fact in record.false_facts]
    if record.not_given and record.linear_constant:
        parts.append(f"not given: modes {', '.join(map(str, record.not_given))}")
    if record.error is not None:
        parts.append(record.error)
    gate = "" if record.gate is None else f", gate {record.gate} (p {record.gate_p})"
    shift = "" if record.shift is None else f", shift {record.shift:.3g}"
    what = "; ".join(parts) or "right"
    return f"{record.seed} {record.kind} [{record.type}{gate}{shift}]: {what}"


def main() -> None:
    """Evaluate the records, print the scores and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=6)
    parser.add_argument("--first-seed", type=int, default=100_000)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--kinds", nargs="+", default=[], help="draw these in turn")
    parser.add_argument("--file", type=Path, help="one line a record; goes on where it ends")
    parser.add_argument("--command-line", action="store_true", help="run the program itself")
    parser.add_argument("--document", type=Path, help="folder for the documents and truths")
    gate = Gate(ROWS, parser)
    given = gate.given
    if given.document is not None:
        given.document.mkdir(parents=True, exist_ok=True)
    last = given.first_seed + given.records
    done: list[ScoredDefect] = []
    if given.file and given.file.exists():
        lines = given.file.read_text().splitlines()
        there = (ScoredDefect.from_line(line) for line in lines)
        done = [each for each in there if given.first_seed <= each.seed < last]
    wanted = tasks(given, {(each.seed, each.kind) for each in done})
    for found in evaluate_all(wanted, given.jobs):
        done.append(found)
        print(described(found), flush=True)
        if given.file:
            with given.file.open("a") as file:
                file.write(found.line() + "\n")
    done.sort(key=lambda each: each.seed)
    print(f"\n{table(done)}\n\n95 % intervals that hold the truth:\n{coverage(done)}")
    print("\nDefects that move it by more than its standard deviation and pass the gate:")
    for what, exact in (("headline", False), ("value for exact geometry", True)):
        passed, moved = gate_passes(done, exact=exact)
        print(f"    {what}: {passed} of {moved}")
    missed = complaints(done)
    print(f"\nLimits exceeded: {len(missed) or 'none'}")
    for line in missed:
        print(f"    {line}")
    print()
    gate.measured("limits of defect_scores.complaints exceeded", len(missed))
    its = totals(done)
    gate.measured("95 % intervals of modes that hold the truth", percent(its.inside, its.intervals))
    gate.finish()


if __name__ == "__main__":
    main()
