"""HTML pages from the templates, with every text escaped and every figure embedded."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import jinja2
import matplotlib as mpl

from analysis.report._document import program_versions

if TYPE_CHECKING:
    from datetime import datetime

FactGroup = tuple[str, list[tuple[str, str]]]
"""Title of a group of facts, and the name and value of each fact."""


def render_page(template_name: str, **template_content: Any) -> str:  # noqa: ANN401 - what the template asks for
    """Return the HTML that a template of this package and its content give.

    Raise an error if the template uses a name that is not in the content.
    """
    return _environment().get_template(template_name).render(template_content)


@cache
def _environment() -> jinja2.Environment:
    """Return Jinja's environment, which escapes texts and raises an error for unknown names."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("analysis.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def version_facts(made_at: datetime) -> FactGroup:
    """Return the date of the report and the versions of the programs, as a group of facts."""
    return (
        "Versions",
        [
            ("report made", made_at.isoformat(timespec="seconds")),
            *program_versions().items(),
            ("matplotlib", mpl.__version__),
        ],
    )
