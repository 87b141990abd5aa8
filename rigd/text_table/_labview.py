"""Head of a LabVIEW measurement file (.lvm): separator, and properties of each channel."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from math import isfinite
from typing import Final

from rigd.text_table._errors import TableError

COMMENT_COLUMN_TITLE: Final = "Comment"
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
    last_line_number : int
        Number of the head's last line, from 1.
    values_by_key : mapping of str to tuple of str
        Values of each key, such as ``Delta_X``, with one value per column.
    """

    separator: str
    last_line_number: int
    values_by_key: Mapping[str, tuple[str, ...]]

    def head_text(self, head_key: str, column_index: int) -> str:
        """Return the text that the head states for a column under a key; "" if there is none."""
        key_cells = self.values_by_key.get(head_key, ())
        return key_cells[column_index] if 0 < column_index < len(key_cells) else ""

    def head_number(self, head_key: str, column_index: int) -> float | None:
        """Return the number that the head states for a column under a key, or None."""
        try:
            return float(self.head_text(head_key, column_index).replace(",", "."))
        except ValueError:
            return None

    def start_ns(self, column_index: int) -> int | None:
        """Return the time of a column's first sample in ns since 1970; None if it is not stated."""
        offset_s = self.head_number("X0", column_index)
        if offset_s is None or not isfinite(offset_s):
            return None
        day, time_text = (
            self.head_text("Date", column_index),
            self.head_text("Time", column_index).replace(",", "."),
        )
        seconds_text, _, fraction_text = time_text.partition(".")
        try:
            start_time = datetime.strptime(f"{day} {seconds_text}", "%Y/%m/%d %H:%M:%S").replace(
                tzinfo=UTC
            )
            head_start_ns = int(start_time.timestamp()) * 10**9 + int(f"{fraction_text[:9]:0<9}")
        except ValueError:
            if day or time_text:
                return None
            head_start_ns = 0
        return head_start_ns + round(offset_s * 1e9)


def parse_labview_head(text_lines: Sequence[str]) -> LabviewHead | None:
    """Return the header of a LabVIEW measurement file; None if the text is not such a file.

    Raise `TableError` if the last line of the header is missing.
    """
    first_line = next((text_line for text_line in text_lines if text_line.strip()), "")
    if not first_line.lstrip('"').startswith(_FIRST_LINE_TEXT):
        return None
    end_line_numbers = [
        line_number
        for line_number, text_line in enumerate(text_lines, 1)
        if text_line.strip('"').startswith(_LAST_LINE_TEXT)
    ]
    if not end_line_numbers:
        raise TableError(
            f"is a LabVIEW file whose header has no line {_LAST_LINE_TEXT}; export it again."
        )
    separator = next(
        (
            separator_character
            for separator_character in ("\t", ",", ";")
            if separator_character in first_line
        ),
        "\t",
    )
    values_by_key: dict[str, tuple[str, ...]] = {}
    for text_line in text_lines[: end_line_numbers[-1] - 1]:
        key, *line_cells = (
            cell.strip().strip('"') for cell in text_line.rstrip("\r\n").split(separator)
        )
        if key == "Separator" and line_cells:
            separator = _SEPARATORS_BY_NAME.get(line_cells[0].lower(), separator)
        elif key.startswith(_LAST_LINE_TEXT):
            values_by_key.clear()  # earlier keys belong to the file and not to a channel
        elif key in _CHANNEL_KEYS:
            values_by_key[key] = ("", *line_cells)
    return LabviewHead(separator, end_line_numbers[-1], values_by_key)
