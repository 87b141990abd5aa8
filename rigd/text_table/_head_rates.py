"""Sampling rate in the lines above a table: ``Sampling rate: 500 Hz`` or ``Delta: 2 ms``."""

import re
from collections.abc import Iterable
from typing import Final

from rigd.text_table.titles import time_unit_s

_POSITIVE_NUMBER_PATTERN: Final = r"(?P<number>\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?)"
"""Pattern of a positive number with a decimal point or comma."""
_RATE_PATTERN: Final = re.compile(
    r"\b(?:sampl\w*|scan|acquisition|abtast\w*?|mess)[ _-]*(?:rate|freq\w*|frequenz)\b"
    rf"[^\d\w]*(?:[\[(]?(?P<before>k?Hz)[\])]?)?[^\d\w]*{_POSITIVE_NUMBER_PATTERN}\s*(?P<behind>k?Hz\b)?",
    re.IGNORECASE,
)
"""Pattern of a stated sampling rate, in English or German."""
_PERIOD_PATTERN: Final = re.compile(
    r"\b(?:delta(?:[ _-]?[tx])?|dt|interval|(?:sampl\w*|scan|abtast\w*?)[ _-]*"
    r"(?:interval\w*|period|time|zeit))\b"
    rf"[^\d\w]*(?:[\[(]?(?P<before>[mµuμn]?s(?:ec)?)[\])]?)?[^\d\w]*{_POSITIVE_NUMBER_PATTERN}"
    r"\s*(?P<behind>[mµuμn]?s(?:ec\w*)?\b)?",
    re.IGNORECASE,
)
"""Pattern of a stated sampling period, in English or German."""


def stated_rate_hz(head_lines: Iterable[str]) -> float | None:
    """Return the sampling rate in Hz that a line above the table states; None if none does.

    A rate without a unit is in Hz.
    """
    for head_line in head_lines:
        rate_match = _RATE_PATTERN.search(head_line)
        if rate_match:
            unit_name = (rate_match["before"] or rate_match["behind"] or "Hz").lower()
            return _plausible_quantity(rate_match["number"], 1e3 if unit_name == "khz" else 1.0)
        period_match = _PERIOD_PATTERN.search(head_line)
        unit_s = (
            time_unit_s(period_match["before"] or period_match["behind"] or "")
            if period_match
            else None
        )
        if period_match and unit_s:
            period_s = _plausible_quantity(period_match["number"], unit_s)
            return 1 / period_s if period_s else None
    return None


def _plausible_quantity(number_text: str, unit_factor: float) -> float | None:
    """Return the number in a text multiplied by its unit; None if the product is not plausible."""
    product = float(number_text.replace(",", ".")) * unit_factor
    return product if 0.0 < product < 1e12 else None
