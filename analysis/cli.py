"""Command `analyze`: parses options, runs the analysis file by file, prints and writes results."""

from __future__ import annotations

import os
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from analysis.commands.default_command import DEFAULT, DefaultCommandGroup
from analysis.commands.exchange import IMPORT_EPILOG, export_app, import_command
from analysis.commands.welch_options import (
    Band,
    Estimator,
    Frf,
    Nfft,
    Overlap,
    Segment,
    welch_settings,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rich.console import Console

    from analysis.settings import WelchSettings
    from analysis.welch_route import WelchAnalysis

_FIGURE_STEPS = 4
"""How many times longer a figure takes than another step, roughly."""

_EPILOG = """\
Example: analyze session.mcap --types III,VI --json fits.json

Writes figures, tables and JSON into session.report/ beside the file (session.report-2/ if that
exists). Records of other programs: analyze import --help; results for them: analyze export --help.
Exit code: 0 done, 1 a file could not be analysed, 2 wrong use, 130 stopped by Ctrl-C."""


class Method(Enum):
    """Ways from a record to models."""

    WELCH = "welch"
    ALL = "all"


# Plain messages of one or two sentences, not boxes: they end up in logs.
app = typer.Typer(
    cls=DefaultCommandGroup,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
app.command("import", epilog=IMPORT_EPILOG)(import_command)
app.add_typer(export_app, name="export")


def main() -> None:
    """Entry point of the command."""
    # Threads gain nothing on matrices as small as a fit's, and cost a tenth of the time.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    app()


@app.command(DEFAULT, epilog=_EPILOG)
def analyze(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="FILE", readable=False, help="Session files (.mcap)."),
    ],
    method: Annotated[
        Method, typer.Option(help="welch: the paper's; all: every method there is.")
    ] = Method.ALL,
    types: Annotated[
        str, typer.Option(metavar="LIST", help="Model types, of I to VII, comma-separated.")
    ] = "I,II,III,IV,V,VI",
    weights: Annotated[
        str,
        typer.Option(
            metavar="LIST",
            help="Weightings of the cost: const, omega (1/omega), omega^K for any power K.",
        ),
    ] = "const,omega",
    band: Band = "0.5875,50",
    frf: Estimator = Frf.H1,
    segment: Segment = None,
    overlap: Overlap = None,
    nfft: Nfft = None,
    report: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the report, new or empty; of several files, one folder each in it.",
        ),
    ] = None,
    json: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="New file for all results as JSON; - for stdout."),
    ] = None,
    rerun: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.rrd",
            help="New file with the session and its fits for Rerun's viewer; of one session file.",
        ),
    ] = None,
) -> None:
    """Identify the damping of a slewing beam from recorded sessions.

    Estimates the frequency response from motor angle to coupling torque, fits the fractional
    damping models to it, and prints and draws the results.
    """
    del method  # There is one so far, so both choices come to the same.
    from analysis.report.folder import OutputError, OutputExistsError, check_new_file

    settings = welch_settings(types, weights, band, frf, segment, overlap, nfft)
    try:
        to_stdout = json is not None and str(json) == "-"
        if json is not None and not to_stdout:
            check_new_file(json, "--json")
        if rerun is not None:
            _check_rerun(rerun, files)
        code = _run(files, settings, report, json, rerun)
    except OutputExistsError as error:
        _complain(str(error))
        code = 2
    except OutputError as error:
        _complain(str(error))
        code = 1
    except KeyboardInterrupt:
        typer.echo("Stopped.", err=True)
        code = 130
    raise typer.Exit(code)


