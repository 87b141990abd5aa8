"""Command `analyze`: parsing of its options, and start of the analyses that they select."""

from __future__ import annotations

import gc
import logging
import math
import os
import signal
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer.core import TyperCommand, TyperGroup

import rigd
from analysis.cli.exchange import IMPORT_EPILOG, export_app, import_command
from analysis.cli.sessions import (
    NoSessionsError,
    OutputOptions,
    latest_session,
    session_command,
    session_files,
)
from analysis.cli.standard_streams import print_error, standard_streams
from analysis.cli.touch import TOUCH_EPILOG, touch_command
from analysis.cli.welch_options import (
    Band,
    Estimator,
    Nfft,
    Overlap,
    Segment,
    band_hz,
    parse_option_choice,
    welch_settings,
)
from analysis.results import FIGURE_FORMATS, AnalysisOptions
from rigd.printable import readable_errors
from rigd.runtime import raise_on_signals
from rigd.runtime.background import use_one_thread

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.campaigns import SingleSessionError
    from analysis.identify import Setting
    from analysis.results import FigureFormat
    from analysis.structures import AddedStructure

DEFAULT_COMMAND: Final = "default"
"""Name of the command that runs if the first argument is not the name of a command."""
_COMPLETION_OPTIONS: Final = (["--install-completion"], ["--show-completion"])
"""Options that Typer adds to the command group."""


class DefaultCommandGroup(TyperGroup):
    """Command group whose default command runs if the first argument names no command.

    Its usage, help and errors then read as if the program were a single command.
    """

    # Some versions of Typer contain their own click, others use the package click, so the type of
    # the context differs.
    def make_context(
        self,
        info_name: str | None,
        args: list[str],
        parent: Any = None,  # noqa: ANN401
        **extra: Any,  # noqa: ANN401
    ) -> Any:  # noqa: ANN401
        """Parse the arguments of the command named first, or of the default command."""
        with readable_errors():
            is_other_command = args and args[0] in self.commands and args[0] != DEFAULT_COMMAND
            if is_other_command or args[:1] in _COMPLETION_OPTIONS:
                return super().make_context(info_name, args, parent, **extra)
            return self.commands[DEFAULT_COMMAND].make_context(info_name, args, parent, **extra)

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401
        """Run the command whose arguments `make_context` has parsed."""
        with readable_errors():
            return super().invoke(ctx) if ctx.command is self else ctx.command.invoke(ctx)


