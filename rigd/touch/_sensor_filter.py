"""Filters between the torque and shear of the beam and the samples of the force sensor."""

from dataclasses import dataclass
from math import pi, sqrt
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class SensorFilter:
    """Low-pass filter and averaging that the samples of torque and shear have passed.

    Examples
    --------
    >>> from rigd.touch import SensorFilter
    >>> mean = SensorFilter(weights=(1 / 7,) * 7, spacing_s=1 / 7000)
    >>> round(1e6 * mean.weights_delay_s)  # µs
    429
    >>> float(round(abs(mean.response(2j * 3.14159 * 300.0)), 3))
    0.861
    """

    corner_hz: float = 0.0
    """Corner frequency in Hz of the sensor's low-pass filter; 0: the sensor has no filter."""
    order: int = 1
    """Order of the low-pass filter: 1, or 2 (Butterworth)."""
    weights: tuple[float, ...] = (1.0,)
    """Weights of the sensor's records whose weighted mean is a sample, oldest first, with the sum
    1."""
    spacing_s: float = 0.0
    """Time between two of the sensor's records."""

    @classmethod
    def for_records(
        cls, corner_hz: float, order: int, filter_kind: str, record_count: int, spacing_s: float
    ) -> "SensorFilter":
        """Return the filter of a sensor that sends several records per tick, which are averaged.

        Parameters
        ----------
        corner_hz, order
            Corner frequency and order of the sensor's low-pass filter.
        filter_kind
            How the records form a sample: "mean" of the records of one tick, or "triangle", their
            mean over two ticks with triangular weights.
        record_count
            Number of records per tick.
        spacing_s
            Time between two records.
        """
        record_weights = np.full(record_count, 1 / record_count)
        if filter_kind == "triangle":
            record_weights = np.convolve(record_weights, record_weights)
        return cls(corner_hz, order, tuple(record_weights.tolist()), spacing_s)

    @property
    def weights_delay_s(self) -> float:
        """Group delay in s of the weighted mean of the sensor's records."""
        return 0.5 * (len(self.weights) - 1) * self.spacing_s

    def response(self, s: ArrayLike) -> ComplexArray:
        """Return the transfer function of low-pass filter and weighted mean, delay included.

        Parameters
        ----------
        s
            Laplace variable in rad/s, of any shape, which the result has too.
        """
        laplace_points = np.asarray(s, dtype=np.complex128)
        record_ages_s = self.spacing_s * np.arange(len(self.weights))[::-1]
        filter_response: ComplexArray = np.exp(
            np.multiply.outer(laplace_points, -record_ages_s)
        ) @ np.array(self.weights)
        if self.corner_hz > 0:
            u = laplace_points / (2 * pi * self.corner_hz)
            filter_response /= 1 + u if self.order == 1 else 1 + u * (sqrt(2) + u)
        return filter_response


NO_FILTER: Final = SensorFilter()
"""Filter of a sensor that neither filters nor averages."""
