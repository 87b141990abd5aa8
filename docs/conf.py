"""Settings of the documentation site; `make docs` builds it."""

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import latex2mathml.converter
import reference_pages
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

import rigd

project = "rigd"
author = "the rigd authors"
copyright = author  # noqa: A001 - Sphinx's name
version = release = rigd.__version__

extensions = ["myst_parser", "numpydoc", "sphinx.ext.autodoc", "sphinx_design"]
exclude_patterns = ["generated/*.txt"]

# Documents are written for a reader of the repository as well: headings have GitHub's anchors.
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence", "dollarmath"]

default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
numpydoc_show_class_members = False

html_theme = "pydata_sphinx_theme"
html_title = "rigd"
html_show_sourcelink = False
html_theme_options = {
    "navigation_with_keys": False,
    "show_prev_next": False,
    "footer_start": ["copyright"],
    "footer_end": [],
}

html_math_renderer = "mathml"


def visit_formula(translator: HTML5Translator, node: nodes.math) -> None:
    """Write a formula as MathML, which browsers show without a script from elsewhere."""
    translator.body.append(latex2mathml.converter.convert(node.astext()))
    raise nodes.SkipNode


def visit_display(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write a formula as MathML in a line of its own."""
    translator.body.append(latex2mathml.converter.convert(node.astext(), display="block"))
    raise nodes.SkipNode


def lead_to_pages(_app: Sphinx, _name: str, source: list[str]) -> None:
    """Let links lead to pages of the site, under their titles instead of file names."""
    text = source[0].replace("](../CONTRIBUTING.md", "](contributing.md")
    source[0] = re.sub(r"\[[\w/]+\.md\]\((?!#)", "[](", text)


def shorten_arrays(
    _app: Sphinx,
    _what: str,
    _name: str,
    _object: object,
    _options: object,
    signature: str | None,
    returns: str | None,
) -> tuple[str | None, str | None]:
    """Write types of arrays as the code does."""
    short, full = r"NDArray[\1]", r"~numpy\.ndarray\[tuple\[.*?\], ~numpy\.dtype\[(.*?)\]\]"
    return (
        signature and re.sub(full, short, signature),
        returns and re.sub(full, short, returns),
    )


def setup(app: Sphinx) -> None:
    """Register what Sphinx does not have, and make the pages that follow from the code."""
    app.add_html_math_renderer("mathml", (visit_formula, None), (visit_display, None))
    app.connect("autodoc-process-signature", shorten_arrays)
    app.connect("source-read", lead_to_pages)
    reference_pages.write_pages()
