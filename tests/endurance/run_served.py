"""The daemon in real time with live view and page, both read all the time: growth of processes.

`rigd serve --live` runs one chirp after the other; the stream of its live view is read, and the
page that `rigd live --web` names is fetched every second. After the first minute no process of
ours may grow by 2 % or more, in memory or in descriptors, and every tick has to be counted.
Rerun's server stores the layout of every session, some 0.4 MB each; it is replaced after
twenty, so its memory only has a ceiling.

    python tests/endurance/run_served.py --minutes 15
"""

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

from run_campaign import ProcessUsage, growth_table
from run_starved import evaluate
from run_viewers import Reading, children

from rigd.live.address import running

RIGD = Path(sys.executable).parent / "rigd"
RIG = "sim"
OPTIONS = ("--rest", "0.2", "--ring-down", "0.2", "--amplitude", "0.01", "--json")
NAMES = {
    "rigd.engine.control_process": "control",
    "rigd.live.publisher": "live",
}
"""Processes that last as long as the daemon; each session has a recorder of its own."""
SERVER_CEILING_KB = 110 * 1024
"""Largest memory of Rerun's server before it is replaced: 16 MiB for late viewers with their
overhead, and the layouts of twenty sessions."""
_READY_S = 60.0
_POLL_S = 1.0
_OVERHEAD_S = 6.0
"""Time of a session in addition to its record."""


class Page:
    """A client that loads the page of the live view again and again."""

    def __init__(self, address: str) -> None:
        self.loaded = 0
        self.failed = 0
        self._address = address
        self._halt = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self) -> None:
        while not self._halt.wait(1.0):
            try:
                with urllib.request.urlopen(self._address, timeout=10.0) as answer:
                    answer.read()
                self.loaded += 1
            except OSError:
                self.failed += 1

    def close(self) -> None:
        """End the client."""
        self._halt.set()
        self._thread.join()


def lasting_processes(supervisor: int) -> dict[str, int]:
    """Return the lasting processes of the daemon by their names."""
    found = {"supervisor": supervisor}
    for child in children(supervisor):
        with contextlib.suppress(OSError):
            command = Path(f"/proc/{child}/cmdline").read_text().split("\0")
            found |= {name: child for module, name in NAMES.items() if module in command}
    if "live" in found and (servers := children(found["live"])):
        found["server"] = servers[0]
    return found


def await_ready() -> None:
    """Wait until the daemon is ready.

    Raises
    ------
    TimeoutError
        If it is not ready in time.
    """
    deadline = time.monotonic() + _READY_S
    while time.monotonic() < deadline:
        done = subprocess.run(
            [RIGD, "status", "--json"], capture_output=True, text=True, check=False
        )
        if done.returncode == 0 and json.loads(done.stdout)["state"] == "ready":
            return
        time.sleep(0.5)
    raise TimeoutError(f"The daemon is not ready after {_READY_S:g} s.")


def follow(minutes: float, seconds: float, folder: Path) -> list[str]:
    """Run the daemon and its readers; print the results, and return complaints."""
    complaints: list[str] = []
    usages: dict[str, list[tuple[float, ProcessUsage]]] = {}
    number = max(1, int(60.0 * minutes / (seconds + _OVERHEAD_S)))
    out, stderr_path = folder / "out.json", folder / "said.txt"
    chirps = ["chirp", "--repeat", str(number), "--duration", f"{seconds:g}", *OPTIONS]
    reading, page = Reading(), None
    with contextlib.ExitStack() as ending:
        log = ending.enter_context((folder / "serve.txt").open("w"))
        stdout, stderr = (ending.enter_context(path.open("w")) for path in (out, stderr_path))
        serve = [
            RIGD,
            "serve",
            "--no-look",
            "--profile",
            RIG,
            "--live",
            "--output",
            folder / "sessions",
        ]
        daemon = subprocess.Popen(serve, stdout=log, stderr=log)
        ending.callback(daemon.wait)
        ending.callback(daemon.terminate)
        ending.callback(reading.close)
        await_ready()
        began_s = time.monotonic()
        client = subprocess.Popen([RIGD, "start", *chirps], stdout=stdout, stderr=stderr)
        while client.poll() is None:
            time.sleep(_POLL_S)
            if views := [each for each in running() if each.rig == RIG]:
                reading.update(views[0], time.monotonic())
                if page is None:
                    named = subprocess.run(
                        [RIGD, "live", "--web"], capture_output=True, text=True, check=True
                    )
                    page = Page(named.stdout.strip())
                    ending.callback(page.close)
            for name, pid in lasting_processes(daemon.pid).items():
                usage = ProcessUsage.in_passing(pid)
                if usage is not None:
                    usages.setdefault(name, []).append((time.monotonic() - began_s, usage))
        connected = reading.connected
    outcomes = [
        evaluate(result, stderr_path.read_text("utf-8"), live=True)
        for result in json.loads(out.read_text("utf-8") or '{"sessions": []}')["sessions"]
    ]
    for outcome in outcomes:
        print(outcome)  # noqa: T201
        complaints += outcome.complaints
        if outcome.outcome != "complete":
            complaints.append(f"{outcome.outcome}: {outcome.reason}")
    if len(outcomes) < number:
        complaints.append(f"{len(outcomes)} sessions of {number}")
    if not connected or page is None or not page.loaded:
        complaints.append("nobody read the live view and its page")
    else:
        print(f"page loaded {page.loaded} times, {page.failed} times not")  # noqa: T201
    server_kb = max((usage.resident_kb for _, usage in usages.pop("server", [])), default=0)
    print(growth_table(usages, complaints))  # noqa: T201
    print(f"Rerun's server: at most {server_kb / 1024:.0f} MB")  # noqa: T201
    if server_kb > SERVER_CEILING_KB:
        complaints.append(f"Rerun's server took {server_kb / 1024:.0f} MB")
    return complaints


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=15.0)
    parser.add_argument("--seconds", type=float, default=54.0, help="Of each sweep.")
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="rigd-served-"))
    os.environ["XDG_RUNTIME_DIR"] = str(folder)
    try:
        complaints = follow(given.minutes, given.seconds, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    for complaint in complaints:
        print(f"WRONG {complaint}")  # noqa: T201
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.exit(main())
