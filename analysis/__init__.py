"""Offline analyser of session files: frequency response and fractional damping models.

It also offers `load`, `frf`, `fit`, `select` and `campaign` of `analysis.api` for scripts and
notebooks.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from analysis.api import campaign, fit, frf, load, select

__all__ = ["campaign", "fit", "frf", "load", "select"]


def __getattr__(name: str) -> object:
    # Late, so that a command that needs none of it starts at once.
    if name in __all__:
        from analysis import api

        return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
