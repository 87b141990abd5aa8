"""Titles of columns: their units, and the recognition of columns of times."""

import re
from typing import Final

_IN_BRACKETS: Final = re.compile(r"[\[(]([^\[\]()]*)[\])]\s*$")
_PRODUCT: Final = re.compile(r"[\s.·⋅*-]")
_AFTER_SLASH: Final = re.compile(r"(?:[/,]|\bin\b)\s*([^\s/,]+)\s*$")

_TIME_TITLE: Final = re.compile(
    r"(?:t|time|times|zeit|temps|tiempo|tempo|x_value|timestamps?|"
    r"(?:rel\w*|abs\w*|elapsed|sample|sampling|measurement)[ _]time)"
    r"(?=$|[\s\[(/,:_])",
    re.IGNORECASE,
)

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
"""Spellings of units of time, in seconds."""

_OTHER_UNITS: Final = (
    "rad", "mrad", "urad", "deg", "degree", "degrees", "radian", "radians", "arcmin", "arcsec",
    "rev", "grad", "°", "nm", "mnm", "unm", "ncm", "nmm", "knm", "newtonmeter", "newtonmetre",
    "lbfin", "ozfin", "n", "mn", "kn", "lbf", "v", "mv", "volt", "volts", "a", "ma", "amp", "mm",
    "m", "cm", "g", "kg", "hz", "khz", "rpm", "1/min", "%", "count", "counts", "digit", "digits",
    "m/s", "m/s²", "m/s^2", "m/s2", "rad/s", "rad/s²", "rad/s^2", "deg/s", "°/s", "°c", "degc",
    "k", "pa", "bar", "pu", "w",
)  # fmt: skip
"""Other units, in lower case and without product signs."""


def stated_unit_of(title: str) -> str:
    """Return the unit in a title such as ``Angle [deg]`` or ``t/ms``, "" if there is none.

    Parameters
    ----------
    title : str
        Title of a column. Any text in square brackets is a unit. In parentheses, or after a slash,
        a comma or the word "in", only known units count.

    Examples
    --------
    >>> from rigd.text_table.titles import stated_unit_of
    >>> stated_unit_of("Angle [deg]"), stated_unit_of("t/ms"), stated_unit_of("Rig/Angle")
    ('deg', 'ms', '')
    """
    found = _IN_BRACKETS.search(title) or _AFTER_SLASH.search(title)
    if found is None:
        return ""
    is_stated = is_unit(found[1]) or found[0].startswith("[")
    return found[1].strip() if is_stated else ""


def is_unit(cell: str) -> bool:
    """Return whether a cell is a known unit, with or without brackets."""
    return _plain_unit(cell) in TIME_UNITS_S or _plain_unit(cell) in _OTHER_UNITS


def bare_unit(cell: str) -> str:
    """Return a unit without the brackets around it."""
    text = cell.strip()
    return text[1:-1].strip() if text[:1] + text[-1:] in ("[]", "()", "<>") else text


def _plain_unit(cell: str) -> str:
    return _PRODUCT.sub("", bare_unit(cell).lower().replace("µ", "u").replace("μ", "u"))


def is_title_of_times(title: str) -> bool:
    """Return whether a title is that of a column of times."""
    return _TIME_TITLE.match(title.strip()) is not None


def time_unit_s(unit: str) -> float | None:
    """Return a unit of time in seconds, None if it is unknown."""
    return TIME_UNITS_S.get(_plain_unit(unit))
