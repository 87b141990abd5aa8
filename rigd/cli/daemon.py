"""Commands ``rigd serve``, ``status``, ``stop``, ``tare``, ``zero``: daemon, and requests to it."""

import json
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rigd.cli.options import (
    EXIT_INTERRUPTED,
    EXIT_WRONG_USE,
    SESSIONS_FOLDER,
    AsJson,
    Fast,
    Hardware,
    NoQuickLook,
    Output,
    ProfileName,
    fail,
)
from rigd.errors import RigdError
from rigd.extras import require_extra
from rigd.units import suffix_of, unit_of

if TYPE_CHECKING:
    from pathlib import Path

    from rigd.daemon.client import Client


_STATUS_UPDATE_PERIOD_S = 0.5
"""Interval in seconds at which ``rigd status --watch`` updates the status."""


def serve(
    profile: ProfileName,
    output: Output = SESSIONS_FOLDER,
    group: Annotated[
        str | None,
        typer.Option("--group", help="Also let this group control the daemon, via /run/rigd."),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Show the signals of each session in Rerun.")
    ] = False,
    is_page_requested: Annotated[
        bool, typer.Option("--web", help="Serve the operator's page on this computer.")
    ] = False,
    web_port: Annotated[
        int | None,
        typer.Option(
            "--web-port",
            min=1,
            max=65535,
            help="Port of the page (default: 8720, or another one if that is taken).",
        ),
    ] = None,
    fast: Fast = False,
    hardware: Hardware = False,
    no_quick_look: NoQuickLook = False,
) -> None:
    """Run the rig daemon; Ctrl-C or SIGTERM ends it safely.

    The daemon runs the sessions of rigd start.

    Example: rigd serve --profile antenna_can --output /data/sessions --web
    """
    from rigd.daemon import run_daemon
    from rigd.runner.request import load_rig, make_folder

    serves_page = is_page_requested or web_port is not None
    if live:
        require_extra("live", "--live")
    if serves_page:
        require_extra("rig", "The page")
    rig_profile, _ = load_rig(profile, uses_virtual_clock=fast, force_hardware=hardware)
    make_folder(output)
    exit_code = run_daemon(
        rig_profile,
        output.absolute(),
        group_name=group,
        with_live_view=live,
        uses_virtual_clock=fast,
        serves_page=serves_page,
        page_port=web_port,
        makes_quick_looks=not no_quick_look,
    )
    if exit_code is not signal.SIGTERM:
        raise typer.Exit(EXIT_INTERRUPTED)


DaemonProfile = Annotated[
    str | None,
    typer.Option("--profile", help="Profile of the rig (default: the only running daemon)."),
]


@contextmanager
def daemon_client(profile: str | None) -> "Iterator[Client]":
    """Yield a client of the daemon of a profile, or of the only running daemon, in this context."""
    from rigd.daemon.client import Client

    with Client(_socket_path(profile)) as client:
        yield client


def _socket_path(profile: str | None) -> "Path":
    """Return the path of the control socket of a profile's daemon, or of the only running one."""
    from rigd.daemon.address import find_daemon_socket

    return find_daemon_socket(rig_name(profile))


def rig_name(profile: str | None) -> str | None:
    """Return the name of a profile's rig, which identifies its daemon; None without profile."""
    if profile is None:
        return None
    from rigd.daemon.address import running_daemon_sockets, socket_path

    # Reading a profile is slow, and unnecessary if a daemon of that name is running.
    if any(
        profile_path.name == socket_path(profile).name for profile_path in running_daemon_sockets()
    ):
        return profile
    from rigd.cli.options import profile_named

    return profile_named(profile).name


