"""Digests of a record's samples, to recognise the same samples in another file."""

import hashlib
from typing import Final

import numpy as np
from numpy.typing import NDArray

_WINDOW: Final = 128
"""Number of samples in a digest."""
_FEWEST_CHANGES: Final = 32
"""Least changes of the torque in a window: a sensor at rest gives the same values in any file."""
_ANCHOR: Final = 8
"""Number of samples that decide whether a window begins."""
_EVERY: Final = 256
"""On average one in so many samples begins a window, wherever the record was cut."""
_MULTIPLIER: Final = np.uint64(0x9E3779B97F4A7C15)


def sample_digests(
    angle_rad: NDArray[np.float64], torque_nm: NDArray[np.float64]
) -> frozenset[bytes]:
    """Return digests of a record's windows of samples.

    Parameters
    ----------
    angle_rad, torque_nm : ndarray, shape (n,)
        Measured angle and coupling torque.

    Returns
    -------
    frozenset of bytes
        Two records with a common digest have common samples: noise does not repeat itself. The
        samples decide where windows begin, so that a record cut at either end has digests of the
        whole one. A torque without noise has none at rest.

    Examples
    --------
    >>> import numpy as np
    >>> from rigd.session import sample_digests
    >>> noise = np.random.default_rng(1).normal(size=(3, 2000))
    >>> whole = sample_digests(noise[0], noise[1])
    >>> whole >= sample_digests(noise[0, 700:], noise[1, 700:]) > frozenset()
    True
    >>> whole & sample_digests(noise[0], noise[2])
    frozenset()
    """
    angle, torque = (np.ascontiguousarray(each) + 0.0 for each in (angle_rad, torque_nm))
    count = torque.size - _WINDOW + 1
    if count <= 0:
        return frozenset()
    bits = torque.view(np.uint64)
    mixed = np.zeros(count, dtype=np.uint64)
    for offset in range(_ANCHOR):
        mixed = (mixed + bits[offset : offset + count]) * _MULTIPLIER
        mixed ^= mixed >> np.uint64(29)
    changes = np.concatenate([[0], np.cumsum(np.diff(torque) != 0.0)])
    busy = changes[_WINDOW - 1 :] - changes[:count] >= _FEWEST_CHANGES
    return frozenset(
        hashlib.blake2b(
            angle[first : first + _WINDOW].tobytes() + torque[first : first + _WINDOW].tobytes(),
            digest_size=8,
        ).digest()
        for first in np.flatnonzero((mixed % np.uint64(_EVERY) == 0) & busy).tolist()
    )
