"""Rerun's native viewer, as a window on a live view."""

import contextlib
import threading
from pathlib import Path
from typing import Final

from rigd.devices.simulator import runtime_folder
from rigd.live.address import LiveAddress, proxy_url
from rigd.live.program import RerunProgram

_MOST_MEMORY: Final = "2GiB"
"""Then the oldest is forgotten; the same computer may be running the loop."""
_ANSWER_S: Final = 5.0
_HOSTS: Final = ("127.0.0.1", "localhost")


class Viewer:
    """The viewer's window.

    What the user has set in Rerun's own viewer is neither used nor changed.

    Parameters
    ----------
    address
        Of the live view that is shown first.
    scratch
        Folder in which Rerun may leave files: it does when it is ended.
    options
        More of the program's command line.

    Raises
    ------
    RerunError
        If Rerun's program cannot be run.
    """

    def __init__(self, address: LiveAddress, scratch: Path, options: tuple[str, ...] = ()) -> None:
        self._connections = 0
        self._connecting: threading.Thread | None = None
        self._program = RerunProgram(
            (
                *("--connect", self._next_url(address)),
                *("--port", "0"),
                *("--memory-limit", _MOST_MEMORY),
                "--hide-welcome-screen",
                *options,
            ),
            {"XDG_DATA_HOME": str(runtime_folder() / "viewer"), "TMPDIR": str(scratch)},
        )

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._program.pid

    @property
    def exit_code(self) -> int | None:
        """How it ended; None while the window is open."""
        return self._program.exit_code

    @property
    def last_words(self) -> str:
        """What it said last."""
        return self._program.last_words

    @property
    def control_url(self) -> str:
        """Where the viewer itself takes orders; empty: not yet."""
        port = self._program.grpc_port
        return proxy_url(_HOSTS[0], port) if port else ""

    def connect(self, address: LiveAddress) -> bool:
        """Show a live view whose server is another one than before; say whether that was done.

        The viewer connects to an address once. To have it connect again, it is given another name
        of the same place. Earlier sessions are forgotten: it would go to the first of them instead
        of staying with the one that is shown.
        """
        if not self.control_url or (self._connecting and self._connecting.is_alive()):
            return False
        self._connections += 1
        url = self._next_url(address)
        done: list[bool] = []
        # A window that is frozen never answers, and who waits for it in here hears no Ctrl-C.
        self._connecting = threading.Thread(
            target=_have_it_connect, args=(self.control_url, url, done), daemon=True
        )
        self._connecting.start()
        self._connecting.join(_ANSWER_S)
        return any(done)

    def close(self) -> None:
        """Close the window."""
        self._program.kill()

    def _next_url(self, address: LiveAddress) -> str:
        return proxy_url(_HOSTS[self._connections % len(_HOSTS)], address.grpc_port)


def _have_it_connect(control_url: str, url: str, done: list[bool]) -> None:
    """Have a viewer go on to another server; `done` gets an item if it did."""
    from rerun.experimental import ViewerClient

    try:
        client = ViewerClient.connect(control_url)
        state = client.get_state()
        earlier = [r.store_id for r in state.recordings if r.store_id != state.active_recording]
        if earlier:
            client.close(store_ids=earlier)
        with contextlib.suppress(ConnectionError):  # nothing came from there
            client.close(url)
        client.open(url)
    except (OSError, RuntimeError):  # it is busy, or about to end
        return
    done.append(True)
