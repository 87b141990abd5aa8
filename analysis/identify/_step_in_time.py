"""Score of a step of the stiffness in time: a clamp that slips, a beam that cracks.

If the stiffness of a ringing mode q of frequency omega rises by the fraction e at an instant, its
response changes to first order by that to a force ``-e omega² q`` from then on; its state is
continuous. In one sweep each mode is passed once, so such a step makes the modes inconsistent. The
largest reduction of the modal model's residual over all instants shows whether a step is a likely
cause.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from analysis.identify._data import fast_length

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._modal_fit import ModalFit

NAMED_ABOVE: Final = 20.0
"""Deviance saved above which a step is named: records without one stay below 13 or so."""

_INSTANTS: Final = 80
_FINER: Final = 3
"""Instants tried all along the record, and then on either side of the best."""

_PADDED: Final = 1.1
_DECAY: Final = 6.6
"""As in `analysis.identify._predictor`: on s = sigma + j omega what wraps round has decayed."""


@dataclass(frozen=True, slots=True)
class Step:
    """Step of the stiffness that explains most of a residual.

    Attributes
    ----------
    score : float
        First-order reduction of deviance.
    instant_s : float
        Since the record's first tick.
    relative_change : float
        Change of the stiffness, from before to after.
    """

    score: float
    instant_s: float
    relative_change: float

    @property
    def named(self) -> bool:
        """Return whether it explains more than chance would."""
        return self.score > NAMED_ABOVE

    @property
    def words(self) -> str:
        """Return the step in words, for sentences."""
        change = float(f"{100 * self.relative_change:.1g}")
        return (
            f"a step of the stiffness by about {change:+g} % near {self.instant_s:.0f} s (each "
            "mode is then what it was when it was passed)"
        )

    def as_json(self) -> dict[str, Any]:
        """Return the step as `json.dumps` takes it."""
        return {
            "name": "step in time",
            "score": self.score,
            "instant_s": self.instant_s,
            "relative_change": self.relative_change,
        }


def step_score(comparison: Comparison, fit: ModalFit) -> Step:
    """Return the stiffness step that best explains the residual of the modal model."""
    residual = fit.residual.view(np.float64)
    stiffened = _Stiffened(comparison, fit)
    best, instants = Step(0.0, 0.0, 0.0), np.linspace(0, comparison.samples, _INSTANTS + 2)[1:-1]
    spacing = float(instants[1] - instants[0])
    for _ in range(2):
        found = np.array([stiffened.spectrum(int(instant)) for instant in instants])
        rows = np.ascontiguousarray(found * fit.noise.weight).view(np.float64)
        rows = rows - (rows @ fit.span.T) @ fit.span
        sizes = np.einsum("ij,ij->i", rows, rows)
        sizes[sizes == 0] = np.inf
        along = -(rows @ residual)  # the residual is model less measurement
        scores = along**2 / sizes
        first = int(np.argmax(scores))
        if scores[first] > best.score:
            best = Step(
                score=float(scores[first]),
                instant_s=comparison.first_s
                + float(instants[first]) / comparison.decimation.rate_hz,
                relative_change=float(along[first] / sizes[first]),
            )
        instants = instants[first] + spacing * np.linspace(-1, 1, 2 * _FINER + 3)[1:-1]
        instants = instants[(instants > 0) & (instants < comparison.samples)]
    return best


class _Stiffened:
    """Torque by a higher stiffness from an instant on."""

    def __init__(self, comparison: Comparison, fit: ModalFit) -> None:
        self._comparison = comparison
        n, rate_hz = comparison.angle_rad.size, comparison.decimation.rate_hz
        self._length = fast_length(math.ceil(_PADDED * n))
        sigma = _DECAY * rate_hz / self._length
        s = sigma + 2j * np.pi * rate_hz / self._length * np.arange(self._length // 2 + 1)
        self._decay = np.exp(-sigma * np.arange(n) / rate_hz)
        angle = np.fft.rfft(comparison.angle_rad * self._decay, self._length)
        vibrations, answers = [], []
        for number, pole, residue in zip(
            fit.numbers, fit.model.poles_rad_s, fit.model.residues, strict=True
        ):
            if number:
                # Of G its part is inertia s⁴ / (s² + 2 xi omega s + omega²), but for constants.
                square, inertia = abs(pole) ** 2, 2 * abs(residue) / abs(pole) ** 3
                follows = s * s / (s * s - 2 * pole.real * s + square)
                vibrations.append(np.fft.irfft(angle * follows, self._length)[:n])
                turned = residue / (1j * abs(residue))
                answers.append(turned * inertia * square * follows)
        self._vibrations, self._answers = np.array(vibrations), np.array(answers)

    def spectrum(self, instant: int) -> NDArray[np.complex128]:
        """Return the spectrum of the torque by a step at a sample, per unit change, (K,)."""
        retained = self._comparison.retained
        later = self._vibrations.copy()
        later[:, : retained.start + instant] = 0.0
        forces = np.fft.rfft(later, self._length)
        torque = np.fft.irfft(np.sum(forces * self._answers, axis=0), self._length)
        torque = torque[: self._decay.size] / self._decay
        return self._comparison.spectrum(torque[retained])
