"""Pages: the templates filled, with every text escaped and every figure inside."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import jinja2
import matplotlib as mpl

from analysis.report._document import versions as computed_by

if TYPE_CHECKING:
    from datetime import datetime

Facts = tuple[str, list[tuple[str, str]]]
"""Title of a group of facts, and their names and values."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of a page.

    Attributes
    ----------
    name : str
        Name of its file, without the ending.
    description : str
        What is seen in it, for those who do not see it, and as its caption.
    png : bytes
        Content of its file.
    svg : bytes or None
        The same as SVG, if there is one.
    """

    name: str
    description: str
    png: bytes
    svg: bytes | None = None

    @property
    def source(self) -> str:
        """The figure itself, in the place of an address: in the smaller of its formats.

        That is SVG, but of a figure with very many strokes, such as many sessions' responses.
        """
        kind, content = "png", self.png
        if self.svg is not None and len(self.svg) < len(self.png):
            kind, content = "svg+xml", self.svg
        return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def page(template: str, **content: Any) -> str:  # noqa: ANN401 - what the template asks for
    """Fill a template of this package; a name that it asks for and is not given is an error."""
    return _environment().get_template(template).render(content)


@cache
def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        loader=jinja2.PackageLoader("analysis.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def versions(made_at: datetime) -> Facts:
    """When the report was made, and by what."""
    return (
        "Versions",
        [
            ("report made", made_at.isoformat(timespec="seconds")),
            *computed_by().items(),
            ("matplotlib", mpl.__version__),
        ],
    )
