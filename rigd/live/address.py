"""Address of a live view, in a small file of the user's runtime folder while the view runs.

The file of a killed process is recognised because the process is gone.
"""

import os
import urllib.parse
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Self

from rigd.runtime.addresses import (
    address_files,
    file_name,
    read_address,
    runtime_folder,
    started_at,
)
from rigd.runtime.addresses import announce as write_address

LOOPBACK: Final = "127.0.0.1"
_PREFIX: Final = "live-"
_SUFFIX: Final = ".json"


@dataclass(frozen=True, slots=True)
class LiveAddress:
    """Address of a running live view.

    Attributes
    ----------
    rig
        The profile's name.
    pid
        Process of the publisher.
    born
        Start of that process in clock ticks since boot; together with `pid` it is unique.
    grpc_port
        Port on loopback for native viewers.
    page_port
        Port on loopback for browsers.
    server
        Unique number of the server, by which viewers notice a replacement.
    """

    rig: str
    pid: int
    born: int
    grpc_port: int
    page_port: int
    server: int

    @classmethod
    def of_this_process(cls, rig: str, grpc_port: int, page_port: int, server: int) -> Self:
        """Return the address of a live view that this process publishes.

        Parameters
        ----------
        rig
            The profile's name.
        grpc_port, page_port
            Ports on loopback, for native viewers and for browsers.
        server
            Unique number of the server.
        """
        pid = os.getpid()
        return cls(rig, pid, started_at(pid) or 0, grpc_port, page_port, server)

    @property
    def proxy_url(self) -> str:
        """Address for native viewers."""
        return proxy_url(LOOPBACK, self.grpc_port)

    @property
    def page_url(self) -> str:
        """Address to open in a browser."""
        return f"http://{LOOPBACK}:{self.page_port}"

    @property
    def viewer_url(self) -> str:
        """Target of :attr:`page_url`: the page with the address of the server."""
        query = urllib.parse.urlencode({"url": self.proxy_url})
        return f"{self.page_url}/?{query}"

    @property
    def alive(self) -> bool:
        """Whether the process still runs."""
        return started_at(self.pid) == self.born


def proxy_url(host: str, grpc_port: int) -> str:
    """Return the address at which the SDK and native viewers connect to a server.

    Parameters
    ----------
    host
        Name or number of the computer.
    grpc_port
        Port of the server.
    """
    return f"rerun+http://{host}:{grpc_port}/proxy"


def announce(address: LiveAddress) -> None:
    """Write the address of a live view to its file, for this user only.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    write_address(_file(address.rig), asdict(address))


def withdraw(address: LiveAddress) -> None:
    """Delete the file of an address, unless it belongs to another process by now."""
    path = _file(address.rig)
    found = _read(path)
    if found is not None and (found.pid, found.born) == (address.pid, address.born):
        path.unlink(missing_ok=True)


def find(rig: str) -> LiveAddress | None:
    """Return the address of a rig's live view; None if none runs."""
    address = _read(_file(rig))
    return address if address is not None and address.alive else None


def running() -> list[LiveAddress]:
    """Return the addresses of all live views of this user."""
    found = map(_read, address_files(f"{_PREFIX}*{_SUFFIX}"))
    return [address for address in found if address is not None and address.alive]


def _file(rig: str) -> Path:
    return runtime_folder() / f"{_PREFIX}{file_name(rig)}{_SUFFIX}"


def _read(path: Path) -> LiveAddress | None:
    """Return the address in a file; None if it is invalid, because it is shown on terminals."""
    found = read_address(path)
    try:
        address = LiveAddress(**found)
    except TypeError:
        return None
    return address if _is_sound(found) else None


def _is_sound(found: dict[str, object]) -> bool:
    """Return whether the contents of a file are a valid address."""
    rig = found.pop("rig")
    ports = (found["grpc_port"], found["page_port"])
    return (
        isinstance(rig, str)
        and rig.isprintable()
        and all(type(number) is int for number in found.values())
        and all(0 < port < 1 << 16 for port in ports if isinstance(port, int))
    )
