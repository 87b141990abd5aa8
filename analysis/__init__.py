"""Offline analyser of session files: frequency response and fractional damping models.

For scripts and notebooks, it provides `load`, `frf`, `fit`, `select` and `campaign` of
`analysis.api`.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analysis.api import campaign, fit, frf, load, select

__all__ = ["campaign", "fit", "frf", "load", "select"]


def __getattr__(name: str) -> object:
    # The import is deferred, so that a command that does not need it starts at once.
    if name in __all__:
        from analysis import api

        return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
