"""Command ``rigd profiles``: list, show and copy profiles, or write one from an EDS file."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rigd.cli.options import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_WRONG_USE,
    EdsFile,
    fail,
    profile_named,
)
from rigd.printable import printable

if TYPE_CHECKING:
    from rigd.profile import Draft

NameOrFile = Annotated[str, typer.Argument(metavar="NAME", help="Name of a profile, or its file.")]

profiles_app = typer.Typer(
    invoke_without_command=True,
    rich_markup_mode=None,
)


@profiles_app.callback()
def profiles(context: typer.Context) -> None:
    """List, show and copy hardware profiles, or write a new one.

    A new one is written from a drive's EDS file. Names are searched in hw_profiles of the working
    folder, then in the per-user folder ($XDG_CONFIG_HOME/rigd/profiles, by default
    ~/.config/rigd/profiles), then among those that came with the program. Without a command, the
    profiles are listed.

    Example: rigd profiles, then rigd profiles copy sim my_rig
    """
    if context.invoked_subcommand is None:
        list_profiles()


@profiles_app.command("list")
def list_profiles() -> None:
    """List the profiles that --profile takes by name.

    The list shows the location of each, and which others it hides.

    Example: rigd profiles list
    """
    from rigd.profile import ProfileError, load_profile, profile_files

    for profile_name, (used_file, *hidden_text) in profile_files().items():
        try:
            description = load_profile(used_file.path).description
        except ProfileError as error:
            description = f"cannot be used: {str(error).splitlines()[0]}"
        typer.echo(
            printable(f"{profile_name}: {description} ({used_file.path}, {used_file.origin})")
        )
        for hidden_file in hidden_text:
            typer.echo(printable(f"  hides {hidden_file.path} ({hidden_file.origin})"))


@profiles_app.command()
def show(name: NameOrFile) -> None:
    """Print the text of a profile.

    Example: rigd profiles show sim
    """
    profile = profile_named(name)
    typer.echo(f"{profile.path}:", err=True)
    typer.echo(profile.text, nl=False)


@profiles_app.command()
def copy(
    name: NameOrFile,
    new_name: Annotated[
        str | None,
        typer.Argument(metavar="[NEW_NAME]", help="Name of the copy (default: the same name)."),
    ] = None,
    here: Annotated[
        bool, typer.Option("--here", help="Copy into ./hw_profiles, for this folder only.")
    ] = False,
) -> None:
    """Copy a profile into the per-user folder, to be edited there. No file is ever overwritten.

    Under the same name the copy hides the shipped profile, which is not changed.

    Example: rigd profiles copy sim my_rig
    """
    from rigd.profile import WORKING_FOLDER, copy_profile, profile_files, user_folder

    profile = profile_named(name)
    folder = WORKING_FOLDER if here else user_folder()
    if folder is None:
        fail(
            "There is no per-user folder, because this user has no home; set XDG_CONFIG_HOME, or "
            "copy into this folder by --here.",
            EXIT_FAILED,
        )
    file_stem = new_name or profile.path.stem
    if Path(file_stem).name != file_stem or file_stem.endswith(".toml"):
        fail(f"{file_stem}: is a path; a copy has a name only, without .toml.", EXIT_WRONG_USE)
    path = folder / f"{file_stem}.toml"
    copy_profile(profile, path, new_name)
    files = profile_files()[file_stem]
    search_position = [profile_file.path.resolve() for profile_file in files].index(path.resolve())
    if search_position:
        typer.echo(f"Note: {files[0].path} ({files[0].origin}) hides it here.", err=True)
    for hiding_file in files[search_position + 1 :]:
        typer.echo(f"Note: it hides {hiding_file.path} ({hiding_file.origin}).", err=True)
    typer.echo(f"{path}: written. Next: edit it, then rigd check --profile {file_stem}")


@profiles_app.command()
def new(
    eds: EdsFile,
    output: Annotated[
        Path, typer.Option("--output", metavar="FILE", help="The new profile, a .toml file.")
    ],
    start_from: Annotated[
        str,
        typer.Option("--from", help="Profile to start from, with a CiA 402 drive."),
    ] = "antenna_can",
) -> None:
    """Write a profile for a drive from its EDS file and from answers.

    Identity, bit rate and what follows from missing objects come from the file. Node id, gear and
    motor are entered on the terminal; Enter accepts the displayed value. Torques, inertia, gear
    ratio and encoder step that are not given stay "unknown", and rigd moves nothing before they are
    filled in. Missing features of the drive need your confirmation. Without a terminal there are no
    questions and confirmations, and the missing values are listed. No file is ever overwritten.

    Without an EDS file, begin with a copy: rigd profiles copy antenna_can my_rig.

    Example: rigd profiles new --eds drive.eds --output my_rig.toml
    """
    from rigd.devices.eds import read_eds
    from rigd.profile import Draft, check_new, write_new

    base_profile = profile_named(start_from)
    check_new(output)
    draft = Draft(base_profile, read_eds(eds), output)
    write_new(output, _ask_for_values(draft) if is_terminal() else draft.profile_text())
    for draft_remark in draft.remarks:
        typer.echo(f"Note: {draft_remark}", err=True)
    unanswered_questions = draft.unanswered_questions()
    missing_features = [finding.acceptance_name for finding in draft.unaccepted_findings()]
    if unanswered_questions or missing_features:
        typer.echo(f"To fill in (marked TO FILL IN in {output}):", err=True)
    for open_question in unanswered_questions:
        typer.echo(
            f"  {open_question.profile_key} = {draft.value_text(open_question.profile_key)}: "
            f"{open_question.question_text}",
            err=True,
        )
    if missing_features:
        typer.echo(
            f"  cia402.accept_without: {', '.join(missing_features)}: what the drive lacks; rigd "
            "refuses it until you accept each by its name",
            err=True,
        )
    typer.echo(f"{output}: written. Next: rigd check --profile {output}")


def is_terminal() -> bool:
    """Return whether standard input is a terminal, on which the user can answer questions."""
    return sys.stdin.isatty()


def _ask_for_values(draft: "Draft") -> str:
    """Ask the user for missing values until the draft is a valid profile; return its text."""
    from rigd.profile import ProfileError

    typer.echo(
        "From data sheets; Enter accepts the value in brackets: assumed, or unknown.", err=True
    )
    try:
        while True:
            for open_question in draft.questions():
                _ask_for_value(draft, open_question.profile_key, open_question.question_text)
            try:
                draft.profile_text()
            except ProfileError as error:
                typer.echo(f"{error}\nTry again:", err=True)
                continue
            _ask_for_acceptance(draft)
            return draft.profile_text()
    except typer.Abort:
        typer.echo("Stopped; no profile was written.", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None


def _ask_for_acceptance(draft: "Draft") -> None:
    """Ask the user whether to accept each missing feature of the drive; Enter means no."""
    declined_features: set[str] = set()
    # One answer may imply another: without a watchdog its reaction is irrelevant.
    while missing_features := [
        finding
        for finding in draft.unaccepted_findings()
        if finding.acceptance_name not in declined_features
    ]:
        typer.echo(missing_features[0].consequence, err=True)
        feature_name = missing_features[0].acceptance_name
        if typer.confirm(f"Run it without ({feature_name})?", default=False, err=True):
            draft.accept(feature_name)
        else:
            declined_features.add(feature_name)


def _ask_for_value(draft: "Draft", profile_key: str, question_text: str) -> None:
    """Ask the user for the value of a key of the profile until the answer is valid."""
    while True:
        typed_reply = typer.prompt(question_text, default=draft.value_text(profile_key), err=True)
        try:
            draft.answer(profile_key, typed_reply.strip())
            return
        except ValueError as error:
            typer.echo(f"{profile_key}: {error}.", err=True)
