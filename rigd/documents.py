"""Reader of users' TOML and JSON documents, with limits of their size and depth.

A document of a few kilobytes can be nested deeper than the interpreter's stack, contain a number
with thousands of digits, or take twenty times its size in memory. Such documents are refused with
one sentence.
"""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from rigd.runtime import open_plain_file
from rigd.text_table import decode_text

MAX_TOML_BYTES: Final = 250_000
"""Largest size of a TOML file in bytes."""
MAX_JSON_BYTES: Final = 12_000_000
"""Largest size of a JSON file in bytes; the worst document takes thirty times as much memory."""
_MAX_TOML_ENTRIES: Final = 3000
"""Largest number of keys and elements of a TOML document; a profile has 150."""
_MAX_TOML_LINE_CHARACTERS: Final = 4096
"""Largest number of characters in a line of TOML.

The memory for a dotted key grows with the square of its length."""
_MAX_NESTING_DEPTH: Final = 16
"""Largest depth of nested tables and arrays in a TOML document."""


class DocumentError(ValueError):
    """Error of a document that cannot be read; the message is a clause after the file's name."""


def read_text(path: Path, max_bytes: int = MAX_TOML_BYTES) -> str:
    """Return the text of a user's file of limited size.

    Parameters
    ----------
    path
        Path of the file.
    max_bytes
        Largest accepted size of the file in bytes.

    Raises
    ------
    DocumentError
        If the file cannot be read, is not a regular file, is too large, or is not text.
    """
    try:
        with open_plain_file(path, max_bytes) as text_file:
            return decode_text(text_file.buffer.read())
    except OSError as error:
        raise DocumentError(f"cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise DocumentError("is not a text file in UTF-8; save it as one") from error


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a TOML document.

    Parameters
    ----------
    text
        Text of the document.

    Raises
    ------
    DocumentError
        If the text is not TOML, is nested too deeply, or is larger than a document written by a
        person.
    """
    if len(text) > MAX_TOML_BYTES:
        raise DocumentError(f"has more than {MAX_TOML_BYTES} characters; shorten it")
    if any(len(message_line) > _MAX_TOML_LINE_CHARACTERS for message_line in text.splitlines()):
        raise DocumentError(
            f"has a line of more than {_MAX_TOML_LINE_CHARACTERS} characters; shorten it"
        )
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise DocumentError(f"is not valid TOML: {error}") from error
    except RecursionError as error:
        raise DocumentError("is not valid TOML: it is nested too deeply") from error
    except ValueError as error:  # the interpreter's limit on digits
        raise DocumentError("is not valid TOML: a number has too many digits") from error
    _require_small_document(document)
    return document


def read_json(path: Path, max_bytes: int = MAX_JSON_BYTES) -> Any:  # noqa: ANN401 - any JSON value
    """Read a JSON file of limited size, and return its value.

    Parameters
    ----------
    path
        Path of the file.
    max_bytes
        Largest accepted size of the file in bytes.

    Raises
    ------
    DocumentError
        If the file cannot be read, is not a regular file, is too large, or is not JSON.
    """
    json_text = read_text(path, max_bytes)
    try:
        return json.loads(json_text)
    except RecursionError as error:
        raise DocumentError("is not a JSON document: it is nested too deeply") from error
    except ValueError as error:
        raise DocumentError(f"is not a JSON document ({error})") from error


def _require_small_document(document: Mapping[str, Any]) -> None:
    """Raise DocumentError if a document has too many entries or is nested too deeply."""
    entry_count = 0
    values_of_level: list[Any] = [document]
    for _ in range(_MAX_NESTING_DEPTH):
        values_of_level = [child for parent in values_of_level for child in _child_values(parent)]
        entry_count += len(values_of_level)
        if entry_count > _MAX_TOML_ENTRIES:
            raise DocumentError(f"has more than {_MAX_TOML_ENTRIES} keys and numbers; shorten it")
    if any(_child_values(child) for child in values_of_level):
        raise DocumentError(
            f"has tables nested deeper than {_MAX_NESTING_DEPTH} levels; flatten it"
        )


def _child_values(value: object) -> list[Any]:
    """Return the values in a table or array, or an empty list for any other value."""
    if isinstance(value, dict):
        return [*value.values()]
    return value if isinstance(value, list) else []
