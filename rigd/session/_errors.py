"""Errors of session files."""

from rigd.errors import FailureError


class SessionError(FailureError):
    """A session file cannot be read or written; the message names the file and the remedy."""


class SessionAccessError(SessionError):
    """The system does not let the file be read now; it may be sound, and readable another time."""


class SessionExistsError(SessionError):
    """The file to be written exists already, and nothing is ever overwritten."""
