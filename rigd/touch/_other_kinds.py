"""Explanations of a touch by a moving or yielding obstacle, by an impact, or by two obstacles."""

import numpy as np
from numpy.typing import NDArray

from rigd.touch._impact import ImpactResponse
from rigd.touch._kernels import ContactKernels
from rigd.touch._obstacle_contact import (
    EffectPredictor,
    ObstacleContact,
    ParameterRanges,
    WhitenedWindow,
    chi2_of,
    find_minima,
)
from rigd.touch._obstacle_fit import UNCERTAINTIES_END_S, Explanation, ObstacleFit
from rigd.touch._pair import TwoObstacleContact
from rigd.touch._tables import GRID_COMPARISON_S
from rigd.touch.samples import FIRST_ESTIMATE_S

RealArray = NDArray[np.float64]

DECISIVE_CHI2_DIFFERENCE = 16.0
"""Difference in the sum of squared residuals that decides between two kinds of obstacle."""
CHANCE_CHI2_REDUCTION = 9.0
"""Reduction of the sum of squared residuals up to which a moving or yielding obstacle is not
preferred to one at rest. Chance causes a larger reduction in 1 % of the touches of an obstacle at
rest."""

_TWO_OBSTACLES_VARIANCE = 4.0
"""Factor on the variance of the residuals if two obstacles explain the record clearly better than
one: errors of the model then decide which of several minima is the lowest."""
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

_START_SPEEDS_M_PER_S = np.array([-1.5, -0.7, -0.3, -0.1, 0.1, 0.25, 0.5])
"""Speeds in m/s of moving obstacles from which the search starts."""
_START_MOBILITIES_M_PER_N_S = np.array([0.01, 0.04, 0.15, 0.6])
"""Mobilities (speed per force) of yielding obstacles from which the search starts."""
_START_STIFFNESSES_N_PER_M = np.array([300.0, 3000.0, 30000.0])
"""Stiffnesses in N/m of moving or yielding obstacles from which the search starts."""


# Obstacle that moves or yields, and impact


def may_move_or_yield(
    obstacle_fit: ObstacleFit, resting_explanation: Explanation, sample_window: WhitenedWindow
) -> bool:
    """Return whether motion or yielding of the obstacle reduces the residuals clearly."""
    motion_parameters = np.array([[-0.05, 0.0], [0.05, 0.0], [0.0, 0.02]])
    start_candidates = np.hstack(
        [
            np.tile(resting_explanation.parameters, (len(motion_parameters), 1)),
            motion_parameters,
        ]
    )
    is_free_parameter = np.hstack(
        [
            np.ones((len(motion_parameters), resting_explanation.parameters.size), dtype=bool),
            motion_parameters != 0,
        ]
    )
    obstacle_contact = ObstacleContact(
        obstacle_fit.tables.middle_kernels, obstacle_fit.tables.x_m, obstacle_fit.motion
    )
    pressing_sign = obstacle_contact.pressing_sign(resting_explanation.parameters)
    minima = find_minima(
        lambda candidates, sample_window: obstacle_contact.predict(
            candidates, sample_window, pressing_sign
        )[0],
        sample_window,
        start_candidates,
        obstacle_fit.parameter_ranges(5),
        max_iterations=5,
        is_free_parameter=is_free_parameter,
    )
    return bool(minima.chi2.min() < resting_explanation.chi2 - CHANCE_CHI2_REDUCTION)


def explain_by_motion_or_impact(
    obstacle_fit: ObstacleFit, sample_window: WhitenedWindow
) -> list[Explanation]:
    """Return three explanations: by a moving obstacle, a yielding obstacle and an impact."""
    any_force_likelihood, pressing_sign = (
        obstacle_fit.any_force_likelihood,
        obstacle_fit.pressing_sign(),
    )
    likeliest_positions = any_force_likelihood.x_m[
        np.argsort(-any_force_likelihood.log_likelihood)[:24]
    ]
    touch_instants_s = obstacle_fit.motion.t[
        obstacle_fit.quiet_samples + 2 : obstacle_fit.detection_index + 1 : 2
    ]
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
        coarse_predictor = _moving_predictor(
            obstacle_fit, obstacle_kind, obstacle_fit.tables.coarse_kernels, pressing_sign
        )
        for comparison_s, candidate_count in ((GRID_COMPARISON_S, 80), (FIRST_ESTIMATE_S, 10)):
            chi2 = chi2_of(coarse_predictor, obstacle_fit.window(comparison_s), start_candidates)
            start_candidates = start_candidates[np.argsort(chi2)[:candidate_count]]
        predict_effect, parameter_ranges = (
            _moving_predictor(
                obstacle_fit, obstacle_kind, obstacle_fit.tables.middle_kernels, pressing_sign
            ),
            _moving_parameter_ranges(obstacle_fit, obstacle_kind),
        )
        if sample_window.end_sample > obstacle_fit.sample_after_detection(FIRST_ESTIMATE_S):
            early_minima = find_minima(
                predict_effect,
                obstacle_fit.window(FIRST_ESTIMATE_S),
                start_candidates,
                parameter_ranges,
                max_iterations=6,
            )
            start_candidates = early_minima.parameters
        explanations.append(
            obstacle_fit.explain_by_kind(
                obstacle_kind, predict_effect, sample_window, start_candidates, parameter_ranges
            )
        )
    obstacle_contact = ObstacleContact(
        obstacle_fit.tables.middle_kernels, obstacle_fit.tables.x_m, obstacle_fit.motion
    )
    impact_response = ImpactResponse(obstacle_contact, obstacle_fit.tables.middle_kernels, 2)
    start_candidates = impact_response.start_candidates(
        obstacle_fit.window(FIRST_ESTIMATE_S), obstacle_fit.detection_index, 10
    )
    obstacle_ranges = obstacle_fit.parameter_ranges(3)
    parameter_ranges = impact_response.parameter_ranges(
        obstacle_fit.position_range_m,
        (obstacle_ranges.lower_limits[1], obstacle_ranges.upper_limits[1]),
    )
    explanations.append(
        obstacle_fit.explain_by_kind(
            "knock", impact_response.predict, sample_window, start_candidates, parameter_ranges
        )
    )
    return explanations


