"""What of a fit's numbers is reported, and what is there only because a fit gives a number."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

from analysis.models import COEFFICIENT_OF

if TYPE_CHECKING:
    from collections.abc import Collection

    from analysis.models import Structure
    from analysis.report.html.table import Number

MARK: Final = "†"

_SYMBOLS: Final = {"alpha": "α", "lambda": "λ"}


def unreported(structure: Structure, withheld: Collection[str]) -> frozenset[str]:
    """Parameters of a fit whose numbers say nothing of the antenna.

    Parameters
    ----------
    structure : Structure
        Of the fit.
    withheld : collection of str
        Orders that the data do not support, "alpha" or "lambda".

    Returns
    -------
    frozenset of str
        Each of these orders that the structure has, and its coefficient: that holds for this
        order only, as its very unit shows.
    """
    return frozenset(
        name for order in withheld for name in (order, COEFFICIENT_OF[order]) if structure.has(name)
    )


def marked(number: Number) -> Number:
    """Mark a number that is not reported; a dash needs no mark."""
    return greyed(number if number.value is None else replace(number, text=number.text + MARK))


def greyed(number: Number) -> Number:
    """Show a number in grey, such as what belongs to one that is marked."""
    return replace(number, doubtful=number.value is not None)


def footnotes(withheld: Collection[str]) -> tuple[str, ...]:
    """Say what the mark means, if it occurs."""
    if not withheld:
        return ()
    orders = " or ".join(_SYMBOLS[order] for order in sorted(withheld))
    return (
        f"{MARK} not reported: the data support no order {orders}. The number belongs to its "
        "curve, not to the antenna.",
    )
