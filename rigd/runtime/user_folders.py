"""Folders of a user for configuration and for caches, as in the XDG base directory specification.

References
----------
https://specifications.freedesktop.org/basedir-spec/
"""

import os
from pathlib import Path


def config_folder() -> Path | None:
    """Return the user's folder for configuration, or None if the user has no home folder.

    The folder need not exist.
    """
    return _user_folder("XDG_CONFIG_HOME", ".config")


def cache_folder() -> Path | None:
    """Return the user's folder for files that may be deleted at any time; None without a home.

    The folder need not exist.
    """
    return _user_folder("XDG_CACHE_HOME", ".cache")


def _user_folder(variable_name: str, default_name: str) -> Path | None:
    """Return the folder ``rigd`` in the folder that an environment variable names."""
    base_folder = Path(os.environ.get(variable_name, ""))
    if not base_folder.is_absolute():  # the XDG specification ignores relative paths
        try:
            base_folder = Path.home() / default_name
        except RuntimeError:  # for example in a container, with an unknown user id
            return None
    return base_folder / "rigd"