class DefaultCommand(TyperCommand):
    """Default command, whose help also lists the other commands."""

    def format_options(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401
        """Write arguments and options, followed by the list of the other commands."""
        super().format_options(ctx, formatter)
        structures = _names_of_added_structures()
        if structures:
            with formatter.section("Structures of installed packages"):
                formatter.write_dl(structures)
        with formatter.section("Commands"):
            formatter.write_dl([*_OTHER_COMMAND_DESCRIPTIONS.items()])


def _names_of_added_structures() -> list[tuple[str, str]]:
    """Return name and package of each damping structure of packages, without importing them."""
    from rigd.plugins import installed_plugins

    return [
        (plugin.name, plugin.problem or f"of {plugin.label}")
        for plugin in installed_plugins("analysis.structures")
    ]


def _print_version(requested: bool) -> None:
    """Print the version and exit, if requested."""
    if requested:
        typer.echo(f"analyze {rigd.__version__}")
        raise typer.Exit


Version = Annotated[
    bool,
    typer.Option(
        "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
    ),
]
"""Option --version."""


_INTERRUPTED_EXIT_CODE: Final = 130
"""Exit code after Ctrl-C."""
_GARBAGE_COLLECTION_THRESHOLD: Final = 20_000
"""Number of new objects that triggers a garbage collection."""

_OTHER_COMMAND_DESCRIPTIONS: Final = {
    "touch": "Estimate where, when and how hard the antenna met something.",
    "import": "Convert a record of another program to a session file (.csv, .mat, .tdms, .uff).",
    "export record": "Write the samples of a session for another program (.csv, .mat, .uff).",
    "export frf": "Write the frequency response of a session (.csv, .mat, .uff).",
    "export model": "Write a linear model of the antenna (.json, .npz, .mat).",
}
"""Descriptions of the other commands in the help, by their names."""

_HELP_EPILOG = """\
Example: analyze session.mcap --types III,VI --json fits.json

Figures, tables and JSON go to session.report/ next to the file (session.report-2/ if that exists).
Several files are a campaign: statistics, nominal models, pooled estimate and validation go to
campaign.report/ next to the first. Sessions that do not suit Welch's method (steps, multisines,
narrow sweeps, short or stopped ones) get only the whole-record analysis, and a line that says why.

Exit code: 0 done; 1 a file could not be analysed; 2 usage error; 130 stopped by Ctrl-C."""
"""Text at the end of the help of the command."""


_METHOD_NAMES: Final = ("welch", "record", "all")
"""Values of --method: analyses of a record."""

_WELCH_OPTION_NAMES: Final = ("types", "weights", "frf", "segment", "overlap", "nfft")
"""Names of the options that only concern Welch fits."""

_COMMAND_LINE_SOURCE_NAME: Final = "COMMANDLINE"
"""Name that click gives to the source of a value stated on the command line."""

# Plain messages of one or two sentences, not boxes: they end up in logs.
app = typer.Typer(
    cls=DefaultCommandGroup,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
"""Application of the command `analyze` with its subcommands."""
app.command("import", epilog=IMPORT_EPILOG)(import_command)
app.command("touch", epilog=TOUCH_EPILOG)(touch_command)
app.add_typer(export_app, name="export")


def main() -> None:
    """Run the command `analyze` and end the process with its exit code."""
    raise_on_signals(signal.SIGINT)
    use_one_thread()
    # Figures consist of many objects that exist until they are drawn. A garbage collection after
    # every 700 new objects would take 5 % of the computing time.
    gc.set_threshold(_GARBAGE_COLLECTION_THRESHOLD)
    _suppress_library_warnings()
    with standard_streams():
        try:
            app()
        except KeyboardInterrupt:
            sys.exit(_INTERRUPTED_EXIT_CODE)


def _suppress_library_warnings() -> None:
    """Suppress warnings of libraries, which are meant for programmers.

    With a record that no model describes, searches reach parameters at which numbers overflow; the
    verdict reports the result. Python's switches (``-W``, PYTHONWARNINGS) enable the warnings.
    """
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
        os.environ["PYTHONWARNINGS"] = "ignore"  # for worker processes
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


@app.command(DEFAULT_COMMAND, epilog=_HELP_EPILOG, cls=DefaultCommand)
def analyze(
    context: typer.Context,
    files: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="FILE",
            readable=False,
            show_default=False,
            help="Session files (.mcap), or folders of them.",
        ),
    ] = None,
    latest: Annotated[
        bool,
        typer.Option(
            "--latest", help="Analyse the newest session of the folder FILE, or of sessions."
        ),
    ] = False,
    method: Annotated[
        str,
        typer.Option(
            metavar="welch|record|all",
            help="welch: Welch method (as in the paper); record: whole-record fits; all: both.",
        ),
    ] = "all",
    fix: Annotated[
        str,
        typer.Option(
            metavar="LIST",
            help="Hold at the file's values in whole-record fits: density_over_stiffness, "
            "bending_stiffness_n_m2, delay_s, tool_inertia_kg_m2.",
        ),
    ] = "",
    types: Annotated[
        str, typer.Option(metavar="LIST", help="Model types of the Welch fits, I to VII.")
    ] = "I,II,III,IV,V,VI",
    weights: Annotated[
        str,
        typer.Option(
            metavar="LIST",
            help="Weightings of the Welch fits: const, omega (1/omega), omega^K.",
        ),
    ] = "const,omega",
    structure: Annotated[
        str,
        typer.Option(
            metavar="LIST",
            help="Also fit these damping structures of installed packages to the whole record "
            "(rigd plugins lists them).",
        ),
    ] = "",
    from_s: Annotated[
        float | None,
        typer.Option(
            "--from",
            metavar="S",
            help="Analyse a part of the session that begins at this time since its start (s).  "
            "[default: its start]",
        ),
    ] = None,
    to_s: Annotated[
        float | None,
        typer.Option(
            "--to",
            metavar="S",
            help="Analyse a part of the session that ends at this time since its start (s).  "
            "[default: its end]",
        ),
    ] = None,
    block: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            help="Divide a session into blocks of this length (s), and compare them as the "
            "sessions of a campaign: shows what changes with time.  [default: 900 for more than "
            "4 million samples]",
        ),
    ] = None,
    band: Band = None,
    frf: Estimator = "h1",
    segment: Segment = None,
    overlap: Overlap = None,
    nfft: Nfft = None,
    uniformity: Annotated[
        float | None,
        typer.Option(
            metavar="PERCENT",
            help="Deviation of each mode's frequency from that of a uniform beam (standard "
            "deviation, % of it); 0: exactly uniform.  [default: the file's, or 0.1]",
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the report, new or empty; with --each, of one folder per file.",
        ),
    ] = None,
    figures: Annotated[
        str,
        typer.Option(
            metavar="LIST", help="File formats of the figures: png, svg, pdf, comma-separated."
        ),
    ] = "svg",
    json: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write all results as JSON; - for standard output."),
    ] = None,
    rerun: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.rrd",
            help="Write session and fits for Rerun's viewer; one session only.",
        ),
    ] = None,
    overwrite: Annotated[
        bool,
        typer.Option(
            "--overwrite",
            help="Replace an earlier report and its --json file; other files are kept.",
        ),
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Print all tables, not only the main results.")
    ] = False,
    each: Annotated[
        bool,
        typer.Option("--each", help="Report each of several files by itself, not as a campaign."),
    ] = False,
    paper: Annotated[
        bool,
        typer.Option("--paper", help="Campaign: show the paper's Tables 3 and 4 for comparison."),
    ] = False,
    jobs: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=1, help="Campaign: number of worker processes.  [default: cores]"
        ),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Campaign: run on this Dask scheduler."),
    ] = None,
    version: Version = False,  # noqa: ARG001 - its callback has printed it
) -> None:
    """Identify the damping of a slewing beam from recorded sessions.

    Estimates the frequency response from motor angle to coupling torque, fits the fractional
    damping models to it, and prints and draws the results.
    """
    from analysis.report.folder import OutputError, OutputExistsError, check_new_file

    if not files and not latest:
        context.fail("Missing argument 'FILE'. Name session files, or take --latest.")
    if latest and files and len(files) > 1:
        raise typer.BadParameter(
            f"it takes one folder, and {len(files)} were given.", param_hint="--latest"
        )
    try:
        files = [latest_session(*files or ())] if latest else session_files(files or ())
    except NoSessionsError as error:
        print_error(str(error))
        raise typer.Exit(1) from None
    if block is None and from_s is None and to_s is None and len(files) == 1 and not each:
        block = _block_length_of_long_session(files[0])
    elif block is not None:
        _check_block_option(
            block, files, has_part=from_s is not None or to_s is not None, is_each=each
        )
    is_campaign = (len(files) > 1 and not each) or block is not None
    if not is_campaign:
        campaign_options = {
            "--paper": paper,
            "--jobs": jobs is not None,
            "--dask": dask is not None,
        }
        _check_campaign_options(
            [option_name for option_name, is_given in campaign_options.items() if is_given], files
        )
    elif jobs is not None and dask is not None:
        raise typer.BadParameter(
            "the workers are those of --dask; leave one of the two out.", param_hint="--jobs"
        )
    method = parse_option_choice(method, _METHOD_NAMES, "--method")
    if fix and method == "welch":
        raise typer.BadParameter(
            "the Welch fits use the file's values for all of them; leave it out, or take --method "
            "all.",
            param_hint="--fix",
        )
    if uniformity is not None and method == "welch":
        raise typer.BadParameter(
            "the Welch fits, as in the paper, assume an exactly uniform beam; leave it out, or "
            "take --method all.",
            param_hint="--uniformity",
        )
    if method == "record":
        _check_record_method_options(context, is_campaign=is_campaign)
    if structure and (method == "welch" or is_campaign):
        raise typer.BadParameter(
            "it is for whole-record fits of single sessions; "
            f"{'add --each' if is_campaign else 'take --method all'}, or leave it out.",
            param_hint="--structure",
        )
    _check_part_options(from_s, to_s, is_campaign=is_campaign)
    settings = welch_settings(types, weights, frf, segment, overlap, nfft)
    options = AnalysisOptions(
        settings,
        with_welch_fits=method != "record",
        whole_record=method != "welch",
        fixed_parameters=_fixed_parameters(fix),
        band_hz=band_hz(band),
        figures=_figure_formats(figures),
        uniformity=None if uniformity is None else _relative_uniformity(uniformity),
        structures=_added_structures(structure),
        part_s=None if from_s is None and to_s is None else (from_s, to_s),
    )
    output_options = OutputOptions(report, json, overwrite, verbose)
    try:
        if json is not None and not output_options.json_to_stdout:
            check_new_file(json, "--json", overwrite=overwrite)
        if rerun is not None:
            _check_rerun_option(rerun, files)
        if not is_campaign:
            exit_code = session_command(files, options, output_options, rerun)
        else:
            from analysis.campaigns import CampaignError, SingleSessionError
            from analysis.cli.campaign import campaign_command
            from analysis.models import STRUCTURES
            from analysis.record_checks import RecordError
            from rigd.session import SessionError

            typer.echo(
                f"{len(files)} sessions are analysed together, as a campaign; --each reports each "
                "by itself."
                if block is None
                else f"The session is analysed in blocks of {block:g} s, as a campaign.",
                err=True,
            )
            try:
                exit_code = campaign_command(
                    files, settings, output_options,
                    structures=tuple(STRUCTURES) if options.whole_record else (),
                    fixed=options.fixed_parameters, band_hz=options.band_hz, jobs=jobs, dask=dask,
                    uniformity=options.uniformity, with_paper=paper, formats=options.figures,
                    block_s=block,
                )  # fmt: skip
            except SingleSessionError as single:
                if block is not None:
                    print_error(
                        "\n".join(failure.message for failure in single.failures)
                        + f"\n{single.path}: only one block of {block:g} s can be used, and a "
                        "comparison needs two: choose another --block, or leave it out."
                    )
                    raise typer.Exit(1) from None
                exit_code = _report_single_session(single, options, output_options)
            except (CampaignError, SessionError, RecordError) as error:
                print_error(str(error))
                exit_code = 1
    except OutputExistsError as error:
        print_error(str(error))
        exit_code = 2
    except OutputError as error:
        print_error(str(error))
        exit_code = 1
    except KeyboardInterrupt:
        typer.echo("Stopped.", err=True)
        exit_code = _INTERRUPTED_EXIT_CODE
    raise typer.Exit(exit_code)


