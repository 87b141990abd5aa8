"""Commands ``rigd live`` and ``rigd replay``: window with a running or a recorded session."""

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

from rigd.cli.options import EXIT_FAILED, EXIT_WRONG_USE, fail, task_progress
from rigd.runtime import raise_on_signals
from rigd.view.rrd_file import (
    RRD_SUFFIX,
    RrdFileError,
    check_new_rrd_file,
    check_rrd_file,
    new_rrd_file,
)

if TYPE_CHECKING:
    from rigd.live import Viewer
    from rigd.live.address import LiveAddress


_POLL_PERIOD_S = 0.5
"""Interval in seconds at which live views are searched for."""


def has_screen() -> bool:
    """Return whether this computer has a display on which a window can open."""
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def tunnel_advice(live_view: "LiveAddress") -> str:
    """Return a sentence for the user with the command to open a live view on another computer."""
    page_port, grpc_port = live_view.page_port, live_view.grpc_port
    return (
        f"From another computer: ssh -L {page_port}:127.0.0.1:{page_port} -L "
        f"{grpc_port}:127.0.0.1:{grpc_port} "
        f"{platform.node()}, and open http://127.0.0.1:{page_port} there."
    )


@contextlib.contextmanager
def scratch_folder() -> Iterator[Path]:
    """Yield a temporary folder for files that the viewer does not remove itself."""
    try:
        folder = tempfile.TemporaryDirectory(prefix="rigd-view-", ignore_cleanup_errors=True)
    except OSError as error:
        fail(
            f"No temporary folder can be made ({error.strerror}); set TMPDIR to one with room.",
            EXIT_FAILED,
        )
    with folder as folder_name:
        yield Path(folder_name)


@contextlib.contextmanager
def interrupted_by_end_signals() -> Iterator[None]:
    """Make SIGTERM and SIGHUP raise KeyboardInterrupt here, so that temporary files are removed."""
    signal_numbers = (signal.SIGTERM, signal.SIGHUP)
    previous_handlers = [signal.getsignal(signal_number) for signal_number in signal_numbers]
    raise_on_signals(*signal_numbers)
    try:
        yield
    finally:
        for signal_number, previous_handler in zip(signal_numbers, previous_handlers, strict=True):
            signal.signal(signal_number, previous_handler)


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
    rig_name = None if profile is None else _rig_name(profile)
    view = _only_running_view(rig_name)
    if view is None and wait:
        view = _wait_for_view(rig_name)
    if view is None:
        fail(_start_advice(profile), EXIT_FAILED)
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
        _show_view(view)


def _rig_name(profile: str) -> str:
    """Return the name of the rig of a profile; an invalid profile ends the command."""
    from rigd.daemon.client import find_live_views

    if find_live_views(profile):
        return profile
    from rigd.cli.options import profile_named

    return profile_named(profile).name


def _only_running_view(rig_name: str | None) -> "LiveAddress | None":
    """Return the only running live view, of `rig_name` or of any rig, or None if there is none.

    Several live views end the command.
    """
    from rigd.daemon.client import find_live_views

    live_views = find_live_views(rig_name)
    if len(live_views) > 1:
        rig_names = ", ".join(live_view.rig for live_view in live_views)
        fail(f"Several live views are running ({rig_names}); name one with --profile.", EXIT_FAILED)
    return live_views[0] if live_views else None


def _wait_for_view(rig_name: str | None) -> "LiveAddress":
    """Wait until a live view runs, and return its address."""
    typer.echo("Waiting for a live view to start; Ctrl-C quits.", err=True)
    while (live_view := _only_running_view(rig_name)) is None:
        time.sleep(_POLL_PERIOD_S)
    return live_view


def _start_advice(profile: str | None) -> str:
    """Return the message that no live view is running, with the command that starts one."""
    from rigd.daemon.client import daemons_with_view

    rig_text = "" if profile is None else f" of the rig {profile}"
    profile_name = profile or "NAME"
    for rig, has_view in daemons_with_view().items():
        if profile not in (None, rig):
            continue
        if has_view:
            return (
                f"The daemon of the rig {rig} has no live view at the moment: rigd status shows "
                "its state. rigd live --wait waits for the view."
            )
        return (
            f"The daemon of the rig {rig} was started without a live view; end it and start it "
            f"with rigd serve --profile {rig} --live."
        )
    return (
        f"No live view{rig_text} is running. Start one with rigd run chirp --profile "
        f"{profile_name} --live, or with rigd serve --profile {profile_name} --live; rigd live "
        "--wait waits for it."
    )


def _show_view(live_view: "LiveAddress") -> None:
    """Show a live view in a window until the window is closed."""
    from rigd.live import Viewer

    with interrupted_by_end_signals(), scratch_folder() as scratch_path:
        viewer = Viewer(live_view, scratch_path)
        typer.echo(
            f"The live view of {live_view.rig} is shown; close the window, or press Ctrl-C, "
            "to end.",
            err=True,
        )
        try:
            exit_code = _follow_servers(viewer, live_view)
        finally:
            viewer.close()
    if exit_code:
        fail(f"{viewer.closing_reason} rigd live --web shows the same in a browser.", EXIT_FAILED)


