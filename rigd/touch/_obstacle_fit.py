"""Fit of the parameters of one kind of obstacle to the record of one touch."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rigd.touch._any_force import AnyForceLikelihood
from rigd.touch._free_motion import TouchRecord
from rigd.touch._obstacle_contact import (
    MAX_LN_STIFFNESS,
    MIN_LN_STIFFNESS,
    EffectPredictor,
    LocalMinima,
    ObstacleContact,
    ParameterRanges,
    WhitenedWindow,
    chi2_of,
    find_minima,
)
from rigd.touch._pair import TwoObstacleContact
from rigd.touch._posterior import Posterior, sample_posterior
from rigd.touch._tables import TouchTables
from rigd.touch._uncertainty_effects import uncertainty_effects
from rigd.touch.samples import FINAL_ESTIMATE_S, FIRST_ESTIMATE_S, RECORD_BEFORE_DETECTION_S

RealArray = NDArray[np.float64]

UNCERTAINTIES_END_S = 0.1
"""Time in s after the detection up to which at least the effects of uncertainties are computed."""
NEAR_TIP_FRACTION = 0.8
"""Fraction of the beam's length beyond which contacts are so short that finer time steps are
used."""
_MIN_RESIDUAL_VARIANCE = 1.2
"""Smallest assumed variance of the whitened residuals: more than 1, because the noise is estimated
from few samples."""
_MAX_MISFIT_STDS = 3.5
"""Number of standard deviations by which the sum of squared residuals of an explanation may exceed
its expectation."""
POOR_FIT_STDS = 2.0
"""Excess of the sum of squared residuals, in its standard deviations, above which an explanation is
doubtful: other kinds are tried, and the position's interval includes that for any force."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Explanation of a touch's record by one kind of obstacle, with fitted parameters."""

    kind: str
    """Kind of obstacle: rigid (one at rest), moving, yielding, two (at rest) or knock (an
    impact)."""
    posterior: Posterior
    """Posterior distribution of the obstacle's parameters."""
    parameters: RealArray
    """Likeliest parameters of the obstacle, shape (p,)."""
    chi2: float
    """Sum of squared whitened residuals for the likeliest parameters."""