def _block_length_of_long_session(session_file: Path) -> float | None:
    """Return the length in s of the blocks of a session that is too long for one fit, or None."""
    from analysis.record import may_be_longer
    from rigd.session.limits import MAX_SAMPLES

    if not may_be_longer(session_file, MAX_SAMPLES):
        return None
    from analysis.record_checks import RecordError
    from analysis.record_part import BLOCK_S, blocks_of_session
    from rigd.session import SessionError, read_summary

    try:
        if (read_summary(session_file).samples or 0) <= MAX_SAMPLES:
            return None
        blocks_of_session(session_file)
    except (SessionError, RecordError):  # stated where the session is read
        return None
    return BLOCK_S


def _check_block_option(
    block_s: float, files: Sequence[Path], *, has_part: bool, is_each: bool
) -> None:
    """Raise a usage error if --block has no usable length, or is not for one whole session."""
    usage_reason = None
    if not 0.0 < block_s < math.inf:
        usage_reason = f"{block_s:g} s must be more than 0."
    elif len(files) > 1:
        usage_reason = f"it takes one session, and {len(files)} files were given."
    elif has_part:
        usage_reason = "it divides the whole session; leave --from and --to out."
    elif is_each:
        usage_reason = "the blocks are compared, not reported by themselves; leave --each out."
    if usage_reason is not None:
        raise typer.BadParameter(usage_reason, param_hint="--block")


