"""Narrow-band disturbance (hum) near a mode: a sinusoid that lasts while the beam does not respond.

At a sharp resonance a fit attributes a hum to the beam, and the residual of a wrong model resembles
a hum. Time separates them: a beam responds while the sweep passes, and rings down, but a hum lasts.
So the spectrum of the residual is computed over the times at which the model predicts almost no
response near the mode, and a hum must be the same in all of them.
"""

from __future__ import annotations

import cmath
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.identify.noise import Hum

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.identify._comparison import Comparison
    from analysis.identify.noise import NoiseSpectrum
    from rigd.beam import Plant, Pole

_RESONANCE_HALF_WIDTHS: Final = 3.0
"""Half width of the frequency range that counts as a resonance, in multiples of damping ratio times
frequency."""

_MIN_RESONANCE_BINS: Final = 20
"""Minimum half width, in bins, of the frequency range that counts as a resonance."""

_HUM_SEARCH_HALF_WIDTHS: Final = 3.0
"""Half width of the frequency range in which a hum is searched for, in half widths of the
resonance. A hum outside this range does not affect the mode."""

_HUM_BLOCK_S: Final = 4.0
"""Duration in seconds of the overlapping blocks of the record in which a hum is searched for."""

_ASSUMED_RELATIVE_MODEL_ERROR: Final = 0.3
"""Relative error of the predicted torque that the test for hum assumes."""

_MIN_HUM_POWER_RATIO: Final = 25.0
"""Minimum power of a hum relative to the noise. Chance exceeds this power at one frequency in 7e10,
and hundreds are tested."""

_MAX_UNSTEADY_POWER_RATIO: Final = 0.3
"""Largest power of the difference between the blocks of a record and a steady hum, beyond noise,
relative to the power of the hum."""

_MIN_SILENT_RECORD_FRACTION: Final = 0.2
"""Minimum fraction of the record in which the beam has to be silent. At other times a sinusoid may
be the response of the beam to a steady excitation."""

_MAX_RELATIVE_HUM_GROWTH: Final = 0.3
"""Largest change of the amplitude of a hum over the record, relative to its mean. The slow decay of
a mode, which a wrong model does not predict, changes more."""

_MIN_HUM_TO_PREDICTION_RATIO: Final = 3.0
"""Minimum amplitude of a hum relative to the predicted torque of that frequency in the silent
times. A steadily driven beam, as by a multisine, leaves a steady residual wherever the model is
wrong."""

_FREQUENCY_OVERSAMPLING: Final = 4
"""Number of frequency points per bin in the search for a hum."""

_FREQUENCY_GAUSS_NEWTON_STEPS: Final = 4
"""Number of Gauss-Newton steps for the frequency of a hum."""


def resonance_half_width_hz(pole: Pole, spacing_hz: float) -> float:
    """Return the half width in hertz of the frequency range that belongs to a resonance.

    It is at least `_MIN_RESONANCE_BINS` bins, which are `spacing_hz` apart.
    """
    return max(
        _RESONANCE_HALF_WIDTHS * abs(pole.at_rad_s.real) / (2 * np.pi),
        _MIN_RESONANCE_BINS * spacing_hz,
    )


