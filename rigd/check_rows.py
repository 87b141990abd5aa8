"""Rows of ``rigd check``: what was checked, its value and the result."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from enum import Enum


class CheckResult(Enum):
    """Result of one check of the rig."""

    OK = "ok"
    WARNING = "warning"
    """A session can be run, but with caution."""
    FAIL = "failed"
    """No session may be run."""
    SKIPPED = "skipped"
    """The check was not made; `CheckRow.found` states the reason."""


@dataclass(frozen=True, slots=True)
class CheckRow:
    """Result of one check of the rig, as a row of a table for the operator."""

    group: str
    """Part of the rig that was checked."""
    what: str
    """Checked quantity."""
    found: str
    """Value of the quantity, or the reason why it was not checked."""
    wanted: str
    """Required value of the quantity, or an empty string if none is required."""
    verdict: CheckResult
    """Result of the check."""
    detail: str = ""
    """Explanation or remedy that is too long for the table, or an empty string."""
    name: str = ""
    """Short name by which a session can accept a failure of this check (`--accept`).

    It is empty for checks of devices and for checks that cannot fail."""

    def __post_init__(self) -> None:
        """Refuse values of other types, except that the text of a result ("failed") is accepted.

        Installed packages make rows too, and a failed one must not be taken for another.
        """
        object.__setattr__(self, "verdict", CheckResult(self.verdict))
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "verdict" and not isinstance(value, str):
                raise TypeError(f"CheckRow.{field.name} must be text, not {type(value).__name__}")

    def as_dict(self) -> dict[str, str]:
        """Return the fields of the row by name, for a JSON document."""
        return {
            "group": self.group,
            "what": self.what,
            "found": self.found,
            "wanted": self.wanted,
            "verdict": self.verdict.value,
            "detail": self.detail,
            "name": self.name,
        }


def overall_verdict(rows: Iterable[CheckRow]) -> str:
    """Return the verdict over all rows: ``failed``, ``warnings`` or ``ok``.

    Skipped rows do not count.
    """
    verdicts = {row.verdict for row in rows}
    if CheckResult.FAIL in verdicts:
        return "failed"
    return "warnings" if CheckResult.WARNING in verdicts else "ok"


def grade(*, fail: bool, warn: bool = False) -> CheckResult:
    """Return the check result for two conditions: failed, warning or ok.

    Parameters
    ----------
    fail, warn
        Whether the check fails and, if it does not fail, whether it gives a warning.
    """
    if fail:
        return CheckResult.FAIL
    return CheckResult.WARNING if warn else CheckResult.OK
