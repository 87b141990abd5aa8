"""Estimate of the beam for which an excitation is designed, and its modes."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from math import isfinite, pi
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rigd.beam import (
    BEAM_PARAMETERS,
    DAMPING_PARAMETERS,
    END_PARAMETERS,
    Beam,
    Damping,
    LoadedBeam,
    clamped_free_eigenvalues,
    gradient_name,
    pole_gradient,
    poles_for_eigenvalues,
)
from rigd.excitation._signals import ExcitationError

Real = NDArray[np.float64]
Complex = NDArray[np.complexfloating[Any, Any]]

BAND_HZ: Final = 50.0
"""Upper end in Hz of the band that the whole-record fit uses."""

UNIFORM_BEAM_PARAMETERS: Final = (
    *DAMPING_PARAMETERS,
    *BEAM_PARAMETERS,
    "delay_s",
    "tool_inertia_kg_m2",
)
"""Names of the parameters in the fit of a uniform beam on a rigid clamp."""

PARAMETERS: Final = (*UNIFORM_BEAM_PARAMETERS, *END_PARAMETERS)
"""Names of all parameters of the fit; `LOGARITHMIC_PARAMETERS` are fitted as logarithms."""

_ADDITIONAL_PARAMETERS: Final = ("delay_s", "tool_inertia_kg_m2", *END_PARAMETERS)
"""Names of the parameters in addition to those of beam and damping; their default value is 0."""

TOLERATED_DEVIATIONS: Final = {"ln_frequency": 1.0, "ln_residue": 3.0}
"""Constants of a mode that may deviate from those of a uniform beam, with the standard deviation of
the deviation over the uniformity, as in the analyser. In the names of free parameters the number of
the mode follows."""

MODAL_CONSTANTS: Final = (*TOLERATED_DEVIATIONS, "ln_damping_ratio", "residue_phase_rad")
"""Names of the free constants of each mode in the modal model."""

_BACKGROUND_TERMS: Final = 5
"""Number of terms of the modal model's background, a polynomial in s."""


