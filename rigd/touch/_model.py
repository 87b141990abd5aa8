"""Model of the beam for the estimation of touches, with its uncertainty."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from rigd.beam import Beam, Damping
from rigd.identified_beam import TOUCH, read_identified_beam
from rigd.touch._sensor_filter import NO_FILTER, SensorFilter

UNCERTAIN_PARAMETERS: Final = (
    "bending_stiffness_n_m2",
    "density_over_stiffness",
    "zeta",
    "alpha",
    "gamma",
    "lambda",
    "tool_inertia_kg_m2",
    "delay_s",
)
"""Names of the model's parameters whose uncertainty is taken into account."""

_ASSUMED_RELATIVE_STD: Final = {
    "bending_stiffness_n_m2": 0.01,
    "density_over_stiffness": 0.01,
    "zeta": 0.2,
    "gamma": 0.2,
}
"""Relative standard deviations that are assumed for the parameters of a beam that was not
identified."""


@dataclass(frozen=True, slots=True)
class TouchModel:
    """Exact beam model for the estimation of touches, with its parameters' uncertainty."""

    beam: Beam
    """Length, density and stiffness of the beam."""
    damping: Damping
    """Damping of the beam."""
    tool_inertia_kg_m2: float = 0.0
    """Inertia between sensor and beam."""
    angle_delay_s: float = 0.0
    """Age of the angle at the time of its sample."""
    torque_delay_s: float = 0.0
    """Age of torque and shear at the time of their sample. It includes the delay of the weighted
    mean of records, but not that of the low-pass filter."""
    sensor_filter: SensorFilter = NO_FILTER
    """Filters of torque and shear."""
    source: str = "profile"
    """Source of the model, for the operator."""
    std: Mapping[str, float] = field(default_factory=dict)
    """Standard deviation of each uncertain parameter of `UNCERTAIN_PARAMETERS` in its unit, by
    name. The mass per length is the product of bending stiffness and density over stiffness."""

    @property
    def wrench_delay_s(self) -> float:
        """Age of torque and shear in s, without the delay of averaging the sensor's records."""
        return self.torque_delay_s - self.sensor_filter.weights_delay_s

    def with_changed_parameter(self, name: str, parameter_change: float) -> "TouchModel":
        """Return the model with one parameter changed by a given difference.

        Parameters
        ----------
        name
            Name of the parameter, one of `UNCERTAIN_PARAMETERS`.
        parameter_change
            Difference in the unit of the parameter.
        """
        beam, damping = self.beam, self.damping
        match name:
            case "bending_stiffness_n_m2":
                coefficient = 1 + parameter_change / beam.bending_stiffness_n_m2
                beam = replace(
                    beam,
                    bending_stiffness_n_m2=beam.bending_stiffness_n_m2 * coefficient,
                    density_kg_per_m=beam.density_kg_per_m * coefficient,
                )
            case "density_over_stiffness":
                coefficient = 1 + parameter_change / beam.density_over_stiffness
                beam = replace(beam, density_kg_per_m=beam.density_kg_per_m * coefficient)
            case "zeta" | "gamma":
                damping = replace(
                    damping, **{name: max(getattr(damping, name) + parameter_change, 0.0)}
                )
            case "alpha" | "lambda":
                key = "lambda_" if name == "lambda" else name
                exponent = min(max(getattr(damping, key) + parameter_change, 0.0), 1.99)
                damping = replace(damping, **{key: exponent})
            case "tool_inertia_kg_m2":
                return replace(self, tool_inertia_kg_m2=self.tool_inertia_kg_m2 + parameter_change)
            case "delay_s":
                return replace(self, torque_delay_s=self.torque_delay_s + parameter_change)
            case _:
                raise ValueError(f"{name!r} is not one of {UNCERTAIN_PARAMETERS}.")
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
        """Return the model of a beam that was not identified, with assumed uncertainties.

        They are 1 % for stiffness and density, and 20 % for the damping.

        Parameters
        ----------
        beam, damping
            Parameters of the exact model.
        tool_inertia_kg_m2
            Inertia between sensor and beam.
        angle_delay_s, torque_delay_s
            Ages of the angle, and of torque and shear, at the time of their sample.
        sensor_filter
            Filters of torque and shear.
        """
        parameter_values = {
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
            std={
                parameter_name: relative_std * parameter_values[parameter_name]
                for parameter_name, relative_std in _ASSUMED_RELATIVE_STD.items()
            },
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
        """Return the model of an identified beam from a document of ``analyze … --json FILE``.

        Tool inertia and delay of the torque are those of the arguments if the document has none.

        Parameters
        ----------
        path
            Path of the JSON document.
        length_m
            Length of the beam, which cannot be identified from a session.
        angle_delay_s, torque_delay_s, tool_inertia_kg_m2, sensor_filter
            Values of the profile.

        Raises
        ------
        IdentifiedBeamError
            If the file cannot be read, lacks the beam's stiffness or density, has an effect that a
            uniform beam on a rigid clamp does not have, or flags a required number.
        """
        identified = read_identified_beam(path, length_m, TOUCH)
        tool = identified.tool_inertia_kg_m2
        return cls(
            identified.beam,
            identified.damping,
            tool_inertia_kg_m2 if tool is None else tool,
            angle_delay_s,
            torque_delay_s if identified.delay_s is None else identified.delay_s + angle_delay_s,
            sensor_filter,
            source=str(path),
            std=identified.std,
        )
