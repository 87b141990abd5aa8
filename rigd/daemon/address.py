"""Socket of a rig's daemon: its path, its creation, and the search for running daemons."""

import errno
import grp
import os
import socket
import stat
import struct
from contextlib import suppress
from pathlib import Path

from rigd.errors import FailureError, UserError
from rigd.runtime.addresses import (
    address_files,
    file_name,
    folder_fault,
    runtime_folder,
    socket_answers,
)
from rigd.runtime.processes import listening_sockets

GROUP_FOLDER = Path("/run/rigd")
"""Folder for sockets of daemons that a group may use: a user's own folder is closed to others."""
SOCKET_SUFFIX = ".daemon"
"""Suffix of the file name of a daemon's socket."""
_CREDENTIALS_FORMAT = struct.Struct("3i")


class AddressError(FailureError):
    """Raised if a socket cannot be created or no daemon is found; the message states why."""


class UnknownGroupError(UserError):
    """Raised if the group that may use the daemon does not exist."""


def socket_path(rig_name: str, folder: Path | None = None) -> Path:
    """Return the path of the socket of a rig's daemon.

    Parameters
    ----------
    rig_name
        Name of the rig's profile.
    folder
        Folder of the socket, or None for the user's runtime folder.
    """
    return (folder or runtime_folder()) / f"{file_name(rig_name)}{SOCKET_SUFFIX}"


def peer_pid_and_uid(connected_socket: socket.socket) -> tuple[int, int]:
    """Return process id and user id of the process at the other end of a Unix socket connection.

    Raises
    ------
    OSError
        If the kernel does not report them.
    """
    credentials = connected_socket.getsockopt(
        socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS_FORMAT.size
    )
    pid, uid, _ = _CREDENTIALS_FORMAT.unpack(credentials)
    return pid, uid


def bind_daemon_socket(daemon_socket_path: Path, group_name: str | None) -> socket.socket:
    """Return a new bound socket for the daemon; only this user or a group can connect to it.

    The caller must hold the lock of the rig, because the socket of a dead daemon is replaced.

    Parameters
    ----------
    daemon_socket_path
        Path of the socket. This user's own folder is created, but the folder of a group must exist.
    group_name
        Group whose members may also connect, or None.

    Raises
    ------
    UnknownGroupError
        If the group does not exist.
    AddressError
        If the socket cannot be created, its folder is closed to the group or writable by others,
        or a running daemon uses it.
    """
    group_id = None if group_name is None else _group_number(group_name)
    folder_fault_text = folder_fault(daemon_socket_path.parent, is_shared=group_name is not None)
    if folder_fault_text:
        raise AddressError(folder_fault_text)
    if socket_answers(daemon_socket_path):
        raise AddressError(f"Another daemon answers on {daemon_socket_path}; see rigd status.")
    bound_socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
    try:
        if group_id is None:
            daemon_socket_path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        elif not _can_group_enter(group_id, daemon_socket_path.parent):
            raise PermissionError(
                errno.EACCES, f"{daemon_socket_path.parent} is closed to the group {group_name}"
            )
        daemon_socket_path.unlink(missing_ok=True)
        previous_umask = os.umask(0o177)
        try:
            bound_socket.bind(os.fspath(daemon_socket_path))
        finally:
            os.umask(previous_umask)
        if group_id is not None:
            os.chown(daemon_socket_path, -1, group_id, follow_symlinks=False)
            daemon_socket_path.chmod(0o660)
    except OSError as error:
        bound_socket.close()
        raise AddressError(_creation_error_text(daemon_socket_path, group_name, error)) from None
    return bound_socket


def running_daemon_sockets() -> list[Path]:
    """Return the paths of the sockets of all daemons that this user can connect to."""
    daemon_sockets = address_files(f"*{SOCKET_SUFFIX}", *_searched_folders())
    return [path for path in daemon_sockets if socket_answers(path)]


def find_daemon_socket(rig_name: str | None) -> Path:
    """Return the path of the socket of a rig's daemon, or of the only daemon if `rig_name` is None.

    Raises
    ------
    AddressError
        If there is no such daemon, or several daemons; the message states the remedy.
    """
    if rig_name is not None:
        for folder in _searched_folders():
            path = socket_path(rig_name, folder)
            if socket_answers(path):
                return path
        raise AddressError(
            f"No daemon of the rig {rig_name} {_not_found_reason(file_name(rig_name))}"
            f"rigd serve --profile {rig_name}."
        )
    daemon_sockets = running_daemon_sockets()
    if not daemon_sockets:
        raise AddressError(f"No daemon {_not_found_reason(None)}rigd serve --profile NAME.")
    if len(daemon_sockets) > 1:
        rig_names = ", ".join(path.name.removesuffix(SOCKET_SUFFIX) for path in daemon_sockets)
        raise AddressError(f"Several daemons are running ({rig_names}); name one with --profile.")
    return daemon_sockets[0]


