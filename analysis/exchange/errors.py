"""The error of this package."""


class ExchangeError(Exception):
    """A file that cannot be imported or exported; the message names file, cause and remedy."""


class TargetError(ExchangeError):
    """A name under which nothing can be written."""
