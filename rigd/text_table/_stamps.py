"""Time stamps of a table: date and time of day, as seconds after the first of them."""

import re
from datetime import date
from typing import Final

_STAMP: Final = re.compile(
    r"(?:(?P<date>\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4})[ T_]+)?"
    r"(?P<hour>\d{1,2}):(?P<minute>[0-5]\d):(?P<second>[0-5]\d)(?:[.,:](?P<fraction>\d{1,12}))?"
    r"(?:\s*(?P<half>[AaPp])[.]?[Mm][.]?)?\s*(?:Z|[-+]\d\d:?\d\d)?",
    re.ASCII,
)
_DAY_S: Final = 86_400


def is_stamp(cell: str) -> bool:
    """Return whether a cell is a time with hours, minutes and seconds, with or without a date."""
    return _STAMP.fullmatch(cell.strip()) is not None


class StampReader:
    """Reader of the time stamps of one column, in seconds after the first one."""

    def __init__(self) -> None:
        self._first: re.Match[str] | None = None

    def __call__(self, cell: str) -> float:
        """Return the seconds from the first stamp to this one; NaN for an empty cell.

        Raises
        ------
        ValueError
            If the cell is not a time stamp, or is of another day with an ambiguous date.
        """
        text = cell.strip()
        if not text:
            return float("nan")
        stamp = _STAMP.fullmatch(text)
        if stamp is None:
            raise ValueError(text)
        first = self._first = self._first or stamp
        days = 0
        if stamp["date"] != first["date"]:
            days = _ordinal(stamp["date"]) - _ordinal(first["date"])
        seconds = days * _DAY_S + _of_day_s(stamp) - _of_day_s(first)
        return (seconds * 10**9 + _nanoseconds(stamp) - _nanoseconds(first)) / 1e9


def _of_day_s(stamp: re.Match[str]) -> int:
    hour = int(stamp["hour"])
    if stamp["half"]:
        hour = hour % 12 + 12 * (stamp["half"] in "Pp")
    return 3600 * hour + 60 * int(stamp["minute"]) + int(stamp["second"])


def _nanoseconds(stamp: re.Match[str]) -> int:
    return int(f"{stamp['fraction'] or '':0<9}"[:9])


def _ordinal(day: str | None) -> int:
    """Return the ordinal of an unambiguous date: year first, or day first with points."""
    parts = re.split(r"[-/.]", day or "")
    if len(parts) == 3 and len(parts[0]) == 4:
        return date(int(parts[0]), int(parts[1]), int(parts[2])).toordinal()
    if len(parts) == 3 and len(parts[2]) == 4 and "." in (day or ""):
        return date(int(parts[2]), int(parts[1]), int(parts[0])).toordinal()
    raise ValueError(day)
