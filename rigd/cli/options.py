"""Options that several commands have, and the profile that one of them names."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rigd.cli.exits import EXIT_WRONG_USE, fail

if TYPE_CHECKING:
    from rigd.profile import Profile

ProfileName = Annotated[
    str, typer.Option("--profile", help="Name of a hardware profile, or its file.")
]
EdsFile = Annotated[
    Path, typer.Option("--eds", metavar="FILE", help="EDS or DCF file of a CANopen drive.")
]
Output = Annotated[Path, typer.Option("--output", help="Folder for the session files.")]
SESSIONS = Path("sessions")
"""Where session files go unless told otherwise."""
Seed = Annotated[
    int | None,
    typer.Option("--seed", min=0, help="Of a simulated rig's noise (default: the profile's)."),
]
Fast = Annotated[
    bool, typer.Option("--fast", help="Do not wait for real time (simulated rigs only).")
]
AsJson = Annotated[bool, typer.Option("--json", help="Write one JSON document to standard output.")]

Hardware = Annotated[
    bool,
    typer.Option(
        "--hardware", help="Move the hardware, even if somebody simulates it out of reach."
    ),
]

Repeat = Annotated[int, typer.Option("--repeat", min=1, help="Number of sessions.")]
Operator = Annotated[str, typer.Option("--operator", help="Goes into the file.")]
Specimen = Annotated[str, typer.Option("--specimen", help="Goes into the file.")]
Note = Annotated[str, typer.Option("--note", help="Goes into the file.")]
Force = Annotated[
    bool, typer.Option("--force", help="Run even if the torque is predicted to saturate.")
]


def session_notes(operator: str, specimen: str, note: str) -> dict[str, str]:
    """Return what is to go into the file; a text that cannot ends the command."""
    notes = {"operator": operator, "specimen": specimen, "note": note}
    for option, text in notes.items():
        if not text.isprintable():
            fail(f"--{option} {text!r}: is not plain text of one line.", EXIT_WRONG_USE)
    return notes


def profile_named(name: str) -> "Profile":
    """Load a profile; one that cannot be used ends the command."""
    from rigd.profile import ProfileError, load_profile

    try:
        return load_profile(name)
    except ProfileError as error:
        fail(str(error), EXIT_WRONG_USE)
