"""What terminals show: text from outside made harmless, counts, progress with the time left."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from rich.progress import Progress

UNPRINTABLE: Final = "?"
"""Replacement of a character that cannot be printed."""

_FROM: Final = 10_000
"""Numbers of four digits are read without help."""

_MOST_LINES: Final = 40
_LONGEST_LINE: Final = 2000
_LINE_ENDING: Final = 500
"""Characters of its end that a line which is cut keeps: the remedy is there."""

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


def readable_message(message: str) -> str:
    r"""Return an error message of harmless text and readable length, whatever it quotes.

    Lines beyond the fortieth are counted, and the middle of a line of more than 2000 characters is
    left out.

    Parameters
    ----------
    message
        Lines of text, each with its remedy at the end.

    Examples
    --------
    >>> from rigd.printable import readable_message
    >>> print(readable_message("a.toml: x = \x1b[2J is unknown."))
    a.toml: x = ?[2J is unknown.
    """
    # An end of line in a quotation is not told from one of the message; either is harmless.
    lines = message.split("\n", _MOST_LINES)
    shown = [_readable_line(line) for line in lines[:_MOST_LINES]]
    if len(lines) > _MOST_LINES:
        shown.append(f"… and {grouped(lines[-1].count(chr(10)) + 1)} more lines.")
    return "\n".join(shown)


def _readable_line(line: str) -> str:
    if len(line) > _LONGEST_LINE:
        line = f"{line[: _LONGEST_LINE - _LINE_ENDING]} … {line[-_LINE_ENDING:]}"
    return printable(line)


@contextlib.contextmanager
def readable_errors() -> Iterator[None]:
    """Make the message of a command line's usage error readable, whatever value it quotes."""
    try:
        yield
    except Exception as error:
        # Typer's click is its own in some versions and the package of that name in others.
        if hasattr(error, "exit_code") and isinstance(getattr(error, "message", None), str):
            error.message = readable_message(error.message)  # type: ignore[attr-defined]
        raise


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
    counted = [
        f"{_count_text(counts['recorded'])} of {_count_text(counts['scheduled'])} samples",
        *(f"{_count_text(counts[name])} {name}" for name in ("missed", "late")),
        *(
            f"{_count_text(counts[name])} {name.replace('_', ' ')}"
            for name in rare
            if name in counts and (counts[name] is None or int(counts[name]))
        ),
    ]
    return ", ".join(counted)


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
