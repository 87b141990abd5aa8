"""Steps through the unknowns that follow what a record shows.

Where damping is larger than the stiffness or inertia it adds to, loss and order make up for each
other: what shows is the phase theta of ``1 ± size exp(j order pi/2)``, and at constant theta they
trade over many powers of ten. A straight step leaves that valley at once, and a descent with
straight steps takes a hundred of them. So a step is taken along ``ln tan(theta/2)`` and the order
in place of ``ln loss`` and the order; where the damping is small the two are the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from analysis.whole_record.unknowns import Unknowns

_SHARE: Final = 0.5
"""Of the way to order 0 or 2, in one step."""

_NEXT_TO_NOTHING: Final = 1e-4
"""Loss that may vanish in one step."""

_LARGEST_GROWTH: Final = 50.0


@dataclass(frozen=True, slots=True)
class Steps:
    """Where steps from a vector of unknowns lead, and how far they may go.

    Attributes
    ----------
    lower, upper : ndarray, shape (k,)
        Bounds of the unknowns.
    dampings : tuple of (int, int, bool)
        Places of the loss and of the order of each damping whose order is free, and whether it adds
        to the stiffness; otherwise it takes from the inertia.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    dampings: tuple[tuple[int, int, bool], ...]
    straight: ClassVar[bool] = False

    @classmethod
    def of(cls, unknowns: Unknowns) -> Steps:
        """Find the dampings in a vector of unknowns."""
        names = unknowns.names
        dampings = tuple(
            (names.index(coefficient), names.index(order), coefficient == "zeta")
            for coefficient, order in (("zeta", "alpha"), ("gamma", "lambda"))
            if order in names
        )
        return cls(*unknowns.bounds, dampings)

    def limits(self, x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Least and largest step in each unknown, shape (k,).

        Orders approach 0 and 2 by a share of the way at a time: what damping does goes with the
        logarithm of that distance. Damping that has vanished keeps its order.
        """
        least, most = self.lower - x, self.upper - x
        for loss, order, _ in self.dampings:
            share = _SHARE if x[loss] > self.lower[loss] else 0.0
            least[order] = max(least[order], -share * x[order])
            most[order] = min(most[order], share * (2 - x[order]))
        return least, most

    def end(self, x: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Point within the bounds that a step leads to, shape (k,).

        Parameters
        ----------
        x : ndarray, shape (k,)
        step : ndarray, shape (k,)
            Within the `limits`; tangent to the way at `x`.
        """
        end = np.clip(x + step, self.lower, self.upper)
        for i, j, elastic in self.dampings:
            if step[i] != 0:
                before, after = _turn(x[j], elastic), _turn(end[j], elastic)
                most = math.exp(self.upper[i])
                loss, turn = _along(math.exp(x[i]), float(step[i]), before, after, most)
                end[i] = math.log(loss) if loss > 0 else self.lower[i]
                if turn != after:
                    end[j] = _order(turn, elastic)
        clipped: NDArray[np.float64] = np.clip(end, self.lower, self.upper)
        return clipped


def _along(
    loss: float, step: float, before: float, after: float, most: float
) -> tuple[float, float]:
    """Loss and turn to which a step of ``ln loss`` leads while the turn goes from before to after.

    The turn comes out otherwise where no loss up to `most` shows at `after` what is to show: then
    that largest loss is combined with the turn at which it does.
    """
    size = loss / math.sin(before)
    real = 1 + size * math.cos(before)
    # d ln tan(theta/2) = (d ln loss + size / sin(turn) d turn) / |1 + size exp(j turn)|
    along = (step + size / math.sin(before) * (after - before)) / math.hypot(real, loss)
    if along <= -1 and loss < _NEXT_TO_NOTHING:
        return 0.0, after  # in proportion to its effect it would change sign
    theta = math.atan2(loss, real)
    theta = 2 * math.atan(math.tan(theta / 2) * math.exp(min(along, _LARGEST_GROWTH)))
    if theta < after:
        loss = math.sin(theta) / math.sin(after - theta) * math.sin(after)
        if loss <= most:
            return loss, after
    return most, theta + math.asin(min(math.sin(theta) ** 2 / most, 1.0))


def _turn(order: float, elastic: bool) -> float:
    """Phase of the damping against the stiffness or the inertia, 0 to pi."""
    turn = math.pi / 2 * float(order)
    return turn if elastic else math.pi - turn


def _order(turn: float, elastic: bool) -> float:
    return (turn if elastic else math.pi - turn) / (math.pi / 2)
