"""Estimate of a touch, combined from the explanations that are about equally likely.

Standard deviations and intervals include the noise, the model's uncertainty and all positions that
are about as likely as the best one.
"""

import numpy as np
from numpy.typing import NDArray

from rigd.touch._explanations import ExplainedRecord, ExplanationSearch
from rigd.touch._obstacle_contact import (
    MAX_LN_STIFFNESS,
    MIN_LN_STIFFNESS,
    ObstacleContact,
    WhitenedWindow,
)
from rigd.touch._obstacle_fit import (
    NEAR_TIP_FRACTION,
    POOR_FIT_STDS,
    Explanation,
    ObstacleFit,
)
from rigd.touch._other_kinds import (
    CHANCE_CHI2_REDUCTION,
    DECISIVE_CHI2_DIFFERENCE,
)
from rigd.touch._posterior import Posterior
from rigd.touch._results import TouchEstimate, TouchQuantity

RealArray = NDArray[np.float64]

_NORMAL_QUANTILE_95 = 1.959964
"""Number of standard deviations of a normal distribution's two-sided 95 % interval."""
_BOUNCE_POSITION_STDS_M = (3e-4, 5e-4)
"""Additional standard deviations in m of the position because of bounces: of a touch far from the
tip, and of one near the tip. With them the errors of 130 simulated touches agree with the
intervals."""
_TWO_OBSTACLES_POSITION_STD_M = 2e-3
"""Additional standard deviation in m of the first obstacle's position if there are two, because
their contact is integrated in longer time steps."""
_EARLY_TIMES_S = (0.006, 0.01, 0.022)
"""Times in s after the detection at which additional, shorter evaluations of an unexplained touch
end. The beam may touch a second point later."""
_WIDE_LIKELIHOOD_DROP = 8.0
"""Difference of the log-likelihood between the likeliest position of an unexplained touch and the
ends of its interval."""


def estimate_from_explanations(
    explanation_search: ExplanationSearch,
    explained_record: ExplainedRecord,
    *,
    includes_likelihoods: bool,
) -> TouchEstimate:
    """Return position, instant, force and stiffness of a touch from its likeliest explanations.

    With `includes_likelihoods` the estimate contains the likelihood of each position; otherwise
    that is empty.
    """
    obstacle_fit = explanation_search.fit
    explanations, sample_window = explained_record.explanations, explained_record.window
    resting_explanation = explanations[0]
    best_explanation = min(explanations, key=lambda explanation: explanation.chi2)
    if resting_explanation.chi2 < best_explanation.chi2 + DECISIVE_CHI2_DIFFERENCE:
        best_explanation = resting_explanation
    likely_explanations = [
        best_explanation,
        *(
            explanation
            for explanation in explanations
            if _is_about_as_likely(best_explanation, explanation)
        ),
    ]
    is_unambiguous = len(likely_explanations) == 1 and best_explanation.kind != "two"
    if best_explanation is resting_explanation:
        likely_explanations += [
            explanation for explanation in explanations if explanation.kind == "two"
        ]
    record_begin_s = obstacle_fit.record_offset / obstacle_fit.rate_hz
    x_m = time_s = force_n = stiffness_n_per_m = None
    force_history_n, force_times_s = np.zeros(0), np.zeros(0)
    obstacle_kind = "unknown"
    if obstacle_fit.fits(best_explanation, sample_window):
        is_poor_fit = not obstacle_fit.fits(best_explanation, sample_window, POOR_FIT_STDS)
        is_doubtful = (
            explained_record.has_contradicting_later_samples or explained_record.has_untried_kinds
            if best_explanation is resting_explanation
            else is_poor_fit
        )
        if is_unambiguous and not is_doubtful:
            obstacle_kind = best_explanation.kind
        x_m, time_s = (
            _position_estimate(obstacle_fit, likely_explanations),
            _parameter_estimate(likely_explanations, 1, record_begin_s),
        )
        x_m = _with_interval_including(x_m, explained_record.first_obstacle_positions_m)
        if is_poor_fit or explained_record.has_untried_kinds:
            x_m = _with_any_force_interval(obstacle_fit, x_m)
        force_history_n, force_times_s, force_n = _force_estimate(
            obstacle_fit, best_explanation, sample_window
        )
        if obstacle_kind == "rigid":
            stiffness_n_per_m = _stiffness_estimate(resting_explanation.posterior)
    elif (
        obstacle_fit.any_force_likelihood.chi2
        < obstacle_fit.max_chi2(obstacle_fit.any_force_likelihood.expected_chi2)
        and not explanation_search.begins_before_window
    ):
        x_m = _unexplained_position(obstacle_fit)
    return TouchEstimate(
        x_m=x_m,
        time_s=time_s,
        force_n=force_n,
        stiffness_n_per_m=stiffness_n_per_m,
        kind=obstacle_kind,
        model=obstacle_fit.tables.model.source,
        channels=obstacle_fit.motion.noise_stds.size,
        samples=sample_window.end_sample - obstacle_fit.detection_index,
        chi2_per_degree=best_explanation.chi2
        / (sample_window.whitened_innovations.size - best_explanation.parameters.size),
        positions_m=obstacle_fit.any_force_likelihood.x_m if includes_likelihoods else np.zeros(0),
        log_likelihood=obstacle_fit.any_force_likelihood.log_likelihood
        if includes_likelihoods
        else np.zeros(0),
        innovations=obstacle_fit.motion.innovations / obstacle_fit.motion.noise_stds[:, None],
        innovation_times_s=obstacle_fit.motion.t + record_begin_s,
        force_history_n=force_history_n,
        force_times_s=force_times_s + record_begin_s,
    )


