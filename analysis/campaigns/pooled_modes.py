"""Frequencies and damping ratios of the modes over all sessions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.campaigns.random_effects import random_effects

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.campaigns.estimates import RecordEstimate


@dataclass(frozen=True, slots=True)
class PooledMode:
    """One mode over all sessions.

    Attributes
    ----------
    number : int
    frequency_hz, frequency_std_hz : float
        Mean over the sessions, and its standard deviation.
    frequency_between_std_hz : float
        Scatter between sessions beyond their own uncertainties.
    damping_ratio, damping_ratio_std, damping_ratio_between_std : float
        Likewise.
    """

    number: int
    frequency_hz: float
    frequency_std_hz: float
    frequency_between_std_hz: float
    damping_ratio: float
    damping_ratio_std: float
    damping_ratio_between_std: float


def pooled_modes(estimates: Sequence[RecordEstimate]) -> tuple[PooledMode, ...]:
    """Pool each mode that all sessions have, frequency and damping ratio each by itself."""
    found = []
    for modes in zip(*(each.modes for each in estimates), strict=False):
        frequency = _pooled([(mode.frequency_hz, mode.frequency_std_hz) for mode in modes])
        ratio = _pooled([(mode.damping_ratio, mode.damping_ratio_std) for mode in modes])
        if frequency is not None and ratio is not None:
            found.append(PooledMode(modes[0].number, *frequency, *ratio))
    return tuple(found)


def _pooled(estimates: Sequence[tuple[float, float]]) -> tuple[float, float, float] | None:
    """Mean, its standard deviation and the scatter between sessions; None if one has no std."""
    values, std = np.array(estimates).T
    if not (np.isfinite(std).all() and (std > 0).all()):
        return None
    effects = random_effects(values[:, None], (std**2)[:, None, None])
    mean, variance, between = effects.mean[0], effects.covariance[0, 0], effects.between_std[0]
    return float(mean), math.sqrt(variance), float(between)
