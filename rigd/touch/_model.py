"""The beam that touches are estimated with, and how well it is known."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from rigd.beam import Beam, Damping
from rigd.identified_beam import TOUCH, read_identified_beam
from rigd.touch._sensor_filter import NO_FILTER, SensorFilter

UNCERTAIN: Final = (
    "bending_stiffness_n_m2",
    "density_over_stiffness",
    "zeta",
    "alpha",
    "gamma",
    "lambda",
    "tool_inertia_kg_m2",
    "delay_s",
)
"""Parameters whose standard deviations are taken into account."""

_ASSUMED: Final = {
    "bending_stiffness_n_m2": 0.01,
    "density_over_stiffness": 0.01,
    "zeta": 0.2,
    "gamma": 0.2,
}
"""Relative standard deviations of a beam that nobody has identified."""


@dataclass(frozen=True, slots=True)
class TouchModel:
    """Exact model of the antenna as identified, or as its profile states it."""

    beam: Beam
    """Length, density and stiffness."""
    damping: Damping
    """Damping."""
    tool_inertia_kg_m2: float = 0.0
    """Inertia between sensor and beam."""
    angle_delay_s: float = 0.0
    """Age of the angle at the time of its sample."""
    torque_delay_s: float = 0.0
    """Age of torque and shear at the time of their sample, that of the averaged records on the
    whole included, that of the low-pass filter not."""
    sensor_filter: SensorFilter = NO_FILTER
    """Filters of torque and shear."""
    source: str = "profile"
    """Where it came from, for people."""
    std: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations of those of `UNCERTAIN` that are uncertain, in their units. The density
    goes with both others: its mass per length is their product."""

    @property
    def wrench_delay_s(self) -> float:
        """Age of torque and shear behind the response of the filters."""
        return self.torque_delay_s - self.sensor_filter.weights_delay_s

    def changed(self, name: str, by: float) -> "TouchModel":
        """Return it with one parameter of `UNCERTAIN` changed, the others as they are.

        Parameters
        ----------
        name
            Name of the parameter.
        by
            Difference in its unit.
        """
        beam, damping = self.beam, self.damping
        match name:
            case "bending_stiffness_n_m2":
                factor = 1 + by / beam.bending_stiffness_n_m2
                beam = replace(
                    beam,
                    bending_stiffness_n_m2=beam.bending_stiffness_n_m2 * factor,
                    density_kg_per_m=beam.density_kg_per_m * factor,
                )
            case "density_over_stiffness":
                factor = 1 + by / beam.density_over_stiffness
                beam = replace(beam, density_kg_per_m=beam.density_kg_per_m * factor)
            case "zeta" | "gamma":
                damping = replace(damping, **{name: max(getattr(damping, name) + by, 0.0)})
            case "alpha" | "lambda":
                key = "lambda_" if name == "lambda" else name
                order = min(max(getattr(damping, key) + by, 0.0), 1.99)
                damping = replace(damping, **{key: order})
            case "tool_inertia_kg_m2":
                return replace(self, tool_inertia_kg_m2=self.tool_inertia_kg_m2 + by)
            case "delay_s":
                return replace(self, torque_delay_s=self.torque_delay_s + by)
            case _:
                raise ValueError(f"{name!r} is not one of {UNCERTAIN}.")
        return replace(self, beam=beam, damping=damping)

    @classmethod
    def assumed(
        cls,
        beam: Beam,
        damping: Damping,
        *,
        tool_inertia_kg_m2: float = 0.0,
        angle_delay_s: float = 0.0,
        torque_delay_s: float = 0.0,
        sensor_filter: SensorFilter = NO_FILTER,
    ) -> "TouchModel":
        """Return the model that a profile states: 1 % of stiffness and density, 20 % of damping.

        Parameters
        ----------
        beam, damping
            Parameters of the exact model.
        tool_inertia_kg_m2
            Inertia between sensor and beam.
        angle_delay_s, torque_delay_s
            Ages of the readings.
        sensor_filter
            Filters of torque and shear.
        """
        values = {
            "bending_stiffness_n_m2": beam.bending_stiffness_n_m2,
            "density_over_stiffness": beam.density_over_stiffness,
            "zeta": damping.zeta,
            "gamma": damping.gamma,
        }
        return cls(
            beam,
            damping,
            tool_inertia_kg_m2,
            angle_delay_s,
            torque_delay_s,
            sensor_filter,
            std={name: factor * values[name] for name, factor in _ASSUMED.items()},
        )

    @classmethod
    def from_analysis(
        cls,
        path: str | Path,
        *,
        length_m: float,
        angle_delay_s: float = 0.0,
        torque_delay_s: float = 0.0,
        tool_inertia_kg_m2: float = 0.0,
        sensor_filter: SensorFilter = NO_FILTER,
    ) -> "TouchModel":
        """Read what ``analyze … --json FILE`` has identified.

        Tool inertia and delay that it has not identified are as given here.

        Parameters
        ----------
        path
            The JSON document.
        length_m
            Length of the beam: no session shows it.
        angle_delay_s, torque_delay_s, tool_inertia_kg_m2, sensor_filter
            As the profile states them.

        Raises
        ------
        IdentifiedBeamError
            If the file cannot be read, lacks the beam's stiffness or density, has an effect that a
            uniform beam on a rigid clamp has not, or flags a number that is needed.
        """
        found = read_identified_beam(path, length_m, TOUCH)
        tool = found.tool_inertia_kg_m2
        return cls(
            found.beam,
            found.damping,
            tool_inertia_kg_m2 if tool is None else tool,
            angle_delay_s,
            torque_delay_s if found.delay_s is None else found.delay_s + angle_delay_s,
            sensor_filter,
            source=str(path),
            std=found.std,
        )
