"""What a record says about the orders of the damping, and what it does not."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

if TYPE_CHECKING:
    from analysis.selection.candidate import Candidate
    from analysis.selection.candidates import Field
    from analysis.selection.profile import Order, Profile

Status = Literal["integer", "fractional", "not supported", "not identifiable", "absent"]

STRONG: Final = 10.0
"""Difference of BIC from which the worse structure may be dismissed (Kass and Raftery, J. American
Statistical Association 90 (1995) 773-795); below `EVEN` the data do not tell the two apart."""

EVEN: Final = 6.0
BARE: Final = 2.0
"""Difference of BIC "not worth more than a bare mention" (the same): none is preferred."""

_MODES_FOR_ALPHA: Final = 2


@dataclass(frozen=True, slots=True)
class OrderVerdict:
    """One order of the damping.

    Attributes
    ----------
    order : str
        "alpha" (internal damping, of the material) or "lambda" (external, of the surroundings).
    status : str
        "integer": 1 fits and no other value is called for; "fractional": the record excludes 1;
        "not supported": a fractional order fits, but something else does as well or something is
        unexplained; "not identifiable": it could be almost anything; "absent": such damping does
        not show, though the record would show it.
    value : float or None
        To be used further: 1, the estimate, or none.
    interval : tuple of float or None
        95 %, with the order free, where the order is identifiable.
    profile : Profile
    """

    order: Order
    status: Status
    value: float | None
    interval: tuple[float, float] | None
    profile: Profile


def order_verdict(
    field: Field, profile: Profile, visible: tuple[int, ...], *, adequate: bool
) -> OrderVerdict:
    """Judge one order.

    Parameters
    ----------
    field : Field
        With the candidates ranked.
    profile : Profile
        Of the order, in the structure selected.
    visible : tuple of int
        Modes that the record shows.
    adequate : bool
        Whether the selected structure leaves nothing but noise.
    """
    status = _status(field, profile, visible, adequate=adequate)
    value = {"integer": 1.0, "fractional": profile.estimate}.get(status)
    identifiable = status not in ("not identifiable", "absent")
    interval = profile.interval if identifiable else None
    return OrderVerdict(profile.order, status, value, interval, profile)


def _status(field: Field, profile: Profile, visible: tuple[int, ...], *, adequate: bool) -> Status:
    best, order = field.best, profile.order
    coefficient = "zeta" if order == "alpha" else "gamma"
    if coefficient not in best.fit.interval and len(visible) > 1:
        return "absent"
    # The loss at one frequency is all that one mode shows; what may narrow the order then is how
    # exactly the beam is uniform. The surroundings' damping shows below the first mode as well.
    if not profile.identifiable or (order == "alpha" and len(visible) < _MODES_FOR_ALPHA):
        return "not identifiable"
    if profile.admits_one:
        return "integer"
    if order not in best.fit.interval:
        freed = math.log(best.values) - profile.gain
        return "integer" if freed > BARE else "not supported"
    if not adequate or any(_integer(rival, order) for rival in rivals(field, STRONG)):
        return "not supported"
    return "fractional"


def _integer(candidate: Candidate, order: Order) -> bool:
    """Whether a structure has this damping with an order of 1."""
    return candidate.structure.fixed.get(order) == 1.0


def rivals(field: Field, within: float) -> tuple[Candidate, ...]:
    """Candidates whose BIC is less than so much above the lowest, without the best."""
    limit = field.best.bic + within
    return tuple(c for c in field.candidates[1:] if c.bic < limit)
