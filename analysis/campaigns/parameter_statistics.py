"""Scatter of the fitted parameters over the sessions: the paper's Table 3."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.models import STRUCTURES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.campaigns.estimates import WelchFit
    from analysis.campaigns.session import SessionResult


@dataclass(frozen=True, slots=True)
class ParameterStatistics:
    """One free parameter of one type and weighting, over all sessions.

    Attributes
    ----------
    structure, weighting, parameter : str
    mean, median, std, min, max : float
        std with K − 1 in the denominator, NaN of a single session.
    at_bounds : int
        Sessions in which it rests on the edge of the range searched.
    """

    structure: str
    weighting: str
    parameter: str
    mean: float
    median: float
    std: float
    min: float
    max: float
    at_bounds: int


def fits_by_model(
    sessions: Sequence[SessionResult],
) -> dict[tuple[str, str], tuple[WelchFit, ...]]:
    """All sessions' fits by type and weighting, session by session."""
    rows = zip(*(session.welch_fits for session in sessions), strict=True)
    return {(row[0].structure, row[0].weighting): row for row in rows}


def parameter_statistics(sessions: Sequence[SessionResult]) -> tuple[ParameterStatistics, ...]:
    """Statistics of the free parameters of every type and weighting (Table 3)."""
    found = []
    for (structure, weighting), fits in fits_by_model(sessions).items():
        for parameter in STRUCTURES[structure].free:
            values = np.array([fit.parameters[parameter] for fit in fits])
            found.append(
                ParameterStatistics(
                    structure=structure,
                    weighting=weighting,
                    parameter=parameter,
                    mean=float(values.mean()),
                    median=float(np.median(values)),
                    std=float(values.std(ddof=1)) if values.size > 1 else float("nan"),
                    min=float(values.min()),
                    max=float(values.max()),
                    at_bounds=sum(parameter in fit.at_bounds for fit in fits),
                )
            )
    return tuple(found)
