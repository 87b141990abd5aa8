"""``rigd replay``: a recorded session, as it was seen live."""

from pathlib import Path
from typing import Annotated

import typer

from rigd.cli.exits import EXIT_FAILED, EXIT_WRONG_USE, fail
from rigd.cli.progress import progress
from rigd.cli.viewing import ended_gently, has_screen, scratch_folder, tunnel_advice
from rigd.view.rrd_file import SUFFIX, RrdFileError, check_new, check_rrd_file, new_rrd_file


def replay(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            readable=False,
            help="A session file (.mcap), or a recording of it for Rerun (.rrd).",
        ),
    ],
    web: Annotated[
        bool, typer.Option("--web", help="Print the address for a browser; open no window.")
    ] = False,
    save: Annotated[
        Path | None,
        typer.Option(
            "--save", metavar="OUT.rrd", help="Write a recording for Rerun's viewer; show nothing."
        ),
    ] = None,
) -> None:
    """Show a recorded session in the layout of the live view, played from its start.

    docs/opening_sessions.md tells what else opens session files.

    Example: rigd replay sessions/20261120-101500-chirp.mcap
    """
    if save is not None:
        with ended_gently():
            _save(path, save, web=web)
        return
    if not web and not has_screen():
        _check_shown(path)  # what is no file for a window is none elsewhere, either
        elsewhere = (
            "the file can be looked at elsewhere as it is"
            if path.suffix == SUFFIX
            else f"--save OUT{SUFFIX} writes a file that can be looked at elsewhere"
        )
        fail(
            "There is no screen for a window (neither DISPLAY nor WAYLAND_DISPLAY is set). "
            f"rigd replay {path} --web prints an address for a browser; {elsewhere}.",
            EXIT_FAILED,
        )
    from rigd.live.program import RerunError

    with ended_gently(), scratch_folder() as scratch:
        recording = _as_recording(path, scratch)
        try:
            if web:
                _serve(recording, scratch, path)
            else:
                _open_window(recording, scratch, path)
        except RerunError as error:
            fail(str(error), EXIT_FAILED)


def _save(path: Path, out: Path, *, web: bool) -> None:
    if web:
        fail(
            "--save writes a file and shows nothing, so it does not go with --web.", EXIT_WRONG_USE
        )
    if path.suffix == SUFFIX:
        fail(f"{path} is a recording for Rerun already; copy it instead.", EXIT_WRONG_USE)
    try:
        check_new(out)
    except RrdFileError as error:
        fail(f"--save {error}", EXIT_WRONG_USE)
    _convert(path, out)
    typer.echo(f"{out}: open it with rigd replay {out}.", err=True)


def _check_shown(path: Path) -> None:
    """End the command if a file is not of a kind that is shown, as far as its beginning tells."""
    from rigd.session import SessionError, check_beginning

    try:
        if path.suffix == SUFFIX:
            check_rrd_file(path)
        else:
            check_beginning(path)
    except (RrdFileError, SessionError) as error:
        fail(str(error), EXIT_FAILED)


def _convert(path: Path, out: Path) -> None:
    """Write a session as a recording for Rerun; what keeps it from that ends the command."""
    from rigd.session import SessionError, read_session, read_timings
    from rigd.view.recorded import draw_session

    try:
        session, timings = read_session(path), read_timings(path)
        with progress(path.name) as on_progress, new_rrd_file(out) as stream:
            draw_session(stream, session, timings, on_progress=on_progress)
    except (SessionError, RrdFileError) as error:
        fail(str(error), EXIT_FAILED)


def _as_recording(path: Path, scratch: Path) -> Path:
    """Return a file that Rerun's viewer shows in our layout, made in a folder if need be."""
    if path.suffix == SUFFIX:
        try:
            check_rrd_file(path)
        except RrdFileError as error:
            fail(str(error), EXIT_FAILED)
        return path
    recording = scratch / f"session{SUFFIX}"
    _convert(path, recording)
    return recording


def _open_window(recording: Path, scratch: Path, path: Path) -> None:
    from rigd.live.playback import Window

    with Window(recording, scratch) as window:
        typer.echo(f"{path.name} is shown; close the window, or press Ctrl-C, to end.", err=True)
        if window.wait():
            fail(
                f"The window was closed by a fault ({window.program.last_words}). "
                f"rigd replay {path} --web shows the same in a browser.",
                EXIT_FAILED,
            )


def _serve(recording: Path, scratch: Path, path: Path) -> None:
    from rigd.live.playback import PageOfFile

    with PageOfFile(recording, scratch) as page:
        typer.echo(page.address.page_url)
        typer.echo(
            f"{path.name} is shown there until Ctrl-C. {tunnel_advice(page.address)}", err=True
        )
        page.wait()
        fail(f"The Rerun server ended: {page.program.last_words}.", EXIT_FAILED)
