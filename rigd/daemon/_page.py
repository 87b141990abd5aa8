"""Process of the operator's page: started by the daemon, started again, and never waited for.

It is given a token that is needed to act on the page. Address and token stand in a
file of this user's runtime folder as long as the daemon runs.
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
from rigd.runtime import OWN_PYTHON, SINGLE_THREADED, held_back
from rigd.runtime.addresses import announce, file_name, read_address, runtime_folder, started_at

if TYPE_CHECKING:
    from rigd.profile import Profile

PAGE_PORT: Final = 8720
"""Port of the page unless another is asked for."""
_PROGRAM: Final = ("-m", "rigd.web")
_MOST_STARTS: Final = 5
"""Starts in a row of which none has lasted."""
_LASTING_S: Final = 60.0
_PAUSE_S: Final = 1.0
_GRACE_S: Final = 3.0

_log = logging.getLogger(NAME)


class PageProcess:
    """The server of the page, in a process that the daemon does without.

    Parameters
    ----------
    profile
        Rig that is shown.
    folder
        Folder of the session files.
    socket
        The daemon's socket.
    port
        Port on loopback; None: the usual one, or another if that is taken.
    on_address
        Called with the address, without its token, or None while there is none; from a thread.
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
        self._thread = threading.Thread(target=self._attend, name="page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it; one that does not end by itself is killed."""
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

    def _attend(self) -> None:
        """Keep it running; in its own thread."""
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
        """Start one and wait for its end."""
        with held_back():
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
        told = {}
        with process:
            with suppress(OSError, ValueError):
                process.stdin.write(json.dumps(self._job).encode() + b"\n")
                process.stdin.flush()
                for line in process.stdout:
                    told = json.loads(line)
                    if "port" in told:
                        self._tell(told["port"])
            code = process.wait()
        if not self._closing.is_set():
            _log.warning("page: its process ended with code %s: %s", code, told.get("error", ""))

    def _tell(self, port: int) -> None:
        """Announce where it is; the next one takes the same port, for the pages that are open."""
        self._job["port"] = port
        url = f"http://127.0.0.1:{port}/"
        pid = os.getpid()
        announce(
            self._file, {"pid": pid, "born": started_at(pid), "url": url, "token": self._token}
        )
        self._on_address(url)
        # The journal has other readers than a terminal.
        shown = f"{url}#token={self._token}" if sys.stderr.isatty() else url
        _log.info("page: %s (rigd status shows the address with its token)", shown)


def page_address(rig: str) -> str | None:
    """Return the address of a daemon's page with the token, for the user who started the daemon.

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
    """Return what the page shows of a rig beside what the socket tells."""
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
