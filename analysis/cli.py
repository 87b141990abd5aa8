"""Command `analyze`: parses options, runs the analysis file by file, prints and writes results."""

from __future__ import annotations

import os
from dataclasses import dataclass
from enum import Enum
from functools import partial
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

    from analysis.record import Record
    from analysis.report.html import Subject
    from analysis.settings import WelchSettings
    from analysis.welch_route import WelchAnalysis
    from analysis.whole_record import Setting

    _Found = tuple[WelchAnalysis, Subject | None]

_FIGURE_STEPS = 4
"""How many times longer a figure takes than another step, roughly."""

_EPILOG = """\
Example: analyze session.mcap --types III,VI --json fits.json

Writes figures, tables and JSON into session.report/ beside the file (session.report-2/ if that
exists). Several files are a campaign: statistics, nominal models, pooled estimate and validation go
to campaign.report/ beside the first. Records of other programs: analyze import --help; results for
them: analyze export --help.
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
        Method, typer.Option(help="welch: the paper's; all: the whole record's before it.")
    ] = Method.ALL,
    fix: Annotated[
        str,
        typer.Option(
            metavar="LIST",
            help="What the whole-record fits take from the file instead of estimating it, of "
            "density_over_stiffness, bending_stiffness_n_m2, delay_s, tool_inertia_kg_m2.",
        ),
    ] = "",
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
            help="Folder of the report, new or empty; with --each, one folder a file in it.",
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
    each: Annotated[
        bool,
        typer.Option("--each", help="Of several files, a report of each and not of the campaign."),
    ] = False,
    paper: Annotated[
        bool, typer.Option("--paper", help="Campaign: the paper's Tables 3 and 4 beside its own.")
    ] = False,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, help="Campaign: worker processes.  [default: one a core]"),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Campaign: Dask scheduler whose workers are used."),
    ] = None,
) -> None:
    """Identify the damping of a slewing beam from recorded sessions.

    Estimates the frequency response from motor angle to coupling torque, fits the fractional
    damping models to it, and prints and draws the results.
    """
    from analysis.campaigns.errors import CampaignError
    from analysis.report.folder import OutputError, OutputExistsError, check_new_file

    settings = welch_settings(types, weights, band, frf, segment, overlap, nfft)
    routes = _Routes(settings, whole_record=method is Method.ALL, fixed=_fixed(fix))
    try:
        to_stdout = json is not None and str(json) == "-"
        if json is not None and not to_stdout:
            check_new_file(json, "--json")
        if rerun is not None:
            _check_rerun(rerun, files)
        if len(files) == 1 or each:
            code = _run(files, routes, report, json, rerun)
        else:
            from analysis.campaigns.command import campaign_command
            from analysis.structures import STRUCTURES

            code = campaign_command(
                files, settings, structures=tuple(STRUCTURES) if routes.whole_record else (),
                fixed=routes.fixed, report=report, json=json, jobs=jobs, dask=dask,
                with_paper=paper,
            )  # fmt: skip
    except OutputExistsError as error:
        _complain(str(error))
        code = 2
    except (OutputError, CampaignError) as error:
        _complain(str(error))
        code = 1
    except KeyboardInterrupt:
        typer.echo("Stopped.", err=True)
        code = 130
    raise typer.Exit(code)


@dataclass(frozen=True, slots=True)
class _Routes:
    """What is done with a record: the paper's route, and the whole record's if it is asked for."""

    settings: WelchSettings
    whole_record: bool
    fixed: tuple[Setting, ...]


def _fixed(text: str) -> tuple[Setting, ...]:
    from analysis.whole_record import SETTINGS

    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in SETTINGS]
    if unknown:
        raise typer.BadParameter(
            f"there is no {', '.join(unknown)}; choose from {', '.join(SETTINGS)}.",
            param_hint="--fix",
        )
    return tuple(name for name in SETTINGS if name in names)


def _run(
    files: Sequence[Path],
    routes: _Routes,
    report: Path | None,
    json: Path | None,
    rerun: Path | None,
) -> int:
    """Analyse the files one after the other and return the exit code."""
    from rich.console import Console

    from analysis.report.document import document, document_text
    from analysis.report.folder import report_folders, write_new
    from analysis.report.record_text import record_text
    from analysis.report.tables import analysis_tables, summary_table

    folders = report_folders(files, report)
    found, errors, code = _analyse_all(files, folders, routes, rerun)
    if not found:
        return code
    analyses = [analysis for analysis, _ in found]
    subjects = [subject for _, subject in found if subject is not None]
    to_stdout = json is not None and str(json) == "-"
    console = Console(stderr=to_stdout, highlight=False)
    if not console.is_terminal:
        console = Console(stderr=to_stdout, highlight=False, width=120)
    if len(files) == 1:
        for subject in subjects:
            console.print(record_text(subject))
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
        text = document_text(document(analyses, errors, subjects))
        if to_stdout:
            typer.echo(text, nl=False)
        else:
            write_new(json, text)
            _say(console, f"All results as JSON: {json}")
    return code


def _analyse_all(
    files: Sequence[Path], folders: Sequence[Path], routes: _Routes, rerun: Path | None
) -> tuple[list[_Found], dict[str, str], int]:
    """Analyse and report every file; return results, message by failed file, and exit code."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from analysis.estimate import EstimateError, SettingsError
    from analysis.record import RecordError
    from analysis.report.folder import OutputError
    from rigd.session import SessionError

    found: list[_Found] = []
    errors: dict[str, str] = {}
    code = 0
    terminal = _standard_error()
    tell = partial(terminal.print, markup=False, highlight=False, soft_wrap=True)
    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TimeRemainingColumn(),
        console=terminal,
        transient=True,
        disable=not terminal.is_terminal,
    ) as progress:
        steps = _steps(routes, rerun)
        task = progress.add_task("", total=len(files) * steps)
        for number, (file, folder) in enumerate(zip(files, folders, strict=True), start=1):

            def on_step(done: str, name: str = file.name) -> None:
                weight = _FIGURE_STEPS if done.startswith("figure") else 1
                progress.update(task, advance=weight, description=f"{name}: {done}")

            try:
                found.append(_analyse_file(file, folder, routes, rerun, on_step, tell))
            except (SessionError, RecordError, EstimateError, OutputError) as error:
                code = max(code, 2 if isinstance(error, SettingsError) else 1)
                errors[str(file)] = str(error)
                progress.update(task, completed=number * steps)
                tell(f"Error: {error}")
    return found, errors, code


