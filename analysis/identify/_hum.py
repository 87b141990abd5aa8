"""Narrow-band disturbance (hum) near a mode: a sinusoid that lasts while the beam does not respond.

At a sharp resonance a fit attributes a hum to the beam, and the residual of a wrong model resembles
a hum. Time separates them: a beam responds while the sweep passes, and rings down; a hum lasts. So
the residual's spectrum is taken over the times at which the model predicts next to nothing there,
and a hum must be the same in all of them.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify.noise import NoiseLine

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify._plant import Plant
    from analysis.identify.free_decay import Pole
    from analysis.identify.noise import NoiseSpectrum

_RESONANCE: Final = 3.0
"""Half-widths of a resonance (damping ratio times frequency) that count as the resonance."""

_RESONANCE_BINS: Final = 20
"""The same for the sharpest of them, in bins."""

_CLEARANCE: Final = 3.0
"""Range of the search for hum, in these units: farther off its skirts do not affect the mode."""

_BLOCK_S: Final = 4.0
_WRONG: Final = 0.3
"""Assumed relative error of the model's prediction in the test."""

_LEVEL: Final = 25.0
"""Power over that of the noise: chance exceeds it at one frequency in 7e10; hundreds are tested."""

_VARIES: Final = 0.3
"""Largest power of the unsteady part, beyond chance, relative to the hum's."""

_SILENT: Final = 0.2
"""Fraction of the record in which the beam has to be silent: at other times the signal may be its
own response to a steady excitation."""

_GROWS: Final = 0.3
"""Largest change of the amplitude from end to end, relative to its mean: what rings down slowly,
where a wrong model does not, loses more."""

_STEADILY: Final = 3.0
"""Amplitude of a hum over what is predicted of that frequency in those times: a beam that is driven
there all the time, by a multisine, leaves something steady wherever the model is wrong."""

_OVERSAMPLED: Final = 4
_STEPS: Final = 4


