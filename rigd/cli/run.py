"""Commands ``rigd run`` and ``rigd start``: sessions, with a subcommand for each excitation.

The options of each excitation are defined here once. ``rigd run`` runs the session in the
foreground, ``rigd start`` has the daemon run it.
"""

import inspect
import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer
from annotated_types import DocInfo, doc
from typer.core import TyperGroup

from rigd.cli.options import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    SESSIONS_FOLDER,
    Accept,
    AsJson,
    Fast,
    Force,
    Hardware,
    Meta,
    NoQuickLook,
    Note,
    Obstacles,
    Operator,
    Output,
    ProfileName,
    Repeat,
    Seed,
    Specimen,
    TipSlope,
    WatchFit,
    fail,
    session_notes,
)
from rigd.cli.start import SessionCommands, start_processes, start_sessions
from rigd.excitation import RestS, RingDownS
from rigd.extras import require_extra
from rigd.units import unit_of

if TYPE_CHECKING:
    from rigd.excitation import OptionValue
    from rigd.runner.session import SessionResult


class _AddedExcitations(TyperGroup):
    """Group of the subcommands of excitations, including excitations of installed packages.

    A package is imported only when its excitation is requested; the help lists names only.
    """

    # Typer's click is its own in some versions and the package of that name in others.
    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401
        """Return a subcommand by its name; excitations of installed packages are included."""
        command = super().get_command(ctx, cmd_name)
        return command or _added_command(self.name or "run", cmd_name)

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401
        """Write the list of commands into the help text, including those of installed packages."""
        from rigd.plugins import installed_plugins

        super().format_commands(ctx, formatter)
        added_plugins = installed_plugins("rigd.excitations")
        if added_plugins:
            with formatter.section("Excitations of installed packages (rigd plugins)"):
                formatter.write_dl([(plugin.name, plugin.label) for plugin in added_plugins])


class _RunCommands(_AddedExcitations, SessionCommands):
    """Group of the subcommands of ``rigd run``."""


run_app = typer.Typer(
    name="run",
    cls=_RunCommands,
    help="Run one or more sessions in the foreground; Ctrl-C stops safely.\n\n"
    "Example: rigd run chirp --profile sim --fast",
    no_args_is_help=True,
    rich_markup_mode=None,
)
start_app = typer.Typer(
    name="start",
    cls=_AddedExcitations,
    help="Run one or more sessions on the daemon; Ctrl-C stops safely.\n\n"
    "Example: rigd start chirp --repeat 20",
    no_args_is_help=True,
    rich_markup_mode=None,
)

Amplitude = Annotated[float, typer.Option("--amplitude", help="Amplitude (rad).")]
StartHz = Annotated[float, typer.Option("--start-hz", help="Frequency where the band starts (Hz).")]
StopHz = Annotated[float, typer.Option("--stop-hz", help="Frequency where the band ends (Hz).")]
Duration = Annotated[float, typer.Option("--duration", help="Duration of the excitation (s).")]
Taper = Annotated[float, typer.Option("--taper", help="Fade-in and fade-out time (s).")]

Model = Annotated[
    Path | None,
    typer.Option(
        "--model",
        metavar="JSON",
        readable=False,
        help="Beam identified by analyze --json (default: the profile's).",
    ),
]


ParametersFunction = Callable[..., "Mapping[str, OptionValue | None]"]
"""Type of a function that turns the options of an excitation into its parameters.

A parameter has the name of its option if possible."""


def excitation_command(parameters_function: ParametersFunction) -> ParametersFunction:
    """Register the subcommands ``rigd run NAME`` and ``rigd start NAME`` of an excitation.

    Both have the excitation's own options and the options that all sessions have.
    """
    _add_subcommand(run_app, run_sessions, parameters_function)
    _add_subcommand(start_app, start_sessions, parameters_function)
    return parameters_function


def _add_subcommand(
    app: typer.Typer, run_or_start: Callable[..., None], parameters_function: ParametersFunction
) -> None:
    """Add the subcommand of an excitation to `app`; `run_or_start` runs the sessions."""
    excitation_kind = parameters_function.__name__
    excitation_parameters = list(
        map(_command_option, inspect.signature(parameters_function).parameters.values())
    )
    common_parameters = list(inspect.signature(run_or_start).parameters.values())[2:]

    def command(**options: Any) -> None:  # noqa: ANN401 - as typer hands them over
        common_options = {
            command_parameter.name: options.pop(command_parameter.name)
            for command_parameter in common_parameters
        }
        given_parameters = {
            parameter_name: parameter_value
            for parameter_name, parameter_value in parameters_function(**options).items()
            if parameter_value is not None
        }
        run_or_start(excitation_kind, given_parameters, **common_options)

    command.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [
            p.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for p in (*excitation_parameters, *common_parameters)
        ]
    )
    command.__annotations__ = {
        p.name: p.annotation for p in (*excitation_parameters, *common_parameters)
    }
    help_text = (parameters_function.__doc__ or "").replace("rigd run", f"rigd {app.info.name}")
    # Otherwise the angle -0.3 would be read as an option.
    command_settings = (
        {"ignore_unknown_options": True} if excitation_kind in ("move", "touch") else None
    )
    app.command(excitation_kind, help=help_text, context_settings=command_settings)(command)


