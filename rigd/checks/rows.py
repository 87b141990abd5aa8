"""Rows of a check: what was found, the verdict over all of them, and their table as text."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from math import isfinite

from rigd.units import UNITS, suffix_of

# Values and their units

_MILLISECONDS = {"s": 1e3, "ns": 1e-6, "µs": 1e-3}
"""Times are shown in ms: unit of the key → how many ms it has."""


def name_of(key: str) -> str:
    """Return a key as words, without its unit."""
    end = _end(key)
    return (key[: -len(end)] if end else key).replace("_", " ")


def value_of(key: str, value: object) -> str:
    """Return the value of a key with its unit; numbers to four digits.

    Parameters
    ----------
    key
        Key that ends in its unit.
    value
        Number, text, or a list of them.
    """
    unit = UNITS.get(_end(key), "")
    factor = 1.0
    if unit in _MILLISECONDS:
        factor, unit = _MILLISECONDS[unit], "ms"
    if isinstance(value, list | tuple) and not all(_is_number(each) for each in value):
        return "; ".join(map(str, value))
    if isinstance(value, list | tuple):
        text = ", ".join(f"{factor * each:.4g}" for each in value) or "none"
    elif isinstance(value, float):
        text = f"{factor * value:.4g}" if isfinite(value) else "none"
    elif isinstance(value, int) and not isinstance(value, bool) and unit:
        text = f"{factor * value:.4g}"
    else:
        return str(value)
    return f"{text} {unit}".rstrip()


def _end(key: str) -> str:
    # How many counts there are is a bare number, whose name says what is counted.
    return "" if key.endswith("_counts") else suffix_of(key)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


# Rows


class CheckResult(Enum):
    """Result of one row."""

    OK = "ok"
    WARNING = "warning"
    """A session can be run, with a caution."""
    FAIL = "failed"
    """No session may be run."""
    SKIPPED = "skipped"
    """Not checked; `found` says why."""


@dataclass(frozen=True, slots=True)
class CheckRow:
    """One check and its result; all texts are for the operator."""

    group: str
    """Part of the rig it belongs to."""
    what: str
    """Quantity."""
    found: str
    """Its value."""
    wanted: str
    """Value it is compared with; empty if there is none."""
    verdict: CheckResult
    """Result of the check."""
    detail: str = ""
    """Text that is too long for a table."""
    name: str = ""
    """Short name by which a session can accept a failure (`--accept`), of a check that needs no
    device; else empty."""

    def as_dict(self) -> dict[str, str]:
        """Return the row for a JSON document."""
        return {
            "group": self.group,
            "what": self.what,
            "found": self.found,
            "wanted": self.wanted,
            "verdict": self.verdict.value,
            "detail": self.detail,
            "name": self.name,
        }


def overall(rows: Iterable[CheckRow]) -> str:
    """Return ``failed``, ``warnings`` or ``ok``; skipped rows do not count."""
    verdicts = {row.verdict for row in rows}
    if CheckResult.FAIL in verdicts:
        return "failed"
    return "warnings" if CheckResult.WARNING in verdicts else "ok"


def grade(*, fail: bool, warn: bool = False) -> CheckResult:
    """Return the verdict on a comparison.

    Parameters
    ----------
    fail, warn
        Whether it fails, and else whether it is a warning.
    """
    if fail:
        return CheckResult.FAIL
    return CheckResult.WARNING if warn else CheckResult.OK


# Table

_STYLES = {
    CheckResult.OK: "green",
    CheckResult.WARNING: "yellow",
    CheckResult.FAIL: "bold red",
    CheckResult.SKIPPED: "dim",
}


OF_A_RIG = {
    "failed": "no session may be run",
    "warnings": "a session can be run",
    "ok": "a session can be run",
}
"""What the verdict over all rows means to the operator."""
OF_AN_EDS = {
    "failed": "this drive cannot be used",
    "warnings": "according to its EDS file, this drive can be used; read the warnings",
    "ok": "according to its EDS file, this drive can be used",
}


def print_table(rows: Sequence[CheckRow], consequences: Mapping[str, str] = OF_A_RIG) -> None:
    """Print the table, the longer details, and the verdict, to standard output.

    Parameters
    ----------
    rows
        Rows, those of a group together.
    consequences
        Verdict → consequence, printed under the table.
    """
    from rich.box import SIMPLE_HEAD  # late: a session prints no table
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), expand=False)
    table.add_column("what", ratio=5, overflow="fold")
    table.add_column("found", ratio=9, overflow="fold")
    table.add_column("wanted", ratio=5, overflow="fold")
    table.add_column("", no_wrap=True, width=7)
    group = ""
    named: set[str] = set()
    for row in rows:
        if row.group != group:
            group = row.group
            if table.row_count:
                table.add_row()
            table.add_row(Text(group, style="bold"))
        style = _STYLES[row.verdict]
        new = {row.name} - named - {""}
        named |= new
        table.add_row(
            Text(f"  {row.what}").append("".join(f"\n  {name}" for name in new), style="dim"),
            Text(row.found),
            Text(row.wanted),
            Text(row.verdict.value, style=style),
        )
    console = Console(highlight=False)
    console.print(table)
    for row in rows:
        if row.detail:
            console.print(Text(row.detail))
            console.print()
    console.print(Text(_verdict(rows, consequences), style="bold"))


def _verdict(rows: Sequence[CheckRow], consequences: Mapping[str, str]) -> str:
    counts = {verdict: sum(row.verdict is verdict for row in rows) for verdict in CheckResult}
    text = (
        f"failed: {counts[CheckResult.FAIL]}, warnings: {counts[CheckResult.WARNING]}, "
        f"ok: {counts[CheckResult.OK]}, skipped: {counts[CheckResult.SKIPPED]}"
    )
    verdict = overall(rows)
    return f"Verdict: {verdict} ({text}): {consequences[verdict]}."
