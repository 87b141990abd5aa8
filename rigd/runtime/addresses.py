"""Addresses: where a process of this user is found, and whether it is still there.

A process is found in the runtime folder: by a Unix socket on which it listens, or by a small JSON
file that it announces. What a dead process left is recognised by nobody listening (`answers`), or
by that process being gone (`started_at`).
"""

import itertools
import json
import os
import re
import socket
import stat
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from rigd.errors import FailureError

_LOGINS: Final = Path("/run/user")
"""Holds the runtime folder of each user who is logged in."""
_FALLBACK: Final = re.compile(r"rigd-(\d{1,10})(?:-(\d{1,9}))?")
_PROBE_S: Final = 1.0
_MOST_BYTES: Final = 65_536


# Folder


class UnsafeFolderError(FailureError):
    """Other users can change what is in the runtime folder; the message names the remedy."""


def runtime_folder() -> Path:
    """Return the folder for sockets and addresses: of this user, gone after a restart.

    Raises
    ------
    UnsafeFolderError
        If other users can write to it.
    """
    base = os.environ.get("XDG_RUNTIME_DIR")
    if base and Path(base).is_dir():
        folder = Path(base) / "rigd"
    else:
        folder = _own_folder(Path(tempfile.gettempdir()))
    fault = folder_fault(folder)
    if fault:
        raise UnsafeFolderError(fault)
    return folder


def folder_fault(folder: Path, *, shared: bool = False) -> str:
    """Say why other users can replace what is in a runtime folder; empty if they cannot.

    Parameters
    ----------
    folder
        The folder; one that does not exist is sound if its parent is.
    shared
        The folder may belong to any user, as that of a group does.
    """
    for path in (folder.parent, folder):
        try:
            status = path.stat()
        except OSError:
            continue
        writable = status.st_mode & 0o022
        if path == folder.parent and status.st_mode & stat.S_ISVTX:
            writable = 0  # in a sticky folder a user can remove only what is that user's own
        if writable:
            whom = "every user" if writable & 0o002 else "its group"
            return (
                f"The runtime folder {path} is writable by {whom} (mode "
                f"{stat.S_IMODE(status.st_mode):04o}), who could replace the daemon's socket; run "
                f"chmod go-w {path}, or set XDG_RUNTIME_DIR to a folder that only you can write to."
            )
        owners = (0, os.getuid())
        if path == folder and not shared and os.getuid() and status.st_uid not in owners:
            return (
                f"The runtime folder {path} belongs to another user ({status.st_uid}); set "
                "XDG_RUNTIME_DIR to a folder that is yours."
            )
    return ""


def known_folders(uid: int | None) -> list[Path]:
    """Return where runtime folders of a user are, whatever the environment of its processes.

    Parameters
    ----------
    uid
        Number of the user; None: any user.

    Returns
    -------
    list of Path
        That of this environment, the login session's, and those in the folder for temporary files.
    """
    base = os.environ.get("XDG_RUNTIME_DIR")
    found = [Path(base) / "rigd"] if base else []
    if uid is None:
        with suppress(OSError):
            found += [each / "rigd" for each in _LOGINS.iterdir()]
    else:
        found.append(_LOGINS / str(uid) / "rigd")
    for temporary in {Path(tempfile.gettempdir()), Path("/tmp")}:
        found += _fallback_folders(temporary, uid)
    return sorted(set(found))


def _fallback_folders(base: Path, uid: int | None) -> list[Path]:
    """Return the folders that `_own_folder` has made for a user, or for all, lowest number first.

    A folder of such a name that belongs to another user is left out.
    """
    found = []
    with suppress(OSError), os.scandir(base) as entries:
        for entry in entries:
            match = _FALLBACK.fullmatch(entry.name)
            if match is None or uid not in (None, int(match[1])):
                continue
            with suppress(OSError):
                status = entry.stat(follow_symlinks=False)
                if stat.S_ISDIR(status.st_mode) and status.st_uid == int(match[1]):
                    found.append((int(match[1]), int(match[2] or 0), Path(entry.path)))
    return [path for *_, path in sorted(found)]


def _own_folder(base: Path) -> Path:
    """Return the user's folder among those of all users; make it if there is none.

    A name that another user took is passed over. A folder made while that was so is found again
    after the other user has given the name up.
    """
    uid = os.getuid()
    own = _fallback_folders(base, uid)
    path = own[0] if own else base / f"rigd-{uid}"
    for number in itertools.count(1):
        with suppress(FileExistsError):
            path.mkdir(mode=0o700)
        status = path.lstat()
        if stat.S_ISDIR(status.st_mode) and status.st_uid == uid:
            if status.st_mode & 0o055 and not status.st_mode & 0o022:
                path.chmod(0o700)
            return path
        path = base / f"rigd-{uid}-{number}"
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
