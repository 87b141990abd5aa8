"""Address of a rig's daemon: creation of its socket, and search for it."""

import errno
import grp
import os
import socket
import stat
import struct
from contextlib import suppress
from pathlib import Path

from rigd.errors import FailureError, UserError
from rigd.runtime.addresses import address_files, answers, file_name, folder_fault, runtime_folder
from rigd.runtime.processes import listening_sockets

COMMON = Path("/run/rigd")
"""Folder of daemons for a group: a user's own runtime folder is closed to others."""
SUFFIX = ".daemon"
"""Suffix of the name of each daemon's socket."""
_CREDENTIALS = struct.Struct("3i")


class AddressError(FailureError):
    """A socket cannot be created, or no daemon is found; the message is for the operator."""


class UnknownGroupError(UserError):
    """A group does not exist."""


def socket_path(rig: str, folder: Path | None = None) -> Path:
    """Return the path of the socket of a rig's daemon.

    Parameters
    ----------
    rig
        Name of the rig's profile.
    folder
        Folder of the socket; None: the user's runtime folder.
    """
    return (folder or runtime_folder()) / f"{file_name(rig)}{SUFFIX}"


def peer_of(link: socket.socket) -> tuple[int, int]:
    """Return process id and user id of a connection's peer, from the kernel.

    Raises
    ------
    OSError
        If the kernel does not report them.
    """
    credentials = link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, uid, _ = _CREDENTIALS.unpack(credentials)
    return pid, uid


def bind(path: Path, group: str | None) -> socket.socket:
    """Create the socket, which only its users can connect to, once it listens.

    Call it only while holding the lock of the rig: it replaces the socket of a dead daemon.

    Parameters
    ----------
    path
        Path of the socket. The user's own folder is created; a group's folder has to exist.
    group
        Group whose members may also connect.

    Raises
    ------
    UnknownGroupError
        If there is no such group.
    AddressError
        If the socket cannot be created, its folder is closed to the group or writable by others,
        or a running daemon uses it.
    """
    number = None if group is None else _group_number(group)
    fault = folder_fault(path.parent, shared=group is not None)
    if fault:
        raise AddressError(fault)
    if answers(path):
        raise AddressError(f"Another daemon answers on {path}; see rigd status.")
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
    try:
        if number is None:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        elif not _open_to(number, path.parent):
            raise PermissionError(errno.EACCES, f"{path.parent} is closed to the group {group}")
        path.unlink(missing_ok=True)
        before = os.umask(0o177)
        try:
            listener.bind(os.fspath(path))
        finally:
            os.umask(before)
        if number is not None:
            os.chown(path, -1, number, follow_symlinks=False)
            path.chmod(0o660)
    except OSError as error:
        listener.close()
        raise AddressError(_refused(path, group, error)) from None
    return listener


def running() -> list[Path]:
    """Return the sockets of all daemons that this user can reach."""
    sockets = address_files(f"*{SUFFIX}", *_folders())
    return [path for path in sockets if answers(path)]


def find(rig: str | None) -> Path:
    """Return the socket of a rig's daemon, or of the only daemon.

    Raises
    ------
    AddressError
        If there is none, or several; the message names the remedy.
    """
    if rig is not None:
        for folder in _folders():
            path = socket_path(rig, folder)
            if answers(path):
                return path
        raise AddressError(
            f"No daemon of the rig {rig} {_not_found_reason(file_name(rig))}"
            f"rigd serve --profile {rig}."
        )
    found = running()
    if not found:
        raise AddressError(f"No daemon {_not_found_reason(None)}rigd serve --profile NAME.")
    if len(found) > 1:
        rigs = ", ".join(path.name.removesuffix(SUFFIX) for path in found)
        raise AddressError(f"Several daemons are running ({rigs}); name one with --profile.")
    return found[0]


def _folders() -> list[Path]:
    """Return the folders to search for daemons, without that of groups if it is unsafe."""
    return [runtime_folder()] if folder_fault(COMMON, shared=True) else [runtime_folder(), COMMON]


def _not_found_reason(rig: str | None) -> str:
    """Return part of a sentence: why no daemon of `rig` (as in file names; None: any) is found."""
    fault = folder_fault(COMMON, shared=True)
    unsafe = address_files(f"*{SUFFIX}", COMMON) if fault else []
    others = []
    with suppress(OSError):
        others = [path for path in own_sockets() if rig in (None, path.name.removesuffix(SUFFIX))]
    folders = " or ".join(map(str, _folders()))
    if unsafe:
        return f"answers in {folders}. {fault} Without one there, start it with "
    if others:
        return (
            f"answers in {folders}, but one listens on {others[0]}: set XDG_RUNTIME_DIR as it was "
            "set for that one, or start another with "
        )
    return "is running; start it with "


def own_sockets() -> list[Path]:
    """Return the listening sockets of this user's daemons from the kernel's list.

    For root these are the sockets of all users.

    Raises
    ------
    OSError
        If the system has no such list.
    """
    found = []
    for path in listening_sockets():
        folder = path.parent.name
        if path.name.endswith(SUFFIX) and (folder == "rigd" or folder.startswith("rigd-")):
            with suppress(OSError, ValueError):  # it is gone, or in a folder of another user
                status = path.lstat()
                if stat.S_ISSOCK(status.st_mode) and os.getuid() in (0, status.st_uid):
                    found.append(path)
    return found


def peer_at(path: Path) -> tuple[int, int] | None:
    """Return process id and user id that listen on a socket; None if its queue is full.

    Parameters
    ----------
    path
        Path of the socket.

    Raises
    ------
    OSError
        If no process listens there, or this user may not connect.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as link:
        try:
            link.connect(os.fspath(path))
        except BlockingIOError:
            return None
        return peer_of(link)


def _group_number(group: str) -> int:
    try:
        return grp.getgrnam(group).gr_gid
    except KeyError:
        raise UnknownGroupError(
            f"--group {group!r}: there is no such group; name one that exists, or have the "
            "administrator create it with groupadd."
        ) from None


def _open_to(group: int, folder: Path) -> bool:
    """Return whether the members of a group can enter a folder."""
    status = folder.stat()
    return bool(
        status.st_mode & stat.S_IXOTH or (status.st_gid == group and status.st_mode & stat.S_IXGRP)
    )


def _refused(path: Path, group: str | None, error: OSError) -> str:
    remedy = (
        "set XDG_RUNTIME_DIR to a folder with a short name that is yours."
        if group is None
        else f"have the administrator make its folder: install -d -o $USER -g {group} -m 2750 "
        f"{path.parent}; and be a member of {group} yourself."
    )
    return f"The socket {path} cannot be made ({error.strerror or error}); {remedy}"
