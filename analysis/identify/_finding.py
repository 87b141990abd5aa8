"""Finding: an effect in a record in addition to the linear beam."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Final, Literal

FindingKind = Literal[
    "hum",
    "nonlinear stiffness",
    "nonlinear damping",
    "air drag",
    "harmonics",
    "delay",
    "tool inertia",
    "ringing start",
    "hidden response",
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
"""Kind of an effect."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Effect found in a record in addition to the linear beam.

    Attributes
    ----------
    kind : str
        Kind of the effect.
    sentence : str
        Sentence for the report.
    value : float or None
        Size of the effect in `unit`; None if it has no size.
    interval : tuple of float or None
        95 % interval of the size; None if it is not known.
    unit : str
        Unit of the size.
    remedy : str
        Action to avoid the effect, or experiment to clarify its cause; may be empty.
    parameters : tuple of str
        Fitted parameters on which the finding is based: it is not established if one of them is
        flagged.
    """

    kind: FindingKind
    sentence: str
    value: float | None = None
    interval: tuple[float, float] | None = None
    unit: str = "1"
    remedy: str = ""
    parameters: tuple[str, ...] = ()


MODEL_INDEPENDENT_KINDS: Final[frozenset[FindingKind]] = frozenset(
    {
        "hum",
        "sensor drift",
        "sign",
        "unit",
        "clipping",
        "stop",
        "knock",
        "implausible",
        "hidden response",
        "unexplained",
    }
)
"""Kinds of effects that are visible in the record itself, whatever model is fitted to it."""

_INTERVAL_PATTERN: Final = re.compile(r" \((?:[^()]*; 95 %|± [^()]*)\)")
"""Interval in parentheses in a sentence."""


def with_doubt(finding: Finding, reason: str) -> Finding:
    """Return a finding whose sentence says that it is not established, for a given reason.

    The returned finding has no interval. A finding whose kind is one of `MODEL_INDEPENDENT_KINDS`
    is returned unchanged.

    Examples
    --------
    >>> delay = Finding("delay", "The torque comes 1 ms later (0.9 to 1.1 ms; 95 %).",
    ...                 1e-3, (9e-4, 1.1e-3), "s", "")
    >>> with_doubt(delay, "part of the record is unexplained").sentence
    'Not established, because part of the record is unexplained: the torque comes 1 ms later.'
    """
    if finding.kind in MODEL_INDEPENDENT_KINDS:
        return finding
    shortened_sentence = _INTERVAL_PATTERN.sub("", finding.sentence)
    if shortened_sentence[1:2].islower() or shortened_sentence[1:2] == " ":  # no abbreviation
        shortened_sentence = shortened_sentence[0].lower() + shortened_sentence[1:]
    return replace(
        finding,
        sentence=f"Not established, because {reason}: {shortened_sentence}",
        interval=None,
    )
