"""Profiles with other values than a shipped one."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from rigd.profile import load_profile

Value = bool | float | str | Sequence[float | str]

_LINE = re.compile(r'(\w+)( *= *)(\{ value = )?(.*?)(, source = "\w+" \})?')


def write_profile(
    folder: Path, values: Mapping[str, Value] | None = None, *, base: str = "sim"
) -> Path:
    """Write a profile that differs from another one.

    Parameters
    ----------
    folder : Path
        Where the file goes, under the profile's name.
    values : mapping of str to value, optional
        Other values by ``section.key``, in the unit of the key; ``name`` is the profile's own. A
        key that the base does not have is added to its section.
    base : str
        Name or path of the profile to start from.

    Returns
    -------
    Path
        For :func:`rigd.profile.load_profile` and for ``--profile``.

    Raises
    ------
    ValueError
        If the base does not have a section.

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
    left = dict(values or {})
    name = str(left.get("name", load_profile(base).name))
    lines: list[str] = []
    section = ""
    for line in load_profile(base).text.splitlines():
        if line.startswith("["):
            lines += _added(section, left)
            section = line.strip("[] ") + "."
        match = _LINE.fullmatch(line)
        if match and (key := section + match[1]) in left:
            text = json.dumps(left.pop(key), ensure_ascii=False)
            lines.append("".join((match[1], match[2], match[3] or "", text, match[5] or "")))
        else:
            lines.append(line)
    lines += _added(section, left)
    if left:
        raise ValueError(f"{base} has no section for {', '.join(left)}")
    path = folder / f"{name}.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _added(section: str, left: dict[str, Value]) -> list[str]:
    """Lines for the keys of a section that the base does not have; they are taken from `left`."""
    new = [key for key in left if section and key.rpartition(".")[0] + "." == section]
    return [f"{key.removeprefix(section)} = {_entry(left.pop(key))}" for key in new]


def _entry(value: Value) -> str:
    text = json.dumps(value, ensure_ascii=False)
    parts = value if isinstance(value, Sequence) else (value,)
    if any(isinstance(part, bool | str) for part in parts):
        return text
    return f'{{ value = {text}, source = "assumed" }}'
