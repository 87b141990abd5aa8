"""Analysis of sessions one by one from the command line: progress bar, reports, tables, JSON."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import typer

from analysis.cli.standard_streams import print_readable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rich.console import Console

    from analysis.paper.welch_analysis import WelchAnalysis
    from analysis.results import AnalysisOptions, ImagesByName, RecordResult, WholeRecord

_TEXT_WIDTH_CHARACTERS: Final = 120
"""Width in characters of texts that are printed to a file or a pipe."""
_STEPS_PER_FIGURE: Final = 4
"""Number of progress steps of a figure, which takes about as long as this many other steps."""


class NoSessionsError(ValueError):
    """Error if a folder contains no session."""


@dataclass(frozen=True, slots=True)
class OutputOptions:
    """Options of a command that select the files to be written and the tables to be printed.

    Attributes
    ----------
    report : Path or None
        Folder of the report, new or empty; None selects a folder next to the first file.
    json : Path or None
        New file for all results as JSON; ``-`` selects standard output, without other texts.
    overwrite : bool
        Whether an earlier report and an earlier JSON file are replaced.
    verbose : bool
        Whether all tables are printed, not only the main ones.
    """

    report: Path | None = None
    json: Path | None = None
    overwrite: bool = False
    verbose: bool = False

    @property
    def json_to_stdout(self) -> bool:
        """Whether the JSON results go to standard output; messages then go to standard error."""
        return self.json is not None and str(self.json) == "-"

    def console(self) -> Console:
        """Return the console to which texts are printed: of fixed width unless a terminal."""
        from rich.console import Console

        console = Console(stderr=self.json_to_stdout, highlight=False)
        if console.is_terminal:
            return console
        return Console(stderr=self.json_to_stdout, highlight=False, width=_TEXT_WIDTH_CHARACTERS)


def session_files(paths: Sequence[Path]) -> list[Path]:
    """Return the session files, with each folder replaced by its complete sessions.

    Parameters
    ----------
    paths : sequence of Path
        Files, which need not exist, and folders.

    Raises
    ------
    NoSessionsError
        A folder contains no session.
    """
    session_paths: list[Path] = []
    for path in paths:
        if not path.is_dir():
            session_paths.append(path)
            continue
        folder_sessions = sorted(
            session_file for session_file in path.glob("*.mcap") if not session_file.is_dir()
        )
        if not folder_sessions:
            has_incomplete_session = any(path.glob("*.mcap.part"))
            raise NoSessionsError(
                f"{path}: there is no session (*.mcap) in this folder; give session files, or the "
                "folder that holds them."
                + (
                    " Recover an incomplete file (*.mcap.part) with `rigd recover`."
                    if has_incomplete_session
                    else ""
                )
            )
        session_paths += folder_sessions
    return session_paths


def latest_session(folder: Path = Path("sessions")) -> Path:
    """Return the file of the newest complete session in a folder, by its time of start.

    Parameters
    ----------
    folder : Path
        Folder with session files, by default that in which ``rigd run`` writes them.

    Raises
    ------
    NoSessionsError
        The folder contains no session, or cannot be read.
    """
    from rigd.errors import UserError
    from rigd.library import list_sessions

    if not folder.exists():
        raise NoSessionsError(
            f"--latest: there is no folder {folder}; record a session (rigd run), or name a folder "
            "of session files: analyze --latest FOLDER."
        )
    try:
        sessions = list_sessions(folder)
    except UserError as error:
        raise NoSessionsError(f"--latest: {error}") from None
    for session in sessions:
        if session.start_utc_ns is not None and session.path.suffix == ".mcap":
            return session.path
    raise NoSessionsError(
        f"--latest: there is no session (*.mcap) in {folder}; name the folder: "
        "analyze --latest FOLDER."
    )


def session_command(
    files: Sequence[Path],
    options: AnalysisOptions,
    outputs: OutputOptions,
    rerun: Path | None = None,
    other_errors: Mapping[str, str] | None = None,
) -> int:
    """Analyse the files one after the other, write a report of each, and print the tables.

    Parameters
    ----------
    files : sequence of Path
        Session files.
    options : AnalysisOptions
        Analyses to be run, and their settings.
    outputs : OutputOptions
        Files to be written. The report folder contains the report of a single file, or one folder
        for each of several files.
    rerun : Path, optional
        New file with the session and its fits for Rerun's viewer; for a single session.
    other_errors : mapping of str to str, optional
        Error messages of further files that could not be used, by file name. They are added to the
        errors in the JSON results.

    Returns
    -------
    int
        Exit code: 0 done, 1 a file could not be analysed, 2 settings not applicable to a record.

    Raises
    ------
    OutputExistsError, OutputError
        An output file cannot be written.
    """
    from analysis.report.folder import report_folders, write_new_file

    folders = report_folders(files, outputs.report, overwrite=outputs.overwrite)
    record_results, errors, exit_code = _analyse_all(files, folders, options, rerun, outputs)
    if not record_results:
        return exit_code
    from analysis.report import document, document_text

    results_document = document(record_results, {**(other_errors or {}), **errors})
    if outputs.json is not None and not outputs.json_to_stdout:
        # The file is written before any output, because the streams may be closed.
        write_new_file(outputs.json, document_text(results_document), overwrite=outputs.overwrite)
    console = outputs.console()
    _print_tables(console, record_results, is_single_file=len(files) == 1, verbose=outputs.verbose)
    if outputs.json_to_stdout:
        typer.echo(document_text(results_document, ascii_only=True), nl=False)
    elif outputs.json is not None:
        _print_without_markup(console, f"All results as JSON: {outputs.json}")
    if rerun is not None:
        _print_without_markup(console, f"Session and fits for Rerun: {rerun} (rigd replay {rerun})")
    for session_file, folder in zip(files, folders, strict=True):
        if str(session_file) not in errors:
            report_page = folder / "report.html"
            _print_without_markup(
                console,
                f"Report of {session_file}: {report_page if report_page.exists() else folder}",
            )
    return exit_code


def _print_tables(
    console: Console, record_results: Sequence[RecordResult], *, is_single_file: bool, verbose: bool
) -> None:
    """Print the tables of a single file, or a summary of several files."""
    from analysis.report import result_text, shown_warnings, summary_table, warning_lines

    welch_results = [
        record_result for record_result in record_results if record_result.welch is not None
    ]
    if is_single_file:
        for record_result in record_results:
            console.print(result_text(record_result, verbose=verbose))
    elif not welch_results:
        from analysis.report import FileWarnings, shared_warnings

        for record_result in record_results:
            console.print(result_text(record_result, verbose=verbose, with_warnings=False))
        for line in warning_lines(
            shared_warnings(
                [
                    FileWarnings(each.name, each.record.path, shown_warnings(each))
                    for each in record_results
                ]
            )
        ):
            console.print(line)
    else:
        console.print(summary_table(welch_results))
        console.print("")


def _analyse_all(
    files: Sequence[Path],
    folders: Sequence[Path],
    options: AnalysisOptions,
    rerun_file: Path | None,
    outputs: OutputOptions,
) -> tuple[list[RecordResult], dict[str, str], int]:
    """Analyse and report each file; return results, error messages by file, and exit code.

    With several files, their warnings are printed after the last file, each warning once.
    """
    from numpy.linalg import LinAlgError

    from analysis.identify import MeasurementError
    from analysis.paper import FrequencyResponseError, SettingsError
    from analysis.record import RecordError
    from analysis.report.folder import OutputError
    from rigd.printable import progress_bar
    from rigd.session import SessionError

    record_results: list[RecordResult] = []
    error_messages: dict[str, str] = {}
    exit_code = 0
    file_warnings: list[list[str]] = [[] for _ in files]
    with progress_bar() as file_progress:
        print_message = partial(print_readable, file_progress.console)

        def print_warning(warning_text: str) -> None:
            print_message(f"Warning: {warning_text}")

        step_count = _count_steps(options, rerun_file)
        progress_task = file_progress.add_task("", total=len(files) * step_count)
        for file_number, (session_file, report_folder) in enumerate(
            zip(files, folders, strict=True), start=1
        ):

            def on_step(finished_step: str, file_name: str = session_file.name) -> None:
                step_weight = _STEPS_PER_FIGURE if finished_step.startswith("figure") else 1
                file_progress.update(
                    progress_task, advance=step_weight, description=f"{file_name}: {finished_step}"
                )

            try:
                record_results.append(
                    _analyse_file(
                        session_file,
                        report_folder,
                        options,
                        rerun_file,
                        on_step,
                        file_warnings[file_number - 1].append if len(files) > 1 else print_warning,
                        overwrite=outputs.overwrite,
                    )
                )
            except (
                SessionError, RecordError, FrequencyResponseError, MeasurementError, OutputError,
                MemoryError, LinAlgError,
            ) as error:  # fmt: skip
                exit_code = max(exit_code, 2 if isinstance(error, SettingsError) else 1)
                error_messages[str(session_file)] = error_text = _error_message(session_file, error)
                file_progress.update(progress_task, completed=file_number * step_count)
                print_message(f"Error: {error_text}")
        if len(files) > 1:
            from analysis.report import FileWarnings, shared_warnings

            for line in shared_warnings(
                [
                    FileWarnings(str(session_file), session_file, warning_texts)
                    for session_file, warning_texts in zip(files, file_warnings, strict=True)
                ]
            ):
                print_message(f"Warning: {line}")
    return record_results, error_messages, exit_code


def _error_message(session_file: Path, error: Exception) -> str:
    """Return the message that is printed for an error in the analysis of a file."""
    from numpy.linalg import LinAlgError

    if isinstance(error, MemoryError):
        return f"{session_file}: not enough memory to analyse it; close other programs."
    if isinstance(error, LinAlgError):
        return f"{session_file}: the estimate failed ({error}); is this a record of the rig?"
    return str(error)


def _count_steps(options: AnalysisOptions, rerun_file: Path | None) -> int:
    """Return the number of progress steps of the analysis of one file."""
    from analysis.report.folder import FIGURES, welch_figure_names

    figure_names = welch_figure_names(
        with_paper_figures=options.with_welch_fits, has_whole_record=options.whole_record
    )
    figure_count = (
        len(figure_names) + options.whole_record * len(FIGURES) + (rerun_file is not None)
    )
    return 2 + _STEPS_PER_FIGURE * figure_count  # reading, and all fits


def _analyse_file(
    session_file: Path,
    report_folder: Path,
    options: AnalysisOptions,
    rerun_file: Path | None,
    on_step: Callable[[str], None],
    warn: Callable[[str], None],
    *,
    overwrite: bool,
) -> RecordResult:
    """Analyse one file, and write its report and its file for Rerun."""
    from analysis.report.folder import new_report_folder
    from analysis.results import record_result

    # The report, which imports matplotlib, is imported where it is used first: another process
    # fits the record meanwhile.
    drawn_images: ImagesByName = {}

    def draw_welch(analysis: WelchAnalysis) -> None:
        from analysis.report.record_report import draw_welch_figures

        drawn_images.update(draw_welch_figures(analysis, options.figures, on_step))

    def draw_whole(whole_record: WholeRecord) -> None:
        from analysis.report.record_report import draw_first_figures

        drawn_images.update(draw_first_figures(whole_record, options.figures, on_step))

    file_result = record_result(
        session_file, options, on_step=on_step, warn=warn, on_welch=draw_welch, on_whole=draw_whole
    )
    from analysis.report.record_report import write_report

    with new_report_folder(report_folder, overwrite=overwrite) as partial_folder:
        write_report(
            file_result,
            partial_folder,
            on_step,
            formats=options.figures,
            drawn_images=drawn_images,
        )
    if rerun_file is not None:
        from analysis.report import write_rerun_file

        write_rerun_file(file_result, rerun_file)
        on_step("figure for Rerun")
    return file_result


def _print_without_markup(console: Console, text: str) -> None:
    """Print a text without markup and line wrapping."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)
