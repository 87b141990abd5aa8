"""Addresses of this user's processes in the runtime folder, and detection of dead processes.

The address of a process is a Unix socket or a small JSON file in the runtime folder. The socket of
a dead process is detected because no process listens (`socket_answers`), and its file because the
process no longer exists (`process_start_ticks`).
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

_LOGIN_FOLDERS: Final = Path("/run/user")
"""Parent of the runtime folders of all logged-in users."""
_FALLBACK_FOLDER_NAME: Final = re.compile(r"rigd-(\d{1,10})(?:-(\d{1,9}))?")
"""Name of a fallback runtime folder in the folder for temporary files: user id and number."""
_CONNECT_TIMEOUT_S: Final = 1.0
"""Maximum time in seconds to connect to a socket."""
_MAX_ADDRESS_BYTES: Final = 65_536
"""Maximum number of bytes that are read of an address file."""


# Folder


class UnsafeFolderError(FailureError):
    """Raised if other users can write to the runtime folder; the message states the remedy."""


def runtime_folder() -> Path:
    """Return this user's folder for sockets and address files, which a reboot removes.

    Raises
    ------
    UnsafeFolderError
        If other users can write to the folder.
    """
    base_folder = os.environ.get("XDG_RUNTIME_DIR")
    if base_folder and Path(base_folder).is_dir():
        folder = Path(base_folder) / "rigd"
    else:
        folder = _own_fallback_folder(Path(tempfile.gettempdir()))
    folder_fault_text = folder_fault(folder)
    if folder_fault_text:
        raise UnsafeFolderError(folder_fault_text)
    return folder


def folder_fault(folder: Path, *, is_shared: bool = False) -> str:
    """Return the reason why other users could replace files in a runtime folder; "" if they cannot.

    Parameters
    ----------
    folder
        Path of the folder. A folder that does not exist is safe if its parent folder is safe.
    is_shared
        Whether the folder may belong to any user, like the folder of a group.
    """
    for path in (folder.parent, folder):
        try:
            status = path.stat()
        except OSError:
            continue
        write_bits = status.st_mode & 0o022
        if path == folder.parent and status.st_mode & stat.S_ISVTX:
            write_bits = 0  # in a sticky folder users can remove only their own files
        if write_bits:
            writer_text = "every user" if write_bits & 0o002 else "its group"
            return (
                f"The runtime folder {path} is writable by {writer_text} (mode "
                f"{stat.S_IMODE(status.st_mode):04o}), who could replace the daemon's socket; run "
                f"chmod go-w {path}, or set XDG_RUNTIME_DIR to a folder that only you can write to."
            )
        trusted_uids = (0, os.getuid())
        if path == folder and not is_shared and os.getuid() and status.st_uid not in trusted_uids:
            return (
                f"The runtime folder {path} belongs to another user ({status.st_uid}); set "
                "XDG_RUNTIME_DIR to a folder that is yours."
            )
    return ""


def known_folders(uid: int | None) -> list[Path]:
    """Return the folders that processes of a user may use as runtime folder.

    Parameters
    ----------
    uid
        User id, or None for all users.

    Returns
    -------
    list of Path
        Runtime folder according to this process's environment, runtime folder of the login session,
        and fallback folders in the folder for temporary files. Some may not exist.
    """
    base_folder = os.environ.get("XDG_RUNTIME_DIR")
    folders = [Path(base_folder) / "rigd"] if base_folder else []
    if uid is None:
        with suppress(OSError):
            folders += [user_folder / "rigd" for user_folder in _LOGIN_FOLDERS.iterdir()]
    else:
        folders.append(_LOGIN_FOLDERS / str(uid) / "rigd")
    for temporary_folder in {Path(tempfile.gettempdir()), Path("/tmp")}:
        folders += _fallback_folders(temporary_folder, uid)
    return sorted(set(folders))


def _fallback_folders(temporary_folder: Path, uid: int | None) -> list[Path]:
    """Return the fallback runtime folders of a user, or of all users if `uid` is None.

    They are sorted by user id and number. A folder that belongs to another user than its name
    states is left out.
    """
    numbered_folders = []
    with suppress(OSError), os.scandir(temporary_folder) as entries:
        for entry in entries:
            name_match = _FALLBACK_FOLDER_NAME.fullmatch(entry.name)
            if name_match is None or uid not in (None, int(name_match[1])):
                continue
            with suppress(OSError):
                folder_status = entry.stat(follow_symlinks=False)
                if stat.S_ISDIR(folder_status.st_mode) and folder_status.st_uid == int(
                    name_match[1]
                ):
                    numbered_folders.append(
                        (int(name_match[1]), int(name_match[2] or 0), Path(entry.path))
                    )
    return [folder_path for *_, folder_path in sorted(numbered_folders)]


def _own_fallback_folder(temporary_folder: Path) -> Path:
    """Return this user's fallback runtime folder, which is created if it does not exist.

    A number is appended to the name if another user has created a folder of that name. Later calls
    return the numbered folder, even if the other user's folder was removed.
    """
    uid = os.getuid()
    own_folders = _fallback_folders(temporary_folder, uid)
    folder_path = own_folders[0] if own_folders else temporary_folder / f"rigd-{uid}"
    for number in itertools.count(1):
        with suppress(FileExistsError):
            folder_path.mkdir(mode=0o700)
        folder_status = folder_path.lstat()
        if stat.S_ISDIR(folder_status.st_mode) and folder_status.st_uid == uid:
            if folder_status.st_mode & 0o055 and not folder_status.st_mode & 0o022:
                folder_path.chmod(0o700)
            return folder_path
        folder_path = temporary_folder / f"rigd-{uid}-{number}"
    raise AssertionError("never reached")


# Files and sockets in the runtime folder


def file_name(rig_name: str) -> str:
    """Return a rig's name for use in file names: only letters and digits, others become ``-``."""
    return "".join(c if c.isalnum() else "-" for c in rig_name).strip("-")


