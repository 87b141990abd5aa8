"""The built documentation: nothing is absent, and it needs no internet; `make docs` runs this."""

import ast
import os
import re
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

import pytest

PROJECT = Path(__file__).parents[2]
SITE = Path(os.environ.get("RIGD_SITE", ""))

pytestmark = pytest.mark.skipif(
    "RIGD_SITE" not in os.environ, reason="RIGD_SITE is not the folder of a built site"
)


class Page(HTMLParser):
    """Identifiers, links of the text, and files that a browser loads to show a page."""

    def __init__(self, path):
        super().__init__()
        self.path = path
        self.ids, self.links, self.loaded = set(), set(), set()
        self.article = 0
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.ids.add(values.get("id"))
        self.article += tag == "article"
        if tag == "a" and self.article and "href" in values:
            self.links.add(values["href"])
        if tag == "link" and values.get("rel") not in ("canonical", "index", "search", "next"):
            self.loaded.add(values["href"])
        if tag in ("script", "img", "iframe", "source", "video") and "src" in values:
            self.loaded.add(values["src"])

    def handle_endtag(self, tag):
        self.article -= tag == "article"

    def targets(self):
        """Pages of the site that the text leads to."""
        for link in self.links:
            url = urlsplit(link)
            if not url.scheme and url.path.endswith(".html"):
                yield (self.path.parent / unquote(url.path)).resolve()


@pytest.fixture(scope="module")
def pages():
    found = {
        path.resolve(): Page(path) for path in SITE.rglob("*.html") if "_static" not in path.parts
    }
    assert len(found) > 100
    return found


def public_names():
    """Full names that the stubs and the package of the analyser offer, modules left out."""
    stubs = [path for room in ("rigd", "analysis") for path in (PROJECT / room).rglob("*.pyi")]
    for stub in stubs:
        package = ".".join(stub.relative_to(PROJECT).parent.parts)
        for node in ast.parse(stub.read_text("utf-8")).body:
            if node.module is not None:
                yield from (f"{package}.{each.name}" for each in node.names)
    yield from (f"analysis.{name}" for name in import_module("analysis").__all__)


def test_every_public_name_has_an_entry(pages):
    described = set().union(*(page.ids for page in pages.values()))
    names = set(public_names())
    assert len(names) > 300
    assert not names - described


def test_every_command_and_key_has_an_entry(pages):
    commands = (SITE / "commands.html").read_text("utf-8")
    for name in ("rigd run chirp", "rigd identify motor", "analyze export frf", "analyze import"):
        assert f"Usage: {name}" in commands
    keys = (SITE / "profile_keys.html").read_text("utf-8")
    for profile in (PROJECT / "hw_profiles").glob("*.toml"):
        for key in re.findall(r"^(\w+) *=", profile.read_text("utf-8"), re.MULTILINE):
            assert f">{key}<" in keys, key


def test_every_page_is_two_clicks_away(pages):
    reached = {(SITE / "index.html").resolve()}
    for _ in range(2):
        reached |= {target for page in reached for target in pages[page].targets()}
    of_sphinx = {
        (SITE / f"{name}.html").resolve() for name in ("genindex", "py-modindex", "search")
    }
    assert not pages.keys() - reached - of_sphinx


def test_pages_load_nothing_from_elsewhere(pages):
    for page in pages.values():
        assert not {each for each in page.loaded if urlsplit(each).netloc}, page.path
    for style in SITE.rglob("*.css"):
        found = re.findall(r"(?:@import|url\()\s*[\"']?(https?:|//)", style.read_text("utf-8"))
        assert not found, style


@pytest.mark.parametrize(
    ("question", "page"),
    [
        ("How do I export an FRF to MATLAB?", "export_to_matlab"),
        ("What does type VI mean?", "types"),
        ("How do I add a drive?", "add_a_drive"),
        ("What is a flag?", "flags"),
    ],
)
def test_answer_is_found_by_menu_and_search(pages, browser, question, page):
    text = (SITE / f"{page}.html").read_text("utf-8")
    assert f"<title>{question}" in text
    groups = [(SITE / f"{group}.html").read_text("utf-8") for group in ("how_to", "explanation")]
    assert any(f"{page}.html" in group and question in group for group in groups)
    window = browser.new_page()
    try:
        address = (SITE / "search.html").resolve().as_uri()
        window.goto(f"{address}?q={quote(question)}")
        window.wait_for_selector("#search-results li a")
        window.wait_for_function(  # its text when all pages have been searched
            "document.querySelector('#search-results .search-summary')?.innerText.includes('found')"
        )
        found = window.locator("#search-results li > a").evaluate_all(
            "links => links.map(link => link.href.split('/').pop().split(/[#?]/)[0])"
        )
    finally:
        window.close()
    assert found[0] == f"{page}.html"
