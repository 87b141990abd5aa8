"""What the predicted torque depends on: beam, damping and instruments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from rigd.beam import Beam, Damping

Setting = Literal[
    "density_over_stiffness", "bending_stiffness_n_m2", "delay_s", "tool_inertia_kg_m2"
]
SETTINGS: Final[tuple[Setting, ...]] = (
    "density_over_stiffness",
    "bending_stiffness_n_m2",
    "delay_s",
    "tool_inertia_kg_m2",
)
"""What is free beside the damping unless it is fixed: rho/EI in s²/m⁴, EI in N·m², by how much the
torque is older than the angle, and the inertia between torque sensor and beam."""

LOGARITHMIC: Final = frozenset(
    {"zeta", "gamma", "density_over_stiffness", "bending_stiffness_n_m2"}
)
"""Parameters that are positive and uncertain by a factor: their logarithm is what is estimated."""


@dataclass(frozen=True, slots=True)
class Plant:
    """One point of the search: everything the predicted torque depends on.

    Attributes
    ----------
    beam : Beam
    damping : Damping
    delay_s : float
        By how much the torque is older than the angle.
    tool_inertia_kg_m2 : float
    stiffness_offsets : tuple of float
        By how much the stiffness of modes 2, 3, … differs from the uniform beam's, relatively.
    """

    beam: Beam
    damping: Damping
    delay_s: float = 0.0
    tool_inertia_kg_m2: float = 0.0
    stiffness_offsets: tuple[float, ...] = ()

    @property
    def parameters(self) -> dict[str, float]:
        """Values by name: zeta, alpha, gamma, lambda, the `SETTINGS`, stiffness_offset_2, …."""
        return {
            "zeta": self.damping.zeta,
            "alpha": self.damping.alpha,
            "gamma": self.damping.gamma,
            "lambda": self.damping.lambda_,
            "density_over_stiffness": self.beam.density_over_stiffness,
            "bending_stiffness_n_m2": self.beam.bending_stiffness_n_m2,
            "delay_s": self.delay_s,
            "tool_inertia_kg_m2": self.tool_inertia_kg_m2,
            **{
                f"stiffness_offset_{mode}": offset
                for mode, offset in enumerate(self.stiffness_offsets, start=2)
            },
        }
