"""Parameters other than the damping that a fit estimates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from collections.abc import Collection

Setting = Literal[
    "density_over_stiffness", "bending_stiffness_n_m2", "delay_s", "tool_inertia_kg_m2"
]
"""Name of a parameter other than the damping that a fit estimates."""

SETTINGS: Final[tuple[Setting, ...]] = (
    "density_over_stiffness",
    "bending_stiffness_n_m2",
    "delay_s",
    "tool_inertia_kg_m2",
)
"""Parameters other than the damping that are estimated unless fixed: rho/EI in s²/m⁴, EI in N·m²,
the age of the torque relative to the angle, and the inertia between torque sensor and beam."""


def free_settings(fixed_settings: Collection[Setting]) -> tuple[Setting, ...]:
    """Return the names of the `SETTINGS` that are not fixed, in the order of `SETTINGS`."""
    return tuple(setting_name for setting_name in SETTINGS if setting_name not in fixed_settings)
