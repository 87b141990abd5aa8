"""Values in rows of a check, and the table of the rows as text."""

from collections.abc import Mapping, Sequence
from math import isfinite

from rigd.check_rows import CheckResult, CheckRow, overall_verdict
from rigd.units import UNITS, suffix_of

# Values and their units

_MILLISECONDS_PER_UNIT = {"s": 1e3, "ns": 1e-6, "µs": 1e-3}
"""Map from a unit of time to its number of milliseconds; all times are shown in ms."""


def key_label(key: str) -> str:
    """Return a key as a label: with spaces instead of underscores and without its unit's suffix."""
    unit_suffix = _unit_suffix(key)
    return (key[: -len(unit_suffix)] if unit_suffix else key).replace("_", " ")


def format_value(key: str, value: object) -> str:
    """Format a reported value with its key's unit; numbers have four significant digits.

    Parameters
    ----------
    key
        Key that ends in its unit.
    value
        Number, text, or a list of them.
    """
    unit = UNITS.get(_unit_suffix(key), "")
    unit_factor = 1.0
    if unit in _MILLISECONDS_PER_UNIT:
        unit_factor, unit = _MILLISECONDS_PER_UNIT[unit], "ms"
    if isinstance(value, list | tuple) and not all(_is_number(number) for number in value):
        return "; ".join(map(str, value))
    if isinstance(value, list | tuple):
        value_text = ", ".join(f"{unit_factor * number:.4g}" for number in value) or "none"
    elif isinstance(value, float):
        value_text = f"{unit_factor * value:.4g}" if isfinite(value) else "none"
    elif isinstance(value, int) and not isinstance(value, bool) and unit:
        value_text = f"{unit_factor * value:.4g}"
    else:
        return str(value)
    return f"{value_text} {unit}".rstrip()


def _unit_suffix(key: str) -> str:
    """Return the suffix of a key that names its unit, or "" if there is none."""
    # A number of counts has no unit: the name of the key says what is counted.
    return "" if key.endswith("_counts") else suffix_of(key)


def _is_number(checked_value: object) -> bool:
    """Return whether a value is an integer or a float, but not a boolean."""
    return isinstance(checked_value, int | float) and not isinstance(checked_value, bool)


# Table

_VERDICT_STYLES = {  # Styles of the verdicts in the printed table
    CheckResult.OK: "green",
    CheckResult.WARNING: "yellow",
    CheckResult.FAIL: "bold red",
    CheckResult.SKIPPED: "dim",
}


RIG_CONSEQUENCES = {
    "failed": "no session may be run",
    "warnings": "a session can be run",
    "ok": "a session can be run",
}
"""Consequence of the verdict over all rows of a rig, for the operator."""
EDS_CONSEQUENCES = {
    "failed": "this drive cannot be used",
    "warnings": "according to its EDS file, this drive can be used; read the warnings",
    "ok": "according to its EDS file, this drive can be used",
}
"""Consequence of the verdict over all rows of an EDS file, for the operator."""


def print_check_table(
    check_rows: Sequence[CheckRow], consequence_by_verdict: Mapping[str, str] = RIG_CONSEQUENCES
) -> None:
    """Print the rows as a table, then their details and the verdict, to standard output.

    Parameters
    ----------
    check_rows
        Rows; those of a group are adjacent.
    consequence_by_verdict
        Map from the verdict over all rows to its consequence, which is printed under the table.
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
    shown_group = ""
    shown_row_names: set[str] = set()
    for row in check_rows:
        if row.group != shown_group:
            shown_group = row.group
            if table.row_count:
                table.add_row()
            table.add_row(Text(shown_group, style="bold"))
        verdict_style = _VERDICT_STYLES[row.verdict]
        new_row_names = {row.name} - shown_row_names - {""}
        shown_row_names |= new_row_names
        table.add_row(
            Text(f"  {row.what}").append(
                "".join(f"\n  {name}" for name in new_row_names), style="dim"
            ),
            Text(row.found),
            Text(row.wanted),
            Text(row.verdict.value, style=verdict_style),
        )
    console = Console(highlight=False)
    console.print(table)
    for row in check_rows:
        if row.detail:
            console.print(Text(row.detail))
            console.print()
    console.print(Text(_verdict_line(check_rows, consequence_by_verdict), style="bold"))


def _verdict_line(check_rows: Sequence[CheckRow], consequence_by_verdict: Mapping[str, str]) -> str:
    """Return the line under the table: verdict, numbers of rows by result, and consequence."""
    row_count_by_verdict = {
        verdict: sum(row.verdict is verdict for row in check_rows) for verdict in CheckResult
    }
    row_counts_text = (
        f"failed: {row_count_by_verdict[CheckResult.FAIL]}, warnings: "
        f"{row_count_by_verdict[CheckResult.WARNING]}, "
        f"ok: {row_count_by_verdict[CheckResult.OK]}, skipped: "
        f"{row_count_by_verdict[CheckResult.SKIPPED]}"
    )
    verdict = overall_verdict(check_rows)
    return f"Verdict: {verdict} ({row_counts_text}): {consequence_by_verdict[verdict]}."
