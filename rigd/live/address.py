"""Address of a live view: one small file in the user's runtime folder as long as there is one.

A file that a killed process left is recognised by that process being gone.
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
    """A live view that runs.

    Attributes
    ----------
    rig
        The profile's name.
    pid
        Process of the publisher.
    born
        When that process was started, in clock ticks since the computer was: no other process has
        both numbers.
    grpc_port
        Port on loopback, for native viewers.
    page_port
        Port on loopback, for browsers.
    server
        Number of the server, another for each: viewers do not connect a second time by themselves.
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
            Number of the server, another for each.
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
        """Where :attr:`page_url` leads to: the page, told which server to show."""
        query = urllib.parse.urlencode({"url": self.proxy_url})
        return f"{self.page_url}/?{query}"

    @property
    def alive(self) -> bool:
        """Whether its process still runs."""
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
    """Write down where a live view is, for this user only, until :func:`withdraw`.

    Raises
    ------
    OSError
        If that cannot be written.
    """
    write_address(_file(address.rig), asdict(address))


def withdraw(address: LiveAddress) -> None:
    """Take the address away, unless it is another's by now."""
    path = _file(address.rig)
    found = _read(path)
    if found is not None and (found.pid, found.born) == (address.pid, address.born):
        path.unlink(missing_ok=True)


def find(rig: str) -> LiveAddress | None:
    """Return the live view of a rig, if one runs."""
    address = _read(_file(rig))
    return address if address is not None and address.alive else None


def running() -> list[LiveAddress]:
    """Return all live views of this user."""
    found = map(_read, address_files(f"{_PREFIX}*{_SUFFIX}"))
    return [address for address in found if address is not None and address.alive]


def _file(rig: str) -> Path:
    return runtime_folder() / f"{_PREFIX}{file_name(rig)}{_SUFFIX}"


def _read(path: Path) -> LiveAddress | None:
    """Return what a file says, None if it is none of ours: its text ends up on terminals."""
    found = read_address(path)
    try:
        address = LiveAddress(**found)
    except TypeError:
        return None
    return address if _is_sound(found) else None


def _is_sound(found: dict[str, object]) -> bool:
    """Whether what a file holds can be an address."""
    rig = found.pop("rig")
    ports = (found["grpc_port"], found["page_port"])
    return (
        isinstance(rig, str)
        and rig.isprintable()
        and all(type(number) is int for number in found.values())
        and all(0 < port < 1 << 16 for port in ports if isinstance(port, int))
    )
