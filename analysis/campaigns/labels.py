"""What tables and figures call the parameters and modes of a whole-record estimate."""

from __future__ import annotations

from typing import Final

_LABELS: Final = {
    "zeta": ("ζ", 1e5, "10⁻⁵ s^α"),
    "alpha": ("α", 1.0, ""),
    "gamma": ("γ", 1e2, "10⁻² s^λ/m⁴"),
    "lambda": ("λ", 1.0, ""),
    "density_over_stiffness": ("ρ/EI", 1e3, "10⁻³ s²/m⁴"),
    "bending_stiffness_n_m2": ("EI", 1e3, "10⁻³ N·m²"),
    "delay_s": ("delay of the torque", 1e6, "µs"),
    "tool_inertia_kg_m2": ("tool's inertia", 1e6, "10⁻⁶ kg·m²"),
}


_LEAST: Final = 1e-99
_OF_MODES: Final = {
    "frequency_hz": ("frequency", 1.0, "Hz"),
    "damping_ratio": ("damping ratio", 100.0, "%"),
    "stiffness_offset": ("stiffness", 100.0, "% above mode 1"),
}


def label(quantity: str) -> tuple[str, float, str]:
    """Symbol, factor and unit in which a parameter or a mode's quantity is shown."""
    if quantity in _LABELS:
        return _LABELS[quantity]
    of_mode, mode = quantity.rsplit("_", 1)
    what, factor, unit = _OF_MODES[of_mode]
    return f"{what} of mode {mode}", factor, unit


def with_unit(parameter: str) -> str:
    """Symbol with its unit, if it has one."""
    symbol, _, unit = label(parameter)
    return f"{symbol} ({unit})" if unit else symbol


def probability(chance: float) -> str:
    """Write a probability that may be too small for a number, but is not 0."""
    return f"{chance:.2g}" if chance > _LEAST else f"< {_LEAST:g}"
