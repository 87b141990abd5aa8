"""``rigd live`` and ``rigd replay``: window with a running or a recorded session."""

import contextlib
import os
import platform
import signal
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rigd.cli.options import EXIT_FAILED, EXIT_WRONG_USE, fail, progress
from rigd.runtime import raise_on
from rigd.view.rrd_file import SUFFIX, RrdFileError, check_new, check_rrd_file, new_rrd_file

if TYPE_CHECKING:
    from rigd.live import Viewer
    from rigd.live.address import LiveAddress


_POLL_S = 0.5


def has_screen() -> bool:
    """Return whether there is a display for a window."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def tunnel_advice(view: "LiveAddress") -> str:
    """Return the command that opens the live view from another computer."""
    page, grpc = view.page_port, view.grpc_port
    return (
        f"From another computer: ssh -L {page}:127.0.0.1:{page} -L {grpc}:127.0.0.1:{grpc} "
        f"{platform.node()}, and open http://127.0.0.1:{page} there."
    )


@contextlib.contextmanager
def scratch_folder() -> Iterator[Path]:
    """Yield a temporary folder for files that the viewer leaves."""
    try:
        folder = tempfile.TemporaryDirectory(prefix="rigd-view-", ignore_cleanup_errors=True)
    except OSError as error:
        fail(
            f"No temporary folder can be made ({error.strerror}); set TMPDIR to one with room.",
            EXIT_FAILED,
        )
    with folder as name:
        yield Path(name)


@contextlib.contextmanager
def ended_gently() -> Iterator[None]:
    """Make SIGTERM and SIGHUP act as Ctrl-C, so that temporary files are removed."""
    numbers = (signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    raise_on(*numbers)
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def live(
    profile: Annotated[
        str | None,
        typer.Option("--profile", help="Profile of the rig (default: the only running live view)."),
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Print the address for a browser; open no window.")
    ] = False,
    wait: Annotated[
        bool, typer.Option("--wait", help="Wait for a live view if none is running.")
    ] = False,
) -> None:
    """Open the live view of a rig in a window.

    The window stays open from session to session. It shows the sessions of rigd run … --live, and
    of a daemon that was started with rigd serve … --live. docs/live_view.md describes the view from
    another computer.

    Example: rigd live --profile antenna_can
    """
    rig = None if profile is None else _rig_name(profile)
    view = _only_one(rig)
    if view is None and wait:
        view = _await(rig)
    if view is None:
        fail(_how_to_start(profile), EXIT_FAILED)
    if web:
        typer.echo(view.page_url)
        typer.echo(tunnel_advice(view), err=True)
        typer.echo(
            f"Every user and program of this computer can read the view, and write to it, on port "
            f"{view.grpc_port}; the session files are not affected.",
            err=True,
        )
    elif not has_screen():
        fail(
            "There is no screen for a window (neither DISPLAY nor WAYLAND_DISPLAY is set). "
            f"rigd live --web prints the address for a browser. {tunnel_advice(view)}",
            EXIT_FAILED,
        )
    else:
        _show(view)


def _rig_name(profile: str) -> str:
    """Return the name of a profile's rig; an invalid profile ends the command."""
    from rigd.daemon.client import find_views

    if find_views(profile):
        return profile
    from rigd.cli.options import profile_named

    return profile_named(profile).name


def _only_one(rig: str | None) -> "LiveAddress | None":
    """Return the only live view of a rig, or None; several live views end the command."""
    from rigd.daemon.client import find_views

    views = find_views(rig)
    if len(views) > 1:
        rigs = ", ".join(view.rig for view in views)
        fail(f"Several live views are running ({rigs}); name one with --profile.", EXIT_FAILED)
    return views[0] if views else None


def _await(rig: str | None) -> "LiveAddress":
    typer.echo("Waiting for a live view to start; Ctrl-C quits.", err=True)
    while (view := _only_one(rig)) is None:
        time.sleep(_POLL_S)
    return view


def _how_to_start(profile: str | None) -> str:
    from rigd.daemon.client import daemons

    of_rig = "" if profile is None else f" of the rig {profile}"
    name = profile or "NAME"
    for rig, with_view in daemons().items():
        if profile not in (None, rig):
            continue
        if with_view:
            return (
                f"The daemon of the rig {rig} has no live view at the moment: rigd status shows "
                "its state. rigd live --wait waits for the view."
            )
        return (
            f"The daemon of the rig {rig} was started without a live view; end it and start it "
            f"with rigd serve --profile {rig} --live."
        )
    return (
        f"No live view{of_rig} is running. Start one with rigd run chirp --profile {name} --live, "
        f"or with rigd serve --profile {name} --live; rigd live --wait waits for it."
    )