@dataclass(frozen=True, slots=True)
class Hum:
    """A narrow-band disturbance: a sinusoid in the torque.

    Attributes
    ----------
    frequency_hz : float
    phasor_nm : complex
        The torque is the real part of ``phasor_nm exp(2j pi frequency_hz t)``, t being the time
        since the first sample compared.
    """

    frequency_hz: float
    phasor_nm: complex

    @property
    def line(self) -> NoiseLine:
        """Return frequency and amplitude."""
        return NoiseLine(self.frequency_hz, float(abs(self.phasor_nm)))

    def torque(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the torque in N·m at some times, of their shape."""
        turning = np.exp(2j * np.pi * self.frequency_hz * time_s)
        torque: NDArray[np.float64] = (self.phasor_nm * turning).real
        return torque


def resonance_reach_hz(pole: Pole, spacing_hz: float) -> float:
    """Return the half width of a resonance, for bins that are `spacing_hz` apart."""
    return max(_RESONANCE * abs(pole.at_rad_s.real) / (2 * np.pi), _RESONANCE_BINS * spacing_hz)


def hum_near_modes(
    comparison: Comparison,
    plant: Plant,
    poles: tuple[Pole, ...],
    noise: NoiseSpectrum,
    decaying_nm: NDArray[np.float64],
) -> tuple[Hum, ...]:
    """Search for hum near each mode, including the hum that has been removed already.

    Parameters
    ----------
    comparison : Comparison
    plant : Plant
        Current estimate.
    poles : tuple of Pole
        Poles of the plant.
    noise : Noise
    decaying_nm : ndarray, shape (samples,)
        Torque of the estimated free decay. Part of it may be the hum, so it is not subtracted.

    Returns
    -------
    tuple of Hum
        At most one per mode.
    """
    predicted, _ = comparison.prediction.torque(plant)
    measured = comparison.torque_nm[comparison.retained] + comparison.hum_nm
    hz = comparison.frequency_hz
    blocks = _Blocks(comparison.samples, comparison.decimation.rate_hz)
    found: list[Hum] = []
    for pole in poles:
        if not pole.oscillates:
            continue
        at_hz = pole.at_rad_s.imag / (2 * np.pi)
        reach_hz = _CLEARANCE * resonance_reach_hz(pole, float(hz[1] - hz[0]))
        near = (max(at_hz - reach_hz, hz[0]), min(at_hz + reach_hz, hz[-1]))
        if near[1] - near[0] < reach_hz / 2:
            continue  # a wrong model may have its modes anywhere
        variance = float(np.interp(at_hz, hz, noise.power)) / comparison.samples
        hum = blocks.steady(measured - predicted, predicted, decaying_nm, near, variance)
        if hum is not None and all(
            abs(hum.frequency_hz - other.frequency_hz) > hz[1] - hz[0] for other in found
        ):
            found.append(hum)
    return tuple(found)


class _Blocks:
    """Overlapping windows over a record, with weights."""

    def __init__(self, samples: int, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self.time_s = np.arange(samples) / rate_hz
        half = round(_BLOCK_S * rate_hz / 2)
        self.window = np.hanning(2 * half + 1)[:-1]
        self.parts = np.arange(0, samples - 2 * half + 1, half)[:, None] + np.arange(2 * half)

    def steady(
        self,
        residual: NDArray[np.float64],
        predicted: NDArray[np.float64],
        decaying: NDArray[np.float64],
        near_hz: tuple[float, float],
        variance: float,
    ) -> Hum | None:
        """Find a steady sinusoid in the residual.

        Parameters
        ----------
        residual, predicted, decaying : ndarray, shape (samples,)
            Torque in N·m.
        near_hz : tuple of float
            Range of frequencies.
        variance : float
            Variance of one sample of noise as strong as that at these frequencies, in N²·m².
        """
        if not len(self.parts):
            return None
        chance = variance * float(self.window @ self.window)
        # Power of noise, of what a wrong model may leave, and of what it does not predict.
        power = chance + (_WRONG * self._largest(predicted, *near_hz)) ** 2
        power += self._largest(decaying, *near_hz) ** 2
        weight = np.zeros(residual.size)
        for part, ratio in zip(self.parts, chance / power, strict=True):
            weight[part] += ratio * self.window
        if weight.mean() < _SILENT:
            return None
        hum, growth_per_s = self._strongest(residual, weight, near_hz)
        if abs(growth_per_s) * residual.size > _GROWS * self.rate_hz:
            return None
        if abs(hum.phasor_nm) ** 2 * weight.sum() < 4 * variance * _LEVEL:
            return None
        if abs(hum.phasor_nm) < _STEADILY * self._amplitude(predicted, weight, hum.frequency_hz):
            return None
        steady = hum.phasor_nm / 2 * self.window.sum()
        turned = residual * np.exp(-2j * np.pi * hum.frequency_hz * self.time_s)
        varies = np.abs(turned[self.parts] @ self.window - steady) ** 2 / power
        if np.sum(varies - 1) > _VARIES * np.sum(abs(steady) ** 2 / power):
            return None
        return hum

    def _largest(
        self, values: NDArray[np.float64], first_hz: float, last_hz: float
    ) -> NDArray[np.float64]:
        """Return the largest value of each block's spectrum between two frequencies, (blocks,)."""
        count = math.ceil((last_hz - first_hz) * _BLOCK_S * 2) + 1
        hz = np.linspace(first_hz, last_hz, count)
        turn = np.exp(-2j * np.pi * np.outer(np.arange(self.window.size) / self.rate_hz, hz))
        spectra = values[self.parts] @ (self.window[:, None] * turn)
        largest: NDArray[np.float64] = np.abs(spectra).max(axis=1)
        return largest

    def _amplitude(
        self, values: NDArray[np.float64], weight: NDArray[np.float64], at_hz: float
    ) -> float:
        """Return the largest amplitude of a sinusoid within a bin of a frequency."""
        steps = np.linspace(-1, 1, 2 * _OVERSAMPLED + 1) / values.size
        turn = np.exp(-2j * np.pi * np.outer(at_hz / self.rate_hz + steps, np.arange(values.size)))
        return 2 * float(np.abs(turn @ (weight * values)).max() / weight.sum())

    def _strongest(
        self,
        residual: NDArray[np.float64],
        weight: NDArray[np.float64],
        near_hz: tuple[float, float],
    ) -> tuple[Hum, float]:
        """Fit the sinusoid that explains most of a residual; return its growth per s as well."""
        length = _OVERSAMPLED * residual.size
        hz = np.fft.rfftfreq(length, 1 / self.rate_hz)
        near = slice(*np.searchsorted(hz, near_hz))
        spectrum = np.fft.rfft(weight * residual, length)[near]
        frequency_hz = float(hz[near][np.argmax(np.abs(spectrum))])
        middle_s = float(weight @ self.time_s / weight.sum())
        time_s = self.time_s - middle_s
        spread = float(weight @ time_s**2)
        for _ in range(_STEPS):
            turned = 2 * weight * residual * np.exp(-2j * np.pi * frequency_hz * time_s)
            phasor = complex(turned.sum()) / float(weight.sum())
            # What grows at a right angle to it is a frequency somewhat off (Gauss-Newton).
            growth = complex(turned @ time_s) / spread / phasor
            frequency_hz += growth.imag / (2 * math.pi)
        at_start = phasor * cmath.exp(-2j * math.pi * frequency_hz * middle_s)
        return Hum(frequency_hz, at_start), growth.real
