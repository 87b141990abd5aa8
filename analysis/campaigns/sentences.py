"""The verdict on a campaign in the operator's words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from analysis.campaigns.labels import label
from analysis.models import STRUCTURES

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from analysis.campaigns.pooled import PooledEstimate
    from analysis.campaigns.pooled_modes import PooledMode
    from analysis.campaigns.pooled_orders import PooledOrder
    from analysis.campaigns.validation import LeftOutError, LostTrial
    from analysis.identify import Order

_OF: Final = {"alpha": "internal damping (of the material)", "lambda": "external damping"}
_ORDERS: Final[tuple[Order, ...]] = ("alpha", "lambda")
_SIZES: Final = {"internal": "material", "external": "surroundings"}
_WRONG: Final = 1.5
"""Residual, in units of the noise, from which a structure is called wrong."""

_SIGNIFICANT: Final = 0.01
_NORMAL_95: Final = 1.959963984540054
_MANY: Final = 5
_AS_GOOD: Final = 1.01


def headline(freest: PooledEstimate, best: PooledEstimate) -> str:
    """Say of which structure the numbers are, and which simpler one would do.

    Parameters
    ----------
    freest : PooledEstimate
        On the beam that all sessions support.
    best : PooledEstimate
        Of the lowest BIC.
    """
    given = [name for name in _ORDERS if STRUCTURES[freest.structure].fixed.get(name) == 1.0]
    are = "is" if len(given) == 1 else "are"
    so = (
        f", and takes for granted that {' and '.join(given)} {are} 1."
        if given
        else ", so its intervals hold whichever simpler one is true."
    )
    said = (
        f"The numbers are those of type {freest.name}: damping {_damping(freest.structure)}"
        f"{_on_beam(freest)}. It is the freest structure that the sessions determine{so}"
    )
    if best.name != freest.name:
        said += (
            f" Of all together type {best.name} has the lowest BIC (damping "
            f"{_damping(best.structure)}{_on_beam(best)}); what it gives is narrower and holds on "
            "that condition only."
        )
    return said


def sizes(freest: PooledEstimate) -> list[str]:
    """Say how large each damping is where it depends least on its order."""
    said = []
    for each in freest.sizes:
        if each.omega_rad_s is None:
            continue
        low, high = each.interval
        said.append(
            f"{each.value:.4g} by the {_SIZES[each.damping]} (95 %: {low:.4g} to {high:.4g}) at "
            f"{each.omega_rad_s / (2 * np.pi):.3g} Hz"
        )
    return (
        [f"Loss factors where they depend least on the orders: {'; '.join(said)}."] if said else []
    )


def selected(
    ranked: Sequence[PooledEstimate],
    close: Sequence[PooledEstimate],
    alone: Mapping[str, int],
    sessions: int,
) -> str:
    """Say what all sessions together would select, what it cannot be told from, and who agrees."""
    best = ranked[0]
    said = f"Lowest BIC: type {best.name}."
    if close:
        names = " or ".join(f"type {each.name}" for each in close)
        said += (
            f" All sessions together cannot tell it from {names} (BIC differs by "
            f"{close[0].bic - best.bic:.1f}; 10 would be clear)."
        )
    elif len(ranked) > 1:
        margin = ranked[1].bic - best.bic
        said += f" The next, type {ranked[1].name}, is worse by {margin:.3g}."
    return f"{said} {_alone({f'type {name}': n for name, n in alone.items()}, sessions, 'select')}"


def _on_beam(estimate: PooledEstimate) -> str:
    modes = "" if estimate.uniform else ", on a beam whose modes each have a stiffness of their own"
    more = estimate.beam.removeprefix(", modes free").removeprefix(", ")
    return f"{modes}, with {more}" if more else modes


def _alone(counts: Mapping[str, int], sessions: int, do: str) -> str:
    """Say how many sessions select or say what when each is looked at by itself."""
    (first, count), *others = counts.items()
    verb = do if count > 1 else f"{do}s"
    more = "".join(f", {n} {what}" for what, n in others)
    return f"Alone, {count} of {sessions} sessions {verb} {first}{more}."


def _damping(structure: str) -> str:
    """Say which kinds of damping a structure has, and of which orders."""
    shape = STRUCTURES[structure]
    kinds = [
        f"by the {what} ({'order free' if order in shape.free else 'of order 1'})"
        for what, order, present in (
            ("material", "alpha", shape.internal),
            ("surroundings", "lambda", shape.external),
        )
        if present
    ]
    return " and ".join(kinds)


def left_over(best: PooledEstimate, adequate: int, sessions: int) -> str:
    """Say whether what the structure leaves is noise."""
    if best.misfit > _WRONG:
        return (
            f"What it leaves is {best.misfit:.3g} times the noise: no structure tried describes "
            "the beam, and standard deviations mean little."
        )
    if adequate == sessions:
        return "What it leaves is noise in every session: nothing in the records asks for more."
    return (
        f"What is left is noise in {adequate} of {sessions} sessions; in the others something is "
        "unexplained."
    )


def modes(best: PooledEstimate, *, mixed: bool) -> list[str]:
    """Say how the modes are damped; of a mixture, that it is one."""
    if not best.modes:
        return []
    said = "; ".join(map(_mode, best.modes))
    of = "the sessions, which are a mixture" if mixed else "the sessions"
    return [f"Modes: {said} (± 95 % of the mean over {of})."]


def _mode(mode: PooledMode) -> str:
    half = _NORMAL_95 * 100 * mode.damping_ratio_std
    digits = max(int(np.ceil(-np.log10(max(half, 1e-9)))) + 1, 0)
    return (
        f"{mode.frequency_hz:.5g} Hz with a damping ratio of "
        f"{100 * mode.damping_ratio:.{digits}f} ± {half:.{digits}f} %"
    )


def order(found: PooledOrder) -> str:
    """Say what is known of one order."""
    name, of = found.order, _OF[found.order]
    counts = {f"“{status}”": count for status, count in found.alone.items()}
    alone = " " + _alone(counts, sum(counts.values()), "say")
    if found.status == "absent":
        return f"No {of} shows, so its order {name} means nothing here.{alone}"
    if found.status == "compatible" and found.interval is None:
        return f"The order {name} of the {of} is taken to be 1, as it may be.{alone}"
    if found.value is None or found.interval is None:
        return f"The order {name} of the {of} is not identifiable: {found.reason}.{alone}"
    low, high = found.interval
    is_ = (
        f"The order {name} of the {of} is {found.value:.4f} "
        f"(95 %: {low:.4f} to {high:.4f}, scatter between sessions included)"
    )
    if found.reason is not None:
        would = is_.replace(" is ", " would be ", 1)
        return f"{would}, but {found.reason}; it is not reported.{alone}"
    said = {
        "compatible": "1 would do",
        "fractional": "1 is excluded",
        "open": "1 is doubtful, but not excluded",
    }
    return f"{is_}: {said[found.status]}.{alone}"


def dissenting(who: Sequence[tuple[str, str]], best: PooledEstimate) -> list[str]:
    """Name the sessions, with what they select, that by themselves dismiss it."""
    if not who:
        return []
    names = ", ".join(f"{file} (type {structure})" for file, structure in who[:_MANY])
    more = f" and {len(who) - _MANY} more" if len(who) > _MANY else ""
    return [
        f"Type {best.name} is dismissed by {len(who)} session{'s' if len(who) > 1 else ''} alone: "
        f"{names}{more}. Look at their reports (analyze --each) before you trust the mean."
    ]


def scatter(best: PooledEstimate) -> str:
    """Say whether the sessions repeat: one alarm in a hundred campaigns that do is false."""
    level = _SIGNIFICANT / max(len(best.parameters), 1)
    moved = [label(each.name)[0] for each in best.parameters if each.chance < level]
    if not moved:
        return (
            "Sessions differ by no more than their own uncertainties (p: probability of so much "
            "scatter by these alone); they repeat."
        )
    return (
        f"Sessions differ by more than their own uncertainties in {', '.join(moved)} (p: "
        "probability of so much scatter by these alone): something changes between sessions, "
        "such as clamp, temperature or motor, and the interval of one session alone is too "
        "narrow for the specimen."
    )


def foresight(best: PooledEstimate, validation: Sequence[LeftOutError], sessions: int) -> list[str]:
    """Say how well the sessions predict one that they have not seen."""
    of_best = [each for each in validation if each.method == "record" and each.name == best.name]
    own = [each.own_error for each in of_best if each.own_error is not None]
    if not own:
        return []
    error, alone = float(np.mean([each.error for each in of_best])), float(np.mean(own))
    verdict = (
        "as well as by a fit to itself"
        if error <= _AS_GOOD * alone
        else "worse than by a fit to itself: the parameters wander"
    )
    fewer = f"; mean of {len(own)} of {sessions} sessions" if len(own) < sessions else ""
    return [
        f"From the others, the torque of a session is predicted to {100 * error:.2f} % (its own "
        f"fit: {100 * alone:.2f} %, noise included{fewer}), {verdict}."
    ]


def lost_trials(lost: Sequence[LostTrial], asked: int) -> list[str]:
    """Account for the sessions that were to be predicted and were not."""
    if not lost:
        return []
    each = "; ".join(f"{trial.path.name}: {trial.reason}" for trial in lost[:_MANY])
    more = f"; and {len(lost) - _MANY} more" if len(lost) > _MANY else ""
    return [
        f"Of {asked} sessions to be predicted from the others, {asked - len(lost)} "
        f"{'was' if asked - len(lost) == 1 else 'were'} and {len(lost)} "
        f"{'was' if len(lost) == 1 else 'were'} not ({each}{more}). Errors of prediction are over "
        "those that were."
    ]
