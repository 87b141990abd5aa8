"""Writing of a profile from the text of another, with new values, sources and comments."""

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
    """New value of a key of a profile."""

    key: str
    """Dotted key, such as ``cia402.node_id``."""
    value: SettingValue
    source: str = "assumed"
    """Source of a number, as in a profile. With "unknown" no value is written."""
    reason: str = ""
    """Text of a comment above the value."""
    hexadecimal: bool = False
    commented: bool = False
    """Write the setting as a comment only, for a later decision; the key has its default."""


def with_settings(text: str, settings: Iterable[Setting]) -> str:
    """Return the text of a profile with new values and unchanged comments.

    Parameters
    ----------
    text
        Text of a valid profile.
    settings
        New values. A missing key replaces the comment that shows it, or becomes the first key of
        its section.

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
    """Raise if a new profile could not be written to a path, or not be found by its name.

    Raises
    ------
    ProfileError
        If the file exists, its folder does not exist, or the name is invalid for a profile.
    """
    if path.suffix != ".toml":
        raise ProfileError(f"{path}: the name of a profile ends in .toml.")
    if path.exists() or path.is_symlink():
        raise _taken(path)
    if not path.parent.is_dir():
        raise ProfileError(f"{path}: there is no folder {path.parent}; create it first.")


def write_new(path: Path, text: str) -> None:
    """Write a new file.

    Parameters
    ----------
    path
        The new file.
    text
        Text of the file.

    Raises
    ------
    ProfileError
        If the file exists or cannot be written.
    """
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise _taken(path) from error
    except OSError as error:
        raise ProfileError(f"{path}: cannot be written ({error.strerror}).") from error


def copy_profile(profile: Profile, path: Path, name: str | None = None) -> None:
    """Write a copy of a profile to a new file; create its folder if necessary.

    Parameters
    ----------
    profile
        Profile to copy, with all comments. The path of the drive's EDS file becomes absolute.
    path
        Path of the copy.
    name
        Name of the rig in the copy; None: unchanged.

    Raises
    ------
    ProfileError
        If the file exists or cannot be written, or the name is invalid for a profile.
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
    """Return the line index of each section and key of a profile.

    A key that occurs only in a comment has the index of the comment.
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
    """Return a text as comment lines."""
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")


def _line(setting: Setting) -> str:
    name = setting.key.rpartition(".")[2]
    value = setting.value
    # Texts and booleans have the same syntax in JSON and TOML.
    shown = json.dumps(value, ensure_ascii=False)
    if not is_number(keys()[setting.key]):
        return f"{name} = {shown}"
    if setting.source == UNKNOWN:
        return f'{name} = {{ source = "{UNKNOWN}" }}'
    if setting.hexadecimal and isinstance(value, int):
        shown = f"0x{value:08X}"
    return f'{name} = {{ value = {shown}, source = "{setting.source}" }}'
