"""Random seeds for the noise of a simulated rig: a fresh seed per session, unless one is stated."""

import hashlib
import secrets
from typing import Final

_SEED_BITS: Final = 53
"""Number of random bits in a seed, which a JSON number (a double) represents exactly."""


def fresh_seed() -> int:
    """Return a random seed for the noise of a simulated rig."""
    return secrets.randbits(_SEED_BITS)


def session_seed(series_seed: int, session_number: int) -> int:
    """Return the seed of one session of a series, derived from the seed of the series.

    Parameters
    ----------
    series_seed
        Seed of the series, which the first session uses unchanged.
    session_number
        Number of the session in the series, from 1 on.
    """
    if session_number == 1:
        return series_seed
    seed_digest = hashlib.blake2b(
        f"{series_seed} {session_number}".encode(), digest_size=8
    ).digest()
    return int.from_bytes(seed_digest, "big") >> (64 - _SEED_BITS)
