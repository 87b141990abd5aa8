"""Small nonlinear effects, as torque spectra in addition to the modal model.

To first order in its size each effect adds to the torque a spectrum of known shape: stiffness that
rises with the deflection, air drag, backlash, dry friction, a sensor whose gain depends on the
torque. An effect that improves the modal model is fitted with it, so that it biases no mode. Its
name is only a hypothesis: a record seldom distinguishes between several small effects.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._finding import Finding
from analysis.identify._nonlinear import NonlinearForceSpectra, NonlinearTerm
from analysis.identify._time_varying import UNIT_BACKLASH_RAD, backlash_spectrum

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._finding import FindingKind
    from analysis.identify._modal_fit import ModalFit
    from rigd.beam import Plant

MIN_SMALL_EFFECT_DEVIANCE_REDUCTION: Final = 16.0
"""Deviance by which an effect must reduce the residual. By chance one of nine effects does so in
two records of a thousand."""

LARGE_EFFECT_DEVIANCE_REDUCTION: Final = 100.0
"""Reduction of deviance from which the first order may not suffice, so that the effect is searched
for by its own model."""

_EXACTLY_KNOWN_EFFECT_KINDS: Final[frozenset[FindingKind]] = frozenset(
    {"nonlinear gain", "friction"}
)
"""Effects that do not change the motion of the beam, so that the first order is exact."""

_FRICTION_TRANSITION_SPEED_RAD_S: Final = 0.01
"""Motor speed at which 70 % of the dry friction is reached. Its value matters at the turning points
only."""

_SPEED_OVERSAMPLING: Final = 4
"""Samples of the friction per sample of the angle, since friction has harmonics of the motion."""


@dataclass(frozen=True, slots=True)
class SmallEffect:
    """Small nonlinear effect that would improve the modal model.

    Attributes
    ----------
    kind : str
        Kind of the `Finding` on the effect.
    phrase : str
        Description of the effect, as the beginning of a sentence.
    torque_spectrum : ndarray of complex, shape (K,)
        Spectrum of the torque by the effect, in N·m per unit of its size.
    deviance_reduction : float
        Reduction of deviance by the effect.
    """

    kind: FindingKind
    phrase: str
    torque_spectrum: NDArray[np.complex128]
    deviance_reduction: float

    @property
    def is_linear(self) -> bool:
        """Return whether the torque by this effect is proportional to the size of the effect."""
        return self.kind in _EXACTLY_KNOWN_EFFECT_KINDS

    @property
    def is_large(self) -> bool:
        """Return whether the nonlinear effect is so large that it needs a model of its own."""
        return self.deviance_reduction > LARGE_EFFECT_DEVIANCE_REDUCTION and not self.is_linear

    def has_significant_amplitude_in(self, modal_fit: ModalFit) -> bool:
        """Return whether the effect would improve a modal model that contains other effects."""
        [cost_reduction] = modal_fit.cost_reduction_by_spectrum(self.torque_spectrum[None])
        return bool(cost_reduction >= MIN_SMALL_EFFECT_DEVIANCE_REDUCTION)

    def finding(self) -> Finding:
        """Return the finding that this effect is possible, but not established."""
        return Finding(
            kind=self.kind,
            sentence=(
                f"{self.phrase} would explain part of the record (chi-square "
                f"{self.deviance_reduction:.0f} with 1 degree of freedom). It was fitted to first "
                "order with the modes, and is not established."
            ),
            remedy="Repeat the session at twice and at half the amplitude.",
        )


def likeliest_small_effect(
    comparison: Comparison,
    modal_fit: ModalFit,
    plant: Plant,
    drag_spectrum: NDArray[np.complex128],
) -> SmallEffect | None:
    """Return the small effect that improves the modal model most, or None if none is significant.

    The effects are computed for the motion of `plant`, a beam close to the modal model.
    `drag_spectrum`, shape (K,), is that of a small air drag per metre of C_D d.
    """
    possible_effects: list[tuple[FindingKind, str, NDArray[np.complex128]]] = [
        *_possible_effects(comparison, modal_fit, plant),
        ("air drag", "Air drag", drag_spectrum),
    ]
    cost_reductions = modal_fit.cost_reduction_by_spectrum(
        [torque_spectrum for _, _, torque_spectrum in possible_effects]
    )
    best_index = int(np.argmax(cost_reductions))
    if cost_reductions[best_index] < MIN_SMALL_EFFECT_DEVIANCE_REDUCTION:
        return None
    finding_kind, effect_words, torque_spectrum = possible_effects[best_index]
    return SmallEffect(
        finding_kind, effect_words, torque_spectrum, float(cost_reductions[best_index])
    )


def _possible_effects(
    comparison: Comparison, modal_fit: ModalFit, plant: Plant
) -> Iterator[tuple[FindingKind, str, NDArray[np.complex128]]]:
    """Yield kind, description and torque spectrum, (K,), of small effects other than air drag."""
    force_spectra = NonlinearForceSpectra(comparison, plant)
    for mode_number in modal_fit.visible_mode_numbers:
        yield (
            "nonlinear stiffness",
            f"A stiffness of mode {mode_number} that depends on the deflection",
            force_spectra.torque_spectrum(NonlinearTerm("cubic stiffness", mode_number)),
        )
        yield (
            "nonlinear stiffness",
            f"A stiffness of mode {mode_number} that differs from side to side",
            force_spectra.torque_spectrum(NonlinearTerm("quadratic stiffness", mode_number)),
        )
    yield (
        "play",
        "Backlash between encoder and beam",
        backlash_spectrum(comparison, plant) / UNIT_BACKLASH_RAD,
    )
    yield "friction", "Dry friction between sensor and beam", _friction_spectrum(comparison)
    model_torque_nm = comparison.torque_predictor.torque(modal_fit.model)[0]
    largest_torque_nm = float(np.abs(model_torque_nm).max())
    if largest_torque_nm > 0 and math.isfinite(largest_torque_nm):
        for force_power, effect_words in ((3, "A gain of the torque that depends on its size"),
                             (2, "A gain of the torque that depends on its sign")):  # fmt: skip
            torque_spectrum = comparison.spectrum(
                model_torque_nm * (model_torque_nm / largest_torque_nm) ** (force_power - 1)
            )
            yield "nonlinear gain", effect_words, torque_spectrum


def _friction_spectrum(comparison: Comparison) -> NDArray[np.complex128]:
    """Return the torque spectrum of a dry friction of 1 N·m against the motion, (K,).

    The motion is that part of the angle that follows the reference: the sensor's noise moves the
    motor as well, and friction against that motion would be correlated with the noise.
    """
    angle_rad = comparison.angle_rad
    # The mirrored angle continues without a step at its end.
    mirrored_spectrum = np.fft.rfft(np.concatenate([angle_rad, angle_rad[::-1]]))
    fine_angle_rad = _SPEED_OVERSAMPLING * np.fft.irfft(
        mirrored_spectrum, 2 * _SPEED_OVERSAMPLING * angle_rad.size
    )
    speed_rad_s = np.gradient(fine_angle_rad) * (
        _SPEED_OVERSAMPLING * comparison.decimation.rate_hz
    )
    retained_fine_samples = slice(
        _SPEED_OVERSAMPLING * comparison.retained_samples.start,
        _SPEED_OVERSAMPLING * comparison.retained_samples.stop,
    )
    friction_torque = (speed_rad_s / np.hypot(speed_rad_s, _FRICTION_TRANSITION_SPEED_RAD_S))[
        retained_fine_samples
    ]
    friction_spectrum: NDArray[np.complex128] = (
        comparison.spectrum(friction_torque) / _SPEED_OVERSAMPLING
    )
    return friction_spectrum