def _moving_predictor(
    obstacle_fit: ObstacleFit, kind: str, kernels: ContactKernels, pressing_sign: float
) -> EffectPredictor:
    """Return the function that predicts the effects of moving or of yielding obstacles.

    The fourth parameter of its candidates is the speed, or for "yielding" the mobility.
    """
    obstacle_contact = ObstacleContact(kernels, obstacle_fit.tables.x_m, obstacle_fit.motion)

    def predict(candidates: RealArray, sample_window: WhitenedWindow) -> RealArray:
        if kind == "yielding":
            candidates = np.insert(candidates, 3, 0.0, axis=1)
        return obstacle_contact.predict(candidates, sample_window, pressing_sign)[0]

    return predict


def _moving_parameter_ranges(obstacle_fit: ObstacleFit, kind: str) -> ParameterRanges:
    """Return bounds and step sizes of the four parameters of a moving or yielding obstacle."""
    ranges = obstacle_fit.parameter_ranges(5)
    parameter_columns = [0, 1, 2, 3 if kind == "moving" else 4]
    return ParameterRanges(
        ranges.lower_limits[parameter_columns],
        ranges.upper_limits[parameter_columns],
        ranges.derivative_step[parameter_columns],
        ranges.significant_change[parameter_columns],
        ranges.smallest_std[parameter_columns],
        ranges.largest_std[parameter_columns],
    )


# Two obstacles


def explain_by_two_obstacles(
    obstacle_fit: ObstacleFit, resting_explanation: Explanation, sample_window: WhitenedWindow
) -> tuple[Explanation | None, RealArray]:
    """Return the explanation by two obstacles, and possible positions in m of the first one.

    The explanation is None if one obstacle explains the record about as well. At each of the
    positions of the first obstacle, the pair explains the first samples as well as a single
    obstacle does.
    """
    two_contacts = obstacle_fit.two_obstacle_contact()
    parameter_ranges = two_contacts.parameter_ranges(obstacle_fit.parameter_ranges(3))
    # The first samples show in less time whether more iterations are worthwhile.
    early_window = (
        obstacle_fit.window(UNCERTAINTIES_END_S)
        if sample_window.end_sample > obstacle_fit.sample_after_detection(UNCERTAINTIES_END_S)
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
    [single_chi2] = chi2_of(obstacle_fit.predictor(single_obstacle), early_window, single_obstacle)
    equivalent_pairs, equivalent_chi2 = _equivalent_pairs(
        two_contacts, resting_explanation, early_window, parameter_ranges, single_chi2
    )
    first_obstacle_positions_m = equivalent_pairs[equivalent_chi2 <= single_chi2, 0]
    start_candidates = np.vstack([minima.parameters, equivalent_pairs])
    start_chi2 = np.concatenate([minima.chi2, equivalent_chi2])
    if start_chi2.min() > single_chi2 - _MIN_EARLY_CHI2_REDUCTION:
        return None, first_obstacle_positions_m
    likeliest_candidates = start_candidates[np.argsort(start_chi2)[:3]]
    start_pairs = np.vstack(
        [likeliest_candidates, two_contacts.reverse_obstacle_order(likeliest_candidates[:1])]
    )
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
    variance_factor = _TWO_OBSTACLES_VARIANCE if chi2_reduction > DECISIVE_CHI2_DIFFERENCE else 1.0
    two_obstacles = obstacle_fit.explain_from_minima(
        "two",
        two_contacts.predict_channels,
        sample_window,
        minima,
        parameter_ranges,
        variance_factor,
    )
    return two_obstacles, first_obstacle_positions_m


def _equivalent_pairs(
    two_contacts: TwoObstacleContact,
    resting_explanation: Explanation,
    sample_window: WhitenedWindow,
    parameter_ranges: ParameterRanges,
    single_chi2: float,
) -> tuple[RealArray, RealArray]:
    """Return pairs of obstacles with the effect of one, and their sums of squared residuals.

    The shapes are (k, 6) and (k,); k = 0 if no pair has an effect similar to one obstacle.
    """
    obstacle_pairs = two_contacts.equivalent_pairs(
        resting_explanation.parameters, _RELATIVE_PAIR_POSITIONS
    )
    obstacle_pairs = obstacle_pairs[
        (obstacle_pairs[:, [0, 3]] <= parameter_ranges.upper_limits[0]).all(axis=1)
    ]
    predict_effect = two_contacts.predict_channels
    if (
        not obstacle_pairs.size
        or chi2_of(predict_effect, sample_window, obstacle_pairs[:1])[0]
        > single_chi2 + _MAX_EQUIVALENT_CHI2_INCREASE
    ):
        return np.empty((0, 6)), np.empty(0)
    is_free_parameter = np.ones(obstacle_pairs.shape, dtype=bool)
    is_free_parameter[:, 0] = False
    minima = find_minima(
        predict_effect,
        sample_window,
        obstacle_pairs,
        parameter_ranges,
        max_iterations=8,
        is_free_parameter=is_free_parameter,
    )
    return minima.parameters, minima.chi2
