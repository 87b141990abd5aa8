"""Run all benchmarks, one after the other, and check their limits; `make bench`.

    python benchmarks/run_all.py [NAME ...] [--report]
    python benchmarks/run_all.py --release

Each runs at its default size; all together take at most half an hour on an idle computer with two
cores. The rows of all, with options and seconds, go to ``build/bench.json``. The exit code is 1 if
a row is beyond its limit, or if a benchmark ended without a result. Benchmarks that this computer
cannot run are named.

``--release`` runs nothing: it appends the values of ``build/bench.json`` to
``docs/validation/benchmarks.json``, which has the last releases, and writes the page
``docs/validation/benchmarks.md`` from it. ``--page`` writes the page alone.
"""

import argparse
import importlib
import json
import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gate import EXIT_CODE_OF_IMPOSSIBLE, Row

import rigd

FOLDER = Path(__file__).parent
BUILD = FOLDER.parent / "build"
SUMMARY = BUILD / "bench.json"
HISTORY = FOLDER.parent / "docs" / "validation" / "benchmarks.json"
PAGE = HISTORY.with_suffix(".md")
MOST_RELEASES = 6
"""Largest number of releases in the history."""

INTRODUCTION = """# Benchmarks and their limits

`make bench` runs `benchmarks/bench_*.py`, each at a size at which all together take at most half an
hour on an idle computer of two cores, and ends with an error if a row is beyond its limit or was
not measured. A benchmark that the computer cannot run is named, and is no error. A ratio is to a
peer of the same run, so that it hardly depends on the computer; limits in percent or in standard
deviations are those of a few sessions, and wider than what the other pages report of many.
`python benchmarks/bench_NAME.py --help` says what a benchmark measures and has an option for its
size; `--report` prints without judging; `build/bench.json` has all rows.

This page is written by `python benchmarks/run_all.py --release`, which appends the values of the
last `make bench` to `docs/validation/benchmarks.json`; each column is one release.
"""


def names() -> list[str]:
    """Return the names of all benchmarks."""
    return sorted(path.stem.removeprefix("bench_") for path in FOLDER.glob("bench_*.py"))


def rows_of(name: str) -> tuple[Row, ...]:
    """Return the rows that a benchmark declares."""
    rows: tuple[Row, ...] = importlib.import_module(f"bench_{name}").ROWS
    return rows


def run(name: str, *, report: bool) -> dict[str, Any]:
    """Run a benchmark; return its rows and its exit code."""
    found = BUILD / f"bench_{name}.json"
    found.unlink(missing_ok=True)
    print(f"\n{name}", flush=True)
    command = [sys.executable, str(FOLDER / f"bench_{name}.py"), "--json", str(found)]
    code = subprocess.run([*command, *(["--report"] if report else [])], check=False).returncode
    result = json.loads(found.read_text("utf-8")) if found.exists() else {"rows": []}
    return {"benchmark": name, **result, "exit_code": code}


def problems(result: dict[str, Any]) -> list[str]:
    """Return the problems of a benchmark that ran: rows beyond their limits, or no result."""
    name, rows = result["benchmark"], result["rows"]
    if result.get("exit_code") == EXIT_CODE_OF_IMPOSSIBLE:
        return []
    if not rows:
        return [f"{name}: ended without a result (exit code {result['exit_code']})"]
    keys = ("name", "most", "least", "unit", "value")
    return [f"{name}: {Row(*(row[key] for key in keys))}" for row in rows if not row["passed"]]


def release(history: list[dict[str, Any]], summary: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the history with the values of a run, which replace those of the same version."""
    entry = {key: summary[key] for key in ("version", "date", "computer")}
    entry["values"] = {
        each["benchmark"]: {row["name"]: _rounded(row["value"]) for row in each["rows"]}
        for each in summary["benchmarks"]
    }
    others = [each for each in history if each["version"] != entry["version"]]
    return [*others, entry][-MOST_RELEASES:]


def _rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.3g}")


def page(history: list[dict[str, Any]]) -> str:
    """Return the page: a table of each benchmark, with a column for each release."""
    lines = [INTRODUCTION]
    if history:
        lines.append("| version | date | computer |\n|---|---|---|")
        lines += [
            f"| {each['version']} | {each['date']} | {each['computer']} |" for each in history
        ]
        lines.append("")
    versions = [each["version"] for each in history]
    for name in names():
        lines.append(f"## {name}\n")
        lines.append("| " + " | ".join(["row", "limit", "unit", *versions]) + " |")
        lines.append("|---" * (3 + len(versions)) + "|")
        for row in rows_of(name):
            values = [each["values"].get(name, {}).get(row.name) for each in history]
            cells = [row.name, row.limit, row.unit]
            cells += ["–" if value is None else f"{value:g}" for value in values]
            lines.append("| " + " | ".join(cells) + " |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Run the benchmarks, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="only these, such as beam")
    parser.add_argument("--report", action="store_true", help="check no limits")
    parser.add_argument("--release", action="store_true", help="append to the history")
    parser.add_argument("--page", action="store_true", help="write the page")
    given = parser.parse_args()
    unknown = set(given.names) - set(names())
    if unknown:
        parser.error(f"no such benchmark: {', '.join(sorted(unknown))}")
    if given.release or given.page:
        history = json.loads(HISTORY.read_text("utf-8"))
        if given.release:
            history = release(history, json.loads(SUMMARY.read_text("utf-8")))
            text = json.dumps(history, indent=1, ensure_ascii=False)
            HISTORY.write_text(text + "\n", "utf-8")
        PAGE.write_text(page(history), "utf-8")
        return
    BUILD.mkdir(exist_ok=True)
    results = [run(name, report=given.report) for name in given.names or names()]
    summary = {
        "version": rigd.__version__,
        "date": datetime.now(UTC).date().isoformat(),
        "computer": f"{platform.machine()}, {os.cpu_count()} cores, Python "
        f"{platform.python_version()}",
        "benchmarks": results,
    }
    SUMMARY.write_text(json.dumps(summary, indent=2, ensure_ascii=False) + "\n", "utf-8")
    wrong = [problem for result in results for problem in problems(result)]
    count = sum(len(result["rows"]) for result in results)
    print(f"\n{count} rows of {len(results)} benchmarks; beyond a limit: {len(wrong) or 'none'}")
    for problem in wrong:
        print(f"    {problem}")
    left_out = [
        result["benchmark"] for result in results if result["exit_code"] == EXIT_CODE_OF_IMPOSSIBLE
    ]
    if left_out:
        print(f"Not possible on this computer: {', '.join(left_out)}")
    print(f"All rows: {SUMMARY}")
    if wrong and not given.report:
        sys.exit(1)


if __name__ == "__main__":
    main()
