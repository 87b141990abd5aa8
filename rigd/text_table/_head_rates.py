"""Sampling rate in the lines above a table, such as ``Sampling rate: 500 Hz``, ``Delta: 2 ms``."""

import re
from collections.abc import Iterable
from typing import Final

from rigd.text_table.titles import time_unit_s

_NUMBER: Final = r"(?P<number>\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?)"
_RATE: Final = re.compile(
    r"\b(?:sampl\w*|scan|acquisition|abtast\w*?|mess)[ _-]*(?:rate|freq\w*|frequenz)\b"
    rf"[^\d\w]*(?:[\[(]?(?P<before>k?Hz)[\])]?)?[^\d\w]*{_NUMBER}\s*(?P<behind>k?Hz\b)?",
    re.IGNORECASE,
)
_PERIOD: Final = re.compile(
    r"\b(?:delta(?:[ _-]?[tx])?|dt|interval|(?:sampl\w*|scan|abtast\w*?)[ _-]*"
    r"(?:interval\w*|period|time|zeit))\b"
    rf"[^\d\w]*(?:[\[(]?(?P<before>[mµuμn]?s(?:ec)?)[\])]?)?[^\d\w]*{_NUMBER}"
    r"\s*(?P<behind>[mµuμn]?s(?:ec\w*)?\b)?",
    re.IGNORECASE,
)


def stated_rate_hz(lines: Iterable[str]) -> float | None:
    """Return the rate in a line of the head, None if there is none; the default unit is Hz."""
    for line in lines:
        rate = _RATE.search(line)
        if rate:
            unit = (rate["before"] or rate["behind"] or "Hz").lower()
            return _positive(rate["number"], 1e3 if unit == "khz" else 1.0)
        period = _PERIOD.search(line)
        size_s = time_unit_s(period["before"] or period["behind"] or "") if period else None
        if period and size_s:
            found = _positive(period["number"], size_s)
            return 1 / found if found else None
    return None


def _positive(number: str, size: float) -> float | None:
    value = float(number.replace(",", ".")) * size
    return value if 0.0 < value < 1e12 else None
