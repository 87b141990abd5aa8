"""Report of touches: table, JSON document and text lines, and a folder with page and figures."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Any

from analysis.report._document import document_text, program_versions
from analysis.report.folder import write_new_file
from analysis.report.table import TEXT_FORMAT, Cell, Column, Entry, Table, csv_text, number_cell
from analysis.results import finite_json
from rigd.units import with_interval

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from analysis.report._page import FactGroup
    from analysis.touch import SessionTouches, Touch
    from rigd.touch import TouchQuantity

_DESCRIPTION_BY_KIND = {
    "rigid": "obstacle at rest",
    "yielding": "obstacle that gives way",
    "moving": "moving obstacle",
    "knock": "knock",
    "unknown": "not identifiable",
}
"""Descriptions of the kinds of contact, by key."""


def touches_table(session_touches: Sequence[SessionTouches]) -> Table:
    """Return the table of the touches of all sessions.

    Parameters
    ----------
    session_touches : sequence of SessionTouches
        Sessions with their touches.
    """
    has_several_sessions = len(session_touches) > 1
    table_columns = (
        Column("Session" if has_several_sessions else "", "session", TEXT_FORMAT),
        Column("Touch", "number"),
        Column("Time (s)", "time_s"),
        Column("From the axis (m)", "x_m"),
        Column("Angle (rad)", "angle_rad", ".4f"),
        Column("Peak force (N)", "force_n"),
        Column("Stiffness (N/m)", "stiffness_n_per_m"),
        Column("Kind", "kind", TEXT_FORMAT),
    )
    table_rows = [
        _touch_row(session, touch) for session in session_touches for touch in session.touches
    ]
    return Table(
        "touches",
        "Touches",
        table_columns,
        tuple(table_rows),
        ("± or to: 95 % interval; the angle is that of the motor at the touch.",)
        if table_rows
        else (),
        is_grouped=has_several_sessions,
    )


def _touch_row(session: SessionTouches, touch: Touch) -> dict[str, Entry]:
    """Return the table row of a touch: time, position, angle, peak force, stiffness and kind."""
    estimate = touch.estimate
    row: dict[str, Entry] = {
        "session": session.path.stem,
        "number": touch.number,
        "angle_rad": touch.angle_rad,
        "kind": "not estimated"
        if estimate is None
        else _DESCRIPTION_BY_KIND.get(estimate.kind, estimate.kind),
    }
    quantities_with_offsets: dict[str, tuple[TouchQuantity | None, float]] = {}
    if estimate is not None:
        quantities_with_offsets = {
            "time_s": (estimate.time_s, touch.start_s),
            "x_m": (estimate.x_m, 0.0),
            "force_n": (estimate.force_n, 0.0),
            "stiffness_n_per_m": (estimate.stiffness_n_per_m, 0.0),
        }
    for key in ("time_s", "x_m", "force_n", "stiffness_n_per_m"):
        estimated_quantity, display_offset = quantities_with_offsets.get(key, (None, 0.0))
        row[key] = _estimate_cell(estimated_quantity, display_offset)
        row[f"{key}_std"] = None if estimated_quantity is None else estimated_quantity.std
    return row


def _estimate_cell(estimated_quantity: TouchQuantity | None, display_offset: float) -> Cell:
    """Return the cell of an estimate with its 95 % interval; a dash without an estimate."""
    if estimated_quantity is None:
        return number_cell(None)
    shown_value = estimated_quantity.value + display_offset
    lower_limit, upper_limit = (
        interval_limit + display_offset for interval_limit in estimated_quantity.interval_95
    )
    return Cell(
        shown_value, with_interval(shown_value, (lower_limit, upper_limit)).replace("-", "−")
    )


def session_lines(session: SessionTouches) -> list[str]:
    """Return text lines on a session: number of touches, source of the beam model, and warnings.

    Parameters
    ----------
    session : SessionTouches
        Session with its touches.
    """
    touch_count = len(session.touches)
    touch_count_text = (
        "no touch"
        if touch_count == 0
        else "1 touch"
        if touch_count == 1
        else f"{touch_count} touches"
    )
    detection_phrase = (
        "during the session" if session.detection_source == "loop" else "in the record"
    )
    detection_text = f", detected {detection_phrase}" if touch_count else ""
    validity_text = f" {session.validity.sentence}" if touch_count else ""
    return [
        f"{session.path.name}: {touch_count_text}{detection_text}. "
        f"Model: {describe_model(session)}.{validity_text}",
        *(f"Warning: {sentence}" for sentence in session.warnings),
    ]


def describe_model(session: SessionTouches) -> str:
    """Return a text that states the source of the parameters of a session's beam model."""
    model_source = session.model.source
    return "the nominal beam of the attached profile" if model_source == "profile" else model_source