def _unexplained_position(obstacle_fit: ObstacleFit) -> TouchQuantity:
    """Return the position of an unexplained touch in m, with a wide interval.

    The interval contains all positions at which some force explains the samples up to one of
    several times, because the beam may touch more than one point later.
    """
    early_likelihoods = [
        obstacle_fit.tables.any_force_estimator.scan(obstacle_fit.window(time_s))
        for time_s in _EARLY_TIMES_S
    ]
    interval_ends = np.array(
        [
            likelihood.position_interval_m(_WIDE_LIKELIHOOD_DROP)[2:]
            for likelihood in (obstacle_fit.any_force_likelihood, *early_likelihoods)
        ]
    )
    low_m, high_m = float(interval_ends[:, 0].min()), float(interval_ends[:, 1].max())
    return TouchQuantity(
        obstacle_fit.any_force_likelihood.position_interval_m(_WIDE_LIKELIHOOD_DROP)[0],
        (high_m - low_m) / 4,
        (low_m, high_m),
    )


def _with_any_force_interval(obstacle_fit: ObstacleFit, estimate: TouchQuantity) -> TouchQuantity:
    """Return a touch position in m, whose interval includes the interval for an arbitrary force."""
    *_, low_m, high_m = obstacle_fit.any_force_likelihood.position_interval_m()
    low_m, high_m = min(low_m, estimate.interval_95[0]), max(high_m, estimate.interval_95[1])
    return TouchQuantity(estimate.value, max(estimate.std, (high_m - low_m) / 4), (low_m, high_m))


def _with_interval_including(estimate: TouchQuantity, positions_m: RealArray) -> TouchQuantity:
    """Return a touch position in m, whose interval is extended to include `positions_m`."""
    low_m, high_m = (
        float(limit([*estimate.interval_95, *positions_m])) for limit in (np.min, np.max)
    )
    if (low_m, high_m) == estimate.interval_95:
        return estimate
    max_distance_m = max(high_m - estimate.value, estimate.value - low_m)
    return TouchQuantity(
        estimate.value, max(estimate.std, max_distance_m / _NORMAL_QUANTILE_95), (low_m, high_m)
    )


def _position_estimate(
    obstacle_fit: ObstacleFit, likely_explanations: list[Explanation]
) -> TouchQuantity:
    """Return the touch position in m, less certain because of bounces or a second obstacle."""
    position_estimate = _parameter_estimate(likely_explanations, 0)
    is_near_tip = (
        position_estimate.value > NEAR_TIP_FRACTION * obstacle_fit.tables.model.plant.beam.length_m
    )
    additional_std_m = (
        _TWO_OBSTACLES_POSITION_STD_M
        if likely_explanations[0].kind == "two"
        else _BOUNCE_POSITION_STDS_M[int(is_near_tip)]
    )
    low_m, high_m = (
        position_estimate.value
        + np.copysign(
            np.hypot(end - position_estimate.value, _NORMAL_QUANTILE_95 * additional_std_m),
            interval_sign,
        )
        for end, interval_sign in zip(position_estimate.interval_95, (-1.0, 1.0), strict=True)
    )
    length_m = obstacle_fit.tables.model.plant.beam.length_m
    return TouchQuantity(
        position_estimate.value,
        float(np.hypot(position_estimate.std, additional_std_m)),
        (max(float(low_m), 0.0), min(float(high_m), length_m)),
    )


