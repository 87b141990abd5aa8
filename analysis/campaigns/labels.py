"""What tables and figures call the parameters of a whole-record estimate."""

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


def label(parameter: str) -> tuple[str, float, str]:
    """Symbol, factor and unit in which a parameter is shown."""
    if parameter in _LABELS:
        return _LABELS[parameter]
    mode = parameter.rsplit("_", 1)[1]
    return f"stiffness of mode {mode}", 100.0, "% above mode 1"


def with_unit(parameter: str) -> str:
    """Symbol with its unit, if it has one."""
    symbol, _, unit = label(parameter)
    return f"{symbol} ({unit})" if unit else symbol