def _show(view: "LiveAddress") -> None:
    """Show the present live view in a window until the window is closed."""
    from rigd.live import Viewer

    with ended_gently(), scratch_folder() as scratch:
        viewer = Viewer(view, scratch)
        typer.echo(
            f"The live view of {view.rig} is shown; close the window, or press Ctrl-C, to end.",
            err=True,
        )
        try:
            code = _follow(viewer, view)
        finally:
            viewer.close()
    if code:
        fail(f"{viewer.fault} rigd live --web shows the same in a browser.", EXIT_FAILED)


def _follow(viewer: "Viewer", shown: "LiveAddress") -> int:
    """Reconnect the window to each new server; return the exit code of the closed viewer."""
    from rigd.daemon.client import find_views

    there = True
    while (code := viewer.exit_code) is None:
        time.sleep(_POLL_S)
        view = next(iter(find_views(shown.rig)), None)
        if view is not None and view.server != shown.server:
            if not viewer.connect(view):
                continue  # tried again in the next round
            typer.echo(f"The live view of {view.rig} has restarted.", err=True)
            shown = view
        elif view is None and there:
            typer.echo(
                f"The live view of {shown.rig} has ended; the window stays open and shows the next "
                "one.",
                err=True,
            )
        there = view is not None
    return code


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
    """Show a recorded session in the layout of the live view.

    The session is played from its start. docs/opening_sessions.md lists other programs that open
    session files.

    Example: rigd replay sessions/20261120-101500-chirp.mcap
    """
    if save is not None:
        with ended_gently():
            _save(path, save, web=web)
        return
    if not web and not has_screen():
        _check_shown(path)  # the same files are valid for a window and for other outputs
        elsewhere = (
            "the file can be opened elsewhere"
            if path.suffix == SUFFIX
            else f"--save OUT{SUFFIX} writes a file that can be opened elsewhere"
        )
        fail(
            "There is no screen for a window (neither DISPLAY nor WAYLAND_DISPLAY is set). "
            f"rigd replay {path} --web prints an address for a browser; {elsewhere}.",
            EXIT_FAILED,
        )
    with ended_gently(), scratch_folder() as scratch:
        recording = _as_recording(path, scratch)
        if web:
            _serve(recording, scratch, path)
        else:
            _open_window(recording, scratch, path)


def _save(path: Path, out: Path, *, web: bool) -> None:
    if web:
        fail(
            "--save writes a file and shows nothing, so it cannot be combined with --web.",
            EXIT_WRONG_USE,
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
    """Raise if the beginning of a file shows that it cannot be displayed."""
    from rigd.session import check_beginning

    if path.suffix == SUFFIX:
        check_rrd_file(path)
    else:
        check_beginning(path)


def _convert(path: Path, out: Path) -> None:
    """Write a session as a recording for Rerun."""
    from rigd.session import read_session, read_timings
    from rigd.view import draw_session

    session, timings = read_session(path), read_timings(path)
    with progress(path.name) as on_progress, new_rrd_file(out) as stream:
        draw_session(stream, session, timings, on_progress=on_progress)


def _as_recording(path: Path, scratch: Path) -> Path:
    """Return the file for Rerun's viewer, converted into the scratch folder if necessary."""
    if path.suffix == SUFFIX:
        check_rrd_file(path)
        return path
    recording = scratch / f"session{SUFFIX}"
    _convert(path, recording)
    return recording


def _open_window(recording: Path, scratch: Path, path: Path) -> None:
    from rigd.live import FileWindow

    with FileWindow(recording, scratch) as window:
        typer.echo(f"{path.name} is shown; close the window, or press Ctrl-C, to end.", err=True)
        if window.wait():
            fail(
                f"{window.fault} rigd replay {path} --web shows the same in a browser.",
                EXIT_FAILED,
            )


def _serve(recording: Path, scratch: Path, path: Path) -> None:
    from rigd.live import PageOfFile

    with PageOfFile(recording, scratch) as page:
        typer.echo(page.address.page_url)
        typer.echo(
            f"{path.name} is shown there until Ctrl-C. {tunnel_advice(page.address)}", err=True
        )
        page.wait()
        fail(f"The Rerun server ended: {page.program.last_log_lines}.", EXIT_FAILED)
