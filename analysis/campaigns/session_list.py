"""Table of the sessions by what their files say of them: when, of which specimen, by whom."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rich.text import Text

from analysis.campaigns.text_table import text_table
from analysis.report.html.table import Column, Table

if TYPE_CHECKING:
    import rich.table

    from analysis.campaigns.campaign import Campaign

_CAPTION: Final = "Sessions, as their files state them"
_COLUMNS: Final = {
    "file": "file",
    "start_utc": "recorded (UTC)",
    "specimen": "specimen",
    "operator": "operator",
    "note": "note",
    "used": "used",
}
"""Key in CSV and JSON → heading."""

_ABSENT: Final = "–"


def session_list_rows(campaign: Campaign) -> list[dict[str, Any]]:
    """List all files, those that were left out behind the others.

    Parameters
    ----------
    campaign : Campaign
    """
    return [
        {
            "file": str(each.path),
            "start_utc": said.start_utc if said else "",
            "specimen": said.label if said else "",
            "operator": said.operator if said else "",
            "note": said.note if said else "",
            "used": used,
        }
        for used, group in ((True, campaign.sessions), (False, campaign.failures))
        for each in group
        for said in (each.experiment,)
    ]


def session_list_text(campaign: Campaign) -> rich.table.Table:
    """Make the table for the terminal."""
    table = text_table(_CAPTION)
    for heading in _COLUMNS.values():
        table.add_column(heading)
    for cells in _cells(campaign):
        table.add_row(*map(Text, cells))
    return table


def session_list_table(campaign: Campaign) -> Table:
    """Make the table for the page."""
    return Table(
        name="session_list",
        caption=_CAPTION,
        columns=tuple(Column(heading, key, numeric=False) for key, heading in _COLUMNS.items()),
        rows=tuple(_cells(campaign)),
    )


def _cells(campaign: Campaign) -> list[tuple[str, ...]]:
    paths = [each.path for each in campaign.sessions]
    paths += [each.path for each in campaign.failures]
    return [
        (
            path.name,
            *(str(row[key]) or _ABSENT for key in ("start_utc", "specimen", "operator", "note")),
            "yes" if row["used"] else "no",
        )
        for path, row in zip(paths, session_list_rows(campaign), strict=True)
    ]