def _check_campaign_options(option_names: Sequence[str], files: Sequence[Path]) -> None:
    """Raise a usage error if options are given that only concern campaigns."""
    if not option_names:
        return
    if len(files) == 1:
        usage_reason = "only for campaigns (two or more sessions); omit it."
    else:
        usage_reason = "only for campaigns, so not with --each; omit one of the two."
    raise typer.BadParameter(usage_reason, param_hint=" and ".join(option_names))


def _check_part_options(from_s: float | None, to_s: float | None, *, is_campaign: bool) -> None:
    """Raise a usage error if --from and --to select no part, or if they are given to a campaign."""
    option_values = {"--from": from_s, "--to": to_s}
    given_values = {name: value for name, value in option_values.items() if value is not None}
    if not given_values:
        return
    if is_campaign:
        raise typer.BadParameter(
            "a campaign compares whole sessions; add --each, or leave it out.",
            param_hint=" and ".join(given_values),
        )
    for option_name, time_s in given_values.items():
        if not 0.0 <= time_s < math.inf:
            raise typer.BadParameter(
                f"{time_s:g} s must be a time since the session's start, 0 or more.",
                param_hint=option_name,
            )
    if from_s is not None and to_s is not None and not from_s < to_s:
        raise typer.BadParameter(
            f"{from_s:g} s must be less than --to {to_s:g} s.", param_hint="--from"
        )


