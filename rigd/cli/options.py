"""Options that several commands have in common, error messages and progress lines."""

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from rigd.cli import entry
from rigd.errors import RigdError
from rigd.extras import explain_missing_module
from rigd.printable import progress_bar, readable_message

if TYPE_CHECKING:
    from rigd.profile import Profile

EXIT_FAILED = entry.EXIT_FAILED
EXIT_WRONG_USE = entry.EXIT_WRONG_USE
EXIT_INTERRUPTED = entry.EXIT_INTERRUPTED


def fail(message: str, exit_code: int) -> NoReturn:
    """Write an error message to standard error, and end the command with an exit code."""
    print_error(message)
    raise typer.Exit(exit_code)


def print_error(message: str) -> None:
    """Write an error message to standard error."""
    typer.echo(f"Error: {readable_message(message)}", err=True)


@contextlib.contextmanager
def exit_on_errors() -> Iterator[None]:
    """Turn an error of rigd in this context into a message and exit code 1, or 2 for wrong use."""
    try:
        yield
    except ModuleNotFoundError as error:
        explanation = explain_missing_module(error)
        if explanation is None:
            raise
        fail(str(explanation), EXIT_FAILED)
    except RigdError as error:
        fail(error.full_message(), EXIT_WRONG_USE if error.wrong_use else EXIT_FAILED)


# Progress

_PROGRESS_DELAY_S = 2.0
"""Seconds of work before a progress line appears."""


@contextlib.contextmanager
def task_progress(task_name: str) -> Iterator[Callable[[float], None]]:
    """Show a progress line; yield a function that must be called with the completed fraction.

    The line appears after `_PROGRESS_DELAY_S`, on a terminal only.
    """
    start_s = time.monotonic()
    with contextlib.ExitStack() as exit_stack:
        show_fraction: Callable[[float], None] | None = None

        def on_progress(completed_fraction: float) -> None:
            nonlocal show_fraction
            if show_fraction is None and time.monotonic() - start_s > _PROGRESS_DELAY_S:
                show_fraction = exit_stack.enter_context(_progress_line(task_name))
            if show_fraction is not None:
                show_fraction(completed_fraction)

        yield on_progress


@contextlib.contextmanager
def _progress_line(task_name: str) -> Iterator[Callable[[float], None]]:
    """Show a progress line at once; yield a function that receives the completed fraction."""
    with progress_bar() as bar:
        task_id = bar.add_task(task_name, total=1.0)
        yield lambda fraction: bar.update(task_id, completed=fraction)


# Options

ProfileName = Annotated[
    str, typer.Option("--profile", help="Name of a hardware profile, or its file.")
]
EdsFile = Annotated[
    Path, typer.Option("--eds", metavar="FILE", help="EDS or DCF file of a CANopen drive.")
]
Output = Annotated[Path, typer.Option("--output", help="Folder for the session files.")]
SESSIONS_FOLDER = Path("sessions")
"""Default folder of session files."""
Seed = Annotated[
    int | None,
    typer.Option(
        "--seed",
        min=0,
        help="Seed of a simulated rig's noise, to repeat it (default: a fresh one each session).",
    ),
]
Fast = Annotated[
    bool, typer.Option("--fast", help="Do not wait for real time (simulated rigs only).")
]
AsJson = Annotated[bool, typer.Option("--json", help="Write one JSON document to standard output.")]

Hardware = Annotated[
    bool,
    typer.Option("--hardware", help="Move the hardware, even if another user simulates the rig."),
]

Obstacles = Annotated[
    list[str] | None,
    typer.Option(
        "--obstacle",
        metavar="SPEC",
        help="Put an obstacle in the way of a simulated beam, such as "
        "x=0.62,angle=0.6,stiffness=3000 (m, rad, N/m), or a knock, such as "
        "x=0.5,force=2,duration=0.02,at=3 (m, N, s); repeat for each.",
    ),
]

Repeat = Annotated[int, typer.Option("--repeat", min=1, help="Number of sessions.")]
Operator = Annotated[str, typer.Option("--operator", help="Operator name, stored in the file.")]
Specimen = Annotated[str, typer.Option("--specimen", help="Specimen, stored in the file.")]
Note = Annotated[str, typer.Option("--note", help="Note, stored in the file.")]
Meta = Annotated[
    list[str] | None,
    typer.Option(
        "--meta",
        metavar="NAME=VALUE",
        help="Metadata, stored in the file, such as temperature_c=21.4; repeat for each.",
    ),
]
Force = Annotated[
    bool, typer.Option("--force", help="Run even if the torque is predicted to saturate.")
]

Accept = Annotated[
    list[str] | None,
    typer.Option(
        "--accept",
        metavar="ROW",
        help="Run although this row of rigd check fails, for this start only; recorded in the "
        "file; repeat for each row.",
    ),
]

TipSlope = Annotated[
    float | None,
    typer.Option(
        "--tip-slope",
        help="Largest predicted slope of the antenna's tip (rad; default: limits.tip_slope_rad of "
        "the profile). Beyond 0.14 the linear model is not exact.",
    ),
]

NoQuickLook = Annotated[
    bool,
    typer.Option(
        "--no-look", envvar="RIGD_NO_LOOK", help="Skip the quick look after each session."
    ),
]

WatchFit = Annotated[
    bool, typer.Option("--watch-fit", help="Fit the record during the session and show the fits.")
]


def session_notes(
    operator: str, specimen: str, note: str, meta: list[str] | None
) -> dict[str, str]:
    """Return the metadata that the options state: key in the session file → text.

    Invalid metadata end the command.
    """
    from rigd.session.user_metadata import metadata_keys

    notes = {"operator": operator, "specimen": specimen, "note": note}
    for option_name, meta_text in notes.items():
        if not meta_text.isprintable():
            fail(
                f"--{option_name} {meta_text!r}: must be a single line of plain text.",
                EXIT_WRONG_USE,
            )
    metadata: dict[str, str] = {}
    for option_value in meta or []:
        note_name, equals_sign, note_value = option_value.partition("=")
        if not equals_sign or note_name in metadata:
            problem_text = (
                "is given twice" if equals_sign else "must be NAME=VALUE (temperature_c=21.4)"
            )
            fail(f"--meta {option_value!r}: {problem_text}.", EXIT_WRONG_USE)
        metadata[note_name] = note_value
    return {
        note_name: meta_text for note_name, meta_text in notes.items() if meta_text
    } | metadata_keys(metadata)


def profile_named(name_or_file: str) -> "Profile":
    """Load a profile by its name or the path of its file.

    The modules of profiles are imported here, because they are slow and other commands start
    without them.
    """
    from rigd.profile import load_profile

    return load_profile(name_or_file)
