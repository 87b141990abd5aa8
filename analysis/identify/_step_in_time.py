"""Score of a step of the stiffness in time: a clamp that slips, a beam that cracks.

If the stiffness of a ringing mode q of frequency omega rises by the fraction e at an instant, its
response changes to first order by the response to a force ``-e omega² q`` from then on. The motion
is continuous. In one sweep each mode is passed once, so such a step makes the modes inconsistent.
The largest reduction of the modal model's residual over all instants shows whether a step is a
likely cause.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from rigd.beam import CausalTransform

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._modal_fit import ModalFit

MIN_REPORTED_DEVIANCE_REDUCTION: Final = 20.0
"""Reduction of deviance from which a step is reported. Records without a step stay below 13 or
so."""

_COARSE_INSTANT_COUNT: Final = 80
"""Number of instants tried along the whole record."""

_FINE_INSTANT_COUNT_PER_SIDE: Final = 3
"""Number of instants tried to either side of the best one."""


@dataclass(frozen=True, slots=True)
class StiffnessStep:
    """Step of the stiffness in time that best explains a residual.

    Attributes
    ----------
    score : float
        First-order reduction of deviance by the step.
    instant_s : float
        Time of the step since the first tick of the record.
    relative_change : float
        Relative change of the stiffness by the step.
    """

    score: float
    instant_s: float
    relative_change: float

    @property
    def is_significant(self) -> bool:
        """Return whether the score is above `MIN_REPORTED_DEVIANCE_REDUCTION`."""
        return self.score > MIN_REPORTED_DEVIANCE_REDUCTION

    @property
    def text(self) -> str:
        """Return size and time of the stiffness step in words, as part of a sentence."""
        percent = float(f"{100 * self.relative_change:.1g}")
        return (
            f"a step of the stiffness by about {percent:+g} % near {self.instant_s:.0f} s (each "
            "mode is then as it was when the sweep passed it)"
        )

    def as_json(self) -> dict[str, Any]:
        """Return the stiffness step as a dict for JSON."""
        return {
            "name": "step in time",
            "score": self.score,
            "instant_s": self.instant_s,
            "relative_change": self.relative_change,
        }


def best_stiffness_step(comparison: Comparison, modal_fit: ModalFit) -> StiffnessStep:
    """Return the stiffness step that best explains the residual of the modal model."""
    real_residual = modal_fit.residual.view(np.float64)
    step_torque = _StiffnessStepTorque(comparison, modal_fit)
    best_step, sample_indices = (
        StiffnessStep(0.0, 0.0, 0.0),
        np.linspace(0, comparison.sample_count, _COARSE_INSTANT_COUNT + 2)[1:-1],
    )
    instant_spacing = float(sample_indices[1] - sample_indices[0])
    for _ in range(2):
        step_spectra = np.array(
            [step_torque.spectrum(int(sample_index)) for sample_index in sample_indices]
        )
        whitened_spectra = np.ascontiguousarray(step_spectra * modal_fit.noise.weight).view(
            np.float64
        )
        whitened_spectra = modal_fit.part_outside_span(whitened_spectra)
        squared_spectrum_norms = np.einsum("ij,ij->i", whitened_spectra, whitened_spectra)
        squared_spectrum_norms[squared_spectrum_norms == 0] = np.inf
        correlation = -(whitened_spectra @ real_residual)  # the residual is model less measurement
        deviance_reductions = correlation**2 / squared_spectrum_norms
        best_index = int(np.argmax(deviance_reductions))
        if deviance_reductions[best_index] > best_step.score:
            best_step = StiffnessStep(
                score=float(deviance_reductions[best_index]),
                instant_s=comparison.first_sample_s
                + float(sample_indices[best_index]) / comparison.decimation.rate_hz,
                relative_change=float(correlation[best_index] / squared_spectrum_norms[best_index]),
            )
        sample_indices = (
            sample_indices[best_index]
            + instant_spacing * np.linspace(-1, 1, 2 * _FINE_INSTANT_COUNT_PER_SIDE + 3)[1:-1]
        )
        sample_indices = sample_indices[
            (sample_indices > 0) & (sample_indices < comparison.sample_count)
        ]
    return best_step


class _StiffnessStepTorque:
    """Computation of the torque change if the stiffness of the modal model rises at an instant."""

    def __init__(self, comparison: Comparison, modal_fit: ModalFit) -> None:
        self._comparison = comparison
        sample_count = comparison.angle_rad.size
        self._transform = CausalTransform.for_record(sample_count, comparison.decimation.rate_hz)
        s = self._transform.s
        angle_transform = self._transform.forward(comparison.angle_rad)
        mode_vibrations, torque_per_force = [], []
        for mode_index, pole, residue in zip(
            modal_fit.mode_numbers,
            modal_fit.model.poles_rad_s,
            modal_fit.model.residues,
            strict=True,
        ):
            if mode_index:
                # The mode adds inertia s⁴ / (s² + 2 xi omega s + omega²) to G, without constants.
                omega_squared, modal_inertia = abs(pole) ** 2, 2 * abs(residue) / abs(pole) ** 3
                mode_response = s * s / (s * s - 2 * pole.real * s + omega_squared)
                mode_vibrations.append(
                    self._transform.inverse(angle_transform * mode_response, sample_count)
                )
                phase_factor = residue / (1j * abs(residue))
                torque_per_force.append(
                    phase_factor * modal_inertia * omega_squared * mode_response
                )
        self._vibrations, self._torque_per_force = (
            np.array(mode_vibrations),
            np.array(torque_per_force),
        )

    def spectrum(self, sample_index: int) -> NDArray[np.complex128]:
        """Return the torque spectrum of a step per unit relative change, shape (K,).

        `sample_index` is the index of the sample at which the stiffness steps.
        """
        retained_samples = self._comparison.retained_samples
        later_vibrations = self._vibrations.copy()
        later_vibrations[:, : retained_samples.start + sample_index] = 0.0
        force_transforms = self._transform.forward(later_vibrations)
        torque_nm = self._transform.inverse(
            np.sum(force_transforms * self._torque_per_force, axis=0), retained_samples
        )
        return self._comparison.spectrum(torque_nm)
