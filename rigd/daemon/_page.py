"""The process that serves the operator's page, which the daemon starts and restarts.

The page accepts commands only with a token from the daemon. While the daemon is running, a file in
this user's runtime folder contains the address and the token.
"""

import json
import logging
import os
import secrets
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rigd.daemon._log import LOGGER_NAME
from rigd.runtime import OWN_PYTHON, SINGLE_THREADED, signals_blocked
from rigd.runtime.addresses import announce, file_name, read_address, runtime_folder, started_at

if TYPE_CHECKING:
    from rigd.profile import Profile

PAGE_PORT: Final = 8720
"""Default port of the page on the loopback interface."""
_PAGE_SERVER_ARGUMENTS: Final = ("-m", "rigd.web")
"""Arguments of Python that run the server of the page."""
_MAX_SHORT_STARTS: Final = 5
"""Maximum number of consecutive starts after each of which the process ended soon."""
_SUCCESSFUL_RUN_S: Final = 60.0
"""Run time in seconds from which a start counts as successful."""
_RESTART_PAUSE_S: Final = 1.0
"""Pause in seconds before the process is started again."""
_END_TIMEOUT_S: Final = 3.0
"""Time in seconds that the process has to end before it is killed."""

_log = logging.getLogger(LOGGER_NAME)


class PageProcess:
    """Supervisor of the process that serves the operator's page.

    The process is restarted if it ends. The daemon does not depend on it.

    Parameters
    ----------
    profile
        Profile of the rig.
    folder
        Folder of the session files.
    socket
        Path of the daemon's socket.
    port
        Port on the loopback interface, or None for the default port or, if used, a free port.
    on_address
        Called from a thread with the page's address without its token, or with None while the page
        is not served.
    """

    def __init__(
        self,
        profile: "Profile",
        folder: Path,
        socket: Path,
        port: int | None,
        on_address: Callable[[str | None], None],
    ) -> None:
        self._token = secrets.token_urlsafe(24)
        self._job = _job(profile, folder, socket) | {
            "token": self._token,
            "port": PAGE_PORT if port is None else port,
            "any_port": port is None,
        }
        self._address_path = _address_path(profile.name)
        self._on_address = on_address
        self._is_closing = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._restart_repeatedly, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the process of the page, and kill it if it does not end by itself."""
        self._is_closing.set()
        process = self._process
        if process is not None:
            assert process.stdin is not None
            process.stdin.close()
            try:
                process.wait(_END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
        self._thread.join(_END_TIMEOUT_S)
        self._address_path.unlink(missing_ok=True)

    def _restart_repeatedly(self) -> None:
        """Start the process again whenever it ends, up to a number of times; run in a thread."""
        short_starts = 0
        while short_starts < _MAX_SHORT_STARTS:
            short_starts += 1
            began_s = time.monotonic()
            try:
                self._run_process()
            except OSError as error:
                _log.warning("page: its process cannot be started (%s)", error.strerror)
            if time.monotonic() - began_s >= _SUCCESSFUL_RUN_S:
                short_starts = 0
            self._on_address(None)
            if self._is_closing.wait(_RESTART_PAUSE_S):
                return
        _log.error("page: it is not started again; the rig does not need it")

    def _run_process(self) -> None:
        """Start the process of the page, announce its address, and wait for its end."""
        with signals_blocked():
            page_process = subprocess.Popen(
                [*OWN_PYTHON, *_PAGE_SERVER_ARGUMENTS],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=os.environ | SINGLE_THREADED,
            )
        self._process = page_process
        if self._is_closing.is_set():
            page_process.kill()
        assert page_process.stdin is not None
        assert page_process.stdout is not None
        port_report = {}
        with page_process:
            with suppress(OSError, ValueError):
                page_process.stdin.write(json.dumps(self._job).encode() + b"\n")
                page_process.stdin.flush()
                for output_line in page_process.stdout:
                    port_report = json.loads(output_line)
                    if "port" in port_report:
                        self._announce(port_report["port"])
            exit_code = page_process.wait()
        if not self._is_closing.is_set():
            _log.warning(
                "page: its process ended with code %s: %s", exit_code, port_report.get("error", "")
            )

    def _announce(self, port: int) -> None:
        """Announce the page's address; a restarted process uses the same port, for open pages."""
        self._job["port"] = port
        url = f"http://127.0.0.1:{port}/"
        pid = os.getpid()
        announce(
            self._address_path,
            {"pid": pid, "born": started_at(pid), "url": url, "token": self._token},
        )
        self._on_address(url)
        # The token is printed only on a terminal, because other users may read the journal.
        shown_address = f"{url}#token={self._token}" if sys.stderr.isatty() else url
        _log.info("page: %s (rigd status shows the address with its token)", shown_address)


def page_address(rig: str) -> str | None:
    """Return the address of the page of a rig's daemon with its token, or None if not served.

    Parameters
    ----------
    rig
        Name of the rig's profile.
    """
    address_document = read_address(_address_path(rig))
    pid, start_ticks, url, token = (
        address_document.get(address_key) for address_key in ("pid", "born", "url", "token")
    )
    if not isinstance(pid, int) or not isinstance(url, str) or not isinstance(token, str):
        return None
    return f"{url}#token={token}" if started_at(pid) == start_ticks else None


def _address_path(rig: str) -> Path:
    """Return the path of the file with the address and the token of a rig's page."""
    return runtime_folder() / f"page-{file_name(rig)}.json"


def _job(profile: "Profile", folder: Path, socket: Path) -> dict[str, Any]:
    """Return the data of a rig that the page shows in addition to the daemon's status."""
    rig = profile.rig
    return {
        "socket": str(socket),
        "folder": str(folder),
        "profile": profile.name,
        "description": profile.description,
        "rate_hz": rig.rate_hz,
        "limits": asdict(profile.limits),
        "required_meta": list(profile.metadata.required),
        "beam": asdict(rig.beam),
        "damping": asdict(rig.damping),
        "tool_inertia_kg_m2": rig.sensor.tool_inertia_kg_m2,
        "angle_delay_s": rig.encoder.delay_s,
        "torque_delay_s": rig.sensor.delay_s,
    }
