"""Windows of Rerun's viewer for a live view or a file, and its page for a file."""

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

_FILE_VIEWER_MEMORY_LIMIT: Final = "4GiB"
"""Memory of a viewer for a file, above which the oldest data are dropped.

It is enough for a session of some hours."""
_START_TIMEOUT_S: Final = 30.0
"""Longest time in seconds for the start of a server."""
_POLL_PERIOD_S: Final = 0.05
"""Interval in seconds at which the program's state is polled."""


# File in a window or a browser


class _RerunContext:
    """Running Rerun program, which is ended at the end of its context."""

    _program: RerunProgram

    @property
    def program(self) -> RerunProgram:
        """Rerun's program of this window or page."""
        return self._program

    def wait(self) -> int:
        """Wait until the program ends, for example a closed window, and return its exit code."""
        while (exit_code := self._program.exit_code) is None:
            time.sleep(_POLL_PERIOD_S)
        return exit_code

    def close(self) -> None:
        """End Rerun's program."""
        self._program.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Window(_RerunContext):
    """Window of Rerun's viewer, which neither uses nor changes the user's settings of Rerun.

    `content_options` are the command-line arguments that state what it shows first, `memory_limit`
    is the limit above which the oldest data are dropped, and `scratch_folder` is a folder for files
    that Rerun leaves when it is killed.
    """

    def __init__(
        self,
        content_options: tuple[str, ...],
        memory_limit: str,
        scratch_folder: Path,
        rerun_options: tuple[str, ...],
    ) -> None:
        self._program = RerunProgram(
            (
                *content_options,
                *("--port", "0"),
                *("--memory-limit", memory_limit),
                "--hide-welcome-screen",
                *rerun_options,
            ),
            {"XDG_DATA_HOME": str(runtime_folder() / "viewer"), "TMPDIR": str(scratch_folder)},
        )

    @property
    def closing_reason(self) -> str:
        """Sentence for the operator on why the window closed, if the user did not close it."""
        if self._program.lacks_graphics:
            return (
                "The window cannot be drawn: this computer has no Vulkan driver, which Rerun's "
                "viewer needs. Install one; on Debian and Ubuntu the package mesa-vulkan-drivers "
                "has those for most graphics cards, and one that needs none."
            )
        return f"The window was closed by a fault ({self._program.last_log_lines})."


class FileWindow(_Window):
    """Window of Rerun's viewer that shows a recording.

    Parameters
    ----------
    path
        Path of the recording file.
    scratch_folder
        Folder for files that Rerun leaves when it is killed.
    rerun_options
        Further options of Rerun's command line.

    Raises
    ------
    RerunError
        If Rerun's program cannot be started.
    """

    def __init__(
        self, path: Path, scratch_folder: Path, rerun_options: tuple[str, ...] = ()
    ) -> None:
        super().__init__(
            (str(path.absolute()),), _FILE_VIEWER_MEMORY_LIMIT, scratch_folder, rerun_options
        )


class PageOfFile(_RerunContext):
    """Page for browsers on this computer that shows a recording in Rerun's web viewer.

    Parameters
    ----------
    path
        Path of the recording file.
    scratch_folder
        Folder for files that Rerun leaves when it is killed.

    Attributes
    ----------
    address
        Address of the page.

    Raises
    ------
    RerunError
        If Rerun's program cannot be started, or accepts no connections.
    """

    def __init__(self, path: Path, scratch_folder: Path) -> None:
        self._file, self._scratch = path, scratch_folder
        self._start_server(free_port(GRPC_PORT))
        try:
            self._await_server()
            self._page = serve_page(lambda: self.address, lambda: self._program.page_port)
        except BaseException:
            self._program.kill()
            raise
        self.address = LiveAddress.for_this_process(
            path.stem, self._program.grpc_port, self._page.port, time.time_ns()
        )

    def close(self) -> None:
        """Close the page and end Rerun's program."""
        self._page.close()
        super().close()

    def _start_server(self, port: int) -> None:
        """Start Rerun's program as a server of the recording on a port."""
        self._program = RerunProgram(
            (
                str(self._file.absolute()),
                "--serve-web",
                *("--port", str(port)),
                *("--web-viewer-port", "0"),
                *("--server-memory-limit", _FILE_VIEWER_MEMORY_LIMIT),
            ),
            {"TMPDIR": str(self._scratch)},
        )

    def _await_server(self) -> None:
        """Wait until the server accepts connections; use another port if this one is taken."""
        deadline_s = time.monotonic() + _START_TIMEOUT_S
        uses_any_port = False
        while not (self._program.grpc_port and self._program.page_port):
            if not self._program.running:
                if uses_any_port or self._program.grpc_port:
                    raise RerunError(f"The Rerun server ended: {self._program.last_log_lines}.")
                # Most likely another process has taken the port.
                uses_any_port = True
                self._start_server(0)
            if time.monotonic() > deadline_s:
                raise RerunError(
                    f"The Rerun server does not answer: {self._program.last_log_lines}."
                )
            time.sleep(_POLL_PERIOD_S)


