"""Time stamps in a table: date and time of day, as seconds since the first one."""

import re
from datetime import date
from typing import Final

_STAMP_PATTERN: Final = re.compile(
    r"(?:(?P<date>\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4})[ T_]+)?"
    r"(?P<hour>\d{1,2}):(?P<minute>[0-5]\d):(?P<second>[0-5]\d)(?:[.,:](?P<fraction>\d{1,12}))?"
    r"(?:\s*(?P<half>[AaPp])[.]?[Mm][.]?)?\s*(?:Z|[-+]\d\d:?\d\d)?",
    re.ASCII,
)
"""Pattern of a time stamp: optional date, hours, minutes and seconds."""
_SECONDS_PER_DAY: Final = 86_400
"""Number of seconds in a day."""


def is_stamp(cell: str) -> bool:
    """Return whether a cell is a time with hours, minutes and seconds, with or without a date."""
    return _STAMP_PATTERN.fullmatch(cell.strip()) is not None


class StampReader:
    """Reader of the time stamps in one column, in seconds since the column's first one."""

    def __init__(self) -> None:
        self._first_stamp: re.Match[str] | None = None

    def __call__(self, cell: str) -> float:
        """Return the seconds from the column's first stamp to this one; NaN for an empty cell.

        Raise `ValueError` if the cell is not a time stamp, or is of another day with an ambiguous
        date.
        """
        stamp_text = cell.strip()
        if not stamp_text:
            return float("nan")
        stamp = _STAMP_PATTERN.fullmatch(stamp_text)
        if stamp is None:
            raise ValueError(stamp_text)
        first_stamp = self._first_stamp = self._first_stamp or stamp
        day_difference = 0
        if stamp["date"] != first_stamp["date"]:
            day_difference = _day_number(stamp["date"]) - _day_number(first_stamp["date"])
        second_difference = (
            day_difference * _SECONDS_PER_DAY
            + _seconds_since_midnight(stamp)
            - _seconds_since_midnight(first_stamp)
        )
        return (
            second_difference * 10**9
            + _fraction_nanoseconds(stamp)
            - _fraction_nanoseconds(first_stamp)
        ) / 1e9


def _seconds_since_midnight(stamp: re.Match[str]) -> int:
    """Return the whole seconds of a time stamp since midnight."""
    hour_of_day = int(stamp["hour"])
    if stamp["half"]:
        hour_of_day = hour_of_day % 12 + 12 * (stamp["half"] in "Pp")
    return 3600 * hour_of_day + 60 * int(stamp["minute"]) + int(stamp["second"])


def _fraction_nanoseconds(stamp: re.Match[str]) -> int:
    """Return the fractional part of a time stamp's seconds, in nanoseconds."""
    return int(f"{stamp['fraction'] or '':0<9}"[:9])


def _day_number(date_text: str | None) -> int:
    """Return a date as a count of days; raise ValueError unless its format is unambiguous.

    Unambiguous are year, month, day, and with points also day, month, year.
    """
    date_parts = re.split(r"[-/.]", date_text or "")
    if len(date_parts) == 3 and len(date_parts[0]) == 4:
        return date(int(date_parts[0]), int(date_parts[1]), int(date_parts[2])).toordinal()
    if len(date_parts) == 3 and len(date_parts[2]) == 4 and "." in (date_text or ""):
        return date(int(date_parts[2]), int(date_parts[1]), int(date_parts[0])).toordinal()
    raise ValueError(date_text)
