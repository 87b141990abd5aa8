"""Sequential test that detects a touch in the innovations, which are white noise without a touch.

The innovations of the last ticks are compared with the signatures of touches. Each comparison is a
product with a unit vector. In white noise the product is a normal deviate of standard deviation 1,
and no linear test is more sensitive to a touch at that position, with that time course and age. The
tail of the normal distribution sets the threshold for a stated rate of false alarms. Two terms
allow for the model's error: a fraction of the predicted torque and shear, and the recent mean
square of the comparisons, which grows while a chirp passes a mode whose frequency is slightly
wrong.

References
----------
M. Basseville, I. Nikiforov, Detection of Abrupt Changes (1993), chapter 7 (generalised likelihood
ratio of additive changes).
"""

from dataclasses import dataclass
from math import sqrt
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rigd.touch._innovations import InnovationFilter
from rigd.touch._signatures import DetectorModel

Real = NDArray[np.float64]

_INDEPENDENT_FRACTION: Final = 0.5
"""Fraction of the comparisons with overlapping signatures that count as independent, measured at 4
to 5 standard deviations."""
_ERROR_ACCUMULATION_TICKS: Final = 8
"""Number of ticks over which an error of the model is assumed to add up."""
_RECENT_WEIGHT: Final = 1 / 600
"""Weight of a tick in the recent mean square of the comparisons."""


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """Settings of the touch detector: false alarms an hour and tolerance of model errors."""

    false_alarms_per_hour: float = 0.02
    """Expected number of false alarms in an hour of white noise."""
    model_tolerance: float = 0.01
    """Assumed error of the model, as a fraction of the predicted torque and shear."""

    def threshold(self, rate_hz: float, signatures: int) -> float:
        """Return the detection threshold in standard deviations, for the false alarms an hour.

        Parameters
        ----------
        rate_hz
            Ticks a second.
        signatures
            Number of comparisons with signatures in a tick.

        Examples
        --------
        >>> from rigd.touch import DetectorSettings
        >>> round(DetectorSettings().threshold(1000.0, signatures=500), 2)
        6.69
        """
        tests_per_hour = 3600.0 * rate_hz * max(1.0, _INDEPENDENT_FRACTION * signatures)
        return -NormalDist().inv_cdf(0.5 * self.false_alarms_per_hour / tests_per_hour)


