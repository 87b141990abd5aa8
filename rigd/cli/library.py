"""Commands ``rigd list``, ``specimens``, ``info`` and ``recover``: recorded sessions, specimens."""

import json
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from rigd.cli.options import (
    EXIT_FAILED,
    EXIT_WRONG_USE,
    SESSIONS_FOLDER,
    AsJson,
    fail,
    print_error,
    task_progress,
)
from rigd.printable import printable, readable_message

if TYPE_CHECKING:
    from rigd.estimates import Change, Estimate, ReportedMode
    from rigd.library import SessionRow
    from rigd.library.trend import ModeTrend, TrendPoint

_MAX_CELL_WIDTH: Final = 24
"""Largest width of a text in a table, in characters."""
_PLOT_WIDTH: Final = 25
"""Width of the plot of a trend, in characters."""
_FIRST_SESSION_TEXT: Final = (
    f"No sessions yet: there is no folder {SESSIONS_FOLDER}. Record one on the simulated rig with "
    "rigd run chirp --fast, or list those of another folder with rigd list FOLDER."
)
"""Text that is printed if the default folder of sessions does not exist."""


def list_sessions(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(metavar="FOLDER", help="Folders of session files (default: sessions)."),
    ] = None,
    specimen: Annotated[str, typer.Option("--specimen", help="Sessions of this specimen.")] = "",
    operator: Annotated[str, typer.Option("--operator", help="Sessions by this operator.")] = "",
    excitation: Annotated[
        str, typer.Option("--excitation", help="Sessions with this excitation, such as chirp.")
    ] = "",
    outcome: Annotated[
        str,
        typer.Option(
            "--outcome",
            help="Sessions with this outcome: complete, stopped, fault, unknown, recording, "
            "incomplete or unreadable.",
        ),
    ] = "",
    since: Annotated[
        str, typer.Option("--since", metavar="DATE", help="Sessions from this day or time on.")
    ] = "",
    until: Annotated[
        str, typer.Option("--until", metavar="DATE", help="Sessions up to this day or time.")
    ] = "",
    trend: Annotated[
        bool,
        typer.Option("--trend", help="Show the modes of one specimen over time."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """List recorded sessions with their modes, or a specimen's trend.

    The newest come first, with modes from the report or else from the quick look. Dates are local
    (2026-11-20 or 2026-11-20T14:30). Incomplete and third-party files are listed with the reason.
    The index library.sqlite in each folder only speeds up the list, and may be removed.

    Example: rigd list --specimen "antenna 3" --trend
    """
    from rigd.library import list_sessions as sessions_of
    from rigd.library.trend import mode_trends

    session_rows: list[SessionRow] = []
    if not folders:
        folders = [SESSIONS_FOLDER] if SESSIONS_FOLDER.exists() else []
    for folder in folders:
        with task_progress(folder.name) as on_progress:
            session_rows += sessions_of(
                folder,
                specimen=specimen,
                operator=operator,
                excitation=excitation,
                outcome=outcome,
                since=since,
                until=until,
                on_progress=on_progress,
            )
    session_rows.sort(key=lambda row: row.start_utc_ns or 0, reverse=True)
    if trend:
        trends = mode_trends(_sessions_of_one_specimen(session_rows))
    if as_json:
        json_document: dict[str, Any] = {"sessions": [row.as_dict() for row in session_rows]}
        if trend:
            json_document["trends"] = [mode_trend.as_dict() for mode_trend in trends]
        typer.echo(json.dumps(json_document))
    elif trend:
        typer.echo("\n".join(_trend_lines(trends)))
    elif not folders:
        typer.echo(_FIRST_SESSION_TEXT)
    else:
        typer.echo("\n".join(_session_lines(session_rows)))


def specimens() -> None:
    """List the specimens that have their own file.

    A file NAME.toml has the section [beam] of a profile and may have [beam.damping] and a text
    note. It is searched in specimens of the working folder, then in the per-user folder
    ($XDG_CONFIG_HOME/rigd/specimens, by default ~/.config/rigd/specimens). Sessions with --specimen
    NAME use its beam instead of the profile's.

    Example: rigd specimens
    """
    from rigd.profile import ProfileError, load_specimen, specimen_files

    for specimen_name, specimen_path in specimen_files().items():
        try:
            specimen = load_specimen(specimen_path)
        except ProfileError as error:
            beam_text = f"cannot be used: {str(error).splitlines()[0]}"
        else:
            beam = specimen.beam
            beam_text = (
                f"{beam.length_m:g} m, {beam.density_kg_per_m:g} kg/m, "
                f"{beam.bending_stiffness_n_m2:g} N·m²{specimen.note and f', {specimen.note}'} "
                f"({specimen_path})"
            )
        typer.echo(readable_message(f"{specimen_name}: {beam_text}"))


def _sessions_of_one_specimen(session_rows: "list[SessionRow]") -> "list[SessionRow]":
    """Return the sessions whose modes are known; end the command if they have several specimens."""
    rows_with_modes = [row for row in session_rows if row.modes]
    specimen_names = sorted({row.specimen for row in rows_with_modes})
    if len(specimen_names) > 1:
        specimen_list_text = ", ".join(
            repr(specimen_name) if specimen_name else "none" for specimen_name in specimen_names
        )
        fail(
            f"--trend: the sessions are of several specimens ({specimen_list_text}); name one by "
            "--specimen.",
            EXIT_WRONG_USE,
        )
    return rows_with_modes


def _local_start_text(row: "SessionRow") -> str:
    """Format the local date and time of a session's start; "" if it is unknown."""
    if row.start_utc_ns is None:
        return ""
    try:
        return f"{datetime.fromtimestamp(row.start_utc_ns / 1e9):%Y-%m-%d %H:%M}"
    except (ValueError, OverflowError, OSError):  # a year out of the range of datetime
        return ""


def _table_lines(
    column_titles: Sequence[str], table_rows: Sequence[Sequence[str]]
) -> Iterator[str]:
    """Yield the lines of a text table, without the columns whose cells are all empty."""
    filled_column_indices = [
        column_index
        for column_index in range(len(column_titles))
        if any(row[column_index] for row in table_rows)
    ]
    column_widths = {
        column_index: max(len(row[column_index]) for row in (column_titles, *table_rows))
        for column_index in filled_column_indices
    }
    for row in (column_titles, *table_rows):
        yield "  ".join(
            f"{row[column_index]:{column_widths[column_index]}}"
            for column_index in filled_column_indices
        ).rstrip()


def _session_lines(session_rows: "list[SessionRow]") -> Iterator[str]:
    """Yield the lines of the table of recorded sessions."""
    if not session_rows:
        yield "No sessions."
        return
    column_titles = (
        *("date", "file", "specimen", "operator", "excitation", "outcome", "modes"),
        *("tip slope", "uniform beam", "report"),
    )
    yield from _table_lines(
        column_titles,
        [
            (
                _local_start_text(row),
                printable(row.path.name),
                *(
                    printable(cell_text, _MAX_CELL_WIDTH)
                    for cell_text in (row.specimen, row.operator, row.excitation, row.outcome)
                ),
                ", ".join(map(_mode_text, row.modes)),
                _validity_text(row),
                _uniform_beam_text(row),
                "" if row.report is None else printable(row.report.parent.suffix[1:]),
            )
            for row in session_rows
        ],
    )
    for row in session_rows:
        if row.problem:
            yield f"{printable(row.path.name)}: {row.problem}"


def _mode_text(mode: "ReportedMode") -> str:
    """Format a mode's frequency and damping ratio; a "?" marks values that an analysis doubts."""
    flag_suffix = "?" if mode.flag else ""
    return f"{mode.frequency_hz.value:.4g} Hz {100 * mode.damping_ratio.value:.3g} %{flag_suffix}"


def _validity_text(row: "SessionRow") -> str:
    """Return a short text on whether a session's linear model is valid; "" if it has no modes."""
    from rigd.session import Validity

    return Validity.from_document(row.validity).short_text if row.modes else ""


def _uniform_beam_text(row: "SessionRow") -> str:
    """Return a short text on whether a uniform beam predicts a session's modes; "" if unknown."""
    from rigd.session import Validity

    check_result = Validity.from_document(row.validity).uniform_beam
    return "" if check_result is None or not row.modes else check_result.short_text


# Trend


def _trend_lines(trends: "list[ModeTrend]") -> Iterator[str]:
    """Yield the lines that show how each mode changes over the sessions."""
    if not trends:
        yield "No modes are known for these sessions; analyze them first."
        return
    for mode_number, mode_trend in enumerate(trends, start=1):
        if mode_number > 1:
            yield ""
        lowest_hz, highest_hz = _frequency_limits(mode_trend)
        yield from _table_lines(
            (
                *(f"mode {mode_number}", "frequency (Hz)", "change", "damping (%)", "change", ""),
                *("tip slope", "file"),
            ),
            [
                (
                    _local_start_text(trend_point.row),
                    _quantity_text(trend_point.frequency_hz),
                    _change_text(
                        trend_point.frequency_change, mode_trend.points[0].frequency_hz.value
                    ),
                    _quantity_text(trend_point.damping_ratio, 100),
                    _change_text(
                        trend_point.damping_change, mode_trend.points[0].damping_ratio.value
                    ),
                    _interval_plot(trend_point, lowest_hz, highest_hz),
                    _validity_text(trend_point.row),
                    printable(trend_point.row.path.name),
                )
                for trend_point in mode_trend.points
            ],
        )
    yield ""
    yield (
        "± and bars of the frequency: 95 % intervals. Changes since the mode's first session; * is "
        "significant (3 standard deviations), ? is flagged in its report or quick look. Tip slope: "
        "its largest value, and the error of the linear model there."
    )


def _frequency_limits(trend: "ModeTrend") -> tuple[float, float]:
    """Return the lowest and highest end of all sessions' frequency intervals of a mode, in Hz."""
    interval_ends_hz = [
        end
        for trend_point in trend.points
        for end in trend_point.frequency_hz.interval_95 or [trend_point.frequency_hz.value]
    ]
    return min(interval_ends_hz), max(interval_ends_hz)


def _interval_plot(point: "TrendPoint", axis_begin_hz: float, axis_end_hz: float) -> str:
    """Return a text plot, one line, of the frequency of a session's mode with its interval.

    The axis extends from `axis_begin_hz` to `axis_end_hz`.
    """
    if axis_end_hz <= axis_begin_hz:
        return ""

    def plot_column(frequency_hz: float) -> int:
        return min(
            max(
                round(
                    (frequency_hz - axis_begin_hz)
                    / (axis_end_hz - axis_begin_hz)
                    * (_PLOT_WIDTH - 1)
                ),
                0,
            ),
            _PLOT_WIDTH - 1,
        )

    frequency_value_hz = point.frequency_hz.value
    first_column, last_column = map(
        plot_column, point.frequency_hz.interval_95 or (frequency_value_hz, frequency_value_hz)
    )
    plot_characters = [
        "─" if first_column <= column_index <= last_column else " "
        for column_index in range(_PLOT_WIDTH)
    ]
    plot_characters[plot_column(frequency_value_hz)] = "●"
    return "".join(plot_characters)


def _quantity_text(estimate: "Estimate", display_factor: float = 1.0) -> str:
    """Format a value with the half-width of its 95 % interval; "?" marks a doubtful one."""
    return estimate.text(display_factor) + (" ?" if estimate.flag else "")


def _change_text(change: "Change | None", first_session_value: float) -> str:
    """Format the change of a mode's value in percent of the first; "*" marks a significant one."""
    if change is None or first_session_value == 0:
        return ""
    change_percent = 100 * change.difference / first_session_value
    return f"{change_percent:+.2g} %{' *' if change.significant else ''}"


# Single files


def info(
    paths: Annotated[
        list[Path], typer.Argument(metavar="FILE...", readable=False, help="Session files.")
    ],
    as_json: AsJson = False,
) -> None:
    """Show the contents of session files.

    Example: rigd info sessions/20261120-101500-chirp.mcap
    """
    from rigd.session import SessionError, describe

    json_documents: list[dict[str, Any]] = []
    has_failed = False
    for file_number, file_path in enumerate(paths):
        try:
            with task_progress(file_path.name) as on_progress:
                description = describe(file_path, on_progress)
        except SessionError as error:
            has_failed = True
            print_error(str(error))
            json_documents.append({"path": str(file_path), "error": str(error)})
        else:
            json_documents.append(description.as_dict())
            if not as_json:
                typer.echo(("\n" if file_number else "") + "\n".join(description.lines()))
    if as_json and not (has_failed and len(paths) == 1):
        typer.echo(json.dumps(json_documents[0] if len(paths) == 1 else {"files": json_documents}))
    if has_failed:
        raise typer.Exit(EXIT_FAILED)


def recover(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", readable=False, help="Incomplete .mcap.part or damaged .mcap files."
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Recover the intact part of incomplete or damaged session files.

    Writes X.mcap next to X.mcap.part, and X.recovered.mcap next to a damaged X.mcap, with every
    sample up to the damage, marked as recovered. Nothing is overwritten or removed.

    Example: rigd recover sessions/20261120-101500-chirp.mcap.part
    """
    from rigd.session import SessionError
    from rigd.session import recover as recover_file

    json_documents: list[dict[str, Any]] = []
    has_failed = False
    for file_path in paths:
        try:
            with task_progress(file_path.name) as on_progress:
                recovery = recover_file(file_path, on_progress)
        except SessionError as error:
            has_failed = True
            print_error(str(error))
            json_documents.append({"source": str(file_path), "path": None, "error": str(error)})
        else:
            json_documents.append(recovery.as_dict())
            if not as_json:
                typer.echo("\n".join(recovery.lines()))
    if as_json:
        typer.echo(json.dumps({"files": json_documents}))
    if has_failed:
        raise typer.Exit(EXIT_FAILED)
