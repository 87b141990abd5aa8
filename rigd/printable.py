"""Printable text: what comes from outside, made fit for a terminal and for a message."""

from types import MappingProxyType
from typing import Final

UNPRINTABLE: Final = "?"
"""Replacement of a character that cannot be printed."""

_FROM: Final = 10_000
"""Numbers of four digits are read without help."""

BAR_STYLES: Final = MappingProxyType(
    {"bar.complete": "cyan", "bar.finished": "green", "bar.pulse": "cyan"}
)
"""Theme of rich for a progress bar: its own is red, which on a rig is for alarms."""


def printable(text: str, most: int | None = None) -> str:
    """Return a text as a message can show it, whatever somebody has put into it.

    Control characters, which a terminal obeys, ends of lines and everything else that has no shape
    of its own are each replaced by :data:`UNPRINTABLE`.

    Parameters
    ----------
    text
        Text from a file, a device, or a path.
    most
        Characters of it that are shown; an ellipsis stands for the rest. All if it is not given.
    """
    shown = text[:most]
    if not shown.isprintable():
        shown = "".join(c if c.isprintable() else UNPRINTABLE for c in shown)
    return shown if len(shown) == len(text) else f"{shown}…"


def grouped(count: int) -> str:
    """Return a whole number with its thousands set apart.

    Examples
    --------
    >>> from rigd.printable import grouped
    >>> print(grouped(136000), grouped(1200))
    136 000 1200
    """
    return f"{count:,}".replace(",", " ") if count >= _FROM else str(count)
