"""Text for terminals: safe display of texts from outside, counts, and progress lines."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from rich.progress import Progress

UNPRINTABLE: Final = "?"
"""Character that replaces one that cannot be printed."""

_MIN_GROUPED_NUMBER: Final = 10_000
"""Smallest number whose thousands are separated."""

_MAX_MESSAGE_LINES: Final = 40
"""Largest number of lines of a displayed message."""
_MAX_LINE_CHARACTERS: Final = 2000
"""Largest number of characters of a displayed line."""
_SHOWN_LINE_END_CHARACTERS: Final = 500
"""Number of characters at the end of a truncated line that are shown: they state the remedy."""

_BAR_STYLES: Final = {"bar.complete": "cyan", "bar.finished": "green", "bar.pulse": "cyan"}
"""Styles of a progress bar; the default red is reserved for alarms."""


def printable(text: str, max_characters: int | None = None) -> str:
    """Return a text in which characters that a terminal would interpret are replaced.

    Control characters, line breaks and all other unprintable characters are each replaced by
    :data:`UNPRINTABLE`.

    Parameters
    ----------
    text
        Text from a file, a device, or a path.
    max_characters
        Largest number of characters, or None for all; an ellipsis replaces the others.
    """
    shown_text = text[:max_characters]
    if not shown_text.isprintable():
        shown_text = "".join(c if c.isprintable() else UNPRINTABLE for c in shown_text)
    return shown_text if len(shown_text) == len(text) else f"{shown_text}…"


def readable_message(message: str) -> str:
    r"""Return an error message as safe text for a terminal, shortened to a readable length.

    Lines after the fortieth are only counted, and the middle of a line of more than 2000 characters
    is omitted.

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
    # A line break of a quotation and one of the message are indistinguishable and both harmless.
    message_lines = message.split("\n", _MAX_MESSAGE_LINES)
    shown_lines = [
        _readable_line(message_line) for message_line in message_lines[:_MAX_MESSAGE_LINES]
    ]
    if len(message_lines) > _MAX_MESSAGE_LINES:
        shown_lines.append(
            f"… and {count_with_separators(message_lines[-1].count(chr(10)) + 1)} more lines."
        )
    return "\n".join(shown_lines)


def _readable_line(line: str) -> str:
    """Return a line as safe text for a terminal, without the middle of a very long line."""
    if len(line) > _MAX_LINE_CHARACTERS:
        line = (
            f"{line[: _MAX_LINE_CHARACTERS - _SHOWN_LINE_END_CHARACTERS]} … "
            f"{line[-_SHOWN_LINE_END_CHARACTERS:]}"
        )
    return printable(line)


@contextlib.contextmanager
def readable_errors() -> Iterator[None]:
    """Make the message of a usage error in this context safe and short, whatever it quotes."""
    try:
        yield
    except Exception as error:
        # Typer's click is its own in some versions and the package of that name in others.
        if hasattr(error, "exit_code") and isinstance(getattr(error, "message", None), str):
            error.message = readable_message(error.message)  # type: ignore[attr-defined]
        raise


def count_with_separators(count: int) -> str:
    """Format a whole number with separated thousands.

    Examples
    --------
    >>> from rigd.printable import count_with_separators
    >>> print(count_with_separators(136000), count_with_separators(1200))
    136 000 1200
    """
    return f"{count:,}".replace(",", " ") if count >= _MIN_GROUPED_NUMBER else str(count)


def listed(texts: Sequence[str]) -> str:
    """Join texts with commas and a final "and".

    Parameters
    ----------
    texts
        At least one text.

    Examples
    --------
    >>> from rigd.printable import listed
    >>> print(listed(["alpha"]), listed(["1", "2", "3"]), sep="; ")
    alpha; 1, 2 and 3
    """
    *other_texts, last_text = texts
    return f"{', '.join(other_texts)} and {last_text}" if other_texts else last_text


def counts_text(counts: Mapping[str, Any]) -> str:
    """Format the numbers of recorded, missed, late and lost samples of a session.

    Parameters
    ----------
    counts
        ``recorded``, ``scheduled``, ``missed``, ``late``, ``lost``, ``stale_angles`` and
        ``stale_wrenches``, as numbers or as texts. The last three are reported only if they are not
        0. A count is None if it is unknown, as for a file that could not be read.

    Examples
    --------
    >>> from rigd.printable import counts_text
    >>> print(counts_text({"recorded": 11_998, "scheduled": 12_000, "missed": 2, "late": 5}))
    11 998 of 12 000 samples, 2 missed, 5 late
    """
    count_names_if_nonzero = ("lost", "stale_angles", "stale_wrenches")
    count_phrases = [
        f"{_count_text(counts['recorded'])} of {_count_text(counts['scheduled'])} samples",
        *(f"{_count_text(counts[count_name])} {count_name}" for count_name in ("missed", "late")),
        *(
            f"{_count_text(counts[count_name])} {count_name.replace('_', ' ')}"
            for count_name in count_names_if_nonzero
            if count_name in counts and (counts[count_name] is None or int(counts[count_name]))
        ),
    ]
    return ", ".join(count_phrases)


def _count_text(count: int | str | None) -> str:
    """Format a count, or return "unknown" for None."""
    return "unknown" if count is None else count_with_separators(int(count))


def progress_bar(*column_texts: str, auto_refresh: bool = True) -> "Progress":
    """Return a progress line on standard error, which is removed after the work.

    The line is shown on a terminal only. Its `console` writes messages above it.

    Parameters
    ----------
    *column_texts
        Texts between the bar and the remaining time, in the format of rich's task columns.
    auto_refresh
        Whether a thread of rich draws the line; otherwise only its `refresh` does.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
    from rich.theme import Theme

    console = Console(stderr=True, highlight=False, theme=Theme(_BAR_STYLES))
    # The remaining time follows from the steps of the last hour: one may take minutes.
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        *map(TextColumn, column_texts),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        auto_refresh=auto_refresh,
        speed_estimate_period=3600.0,
        disable=not console.is_terminal,
    )
