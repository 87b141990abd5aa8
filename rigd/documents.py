"""TOML and JSON documents of users, read with limits of their size.

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

MOST_TOML_BYTES: Final = 250_000
MOST_JSON_BYTES: Final = 12_000_000
"""Largest size of JSON; the worst document takes thirty times as much memory."""
_MOST_ENTRIES: Final = 3000
"""Largest number of keys and elements of a TOML document; a profile has 150."""
_LONGEST_LINE: Final = 4096
"""Longest line of TOML, characters: the memory for a dotted key grows quadratically."""
_DEEPEST: Final = 16


class DocumentError(ValueError):
    """A document cannot be read; the message completes a sentence after the file name."""


def read_text(path: Path, most_bytes: int = MOST_TOML_BYTES) -> str:
    """Return the text of a file.

    Parameters
    ----------
    path
        Name of the file.
    most_bytes
        Size of the largest file that is read.

    Raises
    ------
    DocumentError
        If the file cannot be read, is not a regular file, is too large, or is not text.
    """
    try:
        with open_plain_file(path, most_bytes) as file:
            return decode_text(file.buffer.read())
    except OSError as error:
        raise DocumentError(f"cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise DocumentError("is not a text file in UTF-8; save it as one") from error


def parse_toml(text: str) -> dict[str, Any]:
    """Return the document of a TOML text.

    Parameters
    ----------
    text
        The text.

    Raises
    ------
    DocumentError
        If it is not TOML, is nested too deeply, or is larger than a document written by a person.
    """
    if len(text) > MOST_TOML_BYTES:
        raise DocumentError(f"has more than {MOST_TOML_BYTES} characters; shorten it")
    if any(len(line) > _LONGEST_LINE for line in text.splitlines()):
        raise DocumentError(f"has a line of more than {_LONGEST_LINE} characters; shorten it")
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise DocumentError(f"is not valid TOML: {error}") from error
    except RecursionError as error:
        raise DocumentError("is not valid TOML: it is nested too deeply") from error
    except ValueError as error:  # the interpreter's limit on digits
        raise DocumentError("is not valid TOML: a number has too many digits") from error
    _check_extent(document)
    return document


def read_json(path: Path, most_bytes: int = MOST_JSON_BYTES) -> Any:  # noqa: ANN401 - any JSON value
    """Return the value of a JSON file.

    Parameters
    ----------
    path
        Name of the file.
    most_bytes
        Size of the largest file that is read.

    Raises
    ------
    DocumentError
        If the file cannot be read, is not a regular file, is too large, or is not JSON.
    """
    text = read_text(path, most_bytes)
    try:
        return json.loads(text)
    except RecursionError as error:
        raise DocumentError("is not a JSON document: it is nested too deeply") from error
    except ValueError as error:
        raise DocumentError(f"is not a JSON document ({error})") from error


def _check_extent(document: Mapping[str, Any]) -> None:
    entries = 0
    level: list[Any] = [document]
    for _ in range(_DEEPEST):
        level = [each for part in level for each in _parts(part)]
        entries += len(level)
        if entries > _MOST_ENTRIES:
            raise DocumentError(f"has more than {_MOST_ENTRIES} keys and numbers; shorten it")
    if any(_parts(each) for each in level):
        raise DocumentError(f"has tables nested deeper than {_DEEPEST} levels; flatten it")


def _parts(value: object) -> list[Any]:
    if isinstance(value, dict):
        return [*value.values()]
    return value if isinstance(value, list) else []
