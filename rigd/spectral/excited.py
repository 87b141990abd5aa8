"""Which bins a reference has excited, told from the spectrum of its windowed segments."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

LEAST_POWER: Final = 2e-3
"""Least power of an excited bin, relative to the largest.

Above what a Hamming window lets leak (−43 dB in its side lobes, and its pedestal of 0.08 where the
record breaks off in mid-chirp), below what a chirp leaves where two of the paper's segments join
(−15 dB).
"""


def excited_bins(power: NDArray[np.float64], resolution_bins: int) -> NDArray[np.bool_]:
    """Bins where the power is the reference's own and not leaked from its neighbours.

    Parameters
    ----------
    power : ndarray of float, shape (n,)
        Of the reference, on bins from frequency 0 on.
    resolution_bins : int
        Bins per inverse length of the shortest window that made the power. A dip no wider than
        twice that is a ripple of the window's and counts as excited; at either end of a band so
        many bins are given up to what leaks.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    largest = power.max(initial=0.0)
    if not largest > 0.0:
        return np.zeros(power.shape, dtype=np.bool_)
    closed = _any_near(power > LEAST_POWER * largest, resolution_bins)
    return ~_any_near(~closed, 2 * resolution_bins)


def _any_near(marked: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Whether any bin within the reach is marked; beyond the ends it goes on as at the ends."""
    counts = np.cumsum(np.pad(marked, (reach + 1, reach), mode="edge"))
    near: NDArray[np.bool_] = counts[2 * reach + 1 :] > counts[: -2 * reach - 1]
    return near
