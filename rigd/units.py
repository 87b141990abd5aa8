"""Units from the suffixes of keys, numbers in documents, and rounding to significant digits."""

from collections.abc import Sequence
from math import floor, inf, isfinite, log10
from types import MappingProxyType
from typing import Final

UNITS: Final = MappingProxyType(
    {
        "_rad_per_nm": "rad/(N·m)",
        "_nm_s_per_rad": "N·m·s/rad",
        "_nm_per_rad": "N·m/rad",
        "_kg_per_m": "kg/m",
        "_kg_m2": "kg·m²",
        "_n_m2": "N·m²",
        "_n_nm": "N, N·m",
        "_percent": "%",
        "_counts": "counts",
        "_bit_s": "bit/s",
        "_rad_s2": "rad/s²",
        "_rad_s": "rad/s",
        "_rad": "rad",
        "_per_s": "1/s",
        "_hpa": "hPa",
        "_deg": "°",
        "_kg": "kg",
        "_mm": "mm",
        "_nm": "N·m",
        "_mb": "MB",
        "_hz": "Hz",
        "_us": "µs",
        "_ns": "ns",
        "_m": "m",
        "_n": "N",
        "_s": "s",
        "_c": "°C",
    }
)
"""Map from a key's suffix to its unit, the longer suffixes first; the first match applies."""


_MAX_DECIMALS: Final = 9
"""Largest number of decimals; smaller uncertainties are written with an exponent."""


_MAX_INTERVAL_ASYMMETRY: Final = 0.1
"""Asymmetry of an interval above which its ends are written instead of value and half-width.

The asymmetry is the distance of the value from the middle of the interval, relative to its length.
"""


def suffix_of(quantity_key: str) -> str:
    """Return the suffix of a key that names its unit, or "" if there is none.

    Examples
    --------
    >>> suffix_of("beam.bending_stiffness_n_m2")
    '_n_m2'
    """
    return next((unit_suffix for unit_suffix in UNITS if quantity_key.endswith(unit_suffix)), "")


def unit_of(quantity_key: str) -> str:
    """Return the unit that the suffix of a key names, or "" if there is none.

    Examples
    --------
    >>> unit_of("rated_torque_nm")
    'N·m'
    """
    return UNITS.get(suffix_of(quantity_key), "")


def with_half_width(value: float, interval: Sequence[float] | None, scale: float = 1.0) -> str:
    """Format a number and the half-width of its interval, to two digits of the half-width.

    Parameters
    ----------
    value
        Number to format.
    interval
        Lower and upper limit of the number, or None if they are unknown.
    scale
        Factor by which number and interval are multiplied, such as 100 for per cent.

    Examples
    --------
    >>> print(with_half_width(2.56987, (2.56980, 2.56994)), with_half_width(0.0091, None, 100.0))
    2.569870 ± 0.000070 0.91
    """
    half_width = 0.0 if interval is None else (interval[1] - interval[0]) / 2
    if not 0 < scale * half_width < inf:
        return f"{scale * value:.5g}"
    return " ± ".join(rounded_to_uncertainty((value, half_width), half_width, scale))


def rounded_to_uncertainty(
    numbers: Sequence[float], uncertainty: float, scale: float = 1.0, sign_format: str = ""
) -> tuple[str, ...]:
    """Format numbers, rounded to two digits of their uncertainty.

    Parameters
    ----------
    numbers
        Numbers to format.
    uncertainty
        Standard deviation or half-width of an interval. If it is 0 or not finite, five significant
        digits are written.
    scale
        Factor by which numbers and uncertainty are multiplied, such as 100 for per cent.
    sign_format
        "+" to write the sign of positive numbers too.

    Examples
    --------
    >>> rounded_to_uncertainty((0.0305891, 0.0306012), 6e-6, 100.0, "+")
    ('+3.05891', '+3.06012')
    >>> rounded_to_uncertainty((1.23456e-12,), 1e-15)
    ('1.2346e-12',)
    """
    scaled_uncertainty = scale * uncertainty
    if not 0 < scaled_uncertainty < inf:
        return tuple(f"{scale * number:{sign_format}.5g}" for number in numbers)
    decimal_count = decimals(scaled_uncertainty)
    if decimal_count <= _MAX_DECIMALS:
        return tuple(f"{scale * number:{sign_format}.{decimal_count}f}" for number in numbers)
    largest_size = (
        max((abs(scale * number) for number in numbers), default=0.0) or scaled_uncertainty
    )
    digits_after_first = decimal_count + floor(log10(largest_size))
    return tuple(
        f"{scale * number:{sign_format}.{max(digits_after_first, 1) + 1}g}" for number in numbers
    )