def _follow_servers(viewer: "Viewer", view: "LiveAddress") -> int:
    """Connect a viewer's window to each new server of a live view until the window is closed.

    Returns the exit code of the viewer.
    """
    from rigd.daemon.client import find_live_views

    is_view_running = True
    while (exit_code := viewer.exit_code) is None:
        time.sleep(_POLL_PERIOD_S)
        live_view = next(iter(find_live_views(view.rig)), None)
        if live_view is not None and live_view.server != view.server:
            if not viewer.connect(live_view):
                continue  # tried again in the next round
            typer.echo(f"The live view of {live_view.rig} has restarted.", err=True)
            view = live_view
        elif live_view is None and is_view_running:
            typer.echo(
                f"The live view of {view.rig} has ended; the window stays open and shows the next "
                "one.",
                err=True,
            )
        is_view_running = live_view is not None
    return exit_code


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
        with interrupted_by_end_signals():
            _save_recording(path, save, is_web_requested=web)
        return
    if not web and not has_screen():
        _check_displayable(path)  # the same files are valid for a window and for other outputs
        file_advice = (
            "the file can be opened elsewhere"
            if path.suffix == RRD_SUFFIX
            else f"--save OUT{RRD_SUFFIX} writes a file that can be opened elsewhere"
        )
        fail(
            "There is no screen for a window (neither DISPLAY nor WAYLAND_DISPLAY is set). "
            f"rigd replay {path} --web prints an address for a browser; {file_advice}.",
            EXIT_FAILED,
        )
    with interrupted_by_end_signals(), scratch_folder() as scratch_path:
        rerun_path = _as_recording(path, scratch_path)
        if web:
            _serve_recording(rerun_path, scratch_path, path)
        else:
            _open_window(rerun_path, scratch_path, path)


def _save_recording(path: Path, output_path: Path, *, is_web_requested: bool) -> None:
    """Convert a session file into a new Rerun file, for the option ``--save``."""
    if is_web_requested:
        fail(
            "--save writes a file and shows nothing, so it cannot be combined with --web.",
            EXIT_WRONG_USE,
        )
    if path.suffix == RRD_SUFFIX:
        fail(f"{path} is a recording for Rerun already; copy it instead.", EXIT_WRONG_USE)
    try:
        check_new_rrd_file(output_path)
    except RrdFileError as error:
        fail(f"--save {error}", EXIT_WRONG_USE)
    _write_rerun_file(path, output_path)
    typer.echo(f"{output_path}: open it with rigd replay {output_path}.", err=True)


def _check_displayable(path: Path) -> None:
    """Raise an error if the beginning of a file shows that it cannot be displayed."""
    from rigd.session import check_magic_bytes

    if path.suffix == RRD_SUFFIX:
        check_rrd_file(path)
    else:
        check_magic_bytes(path)


def _write_rerun_file(session_path: Path, output_path: Path) -> None:
    """Convert a session file into a Rerun file, with a progress line."""
    from rigd.session import read_session, read_timings
    from rigd.view import draw_session

    session, tick_timings = read_session(session_path), read_timings(session_path)
    with (
        task_progress(session_path.name) as on_progress,
        new_rrd_file(output_path) as recording_stream,
    ):
        draw_session(recording_stream, session, tick_timings, on_progress=on_progress)


def _as_recording(path: Path, scratch_path: Path) -> Path:
    """Return the path of a Rerun file; convert it into `scratch_path` if `path` is a session."""
    if path.suffix == RRD_SUFFIX:
        check_rrd_file(path)
        return path
    rerun_path = scratch_path / f"session{RRD_SUFFIX}"
    _write_rerun_file(path, rerun_path)
    return rerun_path


def _open_window(rerun_path: Path, scratch_path: Path, shown_path: Path) -> None:
    """Show a Rerun file in a window until the window is closed."""
    from rigd.live import FileWindow

    with FileWindow(rerun_path, scratch_path) as file_window:
        typer.echo(
            f"{shown_path.name} is shown; close the window, or press Ctrl-C, to end.", err=True
        )
        if file_window.wait():
            fail(
                f"{file_window.closing_reason} rigd replay {shown_path} --web shows the same in a "
                "browser.",
                EXIT_FAILED,
            )


def _serve_recording(rerun_path: Path, scratch_path: Path, shown_path: Path) -> None:
    """Show a Rerun file on a page for browsers until Ctrl-C."""
    from rigd.live import PageOfFile

    with PageOfFile(rerun_path, scratch_path) as page:
        typer.echo(page.address.page_url)
        typer.echo(
            f"{shown_path.name} is shown there until Ctrl-C. {tunnel_advice(page.address)}",
            err=True,
        )
        page.wait()
        fail(f"The Rerun server ended: {page.program.last_log_lines}.", EXIT_FAILED)
