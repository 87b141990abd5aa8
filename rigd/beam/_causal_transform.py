"""Responses of causal linear systems in time, by FFT with exponential damping.

A convolution by FFT is circular, and a lightly damped beam rings longer than any padding. So the
signal is multiplied by ``exp(-sigma t)`` before the FFT, which gives its Laplace transform on the
line ``s = sigma + j omega``. The transform is multiplied by the transfer function, transformed back
by the inverse FFT, and multiplied by ``exp(sigma t)``. The part of the response that the circular
convolution wraps round to the beginning has then decayed [1]_.

References
----------
.. [1] H. Dubner, J. Abate, "Numerical inversion of Laplace transforms by relating them to the
   finite Fourier cosine transform", J. ACM 15 (1968) 115-123.
"""

from math import ceil, inf

import numpy as np
from numpy.typing import NDArray

RealArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def fast_transform_length(min_length: int) -> int:
    """Return a length of at least `min_length`, at most an eighth more, whose FFT is fast.

    Parameters
    ----------
    min_length
        Smallest length, at least 1.
    """
    length_step = 1 << max(0, min_length.bit_length() - 4)
    return -(-min_length // length_step) * length_step


class CausalTransform:
    """Laplace transform on ``s = sigma + j omega`` of signals that begin at rest, and its inverse.

    Signals may have `oversampling` values per sample of the transform; both methods act on the last
    axis.

    Parameters
    ----------
    length
        Number of samples of the FFT: signal and padding.
    rate_hz
        Sampling rate.
    decay_exponent
        Product of sigma and the duration of the FFT. The part of a response that wraps round is
        reduced by the factor ``exp(decay_exponent)``; rounding errors grow by up to this factor.
    highest_hz
        Upper end of the band. The transform is zero above it, and has no values there.

    Attributes
    ----------
    length, rate_hz
        As given.
    sigma_per_s
        Real part of `s` in 1/s.
    s
        Laplace variable in rad/s, shape (bins,).

    Examples
    --------
    The response of ``1 / (s + 2)`` to a step:

    >>> import numpy as np
    >>> from rigd.beam import CausalTransform
    >>> line = CausalTransform.for_record(1000, rate_hz=500)
    >>> response = line.convolve(np.ones(1000), 1 / (line.s + 2))
    >>> print(f"{response[500]:.2f}, {(1 - np.exp(-2)) / 2:.2f}")
    0.43, 0.43
    """

    __slots__ = ("_weights", "length", "rate_hz", "s", "sigma_per_s")

    def __init__(
        self, length: int, rate_hz: float, decay_exponent: float, highest_hz: float = inf
    ) -> None:
        self.length, self.rate_hz = length, rate_hz
        self.sigma_per_s = decay_exponent * rate_hz / length
        bin_count = int(min(length // 2, highest_hz * length / rate_hz)) + 1
        omega_per_bin = 2j * np.pi * rate_hz / length
        self.s = np.asarray(self.sigma_per_s + omega_per_bin * np.arange(bin_count), np.complex128)
        self._weights: dict[tuple[int, int], RealArray] = {}

    @classmethod
    def for_record(
        cls,
        sample_count: int,
        rate_hz: float,
        padding_ratio: float = 1.1,
        decay_exponent: float = 6.6,
    ) -> "CausalTransform":
        """Return a transform for records of a given length, padded to a length whose FFT is fast.

        With the defaults, the part of a beam's response that wraps round is reduced to 1e-3 of its
        size. It has the form of a free decay, which no fit mistakes for the response. Rounding
        errors, and remainders of a decimation above the band, grow by exp(6.6 / 1.1) = 400.

        Parameters
        ----------
        sample_count
            Number of samples of the records.
        rate_hz
            Sampling rate.
        padding_ratio
            Length of the FFT relative to the record.
        decay_exponent
            Product of sigma and the duration of the FFT.
        """
        from scipy.fft import next_fast_len

        return cls(next_fast_len(ceil(padding_ratio * sample_count)), rate_hz, decay_exponent)

    def forward(
        self, signals: RealArray, *, oversampling: int = 1, holds_last_value: bool = False
    ) -> ComplexArray:
        """Return the Laplace transform of signals, divided by the sampling period, shape (…, bins).

        Parameters
        ----------
        signals
            Signals from the first sample on, shape (…, n).
        oversampling
            Number of values per sample.
        holds_last_value
            Whether the signals keep their last value after their end; otherwise they are zero.
        """
        padded_length = oversampling * self.length
        if holds_last_value:
            missing_count = padded_length - signals.shape[-1]
            signals = np.concatenate([signals, np.repeat(signals[..., -1:], missing_count, -1)], -1)
        damped_signals = signals * self._exponential_weight(-1, signals.shape[-1], oversampling)
        transform: ComplexArray = np.fft.rfft(damped_signals, padded_length)[..., : self.s.size]
        return transform if oversampling == 1 else transform / oversampling

    def inverse(
        self, transform: NDArray[np.complexfloating], samples: slice | int, *, oversampling: int = 1
    ) -> RealArray:
        """Return signals from their Laplace transforms, shape (…, m).

        Parameters
        ----------
        transform
            Transforms as `forward` returns them, shape (…, bins).
        samples
            Slice of the m values to return, or the number m to return the first m values.
        oversampling
            Number of values per sample.
        """
        if isinstance(samples, int):
            samples = slice(samples)
        if oversampling != 1:
            transform = oversampling * transform
        damped_signals = np.fft.irfft(transform, oversampling * self.length)[..., samples]
        signals: RealArray = (
            damped_signals * self._exponential_weight(1, samples.stop, oversampling)[samples]
        )
        return signals

    def inverse_at(
        self, transform: ComplexArray, fine_indices: NDArray[np.intp], oversampling: int
    ) -> RealArray:
        """Return single values of signals from their Laplace transforms, shape (k, p).

        Parameters
        ----------
        transform
            Transforms at all frequencies, shape (k, bins).
        fine_indices
            Indices of the values, shape (p,), with `oversampling` values per sample.
        oversampling
            Number of values per sample.
        """
        # One short FFT for each value within a sample: they fit into the cache, and take less than
        # half the time of one long FFT.
        shift_factors = np.ones((oversampling, self.s.size), dtype=np.complex128)
        shift_factors[1:] = np.exp(
            2j * np.pi / (oversampling * self.length) * np.arange(self.s.size)
        )
        np.cumprod(shift_factors, axis=0, out=shift_factors)
        if self.length % 2 == 0:
            # At the higher rate this bin and its mirror image are distinct.
            shift_factors[:, -1] *= 2
        signals = np.empty((len(transform), fine_indices.size))
        for row, spectrum in zip(signals, transform, strict=True):
            row[:] = np.fft.irfft(shift_factors * spectrum, self.length).T.ravel()[fine_indices]
        signals *= np.exp(self.sigma_per_s * fine_indices / (oversampling * self.rate_hz))
        return signals

    def convolve(self, signals: RealArray, response: ComplexArray) -> RealArray:
        """Return the response of a linear system to signals, in the shape of the signals.

        Parameters
        ----------
        signals
            Signals from the first sample on, shape (…, n).
        response
            Transfer function of the system at `s`.
        """
        return self.inverse(self.forward(signals) * response, signals.shape[-1])

    def _exponential_weight(
        self, exponent_sign: int, value_count: int, oversampling: int
    ) -> RealArray:
        """Return ``exp(exponent_sign sigma t)`` at the first values, from a cache if possible."""
        exponential_weight = self._weights.get((exponent_sign, oversampling))
        if exponential_weight is None or exponential_weight.size < value_count:
            time_s = np.arange(value_count) / (oversampling * self.rate_hz)
            exponential_weight = np.exp(exponent_sign * self.sigma_per_s * time_s)
            self._weights[exponent_sign, oversampling] = exponential_weight
        return exponential_weight[:value_count]
