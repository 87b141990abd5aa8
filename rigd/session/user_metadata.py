"""Metadata that users add to a session, such as ``temperature_c``: rules, and text in the file.

The ending of a name is the unit: such a name has a finite number as value, any other a text.
"""

import re
from collections.abc import Mapping
from typing import Final

from rigd.errors import UserError
from rigd.units import finite_number, unit_of

NOTES: Final = ("operator", "specimen", "note")
"""Texts with separate options and keys."""
META_PREFIX: Final = "meta_"
"""Prefix of the key in the record ``session``."""

_NAME: Final = re.compile(r"[a-z][a-z0-9_]{0,39}")
_MOST_NAMES: Final = 32
_MOST_CHARACTERS: Final = 200
_SHOWN: Final = 40


class MetadataError(UserError, ValueError):
    """Metadata of a session breaks a rule; the message names it, its value, and the remedy."""


def check_name(name: str) -> None:
    """Check that a name is allowed for metadata.

    Raises
    ------
    MetadataError
        If it is not allowed.
    """
    if not _NAME.fullmatch(name):
        raise MetadataError(
            f"metadata {_shown(name)}: a name has lower-case letters, digits and _ only, begins "
            "with a letter, and has at most 40 characters, such as temperature_c."
        )
    if name in NOTES:
        raise MetadataError(f"metadata {name}: has its own place; give it as {name} instead.")


def metadata_keys(given: Mapping[str, object]) -> dict[str, str]:
    """Check a user's metadata, and return it in the form of the record ``session``.

    Parameters
    ----------
    given
        Values by their names: numbers, or texts, also of numbers.

    Returns
    -------
    dict of str to str
        By ``meta_NAME``.

    Raises
    ------
    MetadataError
        If there are too many, or a name or a value breaks a rule.

    Examples
    --------
    >>> from rigd.session.user_metadata import metadata_keys
    >>> metadata_keys({"temperature_c": "21.40", "batch": "B 7"})
    {'meta_temperature_c': '21.4', 'meta_batch': 'B 7'}
    """
    if len(given) > _MOST_NAMES:
        raise MetadataError(f"metadata: {len(given)} names are more than {_MOST_NAMES}.")
    keys = {}
    for name, value in given.items():
        check_name(name)
        keys[META_PREFIX + name] = _number(name, value) if unit_of(name) else _text(name, value)
    return keys


def added_metadata(session: Mapping[str, str]) -> dict[str, float | str]:
    """Return the metadata that users added to a session, by their names.

    Parameters
    ----------
    session
        The record ``session`` of any file.

    Returns
    -------
    dict of str to (float or str)
        Numbers where the name ends in a unit and the text is a finite number.
    """
    added: dict[str, float | str] = {}
    for key, text in session.items():
        if key.startswith(META_PREFIX):
            name = key.removeprefix(META_PREFIX)
            number = _as_number(text) if unit_of(name) else None
            added[name] = text if number is None else number
    return added


def _number(name: str, value: object) -> str:
    number = _as_number(value)
    if number is None:
        raise MetadataError(
            f"metadata {name} = {_shown(value)} is not a finite number; the name ends in a unit, "
            f"so give a number in {unit_of(name)} with a decimal point, or choose another name."
        )
    return repr(number)


def _as_number(value: object) -> float | None:
    """Return a finite number from a number or its text; None if there is none."""
    try:
        return finite_number(float(value) if isinstance(value, str) else value)
    except ValueError:
        return None


def _text(name: str, value: object) -> str:
    if isinstance(value, int | float) and not isinstance(value, bool):
        value = str(value)
    if not (isinstance(value, str) and value.strip() and value.isprintable()):
        raise MetadataError(
            f"metadata {name} = {_shown(value)} is not plain text of one line; give such a text or "
            "a number."
        )
    if len(value) > _MOST_CHARACTERS:
        raise MetadataError(
            f"metadata {name}: {len(value)} characters are more than {_MOST_CHARACTERS}; put long "
            "texts into the note."
        )
    return value


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"
