"""Figures as SVG inside a page: text as text, no identifier twice, nothing from outside."""

from __future__ import annotations

import base64
import io
import re
from typing import TYPE_CHECKING, Any, Final

from analysis.report.html.markup import Markup, element, void

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