def _added_command(app_name: str, excitation_name: str) -> Any:  # noqa: ANN401 - typer's click varies
    """Return the subcommand of an installed package's excitation; None if there is none."""
    from rigd.excitation import excitation_options, find_excitation

    added_excitation = find_excitation(excitation_name)
    if added_excitation is None:
        return None
    kind, owner = added_excitation

    def parameters(**options: "OptionValue") -> "dict[str, OptionValue]":
        return options

    parameters.__name__ = excitation_name
    parameters.__doc__ = f"{kind.summary} (package {owner.label})."
    parameters.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [
            inspect.Parameter(
                option.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=option.default,
                annotation=Annotated[option.value_type, doc(option.help)],
            )
            for option in excitation_options(excitation_name)
        ]
    )
    app = typer.Typer(name=app_name, rich_markup_mode=None)
    _add_subcommand(app, run_sessions if app_name == "run" else start_sessions, parameters)
    return typer.main.get_command(app)


def _command_option(parameter: inspect.Parameter) -> inspect.Parameter:
    """Return a function's parameter that declares its help text (`doc`) as a command-line option.

    The suffix ``_s`` or ``_rad`` is dropped from the flag; the help text ends with the unit. A
    parameter without such a help text is returned unchanged.
    """
    value_type, *extras = get_args(parameter.annotation) or (None,)
    declared_help = next((each for each in extras if isinstance(each, DocInfo)), None)
    if declared_help is None:
        return parameter
    name, unit = parameter.name, unit_of(parameter.name)
    option_flag = "--" + name.removesuffix("_s").removesuffix("_rad").replace("_", "-")
    help_text = (declared_help.documentation or name).removesuffix(".") + (
        f" ({unit})." if unit else "."
    )
    return parameter.replace(
        annotation=Annotated[value_type, typer.Option(option_flag, help=help_text)]
    )


def run_sessions(
    excitation_kind: str,
    parameters: "Mapping[str, OptionValue]",
    profile: ProfileName = "sim",
    output: Output = SESSIONS_FOLDER,
    repeat: Repeat = 1,
    seed: Seed = None,
    operator: Operator = "",
    specimen: Specimen = "",
    note: Note = "",
    meta: Meta = None,
    fast: Fast = False,
    live: Annotated[bool, typer.Option("--live", help="Show the signals in Rerun.")] = False,
    force: Force = False,
    accept: Accept = None,
    tip_slope_rad: TipSlope = None,
    hardware: Hardware = False,
    obstacle: Obstacles = None,
    no_quick_look: NoQuickLook = False,
    watch_fit: WatchFit = False,
    as_json: AsJson = False,
) -> None:
    """Run sessions of an excitation one after the other, and report how they ended."""
    if live:
        require_extra("live", "--live")
    session_metadata = session_notes(operator, specimen, note, meta)
    with_online_fit = watch_fit or excitation_kind == "until"
    stop_request, process_group = start_processes(
        with_live_view=live, with_touch=excitation_kind == "touch", with_online_fit=with_online_fit
    )
    from rigd.runner import SeriesFailedError, run_in_foreground
    from rigd.runner.planning import excitation_for
    from rigd.runtime import ignore_end_signals

    try:
        session_results = run_in_foreground(
            partial(
                excitation_for, excitation_kind=excitation_kind, excitation_parameters=parameters
            ),
            process_group,
            stop_request,
            profile_name=profile,
            folder=output,
            session_count=repeat,
            seed=seed,
            notes=session_metadata,
            uses_virtual_clock=fast,
            with_live_view=live,
            allows_saturation=force,
            accepted_row_names=accept or (),
            tip_slope_rad=tip_slope_rad,
            quiet_stdout=as_json,
            force_hardware=hardware,
            with_quick_looks=not no_quick_look,
            obstacles=obstacle or (),
            starts_at_present_angle=excitation_kind in ("move", "touch"),
            watch_fit=watch_fit,
        )
    except SeriesFailedError as error:
        if as_json:
            _write_json(error.results)
        raise
    finally:
        ignore_end_signals()  # nothing is left to stop; another Ctrl-C must not change the code
    if as_json:
        _write_json(session_results)
    if any(session_result.fault for session_result in session_results):
        raise typer.Exit(EXIT_FAILED)
    if stop_request.requested:
        raise typer.Exit(EXIT_INTERRUPTED)
    if not all(session_result.is_successful for session_result in session_results):
        raise typer.Exit(EXIT_FAILED)


