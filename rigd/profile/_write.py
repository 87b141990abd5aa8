"""Writing of a profile in the text of another: new values, each with its source and its reason."""

import json
import re
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rigd.profile._load import ProfileError, profile_of
from rigd.profile._schema import UNKNOWN, Profile, is_number, keys

SettingValue = bool | int | float | str | tuple[str, ...]

_WIDTH = 100


@dataclass(frozen=True, slots=True)
class Setting:
    """The value of a key of a profile."""

    key: str
    """Dotted: ``cia402.node_id``."""
    value: SettingValue
    source: str = "assumed"
    """One of the words that a profile knows; only numbers have one. Unknown: without the value."""
    reason: str = ""
    """Becomes a comment above the value."""
    hexadecimal: bool = False
    commented: bool = False
    """Stands as a comment only, for somebody to decide on; the key keeps its default."""


def with_settings(text: str, settings: Iterable[Setting]) -> str:
    """Return the text of a profile with other values; all comments stay.

    Parameters
    ----------
    text
        Text of a valid profile.
    settings
        What is to stand in it. A key that it has left out takes the place of the comment that
        shows it, or comes first in its section.

    Raises
    ------
    KeyError
        If the profile does not have the section of a key.
    """
    lines = text.splitlines()
    for setting in settings:
        indices = _line_indices(lines)
        line = _line(setting)
        new = [*_comment(setting.reason), f"# {line}" if setting.commented else line]
        if setting.key in indices:
            index = indices[setting.key]
            lines[index : index + 1] = new
        else:
            index = indices[setting.key.rpartition(".")[0]] + 1
            lines[index:index] = new
    return "\n".join(lines) + "\n"


def with_head(text: str, head: Sequence[str]) -> str:
    """Return the text of a profile with other comments before its first key."""
    lines = text.splitlines()
    first = next(i for i, line in enumerate(lines) if line and not line.startswith("#"))
    return (
        "\n".join(
            [*(each for line in head for each in _comment(line) or ["#"]), "", *lines[first:]]
        )
        + "\n"
    )


def check_new(path: Path) -> None:
    """Refuse a path for a new profile under which none could be written, or found again.

    Raises
    ------
    ProfileError
        If there is a file, no folder for it, or its name is not a profile's.
    """
    if path.suffix != ".toml":
        raise ProfileError(f"{path}: the name of a profile ends in .toml.")
    if path.exists() or path.is_symlink():
        raise _taken(path)
    if not path.parent.is_dir():
        raise ProfileError(f"{path}: there is no folder {path.parent}; create it first.")


def write_new(path: Path, text: str) -> None:
    """Write a file that does not exist yet.

    Parameters
    ----------
    path
        The new file.
    text
        Its text.

    Raises
    ------
    ProfileError
        If there is one, or it cannot be written.
    """
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise _taken(path) from error
    except OSError as error:
        raise ProfileError(f"{path}: cannot be written ({error.strerror}).") from error


def copy_profile(profile: Profile, path: Path, name: str | None = None) -> None:
    """Write a profile to a file that does not exist yet, in a folder that is made if need be.

    Parameters
    ----------
    profile
        What is copied, with all its comments. Where it names the drive's EDS file, that is named
        by its whole path in the copy, whose folder is another one.
    path
        Name in the copy.
    name
        What the profile calls itself in the copy; None: as before.

    Raises
    ------
    ProfileError
        If there is such a file, it cannot be written, or the name is not a profile's.
    """
    settings = [] if name is None else [Setting("name", name)]
    drive = profile.rig.cia402
    if drive is not None and drive.eds:
        settings.append(Setting("cia402.eds", drive.eds))
    text = profile.text
    if settings:
        try:
            text = with_settings(text, settings)
        except KeyError:
            raise ProfileError(
                f"{profile.path}: is not laid out as the shipped profiles are, one key a line "
                "under its [section], so that no changed copy can be made; copy the file, edit it."
            ) from None
        profile_of(text, path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ProfileError(f"{path.parent}: cannot be made ({error.strerror}).") from error
    check_new(path)
    write_new(path, text)


def _taken(path: Path) -> ProfileError:
    return ProfileError(f"{path}: exists and is not overwritten; name another file.")


def _line_indices(lines: Sequence[str]) -> dict[str, int]:
    """Return the number of the line on which each section and each key of a profile stands.

    A key that stands in a comment only has the comment's place.
    """
    indices: dict[str, int] = {}
    shown: dict[str, int] = {}
    section = ""
    for index, line in enumerate(lines):
        if title := re.match(r"\[([^\]]+)\]", line):
            indices[title[1]] = index
            section = title[1] + "."
        elif key := re.match(r"(\w+)\s*=", line):
            indices[section + key[1]] = index
        elif (key := re.match(r"# (\w+) = ", line)) and section + key[1] in keys():
            shown[section + key[1]] = index
    return shown | indices


def _comment(text: str) -> list[str]:
    """Return a text as lines of comment."""
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")


def _line(setting: Setting) -> str:
    name = setting.key.rpartition(".")[2]
    value = setting.value
    # What JSON makes of texts and truth, TOML reads.
    shown = json.dumps(value, ensure_ascii=False)
    if not is_number(keys()[setting.key]):
        return f"{name} = {shown}"
    if setting.source == UNKNOWN:
        return f'{name} = {{ source = "{UNKNOWN}" }}'
    if setting.hexadecimal and isinstance(value, int):
        shown = f"0x{value:08X}"
    return f'{name} = {{ value = {shown}, source = "{setting.source}" }}'
