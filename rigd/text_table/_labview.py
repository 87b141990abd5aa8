"""Head of a LabVIEW measurement file (.lvm): separator, and properties of each channel."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from math import isfinite
from typing import Final

from rigd.text_table._errors import TableError

COMMENT_TITLE: Final = "Comment"
"""Title of the last column, with comments."""
_FIRST_LINE_TEXT: Final = "LabVIEW Measurement"
"""Text at the beginning of a LabVIEW measurement file."""
_LAST_LINE_TEXT: Final = "***End_of_Header***"
"""Text at the beginning of the head's last line."""
_SEPARATORS_BY_NAME: Final = {"tab": "\t", "comma": ",", "semicolon": ";"}
"""Separators by their names in the head."""
_CHANNEL_KEYS: Final = ("Delta_X", "X0", "Y_Unit_Label", "X_Dimension", "Date", "Time")
"""Keys of the head with a value for each channel."""


@dataclass(frozen=True, slots=True)
class LabviewHead:
    """Head of a LabVIEW measurement file.

    Attributes
    ----------
    separator : str
        Character between the cells of the table.
    last_line : int
        Number of the head's last line, from 1.
    channels : mapping of str to tuple of str
        Values of each key, such as ``Delta_X``, with one value per column.
    """

    separator: str
    last_line: int
    channels: Mapping[str, tuple[str, ...]]

    def text(self, key: str, column: int) -> str:
        """Return the text that a key has for a column; "" if there is none."""
        cells = self.channels.get(key, ())
        return cells[column] if 0 < column < len(cells) else ""

    def number(self, key: str, column: int) -> float | None:
        """Return the number that a key has for a column; None if there is none."""
        try:
            return float(self.text(key, column).replace(",", "."))
        except ValueError:
            return None

    def start_ns(self, column: int) -> int | None:
        """Return the time of a column's first sample in ns since 1970; None if it is not stated."""
        offset_s = self.number("X0", column)
        if offset_s is None or not isfinite(offset_s):
            return None
        day, time = self.text("Date", column), self.text("Time", column).replace(",", ".")
        seconds, _, fraction = time.partition(".")
        try:
            start = datetime.strptime(f"{day} {seconds}", "%Y/%m/%d %H:%M:%S").replace(tzinfo=UTC)
            head_ns = int(start.timestamp()) * 10**9 + int(f"{fraction[:9]:0<9}")
        except ValueError:
            if day or time:
                return None
            head_ns = 0
        return head_ns + round(offset_s * 1e9)


def head_of(lines: Sequence[str]) -> LabviewHead | None:
    """Return the head of a LabVIEW measurement file; None if the text is not such a file.

    Raises
    ------
    TableError
        If the last line of the head is missing.
    """
    first_line = next((line for line in lines if line.strip()), "")
    if not first_line.lstrip('"').startswith(_FIRST_LINE_TEXT):
        return None
    end_lines = [
        number
        for number, line in enumerate(lines, 1)
        if line.strip('"').startswith(_LAST_LINE_TEXT)
    ]
    if not end_lines:
        raise TableError(
            f"is a LabVIEW file whose head has no line {_LAST_LINE_TEXT}; export it again."
        )
    separator = next((character for character in ("\t", ",", ";") if character in first_line), "\t")
    channels: dict[str, tuple[str, ...]] = {}
    for line in lines[: end_lines[-1] - 1]:
        key, *cells = (cell.strip().strip('"') for cell in line.rstrip("\r\n").split(separator))
        if key == "Separator" and cells:
            separator = _SEPARATORS_BY_NAME.get(cells[0].lower(), separator)
        elif key.startswith(_LAST_LINE_TEXT):
            channels.clear()  # earlier keys belong to the file and not to a channel
        elif key in _CHANNEL_KEYS:
            channels[key] = ("", *cells)
    return LabviewHead(separator, end_lines[-1], channels)
