"""The rows of a check as a table on the terminal."""

from collections.abc import Mapping, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from rigd.checks.rows import Row, Verdict, overall

_STYLES = {
    Verdict.OK: "green",
    Verdict.WARNING: "yellow",
    Verdict.FAIL: "bold red",
    Verdict.SKIPPED: "dim",
}


OF_A_RIG = {
    "failed": "no session may be run",
    "warnings": "a session can be run",
    "ok": "a session can be run",
}
"""What the verdict over all rows means to the operator."""
OF_AN_EDS = {
    "failed": "this drive cannot be used",
    "warnings": "as far as its file tells, this drive can be used; read the warnings",
    "ok": "as far as its file tells, this drive can be used",
}


def print_table(rows: Sequence[Row], consequences: Mapping[str, str] = OF_A_RIG) -> None:
    """Print the table, what is too long for it, and the verdict, to standard output."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), expand=False)
    table.add_column("what", ratio=5, overflow="fold")
    table.add_column("found", ratio=9, overflow="fold")
    table.add_column("wanted", ratio=5, overflow="fold")
    table.add_column("", no_wrap=True, width=7)
    group = ""
    for row in rows:
        if row.group != group:
            group = row.group
            if table.row_count:
                table.add_row()
            table.add_row(Text(group, style="bold"))
        style = _STYLES[row.verdict]
        table.add_row(
            Text(f"  {row.what}"),
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


def _verdict(rows: Sequence[Row], consequences: Mapping[str, str]) -> str:
    counts = {verdict: sum(row.verdict is verdict for row in rows) for verdict in Verdict}
    text = (
        f"failed: {counts[Verdict.FAIL]}, warnings: {counts[Verdict.WARNING]}, "
        f"ok: {counts[Verdict.OK]}, skipped: {counts[Verdict.SKIPPED]}"
    )
    verdict = overall(rows)
    return f"Verdict: {verdict} ({text}): {consequences[verdict]}."
