"""Titles of columns: recognition of units in them, and of columns of times."""

import re
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

_BRACKETS_PATTERN: Final = re.compile(r"[\[(]([^\[\]()]*)[\])]")
"""Pattern of brackets with their content."""
_SQUARE_BRACKETS_AT_END_PATTERN: Final = re.compile(r"\[([^\[\]()]*)\]\s*$")
"""Pattern of square brackets with their content at the end of a title."""
_PRODUCT_SIGN_PATTERN: Final = re.compile(r"[\s.·⋅*-]")
"""Pattern of product signs and blanks in a unit."""
_UNIT_AFTER_SLASH_PATTERN: Final = re.compile(
    r"(?:[/,]|\b(?:in|units?|einheit)\b[\s:=]*)\s*([^\s/,]+)\s*$", re.IGNORECASE
)
"""Pattern of the last word of a title after a slash, a comma or the word "in" or "unit"."""

_TIME_TITLE_PATTERN: Final = re.compile(
    r"(?:time|times|zeit|temps|tiempo|tempo|x_value|timestamps?|"
    r"(?:rel\w*|abs\w*|elapsed|sample|sampling|measurement)[ _]time)"
    r"(?=$|[\s\[(/,:_])",
    re.IGNORECASE,
)
"""Pattern of the beginning of the title of a column of times, in several languages."""
_SYMBOL_OF_TIME_PATTERN: Final = re.compile(
    r"t(?:$|\s*[\[(]|(?:\s*[/,:_]\s*|\s+(?:in\s+)?)(?P<rest>\w+)\s*$)"
)
"""Pattern of a title that begins with the symbol t, such as ``t``, ``t [s]`` or ``t_ms``."""
_WORDS_AFTER_SYMBOL: Final = ("rel", "abs", "0")
"""Words other than units that may follow the symbol t in the title of a column of times."""
_MAX_DECREASING_FRACTION: Final = 0.1
"""Largest fraction of the steps of a column of times that may go back, as to another record."""

TIME_UNITS_S: Final = {
    "s": 1.0,
    "sec": 1.0,
    "secs": 1.0,
    "second": 1.0,
    "seconds": 1.0,
    "sekunden": 1.0,
    "ms": 1e-3,
    "msec": 1e-3,
    "millisecond": 1e-3,
    "milliseconds": 1e-3,
    "us": 1e-6,
    "usec": 1e-6,
    "microsecond": 1e-6,
    "microseconds": 1e-6,
    "ns": 1e-9,
    "nsec": 1e-9,
    "min": 60.0,
    "minutes": 60.0,
    "h": 3600.0,
}
"""Length in seconds of each unit of time, by spelling."""

_NON_TIME_UNITS: Final = (
    "rad", "mrad", "urad", "deg", "degree", "degrees", "radian", "radians", "arcmin", "arcsec",
    "rev", "grad", "°", "nm", "mnm", "unm", "ncm", "nmm", "knm", "newtonmeter", "newtonmetre",
    "lbfin", "ozfin", "mnmm", "unmm", "kgfm", "kgfcm", "kgcm", "gfcm", "lbfft", "ftlbf", "inlbf",
    "lbft", "ftlb", "lbin", "inlb", "ozin", "gon", "mgon",
    "n", "mn", "kn", "lbf", "v", "mv", "volt", "volts", "a", "ma", "amp", "mm",
    "m", "cm", "g", "kg", "hz", "khz", "rpm", "1/min", "%", "count", "counts", "digit", "digits",
    "m/s", "m/s²", "m/s^2", "m/s2", "rad/s", "rad/s²", "rad/s^2", "deg/s", "°/s", "°c", "degc",
    "k", "pa", "bar", "pu", "w",
)  # fmt: skip
"""Spellings of units that are not units of time, in lower case and without product signs."""


def stated_unit_of(title: str) -> str:
    """Return the unit in a title such as ``Angle [deg]`` or ``t/ms``; "" if there is none.

    Parameters
    ----------
    title : str
        Title of a column. Any text in square brackets at the end is a unit. Elsewhere in brackets,
        in parentheses, or after a slash, a comma or the word "in" or "unit", only known units are
        recognised.

    Examples
    --------
    >>> from rigd.text_table.titles import stated_unit_of
    >>> stated_unit_of("Angle [deg]"), stated_unit_of("t/ms"), stated_unit_of("Rig/Angle")
    ('deg', 'ms', '')
    """
    unit = unit_in_brackets(title)
    if unit:
        return unit
    word_match = _UNIT_AFTER_SLASH_PATTERN.search(title)
    if word_match and is_unit(word_match[1]):
        return word_match[1]
    last_brackets_match = _SQUARE_BRACKETS_AT_END_PATTERN.search(title)
    return last_brackets_match[1].strip() if last_brackets_match else ""


def unit_in_brackets(title: str) -> str:
    """Return the known unit in brackets in a title such as ``Angle [deg] CH1``; "" if none.

    If there are several units, return the one at the end, or else the first.
    """
    known_units = [
        (brackets[1].strip(), brackets.end())
        for brackets in _BRACKETS_PATTERN.finditer(title.rstrip())
        if is_unit(brackets[1])
    ]
    if not known_units:
        return ""
    last_unit, last_end = known_units[-1]
    return last_unit if last_end == len(title.rstrip()) else known_units[0][0]


def titles_by_units(text: str) -> list[str]:
    """Return the titles in a text such as ``Time [s] Shaft angle [deg]``, each up to its unit."""
    ends = [brackets.end() for brackets in _BRACKETS_PATTERN.finditer(text) if is_unit(brackets[1])]
    return [text[start:end].strip() for start, end in pairwise([0, *ends])]


def is_unit(cell: str) -> bool:
    """Return whether a cell contains a known unit, with or without brackets."""
    return (
        _plain_unit_spelling(cell) in TIME_UNITS_S or _plain_unit_spelling(cell) in _NON_TIME_UNITS
    )


def bare_unit(cell: str) -> str:
    """Return a unit without the brackets around it."""
    unit_text = cell.strip()
    return (
        unit_text[1:-1].strip()
        if unit_text[:1] + unit_text[-1:] in ("[]", "()", "<>")
        else unit_text
    )


def _plain_unit_spelling(cell: str) -> str:
    """Return a unit in lower case, without brackets and product signs."""
    return _PRODUCT_SIGN_PATTERN.sub(
        "", bare_unit(cell).lower().replace("µ", "u").replace("μ", "u")
    )


def is_title_of_times(title: str) -> bool:
    """Return whether a title is that of a column of times."""
    if _TIME_TITLE_PATTERN.match(title.strip()):
        return True
    symbol_match = _SYMBOL_OF_TIME_PATTERN.match(title.strip())
    if symbol_match is None:
        return False
    rest = symbol_match["rest"]
    return rest is None or rest in _WORDS_AFTER_SYMBOL or time_unit_s(rest) is not None


def is_unit_of_other_quantity(unit: str) -> bool:
    """Return whether a unit is known and is no unit of time."""
    return is_unit(unit) and time_unit_s(unit) is None


def are_times(values: npt.NDArray[np.float64]) -> bool:
    """Return whether the values of a column increase as times do, apart from a few steps."""
    steps = np.diff(values[np.isfinite(values)])
    return bool((steps > 0.0).any() and np.mean(steps < 0.0) < _MAX_DECREASING_FRACTION)


def time_unit_s(unit: str) -> float | None:
    """Return the length of a unit of time in seconds; None if the unit is unknown."""
    return TIME_UNITS_S.get(_plain_unit_spelling(unit))
