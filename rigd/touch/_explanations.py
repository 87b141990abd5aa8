"""Search for the explanations of the record of one touch, in successively longer parts of it.

The usual explanation of the innovations of torque and base shear is a springy obstacle at rest,
whose contact is integrated in time with all bounces. Alternatives are two obstacles, an obstacle
that moves or yields, an impact (one pulse of force, reported as the kind "knock"), and an arbitrary
force. `_combined_estimate` decides which of them are reported.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rigd.touch._free_motion import TouchRecord
from rigd.touch._obstacle_contact import (
    LocalMinima,
    ObstacleContact,
    WhitenedWindow,
    chi2_of,
    find_minima,
)
from rigd.touch._obstacle_fit import (
    NEAR_TIP_FRACTION,
    POOR_FIT_STDS,
    UNCERTAINTIES_END_S,
    Explanation,
    ObstacleFit,
)
from rigd.touch._other_kinds import (
    DECISIVE_CHI2_DIFFERENCE,
    explain_by_motion_or_impact,
    explain_by_two_obstacles,
    may_move_or_yield,
)
from rigd.touch._posterior import Posterior
from rigd.touch._tables import GRID_COMPARISON_S, TouchTables
from rigd.touch.samples import FINAL_ESTIMATE_S, FIRST_ESTIMATE_S

RealArray = NDArray[np.float64]

_STAGE_ENDS_S = (FIRST_ESTIMATE_S, 0.1, FINAL_ESTIMATE_S)
"""Times in s after the detection at which the stages of the explanation end; each stage explains a
longer part of the record. Later stages follow only if an obstacle at rest explains the earlier ones
and the position is still uncertain."""
_MIN_STAGE_GROWTH = 1.2
"""Smallest ratio of the available time to the end of a stage for which the stage is not left
out."""
_PRECISE_POSITION_STD_M = 2e-3
"""Standard deviation in m of the position below which no longer part of the record is explained."""
_RANDOM_CANDIDATE_COUNT = 96
"""Number of candidates that a stage draws from the posterior distribution of the previous stage."""
_NEARBY_POSITION_OFFSETS_M = np.array([-4e-3, -2e-3, 2e-3, 4e-3])
"""Distances in m from the best candidates near the tip to additional candidates."""
_NEAR_TIP_FRACTION = 0.95
"""Fraction of the beam's length beyond which later samples do not improve the position, because
many short contacts can be fitted at any position."""
_MAX_LATER_MISFIT_STDS = 2.5
"""Number of standard deviations by which the sum of squared residuals of the samples that a stage
adds may exceed its expectation. Bounces amplify small errors of the model, so that beyond this the
result of the previous stage is more accurate."""


@dataclass(frozen=True, slots=True)
class ExplainedRecord:
    """Possible explanations of a touch's record, and the part of the record that they explain."""

    explanations: list[Explanation]
    """One explanation for each kind of obstacle tried; the first is an obstacle at rest."""
    window: WhitenedWindow
    """Part of the record that is explained."""
    has_contradicting_later_samples: bool
    """Whether the samples after `window` contradict an obstacle at rest."""
    has_untried_kinds: bool
    """Whether a kind of obstacle that was not tried may be likelier."""
    first_obstacle_positions_m: RealArray
    """Positions in m of the first of two obstacles, for pairs that explain the record as well as
    one obstacle does."""


