"""``rigd run``: sessions in the foreground, one command an excitation."""

import inspect
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rigd.cli.crew import start_crew
from rigd.cli.exits import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_WRONG_USE, fail
from rigd.cli.options import SESSIONS, AsJson, Fast, Output, ProfileName, Seed

if TYPE_CHECKING:
    from rigd.excitation import Excitation
    from rigd.supervisor.session import SessionResult

run_app = typer.Typer(
    help="Run one or more sessions in the foreground; Ctrl-C stops safely.\n\n"
    "Example: rigd run chirp --profile sim --fast",
    no_args_is_help=True,
    rich_markup_mode=None,
)

Amplitude = Annotated[float, typer.Option("--amplitude", help="Amplitude, rad.")]
StartHz = Annotated[float, typer.Option("--start-hz", help="Frequency where the band starts, Hz.")]
StopHz = Annotated[float, typer.Option("--stop-hz", help="Frequency where the band ends, Hz.")]
Duration = Annotated[float, typer.Option("--duration", help="Duration of the excitation, s.")]
Rest = Annotated[float, typer.Option("--rest", help="Rest before it, s.")]
RingDown = Annotated[float, typer.Option("--ring-down", help="Holding after it, s.")]
Taper = Annotated[float, typer.Option("--taper", help="Fade in and out over this time, s.")]


Build = Callable[..., "Excitation"]
"""Makes an excitation from the rate (first) and its own options."""


def excitation_command(build: Build) -> Build:
    """Register ``rigd run NAME``: the excitation's own options, then those of every session."""
    own = list(inspect.signature(build).parameters.values())[1:]
    common = list(inspect.signature(run_sessions).parameters.values())[1:]

    def command(**options: Any) -> None:  # noqa: ANN401 - as typer hands them over
        shared = {parameter.name: options.pop(parameter.name) for parameter in common}
        run_sessions(lambda rate_hz: build(rate_hz, **options), **shared)

    command.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in (*own, *common)]
    )
    command.__annotations__ = {p.name: p.annotation for p in (*own, *common)}
    run_app.command(build.__name__, help=build.__doc__)(command)
    return build


