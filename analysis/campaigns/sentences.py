"""Sentences of a campaign's verdict on the damping of its specimen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns._statistics import PAPER_BEST_MODELS
from analysis.campaigns._welch_bias import MAX_REFERENCE_MISFIT
from analysis.campaigns.labels import format_p_value, join_first_texts, label_and_unit
from analysis.identify.sentences import LOSS_NAMES
from analysis.models import STRUCTURES
from analysis.statistics import student_t_quantile
from rigd.beam import COEFFICIENT_OF
from rigd.printable import listed
from rigd.units import decimals, rounded_to_uncertainty

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from analysis.campaigns._homogeneity import Homogeneity
    from analysis.campaigns._orders import PooledOrder
    from analysis.campaigns._validation import FailedPrediction, LeaveOneOutResult
    from analysis.campaigns._welch_bias import ParameterBias, WelchBias
    from analysis.campaigns.pooling import PooledEstimate, PooledMode
    from analysis.identify.headline import ReportedLossFactor
    from analysis.identify.profile_likelihood import OrderName


_DAMPING_NAME_BY_ORDER: Final = {"alpha": "internal damping", "lambda": "external damping"}
"""Name of the damping that has each order."""
_ORDER_NAMES: Final[tuple[OrderName, ...]] = ("alpha", "lambda")
"""Names of the orders of internal and of external damping."""
_CLASSICAL_STRUCTURE: Final = "III"
"""Structure with internal and external damping, both of order 1."""
_MAX_EQUAL_ERROR_RATIO: Final = 1.01
"""Largest ratio of prediction error to in-sample error that counts as equally good."""


_NEARLY_INTEGER_DISTANCE: Final = 0.05
"""Distance from 1 within which an order is called nearly integer although 1 is excluded."""


def describe_orders(
    freest_fit: PooledEstimate,
    alpha: PooledOrder,
    lambda_: PooledOrder,
    validation: Sequence[LeaveOneOutResult],
) -> str:
    """Describe the order of each damping, and the prediction errors of two structures.

    The two structures are the classical one (both orders 1) and the freest one.

    Parameters
    ----------
    freest_fit : PooledEstimate
        Pooled estimate of the freest structure.
    alpha, lambda_ : PooledOrder
        Orders of internal and external damping.
    validation : sequence of LeaveOneOutResult
        Errors of sessions predicted from the others.
    """
    conjunction = " and " if alpha.exact is None else "; "
    order_clauses = f"{_order_clause(alpha)}{conjunction}{_order_clause(lambda_)}"
    sentence = f"{order_clauses[0].upper()}{order_clauses[1:]}."
    names_by_error: dict[str, list[str]] = {}
    for structure_name in dict.fromkeys((_CLASSICAL_STRUCTURE, freest_fit.name)):
        structure_errors = [
            e.error for e in validation if e.method == "record" and e.name == structure_name
        ]
        if structure_errors:
            names_by_error.setdefault(f"{100 * float(np.mean(structure_errors)):.2g} %", []).append(
                structure_name
            )
    if not names_by_error:
        return sentence
    types_by_error_text = ", ".join(
        f"type{'s' if len(names) > 1 else ''} {listed(names)} with {error_text}"
        for error_text, names in names_by_error.items()
    )
    return f"{sentence} Error of the torque predicted for an unseen session: {types_by_error_text}."


def _order_clause(pooled_order: PooledOrder) -> str:
    """Describe the order of one damping as the clause of a sentence."""
    if pooled_order.exact is not None:
        return _loss_slope_clause(pooled_order)
    damping_name = _DAMPING_NAME_BY_ORDER[pooled_order.order]
    if pooled_order.status == "absent":
        return f"no {damping_name}"
    if pooled_order.status == "compatible" and pooled_order.interval is None:
        return f"{damping_name} compatible with order 1 ({pooled_order.order} was not fitted)"
    value_text = _value_and_half_width(pooled_order)
    if value_text is None:
        return f"{damping_name} of an order that is not established"
    assert pooled_order.value is not None
    order_text = f"{pooled_order.order} = {value_text}"
    if pooled_order.status == "compatible":
        return f"{damping_name} compatible with order 1 ({order_text})"
    if pooled_order.status == "open":
        return f"{damping_name} of an order near 1 ({order_text}; 1 is doubtful, but not excluded)"
    if abs(pooled_order.value - 1) < _NEARLY_INTEGER_DISTANCE:
        return f"{damping_name} of nearly integer order ({order_text}; 1 is excluded)"
    return f"{damping_name} of fractional order ({order_text})"


def _value_and_half_width(pooled_order: PooledOrder) -> str | None:
    """Return "value ± half width of the interval" of an order, or None if the order is doubtful."""
    value, interval = pooled_order.value, pooled_order.interval
    if value is None or interval is None or pooled_order.reason is not None:
        return None
    half_width = (interval[1] - interval[0]) / 2
    return " ± ".join(rounded_to_uncertainty((value, half_width), pooled_order.std or half_width))


def _loss_slope_clause(pooled_order: PooledOrder) -> str:
    """Describe how fast one loss grows with frequency, as a clause of a sentence."""
    loss_name = LOSS_NAMES[pooled_order.order]
    loss_slope_text = _value_and_half_width(pooled_order)
    if loss_slope_text is None:
        return f"{loss_name} with a slope that is not established"
    conclusion = {
        "compatible": "consistent with order 1",
        "fractional": "which excludes order 1",
        "open": "which alone does not exclude order 1",
    }
    return f"{loss_name} growing as f^({loss_slope_text}), {conclusion[pooled_order.status]}"


def describe_structure(freest_fit: PooledEstimate, lowest_bic_estimate: PooledEstimate) -> str:
    """Describe the damping structure of the reported parameters, and a simpler one.

    Parameters
    ----------
    freest_fit : PooledEstimate
        Estimate whose parameters are reported.
    lowest_bic_estimate : PooledEstimate
        Estimate of the lowest BIC.
    """
    fixed_orders = [
        order_name
        for order_name in _ORDER_NAMES
        if STRUCTURES[freest_fit.structure].fixed.get(order_name) == 1.0
    ]
    order_verb = "is" if len(fixed_orders) == 1 else "are"
    consequence = (
        f"; it assumes that {' and '.join(fixed_orders)} {order_verb} 1."
        if fixed_orders
        else ", so its intervals hold for any simpler one, too."
    )
    structure_sentence = (
        f"The numbers are those of type {freest_fit.name}: "
        f"{_describe_damping(freest_fit.structure)}. "
        f"It is the freest structure that the sessions determine{consequence}"
    )
    if lowest_bic_estimate.name != freest_fit.name:
        structure_sentence += (
            f" Type {lowest_bic_estimate.name} has the lowest BIC "
            f"({_describe_damping(lowest_bic_estimate.structure)}); "
            "its intervals are narrower, and valid only if it is true."
        )
    return structure_sentence


def describe_loss_factors(loss_factors: Sequence[ReportedLossFactor]) -> list[str]:
    """Describe each loss factor at the frequency where it depends least on the order."""
    loss_factor_texts = []
    for loss_factor in loss_factors:
        if loss_factor.omega_rad_s is None or not (
            loss_factor.size.std and loss_factor.size.interval_95
        ):
            continue
        value_text, low_text, high_text = rounded_to_uncertainty(
            (loss_factor.size.value, *loss_factor.size.interval_95), loss_factor.size.std
        )
        remark = f", {loss_factor.size.flag}" if loss_factor.size.flag else ""
        loss_factor_texts.append(
            f"{loss_factor.damping} {value_text} (95 %: {low_text} to {high_text}) at "
            f"{loss_factor.omega_rad_s / (2 * np.pi):.3g} Hz{remark}"
        )
    return (
        [f"Loss factors at the pivot frequencies: {'; '.join(loss_factor_texts)}."]
        if loss_factor_texts
        else []
    )


def describe_selection(
    ranked_estimates: Sequence[PooledEstimate],
    rival_estimates: Sequence[PooledEstimate],
    selections_by_structure: Mapping[str, int],
    session_count: int,
) -> str:
    """Describe which damping structure all sessions together, and single sessions, select.

    Parameters
    ----------
    ranked_estimates : sequence of PooledEstimate
        Estimates of all structures, the lowest BIC first.
    rival_estimates : sequence of PooledEstimate
        Estimates whose BIC is not distinguishable from the lowest.
    selections_by_structure : mapping of str to int
        Number of sessions that select each structure by themselves.
    session_count : int
        Number of sessions.
    """
    lowest_bic_estimate = ranked_estimates[0]
    bic_sentence = f"Lowest BIC: type {lowest_bic_estimate.name}."
    if rival_estimates:
        rival_names = " or ".join(f"type {rival.name}" for rival in rival_estimates)
        bic_sentence += (
            f" All sessions together do not distinguish it from {rival_names} (ΔBIC "
            f"{rival_estimates[0].bic - lowest_bic_estimate.bic:.1f}; 10 = decisive)."
        )
    elif len(ranked_estimates) > 1:
        bic_margin = ranked_estimates[1].bic - lowest_bic_estimate.bic
        bic_sentence += (
            f" Next: type {ranked_estimates[1].name}, ΔBIC {bic_margin:.3g} (10 = decisive)."
        )
    selection_counts = {
        f"type {structure_name}": selection_count
        for structure_name, selection_count in selections_by_structure.items()
    }
    return f"{bic_sentence} {describe_single_sessions(selection_counts, session_count)}"


def describe_residual(
    pooled_estimate: PooledEstimate, adequate_session_count: int, session_count: int
) -> str:
    """Describe whether the residual of a damping structure's fit is noise.

    Parameters
    ----------
    pooled_estimate : PooledEstimate
        Pooled estimate of the structure.
    adequate_session_count : int
        Number of sessions whose residual is noise.
    session_count : int
        Number of sessions.
    """
    if pooled_estimate.misfit > MAX_REFERENCE_MISFIT:
        return (
            f"Its residual is {pooled_estimate.misfit:.3g} times the noise: no structure fitted "
            "describes the beam, and standard deviations are meaningless."
        )
    return describe_noise_sessions(adequate_session_count, session_count)


def describe_noise_sessions(adequate_session_count: int, session_count: int) -> str:
    """State in how many sessions the residual of the fit is noise.

    Parameters
    ----------
    adequate_session_count : int
        Number of sessions whose residual is noise.
    session_count : int
        Number of sessions.
    """
    if adequate_session_count == session_count:
        return "The residual is noise in every session: the model suffices for these records."
    return (
        f"The residual is noise in {adequate_session_count} of {session_count} sessions; in the "
        "others something is unexplained."
    )


def describe_modes(
    pooled_modes: Sequence[PooledMode], session_count: int, *, is_mixture: bool
) -> list[str]:
    """Describe frequency and damping ratio of each mode.

    Parameters
    ----------
    pooled_modes : sequence of PooledMode
        Modes pooled over the sessions.
    session_count : int
        Number of sessions.
    is_mixture : bool
        Whether the sessions are of several specimens.
    """
    if not pooled_modes:
        return []
    t = student_t_quantile(0.95, session_count - 1)
    mode_clauses = "; ".join(_mode_clause(mode, t) for mode in pooled_modes)
    sessions_text = "the sessions, a mixture" if is_mixture else "the sessions"
    return [f"Modes: {mode_clauses} (± 95 % of the mean over {sessions_text})."]


def describe_order(pooled_order: PooledOrder) -> str:
    """Describe the pooled estimate of one order of the damping."""
    order_name, damping_name = pooled_order.order, _DAMPING_NAME_BY_ORDER[pooled_order.order]
    status_counts = {
        f"“{status}”": session_count for status, session_count in pooled_order.alone.items()
    }
    sessions_text = f" {describe_single_sessions(status_counts, sum(status_counts.values()))}"
    if pooled_order.status == "absent":
        return (
            f"No {damping_name} was found, so its order {order_name} has no meaning.{sessions_text}"
        )
    if pooled_order.status == "compatible" and pooled_order.interval is None:
        return (
            f"The order {order_name} of the {damping_name} is fixed at 1, with which it is "
            f"compatible.{sessions_text}"
        )
    if pooled_order.value is None or pooled_order.interval is None:
        return (
            f"The order {order_name} of the {damping_name} is not identifiable: "
            f"{pooled_order.reason}.{sessions_text}"
        )
    half_width = (pooled_order.interval[1] - pooled_order.interval[0]) / 2
    value_text, low_text, high_text = rounded_to_uncertainty(
        (pooled_order.value, *pooled_order.interval), pooled_order.std or half_width
    )
    order_statement = (
        f"The order {order_name} of the {damping_name} is {value_text} "
        f"(95 %: {low_text} to {high_text}, between-session variance included)"
    )
    if pooled_order.reason is not None:
        conditional_text = order_statement.replace(" is ", " would be ", 1)
        return f"{conditional_text}, but {pooled_order.reason}; do not interpret it.{sessions_text}"
    conclusion = {
        "compatible": "consistent with 1",
        "fractional": "1 is excluded",
        "open": "1 is doubtful, but not excluded",
    }
    return f"{order_statement}: {conclusion[pooled_order.status]}.{sessions_text}"


def describe_welch_bias(
    freest_fit: PooledEstimate,
    biases: Sequence[WelchBias],
    withheld_orders: Collection[str],
    *,
    has_reference: bool,
) -> list[str]:
    """Describe the bias of the Welch fits of the reported damping structure.

    Parameters
    ----------
    freest_fit : PooledEstimate
        Estimate of the reported structure.
    biases : sequence of WelchBias
        Biases of the Welch fits of all structures and weightings.
    withheld_orders : collection of str
        Orders that are not reported; their coefficients are not reported either.
    has_reference : bool
        Whether the sessions are of one specimen whose modes a uniform beam predicts. If not, there
        is no reference for the Welch fits.
    """
    if not has_reference:
        return []
    type_biases = [bias for bias in biases if bias.structure == freest_fit.name]
    best_model_biases = [
        bias for bias in type_biases if (bias.structure, bias.weighting) in PAPER_BEST_MODELS
    ]
    omitted_parameters = {*withheld_orders, *(COEFFICIENT_OF[order] for order in withheld_orders)}
    sentences = []
    for bias in best_model_biases or type_biases[:1]:
        significant_parameters = [
            parameter_bias
            for parameter_bias in bias.significant_parameters
            if parameter_bias.parameter not in omitted_parameters
        ]
        if not significant_parameters:
            continue
        sentences.append(
            f"Welch's {'; '.join(map(_bias_clause, significant_parameters))} (type "
            f"{bias.structure}, weights "
            f"{bias.weighting}, as in Table 3): bias, not scatter, which more sessions do not "
            "reduce."
        )
        if bias.wmse < bias.record_wmse:
            sentences.append(
                f"The lower WMSE of the Welch fits ({bias.wmse:.3g} against "
                f"{bias.record_wmse:.3g} (N·m/rad)²) is no evidence for them: it is the distance "
                "from Welch's response, which has the same bias."
            )
    return sentences


def _bias_clause(parameter_bias: ParameterBias) -> str:
    """Describe the value of one parameter of a Welch fit and its bias."""
    symbol, display_factor, display_unit = label_and_unit(parameter_bias.parameter)
    value_text, scatter_text = rounded_to_uncertainty(
        (parameter_bias.welch_mean, parameter_bias.welch_std),
        parameter_bias.welch_std,
        display_factor,
    )
    (record_text,) = rounded_to_uncertainty(
        (parameter_bias.record_estimate,), parameter_bias.record_std, display_factor
    )
    (bias_text,) = rounded_to_uncertainty(
        (abs(parameter_bias.bias),), parameter_bias.bias_std, display_factor
    )
    shown_name = parameter_bias.parameter if parameter_bias.parameter in _ORDER_NAMES else symbol
    unit_text = f"·{display_unit}" if display_unit else ""
    bounds_remark = (
        f", at the edge of the search range in {parameter_bias.at_bounds}"
        if parameter_bias.at_bounds
        else ""
    )
    return (
        f"{shown_name} ({value_text} ± {scatter_text}{unit_text} between sessions{bounds_remark}) "
        f"is {bias_text}{unit_text} "
        f"{'above' if parameter_bias.bias > 0 else 'below'} the whole records' "
        f"{record_text}{unit_text}"
    )


def describe_dissent(
    dissenting_sessions: Sequence[tuple[str, str]], lowest_bic_estimate: PooledEstimate
) -> list[str]:
    """List the sessions that alone exclude the damping structure selected by all together.

    Parameters
    ----------
    dissenting_sessions : sequence of tuple
        File of each such session, and the structure that it selects.
    lowest_bic_estimate : PooledEstimate
        Estimate of the structure that all sessions select together.
    """
    if not dissenting_sessions:
        return []
    session_texts = [
        f"{file_name} (type {structure})" for file_name, structure in dissenting_sessions
    ]
    return [
        f"Type {lowest_bic_estimate.name} is excluded by {len(dissenting_sessions)} single "
        f"session{'s' if len(dissenting_sessions) > 1 else ''}: {join_first_texts(session_texts)}. "
        "Check their reports (analyze --each) before relying on the mean."
    ]


def describe_scatter(homogeneity: Homogeneity) -> list[str]:
    """Describe whether any quantity varies significantly between the sessions.

    The level of the test gives one false alarm in a hundred campaigns. The list is empty if nothing
    could be compared, or if the only variance is a change with time.
    """
    if not homogeneity.quantities:
        return []
    varying_labels = [
        label_and_unit(scatter.quantity)[0]
        for scatter in homogeneity.quantities
        if scatter.p_value < homogeneity.significance_level
    ]
    if not varying_labels:
        if any(scatter.has_significant_trend for scatter in homogeneity.quantities):
            return []  # a straight line is a more sensitive test of the same variance
        lowest_p_value = min(scatter.p_value for scatter in homogeneity.quantities)
        tau_remark = (
            "; the τ above zero are within chance"
            if any(scatter.between_session_std > 0 for scatter in homogeneity.quantities)
            else ""
        )
        return [
            "No significant between-session variance (Cochran's Q, lowest p of "
            f"{len(homogeneity.quantities)}: {format_p_value(lowest_p_value)}{tau_remark})."
        ]
    return [
        f"Between-session variance in {', '.join(varying_labels)} (Cochran's Q): something changes "
        "between sessions, such as clamp, temperature or motor, and the interval of a single "
        "session is too narrow for the specimen."
    ]


def describe_prediction_errors(
    pooled_estimate: PooledEstimate, validation: Sequence[LeaveOneOutResult], session_count: int
) -> list[str]:
    """Describe how well a damping structure predicts a session from the other sessions.

    Parameters
    ----------
    pooled_estimate : PooledEstimate
        Estimate of the structure.
    validation : sequence of LeaveOneOutResult
        Errors of sessions predicted from the others.
    session_count : int
        Number of sessions.
    """
    structure_errors = [
        left_out
        for left_out in validation
        if left_out.method == "record" and left_out.name == pooled_estimate.name
    ]
    own_errors = [
        left_out.own_error for left_out in structure_errors if left_out.own_error is not None
    ]
    if not own_errors:
        return []
    mean_error, mean_own_error = (
        float(np.mean([left_out.error for left_out in structure_errors])),
        float(np.mean(own_errors)),
    )
    comparison_text = (
        "the others predict a session as well as its own fit"
        if mean_error <= _MAX_EQUAL_ERROR_RATIO * mean_own_error
        else "the others predict a session worse than its own fit, because the parameters vary"
    )
    sessions_remark = (
        f"; mean of {len(own_errors)} of {session_count} sessions"
        if len(own_errors) < session_count
        else ""
    )
    return [
        f"Leave-one-out error of the torque {100 * mean_error:.2f} % rms (in-sample "
        f"{100 * mean_own_error:.2f} %, noise included{sessions_remark}): {comparison_text}."
    ]


def describe_failed_predictions(
    failed_predictions: Sequence[FailedPrediction], requested_session_count: int
) -> list[str]:
    """List the sessions that could not be predicted from the others, with the reasons.

    Parameters
    ----------
    failed_predictions : sequence of FailedPrediction
        Sessions that were not predicted.
    requested_session_count : int
        Number of sessions that were to be predicted.
    """
    if not failed_predictions:
        return []
    reason_texts = [
        f"{failed_prediction.source.name}: {failed_prediction.reason}"
        for failed_prediction in failed_predictions
    ]
    return [
        f"Of {requested_session_count} sessions to be predicted from the others, "
        f"{requested_session_count - len(failed_predictions)} "
        f"{'was' if requested_session_count - len(failed_predictions) == 1 else 'were'} and "
        f"{len(failed_predictions)} "
        f"{'was' if len(failed_predictions) == 1 else 'were'} not "
        f"({join_first_texts(reason_texts, '; ')}). "
        "Prediction errors are averaged over those predicted."
    ]


def describe_single_sessions(conclusion_counts: Mapping[str, int], session_count: int) -> str:
    """State how many sessions by themselves reach each conclusion.

    Parameters
    ----------
    conclusion_counts : mapping of str to int
        Number of sessions by their conclusion, the most common first.
    session_count : int
        Number of sessions.
    """
    (first_conclusion, first_count), *other_conclusions = conclusion_counts.items()
    other_conclusions_text = "".join(
        f", {conclusion} in {n}" for conclusion, n in other_conclusions
    )
    return (
        f"Single sessions: {first_conclusion} in {first_count} of {session_count}"
        f"{other_conclusions_text}."
    )


def _describe_damping(structure: str) -> str:
    """Describe the kinds of damping of a damping structure, and whether orders are free."""
    damping_structure = STRUCTURES[structure]
    damping_texts = [
        f"{damping_name} damping ({order} {'free' if order in damping_structure.free else '= 1'})"
        for damping_name, order, is_present in (
            ("internal", "alpha", damping_structure.has_internal_damping),
            ("external", "lambda", damping_structure.has_external_damping),
        )
        if is_present
    ]
    return " and ".join(damping_texts)


def _mode_clause(mode: PooledMode, t_quantile: float) -> str:
    """Describe the frequency and the damping ratio of one mode."""
    half_width = t_quantile * 100 * mode.damping_ratio_std
    decimal_digits = decimals(max(half_width, 1e-9))
    return (
        f"{mode.frequency_hz:.5g} Hz with a damping ratio of "
        f"{100 * mode.damping_ratio:.{decimal_digits}f} ± {half_width:.{decimal_digits}f} %"
    )
