"""The process that serves the operator's page, which the daemon starts and restarts.

The page accepts commands only with a token from the daemon. While the daemon is running, a file in
this user's runtime folder contains the address and the token.
"""

import logging
import os
import secrets
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rigd.daemon._log import LOGGER_NAME
from rigd.engine.messages import OperatorPageServed, ProcessFailed
from rigd.engine.processes import ChildError, ChildProcess
from rigd.engine.workers import PAGE
from rigd.runtime.addresses import (
    file_name,
    process_start_ticks,
    read_address,
    runtime_folder,
    write_address,
)

if TYPE_CHECKING:
    from rigd.profile import Profile

PAGE_PORT: Final = 8720
"""Default port of the page on the loopback interface."""
_MIN_SUCCESSFUL_RUN_S: Final = 60.0
"""Run time in seconds above which a start of the process counts as successful."""
_RESTART_PAUSE_S: Final = 1.0
"""Pause in seconds before the process is started again."""

_log = logging.getLogger(LOGGER_NAME)


class PageProcess:
    """Supervisor of the process that serves the operator's page.

    The process is restarted if it ends. The daemon does not depend on it. Without `port`, the page
    has the default port or, if that is used, a free port. `on_address` is called in a thread when
    the address changes, with the address (without token), or with None if the page is not served
    any more.
    """

    def __init__(
        self,
        profile: "Profile",
        session_folder: Path,
        daemon_socket_path: Path,
        port: int | None,
        on_address: Callable[[str | None], None],
    ) -> None:
        self._token = secrets.token_urlsafe(24)
        self._job = _page_job(profile, session_folder, daemon_socket_path) | {
            "token": self._token,
            "port": PAGE_PORT if port is None else port,
            "any_port": port is None,
        }
        self._address_path = _address_path(profile.name)
        self._on_address = on_address
        self._is_closing = threading.Event()
        self._child: ChildProcess | None = None
        self._thread = threading.Thread(target=self._restart_repeatedly, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the process of the page, and kill it if it does not end by itself."""
        self._is_closing.set()
        if self._child is not None:
            self._child.close_input()
            self._thread.join(PAGE.end_timeout_s)
            self._child.kill()
        self._thread.join(PAGE.end_timeout_s)
        self._address_path.unlink(missing_ok=True)

    def _restart_repeatedly(self) -> None:
        """Run the process again whenever it ends, unless it ends soon too often (in a thread)."""
        short_run_count = 0
        while short_run_count <= PAGE.restarts:
            short_run_count += 1
            run_begin_s = time.monotonic()
            try:
                self._run_process()
            except ChildError as error:
                _log.warning("page: its process cannot be started (%s)", error.system_reason)
            if time.monotonic() - run_begin_s >= _MIN_SUCCESSFUL_RUN_S:
                short_run_count = 0
            self._on_address(None)
            if self._is_closing.wait(_RESTART_PAUSE_S):
                return
        _log.error("page: it is not started again; the rig does not need it")

    def _run_process(self) -> None:
        """Start the process of the page, announce its address, and wait for its end."""
        self._child = page_process = ChildProcess(PAGE)
        if self._is_closing.is_set():
            page_process.kill()
        failure_text = ""
        try:
            page_process.start(self._job)
            while True:
                match page_process.poll(None):
                    case OperatorPageServed(port):
                        self._announce_page(port)
                    case ProcessFailed(failure_text):
                        pass
        except (ChildError, ValueError):  # it has ended, or its input was closed
            page_process.stop()
        if not self._is_closing.is_set():
            _log.warning(
                "page: its process ended with code %s: %s", page_process.exit_code, failure_text
            )

    def _announce_page(self, port: int) -> None:
        """Announce the page's address, and store the port, which a restarted process uses again."""
        self._job["port"] = port
        page_url = f"http://127.0.0.1:{port}/"
        pid = os.getpid()
        write_address(
            self._address_path,
            {"pid": pid, "born": process_start_ticks(pid), "url": page_url, "token": self._token},
        )
        self._on_address(page_url)
        # The token is printed only on a terminal, because other users may read the journal.
        printed_url = f"{page_url}#token={self._token}" if sys.stderr.isatty() else page_url
        _log.info("page: %s (rigd status shows the address with its token)", printed_url)


def page_address(rig_name: str) -> str | None:
    """Return the URL, with token, of the page of a rig's daemon; None if it is not served.

    Parameters
    ----------
    rig_name
        Name of the rig's profile.
    """
    address_document = read_address(_address_path(rig_name))
    pid, start_ticks, url, token = (
        address_document.get(address_key) for address_key in ("pid", "born", "url", "token")
    )
    if not isinstance(pid, int) or not isinstance(url, str) or not isinstance(token, str):
        return None
    return f"{url}#token={token}" if process_start_ticks(pid) == start_ticks else None


def _address_path(rig_name: str) -> Path:
    """Return the path of the file with the address and the token of a rig's page."""
    return runtime_folder() / f"page-{file_name(rig_name)}.json"


def _page_job(profile: "Profile", session_folder: Path, daemon_socket_path: Path) -> dict[str, Any]:
    """Return the first message to the page's process: what it needs in addition to the status."""
    rig = profile.rig
    return {
        "socket": str(daemon_socket_path),
        "folder": str(session_folder),
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
