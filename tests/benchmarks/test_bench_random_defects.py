"""The benchmark of random defects resumes where it ended, and scores the program's output."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import bench_random_defects
import pytest
from bench_random_defects import DefectTask, analyzer_document, evaluate, main, write_record
from cases import further
from defect_records import DefectRecord, simulate
from defect_scores import ScoredDefect, ScoredNumber, score_document
from random_defects import draw, draw_defect

SECONDS = 8.4
"""The first mode resonates 7 s after the beginning."""
MODE = ScoredNumber("f1", "mode", (2.5, 2.5), 2.5, (2.4, 2.6), None)
RIGHT = ScoredDefect(
    1, "none", True, False, 1.0, type="VI", numbers=(MODE,), gate="passed", gate_p=0.5
)


@pytest.fixture
def evaluated(monkeypatch: pytest.MonkeyPatch) -> list[DefectTask]:
    """Replace the evaluation and collect its tasks."""
    tasks = []

    def instead(task: DefectTask) -> ScoredDefect:
        tasks.append(task)
        error = "ValueError: no record" if task.seed == 13 else None
        return replace(RIGHT, seed=task.seed, kind=task.kind or "none", error=error)

    monkeypatch.setattr(bench_random_defects, "evaluate", instead)
    return tasks


def run(monkeypatch: pytest.MonkeyPatch, *options: object) -> int:
    monkeypatch.setattr(sys, "argv", ["bench_random_defects.py", *map(str, options)])
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_benchmark_resumes_where_it_ended(
    evaluated: list[DefectTask],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    file = tmp_path / "scores.jsonl"
    assert run(monkeypatch, "--records", 2, "--first-seed", 5, "--file", file) == 0
    assert run(monkeypatch, "--records", 4, "--first-seed", 5, "--file", file) == 0
    assert [task.seed for task in evaluated] == [5, 6, 7, 8]
    assert [json.loads(line)["seed"] for line in file.read_text().splitlines()] == [5, 6, 7, 8]
    assert "| **all** | 4 |" in capsys.readouterr().out


def test_kinds_are_drawn_in_turn(evaluated: list[DefectTask], monkeypatch: pytest.MonkeyPatch):
    run(monkeypatch, "--records", 5, "--kinds", "tilt", "mass, ")
    kinds = ["mass, sections", "mass, smooth", "tilt"]
    assert [task.kind for task in evaluated] == [*kinds, *kinds[:2]]
    run(monkeypatch, "--records", 1)
    assert evaluated[-1].kind is None
    assert evaluated[-1].seed == 100_000


def test_record_without_a_result_counts_without_stopping(
    evaluated: list[DefectTask],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    assert run(monkeypatch, "--records", 2, "--first-seed", 13) == 1
    assert len(evaluated) == 2
    printed = capsys.readouterr().out
    assert "records without a result: seeds [13]" in printed
    assert "ValueError: no record" in printed


@pytest.mark.further  # as tests/identify/test_mode_starts.py
@pytest.mark.fit
def test_lost_mode_is_reported():
    """With these relaxations the best beam has an order of 0.1, and mode 1 is overdamped in it."""
    found = evaluate(DefectTask(100329, "relaxations", command_line=False, documents=None))
    assert found.not_given == ()
    assert {"f1", "xi1", "f2", "xi2", "f3", "xi3"} <= {
        number.name for number in found.numbers if number.flag is None
    }
    assert not found.wrong


@pytest.mark.further
@pytest.mark.fit
@pytest.mark.parametrize("seed", [100188, 100351])
def test_a_step_in_time_is_no_nonlinear_stiffness(seed: int, tmp_path: Path):
    found = evaluate(DefectTask(seed, "step in time", command_line=False, documents=tmp_path))
    assert not found.false_facts
    assert all(number.flag is not None for number in found.numbers)
    ((headline,),) = (
        json.loads(file.read_text())["headlines"] for file in tmp_path.glob("*e.json")
    )
    assert "a step of the stiffness" in headline["named"][-1]["sentence"]


@pytest.mark.further
@pytest.mark.fit
def test_external_order_of_a_nonuniform_beam_is_no_fact():
    found = evaluate(DefectTask(100330, "tip mass", command_line=False, documents=None))
    assert found.gate == "refused"
    assert not found.false_facts
    flags = {number.name: number.flag for number in found.numbers if number.group == "parameter"}
    assert flags["gamma"] is not None
    assert flags["lambda"] is not None


@pytest.mark.further
@pytest.mark.fit
@pytest.mark.parametrize(
    ("seed", "kind", "reason"),
    [
        (200016, "mass, sections", "would explain the modes, too, with 1.98"),
        (200019, "taper", "the cause of the difference may change this value"),
    ],
)
def test_internal_order_contradicted_by_a_cause_is_flagged(seed, kind, reason):
    found = evaluate(DefectTask(seed, None, command_line=False, documents=None))
    assert (found.kind, found.gate) == (kind, "refused")
    assert not found.wrong
    flags = {number.name: number.flag for number in found.numbers if number.group == "parameter"}
    assert reason in flags["alpha"]


@pytest.mark.further
@pytest.mark.fit
def test_noise_that_begins_near_a_mode_flags_nothing():
    found = evaluate(DefectTask(300060, None, command_line=False, documents=None))
    assert found.coloured
    assert not found.not_given
    assert not found.wrong


@pytest.mark.fit
@pytest.mark.parametrize("seconds", [SECONDS, further(136.0)])
def test_record_is_scored_from_the_document(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: float
):
    def drawn(seed: int, kind: str) -> DefectRecord:
        defect, *others = draw_defect(seed, kind)
        return simulate(seed, defect, *others, seconds)

    monkeypatch.setattr(bench_random_defects, "draw", drawn)
    found = evaluate(DefectTask(0, "none", command_line=False, documents=tmp_path))
    assert found.error is None
    assert (found.kind, found.visible) == ("none", 3 if seconds > SECONDS else 1)
    assert found.cpu_s > 0
    modes = {"f1", "xi1", "f3", "alpha"} if seconds > SECONDS else {"f1", "xi1"}
    assert modes <= {number.name for number in found.numbers}
    assert not found.wrong
    assert not found.false_facts
    if seconds > SECONDS:
        assert found.shift == pytest.approx(0, abs=0.2)
    (headline,) = json.loads((tmp_path / "0-none.json").read_text())["headlines"]
    truth = json.loads((tmp_path / "0-none.truth.json").read_text())
    assert score_document(truth, headline, found.cpu_s).numbers == found.numbers


@pytest.mark.fit
@pytest.mark.further  # as `make bench`
def test_program_prints_the_same_document(tmp_path: Path):
    write_record(draw(0, "none"), tmp_path / "record.mcap")
    here, there = (
        json.loads(analyzer_document(tmp_path / "record.mcap", command_line=command_line)[0])
        for command_line in (False, True)
    )
    assert here == there