def status(
    profile: DaemonProfile = None,
    watch: Annotated[
        bool, typer.Option("--watch", help="Update continuously until Ctrl-C.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Show the status of daemon, rig and session.

    Example: rigd status --watch
    """
    if watch:
        if as_json:
            fail("--watch and --json cannot be combined; choose one.", EXIT_WRONG_USE)
        if not sys.stdout.isatty():
            fail(
                "--watch needs a terminal; without one, run rigd status repeatedly, or watch the "
                "daemon's socket.",
                EXIT_WRONG_USE,
            )
        _watch_status(profile)
        return
    with daemon_client(profile) as client:
        daemon_reply = client.ask("status")
    from rigd.cli.status_report import report_status

    report_status(daemon_reply, as_json=as_json)


def stop(
    profile: Annotated[
        str | None, typer.Option("--profile", help="Stop the rig of this profile only.")
    ] = None,
    no_wait: Annotated[
        bool, typer.Option("--no-wait", help="Do not wait until the sessions have ended.")
    ] = False,
) -> None:
    """Stop all your running sessions safely; their files are preserved. Not an emergency stop.

    Finds daemons and sessions in the foreground, whatever the runtime folder; as root those of all
    users. Daemons go on. Waits up to 10 s for the sessions to end. Exit code 0 only if no session
    runs any more.

    Example: rigd stop
    """
    from rigd.cli.stop_report import stop_and_report

    exit_code = stop_and_report(profile, is_end_awaited=not no_wait)
    if exit_code:
        raise typer.Exit(exit_code)


def tare(profile: DaemonProfile = None, as_json: AsJson = False) -> None:
    """Tare the sensor: take its mean at rest as zero. No torque.

    Example: rigd tare
    """
    with daemon_client(profile) as client:
        daemon_reply = client.ask("tare")
    if as_json:
        typer.echo(json.dumps(_measured_values(daemon_reply)))
        return
    for axis, axis_mean in daemon_reply["mean"].items():
        value_name, unit_text = axis.removesuffix(suffix_of(axis)), unit_of(axis)
        typer.echo(
            f"{value_name}: mean {axis_mean:.3f} {unit_text}, s.d. {daemon_reply['std'][axis]:.3f} "
            f"{unit_text}"
        )
    typer.echo(f"coupling torque: s.d. {daemon_reply['torque_std_nm']:.3f} N·m")


def zero(profile: DaemonProfile = None, as_json: AsJson = False) -> None:
    """Set the present motor angle as zero.

    The angle limits are relative to this zero. The torque stays off.

    Example: rigd zero
    """
    with daemon_client(profile) as client:
        daemon_reply = client.ask("zero")
    if as_json:
        typer.echo(json.dumps(_measured_values(daemon_reply)))
    else:
        typer.echo(f"Zero set (shift {daemon_reply['moved_rad']:.5f} rad).")


def reset_by_daemon(profile: str | None) -> bool:
    """Have the daemon of a rig, or the only running one, reset the fault.

    Return False if the rig has no daemon. Without a profile, the command ends then.
    """
    from rigd.daemon.address import AddressError, find_daemon_socket
    from rigd.daemon.client import Client

    try:
        daemon_socket = find_daemon_socket(rig_name(profile))
    except AddressError as error:
        if profile is not None:
            return False
        # The default rig is simulated: its success would be taken for that of the real drive.
        fail(
            f"Nothing was reset. {error} To reset a drive without a daemon, name your rig: rigd "
            "reset --profile NAME (the default rig sim is simulated: nothing to reset).",
            EXIT_WRONG_USE,
        )
    with Client(daemon_socket) as client:
        daemon_reply = client.ask("reset")
    typer.echo("The fault is reset; the devices are connected and the torque is off.")
    if daemon_reply["zero_lost"]:
        typer.echo("The zero of the angle was lost: move the motor to mid-travel; run rigd zero.")
    return True


def _measured_values(daemon_reply: dict[str, Any]) -> dict[str, Any]:
    """Return only the measured values in a daemon's reply to ``tare`` or ``zero``."""
    return {
        value_name: measured_value
        for value_name, measured_value in daemon_reply.items()
        if value_name not in ("reply", "ok")
    }


def _watch_status(profile: str | None) -> None:
    """Show the daemon's status repeatedly until Ctrl-C, even if the daemon is restarted."""
    from rich.console import Console
    from rich.live import Live

    from rigd.cli.status_view import status_table
    from rigd.daemon.address import find_daemon_socket
    from rigd.daemon.client import Client

    wanted_rig_name = rig_name(profile)
    with (
        daemon_client(profile) as client,
        Live(console=Console(), auto_refresh=False) as live_display,
    ):
        connected_client: Client | None = client
        while True:
            try:
                connected_client = connected_client or Client(find_daemon_socket(wanted_rig_name))
                daemon_reply = connected_client.ask("status")
                wanted_rig_name = wanted_rig_name or daemon_reply["daemon"]["profile"]
                live_display.update(status_table(daemon_reply), refresh=True)
            except RigdError as error:
                if connected_client is not None:
                    connected_client.close()
                    connected_client = None
                live_display.update(f"{error} Waiting for it; Ctrl-C quits.", refresh=True)
            time.sleep(_STATUS_UPDATE_PERIOD_S)
