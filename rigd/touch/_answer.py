"""Estimate of a touch: the common result of its likeliest explanations, and its kind.

Standard deviations and intervals of the values include the noise, the model's uncertainty and all
positions that are about as likely.
"""

import numpy as np
from numpy.typing import NDArray

from rigd.touch._explanations import (
    CHANCE_CHI2_REDUCTION,
    DECISIVE_CHI2_DIFFERENCE,
    NEAR_TIP_FRACTION,
    POOR_FIT_STDS,
    ExplainedRecord,
    Explanation,
    ExplanationSearch,
)
from rigd.touch._physical import MAX_LN_STIFFNESS, MIN_LN_STIFFNESS, ObstacleContact, WhitenedWindow
from rigd.touch._posterior import Posterior
from rigd.touch._results import Estimated, TouchEstimate

Real = NDArray[np.float64]

_NORMAL_QUANTILE_95 = 1.959964
"""Number of standard deviations of a normal distribution's two-sided 95 % interval."""
_BOUNCE_STD_M = (3e-4, 5e-4)
"""Additional standard deviation of the position in m, from the bounces of hard contacts: elsewhere,
and near the tip. With this addition the errors of 130 simulated touches agree with the
intervals."""
_TWO_OBSTACLES_STD_M = 2e-3
"""Additional standard deviation in m of the position of the first of two obstacles, whose contact
is integrated in longer time steps."""
_EARLY_TIMES_S = (0.006, 0.01, 0.022)
"""Times in s after the detection up to which an unexplained touch is evaluated in addition. Later a
second point may be touched."""
_WIDE_LIKELIHOOD_DROP = 8.0
"""Drop of the log-likelihood at the ends of the position's interval for an unexplained touch."""


def estimate_from_explanations(
    search: ExplanationSearch, explained: ExplainedRecord, *, scan: bool
) -> TouchEstimate:
    """Return the estimate of a touch from the likeliest explanations of its record.

    Parameters
    ----------
    search
        Search that found the explanations.
    explained
        Explanations of the record.
    scan
        Whether the estimate contains the likelihood of all positions; otherwise it is empty.
    """
    explanations, window = explained.explanations, explained.window
    at_rest = explanations[0]
    best = min(explanations, key=lambda each: each.chi2)
    if at_rest.chi2 < best.chi2 + DECISIVE_CHI2_DIFFERENCE:
        best = at_rest
    likely_explanations = [
        best,
        *(each for each in explanations if _is_about_as_likely(best, each)),
    ]
    is_unambiguous = len(likely_explanations) == 1 and best.kind != "two"
    if best is at_rest:
        likely_explanations += [each for each in explanations if each.kind == "two"]
    offset = search.begin / search.rate
    x_m = time_s = force_n = stiffness = None
    force_history_n, instants = np.zeros(0), np.zeros(0)
    kind = "unknown"
    if search.fits(best, window):
        is_poor_fit = not search.fits(best, window, POOR_FIT_STDS)
        is_doubtful = (
            explained.later_samples_contradict or explained.other_kinds_untried
            if best is at_rest
            else is_poor_fit
        )
        if is_unambiguous and not is_doubtful:
            kind = best.kind
        x_m, time_s = (
            _position_estimate(search, likely_explanations),
            _common_parameter(likely_explanations, 1, offset),
        )
        if is_poor_fit or explained.other_kinds_untried:
            x_m = _with_wide_interval(search, x_m)
        force_history_n, instants, force_n = _force_estimate(search, best, window)
        if kind == "rigid":
            stiffness = _stiffness_estimate(at_rest.posterior)
    elif (
        search.any_force.chi2 < search.max_chi2(search.any_force.degrees)
        and not search.begins_before_window
    ):
        x_m = _unexplained_position(search)
    return TouchEstimate(
        x_m=x_m,
        time_s=time_s,
        force_n=force_n,
        stiffness_n_per_m=stiffness,
        kind=kind,
        model=search.tables.model.source,
        channels=search.motion.noise.size,
        samples=window.end - search.detected,
        chi2_per_degree=best.chi2 / (window.data.size - best.parameters.size),
        positions_m=search.any_force.x_m if scan else np.zeros(0),
        log_likelihood=search.any_force.log_likelihood if scan else np.zeros(0),
        innovations=search.motion.innovations / search.motion.noise[:, None],
        innovation_times_s=search.motion.t + offset,
        force_history_n=force_history_n,
        force_times_s=instants + offset,
    )


def _unexplained_position(search: ExplanationSearch) -> Estimated:
    """Return the position of an unexplained touch in m, with a wide interval.

    The interval contains all positions at which any force could cause the first samples, or the
    first and later samples. Later more than one point may be touched.
    """
    early = [search.tables.any_force.scan(search.window(seconds)) for seconds in _EARLY_TIMES_S]
    interval_ends = np.array(
        [scan.interval(_WIDE_LIKELIHOOD_DROP)[2:] for scan in (search.any_force, *early)]
    )
    low, high = float(interval_ends[:, 0].min()), float(interval_ends[:, 1].max())
    return Estimated(
        search.any_force.interval(_WIDE_LIKELIHOOD_DROP)[0], (high - low) / 4, (low, high)
    )


