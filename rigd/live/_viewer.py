"""Rerun's native viewer: a window for a live view or a file, and the page for a file."""

import contextlib
import threading
import time
from pathlib import Path
from typing import Final, Self

from rigd.live._page import serve_page
from rigd.live._program import RerunError, RerunProgram
from rigd.live._server import GRPC_PORT, free_port
from rigd.live.address import LiveAddress, proxy_url
from rigd.runtime.addresses import runtime_folder

_MOST_MEMORY: Final = "4GiB"
"""Limit beyond which the oldest data are dropped: enough for a session of some hours."""
_START_S: Final = 30.0
"""Longest start of a server."""
_POLL_S: Final = 0.05


# File in a window or a browser


class _Playback:
    """Rerun's program, which ends with this context."""

    _program: RerunProgram

    @property
    def program(self) -> RerunProgram:
        """Rerun's program."""
        return self._program

    def wait(self) -> int:
        """Wait until the program ends, such as a closed window, and return its exit code."""
        while (code := self._program.exit_code) is None:
            time.sleep(_POLL_S)
        return code

    def close(self) -> None:
        """End the program."""
        self._program.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Window(_Playback):
    """The viewer's window, which neither uses nor changes the user's settings of Rerun.

    `shown` is the command line for its first contents, `memory` the limit beyond which the oldest
    data are dropped, and `scratch` a folder for files that Rerun leaves when it is killed.
    """

    def __init__(
        self, shown: tuple[str, ...], memory: str, scratch: Path, options: tuple[str, ...]
    ) -> None:
        self._program = RerunProgram(
            (
                *shown,
                *("--port", "0"),
                *("--memory-limit", memory),
                "--hide-welcome-screen",
                *options,
            ),
            {"XDG_DATA_HOME": str(runtime_folder() / "viewer"), "TMPDIR": str(scratch)},
        )

    @property
    def fault(self) -> str:
        """Reason, as a sentence, if the window was not closed by the user."""
        if self._program.without_graphics:
            return (
                "The window cannot be drawn: this computer has no Vulkan driver, which Rerun's "
                "viewer needs. Install one; on Debian and Ubuntu the package mesa-vulkan-drivers "
                "has those for most graphics cards, and one that needs none."
            )
        return f"The window was closed by a fault ({self._program.last_words})."


class FileWindow(_Window):
    """The viewer's window for a file.

    Parameters
    ----------
    path
        Path of the recording.
    scratch
        Folder for files that Rerun leaves when it is killed.
    options
        Further options of the command line.

    Raises
    ------
    RerunError
        If Rerun's program cannot be started.
    """

    def __init__(self, path: Path, scratch: Path, options: tuple[str, ...] = ()) -> None:
        super().__init__((str(path.absolute()),), _MOST_MEMORY, scratch, options)


class PageOfFile(_Playback):
    """The viewer's page for a file, on loopback.

    Parameters
    ----------
    path
        Path of the recording.
    scratch
        Folder for files that Rerun leaves.

    Attributes
    ----------
    address
        Address of the page.

    Raises
    ------
    RerunError
        If Rerun's program cannot be started, or accepts no connections.
    """

    def __init__(self, path: Path, scratch: Path) -> None:
        self._file, self._scratch = path, scratch
        self._serve(free_port(GRPC_PORT))
        try:
            self._await_server()
            self._page = serve_page(lambda: self.address, lambda: self._program.page_port)
        except BaseException:
            self._program.kill()
            raise
        self.address = LiveAddress.of_this_process(
            path.stem, self._program.grpc_port, self._page.port, time.time_ns()
        )

    def close(self) -> None:
        """Close the page and end the program."""
        self._page.close()
        super().close()

    def _serve(self, port: int) -> None:
        self._program = RerunProgram(
            (
                str(self._file.absolute()),
                "--serve-web",
                *("--port", str(port)),
                *("--web-viewer-port", "0"),
                *("--server-memory-limit", _MOST_MEMORY),
            ),
            {"TMPDIR": str(self._scratch)},
        )

    def _await_server(self) -> None:
        deadline = time.monotonic() + _START_S
        anywhere = False
        while not (self._program.grpc_port and self._program.page_port):
            if not self._program.running:
                if anywhere or self._program.grpc_port:
                    raise RerunError(f"The Rerun server ended: {self._program.last_words}.")
                # Most likely another process has taken the port.
                anywhere = True
                self._serve(0)
            if time.monotonic() > deadline:
                raise RerunError(f"The Rerun server does not answer: {self._program.last_words}.")
            time.sleep(_POLL_S)


# Window on a live view

_WINDOW_MEMORY: Final = "2GiB"
"""Limit beyond which the oldest data are dropped; the same computer may be running the loop."""
_ANSWER_S: Final = 5.0
_HOSTS: Final = ("127.0.0.1", "localhost")


class Viewer(_Window):
    """The viewer's window for live views.

    Parameters
    ----------
    address
        First live view to show.
    scratch
        Folder for files that Rerun leaves when it is killed.
    options
        Further options of the command line.

    Raises
    ------
    RerunError
        If Rerun's program cannot be started.
    """

    def __init__(self, address: LiveAddress, scratch: Path, options: tuple[str, ...] = ()) -> None:
        self._connections = 0
        self._connecting: threading.Thread | None = None
        shown = ("--connect", self._next_url(address))
        super().__init__(shown, _WINDOW_MEMORY, scratch, options)

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._program.pid

    @property
    def exit_code(self) -> int | None:
        """Exit code; None while the window is open."""
        return self._program.exit_code

    @property
    def last_words(self) -> str:
        """Last lines of its log."""
        return self._program.last_words

    @property
    def without_graphics(self) -> bool:
        """Whether its log reports that the computer has no usable graphics."""
        return self._program.without_graphics

    @property
    def control_url(self) -> str:
        """Address at which the viewer accepts commands; empty: not known yet."""
        port = self._program.grpc_port
        return proxy_url(_HOSTS[0], port) if port else ""

    def connect(self, address: LiveAddress) -> bool:
        """Connect to a live view whose server was replaced; return whether that succeeded.

        The viewer connects to an address only once. It therefore gets another name of the same
        address. Its earlier sessions are closed, because it would switch to the first of them.
        """
        if not self.control_url or (self._connecting and self._connecting.is_alive()):
            return False
        self._connections += 1
        url = self._next_url(address)
        done: list[bool] = []
        # In a thread, because a frozen window never responds, and the wait would block Ctrl-C.
        self._connecting = threading.Thread(
            target=_switch_server, args=(self.control_url, url, done), daemon=True
        )
        self._connecting.start()
        self._connecting.join(_ANSWER_S)
        return any(done)

    def _next_url(self, address: LiveAddress) -> str:
        return proxy_url(_HOSTS[self._connections % len(_HOSTS)], address.grpc_port)


def _switch_server(control_url: str, url: str, done: list[bool]) -> None:
    """Switch a viewer to another server; append to `done` on success."""
    from rerun.experimental import ViewerClient

    try:
        client = ViewerClient.connect(control_url)
        state = client.get_state()
        earlier = [r.store_id for r in state.recordings if r.store_id != state.active_recording]
        if earlier:
            client.close(store_ids=earlier)
        with contextlib.suppress(ConnectionError):  # it received nothing from there
            client.close(url)
        client.open(url)
    except (OSError, RuntimeError):  # the viewer is busy or about to end
        return
    done.append(True)
