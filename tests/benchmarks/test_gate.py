"""Benchmarks check their rows: one beyond its limit, or not measured, makes the exit code 1."""

import argparse
import ast
import json
import math
import sys
from pathlib import Path

import pytest
import run_all
from gate import Gate, Row, impossible_here, percent

FOLDER = Path(run_all.__file__).parent
ROWS = (
    Row("time", most=2.0, unit="times the peer"),
    Row("coverage", least=90, most=100, unit="%"),
)


def run_benchmark(
    monkeypatch: pytest.MonkeyPatch, values: dict[str, float], *options: str, part: bool = False
) -> int:
    """Run a benchmark with given values; return its exit code."""
    monkeypatch.setattr(sys, "argv", ["bench_example.py", *options])
    gate = Gate(ROWS, argparse.ArgumentParser())
    for name, value in values.items():
        gate.measured(name, value)
    try:
        gate.finish(part=part)
    except SystemExit as end:
        return int(end.code or 0)
    return 0


@pytest.mark.parametrize(
    ("time", "coverage", "failed"),
    [
        (2.0, 90.0, None),
        (2.1, 95.0, "time: 2.1 times the peer (at most 2)"),
        (1.0, 89.0, "coverage: 89 % (at least 90, at most 100)"),
        (1.0, 101.0, "coverage: 101 % (at least 90, at most 100)"),
        (1.0, math.nan, "coverage: nan % (at least 90, at most 100)"),
        (1.0, None, "coverage: not measured (at least 90, at most 100)"),
    ],
)
def test_a_row_beyond_its_limit_fails_and_report_only_prints(
    time: float,
    coverage: float | None,
    failed: str | None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    values = {"time": time} | ({} if coverage is None else {"coverage": coverage})
    assert run_benchmark(monkeypatch, values) == (1 if failed else 0)
    assert capsys.readouterr().err == (f"Beyond its limit: {failed}\n" if failed else "")
    assert run_benchmark(monkeypatch, values, "--report") == 0
    assert f"time: {time:.3g} times the peer (at most 2)" in capsys.readouterr().out


def test_part_is_checked_by_measured_rows_only(monkeypatch: pytest.MonkeyPatch):
    assert run_benchmark(monkeypatch, {"time": 1.0}, part=True) == 0
    assert run_benchmark(monkeypatch, {"time": 3.0}, part=True) == 1


def test_row_needs_a_limit_and_a_declared_name(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(ValueError, match="needs a limit"):
        Row("time")
    with pytest.raises(KeyError):
        run_benchmark(monkeypatch, {"another": 1.0})
    assert math.isnan(percent(0, 0))


def test_summary_names_the_failures(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    file = tmp_path / "rows.json"
    run_benchmark(monkeypatch, {"time": 3.0, "coverage": math.nan}, "--json", str(file))
    found = json.loads(file.read_text())
    assert found["benchmark"] == "example"
    assert run_all.problems(found) == [
        "example: time: 3 times the peer (at most 2)",
        "example: coverage: not measured (at least 90, at most 100)",
    ]
    lost = {"benchmark": "example", "rows": [], "exit_code": -9}
    assert run_all.problems(lost) == ["example: ended without a result (exit code -9)"]


def test_a_benchmark_that_is_impossible_here_is_no_problem(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as end:
        impossible_here("cyclictest is not installed.")
    assert capsys.readouterr().err == "cyclictest is not installed.\n"
    left_out = {"benchmark": "example", "rows": [], "exit_code": end.value.code}
    assert run_all.problems(left_out) == []


def test_a_release_is_appended_and_replaces_itself():
    def summary(version: str, value: float) -> dict[str, object]:
        row = {"name": "G", "value": value}
        return {
            "version": version,
            "date": "2026-01-01",
            "computer": "two cores",
            "benchmarks": [{"benchmark": "beam", "rows": [row]}],
        }

    history: list[dict[str, object]] = []
    for version, value in (("1", 1.0), ("2", 2.0), ("2", 3.14159)):
        history = run_all.release(history, summary(version, value))
    assert [each["version"] for each in history] == ["1", "2"]
    assert history[-1]["values"] == {"beam": {"G": 3.14}}


@pytest.mark.parametrize("name", run_all.names())
def test_every_benchmark_declares_and_checks_rows(name: str):
    tree = ast.parse((FOLDER / f"bench_{name}.py").read_text("utf-8"))
    declared = [
        target.id
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    ]
    assert "ROWS" in declared
    called = [ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)]
    assert called.count("Gate") == 1
    assert "gate.measured" in called
    assert "gate.finish" in called
    arguments = [
        ast.unparse(node.args[0])
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "Gate"
    ]
    assert arguments == ["ROWS"]


@pytest.mark.further  # imports all benchmarks
def test_page_has_the_declared_rows():
    for name in run_all.names():
        declared = [row.name for row in run_all.rows_of(name)]
        assert declared
        assert len(set(declared)) == len(declared), name
    history = json.loads(run_all.HISTORY.read_text("utf-8"))
    assert run_all.PAGE.read_text("utf-8") == run_all.page(history)
