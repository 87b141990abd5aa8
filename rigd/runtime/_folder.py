"""Folder of this user's sockets, locks and addresses; it does not survive a restart."""

import contextlib
import itertools
import os
import stat
import tempfile
from pathlib import Path


def runtime_folder() -> Path:
    """Return the folder for sockets and addresses: of this user, gone after a restart."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    if base and Path(base).is_dir():
        return Path(base) / "rigd"
    return _own_folder(Path(tempfile.gettempdir()) / f"rigd-{os.getuid()}")


def _own_folder(path: Path) -> Path:
    """Make a folder where everybody may; a name that somebody else took is passed over."""
    for number in itertools.count(1):
        with contextlib.suppress(FileExistsError):
            path.mkdir(mode=0o700)
        status = path.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid():
            if status.st_mode & 0o077:
                path.chmod(0o700)
            return path
        path = path.with_name(f"rigd-{os.getuid()}-{number}")
    raise AssertionError("never reached")
