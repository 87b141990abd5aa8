"""Addresses: where a process of this user is found, and whether it is still there.

A process is found in the runtime folder: by a Unix socket on which it listens, or by a small JSON
file that it announces. What a dead process left is recognised by nobody listening (`answers`), or
by that process being gone (`started_at`).
"""

import itertools
import json
import os
import socket
import stat
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

_PROBE_S: Final = 1.0
_MOST_BYTES: Final = 65_536


# Folder


def runtime_folder() -> Path:
    """Return the folder for sockets and addresses: of this user, gone after a restart."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    if base and Path(base).is_dir():
        return Path(base) / "rigd"
    return _own_folder(Path(tempfile.gettempdir()) / f"rigd-{os.getuid()}")


def _own_folder(path: Path) -> Path:
    """Make a folder where everybody may; a name that somebody else took is passed over."""
    for number in itertools.count(1):
        with suppress(FileExistsError):
            path.mkdir(mode=0o700)
        status = path.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid():
            if status.st_mode & 0o077:
                path.chmod(0o700)
            return path
        path = path.with_name(f"rigd-{os.getuid()}-{number}")
    raise AssertionError("never reached")


# Files and sockets in it


def file_name(rig: str) -> str:
    """Return a rig's name as file names have it: all but letters and digits as ``-``."""
    return "".join(c if c.isalnum() else "-" for c in rig).strip("-")


def address_files(pattern: str, *folders: Path) -> list[Path]:
    """Return the files of a pattern in some folders, sorted by path.

    Parameters
    ----------
    pattern
        Pattern of file names, as of :meth:`pathlib.Path.glob`.
    *folders
        Folders to search; one that cannot be read is left out. Without any, the user's runtime
        folder is searched.
    """
    found: list[Path] = []
    for folder in folders or (runtime_folder(),):
        with suppress(OSError):
            found += folder.glob(pattern)
    return sorted(found)


def announce(path: Path, address: Mapping[str, object]) -> None:
    """Write down an address for this user only, until it is withdrawn.

    A reader meanwhile gets the old or the new one. The folder is created.

    Parameters
    ----------
    path
        File to write; an older one is replaced.
    address
        What JSON can represent, by name.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    fresh = path.with_suffix(f".{os.getpid()}")
    fresh.unlink(missing_ok=True)
    fresh.touch(mode=0o600)
    fresh.write_text(json.dumps(address), encoding="utf-8")
    fresh.replace(path)


def read_address(path: Path) -> dict[str, Any]:
    """Return what was announced; empty if nothing was, or something else lies there."""
    try:
        # Anything may lie there, even what blocks the process that opens it.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        with os.fdopen(descriptor, "rb") as file:
            found = json.loads(file.read(_MOST_BYTES))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def answers(path: str | Path) -> bool:
    """Whether a process listens on a Unix socket; on that of a dead process none does."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(_PROBE_S)
        try:
            probe.connect(os.fspath(path))
        except (BlockingIOError, TimeoutError):
            return True  # its queue is full
        except (OSError, ValueError):  # the latter where it is not a path
            return False
    return True


def started_at(pid: int) -> int | None:
    """Return when a process was started, in clock ticks since the computer was.

    No other process has both numbers. None if it does not run.
    """
    try:
        text = Path(f"/proc/{pid}/stat").read_text("utf-8")
    except OSError:
        return None
    state, *rest = text.rpartition(")")[2].split()  # the name before may hold anything
    return None if state in "ZX" else int(rest[18])
