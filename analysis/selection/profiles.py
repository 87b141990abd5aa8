"""Both orders' profiles, round the lowest minimum that any search has found."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from analysis.selection.profile import Profile, Profiled, profile

if TYPE_CHECKING:
    from analysis.selection.candidates import Field
    from analysis.selection.profile import Order

_ORDERS: Final[tuple[Order, Order]] = ("alpha", "lambda")
_ROUNDS: Final = 3
_MISSED: Final = 1e-5
"""Share of a sum of squares, which is some 1e4; BIC counts a parameter as 9."""


def profiled(field: Field) -> tuple[Field, Profile, Profile]:
    """Profile alpha and lambda in the freest structure on the best beam.

    What a walk finds lower than the candidates are, or in another valley, is where all of them
    start once more, so that the fit selected and the profile tell of one minimum.

    Parameters
    ----------
    field : Field

    Returns
    -------
    field : Field
        With the candidates ranked anew.
    alpha, lambda_ : Profile
    """
    for round_ in range(1, _ROUNDS + 1):
        freest = field.freest
        # The order of a damping that does not show could be anything: no walk would tell more.
        walks = {
            order: profile(field, freest, order) for order in _ORDERS if freest.structure.has(order)
        }
        before = [candidate.fit.cost for candidate in field.candidates]
        if round_ == _ROUNDS:
            break
        for found in walks.values():
            if _news(field, found):
                for plant in found.plants:
                    field = field.tried_from(plant, found.structure)
        if [candidate.fit.cost for candidate in field.candidates] == before:
            break
    of_alpha, of_lambda = (
        walks[order].profile if order in walks else Profile.unwalked(freest, order)
        for order in _ORDERS
    )
    return field, of_alpha, of_lambda


def _news(field: Field, found: Profiled) -> bool:
    """Whether a candidate may be elsewhere than its lowest minimum."""
    if len(found.plants) > 1:
        return True
    free = set(found.structure.free)
    as_free = [
        candidate.fit.cost
        for candidate in field.candidates
        if candidate.uniform == found.uniform and free <= set(candidate.structure.free)
    ]
    return bool(as_free) and found.cost < min(as_free) * (1 - _MISSED)
