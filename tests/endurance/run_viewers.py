"""Sessions in real time with viewers that are absent, frozen or killed: is the session affected?

For each kind of viewer a chirp is run at 1 kHz, and one without a live view for comparison. The
memory of publisher and server is polled all the time; then the missed ticks are counted, with and
without those that passed in stalls of the computer itself.

    python tests/endurance/run_viewers.py --minutes 10
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rigd.bench.measure import measurement_from_samples
from rigd.live import Viewer
from rigd.live._program import RerunProgram
from rigd.live.address import LiveAddress, running
from rigd.session import read_session

RIGD = Path(sys.executable).parent / "rigd"
RATE_HZ = 1000
RIG = "sim"
MOST_MB = 200.0
OPTIONS = ("--amplitude", "0.005", "--start-hz", "0.5", "--rest", "0", "--ring-down", "0")
_POLL_S = 0.5


class Nobody:
    """No viewer."""

    def update(self, address: LiveAddress, now_s: float) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


class Frozen:
    """A viewer that is suspended a while after its start, and never resumed."""

    def __init__(self) -> None:
        self._viewer: Viewer | None = None
        self._frozen = False
        self._began_s = 0.0

    def update(self, address: LiveAddress, now_s: float) -> None:
        """Start the viewer, and suspend it later."""
        if self._viewer is None:
            self._viewer, self._began_s = _viewer(address), now_s
        elif not self._frozen and now_s > self._began_s + 5.0:
            assert self._viewer.exit_code is None, self._viewer.last_log_lines
            os.kill(self._viewer.pid, signal.SIGSTOP)
            self._frozen = True

    def close(self) -> None:
        """End the viewer."""
        if self._viewer is not None:
            self._viewer.close()


class Killed:
    """A viewer that is killed and replaced every 20 s."""

    EVERY_S = 20.0

    def __init__(self) -> None:
        self._viewer: Viewer | None = None
        self._due_s = 0.0

    def update(self, address: LiveAddress, now_s: float) -> None:
        """Kill the viewer when it is due, and start another one."""
        if now_s < self._due_s:
            return
        self.close()
        self._viewer = _viewer(address)
        self._due_s = now_s + self.EVERY_S

    def close(self) -> None:
        """Kill the viewer."""
        if self._viewer is not None:
            self._viewer.close()


class Reading:
    """A reader of all data, as fast as it comes, which shows nothing."""

    def __init__(self) -> None:
        self._program: RerunProgram | None = None
        self._server = 0

    def update(self, address: LiveAddress, now_s: float) -> None:
        """Connect, and reconnect if the live view is another one or the connection has ended."""
        gone = self._program is None or not self._program.running
        if not gone and address.server == self._server:
            return
        self.close()
        self._server = address.server
        self._program = RerunProgram((address.proxy_url, "--save", os.devnull, "--port", "0"))

    @property
    def connected(self) -> bool:
        """Whether it is connected."""
        return self._program is not None and self._program.running

    def close(self) -> None:
        """Disconnect."""
        if self._program is not None:
            self._program.kill()
            self._program = None


KINDS = {"none": Nobody, "reading": Reading, "frozen": Frozen, "killed": Killed}


@dataclass
class Outcome:
    """Result of one session."""

    name: str
    missed: int
    missed_between_stalls: int
    lost: int
    recorded: int
    publisher_mb: float = 0.0
    server_mb: float = 0.0

    def __str__(self) -> str:
        text = (
            f"{self.name:12s} {self.recorded} ticks recorded, {self.lost} lost, {self.missed} "
            f"missed, {self.missed_between_stalls} of them while the computer did not stand still"
        )
        if self.publisher_mb:
            text += (
                f"; publisher {self.publisher_mb:.0f} MB, server {self.server_mb:.0f} MB at most"
            )
        return text


def run(name: str, seconds: float) -> Outcome:
    """Run a session with one kind of viewer, or without a live view for any other name."""
    live = ("--live",) if name in KINDS else ()
    viewer = KINDS.get(name, Nobody)()
    publisher_mb = server_mb = 0.0
    with (
        tempfile.TemporaryDirectory(prefix="rigd-viewers-") as folder,
        session("--duration", f"{seconds:g}", *OPTIONS, *live, "--output", folder) as process,
    ):
        try:
            while process.poll() is None:
                time.sleep(_POLL_S)
                for address in [each for each in running() if each.rig == RIG]:
                    viewer.update(address, time.monotonic())
                    publisher_mb = max(publisher_mb, resident_mb(address.pid))
                    server_mb = max(server_mb, *map(resident_mb, children(address.pid)), 0.0)
        finally:
            viewer.close()
        (path,) = Path(folder).glob("*.mcap")
        samples = read_session(path).samples
    scheduled = round(seconds * RATE_HZ)
    found = measurement_from_samples(
        name, RATE_HZ, samples, scheduled_ticks=scheduled, cpu_percent=None, page_faults=None
    )
    return Outcome(
        name,
        missed=found.missed_ticks,
        missed_between_stalls=round((1.0 - found.held_fraction_between_stalls) * scheduled),
        lost=scheduled - found.missed_ticks - len(samples),
        recorded=len(samples),
        publisher_mb=publisher_mb,
        server_mb=server_mb,
    )


@contextmanager
def session(*options: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run ``rigd run chirp``."""
    with subprocess.Popen(
        [RIGD, "run", "chirp", "--no-look", "--profile", RIG, *options]
    ) as process:
        try:
            yield process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)


def children(pid: int) -> list[int]:
    """Return the child processes of a process, of all its threads."""
    found: list[int] = []
    try:
        for task in Path(f"/proc/{pid}/task").iterdir():
            found += map(int, (task / "children").read_text().split())
    except OSError:
        pass
    return found


def resident_mb(pid: int) -> float:
    """Return the resident memory of a process, 0 if it has just ended."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6


def _viewer(address: LiveAddress) -> Viewer:
    scratch = Path(tempfile.gettempdir())
    return Viewer(address, scratch, ("--headless", "--window-size", "640x400"))


def main() -> None:
    """Run all sessions; exit with 1 if a bound is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    seconds = 60.0 * parser.parse_args().minutes
    outcomes = []
    for name in ("without", *KINDS):
        outcomes.append(run(name, seconds))
        print(outcomes[-1], flush=True)  # noqa: T201
    bad = [o.name for o in outcomes if o.lost or o.publisher_mb > MOST_MB]
    if bad:
        raise SystemExit(f"{', '.join(bad)}: ticks were lost, or more than {MOST_MB:g} MB taken.")


if __name__ == "__main__":
    main()
