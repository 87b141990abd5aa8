"""Parameters that determine the predicted torque: beam, damping, settings and stated values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from collections.abc import Collection

    from rigd.beam import Beam, Damping

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


def free_settings(fixed: Collection[Setting]) -> tuple[Setting, ...]:
    """Return the names of the plant's `SETTINGS` that are not fixed, in the order of `SETTINGS`.

    Parameters
    ----------
    fixed : collection of str
        Names of the fixed settings.
    """
    return tuple(setting_name for setting_name in SETTINGS if setting_name not in fixed)


OPTIONAL_PARAMETERS: Final = (
    "root_compliance_rad_per_nm",
    "tip_mass_kg",
    "filter_time_constant_s",
    "second_order_filter_time_constant_s",
)
"""Parameters of a rig with a compliant clamp, a mass at the tip or filters in the torque channel; 0
if it has none."""


@dataclass(frozen=True, slots=True)
class Plant:
    """Rig and beam: all parameters that determine the torque predicted from the motor angle.

    Attributes
    ----------
    beam : Beam
        Geometry and material of the beam.
    damping : Damping
        Coefficients and orders of internal and external damping.
    delay_s : float
        Age of the torque relative to the angle.
    tool_inertia_kg_m2 : float
        Inertia between torque sensor and beam.
    stiffness_offsets : tuple of float
        Relative deviation of the stiffness of modes 2, 3, … from the uniform beam.
    root_compliance_rad_per_nm : float
        Rotation of the clamp per torque on the beam's root. The tool inertia is on the motor's side
        of this compliance: the bolted parts are stiff, and the grip on the beam yields.
    tip_mass_kg : float
        Point mass at the beam's tip.
    filter_time_constant_s : float
        Time constant of a first-order low-pass filter in the torque channel.
    second_order_filter_time_constant_s : float
        Reciprocal corner frequency (rad/s) of a second-order Butterworth filter in the torque
        channel.
    """

    beam: Beam
    damping: Damping
    delay_s: float = 0.0
    tool_inertia_kg_m2: float = 0.0
    stiffness_offsets: tuple[float, ...] = ()
    root_compliance_rad_per_nm: float = 0.0
    tip_mass_kg: float = 0.0
    filter_time_constant_s: float = 0.0
    second_order_filter_time_constant_s: float = 0.0

    @property
    def optional_parameters(self) -> dict[str, float]:
        """Return the values of the plant's `OPTIONAL_PARAMETERS` by name, zeros included."""
        return {
            parameter_name: getattr(self, parameter_name) for parameter_name in OPTIONAL_PARAMETERS
        }

    @property
    def parameters(self) -> dict[str, float]:
        """Return the values of the plant's parameters by name.

        The names are zeta, alpha, gamma, lambda, the `SETTINGS`, stiffness_offset_2, …, and those
        of the `OPTIONAL_PARAMETERS` that are not 0.
        """
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
                f"stiffness_offset_{mode_number}": stiffness_offset
                for mode_number, stiffness_offset in enumerate(self.stiffness_offsets, start=2)
            },
            **{
                parameter_name: parameter_value
                for parameter_name, parameter_value in self.optional_parameters.items()
                if parameter_value
            },
        }
