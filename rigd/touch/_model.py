"""Beam model for the estimation of touches, with the uncertainty of its parameters."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from rigd.beam import COEFFICIENT_OF, DAMPING_PARAMETERS, Plant
from rigd.identified_beam import TOUCH_USE, read_identified_beam
from rigd.touch._sensor_filter import NO_FILTER, SensorFilter

_ASSUMED_RELATIVE_STDS: Final = {
    "bending_stiffness_n_m2": 0.01,
    "density_over_stiffness": 0.01,
    "zeta": 0.2,
    "gamma": 0.2,
}
"""Relative standard deviation that is assumed for each parameter of a beam that was not
identified."""


_MAX_DAMPING_ORDER: Final = 1.99
"""Largest fractional order of damping in a model with a changed parameter."""


@dataclass(frozen=True, slots=True)
class TouchModel:
    """Exact beam model for the estimation of touches, with its parameters' uncertainty."""

    plant: Plant
    """Beam, damping and torque channel. The channel's delay includes the averaging of the sensor's
    records, but not the low-pass filter. The plant's beam ends and filters are not used."""
    angle_delay_s: float = 0.0
    """Time in s from the measurement of the angle to its sample."""
    sensor_filter: SensorFilter = NO_FILTER
    """Filters of torque and shear."""
    source: str = "profile"
    """Origin of the model, as shown to the operator: ``profile`` or the path of a document."""
    std_by_parameter: Mapping[str, float] = field(default_factory=dict)
    """Standard deviation of each uncertain parameter in its unit, by name. The mass per length is
    no parameter, but the product of bending stiffness and density over stiffness."""

    @property
    def wrench_delay_s(self) -> float:
        """Delay of torque and shear in s, without that of averaging the sensor's records."""
        return self.angle_delay_s + self.plant.delay_s - self.sensor_filter.weights_delay_s

    def with_changed_parameter(self, parameter_name: str, parameter_change: float) -> "TouchModel":
        """Return the model with a difference added to one parameter, limited to valid values.

        Parameters
        ----------
        parameter_name
            Name of the parameter, such as ``zeta``.
        parameter_change
            Difference that is added, in the unit of the parameter.

        Raises
        ------
        ValueError
            If a plant has no parameter of that name.
        """
        changed_value = self.plant.parameters.get(parameter_name, 0.0) + parameter_change
        if parameter_name in DAMPING_PARAMETERS:
            changed_value = max(changed_value, 0.0)
        if parameter_name in COEFFICIENT_OF:
            changed_value = min(changed_value, _MAX_DAMPING_ORDER)
        return replace(self, plant=self.plant.with_parameters({parameter_name: changed_value}))

    @classmethod
    def with_assumed_uncertainty(
        cls, plant: Plant, angle_delay_s: float = 0.0, sensor_filter: SensorFilter = NO_FILTER
    ) -> "TouchModel":
        """Return the model of a beam that was not identified, with assumed uncertainties.

        The standard deviations are 1 % for stiffness and density and 20 % for the damping.

        Parameters
        ----------
        plant
            Beam, damping and torque channel.
        angle_delay_s
            Time in s from the measurement of the angle to its sample.
        sensor_filter
            Filters of torque and shear.
        """
        parameter_values = plant.parameters
        return cls(
            plant,
            angle_delay_s,
            sensor_filter,
            std_by_parameter={
                parameter_name: relative_std * parameter_values[parameter_name]
                for parameter_name, relative_std in _ASSUMED_RELATIVE_STDS.items()
            },
        )

    @classmethod
    def from_analysis(
        cls,
        path: str | Path,
        stated_plant: Plant,
        angle_delay_s: float = 0.0,
        sensor_filter: SensorFilter = NO_FILTER,
    ) -> "TouchModel":
        """Return the model of an identified beam from a document of ``analyze … --json FILE``.

        Parameters
        ----------
        path
            Path of the JSON document.
        stated_plant
            Plant of the profile. It supplies the length, which a session cannot identify, and tool
            inertia and delay if the document does not have them.
        angle_delay_s, sensor_filter
            Values of the profile.

        Raises
        ------
        IdentifiedBeamError
            If the file cannot be read, lacks the beam's stiffness or density, has an effect that a
            uniform beam on a rigid clamp does not have, or marks a required number as doubtful.
        """
        identified_beam = read_identified_beam(path, stated_plant, TOUCH_USE)
        return cls(
            identified_beam.plant,
            angle_delay_s,
            sensor_filter,
            source=str(path),
            std_by_parameter=identified_beam.parameter_stds,
        )
