"""Builder of profiles that differ from a shipped one."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from rigd.profile import load_profile

Value = bool | float | str | Sequence[float | str]
"""Value of a key in a profile."""

_LINE_PATTERN = re.compile(r'(\w+)( *= *)(\{ value = )?(.*?)(, source = "\w+" \})?')
"""Pattern of a profile's line: key, value and source."""


def write_profile(
    folder: Path, values: Mapping[str, Value] | None = None, *, base: str = "sim"
) -> Path:
    """Write a profile that differs from another one in some values, and return its path.

    Parameters
    ----------
    folder : Path
        Folder for the file, which gets the name of the profile.
    values : mapping of str to value, optional
        Different values by ``section.key``, in the unit of the key; ``name`` is the profile's name.
        A key that the base does not have is added to its section.
    base : str
        Name or path of the profile whose other values are used.

    Returns
    -------
    Path
        Path of the profile, for :func:`rigd.profile.load_profile` and for ``--profile``.

    Raises
    ------
    ValueError
        If the base does not have a section of `values`.

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
    remaining_values = dict(values or {})
    name = str(remaining_values.get("name", load_profile(base).name))
    lines: list[str] = []
    section = ""
    for line in load_profile(base).text.splitlines():
        if line.startswith("["):
            lines += _added_lines(section, remaining_values)
            section = line.strip("[] ") + "."
        match = _LINE_PATTERN.fullmatch(line)
        if match and (key := section + match[1]) in remaining_values:
            text = json.dumps(remaining_values.pop(key), ensure_ascii=False)
            lines.append("".join((match[1], match[2], match[3] or "", text, match[5] or "")))
        else:
            lines.append(line)
    lines += _added_lines(section, remaining_values)
    if remaining_values:
        raise ValueError(f"{base} has no section for {', '.join(remaining_values)}")
    path = folder / f"{name}.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _added_lines(section: str, remaining_values: dict[str, Value]) -> list[str]:
    """Return lines for a section's keys that the base lacks.

    The keys are removed from `remaining_values`.
    """
    new_keys = [
        key for key in remaining_values if section and key.rpartition(".")[0] + "." == section
    ]
    return [
        f"{key.removeprefix(section)} = {_value_text(remaining_values.pop(key))}"
        for key in new_keys
    ]


def _value_text(value: Value) -> str:
    """Return a value as it is written in a profile."""
    text = json.dumps(value, ensure_ascii=False)
    items = value if isinstance(value, Sequence) else (value,)
    if any(isinstance(item, bool | str) for item in items):
        return text
    return f'{{ value = {text}, source = "assumed" }}'
