"""Estimate of the beam for which an excitation is designed, and its modes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import pi
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rigd.beam import (
    BEAM_PARAMETERS,
    DAMPING_PARAMETERS,
    END_PARAMETERS,
    Plant,
    Pole,
    clamped_free_eigenvalues,
    gradient_name,
)
from rigd.excitation._signals import ExcitationError

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complexfloating[Any, Any]]

BAND_HZ: Final = 50.0
"""Upper end in Hz of the band that the whole-record fit uses."""

UNIFORM_BEAM_PARAMETERS: Final = (
    *DAMPING_PARAMETERS,
    *BEAM_PARAMETERS,
    "delay_s",
    "tool_inertia_kg_m2",
)
"""Names of the parameters in the fit of a uniform beam on a rigid clamp."""

FIT_PARAMETERS: Final = (*UNIFORM_BEAM_PARAMETERS, *END_PARAMETERS)
"""Names of all parameters of the fit; `LOGARITHMIC_PARAMETERS` are fitted as logarithms."""

DEVIATION_STD_PER_UNIFORMITY: Final = {"ln_frequency": 1.0, "ln_residue": 3.0}
"""Map from a constant of a mode that may deviate from that of a uniform beam, to the standard
deviation of this deviation divided by the uniformity, as in the analyser. The names of free
parameters append the number of the mode."""

MODAL_CONSTANTS: Final = (*DEVIATION_STD_PER_UNIFORMITY, "ln_damping_ratio", "residue_phase_rad")
"""Names of the free constants of each mode in the modal model."""

_BACKGROUND_TERMS: Final = 5
"""Number of terms of the modal model's background, a polynomial in s."""


