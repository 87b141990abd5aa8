"""Which modes a record shows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from analysis.whole_record import RecordFit
    from analysis.whole_record.comparison import Comparison
    from analysis.whole_record.noise import Noise

_VISIBLE: Final = 20.0
"""Power over that of the noise, at the peak of a mode that shows."""

_NEAR: Final = 0.05


def visible_modes(comparison: Comparison, noise: Noise, fit: RecordFit) -> tuple[int, ...]:
    """Modes at which the torque stands out of the noise."""
    torque = comparison.spectrum(comparison.torque_nm[comparison.kept])
    over = np.abs(torque) ** 2 / noise.power
    found = []
    for mode in fit.modes:
        near = np.abs(comparison.frequency_hz - mode.frequency_hz) < _NEAR * mode.frequency_hz
        near &= noise.counts
        if near.any() and float(np.median(over[near])) > _VISIBLE:
            found.append(mode.number)
    return tuple(found)
