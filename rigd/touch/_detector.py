"""Sequential test that detects a touch in the innovations, which are white noise without a touch.

The innovations of the last ticks are correlated with templates of contacts (a bank of matched
filters). A template is a unit vector, so that the correlation with white noise is a normal deviate
of standard deviation 1. No linear test is more sensitive to the contact of the template. The
threshold follows from the tail of the normal distribution and the allowed rate of false alarms. Two
terms allow for errors of the model: a fraction of the predicted torque and shear, and the recent
mean square of the correlations, which grows while a chirp passes a mode whose modelled frequency is
slightly wrong.

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
from rigd.touch._templates import DetectorModel

RealArray = NDArray[np.float64]

_INDEPENDENT_TEMPLATE_FRACTION: Final = 0.5
"""Number of independent tests per template and tick, because templates overlap; measured at
thresholds of 4 to 5 standard deviations."""
_ERROR_ACCUMULATION_TICKS: Final = 8
"""Number of ticks over which errors of the model are assumed to accumulate."""
_RECENT_SAMPLE_WEIGHT: Final = 1 / 600
"""Weight of each new tick in the moving average of the correlations' mean square."""


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """Settings of the touch detector: allowed rate of false alarms, and assumed model error."""

    false_alarms_per_hour: float = 0.02
    """Expected number of false alarms in an hour of white noise."""
    model_tolerance: float = 0.01
    """Assumed error of the model, as a fraction of the predicted torque and shear."""

    def threshold(self, rate_hz: float, template_count: int) -> float:
        """Return the detection threshold, in standard deviations of a correlation with white noise.

        Parameters
        ----------
        rate_hz
            Ticks a second.
        template_count
            Number of templates with which innovations are correlated in a tick.

        Examples
        --------
        >>> from rigd.touch import DetectorSettings
        >>> round(DetectorSettings().threshold(1000.0, template_count=500), 2)
        6.69
        """
        tests_per_hour = (
            3600.0 * rate_hz * max(1.0, _INDEPENDENT_TEMPLATE_FRACTION * template_count)
        )
        return -NormalDist().inv_cdf(0.5 * self.false_alarms_per_hour / tests_per_hour)


