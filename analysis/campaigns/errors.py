"""What can go wrong with a campaign."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from analysis.campaigns.session import SessionFailure


class CampaignError(ValueError):
    """A campaign that cannot be analysed; the message says why and what to do."""


class LoneSessionError(CampaignError):
    """A campaign of whose files one alone can be used.

    Attributes
    ----------
    path : Path
        That one.
    failures : tuple of SessionFailure
        The others, and why.
    """

    def __init__(self, path: Path, failures: tuple[SessionFailure, ...]) -> None:
        super().__init__(f"Of {len(failures) + 1} files only {path} can be used.")
        self.path = path
        self.failures = failures


def task_errors() -> tuple[type[Exception], ...]:
    """Errors that concern one session and leave the others as they are."""
    from analysis.identify import MeasurementError
    from analysis.paper import EstimateError
    from analysis.record import RecordError
    from rigd.session import SessionError

    return SessionError, RecordError, EstimateError, MeasurementError
