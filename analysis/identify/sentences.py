"""Sentences of the verdict on one record, and experiments that would clarify the verdict."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from analysis.identify._visible_modes import is_excited
from analysis.identify.headline import EXACTLY_UNIFORM_CONDITION, ONE_MODE_REASON
from analysis.identify.verdict import SECOND_DAMPING_REASON, deviance_of_order_one
from analysis.statistics import NORMAL_95
from rigd.beam import DAMPING_PARAMETERS
from rigd.printable import listed
from rigd.units import decimals, rounded_to_uncertainty

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.identify._candidate import Candidate
    from analysis.identify._candidates import CandidateSet
    from analysis.identify._finding import Finding
    from analysis.identify.beam_uniformity import UniformBeamTest
    from analysis.identify.headline import ConditionalEstimate, Headline
    from analysis.identify.profile_likelihood import OrderName
    from analysis.identify.tolerant_estimate import TolerantEstimate
    from analysis.identify.verdict import OrderVerdict, Status
    from rigd.estimates import Estimate

# Sentences

_MIN_MODES_TO_SEPARATE_DAMPINGS: Final = 2
"""Number of visible modes from which internal and external damping are separable."""

_DAMPING_OF_ORDER: Final = {"alpha": "internal damping", "lambda": "external damping"}
"""Damping to which each order belongs, in words."""

LOSS_NAMES: Final[Mapping[OrderName, str]] = {
    "alpha": "internal loss",
    "lambda": "external damping torque",
}
"""Quantity whose growth with frequency each order describes, in words."""


def headline_sentences(
    headline: Headline,
    order_verdicts: tuple[OrderVerdict, OrderVerdict],
    *,
    doubt_reason: str | None,
) -> list[str]:
    """Return the sentences on modes, damping and conditions of the reported numbers.

    Parameters
    ----------
    headline : Headline
        Headline of the record.
    order_verdicts : tuple of OrderVerdict
        Verdicts on alpha and lambda.
    doubt_reason : str or None
        Reason to doubt every number. With one, no structure is excluded.
    """
    if len(headline.visible_modes) < _MIN_MODES_TO_SEPARATE_DAMPINGS:
        sentences = [f"{ONE_MODE_REASON.capitalize()}, nor does it determine their orders."]
    else:
        sentences = [
            *uniformity(headline.uniform_beam),
            *_damping_sentences(headline, order_verdicts, doubt_reason=doubt_reason),
        ]
    if headline.tolerant is None:
        sentences += [order_sentence(order_verdict) for order_verdict in order_verdicts]
    else:
        sentences += [
            order_slope_sentence(headline, order_verdict) for order_verdict in order_verdicts
        ]
        sentences += _exact_order_sentences(headline)
    if headline.is_explained:
        sentences.append(
            "The residual is white: this model suffices for this record."
            if doubt_reason is None
            else f"The residual is white, but {doubt_reason}."
        )
    return sentences


def uniformity(beam_test: UniformBeamTest | None) -> list[str]:
    """Return the sentence on the uniform-beam test, or no sentence if there was no test.

    Parameters
    ----------
    beam_test : UniformBeamTest or None
        Test on the record. None if no mode is visible.
    """
    if beam_test is None or beam_test.p_value is None:
        return []
    mode_list = listed([str(mode_number) for mode_number in beam_test.mode_numbers])
    chance_text = beam_test.summary.chance
    if beam_test.status == "passed":
        return [
            "A uniform beam predicts frequencies, damping ratios and residues of modes "
            f"{mode_list} ({chance_text})."
        ]
    return [
        "A uniform beam does not predict frequencies, damping ratios and residues of modes "
        f"{mode_list} ({chance_text}): the modes are reported without it."
    ]


def _damping_sentences(
    headline: Headline,
    order_verdicts: tuple[OrderVerdict, OrderVerdict],
    *,
    doubt_reason: str | None,
) -> list[str]:
    """Return the sentences on the dampings that a beam has, and on the excluded structures.

    With a `doubt_reason`, no structure is excluded.
    """
    if headline.tolerant is not None:
        excluded_names = headline.structures_with_status("excluded") if doubt_reason is None else ()
        return (
            [f"Excluded by the losses: {_list_structures(excluded_names)}."]
            if excluded_names
            else []
        )
    reported_structure = headline.fit.structure
    damping_phrase = reported_structure.description
    if any(each.reason == SECOND_DAMPING_REASON for each in order_verdicts):
        damping_phrase = damping_phrase.replace("only", "alone is sufficient")
    sentences = [f"{damping_phrase}. Numbers are those of type {headline.name}, all orders free."]
    excluded_names = headline.structures_with_status("excluded")
    if headline.is_explained and doubt_reason is None and excluded_names:
        sentences.append(f"Excluded: {_list_structures(excluded_names)}.")
    if headline.simpler is not None and headline.simpler.fixed:
        sentences.append(_conditional_sentence(headline.simpler))
    return sentences


def order_slope_sentence(headline: Headline, verdict: OrderVerdict) -> str:
    """Return the sentence on one order: the slope of a loss over the visible modes.

    Parameters
    ----------
    headline : Headline
        Headline with an estimate that tolerates deviations of the geometry.
    verdict : OrderVerdict
        Verdict on the order.
    """
    tolerant_estimate = headline.tolerant
    assert tolerant_estimate is not None
    order_name, damping_name = verdict.order, _DAMPING_OF_ORDER[verdict.order]
    if verdict.value is None or verdict.interval is None:
        return (
            f"The order {order_name} of the {damping_name} is not identifiable: {verdict.reason}."
        )
    visible_hz = [mode.frequency_hz.value for mode in headline.modes if mode.shown]
    return loss_slope_sentence(
        order_name,
        verdict.value,
        verdict.interval,
        visible_hz,
        tolerant_estimate,
        verdict.status,
        verdict.reason,
    )


def loss_slope_sentence(
    order: OrderName,
    order_value: float,
    order_interval: tuple[float, float],
    shown_hz: Sequence[float],
    estimate: TolerantEstimate,
    status: Status,
    doubt_reason: str | None,
) -> str:
    """Return the sentence on the growth of a loss over the visible modes, and its conditions.

    Parameters
    ----------
    order : str
        "alpha" or "lambda".
    order_value : float
        Estimate of the order.
    order_interval : (float, float)
        95 % interval of the order.
    shown_hz : sequence of float
        Frequencies of the visible modes in hertz.
    estimate : TolerantEstimate
        Estimate that contains the order.
    status : str
        "compatible", "fractional" or "open".
    doubt_reason : str or None
        Reason why the order is not established. None if it is established.
    """
    std = (order_interval[1] - order_interval[0]) / (2 * NORMAL_95)
    value_text, low_text, high_text = rounded_to_uncertainty((order_value, *order_interval), std)
    condition_text = "by damping ratios and residue phases alone"
    if estimate.basis == "geometry":
        condition_text = (
            f"if frequencies are those of a uniform beam to {100 * estimate.uniformity:g} %"
        )
    slope_sentence = (
        f"Between {min(shown_hz):.3g} and {max(shown_hz):.3g} Hz the {LOSS_NAMES[order]} grows as "
        f"f^{value_text} ({order}; 95 %: {low_text} to {high_text}), {condition_text}"
    )
    if doubt_reason is not None:
        return f"{slope_sentence}; not established, because {doubt_reason}."
    conclusion_text = {
        "compatible": "consistent with order 1",
        "fractional": "damping ratios and residue phases alone exclude order 1",
    }.get(status, "order 1 is doubtful, but damping ratios and residue phases do not exclude it")
    return f"{slope_sentence}: {conclusion_text}."


def _exact_order_sentences(headline: Headline) -> list[str]:
    """Return the sentence on the orders if the beam is exactly uniform, or no sentence."""
    exact_estimates = headline.exact
    if exact_estimates is None:
        return []
    number_texts = [
        f"{order_name} = {_value_and_interval_text(exact_estimates.parameters[order_name])}"
        for order_name in ("alpha", "lambda")
        if order_name in exact_estimates.parameters
        and exact_estimates.parameters[order_name].flag is None
    ]
    if not number_texts:
        return []
    return [f"{EXACTLY_UNIFORM_CONDITION.capitalize()}: {', '.join(number_texts)}."]


def order_sentence(order_verdict: OrderVerdict) -> str:
    """Return the sentence on one order of damping, estimated for an exactly uniform beam."""
    order_profile = order_verdict.profile
    lower_end, upper_end = order_profile.interval
    order_name, damping_name = order_verdict.order, _DAMPING_OF_ORDER[order_verdict.order]
    std = (upper_end - lower_end) / (2 * NORMAL_95)
    estimate_text, first_text, last_text = rounded_to_uncertainty(
        (order_profile.estimate, lower_end, upper_end), std
    )
    order_text = f"{estimate_text} (95 %: {first_text} to {last_text})"
    if order_verdict.status == "absent":
        return f"No {damping_name} was found, so its order {order_name} has no meaning."
    if order_verdict.status == "not identifiable":
        return (
            f"The order {order_name} of the {damping_name} is not identifiable: "
            f"{_unidentifiable_reason(order_verdict)}."
        )
    if order_verdict.reason is not None:
        return (
            f"The order {order_name} of the {damping_name} is not established: {order_text} fits, "
            f"but {order_verdict.reason}. "
            "Do not interpret it."
        )
    if order_verdict.status == "compatible":
        return f"The order {order_name} of the {damping_name} is {order_text}, consistent with 1."
    if order_verdict.status == "fractional":
        return f"The order {order_name} of the {damping_name} is {order_text}; 1 is excluded."
    return (
        f"The order {order_name} of the {damping_name} is {order_text}: 1 is doubtful, but not "
        f"excluded (p = {math.erfc(math.sqrt(deviance_of_order_one(order_profile) / 2)):.1g})."
    )


def _list_structures(structure_names: tuple[str, ...]) -> str:
    """Return "type" or "types" with the sorted names of structures."""
    return f"type{'s' if len(structure_names) > 1 else ''} {listed(sorted(structure_names))}"


def _conditional_sentence(simpler: ConditionalEstimate) -> str:
    """Return the sentence on the conditional estimate of a simpler structure."""
    condition = " and ".join(
        f"{parameter_name} = {fixed_value:g}"
        for parameter_name, fixed_value in simpler.fixed.items()
    )
    number_texts = [
        f"{parameter_name} = {_value_and_interval_text(simpler.parameters[parameter_name])}"
        for parameter_name in DAMPING_PARAMETERS
        if parameter_name in simpler.parameters
    ]
    return (
        f"{condition[0].upper()}{condition[1:]} {'is' if len(simpler.fixed) == 1 else 'are'} not "
        f"excluded; if true (type {simpler.name}): {', '.join(number_texts)}."
    )


def _value_and_interval_text(reported_value: Estimate) -> str:
    """Return a reported value with its 95 % interval as text, rounded to its uncertainty."""
    if reported_value.interval_95 is None or not reported_value.std:
        return f"{reported_value.value:.4g}"
    lower_end, upper_end = reported_value.interval_95
    decimal_exponent = (
        math.floor(math.log10(abs(reported_value.value))) if reported_value.value else 0
    )
    divisor = 10.0**decimal_exponent if decimal_exponent < -2 else 1.0
    digit_count = decimals(reported_value.std / divisor)
    power_text = f"e{decimal_exponent}" if decimal_exponent < -2 else ""
    return (
        f"{reported_value.value / divisor:.{digit_count}f}{power_text} "
        f"({lower_end / divisor:.{digit_count}f}{power_text} to "
        f"{upper_end / divisor:.{digit_count}f}{power_text})"
    )


def _unidentifiable_reason(order_verdict: OrderVerdict) -> str:
    """Return, as part of a sentence, why an order is not identifiable."""
    order_profile = order_verdict.profile
    lower_end, upper_end = order_profile.interval
    if order_verdict.reason is not None and (
        order_profile.identifiable or not order_profile.is_computed
    ):
        return order_verdict.reason
    if len(order_profile.local_minima) > 1:
        minima_text = " and ".join(
            f"{order_value:.3f}" for order_value in sorted(order_profile.local_minima)
        )
        return (
            f"{minima_text} fit the record equally well, each with a different damping (95 %: "
            f"{lower_end:.3f} to {upper_end:.3f}, with all that lies between)"
        )
    return (
        "any value between 0 and 2 fits"
        if order_profile.open_below and order_profile.open_above
        else f"anything below {upper_end:.2f} fits"
        if order_profile.open_below
        else f"anything above {lower_end:.2f} fits"
        if order_profile.open_above
        else f"anything from {lower_end:.2f} to {upper_end:.2f} fits"
    )


# Advice on experiments

_MIN_MODES_FOR_AN_ORDER: Final = 2
"""Number of visible modes from which one more mode, or slower sweeps around the modes, are advised.
With fewer modes, the advice is how to make these visible."""

_SECOND_OVER_FIRST_FREQUENCY: Final = 6.267
"""Frequency of the second mode of a uniform beam over that of the first."""

_MODE_ORDINALS: Final = {1: "first", 2: "second"}
"""Ordinals of the first two modes, in words."""


def experiments(
    candidate_set: CandidateSet,
    order_verdicts: tuple[OrderVerdict, ...],
    visible_numbers: tuple[int, ...],
    findings: tuple[Finding, ...],
    close_rivals: tuple[Candidate, ...],
) -> list[str]:
    """Return experiments that would clarify the verdict, in addition to the findings' remedies.

    Parameters
    ----------
    candidate_set : CandidateSet
        Candidates of the record.
    order_verdicts : tuple of OrderVerdict
        Verdicts on alpha and lambda.
    visible_numbers : tuple of int
        Numbers of the visible modes.
    findings : tuple of Finding
        Findings on the record.
    close_rivals : tuple of Candidate
        Candidates that explain the record about as well as the selected one.
    """
    advice_sentences = []
    unidentifiable_orders = [o for o in order_verdicts if o.status == "not identifiable"]
    if unidentifiable_orders:
        order_names = " and ".join(o.order for o in unidentifiable_orders)
        if len(visible_numbers) < _MIN_MODES_FOR_AN_ORDER:
            advice_sentences.append(
                f"To determine {order_names}, "
                f"{_advice_for_two_modes(candidate_set, visible_numbers)}"
            )
        else:
            advice_sentences.append(
                f"To determine {order_names}, run narrow, slow sweeps around the modes, or a wider "
                "sweep that reaches one more mode."
            )
    has_unexplained_residual = any(finding.kind == "unexplained" for finding in findings)
    if close_rivals or (
        not has_unexplained_residual and any(o.status == "open" for o in order_verdicts)
    ):
        advice_sentences.append(
            "To distinguish the structures, excite one more mode (a wider sweep), or sweep longer."
        )
    return advice_sentences


def _advice_for_two_modes(candidate_set: CandidateSet, visible_numbers: tuple[int, ...]) -> str:
    """Return the advice, as part of a sentence, how to make both of the first two modes visible."""
    frequency_by_mode = {
        mode_estimate.number: mode_estimate.frequency_hz
        for mode_estimate in candidate_set.best.fit.modes
    }
    first_hz = frequency_by_mode.get(1, 0.0)
    expected_hz = {
        1: first_hz,
        2: frequency_by_mode.get(2, _SECOND_OVER_FIRST_FREQUENCY * first_hz),
    }
    missing_mode = next(mode_number for mode_number in (1, 2) if mode_number not in visible_numbers)
    other_mode = 3 - missing_mode
    last_hz = float(candidate_set.comparison.frequency_hz[-1])
    if expected_hz[missing_mode] > last_hz:
        return (
            f"analyse and excite the {_MODE_ORDINALS[missing_mode]} mode as well: band and sweep "
            f"up to at least {1.3 * expected_hz[missing_mode]:.0f} Hz (the band ends at "
            f"{last_hz:.0f} Hz)."
        )
    if not is_excited(
        candidate_set.comparison, expected_hz[missing_mode], compared_hz=expected_hz[other_mode]
    ):
        return f"excite the {_MODE_ORDINALS[missing_mode]} mode as well: sweep " + (
            f"up to at least {1.3 * expected_hz[2]:.0f} Hz."
            if missing_mode == 2
            else f"from below {0.7 * expected_hz[1]:.1f} Hz."
        )
    return (
        f"raise the {_MODE_ORDINALS[missing_mode]} mode above the noise: it was driven at its "
        f"{expected_hz[missing_mode]:.1f} Hz, so increase the amplitude (twice), sweep slower or "
        "repeat; a wider band does not help."
    )
