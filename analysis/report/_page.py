"""Pages: the templates filled, with every text escaped and every figure inside."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import jinja2
import matplotlib as mpl

from analysis.report._document import versions as computed_by

if TYPE_CHECKING:
    from datetime import datetime

Facts = tuple[str, list[tuple[str, str]]]
"""Title of a group of facts, and their names and values."""


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
    """Return date and program versions of the report."""
    return (
        "Versions",
        [
            ("report made", made_at.isoformat(timespec="seconds")),
            *computed_by().items(),
            ("matplotlib", mpl.__version__),
        ],
    )
