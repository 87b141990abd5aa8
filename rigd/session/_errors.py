"""Errors that are raised when session files are read or written."""

from rigd.errors import FailureError


class SessionError(FailureError):
    """Raised if a session file cannot be read or written; the text states file and remedy."""


class SessionAccessError(SessionError):
    """Raised if the operating system refuses to read a session file, which may be intact."""


class SessionExistsError(SessionError):
    """Raised if the session file to be written exists already; no file is ever overwritten."""