def _steps(routes: _Routes, rerun: Path | None) -> int:
    from analysis.report.html.write import FIGURES as OF_RECORD
    from analysis.report.write import FIGURES, FIGURES_BESIDE_RECORD

    figures = (*FIGURES_BESIDE_RECORD, *OF_RECORD) if routes.whole_record else FIGURES
    pictures = len(figures) + (rerun is not None)
    return 2 + routes.whole_record + len(routes.settings.types) + _FIGURE_STEPS * pictures


def _analyse_file(
    file: Path,
    folder: Path,
    routes: _Routes,
    rerun: Path | None,
    on_step: Callable[[str], None],
    warn: Callable[[str], None],
) -> _Found:
    from analysis.record import load_record
    from analysis.report.folder import new_folder
    from analysis.report.write import write_report
    from analysis.welch_route import analyse
    from analysis.whole_record import MeasurementError

    record = load_record(file)
    on_step("read")
    analysis = analyse(record, routes.settings, on_step)
    subject = None
    if routes.whole_record:
        on_step("whole record")
        try:
            subject = _whole_record(record, routes, analysis)
        except MeasurementError as error:
            warn(f"Warning: {error} Only the paper's route was gone.")
    with new_folder(folder) as part:
        write_report(analysis, part, on_step, subject)
    if rerun is not None:
        from analysis.report.rerun_file import write_rerun_file

        write_rerun_file(analysis, rerun)
        on_step("figure for Rerun")
    return analysis, subject


def _whole_record(record: Record, routes: _Routes, welch: WelchAnalysis) -> Subject:
    from analysis.report.html import Subject
    from analysis.selection import select
    from analysis.whole_record import BAND_HZ, Measurement

    selection = select(Measurement.of_record(record), fixed=routes.fixed)
    return Subject.of(record, selection, BAND_HZ, routes.fixed, welch)


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