class ObstacleFit:
    """Fit of obstacles to the record of one touch: its samples, windows, limits and residuals.

    Parameters
    ----------
    touch_tables
        Precomputed tables of the model at the record's rate.
    touch_record
        Samples from 0.3 s or more before the touch.
    detection_delay_s
        Longest assumed time in s from the touch to its detection.
    """

    def __init__(
        self, touch_tables: TouchTables, touch_record: TouchRecord, detection_delay_s: float
    ) -> None:
        rate_hz = touch_tables.rate_hz
        self.tables, self.rate_hz = touch_tables, rate_hz
        self.record_offset = max(
            0, touch_record.detection_index - round(RECORD_BEFORE_DETECTION_S * rate_hz)
        )
        record_end = min(
            touch_record.angle_rad.size,
            touch_record.detection_index + round(FINAL_ESTIMATE_S * rate_hz),
        )
        self.record = TouchRecord(
            rate_hz,
            touch_record.angle_rad[self.record_offset : record_end],
            touch_record.torque_nm[self.record_offset : record_end],
            None
            if touch_record.shear_n is None
            else touch_record.shear_n[self.record_offset : record_end],
            touch_record.detection_index - self.record_offset,
        )
        self.detection_index = self.record.detection_index
        self.quiet_samples = self.detection_index - round(detection_delay_s * rate_hz)
        self.motion = touch_tables.free_beam.motion(
            self.record, self.quiet_samples, self.quiet_samples - 4
        )
        self.samples_after_detection = self.record.angle_rad.size - self.detection_index
        self.position_range_m = (float(touch_tables.x_m[0]) + 0.002, float(touch_tables.x_m[-1]))
        self.effects_per_std: RealArray | None = None
        self._uncertainties_end_s = 0.0

    @property
    def first_touch_sample(self) -> int:
        """Index of the first sample of the record that may contain the touch."""
        return self.record_offset + self.quiet_samples

    @cached_property
    def any_force_likelihood(self) -> AnyForceLikelihood:
        """Likelihood of a touch at each position for an arbitrary force, from the first samples.

        Computing it takes as long as the rest of the estimate.
        """
        return self.tables.any_force_estimator.scan(self.window(FIRST_ESTIMATE_S))

    def pressing_sign(self) -> float:
        """Return the direction in which the beam presses on the obstacle, 1 or -1.

        It is opposite to the sum of the likeliest force on the beam over time.
        """
        return -1.0 if self.any_force_likelihood.force_n.sum() > 0 else 1.0

    # Data for the comparison of candidates

    def window(self, time_after_detection_s: float) -> WhitenedWindow:
        """Return the whitened innovations of the samples up to a time after the detection."""
        return WhitenedWindow.from_motion(
            self.motion,
            self.quiet_samples,
            self.sample_after_detection(time_after_detection_s),
            self.effects_per_std,
        )

    def sample_after_detection(self, time_after_detection_s: float) -> int:
        """Return the index of the sample at a time after the detection, limited to the record."""
        return self.detection_index + min(
            self.samples_after_detection, round(time_after_detection_s * self.rate_hz)
        )

    def include_uncertainties(
        self, likely_obstacle: RealArray, time_after_detection_s: float
    ) -> None:
        """Compute the effects of uncertainties on the samples up to a time after the detection.

        Only the first candidate of `likely_obstacle` is used. Effects that were computed before, up
        to `time_after_detection_s` or later, remain.
        """
        if self._uncertainties_end_s < time_after_detection_s:
            self._uncertainties_end_s = min(
                max(time_after_detection_s, UNCERTAINTIES_END_S),
                self.samples_after_detection / self.rate_hz,
            )
            record_window = WhitenedWindow.from_motion(
                self.motion,
                self.quiet_samples,
                self.sample_after_detection(self._uncertainties_end_s),
            )
            self.effects_per_std = uncertainty_effects(
                self.tables, self.record, likely_obstacle[:1], record_window
            )

    def parameter_ranges(self, parameter_count: int) -> ParameterRanges:
        """Return bounds and step sizes of the first `parameter_count` `OBSTACLE_PARAMETERS`."""
        t = self.motion.t
        return ParameterRanges(
            lower_limits=np.array(
                [self.position_range_m[0], t[self.quiet_samples + 1], MIN_LN_STIFFNESS, -3.0, 0.0]
            )[:parameter_count],
            upper_limits=np.array(
                [self.position_range_m[1], t[self.detection_index], MAX_LN_STIFFNESS, 3.0, 50.0]
            )[:parameter_count],
            derivative_step=np.array([2e-4, 2e-5, 2e-2, 2e-3, 2e-3])[:parameter_count],
            significant_change=np.array([3e-3, 1e-3, 1.0, 0.1, 0.1])[:parameter_count],
            smallest_std=np.array([1.5e-4, 1e-5, 2e-2, 5e-3, 5e-3])[:parameter_count],
            largest_std=np.array([0.02, 2e-3, 1.0, 0.3, 0.3])[:parameter_count],
        )

    def predictor(
        self, near_candidates: RealArray, *, uses_coarse_kernels: bool = False
    ) -> EffectPredictor:
        """Return the function that predicts the effects of obstacles near `near_candidates`.

        The function integrates with fine time steps if the candidates are near the tip. Otherwise
        the steps are of medium length, or long with `uses_coarse_kernels` set.
        """
        tables = self.tables
        is_near_tip = bool(
            np.median(near_candidates[:, 0]) > NEAR_TIP_FRACTION * tables.model.plant.beam.length_m
        )
        kernels = (
            tables.fine_kernels
            if is_near_tip
            else tables.coarse_kernels
            if uses_coarse_kernels
            else tables.middle_kernels
        )
        obstacle_contact = ObstacleContact(kernels, tables.x_m, self.motion)
        return lambda candidates, window: obstacle_contact.predict(candidates, window)[0]

    def two_obstacle_contact(self) -> TwoObstacleContact:
        """Return the model of the contact with two obstacles, in coarse time steps."""
        tables = self.tables
        obstacle_contact = ObstacleContact(tables.coarse_kernels, tables.x_m, self.motion)
        return TwoObstacleContact(obstacle_contact, tables.coarse_kernels, tables.cross_kernels)

    # Fit and its residuals

    def explain_by_kind(
        self,
        kind: str,
        predict_effect: EffectPredictor,
        sample_window: WhitenedWindow,
        start_candidates: RealArray,
        parameter_ranges: ParameterRanges,
    ) -> Explanation:
        """Return the explanation by one kind of obstacle, searched from `start_candidates`."""
        if start_candidates.shape[0] > 12:
            start_candidates = start_candidates[
                np.argsort(chi2_of(predict_effect, sample_window, start_candidates))[:12]
            ]
        minima = find_minima(
            predict_effect, sample_window, start_candidates, parameter_ranges, max_iterations=9
        )
        return self.explain_from_minima(
            kind, predict_effect, sample_window, minima, parameter_ranges
        )

    def explain_from_minima(
        self,
        kind: str,
        predict_effect: EffectPredictor,
        sample_window: WhitenedWindow,
        local_minima: LocalMinima,
        parameter_ranges: ParameterRanges,
        variance_factor: float = 1.0,
    ) -> Explanation:
        """Return the explanation whose posterior distribution is sampled around local minima.

        The variance of the residuals is multiplied by `variance_factor`.
        """
        parameter_count = local_minima.parameters.shape[1]
        near_best_indices = np.flatnonzero(local_minima.chi2 < local_minima.chi2.min() + 30)
        covariances = np.array(
            [
                np.linalg.inv(
                    local_minima.jacobian[k].T @ local_minima.jacobian[k]
                    + np.diag(1 / parameter_ranges.largest_std**2)
                )
                + np.diag(parameter_ranges.smallest_std**2)
                for k in near_best_indices
            ]
        )
        degrees_of_freedom = max(sample_window.whitened_innovations.size - parameter_count, 1)
        posterior = sample_posterior(
            lambda candidates: chi2_of(predict_effect, sample_window, candidates),
            local_minima.parameters[near_best_indices],
            covariances,
            (parameter_ranges.lower_limits, parameter_ranges.upper_limits),
            residual_variance=variance_factor
            * max(_MIN_RESIDUAL_VARIANCE, local_minima.chi2.min() / degrees_of_freedom),
            samples_per_round=120,
            max_rounds=5,
            sufficient_samples=150.0,
            smallest_std=parameter_ranges.smallest_std,
        )
        best_index = int(np.argmin(posterior.chi2))
        return Explanation(
            kind, posterior, posterior.samples[best_index], float(posterior.chi2[best_index])
        )

    def fits(
        self,
        explanation: Explanation,
        sample_window: WhitenedWindow,
        max_stds: float = _MAX_MISFIT_STDS,
    ) -> bool:
        """Return whether the residuals of an explanation are no larger than noise explains.

        Their sum of squares may exceed its expectation by `max_stds` standard deviations.
        """
        return bool(
            explanation.chi2 < self.max_chi2(sample_window.whitened_innovations.size, max_stds)
        )

    def max_chi2(self, expected_chi2: int, max_stds: float = _MAX_MISFIT_STDS) -> float:
        """Return the largest sum of squared residuals that noise explains.

        That is `max_stds` standard deviations more than the expectation `expected_chi2`.
        """
        noise_variance = 2 * expected_chi2**2 / (self.quiet_samples * self.motion.noise_stds.size)
        return float(expected_chi2 + max_stds * np.sqrt(2 * expected_chi2 + noise_variance))
