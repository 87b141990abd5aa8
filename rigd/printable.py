"""What terminals show: text from outside made harmless, counts, progress with the time left."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from rich.progress import Progress

UNPRINTABLE: Final = "?"
"""Replacement of a character that cannot be printed."""

_FROM: Final = 10_000
"""Numbers of four digits are read without help."""

_BAR_STYLES: Final = {"bar.complete": "cyan", "bar.finished": "green", "bar.pulse": "cyan"}
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


def listed(parts: Sequence[str]) -> str:
    """Return the parts of a list as a sentence has them.

    Parameters
    ----------
    parts
        One at least.

    Examples
    --------
    >>> from rigd.printable import listed
    >>> print(listed(["alpha"]), listed(["1", "2", "3"]), sep="; ")
    alpha; 1, 2 and 3
    """
    *others, last = parts
    return f"{', '.join(others)} and {last}" if others else last


def counts_text(counts: Mapping[str, Any]) -> str:
    """Say how many samples of a session were recorded, and what became of the others.

    Parameters
    ----------
    counts
        ``recorded``, ``scheduled``, ``missed``, ``late``, ``lost``, ``stale_angles`` and
        ``stale_wrenches``, as numbers or as texts; of the last three only what occurred, or may
        have, is told. None: it is not known, as of a file that could not be read.

    Examples
    --------
    >>> from rigd.printable import counts_text
    >>> print(counts_text({"recorded": 11_998, "scheduled": 12_000, "missed": 2, "late": 5}))
    11 998 of 12 000 samples, 2 missed, 5 late
    """
    rare = ("lost", "stale_angles", "stale_wrenches")
    told = [
        f"{_count_text(counts['recorded'])} of {_count_text(counts['scheduled'])} samples",
        *(f"{_count_text(counts[name])} {name}" for name in ("missed", "late")),
        *(
            f"{_count_text(counts[name])} {name.replace('_', ' ')}"
            for name in rare
            if name in counts and (counts[name] is None or int(counts[name]))
        ),
    ]
    return ", ".join(told)


def _count_text(count: int | str | None) -> str:
    return "unknown" if count is None else grouped(int(count))


def progress_bar(*texts: str, auto_refresh: bool = True) -> "Progress":
    """Return a line of progress on standard error, which goes away when the work is done.

    It is shown on a terminal only. Its `console` writes messages above it.

    Parameters
    ----------
    *texts
        What stands between the bar and the time left, as rich formats the columns of a task.
    auto_refresh
        Let a thread of rich draw it, or draw it by its `refresh` only.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
    from rich.theme import Theme

    console = Console(stderr=True, highlight=False, theme=Theme(_BAR_STYLES))
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        *map(TextColumn, texts),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        auto_refresh=auto_refresh,
        disable=not console.is_terminal,
    )
