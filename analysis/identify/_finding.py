"""Finding: an effect in a record other than the beam of Eq. 25."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Final, Literal

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
    "clock rate difference",
    "rival explanations",
    "sign",
    "unit",
    "sensor drift",
    "drifting damping",
    "drifting stiffness",
    "drifting gain",
    "clipping",
    "play",
    "friction",
    "nonlinear gain",
    "knock",
    "stop",
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
    parameters : tuple of str
        Fitted parameters that it is about: it is no fact where one of them is flagged.
    """

    kind: Kind
    sentence: str
    value: float | None = None
    interval: tuple[float, float] | None = None
    unit: str = "1"
    remedy: str = ""
    parameters: tuple[str, ...] = ()


SEEN: Final[frozenset[Kind]] = frozenset(
    {
        "hum",
        "sensor drift",
        "sign",
        "unit",
        "clipping",
        "stop",
        "knock",
        "implausible",
        "unexplained",
    }
)
"""What is seen in the record itself, whatever model is laid over it."""

_INTERVAL: Final = re.compile(r" \((?:[^()]*; 95 %|± [^()]*)\)")


def doubted(finding: Finding, because: str) -> Finding:
    """Tell as no fact what was found beside a model that is not to be believed.

    Parameters
    ----------
    finding : Finding
    because : str
        Why it is not.

    Returns
    -------
    Finding
        Without interval; as it was if it does not rest on the model (`SEEN`).

    Examples
    --------
    >>> delay = Finding("delay", "The torque comes 1 ms later (0.9 to 1.1 ms; 95 %).",
    ...                 1e-3, (9e-4, 1.1e-3), "s", "")
    >>> doubted(delay, "part of the record is unexplained").sentence
    'Not established, because part of the record is unexplained: the torque comes 1 ms later.'
    """
    if finding.kind in SEEN:
        return finding
    bare = _INTERVAL.sub("", finding.sentence)
    if bare[1:2].islower() or bare[1:2] == " ":  # no abbreviation
        bare = bare[0].lower() + bare[1:]
    return replace(
        finding,
        sentence=f"Not established, because {because}: {bare}",
        interval=None,
    )