class TouchDetector:
    """Detector of the beam's touch of an obstacle, from the readings of each tick.

    Until the first `arm` it measures the innovations of the beam at rest. Afterwards innovations
    are compared with their standard deviations, not with the noise for which the model was
    designed.

    Parameters
    ----------
    beam
        Model and signatures of the beam, from `rigd.touch.detector_model`.
    rate_hz
        Ticks a second.
    settings
        Sensitivity of the detector.

    Attributes
    ----------
    level
        Largest comparison of the last tick over its threshold; above 1 there is a touch.
    noise
        Standard deviations of the whitened innovations of torque and shear at rest, after `arm`.
    """

    __slots__ = (
        "_armed",
        "_compare",
        "_compared",
        "_filter",
        "_last",
        "_mean_squares",
        "_measuring",
        "_recent",
        "_slot",
        "_squares",
        "_threshold",
        "_ticks",
        "_tolerance2",
        "_windows",
        "level",
        "noise",
    )

    def __init__(self, beam: DetectorModel, rate_hz: float, settings: DetectorSettings) -> None:
        signatures = beam.signatures
        self._filter = InnovationFilter(beam.observed)
        self._threshold = settings.threshold(rate_hz, len(signatures))
        self._tolerance2 = _ERROR_ACCUMULATION_TICKS * settings.model_tolerance**2
        self._armed = False
        self._measuring = True
        self._squares = [0.0, 0.0]
        self._ticks = 0
        # Single precision: half as much memory to load into the cache in each tick.
        self._compare = np.asfortranarray(signatures, np.float32).dot
        self._compared = np.empty(len(signatures), np.float32)
        # The last innovations are stored twice in a ring, so that they are always contiguous.
        signature_width = signatures.shape[1]
        self._last = np.zeros(2 * signature_width, np.float32)
        self._windows = [
            self._last[window_start : window_start + signature_width]
            for window_start in range(2, signature_width + 2, 2)
        ]
        self._slot = 0
        self._mean_squares = [1.0] * len(self._windows)
        self._recent = 1.0
        self.noise = (1.0, 1.0)
        self.level = 0.0

    def arm(self) -> None:
        """Start to detect touches with the next tick."""
        self._filter.follow_zeros()
        if self._ticks:
            torque_std, shear_std = (sqrt(square_sum / self._ticks) for square_sum in self._squares)
            self.noise = torque_std or 1.0, shear_std or 1.0
        self._ticks = 0
        self._measuring = False
        self._armed = True
        self._last[:] = 0.0
        # In white noise the comparisons have a mean square of 1.
        self._mean_squares = [1.0] * len(self._windows)
        self._recent = 1.0

    def disarm(self) -> None:
        """Stop detecting touches until the beam is free again and `arm` is called.

        The beam model still follows the readings of each tick, but not the zeros of the sensor.
        """
        self._armed = False
        self._filter.hold_zeros()
        self.level = 0.0

    def contact_force_n(self, shear_n: float) -> float:
        """Return the approximate force in N between beam and obstacle at the last tick.

        It is the measured base shear minus the shear predicted for the free beam.

        Parameters
        ----------
        shear_n
            Base shear measured in the last tick.
        """
        return shear_n - self._filter.predicted_shear_n

    def step(
        self,
        angle_rad: float,
        torque_nm: float,
        shear_n: float,
        *,
        missed: int = 0,
        angle_stale: bool = False,
        wrench_stale: bool = False,
    ) -> bool:
        """Process the readings of a tick; return True if they show that the beam touches.

        Parameters
        ----------
        angle_rad, torque_nm, shear_n, missed, angle_stale, wrench_stale
            See `InnovationFilter.step`.
        """
        innovation_filter = self._filter
        innovation_filter.step(
            angle_rad,
            torque_nm,
            shear_n,
            missed=missed,
            angle_stale=angle_stale,
            wrench_stale=wrench_stale,
        )
        torque_innovation, shear_innovation = innovation_filter.whitened
        if not self._armed:
            if self._measuring:
                self._squares[0] += torque_innovation * torque_innovation
                self._squares[1] += shear_innovation * shear_innovation
                self._ticks += 1
            return False
        torque_noise, shear_noise = self.noise
        recent_innovations, window_slot = self._last, self._slot
        half_length = recent_innovations.size >> 1
        recent_innovations[2 * window_slot] = recent_innovations[2 * window_slot + half_length] = (
            torque_innovation / torque_noise
        )
        recent_innovations[2 * window_slot + 1] = recent_innovations[
            2 * window_slot + 1 + half_length
        ] = shear_innovation / shear_noise
        correlations, mean_squares = self._compared, self._mean_squares
        self._compare(self._windows[window_slot], correlations)
        # A touch must not raise its own threshold: comparisons that may include it wait.
        self._recent += _RECENT_WEIGHT * (mean_squares[window_slot] - self._recent)
        mean_squares[window_slot] = float(correlations.dot(correlations)) / correlations.size
        self._slot = window_slot + 1 if window_slot + 1 < len(self._windows) else 0
        u, v = innovation_filter.predicted
        u /= torque_noise
        v /= shear_noise
        # Finding their indices takes a third of the time of finding the values.
        largest_correlation = max(
            correlations[correlations.argmax()], -correlations[correlations.argmin()]
        )
        squared_error = self._tolerance2 * (u * u + v * v)
        # Not its root: a growing error is larger than in the moments before.
        threshold_factor = max(1.0, self._recent) * sqrt(1.0 + squared_error)
        self.level = float(largest_correlation) / (self._threshold * threshold_factor)
        return self.level > 1.0
