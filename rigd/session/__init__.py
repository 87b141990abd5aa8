"""Session files: format, writer, reader, recovery.

The names below are imported on first use, so that the control process, which needs the message
layout only (:mod:`rigd.session.format`), does not pay for the container.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rigd.session.format import (
        SAMPLE_DTYPE,
        SAMPLE_SIZE,
        SessionError,
        SessionExistsError,
        Status,
    )
    from rigd.session.info import SessionInfo, describe, readable_texts
    from rigd.session.reader import (
        Event,
        Session,
        check_beginning,
        read_controls,
        read_session,
        read_timings,
    )
    from rigd.session.recovery import Recovery, holds_samples, recover
    from rigd.session.writer import SessionWriter

__all__ = [
    "SAMPLE_DTYPE",
    "SAMPLE_SIZE",
    "Event",
    "Recovery",
    "Session",
    "SessionError",
    "SessionExistsError",
    "SessionInfo",
    "SessionWriter",
    "Status",
    "check_beginning",
    "describe",
    "holds_samples",
    "read_controls",
    "read_session",
    "read_timings",
    "readable_texts",
    "recover",
]

_HOMES = {
    "format": ("SAMPLE_DTYPE", "SAMPLE_SIZE", "SessionError", "SessionExistsError", "Status"),
    "info": ("SessionInfo", "describe", "readable_texts"),
    "reader": (
        "Event",
        "Session",
        "check_beginning",
        "read_controls",
        "read_session",
        "read_timings",
    ),
    "recovery": ("Recovery", "holds_samples", "recover"),
    "writer": ("SessionWriter",),
}


def __getattr__(name: str) -> object:
    for module, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
