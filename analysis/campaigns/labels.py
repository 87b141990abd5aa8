"""Names, units and numbers of the quantities of a campaign in its sentences, tables and figures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rigd.beam import PARAMETERS

if TYPE_CHECKING:
    from collections.abc import Sequence

_SHOWN_PARAMETER_NAMES: Final = {
    "delay_s": "delay of the torque",
    "tool_inertia_kg_m2": "tool inertia",
}
"""Names shown for parameters whose symbol alone is not clear."""
_FINER_DISPLAY_UNITS: Final = {"bending_stiffness_n_m2": ("1e-3 N·m²", 1e3)}
"""Display unit and factor of parameters that need more digits here than for a single session."""
_SUPERSCRIPTS: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
"""Translation of the digits and the minus sign of an exponent to superscripts."""

_SMALLEST_SHOWN_P_VALUE: Final = 1e-99
"""Smallest p-value that is shown as a number."""
_MAX_LISTED_TEXTS: Final = 5
"""Largest number of texts that a sentence lists."""
_MODE_QUANTITIES: Final = {
    "frequency_hz": ("frequency", 1.0, "Hz"),
    "damping_ratio": ("damping ratio", 100.0, "%"),
}
"""Name, display factor and display unit of each quantity of a mode."""


def label_and_unit(quantity: str) -> tuple[str, float, str]:
    """Return the symbol or name, the display factor and the display unit of a quantity.

    The quantity is a parameter, or ``frequency_hz_N`` or ``damping_ratio_N`` of mode N. A value
    times the factor is in the display unit.
    """
    if quantity in PARAMETERS:
        parameter_definition = PARAMETERS[quantity]
        display_unit, display_factor = _FINER_DISPLAY_UNITS.get(
            quantity, (parameter_definition.display_unit, parameter_definition.display_factor)
        )
        power_text, _, unit_rest = display_unit.partition(" ")
        if power_text.startswith("1e"):
            display_unit = f"10{power_text.removeprefix('1e').translate(_SUPERSCRIPTS)} {unit_rest}"
        return (
            _SHOWN_PARAMETER_NAMES.get(quantity, parameter_definition.symbol),
            display_factor,
            "" if display_unit == "1" else display_unit,
        )
    quantity_name, mode_number = quantity.rsplit("_", 1)
    mode_quantity, display_factor, display_unit = _MODE_QUANTITIES[quantity_name]
    return f"{mode_quantity} of mode {mode_number}", display_factor, display_unit


def symbol_with_unit(quantity: str) -> str:
    """Return the symbol or name of a quantity, followed by its display unit in parentheses.

    Examples
    --------
    >>> from analysis.campaigns.labels import symbol_with_unit
    >>> symbol_with_unit("zeta"), symbol_with_unit("frequency_hz_2")
    ('ζ (10⁻⁵ s^α)', 'frequency of mode 2 (Hz)')
    """
    symbol, _, display_unit = label_and_unit(quantity)
    return f"{symbol} ({display_unit})" if display_unit else symbol


def format_p_value(p_value: float) -> str:
    """Format a p-value; "< 1e-99" for values that are too small to be shown.

    Examples
    --------
    >>> from analysis.campaigns.labels import format_p_value
    >>> format_p_value(0.0312), format_p_value(0.0)
    ('0.031', '< 1e-99')
    """
    return (
        f"{p_value:.2g}" if p_value > _SMALLEST_SHOWN_P_VALUE else f"< {_SMALLEST_SHOWN_P_VALUE:g}"
    )


def format_percent(fraction: float) -> str:
    """Format a fraction as a percentage; a fraction above 99.9 % is not rounded up to 100 %.

    Examples
    --------
    >>> from analysis.campaigns.labels import format_percent
    >>> format_percent(0.4321), format_percent(0.99999)
    ('43.2 %', '> 99.9 %')
    """
    return "> 99.9 %" if fraction > 0.999 else f"{100 * fraction:.3g} %"


def format_hours(hours: float) -> str:
    """Format a duration in hours, or in minutes if it is shorter than an hour.

    Examples
    --------
    >>> from analysis.campaigns.labels import format_hours
    >>> format_hours(0.0336), format_hours(9.75)
    ('2.02 min', '9.75 h')
    """
    return f"{60 * hours:.3g} min" if hours < 1 else f"{hours:.3g} h"


def join_first_texts(texts: Sequence[str], separator: str = ", ") -> str:
    """List the first five texts and the number of the others.

    Parameters
    ----------
    texts : sequence of str
        Texts to be listed, such as names of files.
    separator : str
        Text between two of them.

    Examples
    --------
    >>> from analysis.campaigns.labels import join_first_texts
    >>> join_first_texts(["a.mcap", "b.mcap"]), join_first_texts("abcdefg")
    ('a.mcap, b.mcap', 'a, b, c, d, e and 2 more')
    """
    listed_texts, unlisted_count = (
        separator.join(texts[:_MAX_LISTED_TEXTS]),
        len(texts) - _MAX_LISTED_TEXTS,
    )
    return (
        f"{listed_texts}{separator.strip(', ')} and {unlisted_count} more"
        if unlisted_count > 0
        else listed_texts
    )
