"""Errors for text files that are not the requested table."""

from collections.abc import Sequence
from typing import Final

from rigd.printable import printable

_MAX_TITLES_SHOWN: Final = 12
"""Largest number of titles in a message."""
_MAX_CELL_CHARACTERS_SHOWN: Final = 40
"""Largest number of characters of a cell in a message."""


class TableError(Exception):
    """Error: a text file is not a table of numbers. The message names the line and the remedy.

    Parameters
    ----------
    message : str
        Sentence without the name of the file, in which ``{cell}`` is replaced by the invalid text.
    cell : str
        Invalid text in the file; empty if there is none.
    """

    def __init__(self, message: str, cell: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.cell = cell

    def __str__(self) -> str:
        """Return the message with the invalid text from the file."""
        cell_text = f" ('{printable(self.cell, _MAX_CELL_CHARACTERS_SHOWN)}')" if self.cell else ""
        return self.message.replace("{cell}", cell_text)

    def unquoted_message(self) -> str:
        """Return the message without any text from the file."""
        return self.message.replace("{cell}", "")


class MissingColumnError(TableError):
    """Error: the table has no column with a requested title.

    Parameters
    ----------
    requested_title : str
        Requested title that is missing.
    titles : sequence of str
        Titles in the most probable line of titles.
    line_number : int
        Number of this line; 0 if there is none.
    """

    def __init__(self, requested_title: str, titles: Sequence[str], line_number: int) -> None:
        listed_titles_text = ", ".join(
            repr(printable(title, 60)) for title in titles[:_MAX_TITLES_SHOWN]
        )
        more_titles_text = (
            f" and {len(titles) - _MAX_TITLES_SHOWN} more"
            if len(titles) > _MAX_TITLES_SHOWN
            else ""
        )
        line_text = f" (line {line_number})" if line_number else ""
        super().__init__(
            f"has no channel '{requested_title}'; it has "
            f"{listed_titles_text}{more_titles_text}{line_text}."
            if titles
            else f"has no channel '{requested_title}', and no other either."
        )
        self.requested_title = requested_title

    def unquoted_message(self) -> str:
        """Return the message without the titles of the file."""
        return f"has no column '{self.requested_title}'."
