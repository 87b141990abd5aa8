"""Finding: an effect in a record in addition to the linear beam."""

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
    """One effect found in a record.

    Attributes
    ----------
    kind : str
    sentence : str
        Sentence for the report.
    value : float or None
        Its size, in `unit`.
    interval : tuple of float or None
        95 %.
    unit : str
    remedy : str
        Action, or experiment that would clarify the cause; may be empty.
    parameters : tuple of str
        Fitted parameters that it rests on: it is not established if one of them is flagged.
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
    """Return a finding as not established, for a reason.

    Parameters
    ----------
    finding : Finding
    because : str
        Reason why it is not established.

    Returns
    -------
    Finding
        Finding without interval; unchanged if it does not rest on the model (`SEEN`).

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