class ExplanationSearch:
    """Search for the kinds and parameters of obstacles that explain the record of one touch.

    The record begins at least 0.3 s before the touch, which is detected within `detection_delay_s`.
    The search starts from the results of a previous search in a shorter record of the same touch,
    without one from a grid of candidates.
    """

    def __init__(
        self,
        touch_tables: TouchTables,
        touch_record: TouchRecord,
        detection_delay_s: float,
        previous_search: "ExplanationSearch | None" = None,
    ) -> None:
        self.given_record = touch_record
        self.fit = ObstacleFit(touch_tables, touch_record, detection_delay_s)
        covers_grid = (
            previous_search is not None
            and previous_search.fit.samples_after_detection
            >= round(GRID_COMPARISON_S * touch_tables.rate_hz)
        )
        self._grid_candidates: RealArray = (
            previous_search._grid_candidates
            if previous_search and covers_grid
            else self._best_grid_candidates()
        )
        self._resting_stage: tuple[Explanation, float] | None
        self._resting_stage = None if previous_search is None else previous_search._resting_stage

    @property
    def begins_before_window(self) -> bool:
        """Whether the likeliest obstacle is touched at the earliest instants that are searched."""
        return bool(
            self.grid_starts[0, 1]
            < self.fit.motion.t[self.fit.quiet_samples] + 2.5 / self.fit.rate_hz
        )

    @property
    def likely_first_sample(self) -> int:
        """Index of the record's sample nearest to the likeliest touch of the grid search."""
        time_after_quiet_s = float(
            self.grid_starts[0, 1] - self.fit.motion.t[self.fit.quiet_samples]
        )
        return self.fit.first_touch_sample + round(time_after_quiet_s * self.fit.rate_hz)

    @property
    def misfit(self) -> float:
        """Mean square residual of an obstacle at rest in the first samples; noise alone gives 1."""
        return float(self._first_minima.chi2.min() / self._first_window.whitened_innovations.size)

    def explain(self, *, is_first: bool) -> ExplainedRecord:
        """Return the explanations of the record by the kinds of obstacle that are likely.

        With `is_first` set, only obstacles at rest are tried, because other kinds take longer.
        """
        resting_explanation, sample_window, two_obstacles, has_contradicting_later_samples = (
            self._explain_in_stages()
        )
        explanations = [resting_explanation]
        has_untried_kinds = False
        first_obstacle_positions_m: RealArray = np.zeros(0)
        if two_obstacles is None:
            needs_other_kinds = not self.fit.fits(
                resting_explanation, sample_window, POOR_FIT_STDS
            ) or may_move_or_yield(self.fit, resting_explanation, sample_window)
            if needs_other_kinds and is_first:
                has_untried_kinds = True
            elif needs_other_kinds:
                explanations += explain_by_motion_or_impact(self.fit, sample_window)
            if self.fit.fits(resting_explanation, sample_window):
                two_obstacles, first_obstacle_positions_m = explain_by_two_obstacles(
                    self.fit, resting_explanation, sample_window
                )
                # If two obstacles are much likelier than one, another kind may be as likely as two.
                has_untried_kinds |= (
                    is_first
                    and two_obstacles is not None
                    and two_obstacles.chi2 < resting_explanation.chi2 - DECISIVE_CHI2_DIFFERENCE
                )
        if two_obstacles is not None:
            explanations.append(two_obstacles)
        return ExplainedRecord(
            explanations,
            sample_window,
            has_contradicting_later_samples=has_contradicting_later_samples,
            has_untried_kinds=has_untried_kinds,
            first_obstacle_positions_m=first_obstacle_positions_m,
        )

    # Stages

    def _explain_in_stages(self) -> tuple[Explanation, WhitenedWindow, Explanation | None, bool]:
        """Explain successively longer parts of the record by an obstacle at rest.

        Return four results: the explanation by an obstacle at rest; the part of the record that it
        explains; the explanation of the same part by two obstacles, or None unless only two explain
        its later samples; and whether the samples after the part contradict an obstacle at rest.
        """
        available_time_s = self.fit.samples_after_detection / self.fit.rate_hz
        stage_ends_s = [
            stage_end_s
            for stage_end_s in _STAGE_ENDS_S
            if _MIN_STAGE_GROWTH * stage_end_s <= available_time_s
        ]
        stage_ends_s.append(available_time_s)
        previous_stage: tuple[Explanation, WhitenedWindow] | None = None
        if self._resting_stage is None:
            start_candidates = self._add_neighbours(_distinct_minima(self._first_minima))
        else:
            resting_explanation, explained_s = self._resting_stage
            stage_ends_s = [
                stage_end_s for stage_end_s in stage_ends_s if stage_end_s > explained_s
            ]
            start_candidates = self._next_candidates(resting_explanation)
            self.fit.include_uncertainties(start_candidates, max([explained_s, *stage_ends_s[:1]]))
            stage_window = self.fit.window(explained_s)
            [previous_chi2] = chi2_of(
                self.fit.predictor(start_candidates[:1]), stage_window, start_candidates[:1]
            )
            previous_stage = replace(resting_explanation, chi2=float(previous_chi2)), stage_window
            if self._is_sufficient(*previous_stage, explained_s):
                stage_ends_s = []
        for stage_end_s in stage_ends_s:
            self.fit.include_uncertainties(start_candidates, stage_end_s)
            stage_window = self.fit.window(stage_end_s)
            resting_explanation = self.fit.explain_by_kind(
                "rigid",
                self.fit.predictor(start_candidates),
                stage_window,
                start_candidates,
                self.fit.parameter_ranges(3),
            )
            if previous_stage is not None and self._later_samples_fit_worse(
                resting_explanation, stage_window, *previous_stage
            ):
                two_obstacles, _ = explain_by_two_obstacles(
                    self.fit, resting_explanation, stage_window
                )
                if two_obstacles is not None and self.fit.fits(
                    two_obstacles, stage_window, POOR_FIT_STDS
                ):
                    return resting_explanation, stage_window, two_obstacles, False
                # In later bounces the search may miss the minimum, so that they contradict nothing.
                is_contradicted = stage_end_s <= UNCERTAINTIES_END_S and may_move_or_yield(
                    self.fit, resting_explanation, stage_window
                )
                return *previous_stage, None, is_contradicted
            previous_stage = resting_explanation, stage_window
            self._resting_stage = resting_explanation, stage_end_s
            if self._is_sufficient(resting_explanation, stage_window, stage_end_s):
                break
            start_candidates = self._next_candidates(resting_explanation)
        assert previous_stage is not None  # there is at least one stage, or an earlier one
        return *previous_stage, None, False

    def _is_sufficient(
        self,
        resting_explanation: Explanation,
        sample_window: WhitenedWindow,
        time_after_detection_s: float,
    ) -> bool:
        """Return whether a longer part of the record would not improve the explanation."""
        x_m = resting_explanation.posterior.mean(0)
        is_precise = (
            resting_explanation.posterior.std(0) < _PRECISE_POSITION_STD_M
            or x_m > _NEAR_TIP_FRACTION * self.fit.position_range_m[1]
        )
        return time_after_detection_s > FIRST_ESTIMATE_S and bool(
            is_precise or not self.fit.fits(resting_explanation, sample_window)
        )

    def _later_samples_fit_worse(
        self,
        longer_explanation: Explanation,
        longer_window: WhitenedWindow,
        shorter_explanation: Explanation,
        shorter_window: WhitenedWindow,
    ) -> bool:
        """Return whether the shorter window is explained, but not the samples added to it."""
        added_samples = (
            longer_window.whitened_innovations.size - shorter_window.whitened_innovations.size
        )
        added_chi2 = longer_explanation.chi2 - shorter_explanation.chi2
        return self.fit.fits(
            shorter_explanation, shorter_window
        ) and added_chi2 > self.fit.max_chi2(added_samples, _MAX_LATER_MISFIT_STDS)

    def _next_candidates(self, resting_explanation: Explanation) -> RealArray:
        """Return candidate obstacles for the next stage, from the last stage's explanation."""
        return np.vstack(
            [resting_explanation.parameters, self._draw_candidates(resting_explanation.posterior)]
        )

    def _draw_candidates(self, posterior: Posterior) -> RealArray:
        """Return random candidates near samples of a posterior distribution, shape (k, p)."""
        rng = np.random.default_rng(1)
        drawn_candidates = posterior.samples[
            rng.choice(posterior.weights.size, _RANDOM_CANDIDATE_COUNT, p=posterior.weights)
        ]
        parameter_count = drawn_candidates.shape[1]
        parameter_ranges = self.fit.parameter_ranges(parameter_count)
        random_spread = np.array(
            [
                max(posterior.std(i), parameter_ranges.smallest_std[i])
                for i in range(parameter_count)
            ]
        )
        return np.clip(
            drawn_candidates + 0.5 * random_spread * rng.standard_normal(drawn_candidates.shape),
            parameter_ranges.lower_limits,
            parameter_ranges.upper_limits,
        )

    # Candidates of the grid

    def _best_grid_candidates(self) -> RealArray:
        """Return the four likeliest candidates of the grid at each position, shape (k, 3)."""
        grid_window = self.fit.window(GRID_COMPARISON_S)
        candidate_grid = self.fit.tables.candidate_grid(
            grid_window.end_sample - grid_window.first_sample
        )
        grid_candidates, chi2 = candidate_grid.integrate(
            self.fit.motion, grid_window, self.fit.detection_index
        )
        grid_candidates = grid_candidates[np.lexsort((chi2, grid_candidates[:, 0]))]
        candidates_per_position = grid_candidates.shape[0] // np.unique(grid_candidates[:, 0]).size
        best_candidates: RealArray = grid_candidates.reshape(-1, candidates_per_position, 3)[
            :, :4
        ].reshape(-1, 3)
        return best_candidates

    @cached_property
    def _first_window(self) -> WhitenedWindow:
        """Whitened innovations of the first samples, with which the best of the grid are compared.

        Only the uncertainty of the free motion is included, not its effect on the contact.
        """
        return WhitenedWindow.from_motion(
            self.fit.motion,
            self.fit.quiet_samples,
            self.fit.sample_after_detection(FIRST_ESTIMATE_S),
        )

    @cached_property
    def grid_starts(self) -> RealArray:
        """The 12 candidates of the grid that explain the first samples best, shape (12, 3)."""
        coarse_contact = ObstacleContact(
            self.fit.tables.coarse_kernels, self.fit.tables.x_m, self.fit.motion
        )
        chi2 = chi2_of(
            lambda candidate_rows, window: coarse_contact.predict(candidate_rows, window)[0],
            self._first_window,
            self._grid_candidates,
        )
        return self._grid_candidates[np.argsort(chi2)[:12]]

    @cached_property
    def _first_minima(self) -> LocalMinima:
        """Local minima of the sum of squared residuals that are found from `grid_starts`."""
        predict_effect = self.fit.predictor(self.grid_starts, uses_coarse_kernels=True)
        return find_minima(
            predict_effect,
            self._first_window,
            self.grid_starts,
            self.fit.parameter_ranges(3),
            max_iterations=7,
        )

    def _add_neighbours(self, candidates: RealArray) -> RealArray:
        """Return candidate obstacles; near the tip, add neighbours of the two best.

        Minima are close together near the tip.
        """
        if (
            np.median(candidates[:, 0])
            <= NEAR_TIP_FRACTION * self.fit.tables.model.plant.beam.length_m
        ):
            return candidates
        nearby_candidates = np.repeat(candidates[None, :2], _NEARBY_POSITION_OFFSETS_M.size, axis=0)
        nearby_candidates[:, :, 0] = np.clip(
            nearby_candidates[:, :, 0] + _NEARBY_POSITION_OFFSETS_M[:, None],
            *self.fit.position_range_m,
        )
        return np.vstack([candidates, nearby_candidates.reshape(-1, candidates.shape[1])])


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
