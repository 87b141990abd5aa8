"""Digests of a record's samples, which show whether another record contains the same samples."""

import hashlib
from typing import Final

import numpy as np
from numpy.typing import NDArray

_WINDOW_SAMPLES: Final = 128
"""Number of consecutive samples from which one digest is computed."""
_MIN_TORQUE_CHANGES: Final = 32
"""Minimum number of changes of the torque in a window with a digest. Windows of a sensor at rest
could be equal in different records."""
_ANCHOR_SAMPLES: Final = 8
"""Number of consecutive torque samples whose hash decides whether the first one begins a window."""
_MEAN_WINDOW_DISTANCE: Final = 256
"""Average number of samples from the start of one window to the start of the next."""
_HASH_MULTIPLIER: Final = np.uint64(0x9E3779B97F4A7C15)
"""Multiplier of the hash that decides whether a window begins."""


def sample_digests(
    angle_rad: NDArray[np.float64], torque_nm: NDArray[np.float64]
) -> frozenset[bytes]:
    """Return digests of windows of a record, to find the same samples in another record.

    Parameters
    ----------
    angle_rad, torque_nm : ndarray, shape (n,)
        Measured angle and coupling torque of the record.

    Returns
    -------
    frozenset of bytes
        Two records with a common digest contain the same samples, because measurement noise does
        not repeat. The samples determine where windows begin. A record that was cut at either end
        therefore has digests of the original record. A constant torque has no digests.

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
    angle, torque = (np.ascontiguousarray(signal) + 0.0 for signal in (angle_rad, torque_nm))
    window_count = torque.size - _WINDOW_SAMPLES + 1
    if window_count <= 0:
        return frozenset()
    torque_bits = torque.view(np.uint64)
    anchor_hashes = np.zeros(window_count, dtype=np.uint64)
    for anchor_offset in range(_ANCHOR_SAMPLES):
        anchor_hashes = (
            anchor_hashes + torque_bits[anchor_offset : anchor_offset + window_count]
        ) * _HASH_MULTIPLIER
        anchor_hashes ^= anchor_hashes >> np.uint64(29)
    change_counts = np.concatenate([[0], np.cumsum(np.diff(torque) != 0.0)])
    has_enough_changes = (
        change_counts[_WINDOW_SAMPLES - 1 :] - change_counts[:window_count] >= _MIN_TORQUE_CHANGES
    )
    return frozenset(
        hashlib.blake2b(
            angle[first_sample : first_sample + _WINDOW_SAMPLES].tobytes()
            + torque[first_sample : first_sample + _WINDOW_SAMPLES].tobytes(),
            digest_size=8,
        ).digest()
        for first_sample in np.flatnonzero(
            (anchor_hashes % np.uint64(_MEAN_WINDOW_DISTANCE) == 0) & has_enough_changes
        ).tolist()
    )