def touches_document(
    session_touches: Sequence[SessionTouches], error_messages: Mapping[str, str]
) -> dict[str, Any]:
    """Return the touches of all sessions as one JSON document.

    Parameters
    ----------
    session_touches : sequence of SessionTouches
        Sessions with their touches.
    error_messages : mapping of str to str
        Message for each file that could not be analysed.

    Returns
    -------
    dict
        ``versions``, ``touches`` and ``errors``: lists of objects that name their file.
    """
    document_content: dict[str, Any] = finite_json(
        {
            "versions": program_versions(),
            "touches": [
                {
                    "file": str(session.path),
                    "detected": session.detection_source,
                    "validity": session.validity.as_json(),
                    **touch.as_dict(),
                }
                for session in session_touches
                for touch in session.touches
            ],
            "errors": [
                {"file": file_path, "message": message}
                for file_path, message in error_messages.items()
            ],
        }
    )
    return document_content


# Folder


def write_touch_report(
    session_touches: Sequence[SessionTouches],
    error_messages: Mapping[str, str],
    folder: Path,
) -> None:
    """Write the report of touches into a folder.

    It consists of ``report.html``, ``figures/``, ``tables/touches.csv`` and ``touches.json``.

    Parameters
    ----------
    session_touches : sequence of SessionTouches
        At least one session.
    error_messages : mapping of str to str
        Message for each file that could not be analysed.
    folder : Path
        Existing folder that contains none of these files.

    Raises
    ------
    OutputExistsError, OutputError
        If a file exists or cannot be written.
    """
    from analysis.report import _page as pages
    from analysis.report._style import save_pictures
    from analysis.report._touch_figures import touch_illustrations

    pictures = save_pictures(list(touch_illustrations(session_touches)), folder / "figures")
    touch_table = touches_table(session_touches)
    write_new_file(folder / "tables" / "touches.csv", csv_text(touch_table))
    write_new_file(
        folder / "touches.json", document_text(touches_document(session_touches, error_messages))
    )
    page_html = pages.render_page(
        "touch.html",
        title=session_touches[0].path.stem
        if len(session_touches) == 1
        else f"{len(session_touches)} sessions",
        files=", ".join(session.path.name for session in session_touches),
        first=(),
        sentences=[line for session in session_touches for line in session_lines(session)[:1]],
        experiments=(),
        warnings=[
            *(
                f"{session.path.name}: {sentence}"
                for session in session_touches
                for sentence in session.warnings
            ),
            *(f"Left out: {message}" for message in error_messages.values()),
        ],
        pictures=pictures,
        tables=(touch_table,) if touch_table.rows else (),
        paper_pictures=(),
        paper_tables=(),
        how=[*_collect_facts(session_touches), pages.version_facts(datetime.now().astimezone())],
    )
    write_new_file(folder / "report.html", page_html)


def _collect_facts(session_touches: Sequence[SessionTouches]) -> list[FactGroup]:
    """Return groups of facts on sessions, model and estimator, for the HTML page."""
    return [
        (
            "Sessions",
            [
                (
                    str(session.path),
                    f"{session.rate_hz:g} Hz, "
                    + ("torque and base shear" if session.has_shear else "torque alone"),
                )
                for session in session_touches
            ],
        ),
        (
            "Model",
            sorted({(describe_model(session), _beam_text(session)) for session in session_touches}),
        ),
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
                    "springy obstacle at rest, simulated through its bounces; posterior of point, "
                    "instant and stiffness by population Monte Carlo, with the model's uncertainty",
                ),
                ("log-likelihood", "of each point with any force history (white prior)"),
                ("intervals", "95 %"),
            ],
        ),
    ]


def _beam_text(session: SessionTouches) -> str:
    """Return length, density and bending stiffness of a session's beam model as text."""
    model_beam = session.model.plant.beam
    return (
        f"length {model_beam.length_m:g} m, density {model_beam.density_kg_per_m:.5g} kg/m, "
        f"bending stiffness {model_beam.bending_stiffness_n_m2:.5g} N·m²"
    )
