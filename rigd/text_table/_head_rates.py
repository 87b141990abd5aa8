"""Sampling rate in the lines above a table: ``Sampling rate: 500 Hz`` or ``Delta: 2 ms``."""

import re
from collections.abc import Iterable
from typing import Final

from rigd.text_table.titles import time_unit_s

_NUMBER_PATTERN: Final = r"(?P<number>\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?)"
"""Pattern of a positive number with a decimal point or comma."""
_RATE_PATTERN: Final = re.compile(
    r"\b(?:sampl\w*|scan|acquisition|abtast\w*?|mess)[ _-]*(?:rate|freq\w*|frequenz)\b"
    rf"[^\d\w]*(?:[\[(]?(?P<before>k?Hz)[\])]?)?[^\d\w]*{_NUMBER_PATTERN}\s*(?P<behind>k?Hz\b)?",
    re.IGNORECASE,
)
"""Pattern of a stated sampling rate, in English or German."""
_PERIOD_PATTERN: Final = re.compile(
    r"\b(?:delta(?:[ _-]?[tx])?|dt|interval|(?:sampl\w*|scan|abtast\w*?)[ _-]*"
    r"(?:interval\w*|period|time|zeit))\b"
    rf"[^\d\w]*(?:[\[(]?(?P<before>[mµuμn]?s(?:ec)?)[\])]?)?[^\d\w]*{_NUMBER_PATTERN}"
    r"\s*(?P<behind>[mµuμn]?s(?:ec\w*)?\b)?",
    re.IGNORECASE,
)
"""Pattern of a stated sampling period, in English or German."""


def stated_rate_hz(lines: Iterable[str]) -> float | None:
    """Return the sampling rate that a line states; None if none does. The default unit is Hz."""
    for line in lines:
        rate = _RATE_PATTERN.search(line)
        if rate:
            unit = (rate["before"] or rate["behind"] or "Hz").lower()
            return _plausible_product(rate["number"], 1e3 if unit == "khz" else 1.0)
        period = _PERIOD_PATTERN.search(line)
        unit_s = time_unit_s(period["before"] or period["behind"] or "") if period else None
        if period and unit_s:
            period_s = _plausible_product(period["number"], unit_s)
            return 1 / period_s if period_s else None
    return None


def _plausible_product(number: str, unit: float) -> float | None:
    """Return a number times its unit; None if the product is not plausible."""
    value = float(number.replace(",", ".")) * unit
    return value if 0.0 < value < 1e12 else None
