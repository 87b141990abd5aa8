"""Spectra of the free decays of the beam's modes over a record, and derivatives by their poles.

A beam that already rings when the record begins adds a sum of decays to the torque. Their
amplitudes are unknown, and their poles are those of the model. The same holds after a gap of the
measured angle. The spectra of the decays over the compared samples are geometric sums, in closed
form.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from rigd.beam import Pole

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray


_HUM_DECAY_EXPONENT: Final = 1e-6
"""Decay of a hum over the whole record, so small that the hum is practically steady."""


def count_decay_spectra(poles: Sequence[Pole]) -> int:
    """Return the number of decay spectra: two for each oscillating pole, one for a real pole."""
    return sum(1 + pole.oscillates for pole in poles)


class DecaySpectra:
    """Computation of the spectra of free decays of the beam, at given frequencies.

    Parameters
    ----------
    sample_count : int
        Number of samples. The decays start at the first one.
    rate_hz : float
        Rate of the samples.
    omega_rad_s : ndarray, shape (K,)
        Frequencies of the bins, multiples of ``2 pi rate_hz / sample_count``.
    """

    __slots__ = ("_duration_s", "_period_s", "_sample_rotation")

    def __init__(self, sample_count: int, rate_hz: float, omega_rad_s: NDArray[np.float64]) -> None:
        self._period_s = 1 / rate_hz
        self._duration_s = sample_count / rate_hz
        self._sample_rotation = np.exp(-1j * omega_rad_s * self._period_s)

    def spectra(self, poles: Sequence[Pole]) -> NDArray[np.complex128]:
        """Return the spectra of the decay ``exp(p t)`` of each pole p, shape (m, K).

        An oscillating decay has two rows: the spectra of its real and of its imaginary part.
        """
        return self._real_spectra(poles, self._transform_of_decay)

    def gradient(
        self, poles: Sequence[Pole], amplitudes: NDArray[np.float64]
    ) -> NDArray[np.complex128]:
        """Return the derivatives of ``amplitudes @ spectra(poles)`` by the unknowns, shape (k, K).

        Parameters
        ----------
        poles : sequence of Pole
            Poles with their derivatives by k unknowns.
        amplitudes : ndarray of float, shape (m,)
            Amplitude of each decay spectrum, in N·m.
        """
        weighted_derivatives = []
        amplitude_index = 0
        for pole in poles:
            if pole.oscillates:
                # t exp(p t) times the derivative of the pole, for the two amplitudes.
                pole_slope = (
                    complex(amplitudes[amplitude_index], -amplitudes[amplitude_index + 1])
                    * pole.derivative
                )
                weighted_derivatives += [pole_slope.real, -pole_slope.imag]
                amplitude_index += 2
            else:
                weighted_derivatives.append(amplitudes[amplitude_index] * pole.derivative.real)
                amplitude_index += 1
        real_parts: NDArray[np.float64] = np.array(weighted_derivatives).T @ self.growing_spectra(
            poles
        ).view(np.float64)
        spectrum_slopes: NDArray[np.complex128] = real_parts.view(np.complex128)
        return spectrum_slopes

    def growing_spectra(self, poles: Sequence[Pole]) -> NDArray[np.complex128]:
        """Return the spectra of ``t exp(p t)`` of each pole p, shape (m, K).

        The time t begins at the first sample.
        """
        return self._real_spectra(poles, self._transform_of_growing_decay)

    def torque_at(
        self,
        time_s: NDArray[np.float64],
        poles: Sequence[Pole],
        amplitudes: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return the torque in N·m of decays with given amplitudes at given times, shape (n,).

        Parameters
        ----------
        time_s : ndarray, shape (n,)
            Times since the first sample, in seconds.
        poles : sequence of Pole
            Poles of the decays.
        amplitudes : ndarray of float, shape (m,)
            Amplitude of each decay spectrum, in N·m.
        """
        torque_nm = np.zeros(time_s.size)
        amplitude_index = 0
        for pole in poles:
            decay = np.exp(pole.at_rad_s * time_s)
            torque_nm += amplitudes[amplitude_index] * decay.real
            if pole.oscillates:
                torque_nm += amplitudes[amplitude_index + 1] * decay.imag
            amplitude_index += 1 + pole.oscillates
        return torque_nm

    def hum(self, frequency_hz: Sequence[float]) -> NDArray[np.complex128]:
        """Return spectra of n oscillations over the whole record, shape (4 n, K).

        Each oscillation has four spectra: sine and cosine, each constant or growing from zero. Sums
        of them have any amplitude and phase at the beginning and any other at the end of the
        record. The difference leaks into distant bins.
        """
        no_derivatives = np.zeros(0, dtype=np.complex128)
        # A steady oscillation at the frequency of a bin would give 0 / 0, so it decays a little.
        decay_rate = _HUM_DECAY_EXPONENT / self._duration_s
        poles = [
            Pole(0, complex(-decay_rate, 2 * np.pi * hz), no_derivatives) for hz in frequency_hz
        ]
        return np.concatenate([self.spectra(poles), self.growing_spectra(poles)])

    def _real_spectra(
        self, poles: Sequence[Pole], spectrum_of_pole: Callable[[complex], NDArray[np.complex128]]
    ) -> NDArray[np.complex128]:
        """Return the decay spectra of poles: one for a real, two for an oscillating one, (m, K)."""
        real_spectra = np.empty((count_decay_spectra(poles), self._sample_rotation.size), complex)
        row_index = 0
        for pole in poles:
            pole_spectrum = spectrum_of_pole(pole.at_rad_s)
            if pole.oscillates:
                conjugate_spectrum = spectrum_of_pole(pole.at_rad_s.conjugate())
                np.multiply(pole_spectrum + conjugate_spectrum, 0.5, out=real_spectra[row_index])
                np.multiply(
                    pole_spectrum - conjugate_spectrum, -0.5j, out=real_spectra[row_index + 1]
                )
                row_index += 2
            else:
                real_spectra[row_index] = pole_spectrum
                row_index += 1
        return real_spectra

    def _transform_of_decay(self, pole: complex) -> NDArray[np.complex128]:
        """Return the discrete Fourier transform of ``exp(p t)`` over the samples, shape (K,)."""
        step_factor = np.exp(pole * self._period_s) * self._sample_rotation
        decay_spectrum: NDArray[np.complex128] = (1 - np.exp(pole * self._duration_s)) / (
            1 - step_factor
        )
        return decay_spectrum

    def _transform_of_growing_decay(self, pole: complex) -> NDArray[np.complex128]:
        """Return the discrete Fourier transform of ``t exp(p t)`` over the samples, shape (K,)."""
        step_factor = np.exp(pole * self._period_s) * self._sample_rotation
        end_value = np.exp(pole * self._duration_s)
        reciprocal = np.reciprocal(1 - step_factor)
        decay_spectrum: NDArray[np.complex128] = step_factor * reciprocal
        decay_spectrum *= (1 - end_value) * self._period_s
        decay_spectrum -= self._duration_s * end_value
        decay_spectrum *= reciprocal
        return decay_spectrum


