"""The live views that this user can look at: his own, and those of daemons that he may command."""

from dataclasses import fields
from pathlib import Path
from typing import Any

from rigd.live import address as addresses
from rigd.live.address import LiveAddress
from rigd.service.address import running
from rigd.service.client import Client, DaemonGoneError, RefusedByDaemonError


def find_views(rig: str | None) -> list[LiveAddress]:
    """Return the live views of a rig, or of all.

    Parameters
    ----------
    rig
        The profile's name; None: of any.
    """
    own = addresses.running()
    views = [view for view in own if rig in (None, view.rig)]
    if not views:
        # The runtime folder of a daemon that belongs to somebody else cannot be looked into.
        told = (_of_daemon(path) for path in running())
        views = [view for view in told if view is not None and rig in (None, view.rig)]
    return views


def daemons() -> dict[str, bool]:
    """Return the rigs that a daemon owns, and whether it was asked for a live view."""
    told = (_status(path) for path in running())
    return {
        status["daemon"]["profile"]: status["daemon"]["live"]
        for status in told
        if status is not None
    }


def _of_daemon(path: Path) -> LiveAddress | None:
    status = _status(path)
    view = None if status is None or status["rig"] is None else status["rig"]["live_view"]
    if view is None:
        return None
    return LiveAddress(**{field.name: view[field.name] for field in fields(LiveAddress)})


def _status(path: Path) -> dict[str, Any] | None:
    try:
        with Client(path) as client:
            return client.ask("status")
    except (DaemonGoneError, RefusedByDaemonError):
        return None