def _searched_folders() -> list[Path]:
    """Return the folders that may contain sockets of daemons, without an unsafe group folder."""
    return (
        [runtime_folder()]
        if folder_fault(GROUP_FOLDER, is_shared=True)
        else [runtime_folder(), GROUP_FOLDER]
    )


def _not_found_reason(rig_file_name: str | None) -> str:
    """Return the end of the message "No daemon …": why none is found, and the remedy.

    `rig_name` is the rig's name as in file names, or None for any rig.
    """
    folder_fault_text = folder_fault(GROUP_FOLDER, is_shared=True)
    sockets_in_unsafe_folder = (
        address_files(f"*{SOCKET_SUFFIX}", GROUP_FOLDER) if folder_fault_text else []
    )
    sockets_elsewhere = []
    with suppress(OSError):
        sockets_elsewhere = [
            socket_file
            for socket_file in own_daemon_sockets()
            if rig_file_name in (None, socket_file.name.removesuffix(SOCKET_SUFFIX))
        ]
    folders = " or ".join(map(str, _searched_folders()))
    if sockets_in_unsafe_folder:
        return f"answers in {folders}. {folder_fault_text} Without one there, start it with "
    if sockets_elsewhere:
        return (
            f"answers in {folders}, but one listens on {sockets_elsewhere[0]}: set XDG_RUNTIME_DIR "
            "as it was set for that one, or start another with "
        )
    return "is running; start it with "


def own_daemon_sockets() -> list[Path]:
    """Return the paths of the sockets on which this user's daemons listen, from the kernel's list.

    For root the result includes the sockets of all users.

    Raises
    ------
    OSError
        If the system has no list of sockets.
    """
    socket_paths = []
    for path in listening_sockets():
        folder = path.parent.name
        if path.name.endswith(SOCKET_SUFFIX) and (folder == "rigd" or folder.startswith("rigd-")):
            with suppress(OSError, ValueError):  # it was removed, or is in another user's folder
                socket_status = path.lstat()
                if stat.S_ISSOCK(socket_status.st_mode) and os.getuid() in (
                    0,
                    socket_status.st_uid,
                ):
                    socket_paths.append(path)
    return socket_paths


def daemon_pid_and_uid(daemon_socket_path: Path) -> tuple[int, int] | None:
    """Return process id and user id of the process that listens on a socket.

    The result is None if the socket's queue of waiting connections is full.

    Parameters
    ----------
    daemon_socket_path
        Path of the socket.

    Raises
    ------
    OSError
        If no process listens there, or this user may not connect.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK) as probe_socket:
        try:
            probe_socket.connect(os.fspath(daemon_socket_path))
        except BlockingIOError:
            return None
        return peer_pid_and_uid(probe_socket)


def _group_number(group_name: str) -> int:
    """Return the group id of a group; raise UnknownGroupError if it does not exist."""
    try:
        return grp.getgrnam(group_name).gr_gid
    except KeyError:
        raise UnknownGroupError(
            f"--group {group_name!r}: there is no such group; name one that exists, or have the "
            "administrator create it with groupadd."
        ) from None


def _can_group_enter(group_id: int, folder: Path) -> bool:
    """Return whether the members of a group can enter a folder."""
    folder_status = folder.stat()
    return bool(
        folder_status.st_mode & stat.S_IXOTH
        or (folder_status.st_gid == group_id and folder_status.st_mode & stat.S_IXGRP)
    )


def _creation_error_text(path: Path, group_name: str | None, error: OSError) -> str:
    """Return the error message for a socket that cannot be created, with the remedy."""
    remedy_text = (
        "set XDG_RUNTIME_DIR to a folder with a short name that is yours."
        if group_name is None
        else f"have the administrator make its folder: install -d -o $USER -g {group_name} -m 2750 "
        f"{path.parent}; and be a member of {group_name} yourself."
    )
    return f"The socket {path} cannot be made ({error.strerror or error}); {remedy_text}"
