"""Every structure that was fitted to the whole records, pooled or not, selected or not."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.campaigns.pooled import by_structure, determines_damping, pooled_bic

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.campaigns.pooled import PooledEstimate
    from analysis.campaigns.session import SessionResult


@dataclass(frozen=True, slots=True)
class RankedStructure:
    """How one structure stands with all sessions.

    Attributes
    ----------
    structure : str
    uniform : bool
    beam : str
        As of `RecordEstimate`.
    fitted : int
        Sessions to which it was fitted.
    determined : int
        Those of them that determine its damping.
    selected_alone : int
        Those that select it by themselves.
    misfit : float
        As of `PooledEstimate`, over the sessions to which it was fitted if it is not pooled.
    bic_above_lowest : float or None
        BIC of all sessions together above the lowest of those pooled; None if it was fitted to
        some sessions only. Below zero where it would fit better, but too few determine it.
    pooled : bool
        Whether two sessions or more determine it, and all tried it.
    """

    structure: str
    uniform: bool
    beam: str
    fitted: int
    determined: int
    selected_alone: int
    misfit: float
    bic_above_lowest: float | None
    pooled: bool

    @property
    def name(self) -> str:
        """As tables call it."""
        return f"{self.structure}{self.beam}"


def ranked_structures(
    sessions: Sequence[SessionResult], pooled: Sequence[PooledEstimate]
) -> tuple[RankedStructure, ...]:
    """Rank every structure fitted: those pooled, by BIC, then the others.

    Parameters
    ----------
    sessions : sequence of SessionResult
    pooled : sequence of PooledEstimate
        The lowest BIC first.
    """
    fits = by_structure(sessions)
    tried = max(map(len, fits.values()), default=0)
    bic = {name: pooled_bic(each) for name, each in fits.items() if len(each) == tried}
    alone = Counter(session.selected for session in sessions)
    misfit = {each.name: each.misfit for each in pooled}
    lowest = pooled[0].bic if pooled else min(bic.values(), default=0.0)
    found = [
        RankedStructure(
            structure=each[0].structure,
            uniform=each[0].uniform,
            beam=each[0].beam,
            fitted=len(each),
            determined=sum(map(determines_damping, each)),
            selected_alone=alone[name],
            misfit=misfit.get(name)
            or float(np.median([one.cost / one.degrees_of_freedom for one in each])),
            bic_above_lowest=bic[name] - lowest if name in bic else None,
            pooled=name in misfit,
        )
        for name, each in fits.items()
    ]
    return tuple(sorted(found, key=_rank))


def _rank(each: RankedStructure) -> tuple[bool, bool, float]:
    bic = each.bic_above_lowest
    return not each.pooled, bic is None, bic or 0.0
