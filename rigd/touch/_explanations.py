"""Explanations of the record of one touch: candidates of each kind, and their residuals.

The usual explanation of the innovations of torque and base shear is a springy obstacle at rest,
whose contact is integrated in time with all bounces. Alternatives are two obstacles, an obstacle
that moves or yields, an impact (one pulse of force, reported as the kind "knock"), and an arbitrary
force. `_combined_estimate` decides which of them are reported.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rigd.touch._any_force import AnyForceLikelihood
from rigd.touch._free_motion import TouchRecord
from rigd.touch._impact import ImpactResponse
from rigd.touch._kernels import ContactKernels
from rigd.touch._obstacle_contact import (
    MAX_LN_STIFFNESS,
    MIN_LN_STIFFNESS,
    LocalMinima,
    ObstacleContact,
    ParameterRanges,
    Prediction,
    WhitenedWindow,
    chi2_of,
    find_minima,
)
from rigd.touch._pair import TwoObstacleContact
from rigd.touch._posterior import Posterior, sample_posterior
from rigd.touch._tables import GRID_COMPARISON_S, TouchTables
from rigd.touch._uncertainty_effects import uncertainty_effects
from rigd.touch.samples import FINAL_S, FIRST_S, HISTORY_S

RealArray = NDArray[np.float64]

_STAGE_ENDS_S = (FIRST_S, 0.1, FINAL_S)
"""Times in s after the detection at which the stages of the explanation end; each stage explains a
longer part of the record. Later stages follow only if an obstacle at rest explains the earlier ones
and the position is still uncertain."""
_UNCERTAINTIES_END_S = 0.1
"""Time in s after the detection up to which at least the effects of uncertainties are computed."""
_MIN_STAGE_GROWTH = 1.2
"""Smallest ratio of the available time to the end of a stage for which the stage is not left
out."""
_PRECISE_STD_M = 2e-3
"""Standard deviation in m of the position below which no longer part of the record is explained."""
_RANDOM_CANDIDATES = 96
"""Number of candidates that a stage draws from the posterior distribution of the previous stage."""
NEAR_TIP_FRACTION = 0.8
"""Fraction of the beam's length beyond which contacts are so short that finer time steps are
used."""
_NEARBY_OFFSETS_M = np.array([-4e-3, -2e-3, 2e-3, 4e-3])
"""Distances in m from the best candidates near the tip to additional candidates."""
_TIP_FRACTION = 0.95
"""Fraction of the beam's length beyond which later samples do not improve the position, because
many short contacts can be fitted at any position."""

_MIN_RESIDUAL_VARIANCE = 1.2
"""Smallest assumed variance of the whitened residuals: more than 1, because the noise is estimated
from few samples."""
_TWO_OBSTACLES_VARIANCE = 4.0
"""Factor on the variance of the residuals if two obstacles explain the record clearly better than
one: errors of the model then decide which of several minima is the lowest."""
DECISIVE_CHI2_DIFFERENCE = 16.0
"""Difference in the sum of squared residuals that decides between two kinds of obstacle."""
CHANCE_CHI2_REDUCTION = 9.0
"""Reduction of the sum of squared residuals up to which a moving or yielding obstacle is not
preferred to one at rest. Chance causes a larger reduction in 1 % of the touches of an obstacle at
rest."""
_MIN_PAIR_CHI2_REDUCTION = 5.0
"""Smallest reduction of the sum of squared residuals, compared with one obstacle, with which two
obstacles are a possible explanation."""
_RELATIVE_PAIR_POSITIONS = np.array(
    [[0.85, 1.3], [0.7, 1.5], [0.55, 1.75], [1.3, 0.85], [1.6, 0.65]]
)
"""Pairs of obstacles that are compared with a single one: positions of the first and the second,
divided by that of the single one. The search varies all parameters but the first position."""
_MAX_EQUIVALENT_CHI2_INCREASE = 50.0
"""Increase of the sum of squared residuals with the first of these pairs, compared with a single
obstacle, above which no pair is tried. Only soft obstacles near the axis stay below it."""
_MIN_EARLY_CHI2_REDUCTION = 0.8
"""Smallest reduction of the sum of squared residuals by two obstacles after a few iterations with
which their search continues."""
_MAX_MISFIT_STDS = 3.5
"""Number of standard deviations by which the sum of squared residuals of an explanation may exceed
its expectation."""
POOR_FIT_STDS = 2.0
"""Excess of the sum of squared residuals, in its standard deviations, above which an explanation is
doubtful: other kinds are tried, and the position's interval includes that for any force."""
_MAX_LATER_MISFIT_STDS = 2.5
"""Number of standard deviations by which the sum of squared residuals of the samples that a stage
adds may exceed its expectation. Bounces amplify small errors of the model, so that beyond this the
result of the previous stage is more accurate."""