@excitation_command
def chirp(
    amplitude_rad: Amplitude = 0.025,
    start_hz: StartHz = 0.05,
    stop_hz: StopHz = 50.0,
    duration_s: Duration = 120.0,
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 15.0,
    taper_s: Taper = 0.0,
    there_and_back: Annotated[
        bool,
        typer.Option(
            "--there-and-back",
            help="Also sweep back, in the same time: separates a change in time from "
            "one over frequency.",
        ),
    ] = False,
) -> "dict[str, OptionValue]":
    """Sweep linearly through a band, by default as in the paper.

    Example: rigd run chirp --stop-hz 20 --repeat 5
    """
    return locals() | {"there_and_back": int(there_and_back)}


@excitation_command
def hold(
    duration_s: Duration = 10.0, rest_s: RestS = 1.0, ring_down_s: RingDownS = 0.0
) -> "dict[str, OptionValue]":
    """Hold the motor at its start angle, to measure noise and drift.

    Example: rigd run hold --duration 30
    """
    return locals()


@excitation_command
def step(
    amplitude_rad: Amplitude = 0.025,
    duration_s: Duration = 10.0,
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 15.0,
) -> "dict[str, OptionValue]":
    """Apply a step to the reference.

    Example: rigd run step --amplitude 0.01
    """
    return locals()


@excitation_command
def multisine(
    amplitude_rad: Amplitude = 0.025,
    start_hz: StartHz = 0.05,
    stop_hz: StopHz = 50.0,
    period_s: Annotated[float, typer.Option("--period", help="Period of the signal (s).")] = 20.0,
    duration_s: Duration = 120.0,
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 15.0,
    taper_s: Taper = 0.0,
    phase_seed: Annotated[
        int, typer.Option("--phase-seed", min=0, help="Seed of the random phases.")
    ] = 0,
) -> "dict[str, OptionValue]":
    """Excite with a multisine of equal amplitudes and random phases.

    The amplitude is the peak of their sum.

    Example: rigd run multisine --amplitude 0.01 --period 20
    """
    excitation_options = locals()
    excitation_options["seed"] = excitation_options.pop("phase_seed")
    return excitation_options


@excitation_command
def file(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            readable=False,
            help="Text with columns time_s and angle_rad, or a column of angles (rad).",
        ),
    ],
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 15.0,
) -> "dict[str, OptionValue]":
    """Follow a reference from a text file.

    Columns are separated by commas, semicolons, tabs or blanks, with decimal points or, except
    between commas, decimal commas. A line that does not fit the table is refused with its number.

    Example: rigd run file reference.csv
    """
    return locals()


@excitation_command
def modes(
    path: Annotated[
        Path,
        typer.Argument(metavar="JSON", readable=False, help="Modes written by analyze --json."),
    ],
    amplitude_rad: Annotated[
        float,
        typer.Option(
            "--amplitude", help="Amplitude in each band, lower where limits require (rad)."
        ),
    ] = 0.025,
    stop_hz: Annotated[
        float, typer.Option("--stop-hz", help="Highest mode that is excited (Hz).")
    ] = 50.0,
    widths: Annotated[
        float, typer.Option("--widths", help="Band half-width, in half-power widths of its mode.")
    ] = 1.0,
    duration_s: Duration = 120.0,
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 15.0,
    taper_s: Annotated[
        float, typer.Option("--taper", help="Fade-in and fade-out time of each sweep (s).")
    ] = 1.0,
) -> "dict[str, OptionValue]":
    """Sweep narrow bands around the modes of an analysis.

    The damping parameters are more precise than from a broad sweep of the same length and tip
    slope.

    Example: rigd run modes fits.json --repeat 5
    """
    return locals()


@excitation_command
def touch(
    angle_rad: Annotated[
        float, typer.Argument(metavar="ANGLE", help="Farthest angle from the rig's zero (rad).")
    ],
    speed_rad_s: Annotated[
        float, typer.Option("--speed", help="Speed on the way out (rad/s).")
    ] = 1.0,
    acceleration_rad_s2: Annotated[
        float,
        typer.Option("--acceleration", help="Largest acceleration (rad/s²)."),
    ] = 20.0,
    passes: Annotated[int, typer.Option("--passes", min=1, help="Number of passes.")] = 1,
    hold_s: Annotated[
        float, typer.Option("--hold", help="Time from a touch until the motor returns (s).")
    ] = 0.5,
    settle_s: Annotated[float, typer.Option("--settle", help="Rest before each pass (s).")] = 1.0,
    force_limit_n: Annotated[
        float, typer.Option("--force-limit", help="Largest contact force; more is a fault (N).")
    ] = 10.0,
    path: Model = None,
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 1.0,
) -> "dict[str, OptionValue]":
    """Slew until the beam meets something; brake, hold and withdraw.

    The touch is detected by the torque and base shear that the moving beam itself does not explain.

    Example: rigd run touch 0.8 --speed 0.5 --passes 3
    """
    return locals()