class TouchDetector:
    """Detector of touches between beam and obstacle, from the readings of each tick.

    Until the first call of `arm`, it measures the standard deviations of the innovations of the
    beam at rest. Afterwards they replace the noise for which the model was designed.

    Parameters
    ----------
    detector_model
        Model of the beam and templates of contacts, from `rigd.touch.detector_model`.
    rate_hz
        Ticks a second.
    settings
        Sensitivity of the detector.

    Attributes
    ----------
    level
        Largest correlation in the last tick, divided by the threshold; a touch is detected above 1.
    noise
        Standard deviations of the whitened innovations of torque and shear at rest; 1 before `arm`.
    """

    __slots__ = (
        "_correlate",
        "_correlations",
        "_filter",
        "_is_armed",
        "_is_measuring_noise",
        "_mean_squares",
        "_recent_innovations",
        "_recent_mean_square",
        "_rest_square_sums",
        "_rest_ticks",
        "_squared_tolerance",
        "_threshold",
        "_window_slot",
        "_windows",
        "level",
        "noise",
    )

    def __init__(
        self, detector_model: DetectorModel, rate_hz: float, settings: DetectorSettings
    ) -> None:
        templates = detector_model.templates
        self._filter = InnovationFilter(detector_model.observed_beam)
        self._threshold = settings.threshold(rate_hz, len(templates))
        self._squared_tolerance = _ERROR_ACCUMULATION_TICKS * settings.model_tolerance**2
        self._is_armed = False
        self._is_measuring_noise = True
        self._rest_square_sums = [0.0, 0.0]
        self._rest_ticks = 0
        # Single precision: half as much memory to load into the cache in each tick.
        self._correlate = np.asfortranarray(templates, np.float32).dot
        self._correlations = np.empty(len(templates), np.float32)
        # The last innovations are stored twice in a ring, so that they are always contiguous.
        template_width = templates.shape[1]
        self._recent_innovations = np.zeros(2 * template_width, np.float32)
        self._windows = [
            self._recent_innovations[window_start : window_start + template_width]
            for window_start in range(2, template_width + 2, 2)
        ]
        self._window_slot = 0
        self._mean_squares = [1.0] * len(self._windows)
        self._recent_mean_square = 1.0
        self.noise = (1.0, 1.0)
        self.level = 0.0

    def arm(self) -> None:
        """Start to detect touches with the next tick."""
        self._filter.follow_sensor_zeros()
        if self._rest_ticks:
            torque_std, shear_std = (
                sqrt(square_sum / self._rest_ticks) for square_sum in self._rest_square_sums
            )
            self.noise = torque_std or 1.0, shear_std or 1.0
        self._rest_ticks = 0
        self._is_measuring_noise = False
        self._is_armed = True
        self._recent_innovations[:] = 0.0
        # In white noise the correlations have a mean square of 1.
        self._mean_squares = [1.0] * len(self._windows)
        self._recent_mean_square = 1.0

    def disarm(self) -> None:
        """Stop detecting touches until the next call of `arm`.

        The observer still follows the vibration, but not the zeros of torque and shear.
        """
        self._is_armed = False
        self._filter.hold_sensor_zeros()
        self.level = 0.0

    def contact_force_n(self, shear_n: float) -> float:
        """Return the approximate contact force in N: measured minus predicted base shear.

        The prediction is that of the free beam for the angle of the last tick.

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
        missed_tick_count: int = 0,
        angle_stale: bool = False,
        wrench_stale: bool = False,
    ) -> bool:
        """Process the readings of a tick; return whether a touch is detected.

        Parameters
        ----------
        angle_rad, torque_nm, shear_n, missed_tick_count, angle_stale, wrench_stale
            See `InnovationFilter.step`.
        """
        innovation_filter = self._filter
        innovation_filter.step(
            angle_rad,
            torque_nm,
            shear_n,
            missed_tick_count=missed_tick_count,
            angle_stale=angle_stale,
            wrench_stale=wrench_stale,
        )
        torque_innovation, shear_innovation = innovation_filter.whitened
        if not self._is_armed:
            if self._is_measuring_noise:
                self._rest_square_sums[0] += torque_innovation * torque_innovation
                self._rest_square_sums[1] += shear_innovation * shear_innovation
                self._rest_ticks += 1
            return False
        torque_noise, shear_noise = self.noise
        recent_innovations, window_slot = self._recent_innovations, self._window_slot
        half_length = recent_innovations.size >> 1
        recent_innovations[2 * window_slot] = recent_innovations[2 * window_slot + half_length] = (
            torque_innovation / torque_noise
        )
        recent_innovations[2 * window_slot + 1] = recent_innovations[
            2 * window_slot + 1 + half_length
        ] = shear_innovation / shear_noise
        correlations, mean_squares = self._correlations, self._mean_squares
        self._correlate(self._windows[window_slot], correlations)
        # A touch must not raise its own threshold: its correlations enter the average later.
        self._recent_mean_square += _RECENT_SAMPLE_WEIGHT * (
            mean_squares[window_slot] - self._recent_mean_square
        )
        mean_squares[window_slot] = float(correlations.dot(correlations)) / correlations.size
        self._window_slot = window_slot + 1 if window_slot + 1 < len(self._windows) else 0
        u, v = innovation_filter.predicted
        u /= torque_noise
        v /= shear_noise
        # Finding their indices takes a third of the time of finding the values.
        largest_correlation = max(
            correlations[correlations.argmax()], -correlations[correlations.argmin()]
        )
        squared_error = self._squared_tolerance * (u * u + v * v)
        # Not its root: a growing error is larger than in the moments before.
        threshold_factor = max(1.0, self._recent_mean_square) * sqrt(1.0 + squared_error)
        self.level = float(largest_correlation) / (self._threshold * threshold_factor)
        return self.level > 1.0
