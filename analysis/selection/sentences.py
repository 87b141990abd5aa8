"""The verdict in the operator's words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from analysis.selection.candidate import Candidate
    from analysis.selection.candidates import Field
    from analysis.selection.orders import OrderVerdict

_DAMPING: Final = {
    "I": "damping of the material only, proportional to the rate of strain",
    "II": "viscous damping by the surroundings only",
    "III": "viscous damping by material and surroundings, both of order 1",
    "IV": "damping of the material only, of fractional order",
    "V": "damping by the surroundings only, of fractional order",
    "VI": "damping by material and surroundings, both of fractional order",
    "VII": "damping of the material of order 1, and by the surroundings of fractional order",
}
_OF: Final = {"alpha": "internal damping (of the material)", "lambda": "external damping"}


def selected(
    field: Field,
    close: tuple[Candidate, ...],
    orders: tuple[OrderVerdict, ...],
    *,
    adequate: bool,
) -> list[str]:
    """Say what was selected, and what it cannot be told from."""
    best = field.best
    beam = "" if best.uniform else ", on a beam whose modes each have a stiffness of their own"
    said = [f"Type {best.structure.name}: {_DAMPING[best.structure.name]}{beam}."]
    loose = [o.order for o in orders if o.value is None and o.order in best.structure.free]
    if loose:
        said.append(
            f"It describes the record best, but its {' and '.join(loose)} must not be taken for a "
            "property of the beam."
        )
    if close:
        margin = min(c.bic for c in close) - best.bic
        said.append(
            f"The data cannot tell type {best.name} from "
            f"{' or '.join(f'type {c.name}' for c in close)} (BIC differs by {margin:.1f}; "
            "10 would be clear)."
        )
    else:
        others = [c for c in field.candidates[1:] if c.structure is not best.structure]
        if others:
            next_best = others[0]
            behind = next_best.bic - best.bic
            said.append(
                f"The next, type {next_best.name}, is worse by "
                f"{behind:.{0 if behind > 100 else 1}f} in BIC (10 would be clear)."
            )
    if adequate:
        said.append("What it leaves is noise: nothing in the record asks for more.")
    return said


def order(verdict: OrderVerdict, visible: tuple[int, ...], *, adequate: bool) -> str:
    """Say what is known of one order."""
    profile = verdict.profile
    low, high = profile.interval
    ends = f"95 %: {low:.3f} to {high:.3f}"
    name, of = verdict.order, _OF[verdict.order]
    if verdict.status == "absent":
        return f"No {of} shows, so its order {name} means nothing here."
    if verdict.status == "not identifiable" and len(profile.valleys) > 1:
        equal = " and ".join(f"{value:.3f}" for value in sorted(profile.valleys))
        return (
            f"The order {name} of the {of} is not identifiable: {equal} explain the record equally "
            f"well, each with a damping of its own ({ends}, with all that lies between)."
        )
    if verdict.status == "not identifiable":
        span = (
            "any value between 0 and 2 fits"
            if profile.open_below and profile.open_above
            else f"anything below {high:.2f} fits"
            if profile.open_below
            else f"anything above {low:.2f} fits"
            if profile.open_above
            else f"anything from {low:.2f} to {high:.2f} fits"
        )
        if len(visible) < 2 and name == "alpha":
            span = "one mode alone shows how much damping there is, not of which order" + (
                "" if profile.identifiable else f"; {span}"
            )
        return f"The order {name} of the {of} is not identifiable: {span}."
    if verdict.status == "integer":
        chance = "" if profile.admits_one else ", which differs from 1 by no more than chance may"
        return (
            f"The order {name} of the {of} is 1 as far as the data tell "
            f"({ends} if it is left free{chance})."
        )
    if verdict.status == "fractional":
        return f"The order {name} of the {of} is {profile.estimate:.3f} ({ends}); 1 is excluded."
    but = (
        "a structure of order 1 explains the record about as well"
        if adequate
        else "part of the record is unexplained"
    )
    return (
        f"The order {name} of the {of} stays open: {profile.estimate:.3f} would fit ({ends}), but "
        f"{but}. It is not reported."
    )
