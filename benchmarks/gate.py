"""Rows of a benchmark with their limits: printing, storing and checking.

A benchmark declares its rows and gives each its measured value::

    ROWS = (Row("Welch's estimate", most=0.9, unit="times scipy.signal"),)

    def main() -> None:
        gate = Gate(ROWS, argparse.ArgumentParser(description=__doc__))
        gate.measured("Welch's estimate", ours_s / theirs_s)
        gate.finish()

The program ends with exit code 1 if a row is beyond its limit or was not measured; with
``--report`` it only prints. ``--json FILE`` writes the rows. On a computer that lacks what a
benchmark needs, it ends with exit code 3 and the reason, which is no error of `make bench`.
"""

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NoReturn

# Every analysis fits its records: a benchmark measures no stored fits of an earlier one.
os.environ["RIGD_NO_CACHE"] = "1"

EXIT_CODE_OF_IMPOSSIBLE = 3
"""Exit code of a benchmark that this computer cannot run."""


def impossible_here(reason: str) -> NoReturn:
    """End a benchmark that this computer cannot run, with a sentence that says why."""
    print(reason, file=sys.stderr)
    sys.exit(EXIT_CODE_OF_IMPOSSIBLE)


def percent(count: float, of: float) -> float:
    """Return a fraction in percent; NaN, which is beyond every limit, if `of` is 0."""
    return 100 * count / of if of else math.nan


@dataclass(frozen=True, slots=True)
class Row:
    """A figure of a benchmark and its limits; NaN is beyond each."""

    name: str
    most: float | None = None
    least: float | None = None
    unit: str = ""
    """Unit of value and limits: "times PEER" if the value is a ratio to a peer of the same run."""
    value: float | None = None
    """None until it is measured."""

    def __post_init__(self) -> None:
        """Raise if the row has no limit."""
        if self.most is None and self.least is None:
            raise ValueError(f"{self.name}: a row needs a limit, most or least")

    @property
    def passed(self) -> bool:
        """Whether the value is measured and within the limits."""
        return (
            self.value is not None
            and (self.most is None or self.value <= self.most)
            and (self.least is None or self.value >= self.least)
        )

    @property
    def limit(self) -> str:
        """Limits as a text."""
        ends = (("at least", self.least), ("at most", self.most))
        return ", ".join(f"{which} {end:g}" for which, end in ends if end is not None)

    def __str__(self) -> str:
        """Return the line that is printed."""
        value = "not measured" if self.value is None else f"{self.value:.3g} {self.unit}".rstrip()
        return f"{self.name}: {value} ({self.limit})"

    def as_dict(self) -> dict[str, Any]:
        """Return the row as it is stored."""
        known = self.value is not None and math.isfinite(self.value)
        return asdict(self) | {"value": self.value if known else None, "passed": self.passed}


class Gate:
    """Rows of one run of a benchmark.

    Adds ``--report`` and ``--json`` to the options of a benchmark and reads the command line.
    """

    def __init__(self, rows: Sequence[Row], parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--report", action="store_true", help="print only: exit code 0")
        parser.add_argument("--json", type=Path, help="file for the rows")
        self.given = parser.parse_args()
        self.rows = {row.name: row for row in rows}
        self._start_s = time.monotonic()

    def measured(self, name: str, value: float) -> None:
        """Give a row its value, and print it."""
        self.rows[name] = row = replace(self.rows[name], value=float(value))
        print(row if row.passed else f"{row} <-- beyond its limit", flush=True)

    def finish(self, *, part: bool = False) -> None:
        """Write the rows, and exit with code 1 if one is beyond its limit.

        For a `part` of the benchmark only measured rows count.
        """
        rows = [row for row in self.rows.values() if not (part and row.value is None)]
        failed = [row for row in rows if not row.passed]
        if self.given.json is not None:
            found = {
                "benchmark": Path(sys.argv[0]).stem.removeprefix("bench_"),
                "options": {
                    name: value
                    for name, value in vars(self.given).items()
                    if name not in ("report", "json") and isinstance(value, str | int | float)
                },
                "seconds": round(time.monotonic() - self._start_s, 1),
                "rows": [row.as_dict() for row in rows],
            }
            self.given.json.write_text(json.dumps(found, indent=2) + "\n", "utf-8")
        for row in failed:
            print(f"Beyond its limit: {row}", file=sys.stderr)
        if failed and not self.given.report:
            sys.exit(1)
