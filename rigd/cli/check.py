"""``rigd check`` and ``rigd reset``: the state of the rig, and the operator's fault reset."""

import json
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rigd.cli.daemon import reset_by_daemon
from rigd.cli.exits import EXIT_FAILED, EXIT_WRONG_USE, fail
from rigd.cli.options import AsJson, profile_named
from rigd.interruption import raise_on

if TYPE_CHECKING:
    from rigd.checks import Row
    from rigd.profile import Profile


def check(
    profile: Annotated[
        str | None,
        typer.Option("--profile", help="Name of a hardware profile, or its file (default: sim)."),
    ] = None,
    eds: Annotated[
        Path | None,
        typer.Option(
            "--eds",
            metavar="FILE",
            help="Check only what the EDS or DCF file of a drive tells, and connect to nothing.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check everything that can be checked without a torque: profile, buses, devices, loop.

    Ends with 0 if a session can be run (warnings allowed), and with 1 if not. With --eds, say on
    paper whether a drive can be used: by itself, or with --profile also under that profile.

    Example: rigd check --profile antenna_can
    """
    _end_as_by_ctrl_c()
    if eds is not None:
        _report(_rows_of(eds, profile), as_json=as_json, on_paper=True)
        return
    rig_profile = _openable_profile("sim" if profile is None else profile)
    from rigd.checks.rig import check_rig

    _report(check_rig(rig_profile), as_json=as_json, on_paper=False)


def _rows_of(eds: Path, profile: str | None) -> "list[Row]":
    from rigd.checks.eds import eds_rows

    if profile is None:
        return list(eds_rows(eds, None))
    rig_profile = profile_named(profile)
    if rig_profile.rig.cia402 is None:
        fail(
            f"{rig_profile.path}: has no section [cia402] that the file could be held against; "
            "leave --profile away, or name a profile with such a drive.",
            EXIT_WRONG_USE,
        )
    return list(eds_rows(eds, rig_profile.rig))


def _report(rows: "list[Row]", *, as_json: bool, on_paper: bool) -> None:
    from rigd.checks import overall

    verdict = overall(rows)
    if as_json:
        document = {"verdict": verdict, "rows": [row.as_dict() for row in rows]}
        typer.echo(json.dumps(document, ensure_ascii=False))
    else:
        from rigd.checks.table import OF_A_RIG, OF_AN_EDS, print_table

        print_table(rows, OF_AN_EDS if on_paper else OF_A_RIG)
    if verdict == "failed":
        raise typer.Exit(EXIT_FAILED)


def reset(
    profile: Annotated[
        str | None,
        typer.Option("--profile", help="Whose rig (default: that of the running daemon, or sim)."),
    ] = None,
) -> None:
    """Reset a fault, after its cause is removed. No torque; the drive stays off.

    Where a daemon has the rig, it is asked to; otherwise the fault of the drive is reset.

    Example: rigd reset --profile antenna_can
    """
    _end_as_by_ctrl_c()
    if reset_by_daemon(profile):
        return
    rig_profile = _openable_profile("sim" if profile is None else profile)
    from rigd.devices.contracts import DeviceError
    from rigd.devices.resetting import reset_drive

    try:
        typer.echo(reset_drive(rig_profile.rig))
    except (DeviceError, OSError) as error:
        fail(str(error), EXIT_FAILED)


def _openable_profile(name: str) -> "Profile":
    """Load a profile whose devices this installation can open; any other ends the command."""
    from rigd.engine.process import SINGLE_THREADED

    os.environ.update(SINGLE_THREADED)
    from rigd.devices.registry import UnknownDeviceError, check_selection

    profile = profile_named(name)
    try:
        check_selection(profile.rig.devices, profile.path)
    except UnknownDeviceError as error:
        fail(str(error), EXIT_WRONG_USE)
    return profile


def _end_as_by_ctrl_c() -> None:
    """Let go of the devices when asked to end by whatever means."""
    raise_on(signal.SIGTERM, signal.SIGHUP)
