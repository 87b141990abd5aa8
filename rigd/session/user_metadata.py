"""Metadata that users add to a session, such as ``temperature_c``: rules and form in the file.

If the name ends in a unit, the value is a finite number. Otherwise the value is a text.
"""

import re
from collections.abc import Mapping
from typing import Final

from rigd.errors import UserError
from rigd.units import finite_number, unit_of

NOTES: Final = ("operator", "specimen", "note")
"""Names of texts that are not user metadata, because they have their own options and keys."""
META_PREFIX: Final = "meta_"
"""Prefix that user metadata have in their keys in the record ``session``."""

_METADATA_NAME_PATTERN: Final = re.compile(r"[a-z][a-z0-9_]{0,39}")
"""Regular expression that an allowed name of user metadata matches."""
_MAX_METADATA_NAMES: Final = 32
"""Maximum number of user metadata of a session."""
_MAX_TEXT_CHARACTERS: Final = 200
"""Maximum number of characters of a text that is a value of user metadata."""
_MAX_SHOWN_CHARACTERS: Final = 40
"""Maximum number of characters of a value in an error message."""


class MetadataError(UserError, ValueError):
    """Raised if user metadata break a rule; the message states name, value and remedy."""


def check_name(metadata_name: str) -> None:
    """Raise if a name is not allowed for user metadata.

    Raises
    ------
    MetadataError
        If the name has forbidden characters, is too long, or has an option of its own.
    """
    if not _METADATA_NAME_PATTERN.fullmatch(metadata_name):
        raise MetadataError(
            f"metadata {_shown_value(metadata_name)}: a name has lower-case letters, digits and "
            "_ only, begins with a letter, and has at most 40 characters, such as temperature_c."
        )
    if metadata_name in NOTES:
        raise MetadataError(
            f"metadata {metadata_name}: is a field of its own; give it as {metadata_name} instead."
        )


def metadata_keys(metadata_values: Mapping[str, object]) -> dict[str, str]:
    """Check user metadata, and return them as keys and texts for the record ``session``.

    Parameters
    ----------
    metadata_values
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
    if len(metadata_values) > _MAX_METADATA_NAMES:
        raise MetadataError(
            f"metadata: {len(metadata_values)} names are more than {_MAX_METADATA_NAMES}."
        )
    text_by_key = {}
    for metadata_name, metadata_value in metadata_values.items():
        check_name(metadata_name)
        text_by_key[META_PREFIX + metadata_name] = (
            _number_text(metadata_name, metadata_value)
            if unit_of(metadata_name)
            else _checked_text(metadata_name, metadata_value)
        )
    return text_by_key


def added_metadata(session_record: Mapping[str, str]) -> dict[str, float | str]:
    """Return the metadata that users added to a session, from its record ``session``.

    Parameters
    ----------
    session_record
        Record ``session`` of a session file from any source.

    Returns
    -------
    dict of str to (float or str)
        Name → number if the name ends in a unit and the text is a finite number, else the text.
    """
    user_metadata: dict[str, float | str] = {}
    for key, metadata_text in session_record.items():
        if key.startswith(META_PREFIX):
            metadata_name = key.removeprefix(META_PREFIX)
            number = _finite_or_none(metadata_text) if unit_of(metadata_name) else None
            user_metadata[metadata_name] = metadata_text if number is None else number
    return user_metadata


def _number_text(metadata_name: str, metadata_value: object) -> str:
    """Return the text of a number; raise MetadataError if the value is not a finite number."""
    number = _finite_or_none(metadata_value)
    if number is None:
        raise MetadataError(
            f"metadata {metadata_name} = {_shown_value(metadata_value)} is not a finite number; "
            f"the name ends in a unit, so give a number in {unit_of(metadata_name)} with a decimal "
            "point, or choose another name."
        )
    return repr(number)


def _finite_or_none(number_or_text: object) -> float | None:
    """Return a number, or the number that a text states, as a finite float; otherwise None."""
    try:
        return finite_number(
            float(number_or_text) if isinstance(number_or_text, str) else number_or_text
        )
    except ValueError:
        return None


def _checked_text(metadata_name: str, metadata_value: object) -> str:
    """Return a text of one line; raise MetadataError if the value is not such a text."""
    if isinstance(metadata_value, int | float) and not isinstance(metadata_value, bool):
        metadata_value = str(metadata_value)
    if not (
        isinstance(metadata_value, str) and metadata_value.strip() and metadata_value.isprintable()
    ):
        raise MetadataError(
            f"metadata {metadata_name} = {_shown_value(metadata_value)} is not plain text of one "
            "line; give such a text or a number."
        )
    if len(metadata_value) > _MAX_TEXT_CHARACTERS:
        raise MetadataError(
            f"metadata {metadata_name}: {len(metadata_value)} characters are more than "
            f"{_MAX_TEXT_CHARACTERS}; put long texts into the note."
        )
    return metadata_value


def _shown_value(metadata_value: object) -> str:
    """Return a value for an error message, cut to 40 characters."""
    value_text = repr(metadata_value)
    return (
        value_text
        if len(value_text) <= _MAX_SHOWN_CHARACTERS
        else f"{value_text[:_MAX_SHOWN_CHARACTERS]}…"
    )
