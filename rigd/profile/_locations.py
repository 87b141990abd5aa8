"""Places of named profiles and specimens: the working folder, the user's own, those shipped."""

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
"""Where the build puts the project's profiles (see pyproject.toml)."""
_IN_CHECKOUT: Final = _PACKAGE.parents[1] / "hw_profiles"


class Origin(StrEnum):
    """Where a profile comes from, in the order in which a name is looked for."""

    HERE = "working folder"
    USER = "per-user folder"
    SHIPPED = "shipped"


@dataclass(frozen=True, slots=True)
class ProfileFile:
    """A file that a name may stand for.

    Attributes
    ----------
    name
        What ``--profile`` takes: the file's name without ``.toml``.
    path
        The file.
    origin
        Where it comes from.
    """

    name: str
    path: Path
    origin: Origin


def profile_files() -> dict[str, list[ProfileFile]]:
    """Return the files of each name, names in alphabetical order.

    The first file of a name is the one that is used; it hides the others.
    """
    found: dict[str, list[ProfileFile]] = {}
    for origin, folder in _folders():
        for path in folder.glob("*.toml"):
            found.setdefault(path.stem, []).append(ProfileFile(path.stem, path, origin))
    return dict(sorted(found.items()))


def specimen_files() -> dict[str, Path]:
    """Return the file of each specimen by name, in alphabetical order.

    It is that of ``specimens`` in the working folder, or else that of the user's own folder
    (``$XDG_CONFIG_HOME/rigd/specimens``).
    """
    own = user_folder()
    found: dict[str, Path] = {}
    for folder in (SPECIMENS_HERE, *([own.with_name("specimens")] if own else [])):
        for path in folder.glob("*.toml"):
            found.setdefault(path.stem, path)
    return dict(sorted(found.items()))


def user_folder() -> Path | None:
    """Return the user's own folder for profiles, there or not; None where no user has a home."""
    base = Path(os.environ.get("XDG_CONFIG_HOME", ""))
    if not base.is_absolute():  # the XDG specification has such a value ignored
        try:
            base = Path.home() / ".config"
        except RuntimeError:  # in a container, say, under a number that no user has
            return None
    return base / "rigd" / "profiles"


def _folders() -> Iterator[tuple[Origin, Path]]:
    shipped = _IN_WHEEL if _IN_WHEEL.is_dir() else _IN_CHECKOUT
    try:
        in_checkout = WORKING_FOLDER.samefile(shipped)
    except OSError:  # mostly, there is none here
        in_checkout = False
    if not in_checkout:
        yield Origin.HERE, WORKING_FOLDER
    if user := user_folder():
        yield Origin.USER, user
    yield Origin.SHIPPED, shipped
