"""Head of a LabVIEW measurement file (.lvm): separator, rate, start and unit of each channel."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from math import isfinite
from typing import Final

from rigd.text_table._errors import TableError

COMMENT: Final = "Comment"
_BEGIN: Final = "LabVIEW Measurement"
_END: Final = "***End_of_Header***"
_SEPARATORS: Final = {"tab": "\t", "comma": ",", "semicolon": ";"}
_OF_CHANNELS: Final = ("Delta_X", "X0", "Y_Unit_Label", "X_Dimension", "Date", "Time")


@dataclass(frozen=True, slots=True)
class LabviewHead:
    """Head of a LabVIEW measurement file.

    Attributes
    ----------
    separator : str
    last_line : int
        Number of the last line of the head.
    channels : mapping of str to tuple of str
        Key such as ``Delta_X`` → its cell for each column.
    """

    separator: str
    last_line: int
    channels: Mapping[str, tuple[str, ...]]

    def text(self, key: str, column: int) -> str:
        """Return the text of a key of the head for a column, "" if none."""
        cells = self.channels.get(key, ())
        return cells[column] if 0 < column < len(cells) else ""

    def number(self, key: str, column: int) -> float | None:
        """Return the number of a key of the head for a column, None if none."""
        try:
            return float(self.text(key, column).replace(",", "."))
        except ValueError:
            return None

    def start_ns(self, column: int) -> int | None:
        """Return the time of a column's first sample, ns since 1970, None if it is not stated."""
        first_s = self.number("X0", column)
        if first_s is None or not isfinite(first_s):
            return None
        day, time = self.text("Date", column), self.text("Time", column).replace(",", ".")
        seconds, _, fraction = time.partition(".")
        try:
            begun = datetime.strptime(f"{day} {seconds}", "%Y/%m/%d %H:%M:%S").replace(tzinfo=UTC)
            begun_ns = int(begun.timestamp()) * 10**9 + int(f"{fraction[:9]:0<9}")
        except ValueError:
            if day or time:
                return None
            begun_ns = 0
        return begun_ns + round(first_s * 1e9)


def head_of(lines: Sequence[str]) -> LabviewHead | None:
    """Return the head of a text, None if it is not a LabVIEW measurement file.

    Raises
    ------
    TableError
        If the head has no end.
    """
    first = next((line for line in lines if line.strip()), "")
    if not first.lstrip('"').startswith(_BEGIN):
        return None
    ends = [number for number, line in enumerate(lines, 1) if line.strip('"').startswith(_END)]
    if not ends:
        raise TableError(f"is a LabVIEW file whose head has no line {_END}; export it again.")
    mark = next((each for each in ("\t", ",", ";") if each in first), "\t")
    channels: dict[str, tuple[str, ...]] = {}
    for line in lines[: ends[-1] - 1]:
        key, *cells = (cell.strip().strip('"') for cell in line.rstrip("\r\n").split(mark))
        if key == "Separator" and cells:
            mark = _SEPARATORS.get(cells[0].lower(), mark)
        elif key.startswith(_END):
            channels.clear()  # earlier keys belong to the file and not to a channel
        elif key in _OF_CHANNELS:
            channels[key] = ("", *cells)
    return LabviewHead(mark, ends[-1], channels)
