"""Address of a rig's daemon: its socket, how it is made and found."""

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
"""Folder of daemons that a group may use: a user's own runtime folder is closed to others."""
SUFFIX = ".daemon"
"""Ends the name of each daemon's socket."""
_CREDENTIALS = struct.Struct("3i")


class AddressError(FailureError):
    """There can be no socket, or no daemon is found; the message is for the operator."""


class UnknownGroupError(UserError):
    """There is no group of that name."""


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
    """Return process and user at the other end of a connection, as the kernel knows them.

    Raises
    ------
    OSError
        If the kernel does not tell.
    """
    told = link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, uid, _ = _CREDENTIALS.unpack(told)
    return pid, uid


def bind(path: Path, group: str | None) -> socket.socket:
    """Make the socket; no client can connect before it listens, and then only its users.

    Call it only while holding the rig: what a dead daemon left is replaced.

    Parameters
    ----------
    path
        Path of the socket. The user's own folder is created; a group's folder has to exist.
    group
        Group whose members may use it too.

    Raises
    ------
    UnknownGroupError
        If there is no such group.
    AddressError
        If the socket cannot be made, its folder is closed to the group or writable by others, or a
        living daemon has it.
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
    """Return the socket of the daemon of a rig, or of the only one there is.

    Raises
    ------
    AddressError
        Naming the remedy.
    """
    if rig is not None:
        for folder in _folders():
            path = socket_path(rig, folder)
            if answers(path):
                return path
        raise AddressError(
            f"No daemon of the rig {rig} {_elsewhere(file_name(rig))}rigd serve --profile {rig}."
        )
    found = running()
    if not found:
        raise AddressError(f"No daemon {_elsewhere(None)}rigd serve --profile NAME.")
    if len(found) > 1:
        rigs = ", ".join(path.name.removesuffix(SUFFIX) for path in found)
        raise AddressError(f"Several daemons are running ({rigs}); name one with --profile.")
    return found[0]


def _folders() -> list[Path]:
    """Return the folders in which a daemon is found, without that of groups if it is unsafe."""
    return [runtime_folder()] if folder_fault(COMMON, shared=True) else [runtime_folder(), COMMON]


def _elsewhere(rig: str | None) -> str:
    """Return the reason why no daemon is found, up to the command that starts one.

    Parameters
    ----------
    rig
        Name of the rig as file names have it; None: any.
    """
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
    """Return the sockets on which this user's daemons listen, by the kernel's list.

    For root they are those of all users.

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
    """Return process and user that listen on a socket; None if its queue is full.

    Parameters
    ----------
    path
        Path of the socket.

    Raises
    ------
    OSError
        If nobody listens there, or this user may not connect.
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
    """Whether the members of a group can reach what is in a folder."""
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
