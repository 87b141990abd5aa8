"""Profile likelihood of an order: how much worse everything else can make up for another value."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from analysis.selection.valleys import admitted, valleys
from analysis.selection.walk import Walk
from analysis.unknowns import ORDER_RANGE

if TYPE_CHECKING:
    from analysis.selection.candidate import Candidate
    from analysis.selection.candidates import Field
    from analysis.structures import Structure
    from analysis.whole_record import Plant

Order = Literal["alpha", "lambda"]

WIDEST_SHARE: Final = 0.25
"""Of the range 0 to 2: an order known to no better than ±0.25 tells no material from another."""


@dataclass(frozen=True, slots=True)
class Profile:
    """Deviance of an order's values, everything else fitted anew at each.

    Attributes
    ----------
    order : str
        "alpha" or "lambda".
    structure : str
        In which it was free.
    values : tuple of float
        Increasing.
    deviance : tuple of float
        Above the lowest.
    estimate : float
        Value of the lowest deviance.
    valleys : tuple of float
        Values that explain the record equally, the lowest deviance first: bottoms of valleys that
        the 95 % limit admits, parted by a ridge.
    interval : tuple of float
        95 %, by the likelihood ratio, over all valleys; where it is open it ends at the edge of the
        range.
    open_below, open_above : bool
        Whether the record excludes no value on that side.
    gain : float
        Deviance that the structure saves by freeing the order; 0 if it was free.
    """

    order: Order
    structure: str
    values: tuple[float, ...]
    deviance: tuple[float, ...]
    estimate: float
    valleys: tuple[float, ...]
    interval: tuple[float, float]
    open_below: bool
    open_above: bool
    gain: float

    @classmethod
    def unwalked(cls, candidate: Candidate, order: Order) -> Profile:
        """Stand for an order that nothing could tell: one value, and no limit to either side.

        Parameters
        ----------
        candidate : Candidate
        order : str
        """
        at = candidate.fit.parameters[order]
        return cls(order, candidate.name, (at,), (0.0,), at, (at,), ORDER_RANGE, True, True, 0.0)

    @property
    def walked(self) -> bool:
        """Whether any other value was looked at."""
        return len(self.values) > 1

    @property
    def share(self) -> float:
        """Part of the range that the interval spans."""
        return (self.interval[1] - self.interval[0]) / (ORDER_RANGE[1] - ORDER_RANGE[0])

    @property
    def identifiable(self) -> bool:
        """Whether the record says anything of use about this order."""
        narrow = self.share <= WIDEST_SHARE and not (self.open_below or self.open_above)
        return narrow and len(self.valleys) < 2

    @property
    def admits_one(self) -> bool:
        """Whether the integer order 1 lies in the interval."""
        return self.interval[0] <= 1 <= self.interval[1]


@dataclass(frozen=True, slots=True)
class Profiled:
    """A profile, and where its valleys are.

    Attributes
    ----------
    profile : Profile
    structure : Structure
        With the order free.
    uniform : bool
    plants : tuple of Plant
        At the bottoms of the valleys, the lowest first.
    cost : float
        The lowest sum of squares.
    """

    profile: Profile
    structure: Structure
    uniform: bool
    plants: tuple[Plant, ...]
    cost: float


def profile(field: Field, candidate: Candidate, order: Order) -> Profiled:
    """Walk away from the minimum both ways until the record excludes what lies beyond.

    Each refit starts on the tangent of the last, and each step goes to where the deviance, were it
    a parabola, would reach the next level. Where much of the range is admitted, the rest of it is
    looked over for another valley, which is then walked as well.

    Parameters
    ----------
    field : Field
    candidate : Candidate
        In whose structure the order is freed, if it is not free.
    order : str
    """
    walk = Walk(field, candidate, order)
    walk.both_ways()
    walk.elsewhere()
    values, deviance = walk.curve()
    bottoms = valleys(values, deviance)
    interval, open_below, open_above = admitted(values, deviance)
    lowest = min(walk.costs.values())
    return Profiled(
        profile=Profile(
            order=order,
            structure=candidate.name,
            values=tuple(values.tolist()),
            deviance=tuple(deviance.tolist()),
            estimate=bottoms[0],
            valleys=bottoms,
            interval=interval,
            open_below=open_below,
            open_above=open_above,
            gain=0.0
            if order in candidate.structure.free
            else candidate.values * math.log(max(candidate.fit.cost / lowest, 1.0)),
        ),
        structure=walk.structure,
        uniform=candidate.uniform,
        plants=tuple(walk.plant(value) for value in bottoms),
        cost=lowest,
    )