def _force_estimate(
    obstacle_fit: ObstacleFit,
    best_explanation: Explanation,
    sample_window: WhitenedWindow,
) -> tuple[RealArray, RealArray, TouchQuantity]:
    """Return the contact force in N at each time step, the instants in s, and the peak force.

    Forces and instants are computed from the likeliest parameters, the peak and its interval from
    samples of the posterior distribution.
    """
    rng = np.random.default_rng(2)
    posterior = best_explanation.posterior
    drawn_indices = rng.choice(posterior.weights.size, 48, p=posterior.weights)
    parameter_candidates = np.vstack(
        [best_explanation.parameters, posterior.samples[drawn_indices]]
    )
    step_s = obstacle_fit.tables.middle_kernels.step_s
    if best_explanation.kind == "knock":
        peak_forces_n = np.abs(parameter_candidates[:, 3])
        pulse_phase = np.arange(0.0, np.exp(parameter_candidates[0, 2]) + step_s, step_s) / np.exp(
            parameter_candidates[0, 2]
        )
        force_history_n = peak_forces_n[:1, None] * np.sin(np.pi * np.minimum(pulse_phase, 1.0))
    elif best_explanation.kind == "two":
        step_s = obstacle_fit.tables.coarse_kernels.step_s
        force_history_n = np.abs(
            obstacle_fit.two_obstacle_contact().predict(parameter_candidates, sample_window)[1]
        )
        peak_forces_n = force_history_n.max(axis=1)
    else:
        obstacle_contact = ObstacleContact(
            obstacle_fit.tables.middle_kernels,
            obstacle_fit.tables.x_m,
            obstacle_fit.motion,
        )
        pressing_sign = None if best_explanation.kind == "rigid" else obstacle_fit.pressing_sign()
        if best_explanation.kind == "yielding":
            parameter_candidates = np.insert(parameter_candidates, 3, 0.0, axis=1)
        force_history_n = np.abs(
            obstacle_contact.predict(parameter_candidates, sample_window, pressing_sign)[1]
        )
        peak_forces_n = force_history_n.max(axis=1)
    low_n, high_n = np.quantile(peak_forces_n[1:], (0.025, 0.975))
    peak_force = TouchQuantity(
        float(peak_forces_n[1:].mean()),
        float(peak_forces_n[1:].std()),
        (float(low_n), float(high_n)),
    )
    return (
        force_history_n[0],
        parameter_candidates[0, 1] + step_s * np.arange(force_history_n.shape[1]),
        peak_force,
    )


def _is_about_as_likely(best_explanation: Explanation, other_explanation: Explanation) -> bool:
    """Return whether another explanation of a touch is about as likely as the best one.

    An explanation with more parameters must have clearly smaller residuals.
    """
    if best_explanation.kind == "rigid" and other_explanation.kind in ("moving", "yielding"):
        return other_explanation.chi2 < best_explanation.chi2 - CHANCE_CHI2_REDUCTION
    if best_explanation.kind == "rigid" and other_explanation.kind == "two":
        return False
    return (
        other_explanation is not best_explanation
        and other_explanation.chi2 < best_explanation.chi2 + DECISIVE_CHI2_DIFFERENCE
    )


def _parameter_estimate(
    likely_explanations: list[Explanation], parameter_column: int, value_shift: float = 0.0
) -> TouchQuantity:
    """Return the estimate of one parameter, with an interval that contains all explanations'.

    `parameter_column` is the column of the parameter in the posterior's samples. `value_shift` is
    added to the value and to the ends of the interval.
    """
    interval_ends = np.array(
        [
            explanation.posterior.quantiles(parameter_column, (0.025, 0.975))
            for explanation in likely_explanations
        ]
    )
    low_end, high_end = float(interval_ends[:, 0].min()), float(interval_ends[:, 1].max())
    posterior_mean, posterior_std = (
        likely_explanations[0].posterior.mean(parameter_column),
        likely_explanations[0].posterior.std(parameter_column),
    )
    if len(likely_explanations) > 1:
        posterior_std = max(
            posterior_std,
            (posterior_mean - low_end) / _NORMAL_QUANTILE_95,
            (high_end - posterior_mean) / _NORMAL_QUANTILE_95,
        )
    return TouchQuantity(
        posterior_mean + value_shift, posterior_std, (low_end + value_shift, high_end + value_shift)
    )


def _stiffness_estimate(posterior: Posterior) -> TouchQuantity | None:
    """Return the obstacle's estimated stiffness in N/m, or None if the data do not bound it.

    The estimate is the exponential of the median of the logarithm.
    """
    low_ln_stiffness, median_ln_stiffness, high_ln_stiffness = posterior.quantiles(
        2, (0.025, 0.5, 0.975)
    )
    if (
        high_ln_stiffness > MAX_LN_STIFFNESS - 0.7
        or low_ln_stiffness < MIN_LN_STIFFNESS + 0.3
        or high_ln_stiffness - low_ln_stiffness > np.log(100)
    ):
        return None
    stiffness_n_per_m = float(np.exp(median_ln_stiffness))
    return TouchQuantity(
        stiffness_n_per_m,
        stiffness_n_per_m * posterior.std(2),
        (float(np.exp(low_ln_stiffness)), float(np.exp(high_ln_stiffness))),
    )