@excitation_command
def move(
    angle_rad: Annotated[
        float | None, typer.Argument(metavar="ANGLE", help="Angle from the rig's zero (rad).")
    ] = None,
    by_rad: Annotated[
        float | None, typer.Option("--by", help="Angle from the present motor angle (rad).")
    ] = None,
    robust: Annotated[
        bool,
        typer.Option("--robust", help="Tolerate a frequency error of 1 %; takes longer."),
    ] = False,
    path: Model = None,
    rest_s: RestS = 1.0,
    ring_down_s: RingDownS = 5.0,
) -> "dict[str, OptionValue]":
    """Move to an angle without leaving a vibration, and stay there.

    Example: rigd run move 0.5
    """
    return locals() | {"robust": int(robust)}


@excitation_command
def until(
    damping: Annotated[
        list[str] | None,
        typer.Option(
            "--damping",
            metavar="STD",
            help="Requested standard deviation of the modes' damping ratios, such as 1% (of each "
            "mode in the band), 2:0.5% (of mode 2) or 1:2e-5.",
        ),
    ] = None,
    frequency: Annotated[
        list[str] | None,
        typer.Option(
            "--frequency",
            metavar="STD",
            help="Requested standard deviation of the modes' frequencies, such as 0.01% or 1:0.002 "
            "(Hz).",
        ),
    ] = None,
    zeta: Annotated[
        str | None,
        typer.Option(
            "--zeta", metavar="STD", help="Requested standard deviation of zeta, such as 20%."
        ),
    ] = None,
    alpha: Annotated[
        str | None,
        typer.Option(
            "--alpha", metavar="STD", help="Requested standard deviation of alpha, such as 0.03."
        ),
    ] = None,
    gamma: Annotated[
        str | None,
        typer.Option(
            "--gamma", metavar="STD", help="Requested standard deviation of gamma, such as 30%."
        ),
    ] = None,
    lambda_: Annotated[
        str | None,
        typer.Option(
            "--lambda", metavar="STD", help="Requested standard deviation of lambda, such as 0.1."
        ),
    ] = None,
    at_most_s: Annotated[float, typer.Option("--at-most", help="Longest record (s).")] = 120.0,
    amplitude_rad: Annotated[
        float,
        typer.Option(
            "--amplitude", help="Amplitude of the scan, lower where limits require (rad)."
        ),
    ] = 0.05,
    start_hz: Annotated[
        float, typer.Option("--start-hz", help="Frequency where the scan starts (Hz).")
    ] = 0.5,
    stop_hz: Annotated[
        float, typer.Option("--stop-hz", help="Frequency where the scan ends (Hz).")
    ] = 52.0,
    scan_s: Annotated[float, typer.Option("--scan", help="Duration of the scan (s).")] = 5.0,
    rest_s: RestS = 1.0,
    uniformity_percent: Annotated[
        float | None,
        typer.Option(
            "--uniformity",
            metavar="PERCENT",
            help="Deviation of each mode's frequency from that of a uniform beam (standard "
            "deviation, % of it); 0: exactly uniform (default: the profile's).",
        ),
    ] = None,
) -> "dict[str, OptionValue | None]":
    """Excite the modes until a precision is reached.

    A quick scan finds the modes. Each further segment is the most informative one by the record so
    far.

    Example: rigd run until --damping 1% --at-most 60
    """
    requested_precisions = [
        *(("damping", precision_text) for precision_text in damping or ()),
        *(("frequency", precision_text) for precision_text in frequency or ()),
        *(("zeta", zeta), ("alpha", alpha), ("gamma", gamma), ("lambda", lambda_)),
    ]
    return {
        "targets": "; ".join(
            f"{parameter_name} {precision_text}"
            for parameter_name, precision_text in requested_precisions
            if precision_text is not None
        ),
        "at_most_s": at_most_s,
        "amplitude_rad": amplitude_rad,
        "start_hz": start_hz,
        "stop_hz": stop_hz,
        "scan_s": scan_s,
        "rest_s": rest_s,
        "uniformity_percent": uniformity_percent,
    }


def _write_json(results: "list[SessionResult]") -> None:
    """Write the results of sessions as a JSON document to standard output."""
    from rigd.runner.session import results_document

    try:
        typer.echo(json.dumps(results_document(results)))
    except OSError as error:
        fail(f"The JSON document cannot be written ({error.strerror}).", EXIT_FAILED)
