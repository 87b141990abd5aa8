"""Small nonlinear effects, as columns in addition to the modal model.

To first order in its size each adds to the torque a column of known shape: stiffness that rises
with the deflection, air drag, backlash, dry friction, a sensor whose gain depends on the torque. An
effect that improves the modal model is fitted with it, so that it biases no mode. Its name is only
a hypothesis: a record seldom distinguishes between several small effects.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify._drag import small_drag
from analysis.identify._finding import Finding
from analysis.identify._nonlinear import ModalForces, Term
from analysis.identify._time_varying import UNIT_PLAY_RAD, play

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._finding import Kind
    from analysis.identify._modal_fit import ModalFit
    from analysis.identify._plant import Plant

SIGNIFICANT: Final = 16.0
"""Deviance that an effect must save: by chance one of nine does in two records of a thousand."""

LARGE: Final = 100.0
"""Deviance from which the first order may not suffice, and the effect is searched for by itself."""

_LINEAR: Final[frozenset[Kind]] = frozenset({"nonlinear gain", "friction"})
"""Effects that do not change the motion of the beam: the first order is exact."""

_SLIDING_RAD_S: Final = 0.01
"""Speed of the motor at which 70 % of the dry friction is reached; what it is exactly matters at
the turning points alone."""


@dataclass(frozen=True, slots=True)
class SmallEffect:
    """Small effect that would improve the modal model.

    Attributes
    ----------
    kind : str
        Kind of the `Finding`.
    words : str
        Description, as the beginning of a sentence.
    column : ndarray of complex, shape (K,)
        Spectrum of its torque in N·m per unit of its size.
    saved : float
        Reduction of deviance.
    """

    kind: Kind
    words: str
    column: NDArray[np.complex128]
    saved: float

    @property
    def linear(self) -> bool:
        """Return whether the first order in its size is exact."""
        return self.kind in _LINEAR

    @property
    def large(self) -> bool:
        """Return whether it needs a model of its own."""
        return self.saved > LARGE and not self.linear

    def finding(self) -> Finding:
        """Return the finding that names it as not established."""
        return Finding(
            kind=self.kind,
            sentence=(
                f"{self.words} would explain part of the record (chi-square {self.saved:.0f} with "
                "1 degree of freedom). It was fitted to first order with the modes, and is not "
                "established."
            ),
            remedy="Repeat the session at twice and at half the amplitude.",
        )


def small_effect(comparison: Comparison, modal: ModalFit, plant: Plant) -> SmallEffect | None:
    """Return the effect that would improve the modal model most; None if none does.

    The effects are computed for the motion of `plant`, a beam close to the modal model.
    """
    effects = list(_effects(comparison, modal, plant))
    saved = modal.saved_by(np.array([column for _, _, column in effects]))
    most = int(np.argmax(saved))
    if saved[most] < SIGNIFICANT:
        return None
    kind, words, column = effects[most]
    return SmallEffect(kind, words, column, float(saved[most]))


def _effects(
    comparison: Comparison, modal: ModalFit, plant: Plant
) -> Iterator[tuple[Kind, str, NDArray[np.complex128]]]:
    forces = ModalForces(comparison, plant)
    for mode in modal.visible:
        yield (
            "nonlinear stiffness",
            f"A stiffness of mode {mode} that depends on the deflection",
            forces.column(Term("cubic stiffness", mode)),
        )
        yield (
            "nonlinear stiffness",
            f"A stiffness of mode {mode} that differs from side to side",
            forces.column(Term("quadratic stiffness", mode)),
        )
    (drag,) = small_drag(comparison, plant)
    yield "air drag", "Air drag", drag
    yield "play", "Backlash between encoder and beam", play(comparison, plant) / UNIT_PLAY_RAD
    yield "friction", "Dry friction between sensor and beam", _friction(comparison)
    torque = comparison.prediction.torque(modal.model)[0]
    largest = float(np.abs(torque).max())
    if largest > 0 and math.isfinite(largest):
        for power, words in ((3, "A gain of the torque that depends on its size"),
                             (2, "A gain of the torque that depends on its sign")):  # fmt: skip
            column = comparison.spectrum(torque * (torque / largest) ** (power - 1))
            yield "nonlinear gain", words, column


def _friction(comparison: Comparison) -> NDArray[np.complex128]:
    """Return the spectrum of a dry friction of 1 N·m against the motor's motion, shape (K,)."""
    measurement = comparison.measurement
    angle = measurement.angle_from_rest(float(comparison.frequency_hz[-1]))
    speed = np.gradient(angle) * measurement.rate_hz
    torque = comparison.decimation.apply(speed / np.hypot(speed, _SLIDING_RAD_S))
    return comparison.spectrum(torque[comparison.retained])
