"""What can go wrong with a campaign."""

from __future__ import annotations


class CampaignError(ValueError):
    """A campaign that cannot be analysed; the message says why and what to do."""


def task_errors() -> tuple[type[Exception], ...]:
    """Errors that concern one session and leave the others as they are."""
    from analysis.estimate import EstimateError
    from analysis.record import RecordError
    from analysis.whole_record import MeasurementError
    from rigd.session import SessionError

    return SessionError, RecordError, EstimateError, MeasurementError