_START_SPEEDS_M_PER_S = np.array([-1.5, -0.7, -0.3, -0.1, 0.1, 0.25, 0.5])
"""Speeds in m/s of moving obstacles from which the search starts."""
_START_MOBILITIES_M_PER_N_S = np.array([0.01, 0.04, 0.15, 0.6])
"""Mobilities (speed per force) of yielding obstacles from which the search starts."""
_START_STIFFNESSES_N_PER_M = np.array([300.0, 3000.0, 30000.0])
"""Stiffnesses in N/m of moving or yielding obstacles from which the search starts."""


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


@dataclass(frozen=True, slots=True)
class ExplainedRecord:
    """Possible explanations of a touch's record, and the part of the record that they explain."""

    explanations: list[Explanation]
    """One explanation for each kind of obstacle tried; the first is an obstacle at rest."""
    window: WhitenedWindow
    """Part of the record that is explained."""
    later_samples_contradict: bool
    """Whether the samples after `window` contradict an obstacle at rest."""
    other_kinds_untried: bool
    """Whether a kind of obstacle that was not tried may be likelier."""
    first_obstacle_positions_m: RealArray
    """Positions in m of the first of two obstacles, for pairs that explain the record as well as
    one obstacle does."""


class ExplanationSearch:
    """Search for the kinds and parameters of obstacles that explain the record of one touch.

    Parameters
    ----------
    touch_tables
        Precomputed tables of the model at the record's rate.
    touch_record
        Samples from 0.3 s or more before the touch.
    detection_delay_s
        Longest assumed time in s from the touch to its detection.
    previous_search
        Search in a shorter record of the same touch, from whose results this search starts; None:
        the search starts from a grid of candidates.
    """

    def __init__(
        self,
        touch_tables: TouchTables,
        touch_record: TouchRecord,
        detection_delay_s: float,
        previous_search: "ExplanationSearch | None" = None,
    ) -> None:
        rate_hz = touch_tables.rate_hz
        self.tables, self.rate_hz, self.given_record = touch_tables, rate_hz, touch_record
        self.record_offset = max(0, touch_record.detected - round(HISTORY_S * rate_hz))
        record_end = min(
            touch_record.angle_rad.size, touch_record.detected + round(FINAL_S * rate_hz)
        )
        self.record = TouchRecord(
            rate_hz,
            touch_record.angle_rad[self.record_offset : record_end],
            touch_record.torque_nm[self.record_offset : record_end],
            None
            if touch_record.shear_n is None
            else touch_record.shear_n[self.record_offset : record_end],
            touch_record.detected - self.record_offset,
        )
        self.detected = self.record.detected
        self.quiet_samples = self.detected - round(detection_delay_s * rate_hz)
        self.motion = touch_tables.free_beam.motion(
            self.record, self.quiet_samples, self.quiet_samples - 4
        )
        self.samples_after_detection = self.record.angle_rad.size - self.detected
        self.position_range_m = (float(touch_tables.x_m[0]) + 0.002, float(touch_tables.x_m[-1]))
        self.effects_per_std: RealArray | None = None
        self._uncertainties_end_s = 0.0
        covers_grid = (
            previous_search is not None
            and previous_search.samples_after_detection >= round(GRID_COMPARISON_S * rate_hz)
        )
        self._grid_candidates: RealArray = (
            previous_search._grid_candidates
            if previous_search and covers_grid
            else self._best_of_grid()
        )
        self._resting_stage: tuple[Explanation, float] | None
        self._resting_stage = None if previous_search is None else previous_search._resting_stage

    @property
    def first_touch_sample(self) -> int:
        """Index of the first sample of the record that may contain the touch."""
        return self.record_offset + self.quiet_samples

    @property
    def begins_before_window(self) -> bool:
        """Whether the likeliest obstacle is touched at the earliest instants that are searched."""
        return bool(self.grid_starts[0, 1] < self.motion.t[self.quiet_samples] + 2.5 / self.rate_hz)

    @property
    def likely_first_sample(self) -> int:
        """Index of the record's sample nearest to the likeliest touch of the grid search."""
        after_quiet_s = float(self.grid_starts[0, 1] - self.motion.t[self.quiet_samples])
        return self.first_touch_sample + round(after_quiet_s * self.rate_hz)

    @property
    def misfit(self) -> float:
        """Mean square residual of an obstacle at rest in the first samples; noise alone gives 1."""
        return float(self._first_minima.chi2.min() / self._first_samples.data.size)

    def explain(self, *, first: bool) -> ExplainedRecord:
        """Return the explanations of the record by the kinds of obstacle that are likely.

        With `first` set, only obstacles at rest are tried, because other kinds take longer.
        """
        resting_explanation, sample_window, two_obstacles, later_samples_contradict = (
            self._explain_in_stages()
        )
        explanations = [resting_explanation]
        other_kinds_untried = False
        first_obstacle_positions_m: RealArray = np.zeros(0)
        if two_obstacles is None:
            needs_other_kinds = not self.fits(
                resting_explanation, sample_window, POOR_FIT_STDS
            ) or self._may_move_or_yield(resting_explanation, sample_window)
            if needs_other_kinds and first:
                other_kinds_untried = True
            elif needs_other_kinds:
                explanations += self._explain_by_other_kinds(sample_window)
            if self.fits(resting_explanation, sample_window):
                two_obstacles, first_obstacle_positions_m = self._explain_by_two(
                    resting_explanation, sample_window
                )
                # If two obstacles are much likelier than one, another kind may be as likely as two.
                other_kinds_untried |= (
                    first
                    and two_obstacles is not None
                    and two_obstacles.chi2 < resting_explanation.chi2 - DECISIVE_CHI2_DIFFERENCE
                )
        if two_obstacles is not None:
            explanations.append(two_obstacles)
        return ExplainedRecord(
            explanations,
            sample_window,
            later_samples_contradict=later_samples_contradict,
            other_kinds_untried=other_kinds_untried,
            first_obstacle_positions_m=first_obstacle_positions_m,
        )

    def _explain_in_stages(self) -> tuple[Explanation, WhitenedWindow, Explanation | None, bool]:
        """Explain successively longer parts of the record by an obstacle at rest.

        Return four results: the explanation by an obstacle at rest; the part of the record that it
        explains; the explanation of the same part by two obstacles, or None unless only two explain
        its later samples; and whether the samples after the part contradict an obstacle at rest.
        """
        available_s = self.samples_after_detection / self.rate_hz
        stage_ends_s = [
            stage_end_s
            for stage_end_s in _STAGE_ENDS_S
            if _MIN_STAGE_GROWTH * stage_end_s <= available_s
        ]
        stage_ends_s.append(available_s)
        previous_stage: tuple[Explanation, WhitenedWindow] | None = None
        if self._resting_stage is None:
            start_candidates = self._add_neighbours(_distinct_minima(self._first_minima))
        else:
            at_rest, explained_s = self._resting_stage
            stage_ends_s = [
                stage_end_s for stage_end_s in stage_ends_s if stage_end_s > explained_s
            ]
            start_candidates = self._next_candidates(at_rest)
            self._include_uncertainties(start_candidates, max([explained_s, *stage_ends_s[:1]]))
            stage_window = self.window(explained_s)
            [previous_chi2] = chi2_of(
                self.predictor(start_candidates[:1]), stage_window, start_candidates[:1]
            )
            previous_stage = replace(at_rest, chi2=float(previous_chi2)), stage_window
            if self._is_sufficient(*previous_stage, explained_s):
                stage_ends_s = []
        for stage_end_s in stage_ends_s:
            self._include_uncertainties(start_candidates, stage_end_s)
            stage_window = self.window(stage_end_s)
            at_rest = self.explain_by_kind(
                "rigid",
                self.predictor(start_candidates),
                stage_window,
                start_candidates,
                self.parameter_ranges(3),
            )
            if previous_stage is not None and self._later_samples_fit_worse(
                at_rest, stage_window, *previous_stage
            ):
                two_obstacles, _ = self._explain_by_two(at_rest, stage_window)
                if two_obstacles is not None and self.fits(
                    two_obstacles, stage_window, POOR_FIT_STDS
                ):
                    return at_rest, stage_window, two_obstacles, False
                # In later bounces the search may miss the minimum, so that they contradict nothing.
                is_contradicted = stage_end_s <= _UNCERTAINTIES_END_S and self._may_move_or_yield(
                    at_rest, stage_window
                )
                return *previous_stage, None, is_contradicted
            previous_stage = at_rest, stage_window
            self._resting_stage = at_rest, stage_end_s
            if self._is_sufficient(at_rest, stage_window, stage_end_s):
                break
            start_candidates = self._next_candidates(at_rest)
        assert previous_stage is not None  # there is at least one stage, or an earlier one
        return *previous_stage, None, False

    def _is_sufficient(
        self,
        resting_explanation: Explanation,
        sample_window: WhitenedWindow,
        after_detection_s: float,
    ) -> bool:
        """Return whether a longer part of the record would not improve the explanation."""
        x_m = resting_explanation.posterior.mean(0)
        is_precise = (
            resting_explanation.posterior.std(0) < _PRECISE_STD_M
            or x_m > _TIP_FRACTION * self.position_range_m[1]
        )
        return after_detection_s > FIRST_S and bool(
            is_precise or not self.fits(resting_explanation, sample_window)
        )

    def _include_uncertainties(self, likely_obstacle: RealArray, after_detection_s: float) -> None:
        """Compute the effects of uncertainties on the samples up to a time after the detection.

        Only the first candidate of `likely_obstacle` is used. Effects that were computed before, up
        to `after_detection_s` or later, remain.
        """
        if self._uncertainties_end_s < after_detection_s:
            self._uncertainties_end_s = min(
                max(after_detection_s, _UNCERTAINTIES_END_S),
                self.samples_after_detection / self.rate_hz,
            )
            whole_window = WhitenedWindow.from_motion(
                self.motion,
                self.quiet_samples,
                self.sample_after_detection(self._uncertainties_end_s),
            )
            self.effects_per_std = uncertainty_effects(
                self.tables, self.record, likely_obstacle[:1], whole_window
            )

    def _next_candidates(self, resting_explanation: Explanation) -> RealArray:
        """Return candidate obstacles for the next stage, from the last stage's explanation."""
        return np.vstack(
            [resting_explanation.parameters, self._draw_candidates(resting_explanation.posterior)]
        )

    @cached_property
    def any_force_likelihood(self) -> AnyForceLikelihood:
        """Likelihood of a touch at each position for an arbitrary force, from the first samples.

        Computing it takes as long as the rest of the estimate.
        """
        return self.tables.any_force_estimator.scan(self.window(FIRST_S))

    # Data for the comparison of candidates

    def window(self, after_detection_s: float) -> WhitenedWindow:
        """Return the whitened innovations of the samples up to a time after the detection."""
        return WhitenedWindow.from_motion(
            self.motion,
            self.quiet_samples,
            self.sample_after_detection(after_detection_s),
            self.effects_per_std,
        )

    def sample_after_detection(self, after_detection_s: float) -> int:
        """Return the index of the sample at a time after the detection, limited to the record."""
        return self.detected + min(
            self.samples_after_detection, round(after_detection_s * self.rate_hz)
        )

    def parameter_ranges(self, parameter_count: int) -> ParameterRanges:
        """Return bounds and step sizes of the first `parameter_count` `OBSTACLE_PARAMETERS`."""
        t = self.motion.t
        return ParameterRanges(
            low=np.array(
                [self.position_range_m[0], t[self.quiet_samples + 1], MIN_LN_STIFFNESS, -3.0, 0.0]
            )[:parameter_count],
            high=np.array(
                [self.position_range_m[1], t[self.detected], MAX_LN_STIFFNESS, 3.0, 50.0]
            )[:parameter_count],
            derivative_step=np.array([2e-4, 2e-5, 2e-2, 2e-3, 2e-3])[:parameter_count],
            significant_change=np.array([3e-3, 1e-3, 1.0, 0.1, 0.1])[:parameter_count],
            smallest_std=np.array([1.5e-4, 1e-5, 2e-2, 5e-3, 5e-3])[:parameter_count],
            largest_std=np.array([0.02, 2e-3, 1.0, 0.3, 0.3])[:parameter_count],
        )

    def predictor(self, near_candidates: RealArray, *, coarse: bool = False) -> Prediction:
        """Return the function that predicts the effects of obstacles near `near_candidates`.

        The function integrates with fine time steps if the candidates are near the tip. Otherwise
        the steps are of medium length, or long with `coarse` set.
        """
        tables = self.tables
        is_near_tip = bool(
            np.median(near_candidates[:, 0]) > NEAR_TIP_FRACTION * tables.model.plant.beam.length_m
        )
        kernels = (
            tables.fine_kernels
            if is_near_tip
            else tables.coarse_kernels
            if coarse
            else tables.middle_kernels
        )
        obstacle_contact = ObstacleContact(kernels, tables.x_m, self.motion)
        return lambda candidates, window: obstacle_contact.predict(candidates, window)[0]

    # Springy obstacle at rest

    def _best_of_grid(self) -> RealArray:
        """Return the four likeliest candidates of the grid at each position, shape (k, 3)."""
        grid_window = self.window(GRID_COMPARISON_S)
        candidate_grid = self.tables.candidate_grid(
            grid_window.end_sample - grid_window.first_sample
        )
        grid_candidates, chi2 = candidate_grid.integrate(self.motion, grid_window, self.detected)
        grid_candidates = grid_candidates[np.lexsort((chi2, grid_candidates[:, 0]))]
        candidates_per_position = grid_candidates.shape[0] // np.unique(grid_candidates[:, 0]).size
        best_candidates: RealArray = grid_candidates.reshape(-1, candidates_per_position, 3)[
            :, :4
        ].reshape(-1, 3)
        return best_candidates

    @cached_property
    def _first_samples(self) -> WhitenedWindow:
        """Whitened innovations of the first samples, with which the best of the grid are compared.

        Only the uncertainty of the free motion is included, not its effect on the contact.
        """
        return WhitenedWindow.from_motion(
            self.motion, self.quiet_samples, self.sample_after_detection(FIRST_S)
        )

    @cached_property
    def grid_starts(self) -> RealArray:
        """The 12 candidates of the grid that explain the first samples best, shape (12, 3)."""
        coarse_contact = ObstacleContact(self.tables.coarse_kernels, self.tables.x_m, self.motion)
        chi2 = chi2_of(
            lambda rows, window: coarse_contact.predict(rows, window)[0],
            self._first_samples,
            self._grid_candidates,
        )
        return self._grid_candidates[np.argsort(chi2)[:12]]

    @cached_property
    def _first_minima(self) -> LocalMinima:
        """Local minima of the sum of squared residuals that are found from `grid_starts`."""
        predict_effect = self.predictor(self.grid_starts, coarse=True)
        return find_minima(
            predict_effect,
            self._first_samples,
            self.grid_starts,
            self.parameter_ranges(3),
            max_iterations=7,
        )

    def _add_neighbours(self, candidates: RealArray) -> RealArray:
        """Return candidate obstacles; near the tip, add neighbours of the two best.

        Minima are close together near the tip.
        """
        if np.median(candidates[:, 0]) <= NEAR_TIP_FRACTION * self.tables.model.plant.beam.length_m:
            return candidates
        nearby_candidates = np.repeat(candidates[None, :2], _NEARBY_OFFSETS_M.size, axis=0)
        nearby_candidates[:, :, 0] = np.clip(
            nearby_candidates[:, :, 0] + _NEARBY_OFFSETS_M[:, None], *self.position_range_m
        )
        return np.vstack([candidates, nearby_candidates.reshape(-1, candidates.shape[1])])

    def _draw_candidates(self, posterior: Posterior) -> RealArray:
        """Return random candidates near samples of a posterior distribution, shape (k, p)."""
        rng = np.random.default_rng(1)
        drawn_candidates = posterior.samples[
            rng.choice(posterior.weights.size, _RANDOM_CANDIDATES, p=posterior.weights)
        ]
        parameter_count = drawn_candidates.shape[1]
        parameter_ranges = self.parameter_ranges(parameter_count)
        random_spread = np.array(
            [
                max(posterior.std(i), parameter_ranges.smallest_std[i])
                for i in range(parameter_count)
            ]
        )
        return np.clip(
            drawn_candidates + 0.5 * random_spread * rng.standard_normal(drawn_candidates.shape),
            parameter_ranges.low,
            parameter_ranges.high,
        )

    def explain_by_kind(
        self,
        kind: str,
        predict_effect: Prediction,
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
        return self._explain_from_minima(
            kind, predict_effect, sample_window, minima, parameter_ranges
        )

    def _explain_from_minima(
        self,
        kind: str,
        predict_effect: Prediction,
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
        degrees = max(sample_window.data.size - parameter_count, 1)
        posterior = sample_posterior(
            lambda rows: chi2_of(predict_effect, sample_window, rows),
            local_minima.parameters[near_best_indices],
            covariances,
            (parameter_ranges.low, parameter_ranges.high),
            residual_variance=variance_factor
            * max(_MIN_RESIDUAL_VARIANCE, local_minima.chi2.min() / degrees),
            samples_per_round=120,
            max_rounds=5,
            sufficient_samples=150.0,
            smallest_std=parameter_ranges.smallest_std,
        )
        best_index = int(np.argmin(posterior.chi2))
        return Explanation(
            kind, posterior, posterior.samples[best_index], float(posterior.chi2[best_index])
        )

    # Other kinds

    def fits(
        self,
        explanation: Explanation,
        sample_window: WhitenedWindow,
        max_stds: float = _MAX_MISFIT_STDS,
    ) -> bool:
        """Return whether the residuals of an explanation are no larger than noise explains.

        Their sum of squares may exceed its expectation by `max_stds` standard deviations.
        """
        return bool(explanation.chi2 < self.max_chi2(sample_window.data.size, max_stds))

    def max_chi2(self, expected_chi2: int, max_stds: float = _MAX_MISFIT_STDS) -> float:
        """Return the largest sum of squared residuals that noise explains.

        That is `max_stds` standard deviations more than the expectation `expected_chi2`.
        """
        noise_variance = 2 * expected_chi2**2 / (self.quiet_samples * self.motion.noise_stds.size)
        return float(expected_chi2 + max_stds * np.sqrt(2 * expected_chi2 + noise_variance))

    def _later_samples_fit_worse(
        self,
        longer_explanation: Explanation,
        longer_window: WhitenedWindow,
        shorter_explanation: Explanation,
        shorter_window: WhitenedWindow,
    ) -> bool:
        """Return whether the shorter window is explained, but not the samples added to it."""
        added_samples = longer_window.data.size - shorter_window.data.size
        added_chi2 = longer_explanation.chi2 - shorter_explanation.chi2
        return self.fits(shorter_explanation, shorter_window) and added_chi2 > self.max_chi2(
            added_samples, _MAX_LATER_MISFIT_STDS
        )

    def _may_move_or_yield(
        self, resting_explanation: Explanation, sample_window: WhitenedWindow
    ) -> bool:
        """Return whether motion or yielding of the obstacle reduces the residuals clearly."""
        motion_parameters = np.array([[-0.05, 0.0], [0.05, 0.0], [0.0, 0.02]])
        start_candidates = np.hstack(
            [
                np.tile(resting_explanation.parameters, (len(motion_parameters), 1)),
                motion_parameters,
            ]
        )
        is_free = np.hstack(
            [
                np.ones((len(motion_parameters), resting_explanation.parameters.size), dtype=bool),
                motion_parameters != 0,
            ]
        )
        obstacle_contact = ObstacleContact(self.tables.middle_kernels, self.tables.x_m, self.motion)
        pressing_sign = obstacle_contact.pressing_sign(resting_explanation.parameters)
        minima = find_minima(
            lambda candidates, sample_window: obstacle_contact.predict(
                candidates, sample_window, pressing_sign
            )[0],
            sample_window,
            start_candidates,
            self.parameter_ranges(5),
            max_iterations=5,
            free_parameters=is_free,
        )
        return bool(minima.chi2.min() < resting_explanation.chi2 - CHANCE_CHI2_REDUCTION)

    def _explain_by_other_kinds(self, sample_window: WhitenedWindow) -> list[Explanation]:
        """Return three explanations: by a moving obstacle, a yielding obstacle and an impact."""
        any_force_likelihood, pressing_sign = self.any_force_likelihood, self.pressing_sign()
        likeliest_positions = any_force_likelihood.x_m[
            np.argsort(-any_force_likelihood.log_likelihood)[:24]
        ]
        touch_instants_s = self.motion.t[self.quiet_samples + 2 : self.detected + 1 : 2]
        explanations = []
        for obstacle_kind, motion_values in (
            ("moving", _START_SPEEDS_M_PER_S),
            ("yielding", _START_MOBILITIES_M_PER_N_S),
        ):
            start_grid = np.meshgrid(
                likeliest_positions,
                touch_instants_s,
                np.log(_START_STIFFNESSES_N_PER_M),
                motion_values,
                indexing="ij",
            )
            start_candidates = np.stack([grid_axis.ravel() for grid_axis in start_grid], axis=1)
            coarse_predictor = self._moving_predictor(
                obstacle_kind, self.tables.coarse_kernels, pressing_sign
            )
            for comparison_s, candidate_count in ((GRID_COMPARISON_S, 80), (FIRST_S, 10)):
                chi2 = chi2_of(coarse_predictor, self.window(comparison_s), start_candidates)
                start_candidates = start_candidates[np.argsort(chi2)[:candidate_count]]
            predict_effect, parameter_ranges = (
                self._moving_predictor(obstacle_kind, self.tables.middle_kernels, pressing_sign),
                self._moving_parameter_ranges(obstacle_kind),
            )
            if sample_window.end_sample > self.sample_after_detection(FIRST_S):
                early_minima = find_minima(
                    predict_effect,
                    self.window(FIRST_S),
                    start_candidates,
                    parameter_ranges,
                    max_iterations=6,
                )
                start_candidates = early_minima.parameters
            explanations.append(
                self.explain_by_kind(
                    obstacle_kind, predict_effect, sample_window, start_candidates, parameter_ranges
                )
            )
        obstacle_contact = ObstacleContact(self.tables.middle_kernels, self.tables.x_m, self.motion)
        impact_response = ImpactResponse(obstacle_contact, self.tables.middle_kernels, 2)
        start_candidates = impact_response.start_candidates(self.window(FIRST_S), self.detected, 10)
        obstacle_ranges = self.parameter_ranges(3)
        parameter_ranges = impact_response.parameter_ranges(
            self.position_range_m, (obstacle_ranges.low[1], obstacle_ranges.high[1])
        )
        explanations.append(
            self.explain_by_kind(
                "knock", impact_response.predict, sample_window, start_candidates, parameter_ranges
            )
        )
        return explanations

    def two_obstacle_contact(self) -> TwoObstacleContact:
        """Return the model of the contact with two obstacles, in coarse time steps."""
        tables = self.tables
        obstacle_contact = ObstacleContact(tables.coarse_kernels, tables.x_m, self.motion)
        return TwoObstacleContact(obstacle_contact, tables.coarse_kernels, tables.cross_kernels)

    def _explain_by_two(
        self, resting_explanation: Explanation, sample_window: WhitenedWindow
    ) -> tuple[Explanation | None, RealArray]:
        """Return the explanation by two obstacles, and possible positions in m of the first one.

        The explanation is None if one obstacle explains the record about as well. With the first of
        two obstacles at one of the positions, two explain the first samples as well as one.
        """
        two_contacts = self.two_obstacle_contact()
        parameter_ranges = two_contacts.parameter_ranges(self.parameter_ranges(3))
        # The first samples show in less time whether more iterations are worthwhile.
        early_window = (
            self.window(_UNCERTAINTIES_END_S)
            if sample_window.end_sample > self.sample_after_detection(_UNCERTAINTIES_END_S)
            else sample_window
        )
        start_pairs = two_contacts.start_pairs(
            resting_explanation.parameters, early_window, parameter_ranges, 2
        )
        minima = find_minima(
            two_contacts.predict_channels,
            early_window,
            start_pairs,
            parameter_ranges,
            max_iterations=4,
        )
        single_obstacle = resting_explanation.parameters[None]
        [single_chi2] = chi2_of(self.predictor(single_obstacle), early_window, single_obstacle)
        equivalent_pairs, equivalent_chi2 = self._equivalent_pairs(
            two_contacts, resting_explanation, early_window, parameter_ranges, single_chi2
        )
        first_obstacle_positions_m = equivalent_pairs[equivalent_chi2 <= single_chi2, 0]
        start_candidates = np.vstack([minima.parameters, equivalent_pairs])
        start_chi2 = np.concatenate([minima.chi2, equivalent_chi2])
        if start_chi2.min() > single_chi2 - _MIN_EARLY_CHI2_REDUCTION:
            return None, first_obstacle_positions_m
        likeliest = start_candidates[np.argsort(start_chi2)[:3]]
        start_pairs = np.vstack([likeliest, two_contacts.in_reverse_order(likeliest[:1])])
        minima = find_minima(
            two_contacts.predict_channels,
            sample_window,
            start_pairs,
            parameter_ranges,
            max_iterations=8,
        )
        chi2_reduction = resting_explanation.chi2 - minima.chi2.min()
        if chi2_reduction < _MIN_PAIR_CHI2_REDUCTION:
            return None, first_obstacle_positions_m
        variance_factor = (
            _TWO_OBSTACLES_VARIANCE if chi2_reduction > DECISIVE_CHI2_DIFFERENCE else 1.0
        )
        two_obstacles = self._explain_from_minima(
            "two",
            two_contacts.predict_channels,
            sample_window,
            minima,
            parameter_ranges,
            variance_factor,
        )
        return two_obstacles, first_obstacle_positions_m

    def _equivalent_pairs(
        self,
        two_contacts: TwoObstacleContact,
        resting_explanation: Explanation,
        sample_window: WhitenedWindow,
        parameter_ranges: ParameterRanges,
        single_chi2: float,
    ) -> tuple[RealArray, RealArray]:
        """Return pairs of obstacles with the effect of one, and their sums of squared residuals.

        The shapes are (k, 6) and (k,); k = 0 if no pair has an effect similar to one obstacle.
        """
        pairs = two_contacts.equivalent_pairs(
            resting_explanation.parameters, _RELATIVE_PAIR_POSITIONS
        )
        pairs = pairs[(pairs[:, [0, 3]] <= parameter_ranges.high[0]).all(axis=1)]
        predict_effect = two_contacts.predict_channels
        if (
            not pairs.size
            or chi2_of(predict_effect, sample_window, pairs[:1])[0]
            > single_chi2 + _MAX_EQUIVALENT_CHI2_INCREASE
        ):
            return np.empty((0, 6)), np.empty(0)
        is_free = np.ones(pairs.shape, dtype=bool)
        is_free[:, 0] = False
        minima = find_minima(
            predict_effect,
            sample_window,
            pairs,
            parameter_ranges,
            max_iterations=8,
            free_parameters=is_free,
        )
        return minima.parameters, minima.chi2

    def pressing_sign(self) -> float:
        """Return the direction in which the beam presses on the obstacle, 1 or -1.

        It is opposite to the sum of the likeliest force on the beam over time.
        """
        return -1.0 if self.any_force_likelihood.force_n.sum() > 0 else 1.0

    def _moving_predictor(
        self, kind: str, kernels: ContactKernels, pressing_sign: float
    ) -> Prediction:
        """Return the function that predicts the effects of moving or of yielding obstacles.

        The fourth parameter of its candidates is the speed, or for "yielding" the mobility.
        """
        obstacle_contact = ObstacleContact(kernels, self.tables.x_m, self.motion)

        def predict(candidates: RealArray, sample_window: WhitenedWindow) -> RealArray:
            if kind == "yielding":
                candidates = np.insert(candidates, 3, 0.0, axis=1)
            return obstacle_contact.predict(candidates, sample_window, pressing_sign)[0]

        return predict

    def _moving_parameter_ranges(self, kind: str) -> ParameterRanges:
        """Return bounds and step sizes of the four parameters of a moving or yielding obstacle."""
        ranges = self.parameter_ranges(5)
        parameter_columns = [0, 1, 2, 3 if kind == "moving" else 4]
        return ParameterRanges(
            ranges.low[parameter_columns],
            ranges.high[parameter_columns],
            ranges.derivative_step[parameter_columns],
            ranges.significant_change[parameter_columns],
            ranges.smallest_std[parameter_columns],
            ranges.largest_std[parameter_columns],
        )


def _distinct_minima(local_minima: LocalMinima) -> RealArray:
    """Return the parameters of minima that are not close to a better one, best first, (k, 3)."""
    minimum_order = np.argsort(local_minima.chi2)
    distinct_minima: list[RealArray] = []
    for row in local_minima.parameters[
        minimum_order[local_minima.chi2[minimum_order] < 2 * local_minima.chi2.min() + 60]
    ]:
        if all(
            np.any(np.abs(row - other_minimum)[:2] > (5e-4, 4e-5))
            for other_minimum in distinct_minima
        ):
            distinct_minima.append(row)
    return np.array(distinct_minima)
