"""Report of touches: a folder with page, figures, table and the JSON document."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING

from analysis.report import _style as style
from analysis.report._document import document_text
from analysis.report._folder import write_new
from analysis.report._page import page, versions
from analysis.report._table import csv_text
from analysis.report._touch_figures import touch_illustrations
from analysis.report._touch_tables import (
    model_words,
    session_lines,
    touches_document,
    touches_table,
)
from analysis.results import DEFAULT_FORMATS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from analysis.report._page import Facts
    from analysis.touch import TouchedSession


def write_touch_report(
    sessions: Sequence[TouchedSession],
    errors: Mapping[str, str],
    folder: Path,
    on_step: Callable[[str], None] = lambda _done: None,
    made_at: datetime | None = None,
) -> None:
    """Write ``report.html``, ``figures/``, ``tables/touches.csv`` and ``touches.json``.

    Parameters
    ----------
    sessions : sequence of TouchedSession
        One or more.
    errors : mapping of str to str
        Message for each file that could not be analysed.
    folder : Path
        An existing folder without these files.
    on_step : callable, optional
        Called with a few words after each figure.
    made_at : datetime, optional
        What the page calls its time; by default now.

    Raises
    ------
    OutputExistsError, OutputError
        If a file exists, or cannot be written.
    """
    pictures = []
    with style.styled():
        for shown in touch_illustrations(sessions):
            stem = folder / "figures" / shown.name
            picture = style.save_picture(shown.figure, stem, shown.description, DEFAULT_FORMATS)
            pictures.append(picture)
            on_step(f"figure {shown.name}")
    table = touches_table(sessions)
    write_new(folder / "tables" / "touches.csv", csv_text(table))
    write_new(folder / "touches.json", document_text(touches_document(sessions, errors)))
    text = page(
        "touch.html",
        title=sessions[0].path.stem if len(sessions) == 1 else f"{len(sessions)} sessions",
        files=", ".join(session.path.name for session in sessions),
        first=(),
        sentences=[line for session in sessions for line in session_lines(session)[:1]],
        experiments=(),
        warnings=[
            *(f"{each.path.name}: {sentence}" for each in sessions for sentence in each.warnings),
            *(f"Left out: {message}" for message in errors.values()),
        ],
        pictures=pictures,
        tables=(table,) if table.rows else (),
        paper_pictures=(),
        paper_tables=(),
        how=_how(sessions, made_at or datetime.now().astimezone()),
    )
    write_new(folder / "report.html", text)


def _how(sessions: Sequence[TouchedSession], made_at: datetime) -> list[Facts]:
    """Collect what is known of sessions, model and estimator."""
    return [
        (
            "Sessions",
            [
                (
                    str(each.path),
                    f"{each.rate_hz:g} Hz, "
                    + ("torque and base shear" if each.has_shear else "torque alone"),
                )
                for each in sessions
            ],
        ),
        ("Model", sorted({(model_words(each), _beam(each)) for each in sessions})),
        (
            "Estimate",
            [
                (
                    "innovations",
                    "measured torque and base shear minus those of the free exact model for the "
                    "measured angle, the vibration from before the touch fitted",
                ),
                (
                    "contact",
                    "springy obstacle at rest, marched through its bounces; posterior of point, "
                    "instant and stiffness by population Monte Carlo, with the model's uncertainty",
                ),
                ("log-likelihood", "of each point with any force history (white prior)"),
                ("intervals", "95 %"),
            ],
        ),
        versions(made_at),
    ]


def _beam(session: TouchedSession) -> str:
    beam = session.model.beam
    return (
        f"length {beam.length_m:g} m, density {beam.density_kg_per_m:.5g} kg/m, bending stiffness "
        f"{beam.bending_stiffness_n_m2:.5g} N·m²"
    )
