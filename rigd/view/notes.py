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
