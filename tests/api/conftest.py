"""Two short sessions of the simulated rig, laid out as docs/python_api.md has them."""

import shutil

import pytest


@pytest.fixture(scope="session")
def workspace(short_chirps, tmp_path_factory):
    """Folder with ``session.mcap`` and ``sessions/``."""
    folder = tmp_path_factory.mktemp("api")
    (folder / "sessions").mkdir()
    for path in short_chirps:
        shutil.copy(path, folder / "sessions")
    shutil.copy(short_chirps[0], folder / "session.mcap")
    return folder
