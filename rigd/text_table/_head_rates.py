"""Sampling rate in the lines above a table: ``Sampling rate: 500 Hz`` or ``Delta: 2 ms``."""

import re
from collections.abc import Iterable, Mapping
from typing import Final

from rigd.text_table.titles import TIME_UNITS_S, bare_unit

_RATE_PATTERN: Final = re.compile(
    r"\b(?:sampl\w*|scan|acquisition|abtast\w*?|mess)[ _-]*(?:rate|freq\w*|frequenz)\b(?P<rest>.*)",
    re.IGNORECASE,
)
"""Pattern of a stated sampling rate, in English or German."""
_PERIOD_PATTERN: Final = re.compile(
    r"(?:\b(?:delta(?:[ _-]?[tx])?|dt|(?:sampl\w*|scan|time|abtast\w*?)[ _-]*"
    r"(?:interval\w*|period|time|zeit))|^\W*interval)\b(?P<rest>.*)",
    re.IGNORECASE,
)
"""Pattern of a stated sampling period, in English or German."""
_QUANTITY_PATTERN: Final = re.compile(
    r"[^\d\w\[(]*(?:(?P<before>[\[(][^\])]+[\])]|[^\W\d]+)(?=\W))?[^\d\w]*"
    r"(?P<number>\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?)"
    r"[\s,;:|\"]*(?P<behind>[\[(]?(?:[^\W\d]|1/)[^\"\[\](),;|]*[\])]?)?[\s,;|\".]*"
)
"""Pattern of a number with its unit before or behind it, which is all of the text."""
_MAX_QUANTITY_CHARACTERS: Final = 100
"""Largest number of characters of a quantity, which bounds the time of the search."""
_MAYBE_THOUSANDS_PATTERN: Final = re.compile(r"[1-9]\d{0,2}[.,]\d{3}")
"""Pattern of a number whose sign may separate thousands or decimals, as in 1,000."""

_RATE_UNITS_HZ: Final[Mapping[str, float]] = {
    "": 1.0, "hz": 1.0, "hertz": 1.0, "khz": 1e3,
    "1/s": 1.0, "s/s": 1.0, "sa/s": 1.0, "sps": 1.0, "samples/s": 1.0, "samples/sec": 1.0,
    "samples/second": 1.0, "samples per second": 1.0, "ks/s": 1e3, "ksa/s": 1e3, "ksps": 1e3,
    "1/min": 1 / 60, "samples/min": 1 / 60, "samples per minute": 1 / 60,
}  # fmt: skip
"""Size in Hz of each unit of a rate, by spelling in lower case; a rate without a unit is in Hz."""


def stated_rate_hz(head_lines: Iterable[str]) -> float | None:
    """Return the sampling rate in Hz that a line above the table states; None if none does.

    A line counts only if all of its text behind the name of the quantity is a number with a known
    unit.
    """
    for head_line in head_lines:
        rate_match = _RATE_PATTERN.search(head_line)
        if rate_match:
            rate_hz = _quantity(rate_match["rest"], _RATE_UNITS_HZ)
            if rate_hz:
                return rate_hz
            continue
        period_match = _PERIOD_PATTERN.search(head_line)
        period_s = _quantity(period_match["rest"], TIME_UNITS_S) if period_match else None
        if period_s:
            return 1 / period_s
    return None


def _quantity(text: str, unit_sizes: Mapping[str, float]) -> float | None:
    """Return the number in a text multiplied by its unit; None unless all of it is understood."""
    quantity_text = text.strip(' \t\r\n;,|"')
    if len(quantity_text) > _MAX_QUANTITY_CHARACTERS:
        return None
    quantity_match = _QUANTITY_PATTERN.fullmatch(quantity_text)
    if quantity_match is None or _MAYBE_THOUSANDS_PATTERN.fullmatch(quantity_match["number"]):
        return None
    unit_names = {
        bare_unit(unit_text).strip(" .").lower().replace("µ", "u").replace("μ", "u")
        for unit_text in (quantity_match["before"], quantity_match["behind"])
        if unit_text
    }
    unit_size = unit_sizes.get(unit_names.pop() if unit_names else "")
    if unit_size is None or unit_names:
        return None
    product = float(quantity_match["number"].replace(",", ".")) * unit_size
    return product if 0.0 < product < 1e12 else None
