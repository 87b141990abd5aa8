"""HTML from plain values: a text is escaped wherever it enters, so that none can be forgotten."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

from analysis.report.html.table import Number

if TYPE_CHECKING:
    from collections.abc import Iterable

    from analysis.report.html.table import Cell, Column, Table


class Markup(str):
    """HTML that is complete and safe; any other str is a text."""

    __slots__ = ()


def element(tag: str, *children: str, **attributes: str) -> Markup:
    """Make an element of markup and texts.

    Parameters
    ----------
    tag : str
    children : str
        What is no `Markup` is escaped.
    attributes : str
        A trailing underscore of a name is dropped (``class_``), others become hyphens. Empty ones
        are left out.
    """
    return Markup(f"{void(tag, **attributes)}{joined(children)}</{tag}>")


def void(tag: str, **attributes: str) -> Markup:
    """Make an element that has no children and no end, such as ``img``."""
    names = (
        f' {name.rstrip("_").replace("_", "-")}="{escape(value)}"'
        for name, value in attributes.items()
        if value
    )
    return Markup(f"<{tag}{''.join(names)}>")


def joined(children: Iterable[str]) -> Markup:
    """Put markup and texts one after the other."""
    return Markup(
        "".join(child if isinstance(child, Markup) else escape(child) for child in children)
    )


def section(identifier: str, title: str, *children: str) -> Markup:
    """Make a section with its heading."""
    heading = element("h2", title, id=f"{identifier}-title")
    return element(
        "section", heading, *children, id=identifier, aria_labelledby=f"{identifier}-title"
    )


def table(content: Table) -> Markup:
    """Make a table, its numbers readable for machines (``data``), and its notes."""
    columns = content.columns
    head = element("tr", *(_heading(column) for column in columns if column.heading))
    body = [
        element("tr", *_cells(row, columns), class_="selected" if i == content.selected else "")
        for i, row in enumerate(content.rows)
    ]
    made = element(
        "table",
        element("caption", content.caption),
        element("thead", head),
        element("tbody", *body),
        id=content.name,
    )
    notes = [element("p", note, class_="note") for note in content.notes]
    return element("div", element("div", made, class_="wide"), *notes, class_="table")


def _heading(column: Column) -> Markup:
    return element("th", column.heading, scope="col", class_="number" if column.numeric else "")


def _cells(row: tuple[Cell, ...], columns: tuple[Column, ...]) -> Iterable[Markup]:
    for place, (cell, column) in enumerate(zip(row, columns, strict=True)):
        if not column.heading:
            continue
        tag, scope = ("td", "") if place else ("th", "row")
        kind = "number" if column.numeric else ""
        if not isinstance(cell, Number):
            yield element(tag, cell, scope=scope, class_=kind)
        elif cell.value is None:
            yield element(tag, cell.text, scope=scope, class_=kind)
        else:
            shown = element("data", cell.text, value=repr(cell.value))
            yield element(
                tag,
                element("strong", shown) if cell.strong else shown,
                scope=scope,
                class_=f"{kind} withheld" if cell.doubtful else kind,
            )
