"""A new profile in the text of another: other values, each with its source and its reason."""

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rigd.profile.load import ProfileError
from rigd.profile.settings import TEXTS, is_text, keys

SettingValue = bool | int | float | str


@dataclass(frozen=True, slots=True)
class Setting:
    """The value of a key of a profile."""

    key: str
    """Dotted: ``cia402.node_id``."""
    value: SettingValue
    source: str = "assumed"
    """One of the words that a profile knows; a text has none."""
    reason: str = ""
    """One line, which becomes a comment above the value."""
    hexadecimal: bool = False


def with_settings(text: str, settings: Iterable[Setting]) -> str:
    """Return the text of a profile with other values; all comments stay.

    Parameters
    ----------
    text
        Of a profile that has all the keys.
    settings
        What is to stand in it.

    Raises
    ------
    KeyError
        If the profile does not have a key.
    """
    lines = text.splitlines()
    places = dict(_places(lines))
    # From the last line to the first, so that comments move no line that is still to come.
    for setting in sorted(settings, key=lambda setting: -places[setting.key]):
        place = places[setting.key]
        comment = [f"# {setting.reason}"] if setting.reason else []
        lines[place : place + 1] = [*comment, _line(setting)]
    return "\n".join(lines) + "\n"


def with_head(text: str, head: Sequence[str]) -> str:
    """Return the text of a profile with other comments before its first key."""
    lines = text.splitlines()
    first = next(i for i, line in enumerate(lines) if line and not line.startswith("#"))
    return "\n".join([*(f"# {line}".rstrip() for line in head), "", *lines[first:]]) + "\n"


def write_new(path: Path, text: str) -> None:
    """Write a file that does not exist yet.

    Raises
    ------
    ProfileError
        If there is one, or it cannot be written.
    """
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise ProfileError(
            f"{path}: is there already and is left as it is; name another file."
        ) from error
    except OSError as error:
        raise ProfileError(f"{path}: cannot be written ({error.strerror}).") from error


def _places(lines: Sequence[str]) -> Iterable[tuple[str, int]]:
    """Yield each key of a profile with the number of its line."""
    section = ""
    for place, line in enumerate(lines):
        if title := re.match(r"\[([^\]]+)\]", line):
            section = title[1] + "."
        elif key := re.match(r"(\w+)\s*=", line):
            yield section + key[1], place


def _line(setting: Setting) -> str:
    value = setting.value
    if isinstance(value, bool):
        shown = str(value).lower()
    elif isinstance(value, str):
        shown = json.dumps(value, ensure_ascii=False)  # escaped as TOML has it, too
    else:
        shown = f"0x{value:08X}" if setting.hexadecimal and isinstance(value, int) else repr(value)
    name = setting.key.rpartition(".")[2]
    if setting.key in TEXTS or is_text(keys()[setting.key]):
        return f"{name} = {shown}"
    return f'{name} = {{ value = {shown}, source = "{setting.source}" }}'