class LaterDecaySpectra(DecaySpectra):
    """Spectra of decays that begin within the record and pass its low-pass filter.

    They begin at a tick of the record, and end with the last sample. The filter has no effect in
    the band, so their spectrum is the sum over the ticks instead of the samples.

    Parameters
    ----------
    sample_count : int
        Number of compared samples.
    rate_hz : float
        Rate of the compared samples.
    omega_rad_s : ndarray, shape (K,)
        Frequencies of the bins.
    decay_start_s : float
        Time from the first sample to the tick at which the decays begin, with full amplitude.
    tick_s : float
        Time between ticks.
    """

    __slots__ = ("_first_tick_factor", "_start_s", "_tick_rotation", "_tick_s")

    def __init__(
        self,
        sample_count: int,
        rate_hz: float,
        omega_rad_s: NDArray[np.float64],
        decay_start_s: float,
        tick_s: float,
    ) -> None:
        super().__init__(sample_count, rate_hz, omega_rad_s)
        self._start_s = decay_start_s
        self._duration_s -= decay_start_s
        self._tick_s = tick_s
        self._tick_rotation = np.exp(-1j * omega_rad_s * tick_s)
        self._first_tick_factor = (
            tick_s / self._period_s * np.exp(-1j * omega_rad_s * decay_start_s)
        )

    def torque_at(
        self,
        time_s: NDArray[np.float64],
        poles: Sequence[Pole],
        amplitudes: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return the torque in N·m of decays with given amplitudes; 0 before they begin, (n,).

        Parameters
        ----------
        time_s, poles, amplitudes
            As for `DecaySpectra`.
        """
        elapsed_s = time_s - self._start_s
        has_begun = elapsed_s >= 0
        torque_nm = np.zeros(time_s.size)
        torque_nm[has_begun] = super().torque_at(elapsed_s[has_begun], poles, amplitudes)
        return torque_nm

    def _transform_of_decay(self, pole: complex) -> NDArray[np.complex128]:
        """Return the transform of ``exp(p t)`` from the first tick to the last sample, (K,)."""
        begin_denominator = 1 - np.exp(pole * self._tick_s) * self._tick_rotation
        end_denominator = 1 - np.exp(pole * self._period_s) * self._sample_rotation
        decay_spectrum: NDArray[np.complex128] = (
            self._first_tick_factor / begin_denominator
            - np.exp(pole * self._duration_s) / end_denominator
        )
        return decay_spectrum

    def _transform_of_growing_decay(self, pole: complex) -> NDArray[np.complex128]:
        """Return the transform of ``t exp(p t)`` from the first tick to the last sample, (K,)."""
        tick_factor = np.exp(pole * self._tick_s) * self._tick_rotation
        step_factor = np.exp(pole * self._period_s) * self._sample_rotation
        end_value = np.exp(pole * self._duration_s)
        decay_spectrum: NDArray[np.complex128] = (
            self._first_tick_factor * self._tick_s * tick_factor / (1 - tick_factor) ** 2
        )
        decay_spectrum -= (
            end_value
            * (self._duration_s + self._period_s * step_factor / (1 - step_factor))
            / (1 - step_factor)
        )
        return decay_spectrum