@dataclass(frozen=True, slots=True)
class BeamEstimate:
    """Estimated parameters of beam and damping, with the noise spectrum of the measured torque."""

    plant: Plant
    """Estimated beam, damping and torque channel, with the given length. A damping coefficient of 0
    means that the structure has no such damping."""
    free_parameters: tuple[str, ...]
    """Names of the fit's free parameters: some of `PARAMETERS`, and deviations of modes."""
    noise_frequency_hz: RealArray
    """Frequencies of the noise spectrum in increasing order, shape (m,)."""
    noise_nm2_per_hz: RealArray
    """One-sided power spectral density of the torque's noise, shape (m,)."""
    uniformity: float = 0.0
    """Relative standard deviation of each mode's frequency from that of the uniform beam."""

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> "BeamEstimate":
        """Return the plant and the noise spectrum that a JSON document contains.

        Parameters
        ----------
        document
            Plant as `Plant.as_dict` returns it, with ``names``, and ``noise`` with ``frequency_hz``
            and ``nm2_per_hz``, one-sided. Other keys are ignored.

        Raises
        ------
        ExcitationError
            If a key is missing or its value is invalid.
        """
        try:
            noise_document = document["noise"]
            estimate = cls(
                plant=Plant.from_dict(document),
                free_parameters=tuple(
                    parameter_name
                    for parameter_name in document["names"]
                    if parameter_name in FIT_PARAMETERS
                ),
                noise_frequency_hz=np.array(noise_document["frequency_hz"], dtype=np.float64),
                noise_nm2_per_hz=np.array(noise_document["nm2_per_hz"], dtype=np.float64),
            )
        except KeyError as error:
            raise ExcitationError(f"The estimate of the beam has no key {error}.") from None
        except (TypeError, ValueError, AttributeError) as error:
            raise ExcitationError(f"The estimate of the beam cannot be read: {error}.") from None
        estimate.raise_if_invalid()
        return estimate

    @classmethod
    def from_plant(cls, plant: Plant, noise_nm2_per_hz: float) -> "BeamEstimate":
        """Return an estimate equal to a known plant, with the parameters of a uniform beam free.

        Parameters
        ----------
        plant
            Known plant. Its ends, and a damping that it lacks, are not free parameters.
        noise_nm2_per_hz
            One-sided power spectral density of the torque's white noise.
        """
        damping = plant.damping
        absent_parameters = {
            *(() if damping.zeta else ("zeta", "alpha")),
            *(() if damping.gamma else ("gamma", "lambda")),
        }
        return cls(
            plant,
            tuple(
                parameter_name
                for parameter_name in UNIFORM_BEAM_PARAMETERS
                if parameter_name not in absent_parameters
            ),
            np.array([1.0]),
            np.array([noise_nm2_per_hz]),
        )

    def raise_if_invalid(self) -> None:
        """Raise `ExcitationError` if a parameter or the noise spectrum is invalid.

        Raises
        ------
        ExcitationError
            If a value is not finite or out of range, or no parameter is free.
        """
        try:
            self.plant.raise_if_invalid()
        except ValueError as error:
            raise ExcitationError(f"The estimate of the beam has {error}.") from None
        frequency_hz, noise_density = self.noise_frequency_hz, self.noise_nm2_per_hz
        if not (
            frequency_hz.ndim == 1
            and frequency_hz.size > 0
            and noise_density.shape == frequency_hz.shape
            and bool(np.all(np.diff(frequency_hz) > 0.0))
            and bool(np.all(np.isfinite(noise_density) & (noise_density > 0.0)))
        ):
            raise ExcitationError(
                "The estimate of the beam needs noise.frequency_hz, increasing, and as many "
                "positive noise.nm2_per_hz."
            )
        if not self.free_parameters:
            raise ExcitationError("The estimate of the beam has no free parameter in names.")

    def with_tolerance(self, uniformity: float) -> "BeamEstimate":
        """Return the estimate of a beam whose modes may deviate from those of a uniform beam.

        The deviations of the modes, and the orders of the damping, are free parameters as well.

        Parameters
        ----------
        uniformity
            Relative standard deviation of each mode's frequency from that of a uniform beam; 0: the
            estimate is returned unchanged.
        """
        if not uniformity:
            return self
        order_names = [
            parameter_name
            for parameter_name in ("alpha", "lambda")
            if parameter_name not in self.free_parameters
        ]
        coefficients_by_order = {
            "alpha": self.plant.damping.zeta,
            "lambda": self.plant.damping.gamma,
        }
        mode_numbers = [pole.mode for pole in self.modes()]
        deviation_names = [
            f"{parameter_name}_{mode_number}"
            for mode_number in mode_numbers
            for parameter_name in DEVIATION_STD_PER_UNIFORMITY
        ]
        free_parameter_names = (
            *self.free_parameters,
            *(
                parameter_name
                for parameter_name in order_names
                if coefficients_by_order[parameter_name]
            ),
            *deviation_names,
        )
        return replace(self, free_parameters=free_parameter_names, uniformity=uniformity)

    def with_modal_parameters(self) -> "BeamEstimate":
        """Return the estimate with the constants of a modal model as its free parameters.

        They are the constants of each mode, and those of a background.
        """
        mode_numbers = [pole.mode for pole in self.modes()]
        constant_names = [
            f"{constant_name}_{mode_number}"
            for mode_number in mode_numbers
            for constant_name in MODAL_CONSTANTS
        ]
        background_names = [f"background_{term_power}" for term_power in range(_BACKGROUND_TERMS)]
        return replace(self, free_parameters=(*constant_names, *background_names), uniformity=1.0)

    @property
    def parameter_values(self) -> dict[str, float]:
        """Values of all `PARAMETERS` by name."""
        return dict.fromkeys(FIT_PARAMETERS, 0.0) | self.plant.parameters

    def modes(self, highest_hz: float = BAND_HZ) -> tuple[Pole, ...]:
        """Return the beam's poles below a frequency, with derivatives for the free parameters.

        Parameters
        ----------
        highest_hz
            Highest frequency of a mode.
        """
        mode_count = 2
        while True:
            z = clamped_free_eigenvalues(mode_count)
            is_above_band = (z / self.plant.beam.length_m) ** 2 > 2 * pi * highest_hz * np.sqrt(
                self.plant.beam.density_over_stiffness
            )
            if is_above_band[-1]:
                break
            mode_count *= 2
        derivative_names = [
            gradient_name(name) for name in self.free_parameters if name in FIT_PARAMETERS
        ]
        parameter_factors = fit_parameter_factors(self)
        estimated_modes = []
        for pole in self.plant.mode_poles(mode_count, derivative_names):
            if not 0.0 < pole.at_rad_s.imag < 2 * pi * highest_hz:
                continue
            mode_gradient = np.zeros(len(self.free_parameters), dtype=np.complex128)
            mode_gradient[: len(derivative_names)] = pole.derivative * parameter_factors
            for parameter_index, parameter_name in enumerate(self.free_parameters):
                if parameter_name.endswith(f"_{pole.mode}"):
                    mode_gradient[parameter_index] = POLE_AND_RESIDUE_DERIVATIVES[
                        parameter_name.rpartition("_")[0]
                    ](pole.at_rad_s, 0j)[0]
            estimated_modes.append(replace(pole, derivative=mode_gradient))
        return tuple(estimated_modes)


POLE_AND_RESIDUE_DERIVATIVES: Final[
    Mapping[str, Callable[[complex, complex], tuple[complex, complex]]]
] = {
    "ln_frequency": lambda pole, _: (pole, 0j),
    "ln_damping_ratio": lambda pole, _: (complex(pole.real), 0j),
    "ln_residue": lambda _, residue: (0j, residue),
    "residue_phase_rad": lambda _, residue: (0j, 1j * residue),
    "background": lambda *_: (0j, 0j),
}
"""Map from a constant of a mode to a function of the mode's pole and residue, which returns the
derivatives of both with respect to the constant."""


def fit_parameter_factors(estimate: BeamEstimate) -> RealArray:
    """Return the factors that convert derivatives for model parameters to those for fit parameters.

    The fit uses the logarithms of zeta and gamma, so their factors are zeta and gamma. The other
    factors are 1.
    """
    parameter_values = estimate.parameter_values
    parameter_names = [
        parameter_name
        for parameter_name in estimate.free_parameters
        if parameter_name in FIT_PARAMETERS
    ]
    return np.array(
        [
            parameter_values[parameter_name] if parameter_name in ("zeta", "gamma") else 1.0
            for parameter_name in parameter_names
        ]
    )
