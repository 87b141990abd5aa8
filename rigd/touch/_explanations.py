"""Explanations of the record of one touch: candidates of each kind, and their residuals.

A springy obstacle at rest, integrated in time through its bounces, explains the innovations of
torque and base shear. Alternatives are two obstacles, an obstacle that moves or yields, a knock
(one pulse of force), and any force at all. `_combined_estimate` decides which of them are reported.
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
    Minima,
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

Real = NDArray[np.float64]

_STAGES_S = (FIRST_S, 0.1, FINAL_S)
"""Times in s after the detection up to which the record is explained, in this order. The longest is
used only if an obstacle at rest explains the shorter parts and the point is still uncertain."""
_UNCERTAINTIES_S = 0.1
"""Time in s after the detection up to which the effects of all uncertainties are included at
once."""
_MIN_STAGE_GROWTH = 1.2
"""Smallest factor by which the number of samples must grow for a further stage."""
_PRECISE_STD_M = 2e-3
"""Standard deviation of the position in m below which a longer part of the record is not used."""
_RANDOM_CANDIDATES = 96
"""Number of candidates for a longer part of the record, drawn from the posterior of a shorter
part."""
NEAR_TIP_FRACTION = 0.8
"""Fraction of the beam's length beyond which contacts are shorter, so that time steps are finer."""
_NEARBY_OFFSETS_M = np.array([-4e-3, -2e-3, 2e-3, 4e-3])
"""Distances in m of additional candidates from the best ones near the tip."""
_TIP_FRACTION = 0.95
"""Fraction of the beam's length beyond which a longer record adds nothing, because its many short
contacts fit anywhere."""

_MIN_RESIDUAL_VARIANCE = 1.2
"""Smallest assumed variance of the whitened residuals, since the noise itself is estimated from few
samples."""
_TWO_OBSTACLES_VARIANCE = 4.0
"""Divisor of the sum of squared residuals if two obstacles clearly explain more than one: errors of
the model then decide which of several minima is the lowest."""
DECISIVE_CHI2_DIFFERENCE = 16.0
"""Difference in the sum of squared residuals that decides between two kinds of obstacle."""
CHANCE_CHI2_REDUCTION = 9.0
"""Reduction of the sum of squared residuals by a moving or yielding obstacle up to which an
obstacle at rest is still possible. In one of a hundred touches of an obstacle at rest the reduction
is that large by chance."""
_MIN_TWO_OBSTACLES_GAIN = 5.0
"""Reduction of the sum of squared residuals by two obstacles from which they are possible, so that
the position is less certain."""
_FIRST_OF_TWO = np.array([[0.85, 1.3], [0.7, 1.5], [0.55, 1.75], [1.3, 0.85], [1.6, 0.65]])
"""Positions of two obstacles, over that of a single one, which are compared with it. That of the
first stays, the search adapts the other parameters."""
_MAX_EQUIVALENT_LOSS = 50.0
"""Increase of the sum of squared residuals by the nearest such pair beyond which none is likely, as
for all but soft obstacles near the axis."""
_MIN_EARLY_GAIN = 0.8
"""Reduction of the sum of squared residuals after a few iterations, from which the search for two
obstacles continues."""
_MAX_MISFIT_STDS = 3.5
"""Number of standard deviations by which the sum of squared residuals may exceed its
expectation."""
POOR_FIT_STDS = 2.0
"""Number of standard deviations of the sum of squared residuals beyond which the explanation may be
wrong: other kinds are tried, and the interval of the point is that for any force."""
_MAX_LATER_MISFIT_STDS = 2.5
"""Number of standard deviations by which the sum of squared residuals of the later samples alone
may exceed its expectation. Bounces amplify small errors of the model. If the later bounces are
explained less well, the first result is closer to the truth."""

