"""What a check finds: rows of one table, and the verdict over all of them."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum


class Verdict(Enum):
    """Of one row."""

    OK = "ok"
    WARNING = "warning"
    """A session can be run; somebody should know."""
    FAIL = "failed"
    """No session may be run."""
    SKIPPED = "skipped"
    """Not looked at; what was found says why."""


@dataclass(frozen=True, slots=True)
class Row:
    """One thing that was looked at; all texts are for the operator."""

    group: str
    what: str
    found: str
    wanted: str
    """What it is compared with; empty if with nothing."""
    verdict: Verdict
    detail: str = ""
    """What is too long for a table."""

    def as_dict(self) -> dict[str, str]:
        """Return the row for a JSON document."""
        return {
            "group": self.group,
            "what": self.what,
            "found": self.found,
            "wanted": self.wanted,
            "verdict": self.verdict.value,
            "detail": self.detail,
        }


def overall(rows: Iterable[Row]) -> str:
    """Return ``failed``, ``warnings`` or ``ok``; what was skipped does not count."""
    verdicts = {row.verdict for row in rows}
    if Verdict.FAIL in verdicts:
        return "failed"
    return "warnings" if Verdict.WARNING in verdicts else "ok"


def grade(*, fail: bool, warn: bool = False) -> Verdict:
    """Return the verdict on a comparison."""
    if fail:
        return Verdict.FAIL
    return Verdict.WARNING if warn else Verdict.OK