def interval_text(interval: Sequence[float], scale: float = 1.0, sign_format: str = "") -> str:
    """Format an interval, rounded to two digits of its half-width.

    Parameters
    ----------
    interval
        Lower and upper limit.
    scale
        Factor by which the limits are multiplied, such as 100 for per cent.
    sign_format
        "+" to write the sign of positive limits too.

    Examples
    --------
    >>> interval_text((-0.169132, -0.169084), 100.0, "+")
    '-16.9132 to -16.9084'
    """
    half_width = (interval[1] - interval[0]) / 2
    return " to ".join(rounded_to_uncertainty(interval, half_width, scale, sign_format))


def with_interval(value: float, interval: Sequence[float] | None) -> str:
    """Format a number with its interval: as ± if this is symmetric, otherwise as its two ends.

    The ± of an asymmetric interval would exclude values that the interval contains, and include
    others, such as a negative stiffness.

    Parameters
    ----------
    value
        Number to format.
    interval
        Lower and upper limit of the number, or None if they are unknown.

    Examples
    --------
    >>> print(with_interval(43.3, (12.1, 74.7)), "or", with_interval(43.3, (16.3, 127.1)))
    43 ± 31 or 16 to 127
    """
    if interval is None:
        return with_half_width(value, None)
    lower_limit, upper_limit = interval
    distance_from_middle = abs(value - (lower_limit + upper_limit) / 2)
    if distance_from_middle > _MAX_INTERVAL_ASYMMETRY * (upper_limit - lower_limit):
        return interval_text(interval)
    return with_half_width(value, interval)


def with_percentage(std: float, value: float) -> str:
    """Format a standard deviation, with its percentage of the value unless the value is 0.

    Parameters
    ----------
    std, value
        Standard deviation and value in the same unit.

    Examples
    --------
    >>> print(with_percentage(6.5e-5, 0.0091), with_percentage(0.1, 0.0), sep=", ")
    6.5e-05 (0.71 %), 0.1
    """
    return f"{std:.2g} ({100.0 * std / abs(value):.2g} %)" if value else f"{std:.2g}"


def decimals(uncertainty: float) -> int:
    """Return the number of decimals that shows two significant digits of an uncertainty.

    Examples
    --------
    >>> decimals(0.0123), decimals(40.0)
    (3, 0)
    """
    return max(1 - floor(log10(uncertainty)), 0)


_SMALLEST_SIZE, _LARGEST_SIZE = 1e-12, 1e12
"""Smallest and largest plausible magnitude of a number in the unit of its key."""


def is_usable_size(value: float) -> bool:
    """Return whether a number is 0 or has a plausible magnitude for a rig.

    Outside this range powers and products of a model overflow or underflow.

    Examples
    --------
    >>> from rigd.units import is_usable_size
    >>> is_usable_size(0.98), is_usable_size(0.0), is_usable_size(1e300), is_usable_size(-5e-324)
    (True, True, False, False)
    """
    return value == 0.0 or _SMALLEST_SIZE <= abs(value) <= _LARGEST_SIZE


def finite_number(value: object) -> float | None:
    """Return a value of a document as a finite number, or None if it is not one.

    Examples
    --------
    >>> from rigd.units import finite_number
    >>> finite_number(3), finite_number("3"), finite_number(True), finite_number(10**400)
    (3.0, None, None, None)
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        float_value = float(value)
    except OverflowError:
        return None
    return float_value if isfinite(float_value) else None
