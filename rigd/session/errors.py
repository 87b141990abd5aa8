"""What can go wrong with a session file, told to the user."""


class SessionError(Exception):
    """A session file cannot be read or written; the message names the file and the remedy."""


class SessionExistsError(SessionError):
    """The file to be written exists already, and nothing is ever overwritten."""