def _check_record_method_options(context: typer.Context, *, is_campaign: bool) -> None:
    """Check the other options if --method selects only the whole-record fits.

    Raise a usage error for a campaign, which needs Welch fits. Otherwise print a warning if options
    of the Welch fits are given, which then have no effect.
    """
    if is_campaign:
        raise typer.BadParameter(
            "a campaign has the paper's Tables 3 to 5, so record alone is for single files; take "
            "--method all, or add --each.",
            param_hint="--method",
        )
    option_sources = {
        option_name: context.get_parameter_source(option_name)
        for option_name in _WELCH_OPTION_NAMES
    }
    ineffective_options = [
        f"--{option_name}"
        for option_name, option_source in option_sources.items()
        if option_source and option_source.name == _COMMAND_LINE_SOURCE_NAME
    ]
    if ineffective_options:
        typer.echo(
            f"Warning: {', '.join(ineffective_options)} "
            f"{'concerns' if len(ineffective_options) == 1 else 'concern'} the Welch fits alone, "
            "which --method record leaves out: every type is fitted to the whole record.",
            err=True,
        )


def _report_single_session(
    single_session_error: SingleSessionError, options: AnalysisOptions, outputs: OutputOptions
) -> int:
    """Print the errors of a campaign's unusable files, and report its only usable session."""
    for failure in single_session_error.failures:
        print_error(failure.message)
    typer.echo(
        f"A campaign needs two sessions: {single_session_error.path} is reported alone.", err=True
    )
    messages_by_file = {
        str(failure.path): failure.message for failure in single_session_error.failures
    }
    return max(
        1,
        session_command(
            [single_session_error.path], options, outputs, other_errors=messages_by_file
        ),
    )


def _fixed_parameters(option_text: str) -> tuple[Setting, ...]:
    """Return the parameters named in --fix; raise a usage error if one is unknown."""
    from analysis.identify import SETTINGS

    parameter_names = [
        parameter_name.strip()
        for parameter_name in option_text.split(",")
        if parameter_name.strip()
    ]
    unknown_names = [
        parameter_name for parameter_name in parameter_names if parameter_name not in SETTINGS
    ]
    if unknown_names:
        raise typer.BadParameter(
            f"there is no {', '.join(unknown_names)}; choose from {', '.join(SETTINGS)}.",
            param_hint="--fix",
        )
    return tuple(parameter_name for parameter_name in SETTINGS if parameter_name in parameter_names)


def _added_structures(option_text: str) -> tuple[AddedStructure, ...]:
    """Return the structures named in --structure; raise a usage error if one cannot be used."""
    names = [name.strip() for name in option_text.split(",") if name.strip()]
    if not names:
        return ()
    from analysis.structures import added_structures
    from rigd.plugins import PluginError

    try:
        return added_structures(list(dict.fromkeys(names)))
    except (LookupError, PluginError) as error:
        raise typer.BadParameter(str(error), param_hint="--structure") from error


def _relative_uniformity(uniformity_percent: float) -> float:
    """Return the uniformity of the beam as a fraction; raise a usage error if not in its range."""
    from analysis.record_checks import MAX_UNIFORMITY_PERCENT

    if not 0.0 <= uniformity_percent <= MAX_UNIFORMITY_PERCENT:
        raise typer.BadParameter(
            f"{uniformity_percent:g} % must lie between 0 and {MAX_UNIFORMITY_PERCENT:g} %.",
            param_hint="--uniformity",
        )
    return uniformity_percent / 100


def _figure_formats(option_text: str) -> tuple[FigureFormat, ...]:
    """Return the figure formats named in --figures; raise a usage error if one is unknown."""
    format_names = {
        format_name.strip().lower() for format_name in option_text.split(",") if format_name.strip()
    }
    unknown_formats = sorted(format_names.difference(FIGURE_FORMATS))
    if unknown_formats or not format_names:
        raise typer.BadParameter(
            f"there is no {', '.join(unknown_formats) or 'format'}; choose from "
            f"{', '.join(FIGURE_FORMATS)}.",
            param_hint="--figures",
        )
    return tuple(figure_format for figure_format in FIGURE_FORMATS if figure_format in format_names)


def _check_rerun_option(rerun_file: Path, files: Sequence[Path]) -> None:
    """Raise a usage error if --rerun is given with several sessions.

    Raise the error of `check_new_file` if the file of --rerun already exists.
    """
    from analysis.report import check_rerun_file
    from rigd.extras import MissingExtraError, require_extra

    if len(files) > 1:
        raise typer.BadParameter(
            f"it takes one session, and {len(files)} files were given.", param_hint="--rerun"
        )
    try:
        require_extra("live", "--rerun")
    except MissingExtraError as error:
        print_error(str(error))
        raise typer.Exit(1) from None
    check_rerun_file(rerun_file)