# Window on a live view

_LIVE_VIEWER_MEMORY_LIMIT: Final = "2GiB"
"""Memory of a viewer for live views, above which the oldest data are dropped.

It is limited because the same computer may be running the loop."""
_SWITCH_TIMEOUT_S: Final = 5.0
"""Longest time in seconds for the viewer to switch to another server."""
_LOOPBACK_NAMES: Final = ("127.0.0.1", "localhost")
"""Names of this computer, which are used in turn, since a viewer connects to a URL only once."""


class Viewer(_Window):
    """Window of Rerun's viewer that shows live views.

    Parameters
    ----------
    address
        First live view to show.
    scratch_folder
        Folder for files that Rerun leaves when it is killed.
    rerun_options
        Further options of Rerun's command line.

    Raises
    ------
    RerunError
        If Rerun's program cannot be started.
    """

    def __init__(
        self, address: LiveAddress, scratch_folder: Path, rerun_options: tuple[str, ...] = ()
    ) -> None:
        self._connections = 0
        self._connecting: threading.Thread | None = None
        content_options = ("--connect", self._next_url(address))
        super().__init__(content_options, _LIVE_VIEWER_MEMORY_LIMIT, scratch_folder, rerun_options)

    @property
    def pid(self) -> int:
        """Process id of the viewer's program."""
        return self._program.pid

    @property
    def exit_code(self) -> int | None:
        """Exit code of the viewer's program, or None while its window is open."""
        return self._program.exit_code

    @property
    def last_log_lines(self) -> str:
        """Last lines of the viewer's log."""
        return self._program.last_log_lines

    @property
    def lacks_graphics(self) -> bool:
        """Whether the viewer's log reports that the computer has no usable graphics."""
        return self._program.lacks_graphics

    @property
    def control_url(self) -> str:
        """URL at which the viewer accepts commands, or "" if it is not known yet."""
        grpc_port = self._program.grpc_port
        return proxy_url(_LOOPBACK_NAMES[0], grpc_port) if grpc_port else ""

    def connect(self, address: LiveAddress) -> bool:
        """Connect the window to a live view whose server was replaced; return whether it did so.

        The viewer connects to a URL only once, so it receives the URL with another name of this
        computer. Its earlier sessions are closed, because it would switch to the first of them.
        """
        if not self.control_url or (self._connecting and self._connecting.is_alive()):
            return False
        self._connections += 1
        server_url = self._next_url(address)
        switch_successes: list[bool] = []
        # In a thread, because a frozen window never responds, and the wait would block Ctrl-C.
        self._connecting = threading.Thread(
            target=_switch_server,
            args=(self.control_url, server_url, switch_successes),
            daemon=True,
        )
        self._connecting.start()
        self._connecting.join(_SWITCH_TIMEOUT_S)
        return any(switch_successes)

    def _next_url(self, live_address: LiveAddress) -> str:
        """Return a URL of the live view's server that differs from the previous one."""
        return proxy_url(
            _LOOPBACK_NAMES[self._connections % len(_LOOPBACK_NAMES)], live_address.grpc_port
        )


def _switch_server(control_url: str, server_url: str, switch_successes: list[bool]) -> None:
    """Switch a viewer to the server at `url`, and append True to `successes` on success."""
    from rerun.experimental import ViewerClient

    try:
        viewer_client = ViewerClient.connect(control_url)
        viewer_state = viewer_client.get_state()
        earlier_recordings = [
            r.store_id
            for r in viewer_state.recordings
            if r.store_id != viewer_state.active_recording
        ]
        if earlier_recordings:
            viewer_client.close(store_ids=earlier_recordings)
        with contextlib.suppress(ConnectionError):  # the viewer received nothing from this server
            viewer_client.close(server_url)
        viewer_client.open(server_url)
    except (OSError, RuntimeError):  # the viewer is busy or about to end
        return
    switch_successes.append(True)
