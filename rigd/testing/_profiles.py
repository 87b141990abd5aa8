"""Builder of profiles that differ from a shipped one."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from rigd.profile import load_profile

ProfileValue = bool | float | str | Sequence[float | str]
"""Value of a key in a profile."""

_PROFILE_LINE_PATTERN = re.compile(r'(\w+)( *= *)(\{ value = )?(.*?)(, source = "\w+" \})?')
"""Pattern of a profile's line: key, value and source."""


def write_profile(
    folder: Path, new_values: Mapping[str, ProfileValue] | None = None, *, base_profile: str = "sim"
) -> Path:
    """Write a profile that differs from another one in some values, and return its path.

    Parameters
    ----------
    folder : Path
        Folder for the file, which gets the name of the profile.
    new_values : mapping of str to value, optional
        New values by ``section.key``, in the unit of the key; ``name`` is the profile's name.
        A key that the base does not have is added to its section.
    base_profile : str
        Name or path of the profile whose other values are used.

    Returns
    -------
    Path
        Path of the profile, for :func:`rigd.profile.load_profile` and for ``--profile``.

    Raises
    ------
    ValueError
        If the base does not have a section of `new_values`.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from rigd.profile import load_profile
    >>> from rigd.testing import write_profile
    >>> with TemporaryDirectory() as folder:
    ...     path = write_profile(Path(folder), {"name": "stiff", "control.pole_rad_s": 60.0})
    ...     profile = load_profile(path)
    >>> profile.name, profile.control.pole_rad_s
    ('stiff', 60.0)
    """
    remaining_values = dict(new_values or {})
    profile_name = str(remaining_values.get("name", load_profile(base_profile).name))
    profile_lines: list[str] = []
    section_prefix = ""
    for profile_line in load_profile(base_profile).text.splitlines():
        if profile_line.startswith("["):
            profile_lines += _added_lines(section_prefix, remaining_values)
            section_prefix = profile_line.strip("[] ") + "."
        line_match = _PROFILE_LINE_PATTERN.fullmatch(profile_line)
        if line_match and (key := section_prefix + line_match[1]) in remaining_values:
            value_text = json.dumps(remaining_values.pop(key), ensure_ascii=False)
            profile_lines.append(
                "".join(
                    (
                        line_match[1],
                        line_match[2],
                        line_match[3] or "",
                        value_text,
                        line_match[5] or "",
                    )
                )
            )
        else:
            profile_lines.append(profile_line)
    profile_lines += _added_lines(section_prefix, remaining_values)
    if remaining_values:
        raise ValueError(f"{base_profile} has no section for {', '.join(remaining_values)}")
    profile_path = folder / f"{profile_name}.toml"
    profile_path.write_text("\n".join(profile_lines) + "\n", encoding="utf-8")
    return profile_path


def _added_lines(section_name: str, remaining_values: dict[str, ProfileValue]) -> list[str]:
    """Return lines for a section's keys that the base lacks.

    The keys are removed from `remaining_values`.
    """
    new_keys = [
        key
        for key in remaining_values
        if section_name and key.rpartition(".")[0] + "." == section_name
    ]
    return [
        f"{key.removeprefix(section_name)} = {_value_text(remaining_values.pop(key))}"
        for key in new_keys
    ]


def _value_text(profile_value: ProfileValue) -> str:
    """Return a value as it is written in a profile."""
    value_json = json.dumps(profile_value, ensure_ascii=False)
    value_items = profile_value if isinstance(profile_value, Sequence) else (profile_value,)
    if any(isinstance(value_item, bool | str) for value_item in value_items):
        return value_json
    return f'{{ value = {value_json}, source = "assumed" }}'
