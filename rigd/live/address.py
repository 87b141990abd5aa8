"""Where the live view of a rig is found: one small file for each, as long as there is one.

It stands in the user's runtime folder. What a killed process left is told by its process, which is
not there any more.
"""

import json
import os
import urllib.parse
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Self

from rigd.devices.simulator import runtime_folder
from rigd.live.program import LOOPBACK

_PREFIX: Final = "live-"
_SUFFIX: Final = ".json"
_MOST_BYTES: Final = 4096


@dataclass(frozen=True, slots=True)
class LiveAddress:
    """A live view that runs.

    Attributes
    ----------
    rig
        The profile's name.
    pid
        Of the publisher.
    born
        When that process was started, in clock ticks since the computer was: no other process has
        both numbers.
    grpc_port
        On loopback, for native viewers.
    page_port
        On loopback, for browsers.
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
        """Return the address of a live view that this process publishes."""
        pid = os.getpid()
        return cls(rig, pid, _born(pid) or 0, grpc_port, page_port, server)

    @property
    def proxy_url(self) -> str:
        """Where native viewers connect."""
        return proxy_url(LOOPBACK, self.grpc_port)

    @property
    def page_url(self) -> str:
        """What to open in a browser."""
        return f"http://{LOOPBACK}:{self.page_port}"

    @property
    def viewer_url(self) -> str:
        """Where :attr:`page_url` leads to: the page, told which server to show."""
        query = urllib.parse.urlencode({"url": self.proxy_url})
        return f"{self.page_url}/?{query}"

    @property
    def alive(self) -> bool:
        """Whether its process still runs."""
        born = _born(self.pid)
        return born is not None and born == self.born


def proxy_url(host: str, grpc_port: int) -> str:
    """Return where the SDK and native viewers connect to a server."""
    return f"rerun+http://{host}:{grpc_port}/proxy"


def announce(address: LiveAddress) -> None:
    """Write down where a live view is, for this user only, until :func:`withdraw`.

    Raises
    ------
    OSError
        If that cannot be written.
    """
    path = _file(address.rig)
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    fresh = path.with_suffix(f".{address.pid}")
    fresh.unlink(missing_ok=True)
    fresh.touch(mode=0o600)
    fresh.write_text(json.dumps(asdict(address)), encoding="utf-8")
    fresh.replace(path)


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
    return [address for path in _files() if (address := _read(path)) is not None and address.alive]


def _file(rig: str) -> Path:
    plain = "".join(c if c.isalnum() else "-" for c in rig).strip("-")
    return runtime_folder() / f"{_PREFIX}{plain}{_SUFFIX}"


def _files() -> Iterator[Path]:
    with suppress(OSError):
        yield from sorted(runtime_folder().glob(f"{_PREFIX}*{_SUFFIX}"))


def _read(path: Path) -> LiveAddress | None:
    """Return what a file says, None if it is none of ours: its text ends up on terminals."""
    try:
        # Anything may lie there, even what blocks whoever opens it.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        with os.fdopen(descriptor, "rb") as file:
            found = json.loads(file.read(_MOST_BYTES))
        address = LiveAddress(**found)
    except (OSError, ValueError, TypeError, RecursionError):
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


def _born(pid: int) -> int | None:
    """Return when a process was started, in clock ticks; None if it does not run."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text("utf-8")
    except OSError:
        return None
    state, *rest = text.rpartition(")")[2].split()  # the name before may hold anything
    return None if state in "ZX" else int(rest[18])
