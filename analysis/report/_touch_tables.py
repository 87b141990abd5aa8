"""Touches of sessions as a table, and as a document."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from analysis.report._document import versions
from analysis.report._table import WORDS, Cell, Column, Entry, Table, number
from analysis.results import finite
from rigd.units import decimals, with_half_width

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.touch import Touch, TouchedSession
    from rigd.touch import Estimated

_LOPSIDED = 0.25
"""Distance of a value from the middle of its interval, as a share of that, from which on the
ends are told instead."""
_KINDS = {
    "rigid": "obstacle at rest",
    "yielding": "obstacle that gives way",
    "moving": "moving obstacle",
    "knock": "knock",
    "unknown": "cannot tell",
}


def touches_table(sessions: Sequence[TouchedSession]) -> Table:
    """Put the touches of all sessions into a table.

    Parameters
    ----------
    sessions : sequence of TouchedSession
    """
    several = len(sessions) > 1
    columns = (
        Column("Session" if several else "", "session", WORDS),
        Column("Touch", "number"),
        Column("Time (s)", "time_s"),
        Column("From the axis (m)", "x_m"),
        Column("Angle (rad)", "angle_rad", ".4f"),
        Column("Peak force (N)", "force_n"),
        Column("Stiffness (N/m)", "stiffness_n_per_m"),
        Column("Kind", "kind", WORDS),
    )
    rows = [_row(session, touch) for session in sessions for touch in session.touches]
    return Table(
        "touches",
        "Touches",
        columns,
        tuple(rows),
        ("± or to: 95 % interval; the angle is that of the motor at the touch.",) if rows else (),
        grouped=several,
    )


def _row(session: TouchedSession, touch: Touch) -> dict[str, Entry]:
    estimate = touch.estimate
    row: dict[str, Entry] = {
        "session": session.path.stem,
        "number": touch.number,
        "angle_rad": touch.angle_rad,
        "kind": "not estimated" if estimate is None else _KINDS.get(estimate.kind, estimate.kind),
    }
    told: dict[str, tuple[Estimated | None, float]] = {}
    if estimate is not None:
        told = {
            "time_s": (estimate.time_s, touch.start_s),
            "x_m": (estimate.x_m, 0.0),
            "force_n": (estimate.force_n, 0.0),
            "stiffness_n_per_m": (estimate.stiffness_n_per_m, 0.0),
        }
    for key in ("time_s", "x_m", "force_n", "stiffness_n_per_m"):
        found, start = told.get(key, (None, 0.0))
        row[key] = _cell(found, start)
        row[f"{key}_std"] = None if found is None else found.std
    return row


def _cell(found: Estimated | None, start: float) -> Cell:
    if found is None:
        return number(None)
    value = found.value + start
    low, high = (each + start for each in found.interval_95)
    if abs(value - (low + high) / 2) > _LOPSIDED * (high - low):
        digits = decimals((high - low) / 2)
        return Cell(value, f"{low:.{digits}f} to {high:.{digits}f}".replace("-", "−"))
    return Cell(value, with_half_width(value, (low, high)).replace("-", "−"))


def session_lines(session: TouchedSession) -> list[str]:
    """Say what was found in a session, and by what model.

    Parameters
    ----------
    session : TouchedSession
    """
    count = len(session.touches)
    what = "no touch" if count == 0 else "1 touch" if count == 1 else f"{count} touches"
    by = "during the session" if session.found == "loop" else "in the record"
    detected = f", detected {by}" if count else ""
    return [
        f"{session.path.name}: {what}{detected}. Model: {model_words(session)}.",
        *(f"Warning: {sentence}" for sentence in session.warnings),
    ]


def model_words(session: TouchedSession) -> str:
    """Say where the model of the beam comes from.

    Parameters
    ----------
    session : TouchedSession
    """
    source = session.model.source
    return "the nominal beam of the attached profile" if source == "profile" else source


def touches_document(
    sessions: Sequence[TouchedSession], errors: Mapping[str, str]
) -> dict[str, Any]:
    """Collect the touches of all sessions.

    Parameters
    ----------
    sessions : sequence of TouchedSession
    errors : mapping of str to str
        Message for each file that could not be analysed.

    Returns
    -------
    dict
        ``versions``, ``touches`` and ``errors``: lists of objects that name their file.
    """
    content: dict[str, Any] = finite(
        {
            "versions": versions(),
            "touches": [
                {"file": str(session.path), "detected": session.found, **touch.as_dict()}
                for session in sessions
                for touch in session.touches
            ],
            "errors": [{"file": file, "message": message} for file, message in errors.items()],
        }
    )
    return content
