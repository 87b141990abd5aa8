"""What a whole record says of the damping, and what a campaign says, in sentences."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from analysis.campaigns import lost_trials, specimens
from analysis.identify import MISREAD
from analysis.report._table import estimate

if TYPE_CHECKING:
    from analysis.campaigns import Campaign
    from analysis.identify import Headline, Mode, Quantity, Size

_SMALL: Final = 1e-3
"""Sizes below are told in the power of ten that zeta has in the paper."""

_SYMBOLS: Final = {
    "internal": ("ζ", "", "zeta", "alpha", "α"),
    "external": ("γ", " 1/m⁴", "gamma", "lambda", "λ"),
}


def damping_sentences(told: Headline) -> tuple[str, ...]:
    """Say how the modes are damped, and by which internal and external damping.

    Nothing is said of modes that the record does not show, nor of any where no number is the
    antenna's. Where part of the record is unexplained the numbers are named as what they would be,
    without intervals.

    Parameters
    ----------
    told : Headline

    Returns
    -------
    tuple of str
        95 % intervals in brackets.
    """
    found = []
    if any(mode.damping_ratio.flag == MISREAD for mode in told.modes):
        return ()
    shown = [_mode(mode) for mode in told.modes if mode.shown]
    if not told.explained:
        if not shown:
            return ()
        return (
            "Part of the record is unexplained. If that spoilt nothing, the antenna's damping "
            f"ratio would be {_listed(shown)}.",
        )
    if shown:
        found.append(
            f"The antenna's damping ratio is {_listed(shown)} (in brackets: 95 % intervals)."
        )
    found.extend(
        f"The {each.damping} damping {_size(each)}{_order(told, each)}."
        for each in told.sizes
        # A coefficient that holds for one assumed order says nothing of the antenna.
        if each.size.flag is None and (each.omega_rad_s is not None or not _flagged(told, each))
    )
    return tuple(found)


def _mode(mode: Mode) -> str:
    ratio = mode.damping_ratio
    return f"{_percent(ratio)} at {mode.frequency_hz.value:.4g} Hz"


def _percent(ratio: Quantity) -> str:
    value, low, high = estimate(
        (ratio.value, *(ratio.interval_95 or (None, None))), ratio.std, 100.0
    )
    if ratio.flag is not None:
        return f"{value.text} %"
    return f"{value.text} % ({low.text} to {high.text} %)"


def _size(each: Size) -> str:
    coefficient, unit, *_names = _SYMBOLS[each.damping]
    size = each.size
    factor, tenth = (1e5, " · 10⁻⁵") if size.value < _SMALL else (1.0, "")
    value, low, high = estimate((size.value, *(size.interval_95 or (None, None))), size.std, factor)
    bounds = f"{value.text} ({low.text} to {high.text}){tenth}"
    if each.omega_rad_s is None:
        return f"is {coefficient}\u00a0=\u00a0{bounds}{unit}"
    return f"has a loss factor of {bounds} at {each.omega_rad_s / (2 * math.pi):.3g} Hz"


def _flagged(told: Headline, each: Size) -> bool:
    """Whether coefficient and order of a damping carry a flag."""
    return told.parameters[_SYMBOLS[each.damping][2]].flag is not None


def _order(told: Headline, each: Size) -> str:
    *_others, name, symbol = _SYMBOLS[each.damping]
    order = told.parameters[name]
    if name not in told.fit.structure.free:
        return f", of the fixed order {symbol}\u00a0=\u00a0{order.value:g}"
    if order.interval_95 is None or order.flag is not None:
        return f"; its order {symbol} is not known"
    value, low, high = estimate((order.value, *order.interval_95), order.std)
    return f" and the order {symbol}\u00a0=\u00a0{value.text} ({low.text} to {high.text})"


def _listed(parts: list[str]) -> str:
    if len(parts) == 1:
        return parts[0]
    return f"{', '.join(parts[:-1])} and {parts[-1]}"


_NO_VERDICT: Final = (
    "No verdict on the whole records: it takes two sessions that determine a structure's damping."
)


def campaign_sentences(campaign: Campaign) -> tuple[str, ...]:
    """Return the verdict; without one, what it would have said first, and why there is none."""
    if campaign.verdict is not None:
        return campaign.verdict.sentences
    asked = any(each.record_estimates for each in campaign.sessions)
    return (
        *specimens(campaign.homogeneity),
        *([_NO_VERDICT] if asked else []),
        *lost_trials(campaign.lost_trials, campaign.trials),
    )
