"""A file of Rerun's, played in its viewer: in a window, or served to browsers on this computer."""

import time
from pathlib import Path
from typing import Final, Self

from rigd.devices.simulator import runtime_folder
from rigd.live.address import LiveAddress
from rigd.live.outlet import GRPC_PORT, free_port
from rigd.live.page import serve_page
from rigd.live.program import RerunError, RerunProgram

_MOST_MEMORY: Final = "4GiB"
"""Then the oldest is forgotten: a session of some hours has room."""
_START_S: Final = 30.0
"""In which a server has to take connections."""
_LOOK_S: Final = 0.05


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


class Window(_Playback):
    """The viewer's window on a file.

    What the user has set in Rerun's own viewer is neither used nor changed.

    Parameters
    ----------
    path
        Of the recording.
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
        self._program = RerunProgram(
            (
                str(path.absolute()),
                *("--port", "0"),
                *("--memory-limit", _MOST_MEMORY),
                "--hide-welcome-screen",
                *options,
            ),
            {"XDG_DATA_HOME": str(runtime_folder() / "viewer"), "TMPDIR": str(scratch)},
        )


class PageOfFile(_Playback):
    """The viewer's page on a file, on loopback.

    Parameters
    ----------
    path
        Of the recording.
    scratch
        Folder in which Rerun may leave files.

    Attributes
    ----------
    address
        Where it is.

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
