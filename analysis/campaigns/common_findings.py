"""What was found beside the beam, counted over the sessions."""

from __future__ import annotations

import re
from dataclasses import dataclass
from statistics import median_low
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

    from analysis.campaigns.session import SessionResult
    from analysis.identify import Finding

_FIGURE: Final = re.compile(r"(?<!mode )[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
"""A number, but not that of a mode: it tells what is meant and not how much."""

_SHOWN: Final = {"s": (1e3, "ms"), "N·m": (1e3, "mN·m"), "1": (100.0, "%"),
                 "kg·m²": (1e6, "10⁻⁶ kg·m²")}  # fmt: skip


@dataclass(frozen=True, slots=True)
class CommonFinding:
    """One thing that one or more sessions hold beside the beam.

    Attributes
    ----------
    example : Finding
        Of the session in the middle, by size.
    files : tuple of str
        Names of the sessions that have it.
    sessions : int
        Of how many.
    span : tuple of float or None
        Least and largest size, in the finding's unit.
    """

    example: Finding
    files: tuple[str, ...]
    sessions: int
    span: tuple[float, float] | None

    @property
    def sentence(self) -> str:
        """In how many sessions, in the words of the one in the middle, and from what to what."""
        count = len(self.files)
        which = f" ({', '.join(self.files)})" if count < min(self.sessions, 3) else ""
        words = f"In {count} of {self.sessions} sessions{which}: {self.example.sentence}"
        if self.span is None or count == 1:
            return words
        factor, unit = _SHOWN.get(self.example.unit, (1.0, self.example.unit))
        low, high = (f"{factor * end:.3g}" for end in self.span)
        return f"{words} (So the session in the middle; over the sessions {low} to {high} {unit}.)"


def common_findings(sessions: Sequence[SessionResult]) -> tuple[CommonFinding, ...]:
    """Count the findings of all sessions, the most common first.

    Two findings are of the same thing if their sentences are the same but for the figures in them.
    """
    found: dict[tuple[str, str], list[tuple[str, Finding]]] = {}
    judged = [session for session in sessions if session.verdict is not None]
    for session in judged:
        for finding in session.verdict.findings if session.verdict else ():
            kind = finding.kind, _FIGURE.sub("#", finding.sentence)
            found.setdefault(kind, []).append((session.path.name, finding))
    counted = [_counted(group, len(judged)) for group in found.values()]
    return tuple(sorted(counted, key=lambda each: -len(each.files)))


def _counted(group: list[tuple[str, Finding]], sessions: int) -> CommonFinding:
    files = tuple(dict.fromkeys(name for name, _ in group))
    sizes = [finding.value for _, finding in group if finding.value is not None]
    if len(sizes) < len(group):
        return CommonFinding(group[0][1], files, sessions, None)
    middle = median_low(sizes)
    example = next(finding for _, finding in group if finding.value == middle)
    return CommonFinding(example, files, sessions, (min(sizes), max(sizes)))
