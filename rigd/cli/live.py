"""``rigd live``: the operator's window on a running rig."""

import time
from typing import TYPE_CHECKING, Annotated

import typer

from rigd.cli.exits import EXIT_FAILED, fail
from rigd.cli.viewing import ended_gently, has_screen, scratch_folder, tunnel_advice

if TYPE_CHECKING:
    from rigd.live.address import LiveAddress
    from rigd.live.viewer import Viewer

_LOOK_S = 0.5


def live(
    profile: Annotated[
        str | None,
        typer.Option("--profile", help="Whose live view (default: the only one that is running)."),
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Print the address for a browser; open no window.")
    ] = False,
    wait: Annotated[
        bool, typer.Option("--wait", help="If there is no live view yet, wait until there is.")
    ] = False,
) -> None:
    """Open the live view of a rig in a window. It stays, and shows one session after the other.

    Shown are the sessions of rigd run … --live, and those of a daemon that was started with
    rigd serve … --live. docs/live_view.md tells how to look at them from another computer.

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
            f"{view.grpc_port}; the session files are not concerned.",
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
    """Return the name of a profile's rig; a profile that cannot be used ends the command."""
    from rigd.service.live_views import find_views

    if find_views(profile):
        return profile
    from rigd.cli.options import profile_named

    return profile_named(profile).name


def _only_one(rig: str | None) -> "LiveAddress | None":
    """Return the live view of a rig, if there is one; several end the command."""
    from rigd.service.live_views import find_views

    views = find_views(rig)
    if len(views) > 1:
        rigs = ", ".join(view.rig for view in views)
        fail(f"Several live views are running ({rigs}); name one with --profile.", EXIT_FAILED)
    return views[0] if views else None


def _await(rig: str | None) -> "LiveAddress":
    typer.echo("Waiting for a live view to begin; Ctrl-C ends.", err=True)
    while (view := _only_one(rig)) is None:
        time.sleep(_LOOK_S)
    return view


def _how_to_start(profile: str | None) -> str:
    from rigd.service.live_views import daemons

    of_rig = "" if profile is None else f" of the rig {profile}"
    name = profile or "NAME"
    for rig, with_view in daemons().items():
        if profile not in (None, rig):
            continue
        if with_view:
            return (
                f"The daemon of the rig {rig} has no live view at the moment: rigd status says "
                "what it is doing. rigd live --wait waits for the view."
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
    """Keep a window open, on the live view that there is, until it is closed."""
    from rigd.live.program import RerunError
    from rigd.live.viewer import Viewer

    with ended_gently(), scratch_folder() as scratch:
        try:
            viewer = Viewer(view, scratch)
        except RerunError as error:
            fail(str(error), EXIT_FAILED)
        typer.echo(
            f"The live view of {view.rig} is shown; close the window, or press Ctrl-C, to end.",
            err=True,
        )
        try:
            code = _follow(viewer, view)
        finally:
            viewer.close()
    if code:
        fail(
            f"The window was closed by a fault ({viewer.last_words}). rigd live --web shows the "
            "same in a browser.",
            EXIT_FAILED,
        )


def _follow(viewer: "Viewer", shown: "LiveAddress") -> int:
    """Connect the window to each server that takes the place of the one before.

    Returns
    -------
    int
        The viewer's exit code, once the window is closed.
    """
    from rigd.service.live_views import find_views

    there = True
    while (code := viewer.exit_code) is None:
        time.sleep(_LOOK_S)
        view = next(iter(find_views(shown.rig)), None)
        if view is not None and view.server != shown.server:
            if not viewer.connect(view):
                continue  # it is tried again
            typer.echo(f"The live view of {view.rig} has begun anew.", err=True)
            shown = view
        elif view is None and there:
            typer.echo(
                f"The live view of {shown.rig} has ended; the window stays, and shows the next one "
                "when it begins.",
                err=True,
            )
        there = view is not None
    return code
