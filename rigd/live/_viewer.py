"""Rerun's native viewer: a window on a live view, or on a file; and the page for a file."""

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
"""Limit beyond which the oldest data are dropped: a session of some hours has room."""
_START_S: Final = 30.0
"""Time in which a server has to accept connections."""
_LOOK_S: Final = 0.05


# File in a window or a browser


class _Playback:
    """Rerun's program with a file, as long as this context is entered."""

    _program: RerunProgram

    @property
    def program(self) -> RerunProgram:
        """The program itself."""
        return self._program

    def wait(self) -> int:
        """Wait until it ends: a window when it is closed, a server not by itself.

        Returns
        -------
        int
            Its exit code.
        """
        while (code := self._program.exit_code) is None:
            time.sleep(_LOOK_S)
        return code

    def close(self) -> None:
        """End it."""
        self._program.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Window(_Playback):
    """The viewer's window. What the user has set in Rerun's own viewer is not used, nor changed.

    Parameters
    ----------
    shown
        Command line that says what is shown first.
    memory
        Limit beyond which the oldest data are dropped.
    scratch
        Folder in which Rerun may leave files: it does when it is ended.
    options
        More of the program's command line.

    Raises
    ------
    RerunError
        If Rerun's program cannot be run.
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
        """Why it was closed, if not by the user: a sentence."""
        if self._program.without_graphics:
            return (
                "The window cannot be drawn: this computer has no Vulkan driver, which Rerun's "
                "viewer needs. Install one; on Debian and Ubuntu the package mesa-vulkan-drivers "
                "has those for most graphics cards, and one that needs none."
            )
        return f"The window was closed by a fault ({self._program.last_words})."


class Window(_Window):
    """The viewer's window on a file.

    Parameters
    ----------
    path
        Path of the recording.
    scratch
        Folder in which Rerun may leave files: it does when it is ended.
    options
        More of the program's command line.

    Raises
    ------
    RerunError
        If Rerun's program cannot be run.
    """

    def __init__(self, path: Path, scratch: Path, options: tuple[str, ...] = ()) -> None:
        super().__init__((str(path.absolute()),), _MOST_MEMORY, scratch, options)


class PageOfFile(_Playback):
    """The viewer's page on a file, on loopback.

    Parameters
    ----------
    path
        Path of the recording.
    scratch
        Folder in which Rerun may leave files.

    Attributes
    ----------
    address
        Address of the page.

    Raises
    ------
    RerunError
        If Rerun's program cannot be run, or takes no connections.
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
        """Take the page away."""
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
                # Most likely another was quicker to take the port.
                anywhere = True
                self._serve(0)
            if time.monotonic() > deadline:
                raise RerunError(f"The Rerun server does not answer: {self._program.last_words}.")
            time.sleep(_LOOK_S)


# Window on a live view

_WINDOW_MEMORY: Final = "2GiB"
"""Limit beyond which the oldest data are dropped; the same computer may be running the loop."""
_ANSWER_S: Final = 5.0
_HOSTS: Final = ("127.0.0.1", "localhost")


class Viewer(_Window):
    """The viewer's window on live views.

    Parameters
    ----------
    address
        Live view that is shown first.
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
        shown = ("--connect", self._next_url(address))
        super().__init__(shown, _WINDOW_MEMORY, scratch, options)

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
        """Last lines of its log."""
        return self._program.last_words

    @property
    def without_graphics(self) -> bool:
        """Whether it said that it cannot draw: that the computer has no graphics it can use."""
        return self._program.without_graphics

    @property
    def control_url(self) -> str:
        """Address at which the viewer accepts commands; empty: none yet."""
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
