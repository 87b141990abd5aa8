"""The verdict in the operator's words."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from analysis.selection.headline import ONE_MODE
from analysis.selection.orders import deviance_of_one

if TYPE_CHECKING:
    from analysis.selection.headline import Headline, Quantity, Simpler
    from analysis.selection.orders import OrderVerdict

_DAMPING: Final = {
    "I": "Damping by the material only",
    "II": "Damping by the surroundings only",
    "III": "Damping by material and surroundings",
    "IV": "Damping by the material only",
    "V": "Damping by the surroundings only",
    "VI": "Damping by material and surroundings",
    "VII": "Damping by material and surroundings",
}
_SEVERAL: Final = 2
_FREE: Final = "modes free"
_OF: Final = {"alpha": "internal damping (of the material)", "lambda": "external damping"}


def of_headline(
    told: Headline, orders: tuple[OrderVerdict, OrderVerdict], *, alone: bool
) -> list[str]:
    """Say what the beam does, what is excluded, and what would do.

    Parameters
    ----------
    told : Headline
    orders : tuple of OrderVerdict
        Alpha's and lambda's.
    alone : bool
        Whether nothing else explains the record as well.
    """
    free = told.fit.structure
    kind = told.name.partition(", ")[2]
    beam = ", on a beam whose modes each have a stiffness of their own" if kind == _FREE else ""
    if kind and not beam:
        beam = f", beside {kind}"
    if len(told.visible_modes) < _SEVERAL:
        said = [f"{ONE_MODE.capitalize()}, and nothing of orders."]
    else:
        said = [
            f"{_DAMPING[free.name]}{beam}: the numbers are those of type {told.name}, every order "
            "free."
        ]
        excluded = told.with_status("excluded")
        if told.explained and excluded:
            said.append(f"Excluded: {_types(excluded)}.")
        if told.simpler is not None and told.simpler.fixed:
            said.append(_condition(told.simpler))
    said += [order(each) for each in orders]
    if told.explained:
        said.append(
            "What it leaves is noise: nothing in the record asks for more."
            if alone
            else "What it leaves is noise, but something else explains the record as well."
        )
    return said


def _types(names: tuple[str, ...]) -> str:
    """List structures, those of a uniform beam first."""
    plain = sorted(name for name in names if "," not in name)
    others: dict[str, list[str]] = {}
    for name in sorted(set(names) - set(plain)):
        structure, beam = name.split(", ", 1)
        others.setdefault(beam, []).append(structure)
    groups = [_listed(plain)] if plain else []
    groups += [f"with {beam} {_listed(each)}" for beam, each in others.items()]
    return f"type{'s' if len(names) > 1 else ''} {'; '.join(groups)}"


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _condition(simpler: Simpler) -> str:
    """Say what a simpler structure would give."""
    taken = " and ".join(f"{name} = {value:g}" for name, value in simpler.fixed.items())
    numbers = [
        f"{name} = {_with_interval(simpler.parameters[name])}"
        for name in ("zeta", "alpha", "gamma", "lambda")
        if name in simpler.parameters
    ]
    they = "it is" if len(simpler.fixed) == 1 else "they are"
    return (
        f"{taken[0].upper()}{taken[1:]} {'is' if they == 'it is' else 'are'} not excluded (type "
        f"{simpler.name}); only if {they} true, {', '.join(numbers)}."
    )


def _with_interval(quantity: Quantity) -> str:
    """Write a number with its 95 % interval, to the digits that this gives a meaning."""
    if quantity.interval_95 is None or not quantity.std:
        return f"{quantity.value:.4g}"
    low, high = quantity.interval_95
    power = math.floor(math.log10(abs(quantity.value))) if quantity.value else 0
    scale = 10.0**power if power < -2 else 1.0
    digits = max(0, 1 - math.floor(math.log10(quantity.std / scale)))
    exponent = f"e{power}" if power < -2 else ""
    return (
        f"{quantity.value / scale:.{digits}f}{exponent} "
        f"({low / scale:.{digits}f}{exponent} to {high / scale:.{digits}f}{exponent})"
    )


def order(verdict: OrderVerdict) -> str:
    """Say what is known of one order.

    Parameters
    ----------
    verdict : OrderVerdict
    """
    profile = verdict.profile
    low, high = profile.interval
    name, of = verdict.order, _OF[verdict.order]
    value = f"{profile.estimate:.3f} (95 %: {low:.3f} to {high:.3f})"
    if verdict.status == "absent":
        return f"No {of} shows, so its order {name} means nothing here."
    if verdict.status == "not identifiable":
        return f"The order {name} of the {of} is not identifiable: {_why_not(verdict)}."
    if verdict.reason is not None:
        return (
            f"The order {name} of the {of} stays open: {value} would fit, but {verdict.reason}. It "
            "must not be taken for a property of the beam."
        )
    if verdict.status == "compatible":
        return f"The order {name} of the {of} is {value}: 1 would do."
    if verdict.status == "fractional":
        return f"The order {name} of the {of} is {value}; 1 is excluded."
    return (
        f"The order {name} of the {of} is {value}: 1 is doubtful, but not excluded (chance would "
        f"be as far off in one record of {_one_in(deviance_of_one(profile))})."
    )


def _why_not(verdict: OrderVerdict) -> str:
    profile = verdict.profile
    low, high = profile.interval
    if verdict.reason is not None and (profile.identifiable or not profile.walked):
        return verdict.reason
    if len(profile.valleys) > 1:
        equal = " and ".join(f"{value:.3f}" for value in sorted(profile.valleys))
        return (
            f"{equal} explain the record equally well, each with a damping of its own "
            f"(95 %: {low:.3f} to {high:.3f}, with all that lies between)"
        )
    return (
        "any value between 0 and 2 fits"
        if profile.open_below and profile.open_above
        else f"anything below {high:.2f} fits"
        if profile.open_below
        else f"anything above {low:.2f} fits"
        if profile.open_above
        else f"anything from {low:.2f} to {high:.2f} fits"
    )


def _one_in(deviance: float) -> int:
    """Of how many records chance gives one with such a deviance, of one degree of freedom."""
    return 10 * round(0.1 / math.erfc(math.sqrt(deviance / 2)))
