"""The page: verdict, figures, tables, and how it was computed, in one file."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

from analysis.report.html.damping_sentences import damping_sentences
from analysis.report.html.how import how_sections
from analysis.report.html.markup import Markup, element, joined, section, table, void

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from analysis.report.html.subject import Subject
    from analysis.report.html.table import Table

STYLE: Final = Path(__file__).with_name("report.css")
_CONTENTS: Final = (
    ("verdict", "Verdict"),
    ("figures", "Figures"),
    ("tables", "Tables"),
    ("paper", "The paper's route"),
    ("how", "How it was computed"),
)


def page(
    subject: Subject,
    drawings: Sequence[Markup],
    modes: Table,
    tables: Iterable[Table],
    paper: Iterable[Markup | Table],
    made_at: datetime,
) -> str:
    """Put a report together.

    Parameters
    ----------
    subject : Subject
    drawings : sequence of Markup
        The figures; the table of the modes follows the first one.
    modes : Table
    tables : iterable of Table
        Of the whole-record fits.
    paper : iterable of Markup or Table
        Figures and tables of the paper's route; none leaves its section out.
    made_at : datetime
        When, with a time zone.

    Returns
    -------
    str
        An HTML document that refers to nothing outside it.
    """
    of_paper = [each if isinstance(each, Markup) else table(each) for each in paper]
    titles = {name: title for name, title in _CONTENTS if name != "paper" or of_paper}
    first, *others = drawings
    head = element(
        "head",
        void("meta", charset="utf-8"),
        void("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("title", f"{subject.name}: damping"),
        Markup(f"<style>\n{STYLE.read_text(encoding='utf-8')}</style>"),
    )
    links = [element("li", element("a", title, href=f"#{name}")) for name, title in titles.items()]
    body = element(
        "body",
        element("header", element("h1", subject.name), element("p", _session_line(subject))),
        element("nav", element("ul", *links), aria_label="Contents"),
        element(
            "main",
            _verdict(subject, titles["verdict"]),
            _warnings(subject),
            section("figures", titles["figures"], first, table(modes), *others),
            section("tables", titles["tables"], *map(table, tables)),
            section("paper", titles["paper"], *of_paper) if of_paper else "",
            section("how", titles["how"], *how_sections(subject, made_at)),
        ),
    )
    return f"<!DOCTYPE html>\n{element('html', head, body, lang='en')}\n"


def _verdict(subject: Subject, title: str) -> Markup:
    damping = [
        element("p", sentence, class_="damping") for sentence in damping_sentences(subject.headline)
    ]
    said = [element("p", sentence) for sentence in subject.verdict.sentences]
    advice = [element("li", sentence) for sentence in subject.verdict.experiments]
    more = [element("p", "What would tell more:"), element("ul", *advice)] if advice else []
    return section("verdict", title, *damping, *said, *more)


def _warnings(subject: Subject) -> Markup:
    if not subject.warnings:
        return Markup("")
    items = [element("li", warning) for warning in subject.warnings]
    return section("warnings", "Read this too", element("ul", *items))


def _session_line(subject: Subject) -> Markup:
    """Say whose session it is, as far as the file does."""
    metadata = subject.record.metadata
    parts = [*_start(metadata), f"outcome {subject.record.outcome}"]
    parts += [f"{key}: {metadata[key]}" for key in ("specimen", "operator") if metadata.get(key)]
    note = metadata.get("note")
    line = joined(["  ·  ".join(parts)])
    return joined([line, void("br"), f"Note: {note}"]) if note else line


def _start(metadata: Mapping[str, str]) -> list[str]:
    """Say when the session started, if the file knows."""
    try:
        seconds = int(metadata["start_utc_ns"]) / 1e9
        start = datetime.fromtimestamp(seconds, UTC)
    except (KeyError, ValueError, OverflowError, OSError):
        return []
    return [f"recorded {start:%Y-%m-%d %H:%M:%S} UTC"]
