"""Errors of tables."""

from collections.abc import Sequence
from typing import Final

from rigd.printable import printable

_TITLES_SHOWN: Final = 12
_CELL_SHOWN: Final = 40


class TableError(Exception):
    """A text file is not a table of numbers; the message names the line and the remedy.

    Parameters
    ----------
    message : str
        Sentence without the file's name.
    cell : str
        Invalid text of the file, "" if none.
    """

    def __init__(self, message: str, cell: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.cell = cell

    def __str__(self) -> str:
        """Return the message with the invalid text of the file."""
        shown = f" ('{printable(self.cell, _CELL_SHOWN)}')" if self.cell else ""
        return self.message.replace("{cell}", shown)

    def unquoted(self) -> str:
        """Return the message without any text of the file."""
        return self.message.replace("{cell}", "")


class MissingColumnError(TableError):
    """The table has no column with that title.

    Parameters
    ----------
    name : str
        Missing title.
    titles : sequence of str
        Probable titles of the file.
    line : int
        Line of the titles, 0 if there are none.
    """

    def __init__(self, name: str, titles: Sequence[str], line: int) -> None:
        listed = ", ".join(repr(printable(each, 60)) for each in titles[:_TITLES_SHOWN])
        more = f" and {len(titles) - _TITLES_SHOWN} more" if len(titles) > _TITLES_SHOWN else ""
        where = f" (line {line})" if line else ""
        super().__init__(
            f"has no channel '{name}'; it has {listed}{more}{where}."
            if titles
            else f"has no channel '{name}', and no other either."
        )
        self.name = name

    def unquoted(self) -> str:
        """Return the message without the titles of the file."""
        return f"has no column '{self.name}'."
