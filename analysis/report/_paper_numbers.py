"""The paper's own numbers, to be put beside a campaign's.

"Fractional-Order Models of Damping Phenomena in a Flexible Sensing Antenna Used for Haptic Robot
Navigation", Tables 3 and 4, and the WMSE of Table 5: twenty sessions of a carbon fibre link.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class PaperStatistics:
    """One row of Table 3."""

    mean: float
    median: float
    std: float
    min: float
    max: float


@cache
def table3() -> Mapping[tuple[str, str, str], PaperStatistics]:
    """Statistics by type, weighting and parameter."""
    return {
        (row["type"], row["weighting"], row["parameter"]): PaperStatistics(
            **{name: float(row[name]) for name in ("mean", "median", "std", "min", "max")}
        )
        for row in _rows("paper_table3.csv")
    }


@cache
def table4() -> Mapping[tuple[str, str, str, int], float]:
    """Mean deviations by type, weighting, quantity (as `MeanPeakDeviation` names it) and mode."""
    names = ("quantity", "mode", "weighting")
    return {
        (structure, row["weighting"], row["quantity"], int(row["mode"])): float(value)
        for row in _rows("paper_table4.csv")
        for structure, value in row.items()
        if structure not in names
    }


@cache
def table5_wmse() -> Mapping[tuple[str, str], float]:
    """Weighted mean square error of the two best models, by type and weighting."""
    return {
        (row["type"], row["weighting"]): float(row["wmse"]) for row in _rows("paper_table5.csv")
    }


def _rows(name: str) -> list[dict[str, str]]:
    text = files("analysis.report").joinpath("data", name).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))
