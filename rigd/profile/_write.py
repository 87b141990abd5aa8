"""Writing of a profile from another profile's text, with new values, sources and comments."""

import json
import re
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from rigd.profile._load import ProfileError, profile_from_text
from rigd.profile._schema import UNKNOWN_SOURCE, Profile, is_number_type, key_types

SettingValue = bool | int | float | str | tuple[str, ...]
"""Type of the value of a profile's key."""

_COMMENT_WIDTH = 100
"""Largest length of a comment's lines, in characters."""

_NAMING_LINE_PATTERN = re.compile(r"\[([^\]]+)\]|(\w+)\s*=|# (\w+) = ")
"""Pattern for the beginning of a line that names a section, a key, or a key in a comment."""


@dataclass(frozen=True, slots=True)
class Setting:
    """Change of a profile: key, new value, its source, and a comment."""

    profile_key: str
    """Dotted key, such as ``cia402.node_id``."""
    new_value: SettingValue
    """New value of the key."""
    value_source: str = "assumed"
    """Source of the value if it is a number; if the source is "unknown", no value is written."""
    comment: str = ""
    """Text of the comment above the key, or an empty string for no comment."""
    is_hexadecimal: bool = False
    """Whether an integer is written as a hexadecimal number."""
    is_commented_out: bool = False
    """Whether the setting is only written as a comment, for a later decision."""


def with_settings(profile_text: str, settings: Iterable[Setting]) -> str:
    """Return the text of a valid profile after the values of some keys are replaced.

    Other comments and values are unchanged. A key that the profile does not have replaces the
    comment that shows it, or becomes the first key of its section; without the section it raises
    `KeyError`.
    """
    text_lines = profile_text.splitlines()
    for new_setting in settings:
        line_index_by_key = _line_index_by_key(text_lines)
        setting_line = _setting_line(new_setting)
        new_lines = [
            *_comment_lines(new_setting.comment),
            f"# {setting_line}" if new_setting.is_commented_out else setting_line,
        ]
        if new_setting.profile_key in line_index_by_key:
            line_position = line_index_by_key[new_setting.profile_key]
            text_lines[line_position : line_position + 1] = new_lines
        else:
            line_position = line_index_by_key[new_setting.profile_key.rpartition(".")[0]] + 1
            text_lines[line_position:line_position] = new_lines
    return "\n".join(text_lines) + "\n"


def with_head(profile_text: str, head_lines: Sequence[str]) -> str:
    """Return the text of a profile after the comments before its first key are replaced.

    `head_lines` contains the lines of the new comments.
    """
    text_lines = profile_text.splitlines()
    first_key_line_index = next(
        i for i, text_line in enumerate(text_lines) if text_line and not text_line.startswith("#")
    )
    return (
        "\n".join(
            [
                *(
                    head_line
                    for text_line in head_lines
                    for head_line in _comment_lines(text_line) or ["#"]
                ),
                "",
                *text_lines[first_key_line_index:],
            ]
        )
        + "\n"
    )


def check_new(path: Path) -> None:
    """Raise ProfileError if a new profile cannot be written to a path, or has an invalid name.

    Raises
    ------
    ProfileError
        If the file exists, its folder does not exist, or the name is invalid for a profile.
    """
    if path.suffix != ".toml":
        raise ProfileError(f"{path}: the name of a profile ends in .toml.")
    if path.exists() or path.is_symlink():
        raise _exists_error(path)
    if not path.parent.is_dir():
        raise ProfileError(f"{path}: there is no folder {path.parent}; create it first.")


def write_new(path: Path, file_text: str) -> None:
    """Write the text of a profile to a new file.

    Parameters
    ----------
    path
        Path of the new file.
    file_text
        Text of the file.

    Raises
    ------
    ProfileError
        If the file exists or cannot be written.
    """
    try:
        with path.open("x", encoding="utf-8") as profile_file:
            profile_file.write(file_text)
    except FileExistsError as error:
        raise _exists_error(path) from error
    except OSError as error:
        raise ProfileError(f"{path}: cannot be written ({error.strerror}).") from error


def copy_profile(profile: Profile, path: Path, new_name: str | None = None) -> None:
    """Write a copy of a profile to a new file; create its folder if necessary.

    Parameters
    ----------
    profile
        Profile to copy, with all comments. The path of the drive's EDS file becomes absolute.
    path
        Path of the copy.
    new_name
        Name of the rig in the copy, or None if it is unchanged.

    Raises
    ------
    ProfileError
        If the file exists or cannot be written, or the name is invalid for a profile.
    """
    changed_settings = [] if new_name is None else [Setting("name", new_name)]
    drive_settings = profile.rig.cia402
    if drive_settings is not None and drive_settings.eds:
        changed_settings.append(Setting("cia402.eds", drive_settings.eds))
    profile_text = profile.text
    if changed_settings:
        try:
            profile_text = with_settings(profile_text, changed_settings)
        except KeyError:
            raise ProfileError(
                f"{profile.path}: is not laid out as the shipped profiles are, one key a line "
                "under its [section], so that no changed copy can be made; copy the file and edit "
                "it."
            ) from None
        profile_from_text(profile_text, path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ProfileError(f"{path.parent}: cannot be made ({error.strerror}).") from error
    check_new(path)
    write_new(path, profile_text)


def _exists_error(path: Path) -> ProfileError:
    """Return the error to raise if a new profile's file exists already."""
    return ProfileError(f"{path}: exists and is not overwritten; name another file.")


def _line_index_by_key(text_lines: Sequence[str]) -> dict[str, int]:
    """Return the index of the line of each section and each key of a profile.

    If a key occurs only in a comment, it is the index of the comment.
    """
    index_by_key: dict[str, int] = {}
    comment_index_by_key: dict[str, int] = {}
    section_prefix = ""
    for line_index, text_line in enumerate(text_lines):
        if not (found := _NAMING_LINE_PATTERN.match(text_line)):
            continue
        title, key_name, commented_key = found.groups()
        if title:
            index_by_key[title] = line_index
            section_prefix = f"{title}."
        elif key_name:
            index_by_key[section_prefix + key_name] = line_index
        elif section_prefix + commented_key in key_types():
            comment_index_by_key[section_prefix + commented_key] = line_index
    return comment_index_by_key | index_by_key


def _comment_lines(comment: str) -> list[str]:
    """Return a text as lines of a profile's comment, wrapped and each with "# "."""
    return textwrap.wrap(comment, _COMMENT_WIDTH, initial_indent="# ", subsequent_indent="# ")


def _setting_line(setting: Setting) -> str:
    """Return the line of a profile for a setting."""
    key_name = setting.profile_key.rpartition(".")[2]
    setting_value = setting.new_value
    # Texts and booleans have the same syntax in JSON and TOML.
    value_text = json.dumps(setting_value, ensure_ascii=False)
    if not is_number_type(key_types()[setting.profile_key]):
        return f"{key_name} = {value_text}"
    if setting.value_source == UNKNOWN_SOURCE:
        return f'{key_name} = {{ source = "{UNKNOWN_SOURCE}" }}'
    if setting.is_hexadecimal and isinstance(setting_value, int):
        value_text = f"0x{setting_value:08X}"
    return f'{key_name} = {{ value = {value_text}, source = "{setting.value_source}" }}'
