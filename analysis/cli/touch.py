"""Command `analyze touch`: position, time and force of touches of the antenna in records."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from analysis.cli.sessions import NoSessionsError, OutputOptions, session_files
from analysis.cli.standard_streams import print_error, print_readable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.touch import SessionTouches

TOUCH_EPILOG = """\
Example: analyze touch sessions/*.mcap --model beam.json --report touches

Exit code: 0 done, 1 a file could not be analysed, 2 usage error, 130 stopped by Ctrl-C."""
"""Text at the end of the help of the command."""


def touch_command(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="SESSION", readable=False, help="Session files (.mcap), or folders of them."
        ),
    ],
    model: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            readable=False,
            help="JSON of analyze with the beam to assume.  [default: the profile in each file]",
        ),
    ] = None,
    json: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the touches as JSON; - for standard output."),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write a report with figures to this new folder."),
    ] = None,
) -> None:
    """Estimate where, when and how hard the antenna met something.

    Uses the touches that were detected during a session; without any it searches the record for
    them.
    """
    from analysis.report.folder import (
        OutputError,
        OutputExistsError,
        check_new_file,
        report_folders,
    )
    from rigd.identified_beam import IdentifiedBeamError

    output_options = OutputOptions(report, json)
    try:
        files = session_files(files)
        if json is not None and not output_options.json_to_stdout:
            check_new_file(json, "--json")
        if report is not None:
            report_folders(files[:1], report)
        exit_code = _run_analysis(files, model, output_options)
    except (OutputExistsError, IdentifiedBeamError) as error:
        print_error(str(error))
        exit_code = 2
    except (NoSessionsError, OutputError) as error:
        print_error(str(error))
        exit_code = 1
    except KeyboardInterrupt:
        typer.echo("Stopped.", err=True)
        exit_code = 130
    raise typer.Exit(exit_code)


def _run_analysis(files: Sequence[Path], model_file: Path | None, outputs: OutputOptions) -> int:
    """Analyse the files, print and write the results, and return the exit code."""
    from analysis.report import document_text
    from analysis.report.folder import new_report_folder, write_new_file
    from analysis.report.table import terminal_table
    from analysis.report.touch_report import (
        session_lines,
        touches_document,
        touches_table,
        write_touch_report,
    )

    session_touches, error_messages = _analyse_sessions(files, model_file)
    json_document = touches_document(session_touches, error_messages)
    if outputs.json is not None and not outputs.json_to_stdout:
        write_new_file(outputs.json, document_text(json_document))
    if outputs.report is not None and session_touches:
        with new_report_folder(outputs.report) as partial_folder:
            write_touch_report(session_touches, error_messages, partial_folder)
    console = outputs.console()
    print_without_markup = partial(console.print, markup=False, highlight=False, soft_wrap=True)
    for touched_session in session_touches:
        for table_line in session_lines(touched_session):
            print_without_markup(table_line)
    if any(touched_session.touches for touched_session in session_touches):
        print_without_markup("")
        console.print(terminal_table(touches_table(session_touches)))
    if outputs.json_to_stdout:
        typer.echo(document_text(json_document, ascii_only=True), nl=False)
    if outputs.report is not None and session_touches:
        print_without_markup(f"Report: {outputs.report / 'report.html'}")
    return 1 if error_messages else 0


def _analyse_sessions(
    files: Sequence[Path], model_file: Path | None
) -> tuple[list[SessionTouches], dict[str, str]]:
    """Analyse the touches in each file; return the results, and error messages by file."""
    from analysis.record import RecordError
    from analysis.touch import TouchAnalysis
    from rigd.printable import progress_bar
    from rigd.session import SessionError

    session_touches: list[SessionTouches] = []
    error_messages: dict[str, str] = {}
    touch_analysis = TouchAnalysis(model_file)
    with progress_bar() as file_progress:
        progress_task = file_progress.add_task("", total=len(files))
        for file_number, session_file in enumerate(files):

            def on_step(step: str, file_name: str = session_file.name) -> None:
                file_progress.update(progress_task, description=f"{file_name}: {step}")

            try:
                session_touches.append(touch_analysis.analyse_session(session_file, on_step))
            except (SessionError, RecordError, MemoryError) as error:
                error_text = (
                    str(error) or f"{session_file}: not enough memory; close other programs."
                )
                error_messages[str(session_file)] = error_text
                print_readable(file_progress.console, f"Error: {error_text}")
            file_progress.update(progress_task, completed=file_number + 1)
    return session_touches, error_messages
