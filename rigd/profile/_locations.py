"""Search for profile and specimen files: working folder, user's own folder, shipped files."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

from rigd.runtime.user_folders import config_folder

WORKING_FOLDER: Final = Path("hw_profiles")
"""Folder of profiles, relative to the working folder."""
SPECIMEN_FOLDER: Final = Path("specimens")
"""Folder of specimen files, relative to the working folder."""
_PACKAGE_FOLDER: Final = Path(__file__).resolve().parent
"""Folder of this package."""
_WHEEL_PROFILE_FOLDER: Final = _PACKAGE_FOLDER / "shipped"
"""Folder of the project's profiles in an installed wheel (see pyproject.toml)."""
_CHECKOUT_PROFILE_FOLDER: Final = _PACKAGE_FOLDER.parents[1] / "hw_profiles"
"""Folder of the project's profiles in a checkout of the source tree."""


class ProfileOrigin(StrEnum):
    """Folder in which a profile file was found, in the search order."""

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
        Path of the file.
    origin
        Folder in which the file was found.
    """

    name: str
    path: Path
    origin: ProfileOrigin


def profile_files() -> dict[str, list[ProfileFile]]:
    """Return all profile files by their names, in alphabetical order.

    If several files have the same name, the first one is used and hides the others.
    """
    files_by_name: dict[str, list[ProfileFile]] = {}
    for origin, search_folder in _search_folders():
        for path in search_folder.glob("*.toml"):
            files_by_name.setdefault(path.stem, []).append(ProfileFile(path.stem, path, origin))
    return dict(sorted(files_by_name.items()))


def specimen_files() -> dict[str, Path]:
    """Return the paths of all specimen files by their names, in alphabetical order.

    Files in ``specimens`` of the working folder precede those of the user's own folder
    (``$XDG_CONFIG_HOME/rigd/specimens``).
    """
    profile_folder = user_folder()
    paths_by_name: dict[str, Path] = {}
    for specimen_folder in (
        SPECIMEN_FOLDER,
        *([profile_folder.with_name("specimens")] if profile_folder else []),
    ):
        for specimen_path in specimen_folder.glob("*.toml"):
            paths_by_name.setdefault(specimen_path.stem, specimen_path)
    return dict(sorted(paths_by_name.items()))


def user_folder() -> Path | None:
    """Return the user's own folder for profiles, or None if the user has no home folder.

    The folder need not exist.
    """
    folder = config_folder()
    return None if folder is None else folder / "profiles"


def _search_folders() -> Iterator[tuple[ProfileOrigin, Path]]:
    """Yield the folders that are searched for profiles, in the search order."""
    shipped_folder = (
        _WHEEL_PROFILE_FOLDER if _WHEEL_PROFILE_FOLDER.is_dir() else _CHECKOUT_PROFILE_FOLDER
    )
    try:
        is_checkout_folder = WORKING_FOLDER.samefile(shipped_folder)
    except OSError:  # usually the folder does not exist
        is_checkout_folder = False
    if not is_checkout_folder:
        yield ProfileOrigin.HERE, WORKING_FOLDER
    if own_folder := user_folder():
        yield ProfileOrigin.USER, own_folder
    yield ProfileOrigin.SHIPPED, shipped_folder