def find_hum_near_modes(
    comparison: Comparison,
    plant: Plant,
    poles: tuple[Pole, ...],
    noise: NoiseSpectrum,
    free_decay_nm: NDArray[np.float64],
) -> tuple[Hum, ...]:
    """Return the hum found near each mode, including the hum that has already been removed.

    There is at most one hum per mode. `free_decay_nm` is the torque of the estimated free decay.
    Part of it may be the hum, so it is not subtracted.
    """
    predicted_nm, _ = comparison.torque_predictor.torque(plant)
    measured_nm = comparison.torque_nm[comparison.retained_samples] + comparison.hum_nm
    frequency_hz = comparison.frequency_hz
    record_blocks = _HumBlocks(comparison.sample_count, comparison.decimation.rate_hz)
    found_hums: list[Hum] = []
    for pole in poles:
        if not pole.oscillates:
            continue
        mode_hz = pole.at_rad_s.imag / (2 * np.pi)
        half_width_hz = _HUM_SEARCH_HALF_WIDTHS * resonance_half_width_hz(
            pole, float(frequency_hz[1] - frequency_hz[0])
        )
        search_range_hz = (
            max(mode_hz - half_width_hz, frequency_hz[0]),
            min(mode_hz + half_width_hz, frequency_hz[-1]),
        )
        if search_range_hz[1] - search_range_hz[0] < half_width_hz / 2:
            continue  # a wrong model may have modes outside the band
        noise_variance = (
            float(np.interp(mode_hz, frequency_hz, noise.power)) / comparison.sample_count
        )
        hum = record_blocks.find_steady_hum(
            measured_nm - predicted_nm, predicted_nm, free_decay_nm, search_range_hz, noise_variance
        )
        if hum is not None and all(
            abs(hum.frequency_hz - other_hum.frequency_hz) > frequency_hz[1] - frequency_hz[0]
            for other_hum in found_hums
        ):
            found_hums.append(hum)
    return tuple(found_hums)


