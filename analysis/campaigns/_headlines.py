"""Headline numbers of a campaign, for programs: of each session, then of all together."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from analysis.identify import headline_json, with_modal_model
from analysis.identify.headline import (
    ConditionalEstimate,
    Estimates,
    ReportedLossFactor,
    ReportedMode,
    ReportedValue,
)
from analysis.identify.verdict import BIC_DECISIVE
from analysis.models import COEFFICIENT_OF, PARAMETERS, STRUCTURES
from analysis.statistics import student_t_quantile

if TYPE_CHECKING:
    from collections.abc import Mapping

    from analysis.campaigns._campaign import CampaignResult
    from analysis.campaigns._orders import PooledOrder
    from analysis.campaigns._statistics import RankedStructure
    from analysis.campaigns.pooling import PooledEstimate
    from analysis.identify.headline import StructureStatus

_UNEXPLAINED: Final = "part of the records is unexplained"
_MIXTURE: Final = "the mean of a mixture: sessions differ significantly"
_ON_BOUND: Final = "the unweighted mean: at its bound in at least one session"
_NOT_SHOWN: Final = "computed from the model: too few records show this mode"
_ADEQUATE: Final = 0.9


def headlines(campaign: CampaignResult) -> list[dict[str, Any]]:
    """Collect the headlines of a campaign.

    Parameters
    ----------
    campaign : CampaignResult

    Returns
    -------
    list of dict
        As of single files; the last one, with ``file`` null, is of all sessions together. Without
        whole-record fits there are none.
    """
    found = [dict(each.headline) for each in campaign.sessions if each.headline]
    numbers, verdict = campaign_numbers(campaign), campaign.verdict
    if numbers is not None and verdict is not None:
        orders = (verdict.alpha, verdict.lambda_)
        named = (
            replace(each.example, sentence=each.sentence, interval=None)
            for each in verdict.findings
        )
        found.append(headline_json(None, numbers, orders, named, campaign.validity))
    return found


def campaign_numbers(campaign: CampaignResult) -> Estimates | None:
    """Collect the numbers of all sessions together, with flags.

    Parameters
    ----------
    campaign : CampaignResult

    Returns
    -------
    Numbers or None
        None without whole-record fits.
    """
    pooled, verdict, modal = campaign.headline, campaign.verdict, campaign.modal
    if pooled is None or verdict is None:
        return None
    orders = (verdict.alpha, verdict.lambda_)
    exactly = tuple(each.exact or each for each in orders)
    explained = verdict.adequate >= _ADEQUATE * verdict.sessions
    every = None if explained else _UNEXPLAINED
    exact = Estimates(
        name=pooled.name,
        parameters=_parameters(campaign, pooled, exactly, every),
        sizes=_sizes(pooled, exactly, every),
        modes=_modes(campaign, pooled, every),
        structures=tuple((each.name, _status(each, pooled)) for each in campaign.structures),
        simpler=_simpler(campaign, pooled),
        drag_speed_m_s=None,
    )
    if modal is None:
        return exact
    numbers = with_modal_model(
        exact, modal, modal.uniform_beam, modal.tolerant, every, every, half_width=modal.half_width
    )
    return _flagged(numbers, campaign, orders)


def _flagged(
    numbers: Estimates, campaign: CampaignResult, orders: tuple[PooledOrder, ...]
) -> Estimates:
    """Flag quantities that differ between sessions, doubtful orders, and hidden modes."""
    flags, mixed = _flags(orders), campaign.homogeneity.is_mixed

    def of_mixture(quantity: str) -> str | None:
        return _MIXTURE if mixed(quantity) else None

    return replace(
        numbers,
        parameters={
            name: each.flagged(of_mixture(name) or flags.get(name))
            for name, each in numbers.parameters.items()
        },
        modes=tuple(
            replace(
                each,
                frequency_hz=each.frequency_hz.flagged(
                    of_mixture(f"frequency_hz_{each.number}") if each.shown else _NOT_SHOWN
                ),
                damping_ratio=each.damping_ratio.flagged(
                    of_mixture(f"damping_ratio_{each.number}") if each.shown else _NOT_SHOWN
                ),
            )
            for each in numbers.modes
        ),
    )


def _simpler(campaign: CampaignResult, pooled: PooledEstimate) -> ConditionalEstimate | None:
    """Return the estimate of the lowest BIC, on condition that its orders are true."""
    conditional = campaign.pooled[0]
    if conditional is pooled:
        return None
    fixed = STRUCTURES[conditional.structure].fixed
    return ConditionalEstimate(
        name=conditional.name,
        fixed={name: value for name, value in fixed.items() if name in COEFFICIENT_OF},
        parameters={
            each.name: ReportedValue(each.value, each.std, each.interval)
            for each in conditional.parameters
        },
    )


def _parameters(
    campaign: CampaignResult,
    pooled: PooledEstimate,
    orders: tuple[PooledOrder, ...],
    every: str | None,
) -> dict[str, ReportedValue]:
    mixed = campaign.homogeneity.is_mixed
    flags = _flags(orders)
    found = {
        each.name: ReportedValue(
            each.value,
            each.std,
            each.interval,
            every or (_MIXTURE if mixed(each.name) else flags.get(each.name)),
        )
        for each in pooled.parameters
    }
    free = STRUCTURES[pooled.structure].free
    for name, value in pooled.plant.parameters.items():
        if name not in found and (name not in PARAMETERS or name in free):
            found[name] = ReportedValue(value, None, None, every or _ON_BOUND)
    return found


def _flags(orders: tuple[PooledOrder, ...]) -> Mapping[str, str]:
    """Return the reasons against each order, also for its coefficient."""
    return {
        name: each.reason
        for each in orders
        if each.reason is not None
        for name in (each.order, COEFFICIENT_OF[each.order])
    }


def _sizes(
    pooled: PooledEstimate, orders: tuple[PooledOrder, ...], every: str | None
) -> tuple[ReportedLossFactor, ...]:
    flags = _flags(orders)
    return tuple(each.flagged(every or flags.get(each.order)) for each in pooled.sizes)


def _modes(
    campaign: CampaignResult, pooled: PooledEstimate, every: str | None
) -> tuple[ReportedMode, ...]:
    t, mixed = student_t_quantile(0.95, pooled.sessions - 1), campaign.homogeneity.is_mixed

    def quantity_of(value: float, std: float, quantity: str) -> ReportedValue:
        flag = every or (_MIXTURE if mixed(quantity) else None)
        return ReportedValue(value, std, (value - t * std, value + t * std), flag)

    return tuple(
        ReportedMode(
            mode.number,
            quantity_of(mode.frequency_hz, mode.frequency_std_hz, f"frequency_hz_{mode.number}"),
            quantity_of(mode.damping_ratio, mode.damping_ratio_std, f"damping_ratio_{mode.number}"),
            shown=True,
        )
        for mode in pooled.modes
    )


def _status(each: RankedStructure, pooled: PooledEstimate) -> StructureStatus:
    if each.name == pooled.name:
        return "selected"
    above = each.bic_above_lowest
    return "compatible" if above is not None and above < BIC_DECISIVE else "excluded"
