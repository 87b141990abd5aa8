"""Window of Welch's method: its weights, and the limits that follow from its shape."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class WelchWindow:
    """Declaration of a window that weights the segments of Welch's method."""

    name: str
    """Name in figures and reports."""
    weights: Callable[[int], NDArray[np.float64]]
    """Function that returns the weights of a segment of n samples, shape (n,)."""
    half_power_bins: float
    """Width of the main lobe at half power, in bins of a segment's transform."""
    min_relative_power: float
    """Smallest power of the reference in an excited bin, relative to its largest power; the power
    that leaks into other bins is smaller."""


# The side lobes have -43 dB, and where the record ends in mid-chirp the pedestal is 0.08. The power
# of a chirp where two of the reference paper's segments join is -15 dB.
WINDOW: Final = WelchWindow("Hamming", np.hamming, half_power_bins=1.30, min_relative_power=2e-3)
"""Window of all estimates: the symmetric Hamming window, as in MATLAB and the reference paper."""