class _HumBlocks:
    """Overlapping windowed time blocks of a record, in which a steady sinusoid is searched for."""

    def __init__(self, sample_count: int, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self.time_s = np.arange(sample_count) / rate_hz
        half_block_length = round(_HUM_BLOCK_S * rate_hz / 2)
        self.window = np.hanning(2 * half_block_length + 1)[:-1]
        self.block_indices = np.arange(
            0, sample_count - 2 * half_block_length + 1, half_block_length
        )[:, None] + np.arange(2 * half_block_length)

    def find_steady_hum(
        self,
        residual_nm: NDArray[np.float64],
        predicted_nm: NDArray[np.float64],
        free_decay_nm: NDArray[np.float64],
        search_range_hz: tuple[float, float],
        noise_variance: float,
    ) -> Hum | None:
        """Return a sinusoid in the residual that is steady over the record, or None.

        The torques have the shape (samples,), and `search_range_hz` is the range of the search.
        `noise_variance` is the variance in N²·m² of one sample of noise that is as strong as the
        noise near these frequencies.
        """
        if not len(self.block_indices):
            return None
        noise_power = noise_variance * float(self.window @ self.window)
        # Power of the noise, of the possible error of the model, and of the free decay.
        block_power = (
            noise_power
            + (
                _ASSUMED_RELATIVE_MODEL_ERROR
                * self._largest_block_magnitudes(predicted_nm, *search_range_hz)
            )
            ** 2
        )
        block_power += self._largest_block_magnitudes(free_decay_nm, *search_range_hz) ** 2
        sample_weights = np.zeros(residual_nm.size)
        for block_samples, block_weight in zip(
            self.block_indices, noise_power / block_power, strict=True
        ):
            sample_weights[block_samples] += block_weight * self.window
        if sample_weights.mean() < _MIN_SILENT_RECORD_FRACTION:
            return None
        hum, growth_per_s = self._fit_strongest_sinusoid(
            residual_nm, sample_weights, search_range_hz
        )
        if abs(growth_per_s) * residual_nm.size > _MAX_RELATIVE_HUM_GROWTH * self.rate_hz:
            return None
        if (
            abs(hum.phasor_nm) ** 2 * sample_weights.sum()
            < 4 * noise_variance * _MIN_HUM_POWER_RATIO
        ):
            return None
        if abs(hum.phasor_nm) < _MIN_HUM_TO_PREDICTION_RATIO * self._largest_amplitude(
            predicted_nm, sample_weights, hum.frequency_hz
        ):
            return None
        block_phasor = hum.phasor_nm / 2 * self.window.sum()
        demodulated_torque_nm = residual_nm * np.exp(-2j * np.pi * hum.frequency_hz * self.time_s)
        relative_variation = (
            np.abs(demodulated_torque_nm[self.block_indices] @ self.window - block_phasor) ** 2
            / block_power
        )
        if np.sum(relative_variation - 1) > _MAX_UNSTEADY_POWER_RATIO * np.sum(
            abs(block_phasor) ** 2 / block_power
        ):
            return None
        return hum

    def _largest_block_magnitudes(
        self, torque_nm: NDArray[np.float64], first_hz: float, last_hz: float
    ) -> NDArray[np.float64]:
        """Return the largest magnitude of the spectrum of each block's torque, shape (blocks,).

        Only frequencies from `first_hz` to `last_hz` are considered.
        """
        frequency_count = math.ceil((last_hz - first_hz) * _HUM_BLOCK_S * 2) + 1
        frequencies_hz = np.linspace(first_hz, last_hz, frequency_count)
        phase_rotation = np.exp(
            -2j * np.pi * np.outer(np.arange(self.window.size) / self.rate_hz, frequencies_hz)
        )
        block_spectra = torque_nm[self.block_indices] @ (self.window[:, None] * phase_rotation)
        largest_magnitudes: NDArray[np.float64] = np.abs(block_spectra).max(axis=1)
        return largest_magnitudes

    def _largest_amplitude(
        self, torque_nm: NDArray[np.float64], sample_weights: NDArray[np.float64], centre_hz: float
    ) -> float:
        """Return the largest amplitude in N·m of a sinusoid near a frequency in a weighted torque.

        Frequencies within one bin of `centre_hz` are considered.
        """
        frequency_steps = np.linspace(-1, 1, 2 * _FREQUENCY_OVERSAMPLING + 1) / torque_nm.size
        phase_rotation = np.exp(
            -2j
            * np.pi
            * np.outer(centre_hz / self.rate_hz + frequency_steps, np.arange(torque_nm.size))
        )
        return 2 * float(
            np.abs(phase_rotation @ (sample_weights * torque_nm)).max() / sample_weights.sum()
        )

    def _fit_strongest_sinusoid(
        self,
        residual_nm: NDArray[np.float64],
        sample_weights: NDArray[np.float64],
        search_range_hz: tuple[float, float],
    ) -> tuple[Hum, float]:
        """Fit the sinusoid that explains most of a residual.

        Return it as a hum, with the relative growth of its amplitude per second.
        """
        padded_length = _FREQUENCY_OVERSAMPLING * residual_nm.size
        frequencies_hz = np.fft.rfftfreq(padded_length, 1 / self.rate_hz)
        bins_in_range = slice(*np.searchsorted(frequencies_hz, search_range_hz))
        spectrum = np.fft.rfft(sample_weights * residual_nm, padded_length)[bins_in_range]
        frequency_hz = float(frequencies_hz[bins_in_range][np.argmax(np.abs(spectrum))])
        mean_time_s = float(sample_weights @ self.time_s / sample_weights.sum())
        centred_time_s = self.time_s - mean_time_s
        time_variance = float(sample_weights @ centred_time_s**2)
        for _ in range(_FREQUENCY_GAUSS_NEWTON_STEPS):
            demodulated_torque_nm = (
                2
                * sample_weights
                * residual_nm
                * np.exp(-2j * np.pi * frequency_hz * centred_time_s)
            )
            mean_phasor = complex(demodulated_torque_nm.sum()) / float(sample_weights.sum())
            # Growth in quadrature means that the frequency is slightly wrong (Gauss-Newton).
            growth_per_s = (
                complex(demodulated_torque_nm @ centred_time_s) / time_variance / mean_phasor
            )
            frequency_hz += growth_per_s.imag / (2 * math.pi)
        initial_phasor = mean_phasor * cmath.exp(-2j * math.pi * frequency_hz * mean_time_s)
        return Hum(frequency_hz, initial_phasor), growth_per_s.real
