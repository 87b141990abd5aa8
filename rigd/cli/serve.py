"""``rigd serve``: the daemon that owns a rig."""

import os
import signal
from typing import Annotated

import typer

from rigd.cli.exits import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_WRONG_USE, fail
from rigd.cli.options import SESSIONS, Fast, Hardware, Output, ProfileName


def serve(
    profile: ProfileName,
    output: Output = SESSIONS,
    group: Annotated[
        str | None,
        typer.Option(
            "--group", help="Let the members of this group command it too, over /run/rigd."
        ),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Show the signals of each session in Rerun.")
    ] = False,
    fast: Fast = False,
    hardware: Hardware = False,
) -> None:
    """Own a rig and run sessions for rigd start, until Ctrl-C or SIGTERM ends it safely.

    Example: rigd serve --profile antenna_can --output /data/sessions
    """
    from rigd.engine.process import SINGLE_THREADED

    os.environ.update(SINGLE_THREADED)
    from rigd.devices.registry import UnknownDeviceError
    from rigd.planning import RefusedError
    from rigd.profile import ProfileError
    from rigd.service.address import AddressError, UnknownGroupError
    from rigd.service.daemon import run_daemon
    from rigd.supervisor.lock import RigBusyError
    from rigd.supervisor.orders import load_rig, make_folder

    try:
        rig_profile, _ = load_rig(profile, fast=fast, hardware=hardware)
        make_folder(output)
        number = run_daemon(rig_profile, output.absolute(), group=group, live=live, fast=fast)
    except (ProfileError, UnknownDeviceError, UnknownGroupError, RefusedError) as error:
        fail(str(error), EXIT_WRONG_USE)
    except (RigBusyError, AddressError) as error:
        fail(str(error), EXIT_FAILED)
    if number is not signal.SIGTERM:
        raise typer.Exit(EXIT_INTERRUPTED)
