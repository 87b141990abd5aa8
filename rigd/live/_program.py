"""Rerun's program as a child process: silent, on loopback only, and killed with this process."""

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
from rigd.view.rrd_file import without_rerun_variables

_REFUSING_PROXY = f"http://{LOOPBACK}:9"
"""Proxy that refuses all requests: no process listens on the discard port."""
_OFFLINE_ENVIRONMENT: Mapping[
    str, str
] = {  # Environment variables that keep Rerun off the internet
    # With this variable Rerun sends no usage data.
    "CI": "1",
    # Its requests to the web (newer versions, examples) fail on this computer. Its connections to
    # viewers and recordings ignore proxies.
    **dict.fromkeys(("ALL_PROXY", "HTTPS_PROXY", "HTTP_PROXY"), _REFUSING_PROXY),
    **dict.fromkeys(("all_proxy", "https_proxy", "http_proxy"), _REFUSING_PROXY),
    "NO_PROXY": "",
    "no_proxy": "",
    # Its log contains its ports, so it must be readable whatever the user has set.
    "RUST_LOG": "info",
    "NO_COLOR": "1",
}
_GRPC_PORT_PATTERN = re.compile(rf"gRPC connections on {re.escape(LOOPBACK)}:(\d+)")
"""Pattern of the log line with the port for native viewers."""
_PAGE_PORT_PATTERN = re.compile(rf"web-viewer at http://{re.escape(LOOPBACK)}:(\d+)")
"""Pattern of the log line with the port of the page."""
_NO_GRAPHICS_PATTERN = re.compile(  # Pattern of log lines about missing graphics
    # Neither Vulkan nor OpenGL, or only OpenGL, which is incomplete in Mesa's software renderer.
    "[Nn]o (suitable )?(graphics|wgpu) adapter|Failed to get render context"
)
_LOG_WAIT_S: Final = 0.5
"""Seconds to wait for further log lines of a running program."""
_MAX_LOG_END_WAIT_S: Final = 10.0
"""Longest time in seconds to read the log of an ended program to its end."""
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
"""Option of prctl that sets the signal which a process receives when its parent ends."""


class RerunError(FailureError):
    """Rerun's program is missing, cannot be started, or has failed."""


class RerunProgram:
    """Rerun's program as a child process that the system kills when this process ends.

    The constructor raises `RerunError` if the program is missing or cannot be started.
    """

    def __init__(
        self, rerun_options: Sequence[str], extra_environment: Mapping[str, str] | None = None
    ) -> None:
        rerun_command = [_rerun_program_path(), *("--bind", LOOPBACK), *rerun_options]
        try:
            self._process = subprocess.Popen(
                rerun_command,
                env={
                    **without_rerun_variables(os.environ),
                    **_OFFLINE_ENVIRONMENT,
                    **(extra_environment or {}),
                },
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                preexec_fn=_die_with_parent,  # noqa: PLW1509 - one system call, no lock taken
            )
        except OSError as error:
            raise RerunError(f"{rerun_command[0]}: cannot be run: {error.strerror}.") from None
        self._ports: dict[re.Pattern[str], int] = {}
        self._last_lines: collections.deque[str] = collections.deque(maxlen=3)
        self._lacks_graphics = False
        # Read to the end: a program blocks if its output fills the pipe.
        self._reader = threading.Thread(target=self._read_log, daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Process id of Rerun's program."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether the program has not ended; it may be frozen."""
        return self._process.poll() is None

    @property
    def exit_code(self) -> int | None:
        """Exit code of Rerun's program, or None while it is running."""
        return self._process.poll()

    @property
    def grpc_port(self) -> int:
        """Port of Rerun's server for native viewers, or 0 if it is not known yet."""
        return self._ports.get(_GRPC_PORT_PATTERN, 0)

    @property
    def page_port(self) -> int:
        """Port of Rerun's page for browsers, or 0 if it is unknown or there is no page."""
        return self._ports.get(_PAGE_PORT_PATTERN, 0)

    @property
    def last_log_lines(self) -> str:
        """Last lines of the program's log, or "it wrote no log"."""
        self._wait_for_log()
        return " ".join(self._last_lines) or "it wrote no log"

    @property
    def lacks_graphics(self) -> bool:
        """Whether the program's log reports that the computer has no usable graphics."""
        self._wait_for_log()
        return self._lacks_graphics

    def kill(self) -> None:
        """Kill Rerun's program, which has nothing to save."""
        self._process.kill()
        self._process.wait()

    def _wait_for_log(self) -> None:
        """Wait a moment for more log lines, or until an ended program's log is read to its end."""
        # After the end of the program the thread reads the log to its end.
        self._reader.join(timeout=_LOG_WAIT_S if self.running else _MAX_LOG_END_WAIT_S)

    def _read_log(self) -> None:
        """Read the program's log to its end, for ports and errors (run in a thread)."""
        assert self._process.stdout is not None
        with self._process.stdout as log:
            for log_line in log:
                self._last_lines.append(log_line.strip()[:200])
                # A backtrace follows this line, so it is not among the last lines.
                self._lacks_graphics |= _NO_GRAPHICS_PATTERN.search(log_line) is not None
                for port_pattern in (_GRPC_PORT_PATTERN, _PAGE_PORT_PATTERN):
                    if port_match := port_pattern.search(log_line):
                        self._ports[port_pattern] = int(port_match[1])


def _rerun_program_path() -> str:
    """Return the path of Rerun's program, or raise RerunError if it is not installed."""
    # The `rerun` command on the path is a script: killing it would leave the program running.
    package_spec = importlib.util.find_spec("rerun_cli")
    if package_spec is None or package_spec.origin is None:
        raise RerunError("The Python package rerun-sdk is not installed; the live view needs it.")
    return str(Path(package_spec.origin).with_name("rerun"))


_prctl = ctypes.CDLL(None).prctl


def _die_with_parent() -> None:
    """Make the system kill this new process when its parent ends."""
    _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