@dataclass(frozen=True, slots=True)
class BeamEstimate:
    """Estimated parameters of beam and damping, with the noise spectrum of the measured torque."""

    beam: Beam
    """Beam with the given length, and the estimated density and stiffness."""
    damping: Damping
    """Estimated damping; a coefficient of 0 means that the structure has no such damping."""
    names: tuple[str, ...]
    """Names of the fit's free parameters: some of `PARAMETERS`, and deviations of modes."""
    noise_frequency_hz: Real
    """Frequencies of the noise spectrum in increasing order, shape (m,)."""
    noise_nm2_per_hz: Real
    """One-sided power spectral density of the torque's noise, shape (m,)."""
    delay_s: float = 0.0
    """Delay of the torque relative to the angle."""
    tool_inertia_kg_m2: float = 0.0
    """Inertia between torque sensor and beam."""
    tip_mass_kg: float = 0.0
    """Point mass at the tip of the beam."""
    root_compliance_rad_per_nm: float = 0.0
    """Rotation of the clamp per torque."""
    stiffness_offsets: tuple[float, ...] = ()
    """Relative differences of the stiffness of modes 2, 3, … from that of the uniform beam."""
    uniformity: float = 0.0
    """Relative standard deviation of each mode's frequency from that of the uniform beam."""

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> "BeamEstimate":
        """Return the beam parameters, damping and noise spectrum that a JSON document contains.

        Parameters
        ----------
        document
            ``beam`` with the keys of `Beam`; ``damping`` with zeta, alpha, gamma and lambda;
            ``names``; ``noise`` with ``frequency_hz`` and ``nm2_per_hz``, one-sided; and optionally
            ``delay_s``, ``tool_inertia_kg_m2``, ``tip_mass_kg``, ``root_compliance_rad_per_nm``
            and ``stiffness_offsets``. Other keys are ignored.

        Raises
        ------
        ExcitationError
            If a key is missing or its value is invalid.
        """
        try:
            damping, noise_document = document["damping"], document["noise"]
            estimate = cls(
                beam=Beam(
                    **{
                        key: float(document["beam"][key])
                        for key in ("length_m", "density_kg_per_m", "bending_stiffness_n_m2")
                    }
                ),
                damping=Damping(
                    **{
                        key: float(damping[key.rstrip("_")])
                        for key in ("zeta", "alpha", "gamma", "lambda_")
                    }
                ),
                names=tuple(
                    parameter_name
                    for parameter_name in document["names"]
                    if parameter_name in PARAMETERS
                ),
                noise_frequency_hz=np.array(noise_document["frequency_hz"], dtype=np.float64),
                noise_nm2_per_hz=np.array(noise_document["nm2_per_hz"], dtype=np.float64),
                **{key: float(document.get(key, 0.0)) for key in _ADDITIONAL_PARAMETERS},
                stiffness_offsets=tuple(map(float, document.get("stiffness_offsets", ()))),
            )
        except KeyError as error:
            raise ExcitationError(f"The estimate of the beam has no key {error}.") from None
        except (TypeError, ValueError, AttributeError) as error:
            raise ExcitationError(f"The estimate of the beam cannot be read: {error}.") from None
        estimate.check()
        return estimate

    @classmethod
    def stated(
        cls, beam: Beam, damping: Damping, noise_nm2_per_hz: float, tip_mass_kg: float = 0.0
    ) -> "BeamEstimate":
        """Return an estimate with given beam and damping, whose parameters are all to be fitted.

        Parameters
        ----------
        beam, damping
            Known beam and damping.
        noise_nm2_per_hz
            One-sided power spectral density of the torque's white noise.
        tip_mass_kg
            Point mass at the tip, which is not a free parameter.
        """
        absent_parameters = {
            *(() if damping.zeta else ("zeta", "alpha")),
            *(() if damping.gamma else ("gamma", "lambda")),
        }
        return cls(
            beam,
            damping,
            tuple(
                parameter_name
                for parameter_name in UNIFORM_BEAM_PARAMETERS
                if parameter_name not in absent_parameters
            ),
            np.array([1.0]),
            np.array([noise_nm2_per_hz]),
            tip_mass_kg=tip_mass_kg,
        )

    def check(self) -> None:
        """Raise `ExcitationError` if a parameter or the noise spectrum is invalid.

        Raises
        ------
        ExcitationError
            If a value is not finite or out of range, or no parameter is free.
        """
        beam, damping = self.beam, self.damping
        for key, checked_value, lower_bound, upper_bound in (
            ("beam.length_m", beam.length_m, 1e-6, np.inf),
            ("beam.density_kg_per_m", beam.density_kg_per_m, 1e-12, np.inf),
            ("beam.bending_stiffness_n_m2", beam.bending_stiffness_n_m2, 1e-12, np.inf),
            ("damping.zeta", damping.zeta, 0.0, np.inf),
            ("damping.alpha", damping.alpha, 0.0, 2.0),
            ("damping.gamma", damping.gamma, 0.0, np.inf),
            ("damping.lambda", damping.lambda_, 0.0, 2.0),
            *((key, getattr(self, key), -np.inf, np.inf) for key in _ADDITIONAL_PARAMETERS),
            *(
                ("stiffness_offsets", estimate_entry, -0.9, 10.0)
                for estimate_entry in self.stiffness_offsets
            ),
        ):
            if not (isfinite(checked_value) and lower_bound <= checked_value < upper_bound):
                raise ExcitationError(f"The estimate of the beam has {key} = {checked_value}.")
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
        if not self.names:
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
            if parameter_name not in self.names
        ]
        coefficients_by_order = {"alpha": self.damping.zeta, "lambda": self.damping.gamma}
        mode_numbers = [beam_mode.number for beam_mode in self.modes()]
        deviation_names = [
            f"{parameter_name}_{mode_number}"
            for mode_number in mode_numbers
            for parameter_name in TOLERATED_DEVIATIONS
        ]
        free_names = (
            *self.names,
            *(
                parameter_name
                for parameter_name in order_names
                if coefficients_by_order[parameter_name]
            ),
            *deviation_names,
        )
        return replace(self, names=free_names, uniformity=uniformity)

    def modal(self) -> "BeamEstimate":
        """Return the estimate with the constants of a modal model as its free parameters.

        They are the constants of each mode, and those of a background.
        """
        mode_numbers = [beam_mode.number for beam_mode in self.modes()]
        constant_names = [
            f"{constant_name}_{mode_number}"
            for mode_number in mode_numbers
            for constant_name in MODAL_CONSTANTS
        ]
        background_names = [f"background_{term_power}" for term_power in range(_BACKGROUND_TERMS)]
        return replace(self, names=(*constant_names, *background_names), uniformity=1.0)

    @property
    def values(self) -> dict[str, float]:
        """Values of all `PARAMETERS` by name."""
        beam, damping = self.beam, self.damping
        return dict(
            zip(
                PARAMETERS,
                (
                    *(damping.zeta, damping.alpha, damping.gamma, damping.lambda_),
                    *(beam.density_over_stiffness, beam.bending_stiffness_n_m2),
                    *(getattr(self, key) for key in _ADDITIONAL_PARAMETERS),
                ),
                strict=True,
            )
        )

    @property
    def loaded(self) -> LoadedBeam | None:
        """Beam model with tip mass, root compliance and offsets of the modes' stiffness.

        It is None if all of these are 0 and not free, so that the beam is uniform.
        """
        differs_from_uniform = (
            self.tip_mass_kg or self.root_compliance_rad_per_nm or any(self.stiffness_offsets)
        )
        if not differs_from_uniform and set(END_PARAMETERS).isdisjoint(self.names):
            return None
        return self.loaded_beam

    @property
    def loaded_beam(self) -> LoadedBeam:
        """Beam model with tip mass, root compliance and stiffness offsets, which may all be 0."""
        return LoadedBeam(
            self.beam,
            self.damping,
            self.tip_mass_kg,
            self.root_compliance_rad_per_nm,
            self.stiffness_offsets,
        )

    def modes(self, highest_hz: float = BAND_HZ) -> tuple["EstimatedMode", ...]:
        """Return the beam's modes below a frequency, with their derivatives by the parameters.

        Parameters
        ----------
        highest_hz
            Highest frequency of a mode.
        """
        mode_count = 2
        while True:
            z = clamped_free_eigenvalues(mode_count)
            is_above_band = (z / self.beam.length_m) ** 2 > 2 * pi * highest_hz * np.sqrt(
                self.beam.density_over_stiffness
            )
            if is_above_band[-1]:
                break
            mode_count *= 2
        nonuniform_beam = self.loaded
        pole_pairs = (
            poles_for_eigenvalues(z, self.beam, self.damping)
            if nonuniform_beam is None
            else nonuniform_beam.poles(z)
        )
        parameter_names = [
            parameter_name for parameter_name in self.names if parameter_name in PARAMETERS
        ]
        derivative_names = [gradient_name(parameter_name) for parameter_name in parameter_names]
        poles_in_band = {
            mode_number: mode_pole
            for mode_number, mode_pole in enumerate(pole_pairs[:, 0].tolist(), start=1)
            if np.isfinite(mode_pole) and 0.0 < mode_pole.imag < 2 * pi * highest_hz
        }
        if nonuniform_beam is None:
            stiffness_by_mode = (z / self.beam.length_m) ** 4
            pole_gradients_by_mode: Iterable[Complex] = (
                pole_gradient(
                    mode_pole,
                    float(stiffness_by_mode[mode_number - 1]),
                    self.beam,
                    self.damping,
                    derivative_names,
                )
                for mode_number, mode_pole in poles_in_band.items()
            )
        else:
            pole_gradients_by_mode = nonuniform_beam.pole_gradients(
                np.array([*poles_in_band.values()], dtype=np.complex128), derivative_names
            )
        parameter_factors = parameter_scales(self)
        estimated_modes = []
        for (mode_number, mode_pole), row in zip(
            poles_in_band.items(), pole_gradients_by_mode, strict=True
        ):
            mode_gradient = np.zeros(len(self.names), dtype=np.complex128)
            mode_gradient[: len(parameter_names)] = row * parameter_factors
            for parameter_index, parameter_name in enumerate(self.names):
                if parameter_name.endswith(f"_{mode_number}"):
                    mode_gradient[parameter_index] = POLE_AND_RESIDUE_DERIVATIVES[
                        parameter_name.rpartition("_")[0]
                    ](mode_pole, 0j)[0]
            estimated_modes.append(EstimatedMode(mode_number, mode_pole, mode_gradient))
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
"""Functions that return the derivatives of a mode's pole and residue by one of its constants, from
pole and residue."""


