"""Rerun's program as a child process: silent, on loopback only, and ending with this process."""

import collections
import ctypes
import importlib.util
import os
import re
import signal
import subprocess
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from rigd.errors import FailureError
from rigd.live.address import LOOPBACK
from rigd.view.rrd_file import without_settings

_NOWHERE = f"http://{LOOPBACK}:9"
"""The discard port, on which no process listens."""
_QUIET: Mapping[str, str] = {
    # With this variable Rerun sends no usage data.
    "CI": "1",
    # Its requests to the web (newer versions, examples) fail on this computer. Its connections to
    # viewers and recordings ignore proxies.
    **dict.fromkeys(("ALL_PROXY", "HTTPS_PROXY", "HTTP_PROXY"), _NOWHERE),
    **dict.fromkeys(("all_proxy", "https_proxy", "http_proxy"), _NOWHERE),
    "NO_PROXY": "",
    "no_proxy": "",
    # Its log contains its ports, so it must be readable whatever the user has set.
    "RUST_LOG": "info",
    "NO_COLOR": "1",
}
_LISTENING = re.compile(rf"gRPC connections on {re.escape(LOOPBACK)}:(\d+)")
_SERVING_PAGE = re.compile(rf"web-viewer at http://{re.escape(LOOPBACK)}:(\d+)")
_NO_GRAPHICS = re.compile(
    # Neither Vulkan nor OpenGL, or only OpenGL, which is incomplete in Mesa's software renderer.
    "[Nn]o (suitable )?(graphics|wgpu) adapter|Failed to get render context"
)
_MOMENT_S: Final = 0.5
_MOST_READING_S: Final = 10.0
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


class RerunError(FailureError):
    """Rerun's program cannot run."""


class RerunProgram:
    """Rerun's program as a child process, which ends with this one.

    Parameters
    ----------
    options
        Options of its command line.
    environment
        Environment variables in addition to this process's own.

    Raises
    ------
    RerunError
        If the program is missing or cannot be started.
    """

    def __init__(
        self, options: Sequence[str], environment: Mapping[str, str] | None = None
    ) -> None:
        command = [_path(), *("--bind", LOOPBACK), *options]
        try:
            self._process = subprocess.Popen(
                command,
                env={**without_settings(os.environ), **_QUIET, **(environment or {})},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                preexec_fn=_die_with_parent,  # noqa: PLW1509 - one system call, no lock taken
            )
        except OSError as error:
            raise RerunError(f"{command[0]}: cannot be run: {error.strerror}.") from None
        self._ports: dict[re.Pattern[str], int] = {}
        self._last_lines: collections.deque[str] = collections.deque(maxlen=3)
        self._without_graphics = False
        # Read to the end: a program blocks if its output fills the pipe.
        self._reader = threading.Thread(target=self._read_log, daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether the process exists, even if it is frozen."""
        return self._process.poll() is None

    @property
    def exit_code(self) -> int | None:
        """Exit code; None while it is running."""
        return self._process.poll()

    @property
    def grpc_port(self) -> int:
        """Port for connections; 0: not known yet."""
        return self._ports.get(_LISTENING, 0)

    @property
    def page_port(self) -> int:
        """Port of the web viewer's page; 0: not known yet, or no page."""
        return self._ports.get(_SERVING_PAGE, 0)

    @property
    def last_words(self) -> str:
        """The last lines of its log."""
        self._read_on()
        return " ".join(self._last_lines) or "it wrote no log"

    @property
    def without_graphics(self) -> bool:
        """Whether its log reports that the computer has no usable graphics."""
        self._read_on()
        return self._without_graphics

    def kill(self) -> None:
        """Kill the process; it has nothing to save."""
        self._process.kill()
        self._process.wait()

    def _read_on(self) -> None:
        # After the process has ended, read the log to its end.
        self._reader.join(timeout=_MOMENT_S if self.running else _MOST_READING_S)

    def _read_log(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as log:
            for line in log:
                self._last_lines.append(line.strip()[:200])
                # A backtrace follows this line, so it is not among the last lines.
                self._without_graphics |= _NO_GRAPHICS.search(line) is not None
                for pattern in (_LISTENING, _SERVING_PAGE):
                    if found := pattern.search(line):
                        self._ports[pattern] = int(found[1])


def _path() -> str:
    # Not the `rerun` command on the path, a script: ending it would leave the program running.
    package = importlib.util.find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise RerunError("The Python package rerun-sdk is not installed; the live view needs it.")
    return str(Path(package.origin).with_name("rerun"))


_prctl = ctypes.CDLL(None).prctl


def _die_with_parent() -> None:
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
