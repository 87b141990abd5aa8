"""Process of the operator's page: the daemon starts and restarts it, and never waits for it.

The page accepts commands only with a token from the daemon. While the daemon runs, a file in this
user's runtime folder holds address and token.
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

from rigd.daemon._log import NAME
from rigd.runtime import OWN_PYTHON, SINGLE_THREADED, signals_blocked
from rigd.runtime.addresses import announce, file_name, read_address, runtime_folder, started_at

if TYPE_CHECKING:
    from rigd.profile import Profile

PAGE_PORT: Final = 8720
"""Default port of the page."""
_PROGRAM: Final = ("-m", "rigd.web")
_MOST_STARTS: Final = 5
"""Consecutive short-lived starts after which no further start follows."""
_LASTING_S: Final = 60.0
_PAUSE_S: Final = 1.0
_GRACE_S: Final = 3.0

_log = logging.getLogger(NAME)


class PageProcess:
    """The page's server, in a process on which the daemon does not depend.

    Parameters
    ----------
    profile
        Profile of the rig.
    folder
        Folder of the session files.
    socket
        The daemon's socket.
    port
        Port on loopback; None: the default one, or a free one if that is taken.
    on_address
        Called from a thread with the address without its token, or None while there is none.
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
        self._file = _file(profile.name)
        self._on_address = on_address
        self._closing = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread = threading.Thread(target=self._keep_running, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the process; kill it if it does not end by itself."""
        self._closing.set()
        process = self._process
        if process is not None:
            assert process.stdin is not None
            process.stdin.close()
            try:
                process.wait(_GRACE_S)
            except subprocess.TimeoutExpired:
                process.kill()
        self._thread.join(_GRACE_S)
        self._file.unlink(missing_ok=True)

    def _keep_running(self) -> None:
        """Restart the process whenever it ends; runs in its own thread."""
        starts = 0
        while starts < _MOST_STARTS:
            starts += 1
            began_s = time.monotonic()
            try:
                self._run()
            except OSError as error:
                _log.warning("page: its process cannot be started (%s)", error.strerror)
            if time.monotonic() - began_s >= _LASTING_S:
                starts = 0
            self._on_address(None)
            if self._closing.wait(_PAUSE_S):
                return
        _log.error("page: it is not started again; the rig does not need it")

    def _run(self) -> None:
        """Start the process and wait for its end."""
        with signals_blocked():
            process = subprocess.Popen(
                [*OWN_PYTHON, *_PROGRAM],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=os.environ | SINGLE_THREADED,
            )
        self._process = process
        if self._closing.is_set():
            process.kill()
        assert process.stdin is not None
        assert process.stdout is not None
        report = {}
        with process:
            with suppress(OSError, ValueError):
                process.stdin.write(json.dumps(self._job).encode() + b"\n")
                process.stdin.flush()
                for line in process.stdout:
                    report = json.loads(line)
                    if "port" in report:
                        self._announce(report["port"])
            code = process.wait()
        if not self._closing.is_set():
            _log.warning("page: its process ended with code %s: %s", code, report.get("error", ""))

    def _announce(self, port: int) -> None:
        """Announce the address; a restarted process takes the same port, for open pages."""
        self._job["port"] = port
        url = f"http://127.0.0.1:{port}/"
        pid = os.getpid()
        announce(
            self._file, {"pid": pid, "born": started_at(pid), "url": url, "token": self._token}
        )
        self._on_address(url)
        # Other users may read the journal, so the token is shown on a terminal only.
        shown = f"{url}#token={self._token}" if sys.stderr.isatty() else url
        _log.info("page: %s (rigd status shows the address with its token)", shown)


def page_address(rig: str) -> str | None:
    """Return the address of a daemon's page with its token; None if there is none.

    Parameters
    ----------
    rig
        Name of the rig's profile.
    """
    found = read_address(_file(rig))
    pid, born, url, token = (found.get(name) for name in ("pid", "born", "url", "token"))
    if not isinstance(pid, int) or not isinstance(url, str) or not isinstance(token, str):
        return None
    return f"{url}#token={token}" if started_at(pid) == born else None


def _file(rig: str) -> Path:
    return runtime_folder() / f"page-{file_name(rig)}.json"


def _job(profile: "Profile", folder: Path, socket: Path) -> dict[str, Any]:
    """Return the data of a rig that the page shows in addition to those from the socket."""
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
