"""A session with its fits as a file for Rerun's viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from analysis.report.folder import OutputError, OutputExistsError
from rigd.session import read_session, read_timings
from rigd.view import RrdFileError, check_new, new_rrd_file

if TYPE_CHECKING:
    from pathlib import Path

    from analysis.paper import WelchAnalysis


def check_rerun_file(path: Path) -> None:
    """Raise OutputExistsError if a path is taken, or is no name of such a file."""
    try:
        check_new(path)
    except RrdFileError as error:
        raise OutputExistsError(f"--rerun {error}") from None


def write_rerun_file(analysis: WelchAnalysis, path: Path) -> None:
    """Write the session in the layout of the live view, and its fits in front of it.

    Parameters
    ----------
    analysis : WelchAnalysis
    path : Path
        A new file, ``….rrd``.

    Raises
    ------
    OutputError
        If it cannot be written, or has appeared meanwhile.
    rigd.session.SessionError
        If the session file cannot be read any more.
    """
    from analysis.report import fit_charts
    from analysis.report.write import tables_text
    from rigd.view import draw_session, recorded_blueprint

    session = read_session(analysis.record.path)
    timings = read_timings(analysis.record.path)
    try:
        with new_rrd_file(path) as stream:
            layout = recorded_blueprint([fit_charts.tab(analysis)])
            draw_session(stream, session, timings, layout=layout)
            fit_charts.draw(analysis, tables_text(analysis), stream)
    except RrdFileError as error:
        raise OutputError(str(error)) from None
