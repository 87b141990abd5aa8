"""Seeds of a simulated rig's noise: a fresh one for each session, unless one is stated."""

import hashlib
import secrets
from typing import Final

_BITS: Final = 53
"""A double holds it exactly, as in JSON."""


def fresh_seed() -> int:
    """Return a random seed."""
    return secrets.randbits(_BITS)


def session_seed(stated: int, number: int) -> int:
    """Return the seed of a session of a series.

    Parameters
    ----------
    stated
        Seed of the series, which its first session has.
    number
        Number of the session, from 1 on.
    """
    if number == 1:
        return stated
    digest = hashlib.blake2b(f"{stated} {number}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "big") >> (64 - _BITS)