def _run(
    files: Sequence[Path],
    settings: WelchSettings,
    report: Path | None,
    json: Path | None,
    rerun: Path | None,
) -> int:
    """Analyse the files one after the other and return the exit code."""
    from rich.console import Console

    from analysis.report.document import document, document_text
    from analysis.report.folder import report_folders, write_new
    from analysis.report.tables import analysis_tables, summary_table

    folders = report_folders(files, report)
    analyses, errors, code = _analyse_all(files, folders, settings, rerun)
    if not analyses:
        return code
    to_stdout = json is not None and str(json) == "-"
    console = Console(stderr=to_stdout, highlight=False)
    if not console.is_terminal:
        console = Console(stderr=to_stdout, highlight=False, width=120)
    if len(files) == 1:
        console.print(analysis_tables(analyses[0]))
    else:
        console.print(summary_table(analyses))
    _say(console, "")
    for file, folder in zip(files, folders, strict=True):
        if str(file) not in errors:
            _say(console, f"Report of {file}: {folder}")
    if rerun is not None:
        _say(console, f"Session and fits for Rerun: {rerun} (rigd replay {rerun})")
    if json is not None:
        text = document_text(document(analyses, errors))
        if to_stdout:
            typer.echo(text, nl=False)
        else:
            write_new(json, text)
            _say(console, f"All results as JSON: {json}")
    return code


def _analyse_all(
    files: Sequence[Path], folders: Sequence[Path], settings: WelchSettings, rerun: Path | None
) -> tuple[list[WelchAnalysis], dict[str, str], int]:
    """Analyse and report every file; return results, message by failed file, and exit code."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from analysis.estimate import EstimateError, SettingsError
    from analysis.record import RecordError
    from analysis.report.folder import OutputError
    from rigd.session import SessionError

    analyses: list[WelchAnalysis] = []
    errors: dict[str, str] = {}
    code = 0
    terminal = _standard_error()
    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TimeRemainingColumn(),
        console=terminal,
        transient=True,
        disable=not terminal.is_terminal,
    ) as progress:
        steps = _steps(settings, rerun)
        task = progress.add_task("", total=len(files) * steps)
        for number, (file, folder) in enumerate(zip(files, folders, strict=True), start=1):

            def on_step(done: str, name: str = file.name) -> None:
                weight = _FIGURE_STEPS if done.startswith("figure") else 1
                progress.update(task, advance=weight, description=f"{name}: {done}")

            try:
                analyses.append(_analyse_file(file, folder, settings, rerun, on_step))
            except (SessionError, RecordError, EstimateError, OutputError) as error:
                code = max(code, 2 if isinstance(error, SettingsError) else 1)
                errors[str(file)] = str(error)
                progress.update(task, completed=number * steps)
                terminal.print(f"Error: {error}", markup=False, highlight=False, soft_wrap=True)
    return analyses, errors, code


def _steps(settings: WelchSettings, rerun: Path | None) -> int:
    from analysis.report.write import FIGURES

    pictures = len(FIGURES) + (rerun is not None)
    return 2 + len(settings.types) + _FIGURE_STEPS * pictures


def _analyse_file(
    file: Path,
    folder: Path,
    settings: WelchSettings,
    rerun: Path | None,
    on_step: Callable[[str], None],
) -> WelchAnalysis:
    from analysis.record import load_record
    from analysis.report.folder import new_folder
    from analysis.report.write import write_report
    from analysis.welch_route import analyse

    record = load_record(file)
    on_step("read")
    analysis = analyse(record, settings, on_step)
    with new_folder(folder) as part:
        write_report(analysis, part, on_step)
    if rerun is not None:
        from analysis.report.rerun_file import write_rerun_file

        write_rerun_file(analysis, rerun)
        on_step("figure for Rerun")
    return analysis


def _check_rerun(rerun: Path, files: Sequence[Path]) -> None:
    from analysis.report.rerun_file import check_rerun_file

    if len(files) > 1:
        raise typer.BadParameter(
            f"it takes one session, and {len(files)} files were given.", param_hint="--rerun"
        )
    check_rerun_file(rerun)


def _standard_error() -> Console:
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def _say(console: Console, text: str) -> None:
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def _complain(message: str) -> None:
    typer.echo(f"Error: {message}", err=True)


if __name__ == "__main__":
    main()
