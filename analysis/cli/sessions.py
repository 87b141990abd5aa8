"""Sessions analysed one by one from the command line: progress, reports, tables, JSON."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import typer

from analysis.cli.standard_streams import print_readable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from rich.console import Console

    from analysis.results import RecordResult, Routes

_TEXT_WIDTH: Final = 120
"""Columns of what is printed into a file or a pipe."""
_FIGURE_STEPS: Final = 4
"""How many times longer a figure takes than another step, roughly."""


class NoSessionsError(ValueError):
    """A folder without a session."""


@dataclass(frozen=True, slots=True)
class Outputs:
    """What is written and printed.

    Attributes
    ----------
    report : Path or None
        Folder of the report, new or empty; by default next to the first file.
    json : Path or None
        New file for all results; ``-`` for standard output, which then holds nothing else.
    overwrite : bool
        Whether an earlier report, and earlier results in JSON, are replaced.
    verbose : bool
        Whether all tables are printed.
    """

    report: Path | None = None
    json: Path | None = None
    overwrite: bool = False
    verbose: bool = False

    @property
    def json_to_stdout(self) -> bool:
        """Whether standard output is for the results alone."""
        return self.json is not None and str(self.json) == "-"

    def console(self) -> Console:
        """Return where people's text goes, in the report's width where that is not a terminal."""
        from rich.console import Console

        console = Console(stderr=self.json_to_stdout, highlight=False)
        if console.is_terminal:
            return console
        return Console(stderr=self.json_to_stdout, highlight=False, width=_TEXT_WIDTH)


def session_files(paths: Sequence[Path]) -> list[Path]:
    """Replace each folder by the sessions in it, by name; incomplete ones are left out.

    Parameters
    ----------
    paths : sequence of Path
        Files, which need not exist, and folders.

    Raises
    ------
    NoSessionsError
        A folder has no session in it.
    """
    found: list[Path] = []
    for path in paths:
        if not path.is_dir():
            found.append(path)
            continue
        sessions = sorted(each for each in path.glob("*.mcap") if each.is_file())
        if not sessions:
            torn = any(path.glob("*.mcap.part"))
            raise NoSessionsError(
                f"{path}: there is no session (*.mcap) in this folder; give session files, or the "
                "folder that holds them."
                + (" Recover an incomplete file (*.mcap.part) with `rigd recover`." if torn else "")
            )
        found += sessions
    return found


def session_command(
    files: Sequence[Path],
    routes: Routes,
    outputs: Outputs,
    rerun: Path | None = None,
    others: Mapping[str, str] | None = None,
) -> int:
    """Analyse the files one after the other, write a report of each, and print the tables.

    Parameters
    ----------
    files : sequence of Path
    routes : Routes
    outputs : Outputs
        Its folder is that of the report of one file, or of one folder per file.
    rerun : Path, optional
        New file with session and fits for Rerun's viewer, of one session.
    others : mapping of str to str, optional
        Files that were left out before, with the reported reasons, which become errors of the
        results.

    Returns
    -------
    int
        Exit code: 1 if a file could not be analysed, 2 if the settings suit none, 0 otherwise.

    Raises
    ------
    OutputExistsError, OutputError
        Something cannot be written.
    """
    from analysis.report import document, document_text
    from analysis.report.folder import report_folders, write_new

    folders = report_folders(files, outputs.report, overwrite=outputs.overwrite)
    found, errors, code = _analyse_all(files, folders, routes, rerun, outputs)
    if not found:
        return code
    results = document(found, {**(others or {}), **errors})
    if outputs.json is not None and not outputs.json_to_stdout:
        # Before any output: the streams may be closed.
        write_new(outputs.json, document_text(results), overwrite=outputs.overwrite)
    console = outputs.console()
    _print_tables(console, found, single=len(files) == 1, verbose=outputs.verbose)
    if outputs.json_to_stdout:
        typer.echo(document_text(results, ascii_only=True), nl=False)
    elif outputs.json is not None:
        _say(console, f"All results as JSON: {outputs.json}")
    if rerun is not None:
        _say(console, f"Session and fits for Rerun: {rerun} (rigd replay {rerun})")
    for file, folder in zip(files, folders, strict=True):
        if str(file) not in errors:
            page = folder / "report.html"
            _say(console, f"Report of {file}: {page if page.exists() else folder}")
    return code


def _print_tables(
    console: Console, results: Sequence[RecordResult], *, single: bool, verbose: bool
) -> None:
    """Print the main tables of a single file, or all of them; for several files a summary."""
    from analysis.report import result_text, summary_table

    by_welch = [each for each in results if each.welch is not None]
    if single or not by_welch:
        for each in results:
            console.print(result_text(each, verbose=verbose))
    else:
        console.print(summary_table(by_welch))
        console.print("")


def _analyse_all(
    files: Sequence[Path],
    folders: Sequence[Path],
    routes: Routes,
    rerun: Path | None,
    outputs: Outputs,
) -> tuple[list[RecordResult], dict[str, str], int]:
    """Analyse and report every file; return results, message by failed file, and exit code."""
    from numpy.linalg import LinAlgError

    from analysis.identify import MeasurementError
    from analysis.paper import FrequencyResponseError, SettingsError
    from analysis.record import RecordError
    from analysis.report.folder import OutputError
    from rigd.printable import progress_bar
    from rigd.session import SessionError

    found: list[RecordResult] = []
    errors: dict[str, str] = {}
    code = 0
    with progress_bar() as progress:
        print_message = partial(print_readable, progress.console)
        steps = _steps(routes, rerun)
        task = progress.add_task("", total=len(files) * steps)
        for number, (file, folder) in enumerate(zip(files, folders, strict=True), start=1):

            def on_step(done: str, name: str = file.name) -> None:
                weight = _FIGURE_STEPS if done.startswith("figure") else 1
                progress.update(task, advance=weight, description=f"{name}: {done}")

            try:
                found.append(
                    _analyse_file(
                        file,
                        folder,
                        routes,
                        rerun,
                        on_step,
                        print_message,
                        overwrite=outputs.overwrite,
                    )
                )
            except (
                SessionError, RecordError, FrequencyResponseError, MeasurementError, OutputError,
                MemoryError, LinAlgError,
            ) as error:  # fmt: skip
                code = max(code, 2 if isinstance(error, SettingsError) else 1)
                errors[str(file)] = message = _error_message(file, error)
                progress.update(task, completed=number * steps)
                print_message(f"Error: {message}")
    return found, errors, code


def _error_message(file: Path, error: Exception) -> str:
    from numpy.linalg import LinAlgError

    if isinstance(error, MemoryError):
        return f"{file}: not enough memory to analyse it; close other programs."
    if isinstance(error, LinAlgError):
        return f"{file}: the estimate failed ({error}); is this a record of the rig?"
    return str(error)


def _steps(routes: Routes, rerun: Path | None) -> int:
    from analysis.report import FIGURES as OF_RECORD
    from analysis.report.record_report import figures_of_paper

    figures = figures_of_paper(paper=routes.paper, whole_record=routes.whole_record)
    pictures = len(figures) + routes.whole_record * len(OF_RECORD) + (rerun is not None)
    steps = 1 + routes.whole_record + routes.paper * (1 + len(routes.settings.types))
    return steps + _FIGURE_STEPS * pictures


def _analyse_file(
    file: Path,
    folder: Path,
    routes: Routes,
    rerun: Path | None,
    on_step: Callable[[str], None],
    print_message: Callable[[str], None],
    *,
    overwrite: bool,
) -> RecordResult:
    from analysis.report.folder import new_folder
    from analysis.report.record_report import write_report
    from analysis.results import record_result

    result = record_result(
        file, routes, on_step=on_step,
        warn=lambda text: print_message(f"Warning: {text}"),
    )  # fmt: skip
    with new_folder(folder, overwrite=overwrite) as part:
        write_report(result, part, on_step, formats=routes.figures)
    if rerun is not None:
        from analysis.report import write_rerun_file

        write_rerun_file(result, rerun)
        on_step("figure for Rerun")
    return result


def _say(console: Console, text: str) -> None:
    console.print(text, markup=False, highlight=False, soft_wrap=True)
