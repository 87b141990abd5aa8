"""One thing found in a record beside the beam of Eq. 25."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal[
    "hum",
    "nonlinear stiffness",
    "nonlinear damping",
    "air drag",
    "harmonics",
    "delay",
    "tool inertia",
    "ringing start",
    "beam data",
    "not uniform",
    "implausible",
    "unexplained",
]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing found.

    Attributes
    ----------
    kind : str
    sentence : str
        As the report says it.
    value : float or None
        Its size, in `unit`.
    interval : tuple of float or None
        95 %.
    unit : str
    remedy : str
        What to do, or which experiment tells more; may be empty.
    """

    kind: Kind
    sentence: str
    value: float | None
    interval: tuple[float, float] | None
    unit: str
    remedy: str
