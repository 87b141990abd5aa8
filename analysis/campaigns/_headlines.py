"""Headline results of a campaign as JSON: of each session, then of all sessions together."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from analysis.campaigns._orders import MIN_ADEQUATE_FRACTION, UNEXPLAINED_RECORDS_REASON
from analysis.identify import headline_json
from analysis.identify.headline import ConditionalEstimate, Estimates, ReportedLossFactor
from analysis.identify.modal_headline import replace_by_modal_model, uniform_beam_refusal_reason
from analysis.models import STRUCTURES
from analysis.statistics import BIC_DECISIVE, student_t_quantile
from rigd.beam import COEFFICIENT_OF, DAMPING_PARAMETERS
from rigd.estimates import Estimate, ReportedMode

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.campaigns._campaign import CampaignResult
    from analysis.campaigns._orders import PooledOrder
    from analysis.campaigns._statistics import RankedStructure
    from analysis.campaigns._verdict import CampaignVerdict
    from analysis.campaigns.pooling import PooledEstimate
    from analysis.identify.headline import StructureStatus

_MIXTURE_FLAG: Final = "the mean of a mixture: sessions differ significantly"
"""Flag of a quantity that differs significantly between sessions."""
_ON_BOUND_FLAG: Final = "the unweighted mean: at its bound in at least one session"
"""Flag of a parameter that is at a bound in at least one session."""
_NOT_SHOWN_FLAG: Final = "computed from the model: too few records show this mode"
"""Flag of a mode that too few records show."""


def headlines(campaign: CampaignResult) -> list[dict[str, Any]]:
    """Collect the reported estimates of each session and of all sessions together, as JSON.

    Parameters
    ----------
    campaign : CampaignResult
        The analysed campaign.

    Returns
    -------
    list of dict
        Headlines as for single files. The last one, with ``file`` null, is that of all sessions
        together. Without whole-record fits the list is empty.
    """
    headline_documents = [
        dict(session.headline) for session in campaign.sessions if session.headline
    ]
    common_estimates, verdict = campaign_estimates(campaign), campaign.verdict
    if common_estimates is not None and verdict is not None:
        pooled_orders = (verdict.alpha, verdict.lambda_)
        shown_findings = (
            replace(finding.example, sentence=finding.sentence, interval=None)
            for finding in verdict.findings
        )
        headline_documents.append(
            headline_json(None, common_estimates, pooled_orders, shown_findings, campaign.validity)
        )
    return headline_documents


def campaign_estimates(campaign: CampaignResult) -> Estimates | None:
    """Collect the estimates from all sessions together, with flags on doubtful ones.

    Parameters
    ----------
    campaign : CampaignResult
        The analysed campaign.

    Returns
    -------
    Estimates or None
        The estimates; None without whole-record fits.
    """
    pooled_estimate, verdict, modal_model = campaign.freest, campaign.verdict, campaign.modal
    if pooled_estimate is None or verdict is None:
        return None
    pooled_orders = (verdict.alpha, verdict.lambda_)
    exact_orders, flag_of_all_values = _exact_orders(verdict), _flag_of_all_values(verdict)
    exact_estimates = Estimates(
        name=pooled_estimate.name,
        parameters=_reported_parameters(
            campaign, pooled_estimate, exact_orders, flag_of_all_values
        ),
        sizes=_reported_loss_factors(pooled_estimate, exact_orders, flag_of_all_values),
        modes=_reported_modes(campaign, pooled_estimate, flag_of_all_values),
        structures=tuple(
            (structure.name, _structure_status(structure, pooled_estimate))
            for structure in campaign.structures
        ),
        simpler=_lowest_bic_conditional_estimate(campaign, pooled_estimate),
        drag_speed_m_s=None,
    )
    if modal_model is None:
        return exact_estimates
    reported_estimates = replace_by_modal_model(
        exact_estimates,
        modal_model,
        modal_model.uniform_beam,
        modal_model.tolerant,
        flag_of_all_values,
        flag_of_all_values,
        half_width=modal_model.half_width_in_stds,
    )
    return _add_flags(reported_estimates, campaign, pooled_orders)


def pooled_flags(campaign: CampaignResult, pooled_estimate: PooledEstimate) -> dict[str, str]:
    """Return the flags of a pooled estimate for an exactly uniform beam, by parameter name.

    Parameters
    ----------
    campaign : CampaignResult
        The analysed campaign.
    pooled_estimate : PooledEstimate
        One of its pooled estimates.
    """
    verdict, modal_model = campaign.verdict, campaign.modal
    if verdict is None:
        return {}
    refusal_reason = uniform_beam_refusal_reason(modal_model.uniform_beam) if modal_model else None
    reported_parameters = _reported_parameters(
        campaign, pooled_estimate, _exact_orders(verdict), _flag_of_all_values(verdict)
    )
    return {
        parameter_name: flag
        for parameter_name, parameter in reported_parameters.items()
        if (flag := parameter.flag or refusal_reason) is not None
    }


def _exact_orders(verdict: CampaignVerdict) -> tuple[PooledOrder, ...]:
    """Return the orders of the damping for an exactly uniform beam."""
    return tuple(order.exact or order for order in (verdict.alpha, verdict.lambda_))


def _flag_of_all_values(verdict: CampaignVerdict) -> str | None:
    """Return the flag of all estimates, or None if the residual of enough sessions is noise."""
    are_records_explained = verdict.adequate >= MIN_ADEQUATE_FRACTION * verdict.sessions
    return None if are_records_explained else UNEXPLAINED_RECORDS_REASON


def _add_flags(
    estimates: Estimates, campaign: CampaignResult, orders: tuple[PooledOrder, ...]
) -> Estimates:
    """Flag quantities that differ between sessions, doubtful orders, and modes not shown."""
    order_flags, is_mixed = _order_flags(orders), campaign.homogeneity.is_mixed

    def mixture_flag(quantity: str) -> str | None:
        """Return the flag of a quantity that differs between sessions, or None."""
        return _MIXTURE_FLAG if is_mixed(quantity) else None

    return replace(
        estimates,
        parameters={
            parameter_name: parameter.with_flag(
                mixture_flag(parameter_name) or order_flags.get(parameter_name)
            )
            for parameter_name, parameter in estimates.parameters.items()
        },
        modes=tuple(
            replace(
                mode,
                frequency_hz=mode.frequency_hz.with_flag(
                    mixture_flag(f"frequency_hz_{mode.number}") if mode.shown else _NOT_SHOWN_FLAG
                ),
                damping_ratio=mode.damping_ratio.with_flag(
                    mixture_flag(f"damping_ratio_{mode.number}") if mode.shown else _NOT_SHOWN_FLAG
                ),
            )
            for mode in estimates.modes
        ),
    )


def _lowest_bic_conditional_estimate(
    campaign: CampaignResult, reported_estimate: PooledEstimate
) -> ConditionalEstimate | None:
    """Return the estimate of the lowest BIC, which is valid if the orders that it fixes are true.

    Return None if that estimate is the reported one.
    """
    lowest_bic_estimate = campaign.pooled[0]
    if lowest_bic_estimate is reported_estimate:
        return None
    fixed_orders = STRUCTURES[lowest_bic_estimate.structure].fixed
    return ConditionalEstimate(
        name=lowest_bic_estimate.name,
        fixed={
            order_name: order_value
            for order_name, order_value in fixed_orders.items()
            if order_name in COEFFICIENT_OF
        },
        parameters={
            parameter.name: Estimate(parameter.value, parameter.std, parameter.interval)
            for parameter in lowest_bic_estimate.parameters
        },
    )


def _reported_parameters(
    campaign: CampaignResult,
    pooled_estimate: PooledEstimate,
    orders: tuple[PooledOrder, ...],
    flag_of_all_values: str | None,
) -> dict[str, Estimate]:
    """Return the pooled parameters with their flags."""
    is_mixed = campaign.homogeneity.is_mixed
    order_flags = _order_flags(orders)
    reported_parameters = {
        parameter.name: Estimate(
            parameter.value,
            parameter.std,
            parameter.interval,
            flag_of_all_values
            or (_MIXTURE_FLAG if is_mixed(parameter.name) else order_flags.get(parameter.name)),
        )
        for parameter in pooled_estimate.parameters
    }
    free_parameter_names = STRUCTURES[pooled_estimate.structure].free
    for parameter_name, fixed_value in pooled_estimate.plant.parameters.items():
        if parameter_name not in reported_parameters and (
            parameter_name not in DAMPING_PARAMETERS or parameter_name in free_parameter_names
        ):
            reported_parameters[parameter_name] = Estimate(
                fixed_value, None, None, flag_of_all_values or _ON_BOUND_FLAG
            )
    return reported_parameters


def _order_flags(orders: tuple[PooledOrder, ...]) -> Mapping[str, str]:
    """Return a flag for each doubtful order and for its coefficient, by the parameter name."""
    return {
        order_name: order.reason
        for order in orders
        if order.reason is not None
        for order_name in (order.order, COEFFICIENT_OF[order.order])
    }


def _reported_loss_factors(
    pooled_estimate: PooledEstimate, orders: tuple[PooledOrder, ...], flag_of_all_values: str | None
) -> tuple[ReportedLossFactor, ...]:
    """Return the loss factors with their flags."""
    order_flags = _order_flags(orders)
    return tuple(
        loss_factor.with_flag(flag_of_all_values or order_flags.get(loss_factor.order))
        for loss_factor in pooled_estimate.sizes
    )


def _reported_modes(
    campaign: CampaignResult, pooled_estimate: PooledEstimate, flag_of_all_values: str | None
) -> tuple[ReportedMode, ...]:
    """Return frequency and damping ratio of each pooled mode, with their flags."""
    t, is_mixed = (
        student_t_quantile(0.95, pooled_estimate.sessions - 1),
        campaign.homogeneity.is_mixed,
    )

    def reported_value(value: float, std: float, quantity: str) -> Estimate:
        """Return a quantity of a mode with its interval and flag."""
        value_flag = flag_of_all_values or (_MIXTURE_FLAG if is_mixed(quantity) else None)
        return Estimate(value, std, (value - t * std, value + t * std), value_flag)

    return tuple(
        ReportedMode(
            mode.number,
            reported_value(mode.frequency_hz, mode.frequency_std_hz, f"frequency_hz_{mode.number}"),
            reported_value(
                mode.damping_ratio, mode.damping_ratio_std, f"damping_ratio_{mode.number}"
            ),
            shown=True,
            source="beam",
        )
        for mode in pooled_estimate.modes
    )


def _structure_status(
    structure: RankedStructure, selected_estimate: PooledEstimate
) -> StructureStatus:
    """Return whether a damping structure is selected, compatible with the data, or excluded."""
    if structure.name == selected_estimate.name:
        return "selected"
    bic_difference = structure.bic_above_lowest
    return (
        "compatible" if bic_difference is not None and bic_difference < BIC_DECISIVE else "excluded"
    )
