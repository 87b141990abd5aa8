"""HTML from plain values, every text escaped; and figures as SVG inside a page."""

from __future__ import annotations

import base64
import io
import re
from html import escape
from typing import TYPE_CHECKING, Any, Final

from analysis.report._table import Number

if TYPE_CHECKING:
    from collections.abc import Iterable

    from matplotlib.figure import Figure

    from analysis.report._table import Cell, Column, Table


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


SVG_SETTINGS: Final[dict[Any, Any]] = {"svg.fonttype": "none", "svg.hashsalt": "rigd"}
"""Text as text, and the same identifiers each time."""

_NO_METADATA: Final = dict.fromkeys(("Creator", "Date", "Format", "Type"))
_SURROUNDINGS: Final = re.compile(
    r"<\?xml.*?\?>|<!DOCTYPE.*?>|<!--.*?-->|<metadata>.*?</metadata>|<defs>\s*<style.*?</defs>",
    re.DOTALL,
)
_UNUSED_IDS: Final = re.compile(r' id="(?:figure|axes|patch|line2d|text|matplotlib|xtick|ytick'
                                r'|legend|Quad|Fill|Line|Path|Poly)[^"]*"')  # fmt: skip
_TAG: Final = re.compile(r"<[^>]*>")
_DECIMALS: Final = re.compile(r"(\d\.\d)\d{2,}")


def svg_text(figure: Figure) -> str:
    """Write a figure as an SVG file; within `style.styled`."""
    from matplotlib import rc_context

    buffer = io.StringIO()
    with rc_context(SVG_SETTINGS):
        figure.savefig(buffer, format="svg", metadata=_NO_METADATA)
    return buffer.getvalue()


def drawing(svg: str, name: str, description: str) -> Markup:
    """Make a figure of a page from an SVG file.

    Parameters
    ----------
    svg : str
        As `svg_text` writes it.
    name : str
        Prefix of its identifiers, which a page must not hold twice.
    description : str
        What is seen in it, for those who do not see it, and as its caption.
    """
    body = _SURROUNDINGS.sub("", svg)
    body = _UNUSED_IDS.sub("", body)
    body = re.sub(r'\bid="', f'id="{name}-', body)
    body = body.replace("url(#", f"url(#{name}-").replace('xlink:href="#', f'href="#{name}-')
    body = re.sub(r' xmlns(?::xlink)?="[^"]*"', "", body)
    # A tenth of a point is a quarter of a printer's dot at most; what is written stays whole.
    body = _TAG.sub(lambda tag: _DECIMALS.sub(r"\1", tag[0]), body).strip()
    body = re.sub(r"^<svg [^>]*?(viewBox=\"[^\"]*\")[^>]*>", r'<svg \1 aria-hidden="true">', body)
    shown = element("div", Markup(body), role="img", aria_label=description, class_="picture")
    return _figure(shown, name, description)


def photograph(png: bytes, name: str, description: str) -> Markup:
    """Make a figure of a page from a PNG file: one with too many strokes for SVG."""
    data = base64.b64encode(png).decode("ascii")
    image = void("img", alt=description, src=f"data:image/png;base64,{data}")
    return _figure(element("div", image, class_="picture"), name, description)


def _figure(shown: Markup, name: str, description: str) -> Markup:
    return element("figure", shown, element("figcaption", description), id=f"figure-{name}")
