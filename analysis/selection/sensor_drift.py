"""Drift of the torque sensor's zero: what remains, averaged over sixteenths of the record."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from analysis.selection.candidates import Field

_PARTS: Final = 16
_BEYOND_CHANCE: Final = 10.0
"""Scatter of the means over what noise alone makes of them."""


def drift_of_zero(field: Field) -> float:
    """Range of the means over parts of the record in N·m; 0 if noise alone may make it."""
    comparison = field.comparison
    torque, _ = comparison.prediction.torque(field.best.fit.plant)
    left = comparison.torque_nm[comparison.kept] - torque
    length = left.size // _PARTS
    means = left[: _PARTS * length].reshape(_PARTS, length).mean(axis=1)
    # White noise as loud as that of the band's upper half.
    upper = field.noise.power[field.noise.power.size // 2 :]
    chance = math.sqrt(float(np.median(upper)) / comparison.samples / length)
    return float(np.ptp(means)) if float(means.std()) > _BEYOND_CHANCE * chance else 0.0