_RATES_M_PER_S = np.array([-1.5, -0.7, -0.3, -0.1, 0.1, 0.25, 0.5])
"""Speeds of moving obstacles with which the search starts."""
_MOBILITIES = np.array([0.01, 0.04, 0.15, 0.6])
"""Mobilities of yielding obstacles, in m/s per N, with which the search starts."""
_STIFFNESSES = np.array([300.0, 3000.0, 30000.0])
"""Stiffnesses in N/m of moving or yielding obstacles with which the search starts."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Explanation of a touch's record by one kind of obstacle, with its parameters and misfit."""

    kind: str
    """Kind of obstacle: rigid, moving, yielding, two or knock."""
    posterior: Posterior
    """Posterior distribution of the obstacle's parameters."""
    parameters: Real
    """Likeliest parameters, shape (p,)."""
    chi2: float
    """Sum of squared residuals of the likeliest parameters."""


@dataclass(frozen=True, slots=True)
class ExplainedRecord:
    """Possible explanations of a touch's record, and the part of the record that they explain."""

    explanations: list[Explanation]
    """Explanations by kind; that by an obstacle at rest comes first."""
    window: WhitenedWindow
    """Part of the record that is explained."""
    later_samples_contradict: bool
    """Whether the later samples, which are left out, contradict an obstacle at rest."""
    other_kinds_untried: bool
    """Whether another kind of obstacle may be likelier, but was not tried."""
    first_of_two_m: Real
    """Positions of the first of two obstacles that explain the record as well as one does."""


