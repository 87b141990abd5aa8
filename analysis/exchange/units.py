"""Units of imported channels: what may be stated, and its size in the session file's unit."""

from __future__ import annotations

import math
import re
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from analysis.exchange.errors import ExchangeError

if TYPE_CHECKING:
    from collections.abc import Mapping

_INCH_M: Final = 0.0254
_POUND_N: Final = 4.4482216152605

UNITS: Final[Mapping[str, Mapping[str, float]]] = MappingProxyType(
    {
        "angle": {
            "rad": 1.0,
            "mrad": 1e-3,
            "urad": 1e-6,
            "deg": math.pi / 180,
            "arcmin": math.pi / 10_800,
            "arcsec": math.pi / 648_000,
            "rev": 2 * math.pi,
        },
        "torque": {
            "N.m": 1.0,
            "mN.m": 1e-3,
            "uN.m": 1e-6,
            "N.cm": 1e-2,
            "N.mm": 1e-3,
            "kN.m": 1e3,
            "lbf.in": _POUND_N * _INCH_M,
            "ozf.in": _POUND_N * _INCH_M / 16,
        },
        "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3, "lbf": _POUND_N},
        "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    }
)
"""Quantity → unit → how many rad, N·m, N or s it is."""

_NAME_SUFFIXES: Final = {
    "rad": "rad",
    "mrad": "mrad",
    "deg": "deg",
    "nm": "N.m",  # as in the fields of a session file
    "mnm": "mN.m",
    "n": "N",
    "s": "s",
    "ms": "ms",
    "us": "us",
}
"""Last word of a channel's name → the unit it means."""

_NUMBER: Final = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?(?=\s*[^\s\d.])")
_IN_BRACKETS: Final = re.compile(r"[\[(]([^\[\]()]*)[\])]\s*$")


def canonical_unit(text: str) -> str | None:
    """Return the table's spelling of a unit (``Nm``, ``N·m`` and ``N*m`` are ``N.m``), or None.

    Capitals matter: ``mN.m`` is a thousandth of a newton metre and ``nm`` no torque at all.
    """
    return _SPELLINGS.get(_bare(text))


def factor(quantity: str, unit: str) -> float:
    """Size of a unit in rad, N·m, N or s.

    Parameters
    ----------
    quantity : {"angle", "torque", "force", "time"}
    unit : str
        In any spelling that `canonical_unit` knows, with a number before it or not: ``0.02 N.m``
        is what one volt of a sensor's signal stands for.

    Raises
    ------
    ExchangeError
        If it is no unit of that quantity, or the number is not finite or 0.
    """
    size, name = _scaled(unit)
    known = canonical_unit(name)
    if known is None or known not in UNITS[quantity] or not math.isfinite(size) or size == 0.0:
        base = next(iter(UNITS[quantity]))
        raise ExchangeError(
            f"'{unit}' is not a unit of {quantity} that is known here; choose from "
            f"{', '.join(UNITS[quantity])}. Of a signal in volts, counts or the like, state what "
            f"one of them stands for, as a number and a unit: CHANNEL:0.02 {base}."
        )
    return size * UNITS[quantity][known]


def stated_unit(unit: str) -> str:
    """Spell a unit as the table does, with its number if it has one other than 1."""
    size, name = _scaled(unit)
    known = canonical_unit(name) or name
    return known if size == 1.0 else f"{size!r} {known}"


def _scaled(unit: str) -> tuple[float, str]:
    """Take a number and a unit apart, ``0.02 N.m``; 1 where there is no number."""
    found = _NUMBER.match(unit.strip())
    return (float(found[0]), unit.strip()[found.end() :]) if found else (1.0, unit)


def unit_in_brackets(name: str) -> str | None:
    """Return the unit in brackets behind a name, as in ``Angle [deg]`` or ``Tz (mN.m)``."""
    found = _IN_BRACKETS.search(name)
    return canonical_unit(found[1]) if found else None


def unit_in_suffix(name: str) -> str | None:
    """Return the unit that the last word of a name suggests, as in ``angle_rad``, or None."""
    _, underscore, last = name.strip().rpartition("_")
    return _NAME_SUFFIXES.get(last) if underscore else None


def _bare(text: str) -> str:
    return re.sub(
        r"[\s.·⋅*]", "", text.strip().replace("µ", "u").replace("μ", "u").replace("°", "deg")
    )


_SPELLINGS: Final = {_bare(name): name for names in UNITS.values() for name in names}