def _with_wide_interval(search: ExplanationSearch, estimate: Estimated) -> Estimated:
    """Return the estimate of a position with an interval that contains those for any force."""
    *_, low, high = search.any_force.interval()
    low, high = min(low, estimate.interval_95[0]), max(high, estimate.interval_95[1])
    return Estimated(estimate.value, max(estimate.std, (high - low) / 4), (low, high))


def _position_estimate(
    search: ExplanationSearch, likely_explanations: list[Explanation]
) -> Estimated:
    """Return the position of the touch in m, with the additional uncertainty from bounces."""
    estimate = _common_parameter(likely_explanations, 0)
    near_tip = estimate.value > NEAR_TIP_FRACTION * search.tables.model.beam.length_m
    additional_std_m = (
        _TWO_OBSTACLES_STD_M
        if likely_explanations[0].kind == "two"
        else _BOUNCE_STD_M[int(near_tip)]
    )
    low, high = (
        estimate.value
        + np.copysign(np.hypot(end - estimate.value, _NORMAL_QUANTILE_95 * additional_std_m), sign)
        for end, sign in zip(estimate.interval_95, (-1.0, 1.0), strict=True)
    )
    length = search.tables.model.beam.length_m
    return Estimated(
        estimate.value,
        float(np.hypot(estimate.std, additional_std_m)),
        (max(float(low), 0.0), min(float(high), length)),
    )


def _force_estimate(
    search: ExplanationSearch, best: Explanation, window: WhitenedWindow
) -> tuple[Real, Real, Estimated]:
    """Return the contact force over time, its instants, and its peak with an interval.

    Force and instants are those of the likeliest parameters. The interval of the peak contains the
    spread over the posterior distribution.
    """
    rng = np.random.default_rng(2)
    posterior = best.posterior
    drawn = rng.choice(posterior.weights.size, 48, p=posterior.weights)
    candidates = np.vstack([best.parameters, posterior.samples[drawn]])
    step_s = search.tables.middle.step_s
    if best.kind == "knock":
        peaks = np.abs(candidates[:, 3])
        phase = np.arange(0.0, np.exp(candidates[0, 2]) + step_s, step_s) / np.exp(candidates[0, 2])
        force = peaks[:1, None] * np.sin(np.pi * np.minimum(phase, 1.0))
    elif best.kind == "two":
        step_s = search.tables.coarse.step_s
        force = np.abs(search.pairing().predict(candidates, window)[1])
        peaks = force.max(axis=1)
    else:
        contact = ObstacleContact(search.tables.middle, search.tables.x_m, search.motion)
        side = None if best.kind == "rigid" else search.pressing_direction()
        if best.kind == "yielding":
            candidates = np.insert(candidates, 3, 0.0, axis=1)
        force = np.abs(contact.predict(candidates, window, side)[1])
        peaks = force.max(axis=1)
    low, high = np.quantile(peaks[1:], (0.025, 0.975))
    estimate = Estimated(float(peaks[1:].mean()), float(peaks[1:].std()), (float(low), float(high)))
    return force[0], candidates[0, 1] + step_s * np.arange(force.shape[1]), estimate


def _is_about_as_likely(best: Explanation, other: Explanation) -> bool:
    """Return whether another explanation is about as likely as the best one.

    An explanation with more parameters must be clearly better.
    """
    if best.kind == "rigid" and other.kind in ("moving", "yielding"):
        return other.chi2 < best.chi2 - CHANCE_CHI2_REDUCTION
    if best.kind == "rigid" and other.kind == "two":
        return False
    return other is not best and other.chi2 < best.chi2 + DECISIVE_CHI2_DIFFERENCE


def _common_parameter(
    likely_explanations: list[Explanation], column: int, shift: float = 0.0
) -> Estimated:
    """Return the estimate of a parameter that all likely explanations have in common.

    `column` is the column of the parameter, `shift` is added to its value, and the interval
    contains those of all explanations.
    """
    interval_ends = np.array(
        [each.posterior.quantiles(column, (0.025, 0.975)) for each in likely_explanations]
    )
    low, high = float(interval_ends[:, 0].min()), float(interval_ends[:, 1].max())
    mean, std = (
        likely_explanations[0].posterior.mean(column),
        likely_explanations[0].posterior.std(column),
    )
    if len(likely_explanations) > 1:
        std = max(std, (mean - low) / _NORMAL_QUANTILE_95, (high - mean) / _NORMAL_QUANTILE_95)
    return Estimated(mean + shift, std, (low + shift, high + shift))


def _stiffness_estimate(posterior: Posterior) -> Estimated | None:
    """Return the estimate of the stiffness in N/m, or None if the data do not bound it.

    The value is the exponential of the logarithm's median.
    """
    low, middle, high = posterior.quantiles(2, (0.025, 0.5, 0.975))
    if high > MAX_LN_STIFFNESS - 0.7 or low < MIN_LN_STIFFNESS + 0.3 or high - low > np.log(100):
        return None
    value = float(np.exp(middle))
    return Estimated(value, value * posterior.std(2), (float(np.exp(low)), float(np.exp(high))))
