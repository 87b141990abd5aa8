"""What the exact model says the torque sensor measures, in time, for a measured angle."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rigd.beam import transfer

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.record import Record
    from rigd.beam import Damping

_DECAY_OVER_RECORD = 2.7
"""sigma T: what wraps around shrinks by exp(-2 sigma T), rounding errors grow by exp(sigma T)."""


def modelled_torque(record: Record, damping: Damping) -> NDArray[np.float64]:
    """Causal response of the exact model to the whole record's measured angle.

    The beam is taken to rest before the first sample, at the angle of the segment ``rest`` or else
    at the first angle. The record times exp(-sigma t) is padded with zeros and transformed: that
    is its transform on s = sigma + j omega, where what wraps around has decayed. There it is
    multiplied with ``G(s) + J_tool s²`` and the difference of the two channels' delays, then
    transformed back, and the exponential undone.

    Parameters
    ----------
    record
        Its angle, beam, tool inertia and delays are used.
    damping
        Parameters of Eq. 25.

    Returns
    -------
    ndarray, shape (n,)
        Torque in N·m as the sensor would give it at the record's time stamps.
    """
    samples = len(record.angle_rad)
    padded = 1 << (2 * samples - 1).bit_length()
    duration_s = samples / record.rate_hz
    sigma = _DECAY_OVER_RECORD / duration_s
    decay = np.exp(-sigma * np.arange(samples) / record.rate_hz)
    s = sigma + 2j * np.pi * np.fft.rfftfreq(padded, 1.0 / record.rate_hz)
    origin_rad = record.angle_rad[0] if record.rest_angle_rad is None else record.rest_angle_rad
    angle = np.fft.rfft((record.angle_rad - origin_rad) * decay, padded)
    response = transfer(s, record.beam, damping) + record.tool_inertia_kg_m2 * s**2
    response *= np.exp(-s * (record.torque_delay_s - record.angle_delay_s))
    return np.asarray(np.fft.irfft(angle * response, padded)[:samples] / decay)


def band_limited(
    values: NDArray[np.float64], rate_hz: float, band_hz: tuple[float, float]
) -> NDArray[np.float64]:
    """Values without what lies outside a band, by masking their Fourier transform (no delay).

    Parameters
    ----------
    values : ndarray, shape (n,)
    rate_hz
        Sampling rate.
    band_hz
        First and last frequency that pass.

    Returns
    -------
    ndarray, shape (n,)
    """
    padded = 1 << (2 * len(values) - 1).bit_length()
    frequency_hz = np.fft.rfftfreq(padded, 1.0 / rate_hz)
    spectrum = np.fft.rfft(values, padded)
    spectrum[(frequency_hz < band_hz[0]) | (frequency_hz > band_hz[1])] = 0.0
    return np.asarray(np.fft.irfft(spectrum, padded)[: len(values)])


def loudest_moment_s(
    values: NDArray[np.float64], rate_hz: float, frequency_hz: float, *, bandwidth: float = 0.1
) -> float:
    """Time at which the oscillation near a frequency is largest.

    The envelope is the magnitude of the analytic signal in ``frequency_hz (1 ± bandwidth)``, so
    it works for a chirp as for any other excitation.

    Returns
    -------
    float
        Seconds from the first value.
    """
    padded = 1 << (len(values) - 1).bit_length()
    frequencies_hz = np.fft.rfftfreq(padded, 1.0 / rate_hz)
    near = np.abs(frequencies_hz / frequency_hz - 1.0) <= bandwidth
    analytic = np.zeros(padded, dtype=np.complex128)
    analytic[: len(frequencies_hz)][near] = np.fft.rfft(values, padded)[near]
    envelope = np.abs(np.fft.ifft(analytic)[: len(values)])
    return float(np.argmax(envelope)) / rate_hz