def address_files(pattern: str, *folders: Path) -> list[Path]:
    """Return the files in runtime folders whose names match a pattern, sorted by path.

    Parameters
    ----------
    pattern
        Pattern of file names, as for :meth:`pathlib.Path.glob`.
    *folders
        Folders to search; by default the user's runtime folder. Unreadable folders are skipped.
    """
    file_paths: list[Path] = []
    for folder in folders or (runtime_folder(),):
        with suppress(OSError):
            file_paths += folder.glob(pattern)
    return sorted(file_paths)


def write_address(path: Path, address: Mapping[str, object]) -> None:
    """Write the address of a process to a JSON file that only this user can read.

    The file is replaced atomically. Its folder is created if necessary.

    Parameters
    ----------
    path
        Path of the file; an existing file is replaced.
    address
        Fields of the address: name → value that JSON can represent.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    temporary_path = path.with_suffix(f".{os.getpid()}")
    temporary_path.unlink(missing_ok=True)
    temporary_path.touch(mode=0o600)
    temporary_path.write_text(json.dumps(address), encoding="utf-8")
    temporary_path.replace(path)


def read_address(path: Path) -> dict[str, Any]:
    """Return the address that `write_address` wrote to a file; empty if the file is not valid."""
    try:
        # The file may be of any kind, even one that blocks on opening.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        with os.fdopen(descriptor, "rb") as file:
            address_document = json.loads(file.read(_MAX_ADDRESS_BYTES))
    except (OSError, ValueError, RecursionError):
        return {}
    return address_document if isinstance(address_document, dict) else {}


def socket_answers(path: str | Path) -> bool:
    """Return whether a process listens on the Unix socket with a path."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe_socket:
        probe_socket.settimeout(_CONNECT_TIMEOUT_S)
        try:
            probe_socket.connect(os.fspath(path))
        except (BlockingIOError, TimeoutError):
            return True  # its queue is full
        except (OSError, ValueError):  # ValueError if it is not a valid path
            return False
    return True


def process_start_ticks(pid: int) -> int | None:
    """Return the start time of a process in clock ticks since the computer was started.

    Process id and start time together identify a process uniquely. The result is None if the
    process is not running.
    """
    try:
        stat_text = Path(f"/proc/{pid}/stat").read_text("utf-8")
    except OSError:
        return None
    state, *stat_fields = stat_text.rpartition(")")[
        2
    ].split()  # the name before may contain any character
    return None if state in "ZX" else int(stat_fields[18])
