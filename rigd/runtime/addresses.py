"""Addresses of the processes of this user, and detection of dead processes.

A process has a Unix socket or a small JSON file in the runtime folder. A socket of a dead process
is recognised because nobody listens (`answers`), a file because the process is gone (`started_at`).
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
"""Parent of the runtime folders of all logged-in users."""
_FALLBACK: Final = re.compile(r"rigd-(\d{1,10})(?:-(\d{1,9}))?")
_PROBE_S: Final = 1.0
_MOST_BYTES: Final = 65_536


# Folder


class UnsafeFolderError(FailureError):
    """Other users can modify the runtime folder; the message names the remedy."""


def runtime_folder() -> Path:
    """Return this user's folder for sockets and addresses, which a restart removes.

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
    """Return why other users can replace files in a runtime folder; empty if they cannot.

    Parameters
    ----------
    folder
        The folder. A folder that does not exist is safe if its parent is.
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
            writable = 0  # in a sticky folder users can remove only their own files
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
    """Return all possible runtime folders of a user, for any environment of the processes.

    Parameters
    ----------
    uid
        User id; None: any user.

    Returns
    -------
    list of Path
        Folders of this environment, of the login session, and in the folder for temporary files.
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
    """Return the folders made by `_own_folder` for a user, or for all, by increasing number.

    A folder of such a name that belongs to another user is omitted.
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
    """Return the user's folder in the common folder; create it if there is none.

    A name taken by another user is skipped. The folder is found again even after the other user has
    released the name.
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
    """Return a rig's name for file names, with ``-`` for all but letters and digits."""
    return "".join(c if c.isalnum() else "-" for c in rig).strip("-")


def address_files(pattern: str, *folders: Path) -> list[Path]:
    """Return the files of a pattern in some folders, sorted by path.

    Parameters
    ----------
    pattern
        Pattern of file names, as of :meth:`pathlib.Path.glob`.
    *folders
        Folders to search; unreadable ones are skipped. Default: the user's runtime folder.
    """
    found: list[Path] = []
    for folder in folders or (runtime_folder(),):
        with suppress(OSError):
            found += folder.glob(pattern)
    return sorted(found)


def announce(path: Path, address: Mapping[str, object]) -> None:
    """Write an address to a file that only this user can read.

    The file is replaced atomically. The folder is created if necessary.

    Parameters
    ----------
    path
        File to write; an existing one is replaced.
    address
        Values that JSON can represent, by name.

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
    """Return an announced address; empty if there is no valid file."""
    try:
        # The file may be of any kind, even one that blocks on opening.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        with os.fdopen(descriptor, "rb") as file:
            found = json.loads(file.read(_MOST_BYTES))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def answers(path: str | Path) -> bool:
    """Return whether a process listens on a Unix socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(_PROBE_S)
        try:
            probe.connect(os.fspath(path))
        except (BlockingIOError, TimeoutError):
            return True  # its queue is full
        except (OSError, ValueError):  # ValueError if it is not a valid path
            return False
    return True


def started_at(pid: int) -> int | None:
    """Return the start time of a process in clock ticks after that of the computer.

    Process id and start time together are unique. None if the process does not run.
    """
    try:
        text = Path(f"/proc/{pid}/stat").read_text("utf-8")
    except OSError:
        return None
    state, *rest = text.rpartition(")")[2].split()  # the name before may contain any character
    return None if state in "ZX" else int(rest[18])
