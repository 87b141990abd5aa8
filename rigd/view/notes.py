"""Lines of the session's log, as they are shown."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Note:
    """Something that happened.

    Attributes
    ----------
    t_ns
        When, since the start of the session.
    level
        "debug", "info", "warning", "error" or "fatal", as in the session file.
    message
        In the operator's words.
    """

    t_ns: int
    level: str
    message: str


def outcome_note(t_ns: int, outcome: str, reason: str) -> Note:
    """Return the last line of a session's log: how it ended, at the time of its last sample."""
    return Note(t_ns, _LEVELS.get(outcome, "warning"), f"Outcome: {outcome}. {reason}".rstrip())


_LEVELS = {"complete": "info", "fault": "error"}
