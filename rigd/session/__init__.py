"""Session files: format, writer, reader.

The names below are imported on first use, so that the control process, which needs the message
layout only (:mod:`rigd.session.format`), does not pay for the container.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rigd.session.errors import SessionError, SessionExistsError
    from rigd.session.writer import SessionWriter

__all__ = ["SessionError", "SessionExistsError", "SessionWriter"]

_HOMES = {
    "SessionError": "errors",
    "SessionExistsError": "errors",
    "SessionWriter": "writer",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
