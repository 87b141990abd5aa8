"""Address of a running live view, stored in a small file of the user's runtime folder.

A file that a killed process has left is recognised, because that process no longer exists.
"""

import os
import urllib.parse
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Self

from rigd.runtime.addresses import (
    address_files,
    file_name,
    process_start_ticks,
    read_address,
    runtime_folder,
    write_address,
)

LOOPBACK: Final = "127.0.0.1"
"""Address of this computer's loopback interface, on which all servers of the view listen."""
_FILE_PREFIX: Final = "live-"
"""Beginning of an address file's name, before the name of the rig."""
_FILE_SUFFIX: Final = ".json"
"""Suffix of an address file's name."""


@dataclass(frozen=True, slots=True)
class LiveAddress:
    """Address of a running live view.

    Attributes
    ----------
    rig
        Name of the rig's profile.
    pid
        Process id of the publisher.
    born
        Start of that process in clock ticks since boot; together with `pid` it is unique.
    grpc_port
        Port on loopback for native viewers.
    page_port
        Port on loopback for browsers.
    server
        Unique number of the server, by which viewers recognise that it was replaced.
    """

    rig: str
    pid: int
    born: int
    grpc_port: int
    page_port: int
    server: int

    @classmethod
    def for_this_process(cls, rig: str, grpc_port: int, page_port: int, server: int) -> Self:
        """Return the address of a live view that this process publishes.

        Parameters
        ----------
        rig
            Name of the rig's profile.
        grpc_port, page_port
            Ports on loopback for native viewers and for browsers.
        server
            Unique number of the server.
        """
        pid = os.getpid()
        return cls(rig, pid, process_start_ticks(pid) or 0, grpc_port, page_port, server)

    @property
    def proxy_url(self) -> str:
        """URL to which native viewers connect."""
        return proxy_url(LOOPBACK, self.grpc_port)

    @property
    def page_url(self) -> str:
        """URL of the view's page for browsers."""
        return f"http://{LOOPBACK}:{self.page_port}"

    @property
    def viewer_url(self) -> str:
        """URL to which the page redirects browsers: the page with the server's address."""
        url_query = urllib.parse.urlencode({"url": self.proxy_url})
        return f"{self.page_url}/?{url_query}"

    @property
    def alive(self) -> bool:
        """Whether the publisher's process still runs."""
        return process_start_ticks(self.pid) == self.born


def proxy_url(host_name: str, grpc_port: int) -> str:
    """Return the URL at which Rerun's SDK and native viewers connect to a Rerun server.

    Parameters
    ----------
    host_name
        Host name or IP address of the server's computer.
    grpc_port
        Port of the server for native viewers.
    """
    return f"rerun+http://{host_name}:{grpc_port}/proxy"


def announce(address: LiveAddress) -> None:
    """Write the address of a live view to its file, which only this user can read.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    write_address(_address_path(address.rig), asdict(address))


def withdraw(address: LiveAddress) -> None:
    """Delete the file of a view's address, unless another process has replaced it."""
    address_path = _address_path(address.rig)
    stored_address = _read_address_file(address_path)
    if stored_address is not None and (stored_address.pid, stored_address.born) == (
        address.pid,
        address.born,
    ):
        address_path.unlink(missing_ok=True)


def find(rig_name: str) -> LiveAddress | None:
    """Return the address of a rig's live view, or None if the rig has no running view."""
    address = _read_address_file(_address_path(rig_name))
    return address if address is not None and address.alive else None


def running() -> list[LiveAddress]:
    """Return the addresses of all running live views of this user."""
    live_addresses = map(_read_address_file, address_files(f"{_FILE_PREFIX}*{_FILE_SUFFIX}"))
    return [address for address in live_addresses if address is not None and address.alive]


def _address_path(rig_name: str) -> Path:
    """Return the path of a rig's address file."""
    return runtime_folder() / f"{_FILE_PREFIX}{file_name(rig_name)}{_FILE_SUFFIX}"


def _read_address_file(path: Path) -> LiveAddress | None:
    """Return the address in a file, or None if it is invalid.

    The contents are checked because they are shown on terminals.
    """
    address_fields = read_address(path)
    try:
        address = LiveAddress(**address_fields)
    except TypeError:
        return None
    return address if _are_valid_fields(address_fields) else None


def _are_valid_fields(address_fields: dict[str, object]) -> bool:
    """Return whether the fields read from an address file have valid values."""
    rig_name = address_fields.pop("rig")
    port_numbers = (address_fields["grpc_port"], address_fields["page_port"])
    return (
        isinstance(rig_name, str)
        and rig_name.isprintable()
        and all(type(process_number) is int for process_number in address_fields.values())
        and all(
            0 < port_number < 1 << 16
            for port_number in port_numbers
            if isinstance(port_number, int)
        )
    )