@dataclass(frozen=True, slots=True)
class EstimatedMode:
    """Vibration mode of the estimated beam with its hub held still."""

    number: int
    """Number of the mode, from 1."""
    pole_rad_s: complex
    """Pole of the mode with positive imaginary part."""
    gradient: Complex
    """Derivatives of the pole by the free parameters, shape (k,)."""

    @property
    def frequency_hz(self) -> float:
        """Frequency of the mode's free decay in Hz."""
        return self.pole_rad_s.imag / (2 * pi)

    @property
    def damping_ratio(self) -> float:
        """Damping ratio of the mode, as a fraction of critical damping."""
        return -self.pole_rad_s.real / abs(self.pole_rad_s)

    @property
    def frequency_gradient_hz(self) -> Real:
        """Derivatives of the mode's frequency in Hz by the free parameters, shape (k,)."""
        return np.asarray(self.gradient.imag / (2 * pi), dtype=np.float64)

    @property
    def damping_gradient(self) -> Real:
        """Derivatives of the mode's damping ratio by the free parameters, shape (k,)."""
        p, pole_magnitude = self.pole_rad_s, abs(self.pole_rad_s)
        magnitude_gradient = (p.conjugate() * self.gradient).real / pole_magnitude
        damping_derivatives = (
            -self.gradient.real / pole_magnitude
            - self.damping_ratio * magnitude_gradient / pole_magnitude
        )
        return np.asarray(damping_derivatives, dtype=np.float64)


def parameter_scales(estimate: BeamEstimate) -> Real:
    """Return the factors that convert derivatives of the exact model to the fit's parameters.

    The fit uses the logarithms of zeta and gamma, so their factors are zeta and gamma. The other
    factors are 1.
    """
    parameter_values = estimate.values
    parameter_names = [
        parameter_name for parameter_name in estimate.names if parameter_name in PARAMETERS
    ]
    return np.array(
        [
            parameter_values[parameter_name] if parameter_name in ("zeta", "gamma") else 1.0
            for parameter_name in parameter_names
        ]
    )