def run_sessions(
    build: Callable[[float], "Excitation"],
    profile: ProfileName = "sim",
    output: Output = SESSIONS,
    repeat: Annotated[int, typer.Option("--repeat", min=1, help="Number of sessions.")] = 1,
    seed: Seed = None,
    operator: Annotated[str, typer.Option("--operator", help="Goes into the file.")] = "",
    specimen: Annotated[str, typer.Option("--specimen", help="Goes into the file.")] = "",
    note: Annotated[str, typer.Option("--note", help="Goes into the file.")] = "",
    fast: Fast = False,
    live: Annotated[bool, typer.Option("--live", help="Show the signals in Rerun.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Run even if the torque is predicted to saturate.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Run sessions one after the other and report how they ended."""
    notes = {"operator": operator, "specimen": specimen, "note": note}
    for option, text in notes.items():
        if not text.isprintable():
            fail(f"--{option} {text!r}: is not plain text of one line.", EXIT_WRONG_USE)
    stop, crew = start_crew(live=live)
    from rigd.engine.signals import ignore
    from rigd.foreground import ForegroundError, run_in_foreground

    try:
        results = run_in_foreground(
            build,
            crew,
            stop,
            profile_name=profile,
            folder=output,
            repeat=repeat,
            seed=seed,
            notes=notes,
            fast=fast,
            live=live,
            force=force,
            quiet_stdout=as_json,
        )
    except ForegroundError as error:
        if as_json and error.results:
            _write_json(error.results)
        fail(str(error), EXIT_WRONG_USE if error.wrong_use else EXIT_FAILED)
    finally:
        ignore()  # nothing is left to stop, and an impatient Ctrl-C must not change the exit code
    if as_json:
        _write_json(results)
    if stop.requested:
        raise typer.Exit(EXIT_INTERRUPTED)
    if not all(result.went_well for result in results):
        raise typer.Exit(EXIT_FAILED)


@excitation_command
def chirp(
    rate_hz: float,
    amplitude: Amplitude = 0.025,
    start_hz: StartHz = 0.05,
    stop_hz: StopHz = 50.0,
    duration: Duration = 120.0,
    rest: Rest = 1.0,
    ring_down: RingDown = 15.0,
    taper: Taper = 0.0,
) -> "Excitation":
    """Sweep linearly through a band, by default as in the paper.

    Example: rigd run chirp --profile sim --fast --output sessions
    """
    from rigd import excitation

    return excitation.chirp(
        rate_hz=rate_hz,
        amplitude_rad=amplitude,
        start_hz=start_hz,
        stop_hz=stop_hz,
        duration_s=duration,
        rest_s=rest,
        ring_down_s=ring_down,
        taper_s=taper,
    )


@excitation_command
def hold(
    rate_hz: float, duration: Duration = 10.0, rest: Rest = 1.0, ring_down: RingDown = 0.0
) -> "Excitation":
    """Hold the motor where it stands, for noise and drift.

    Example: rigd run hold --duration 30
    """
    from rigd import excitation

    return excitation.hold(rate_hz=rate_hz, duration_s=duration, rest_s=rest, ring_down_s=ring_down)


@excitation_command
def step(
    rate_hz: float,
    amplitude: Amplitude = 0.025,
    duration: Duration = 10.0,
    rest: Rest = 1.0,
    ring_down: RingDown = 15.0,
) -> "Excitation":
    """Step by an amplitude.

    Example: rigd run step --amplitude 0.01 --fast
    """
    from rigd import excitation

    return excitation.step(
        rate_hz=rate_hz,
        amplitude_rad=amplitude,
        duration_s=duration,
        rest_s=rest,
        ring_down_s=ring_down,
    )


@excitation_command
def multisine(
    rate_hz: float,
    amplitude: Amplitude = 0.025,
    start_hz: StartHz = 0.05,
    stop_hz: StopHz = 50.0,
    period: Annotated[float, typer.Option("--period", help="Period of the signal, s.")] = 20.0,
    duration: Duration = 120.0,
    rest: Rest = 1.0,
    ring_down: RingDown = 15.0,
    taper: Taper = 0.0,
    phase_seed: Annotated[
        int, typer.Option("--phase-seed", min=0, help="Of the random phases.")
    ] = 0,
) -> "Excitation":
    """Excite with equal sines of random phase; the amplitude is the peak of their sum.

    Example: rigd run multisine --amplitude 0.01 --period 20 --fast
    """
    from rigd import excitation

    return excitation.multisine(
        rate_hz=rate_hz,
        amplitude_rad=amplitude,
        start_hz=start_hz,
        stop_hz=stop_hz,
        period_s=period,
        duration_s=duration,
        rest_s=rest,
        ring_down_s=ring_down,
        taper_s=taper,
        seed=phase_seed,
    )


@excitation_command
def file(
    rate_hz: float,
    path: Annotated[
        Path,
        typer.Argument(
            metavar="CSV", readable=False, help="Columns time_s and angle_rad, or one of angles."
        ),
    ],
    rest: Rest = 1.0,
    ring_down: RingDown = 15.0,
) -> "Excitation":
    """Follow a reference from a CSV file.

    Example: rigd run file reference.csv --fast
    """
    from rigd import excitation

    return excitation.from_csv(path, rate_hz=rate_hz, rest_s=rest, ring_down_s=ring_down)


def _write_json(results: "list[SessionResult]") -> None:
    try:
        typer.echo(json.dumps({"sessions": [_as_json(result) for result in results]}))
    except OSError as error:
        fail(f"The JSON document cannot be written ({error.strerror}).", EXIT_FAILED)


def _as_json(result: "SessionResult") -> dict[str, object]:
    return {
        "path": None if result.path is None else str(result.path),
        "outcome": result.outcome,
        "reason": result.reason,
        "scheduled": result.scheduled,
        "recorded": result.recorded,
        "missed": result.missed,
        "late": result.late,
        "lost": result.lost,
    }
