"""Locations of profiles and specimens: working folder, user's own folder, shipped files."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

WORKING_FOLDER: Final = Path("hw_profiles")
SPECIMENS_HERE: Final = Path("specimens")
_PACKAGE: Final = Path(__file__).resolve().parent
_IN_WHEEL: Final = _PACKAGE / "shipped"
"""Folder of the project's profiles in a wheel (see pyproject.toml)."""
_IN_CHECKOUT: Final = _PACKAGE.parents[1] / "hw_profiles"


class Origin(StrEnum):
    """Origin of a profile, in the search order."""

    HERE = "working folder"
    USER = "per-user folder"
    SHIPPED = "shipped"


@dataclass(frozen=True, slots=True)
class ProfileFile:
    """Profile file found by its name.

    Attributes
    ----------
    name
        Value of ``--profile``: the file name without ``.toml``.
    path
        The file.
    origin
        Origin of the file.
    """

    name: str
    path: Path
    origin: Origin


def profile_files() -> dict[str, list[ProfileFile]]:
    """Return the files by name, in alphabetical order.

    The first file of a name is used and hides the others.
    """
    found: dict[str, list[ProfileFile]] = {}
    for origin, folder in _folders():
        for path in folder.glob("*.toml"):
            found.setdefault(path.stem, []).append(ProfileFile(path.stem, path, origin))
    return dict(sorted(found.items()))


def specimen_files() -> dict[str, Path]:
    """Return the specimen files by name, in alphabetical order.

    Files in ``specimens`` of the working folder precede those of the user's own folder
    (``$XDG_CONFIG_HOME/rigd/specimens``).
    """
    own = user_folder()
    found: dict[str, Path] = {}
    for folder in (SPECIMENS_HERE, *([own.with_name("specimens")] if own else [])):
        for path in folder.glob("*.toml"):
            found.setdefault(path.stem, path)
    return dict(sorted(found.items()))


def user_folder() -> Path | None:
    """Return the user's own folder for profiles, existing or not; None without a home folder."""
    base = Path(os.environ.get("XDG_CONFIG_HOME", ""))
    if not base.is_absolute():  # the XDG specification ignores relative paths
        try:
            base = Path.home() / ".config"
        except RuntimeError:  # for example in a container, with an unknown user id
            return None
    return base / "rigd" / "profiles"


def _folders() -> Iterator[tuple[Origin, Path]]:
    shipped = _IN_WHEEL if _IN_WHEEL.is_dir() else _IN_CHECKOUT
    try:
        in_checkout = WORKING_FOLDER.samefile(shipped)
    except OSError:  # usually the folder does not exist
        in_checkout = False
    if not in_checkout:
        yield Origin.HERE, WORKING_FOLDER
    if user := user_folder():
        yield Origin.USER, user
    yield Origin.SHIPPED, shipped
