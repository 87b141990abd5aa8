"""Metadata that users add to a session, such as ``temperature_c``: rules and form in the file.

If the name ends in a unit, the value is a finite number. Otherwise the value is a text.
"""

import re
from collections.abc import Mapping
from typing import Final

from rigd.errors import UserError
from rigd.units import finite_number, unit_of

NOTES: Final = ("operator", "specimen", "note")
"""Names of the texts that have options and keys of their own, and are not user metadata."""
META_PREFIX: Final = "meta_"
"""Prefix that user metadata have in their keys in the record ``session``."""

_NAME_PATTERN: Final = re.compile(r"[a-z][a-z0-9_]{0,39}")
"""Regular expression that an allowed name of user metadata matches."""
_MAX_NAMES: Final = 32
"""Maximum number of user metadata of a session."""
_MAX_TEXT_CHARACTERS: Final = 200
"""Maximum number of characters of a text that is a value of user metadata."""
_MAX_SHOWN_CHARACTERS: Final = 40
"""Maximum number of characters of a value in an error message."""


class MetadataError(UserError, ValueError):
    """Raised if user metadata break a rule; the message states name, value and remedy."""


def check_name(name: str) -> None:
    """Raise if a name is not allowed for user metadata.

    Raises
    ------
    MetadataError
        If the name has forbidden characters, is too long, or has an option of its own.
    """
    if not _NAME_PATTERN.fullmatch(name):
        raise MetadataError(
            f"metadata {_shown_value(name)}: a name has lower-case letters, digits and _ only, "
            "begins with a letter, and has at most 40 characters, such as temperature_c."
        )
    if name in NOTES:
        raise MetadataError(f"metadata {name}: has its own place; give it as {name} instead.")


def metadata_keys(values: Mapping[str, object]) -> dict[str, str]:
    """Check user metadata, and return them as keys and texts for the record ``session``.

    Parameters
    ----------
    values
        Name → value: a number, a number's text, or any other text.

    Returns
    -------
    dict of str to str
        ``meta_NAME`` → text.

    Raises
    ------
    MetadataError
        If there are too many names, or a name or a value breaks a rule.

    Examples
    --------
    >>> from rigd.session.user_metadata import metadata_keys
    >>> metadata_keys({"temperature_c": "21.40", "batch": "B 7"})
    {'meta_temperature_c': '21.4', 'meta_batch': 'B 7'}
    """
    if len(values) > _MAX_NAMES:
        raise MetadataError(f"metadata: {len(values)} names are more than {_MAX_NAMES}.")
    keys = {}
    for name, value in values.items():
        check_name(name)
        keys[META_PREFIX + name] = (
            _number_text(name, value) if unit_of(name) else _checked_text(name, value)
        )
    return keys


def added_metadata(session: Mapping[str, str]) -> dict[str, float | str]:
    """Return the metadata that users added to a session, from its record ``session``.

    Parameters
    ----------
    session
        Record ``session`` of a session file from any source.

    Returns
    -------
    dict of str to (float or str)
        Name → number if the name ends in a unit and the text is a finite number, else the text.
    """
    metadata: dict[str, float | str] = {}
    for key, text in session.items():
        if key.startswith(META_PREFIX):
            name = key.removeprefix(META_PREFIX)
            number = _finite_or_none(text) if unit_of(name) else None
            metadata[name] = text if number is None else number
    return metadata


def _number_text(name: str, value: object) -> str:
    """Return the text of a number; raise MetadataError if the value is not a finite number."""
    number = _finite_or_none(value)
    if number is None:
        raise MetadataError(
            f"metadata {name} = {_shown_value(value)} is not a finite number; the name ends in a "
            f"unit, so give a number in {unit_of(name)} with a decimal point, or choose another "
            "name."
        )
    return repr(number)


def _finite_or_none(value: object) -> float | None:
    """Return the finite number of a number or a text, or None if the value is something else."""
    try:
        return finite_number(float(value) if isinstance(value, str) else value)
    except ValueError:
        return None


def _checked_text(name: str, value: object) -> str:
    """Return a text of one line; raise MetadataError if the value is not such a text."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        value = str(value)
    if not (isinstance(value, str) and value.strip() and value.isprintable()):
        raise MetadataError(
            f"metadata {name} = {_shown_value(value)} is not plain text of one line; give such a "
            "text or a number."
        )
    if len(value) > _MAX_TEXT_CHARACTERS:
        raise MetadataError(
            f"metadata {name}: {len(value)} characters are more than {_MAX_TEXT_CHARACTERS}; put "
            "long texts into the note."
        )
    return value


def _shown_value(value: object) -> str:
    """Return a value for an error message, cut to 40 characters."""
    text = repr(value)
    return text if len(text) <= _MAX_SHOWN_CHARACTERS else f"{text[:_MAX_SHOWN_CHARACTERS]}…"