class ExplanationSearch:
    """Search for the kinds and parameters of obstacles that explain the record of one touch.

    Parameters
    ----------
    touch_tables
        Precomputed tables of the model at the record's rate.
    touch_record
        Samples from 0.3 s or more before the touch.
    detection_delay_s
        Longest time in s from the touch to its detection.
    previous_search
        Search with the beginning of the same record, from whose results this search starts; None:
        it starts from a grid.
    """

    def __init__(
        self,
        touch_tables: TouchTables,
        touch_record: TouchRecord,
        detection_delay_s: float,
        previous_search: "ExplanationSearch | None" = None,
    ) -> None:
        rate_hz = touch_tables.rate_hz
        self.tables, self.rate, self.given = touch_tables, rate_hz, touch_record
        self.begin = max(0, touch_record.detected - round(HISTORY_S * rate_hz))
        record_end = min(
            touch_record.angle_rad.size, touch_record.detected + round(FINAL_S * rate_hz)
        )
        self.record = TouchRecord(
            rate_hz,
            touch_record.angle_rad[self.begin : record_end],
            touch_record.torque_nm[self.begin : record_end],
            None if touch_record.shear_n is None else touch_record.shear_n[self.begin : record_end],
            touch_record.detected - self.begin,
        )
        self.detected = self.record.detected
        self.quiet = self.detected - round(detection_delay_s * rate_hz)
        self.motion = touch_tables.free.motion(self.record, self.quiet, self.quiet - 4)
        self.available = self.record.angle_rad.size - self.detected
        self.edges = (float(touch_tables.x_m[0]) + 0.002, float(touch_tables.x_m[-1]))
        self.deviations: Real | None = None
        self._uncertainties_s = 0.0
        covers_grid = previous_search is not None and previous_search.available >= round(
            GRID_COMPARISON_S * rate_hz
        )
        self._grid_candidates: Real = (
            previous_search._grid_candidates
            if previous_search and covers_grid
            else self._best_of_grid()
        )
        self._at_rest: tuple[Explanation, float] | None
        self._at_rest = None if previous_search is None else previous_search._at_rest

    @property
    def first(self) -> int:
        """Index of the first sample of the record that may contain the touch."""
        return self.begin + self.quiet

    @property
    def begins_before_window(self) -> bool:
        """Whether the likeliest touch begins before the samples that may contain it."""
        return bool(self.starts[0, 1] < self.motion.t[self.quiet] + 2.5 / self.rate)

    @property
    def likely_first_sample(self) -> int:
        """Index of the sample before which the likeliest touch of the grid search begins."""
        after_quiet_s = float(self.starts[0, 1] - self.motion.t[self.quiet])
        return self.first + round(after_quiet_s * self.rate)

    @property
    def misfit(self) -> float:
        """Mean square of the residuals of an obstacle at rest in the first samples, over noise."""
        return float(self._first_minima.chi2.min() / self._first_samples.data.size)

    def explain(self, *, first: bool) -> ExplainedRecord:
        """Return the explanations of the record by one or two obstacles at rest and other kinds.

        With `first` set, other kinds than obstacles at rest are not tried, because that takes long.
        """
        resting_explanation, sample_window, two_obstacles, later_samples_contradict = (
            self._explain_in_stages()
        )
        explanations = [resting_explanation]
        other_kinds_untried = False
        first_of_two_m: Real = np.zeros(0)
        if two_obstacles is None:
            needs_other_kinds = not self.fits(
                resting_explanation, sample_window, POOR_FIT_STDS
            ) or self._may_move_or_yield(resting_explanation, sample_window)
            if needs_other_kinds and first:
                other_kinds_untried = True
            elif needs_other_kinds:
                explanations += self._explain_by_other_kinds(sample_window)
            if self.fits(resting_explanation, sample_window):
                two_obstacles, first_of_two_m = self._explain_by_two(
                    resting_explanation, sample_window
                )
                # What one obstacle explains much worse than two, another kind may explain as well.
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
            first_of_two_m=first_of_two_m,
        )

    def _explain_in_stages(self) -> tuple[Explanation, WhitenedWindow, Explanation | None, bool]:
        """Explain longer and longer parts of the record by an obstacle at rest.

        Return four results: the explanation of the longest part that an obstacle at rest explains,
        or of the first part that it does not explain; this part; the explanation by two obstacles,
        or None unless they explain a part that a single obstacle does not; and whether the
        following samples contradict the first explanation.
        """
        available_s = self.available / self.rate
        stage_ends_s = [
            stage_end_s
            for stage_end_s in _STAGES_S
            if _MIN_STAGE_GROWTH * stage_end_s <= available_s
        ]
        stage_ends_s.append(available_s)
        previous_stage: tuple[Explanation, WhitenedWindow] | None = None
        if self._at_rest is None:
            start_candidates = self._add_neighbours(_distinct_minima(self._first_minima))
        else:
            at_rest, explained_s = self._at_rest
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
                self.space(3),
            )
            if previous_stage is not None and self._later_samples_fit_worse(
                at_rest, stage_window, *previous_stage
            ):
                two_obstacles, _ = self._explain_by_two(at_rest, stage_window)
                if two_obstacles is not None and self.fits(
                    two_obstacles, stage_window, POOR_FIT_STDS
                ):
                    return at_rest, stage_window, two_obstacles, False
                # In still later bounces the search may miss the minimum: they decide no kind.
                is_contradicted = stage_end_s <= _UNCERTAINTIES_S and self._may_move_or_yield(
                    at_rest, stage_window
                )
                return *previous_stage, None, is_contradicted
            previous_stage = at_rest, stage_window
            self._at_rest = at_rest, stage_end_s
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
        """Return whether a longer part of the record would not improve a touch's estimate."""
        x_m = resting_explanation.posterior.mean(0)
        is_precise = (
            resting_explanation.posterior.std(0) < _PRECISE_STD_M
            or x_m > _TIP_FRACTION * self.edges[1]
        )
        return after_detection_s > FIRST_S and bool(
            is_precise or not self.fits(resting_explanation, sample_window)
        )

    def _include_uncertainties(self, likely_obstacle: Real, after_detection_s: float) -> None:
        """Compute the effects of all uncertainties up to `after_detection_s` after the detection.

        They are computed for the first candidate of `likely_obstacle`, unless this was done before.
        """
        if self._uncertainties_s < after_detection_s:
            self._uncertainties_s = min(
                max(after_detection_s, _UNCERTAINTIES_S), self.available / self.rate
            )
            whole_window = WhitenedWindow.from_motion(
                self.motion, self.quiet, self.end(self._uncertainties_s)
            )
            self.deviations = uncertainty_effects(
                self.tables, self.record, likely_obstacle[:1], whole_window
            )

    def _next_candidates(self, resting_explanation: Explanation) -> Real:
        """Return candidate obstacles for a longer part of the record, from a shorter part."""
        return np.vstack(
            [resting_explanation.parameters, self._draw_candidates(resting_explanation.posterior)]
        )

    @cached_property
    def any_force(self) -> AnyForceLikelihood:
        """Likelihood of a touch by any force at each position, from the first samples.

        Its computation takes as long as the remaining estimate.
        """
        return self.tables.any_force.scan(self.window(FIRST_S))

    # Data for the comparison of candidates

    def window(self, after_detection_s: float) -> WhitenedWindow:
        """Return the whitened innovations from before a touch to a time after its detection."""
        return WhitenedWindow.from_motion(
            self.motion, self.quiet, self.end(after_detection_s), self.deviations
        )

    def end(self, after_detection_s: float) -> int:
        """Return the index of the sample at a time after the detection, or the record's end."""
        return self.detected + min(self.available, round(after_detection_s * self.rate))

    def space(self, parameter_count: int) -> ParameterRanges:
        """Return the allowed ranges of the first `parameter_count` of the `OBSTACLE_PARAMETERS`."""
        t = self.motion.t
        return ParameterRanges(
            low=np.array([self.edges[0], t[self.quiet + 1], MIN_LN_STIFFNESS, -3.0, 0.0])[
                :parameter_count
            ],
            high=np.array([self.edges[1], t[self.detected], MAX_LN_STIFFNESS, 3.0, 50.0])[
                :parameter_count
            ],
            difference=np.array([2e-4, 2e-5, 2e-2, 2e-3, 2e-3])[:parameter_count],
            scale=np.array([3e-3, 1e-3, 1.0, 0.1, 0.1])[:parameter_count],
            smallest_std=np.array([1.5e-4, 1e-5, 2e-2, 5e-3, 5e-3])[:parameter_count],
            largest_std=np.array([0.02, 2e-3, 1.0, 0.3, 0.3])[:parameter_count],
        )

    def predictor(self, rows: Real, *, first: bool = False) -> Prediction:
        """Return the function that predicts the effect of obstacles near the candidates `rows`.

        Its time steps are half as long near the tip, where contacts are shorter. With `first` set,
        they are twice as long elsewhere, for a first search.
        """
        tables = self.tables
        is_near_tip = bool(
            np.median(rows[:, 0]) > NEAR_TIP_FRACTION * tables.model.plant.beam.length_m
        )
        kernels = tables.finest if is_near_tip else tables.coarse if first else tables.middle
        obstacle_contact = ObstacleContact(kernels, tables.x_m, self.motion)
        return lambda candidates, window: obstacle_contact.predict(candidates, window)[0]

    # Springy obstacle at rest

    def _best_of_grid(self) -> Real:
        """Return the grid's four likeliest obstacle parameters (k, 3) for each position."""
        grid_window = self.window(GRID_COMPARISON_S)
        candidate_grid = self.tables.starts(grid_window.end - grid_window.first)
        grid_candidates, chi2 = candidate_grid.integrate(self.motion, grid_window, self.detected)
        grid_candidates = grid_candidates[np.lexsort((chi2, grid_candidates[:, 0]))]
        candidates_per_position = grid_candidates.shape[0] // np.unique(grid_candidates[:, 0]).size
        best_candidates: Real = grid_candidates.reshape(-1, candidates_per_position, 3)[
            :, :4
        ].reshape(-1, 3)
        return best_candidates

    @cached_property
    def _first_samples(self) -> WhitenedWindow:
        """Whitened innovations of the first samples, with which the grid's candidates are compared.

        The effects of uncertainties through the contact are not included yet.
        """
        return WhitenedWindow.from_motion(self.motion, self.quiet, self.end(FIRST_S))

    @cached_property
    def starts(self) -> Real:
        """The 12 likeliest obstacles at rest of the grid, compared over more samples."""
        coarse_contact = ObstacleContact(self.tables.coarse, self.tables.x_m, self.motion)
        chi2 = chi2_of(
            lambda rows, window: coarse_contact.predict(rows, window)[0],
            self._first_samples,
            self._grid_candidates,
        )
        return self._grid_candidates[np.argsort(chi2)[:12]]

    @cached_property
    def _first_minima(self) -> Minima:
        """Local minima of the squared residuals near the grid's likeliest obstacles at rest."""
        predict_effect = self.predictor(self.starts, first=True)
        return find_minima(
            predict_effect, self._first_samples, self.starts, self.space(3), rounds=7
        )

    def _add_neighbours(self, candidates: Real) -> Real:
        """Return the candidate obstacles, with further ones nearby if they are close to the tip.

        Minima are close together there.
        """
        if np.median(candidates[:, 0]) <= NEAR_TIP_FRACTION * self.tables.model.plant.beam.length_m:
            return candidates
        nearby_candidates = np.repeat(candidates[None, :2], _NEARBY_OFFSETS_M.size, axis=0)
        nearby_candidates[:, :, 0] = np.clip(
            nearby_candidates[:, :, 0] + _NEARBY_OFFSETS_M[:, None], *self.edges
        )
        return np.vstack([candidates, nearby_candidates.reshape(-1, candidates.shape[1])])

    def _draw_candidates(self, posterior: Posterior) -> Real:
        """Return random obstacle parameters (k, p) from the posterior of a shorter window."""
        rng = np.random.default_rng(1)
        drawn_candidates = posterior.samples[
            rng.choice(posterior.weights.size, _RANDOM_CANDIDATES, p=posterior.weights)
        ]
        parameter_count = drawn_candidates.shape[1]
        parameter_ranges = self.space(parameter_count)
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
        start_candidates: Real,
        parameter_ranges: ParameterRanges,
    ) -> Explanation:
        """Return the explanation by one kind of obstacle: search for minima, and sample around."""
        if start_candidates.shape[0] > 12:
            start_candidates = start_candidates[
                np.argsort(chi2_of(predict_effect, sample_window, start_candidates))[:12]
            ]
        minima = find_minima(
            predict_effect, sample_window, start_candidates, parameter_ranges, rounds=9
        )
        return self._explain_from_minima(
            kind, predict_effect, sample_window, minima, parameter_ranges
        )

    def _explain_from_minima(
        self,
        kind: str,
        predict_effect: Prediction,
        sample_window: WhitenedWindow,
        local_minima: Minima,
        parameter_ranges: ParameterRanges,
        variance_factor: float = 1.0,
    ) -> Explanation:
        """Return an explanation with samples of the posterior around the minima in `local_minima`.

        `variance_factor` is a factor on the variance of the residuals.
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
            scale=variance_factor * max(_MIN_RESIDUAL_VARIANCE, local_minima.chi2.min() / degrees),
            count=120,
            rounds=5,
            enough_samples=150.0,
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
        """Return whether the residuals of a touch's explanation are no larger than noise.

        `max_stds` is the number of standard deviations by which they may exceed their expectation.
        """
        return bool(explanation.chi2 < self.max_chi2(sample_window.data.size, max_stds))

    def max_chi2(self, expected_chi2: int, max_stds: float = _MAX_MISFIT_STDS) -> float:
        """Return the largest sum of squared residuals that noise explains.

        `expected_chi2` is its expectation, and `max_stds` the allowed standard deviations.
        """
        noise_variance = 2 * expected_chi2**2 / (self.quiet * self.motion.noise.size)
        return float(expected_chi2 + max_stds * np.sqrt(2 * expected_chi2 + noise_variance))

    def _later_samples_fit_worse(
        self,
        longer_explanation: Explanation,
        longer_window: WhitenedWindow,
        shorter_explanation: Explanation,
        shorter_window: WhitenedWindow,
    ) -> bool:
        """Return whether a shorter window is explained, but not the samples added to it."""
        added_samples = longer_window.data.size - shorter_window.data.size
        added_chi2 = longer_explanation.chi2 - shorter_explanation.chi2
        return self.fits(shorter_explanation, shorter_window) and added_chi2 > self.max_chi2(
            added_samples, _MAX_LATER_MISFIT_STDS
        )

    def _may_move_or_yield(
        self, resting_explanation: Explanation, sample_window: WhitenedWindow
    ) -> bool:
        """Return whether a moving or yielding obstacle is clearly likelier than one at rest."""
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
        obstacle_contact = ObstacleContact(self.tables.middle, self.tables.x_m, self.motion)
        pressing_side = obstacle_contact.pressing_direction(resting_explanation.parameters)
        minima = find_minima(
            lambda candidates, sample_window: obstacle_contact.predict(
                candidates, sample_window, pressing_side
            )[0],
            sample_window,
            start_candidates,
            self.space(5),
            rounds=5,
            free=is_free,
        )
        return bool(minima.chi2.min() < resting_explanation.chi2 - CHANCE_CHI2_REDUCTION)

    def _explain_by_other_kinds(self, sample_window: WhitenedWindow) -> list[Explanation]:
        """Return the explanations of the window by a moving or yielding obstacle, and a knock."""
        any_force, pressing_side = self.any_force, self.pressing_direction()
        likeliest_positions = any_force.x_m[np.argsort(-any_force.log_likelihood)[:24]]
        touch_instants_s = self.motion.t[self.quiet + 2 : self.detected + 1 : 2]
        explanations = []
        for obstacle_kind, motion_values in (("moving", _RATES_M_PER_S), ("yielding", _MOBILITIES)):
            start_grid = np.meshgrid(
                likeliest_positions,
                touch_instants_s,
                np.log(_STIFFNESSES),
                motion_values,
                indexing="ij",
            )
            start_candidates = np.stack([minima_part.ravel() for minima_part in start_grid], axis=1)
            coarse_predictor = self._moving_predictor(
                obstacle_kind, self.tables.coarse, pressing_side
            )
            for column_span, candidate_count in ((GRID_COMPARISON_S, 80), (FIRST_S, 10)):
                chi2 = chi2_of(coarse_predictor, self.window(column_span), start_candidates)
                start_candidates = start_candidates[np.argsort(chi2)[:candidate_count]]
            predict_effect, parameter_ranges = (
                self._moving_predictor(obstacle_kind, self.tables.middle, pressing_side),
                self._moving_space(obstacle_kind),
            )
            if sample_window.end > self.end(FIRST_S):
                early_minima = find_minima(
                    predict_effect,
                    self.window(FIRST_S),
                    start_candidates,
                    parameter_ranges,
                    rounds=6,
                )
                start_candidates = early_minima.parameters
            explanations.append(
                self.explain_by_kind(
                    obstacle_kind, predict_effect, sample_window, start_candidates, parameter_ranges
                )
            )
        obstacle_contact = ObstacleContact(self.tables.middle, self.tables.x_m, self.motion)
        impact_response = ImpactResponse(obstacle_contact, self.tables.middle, 2)
        start_candidates = impact_response.starts(self.window(FIRST_S), self.detected, 10)
        obstacle_ranges = self.space(3)
        parameter_ranges = impact_response.space(
            self.edges, (obstacle_ranges.low[1], obstacle_ranges.high[1])
        )
        explanations.append(
            self.explain_by_kind(
                "knock", impact_response.predict, sample_window, start_candidates, parameter_ranges
            )
        )
        return explanations

    def pairing(self) -> TwoObstacleContact:
        """Return the model of the contact with two obstacles for this record."""
        tables = self.tables
        obstacle_contact = ObstacleContact(tables.coarse, tables.x_m, self.motion)
        return TwoObstacleContact(obstacle_contact, tables.coarse, tables.crossing)

    def _explain_by_two(
        self, resting_explanation: Explanation, sample_window: WhitenedWindow
    ) -> tuple[Explanation | None, Real]:
        """Return the explanation by two obstacles, and possible positions of the first of two.

        The explanation is None if one obstacle explains about as much. At the positions, two
        obstacles explain the first samples at least as well as one.
        """
        two_contacts = self.pairing()
        parameter_ranges = two_contacts.space(self.space(3))
        # The first samples show in less time whether more iterations are worthwhile.
        early_window = (
            self.window(_UNCERTAINTIES_S)
            if sample_window.end > self.end(_UNCERTAINTIES_S)
            else sample_window
        )
        start_pairs = two_contacts.starts(
            resting_explanation.parameters, early_window, parameter_ranges, 2
        )
        minima = find_minima(
            two_contacts.predict_channels, early_window, start_pairs, parameter_ranges, rounds=4
        )
        single_obstacle = resting_explanation.parameters[None]
        [single_chi2] = chi2_of(self.predictor(single_obstacle), early_window, single_obstacle)
        equivalent_pairs, equivalent_chi2 = self._equivalent_pairs(
            two_contacts, resting_explanation, early_window, single_chi2
        )
        first_of_two_m = equivalent_pairs[equivalent_chi2 <= single_chi2, 0]
        start_candidates = np.vstack([minima.parameters, equivalent_pairs])
        start_chi2 = np.concatenate([minima.chi2, equivalent_chi2])
        if start_chi2.min() > single_chi2 - _MIN_EARLY_GAIN:
            return None, first_of_two_m
        likeliest = start_candidates[np.argsort(start_chi2)[:3]]
        start_pairs = np.vstack([likeliest, two_contacts.in_reverse_order(likeliest[:1])])
        minima = find_minima(
            two_contacts.predict_channels, sample_window, start_pairs, parameter_ranges, rounds=8
        )
        chi2_gain = resting_explanation.chi2 - minima.chi2.min()
        if chi2_gain < _MIN_TWO_OBSTACLES_GAIN:
            return None, first_of_two_m
        variance_factor = _TWO_OBSTACLES_VARIANCE if chi2_gain > DECISIVE_CHI2_DIFFERENCE else 1.0
        two_obstacles = self._explain_from_minima(
            "two",
            two_contacts.predict_channels,
            sample_window,
            minima,
            parameter_ranges,
            variance_factor,
        )
        return two_obstacles, first_of_two_m

    def _equivalent_pairs(
        self,
        two_contacts: TwoObstacleContact,
        resting_explanation: Explanation,
        sample_window: WhitenedWindow,
        single_chi2: float,
    ) -> tuple[Real, Real]:
        """Return the likeliest pairs for some positions of the first, and their squared residuals.

        The pairs are (k, 6) parameters, without any if their effect is not that of one obstacle.
        """
        parameter_ranges = two_contacts.space(self.space(3))
        pairs = two_contacts.equivalent_pairs(resting_explanation.parameters, _FIRST_OF_TWO)
        pairs = pairs[(pairs[:, [0, 3]] <= parameter_ranges.high[0]).all(axis=1)]
        predict_effect = two_contacts.predict_channels
        if (
            not pairs.size
            or chi2_of(predict_effect, sample_window, pairs[:1])[0]
            > single_chi2 + _MAX_EQUIVALENT_LOSS
        ):
            return np.empty((0, 6)), np.empty(0)
        is_free = np.ones(pairs.shape, dtype=bool)
        is_free[:, 0] = False
        minima = find_minima(
            predict_effect, sample_window, pairs, parameter_ranges, rounds=8, free=is_free
        )
        return minima.parameters, minima.chi2

    def pressing_direction(self) -> float:
        """Return the direction in which the beam presses on the obstacle, 1 or -1.

        It is opposite to the direction of the likeliest force on the beam.
        """
        return -1.0 if self.any_force.force_n.sum() > 0 else 1.0

    def _moving_predictor(
        self, kind: str, kernels: ContactKernels, pressing_side: float
    ) -> Prediction:
        """Return the function that predicts the effect of moving or yielding obstacles.

        Their fourth parameter is the speed or the mobility.
        """
        obstacle_contact = ObstacleContact(kernels, self.tables.x_m, self.motion)

        def predict(candidates: Real, sample_window: WhitenedWindow) -> Real:
            if kind == "yielding":
                candidates = np.insert(candidates, 3, 0.0, axis=1)
            return obstacle_contact.predict(candidates, sample_window, pressing_side)[0]

        return predict

    def _moving_space(self, kind: str) -> ParameterRanges:
        """Return the ranges of the four parameters of a moving or yielding obstacle."""
        ranges = self.space(5)
        parameter_columns = [0, 1, 2, 3 if kind == "moving" else 4]
        return ParameterRanges(
            ranges.low[parameter_columns],
            ranges.high[parameter_columns],
            ranges.difference[parameter_columns],
            ranges.scale[parameter_columns],
            ranges.smallest_std[parameter_columns],
            ranges.largest_std[parameter_columns],
        )


def _distinct_minima(local_minima: Minima) -> Real:
    """Return the parameters of minima that are not close to a better minimum, best first."""
    minimum_order = np.argsort(local_minima.chi2)
    distinct_minima: list[Real] = []
    for row in local_minima.parameters[
        minimum_order[local_minima.chi2[minimum_order] < 2 * local_minima.chi2.min() + 60]
    ]:
        if all(
            np.any(np.abs(row - other_minimum)[:2] > (5e-4, 4e-5))
            for other_minimum in distinct_minima
        ):
            distinct_minima.append(row)
    return np.array(distinct_minima)
