"""Hours of rig time under the virtual clock: growth of processes, and counts of all ticks.

`rigd run chirp --fast --repeat N` is one supervisor with one control process. Each finished session
file is checked and deleted, and the memory and the descriptors of every process are recorded.
After the first minute none of them may grow by 2 % or more.

    python tests/endurance/run_campaign.py --hours 12
    python tests/endurance/run_campaign.py --minutes 60
"""

import argparse
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np

from rigd.session import read_session

BIN = Path(sys.executable).parent
RATE_HZ = 1000
MODULES = {"rigd.engine.control_process": "control", "rigd.engine.recorder": "recorder"}

_POLL_S = 0.05
_ENDLESS_HOURS = 500.0
"""Rig time: more than passes in any real campaign."""
WARM_UP = 0.2
"""Fraction of the sessions that is omitted: late imports, and convergence of the heap."""
ENOUGH = 100
"""Least number of sessions for a trend."""
FLAT_KB = 2048
"""Accepted growth over the whole campaign: `rigd run` stores the results of its sessions, some
3 kB each, and prints them at its end."""
FLAT_DESCRIPTORS = 1
"""Accepted growth of descriptors: one or two are open only between two sessions."""


_PAGE_KB = os.sysconf("SC_PAGE_SIZE") // 1024

STEADY_AFTER_S = 60.0
"""Time after which no process may grow any more."""
MOST_GROWTH = 0.02


@dataclass(frozen=True)
class ProcessUsage:
    """Memory and descriptors of a process."""

    resident_kb: int
    """Own and shared memory."""
    private_kb: int
    """Own memory only, to which a leak would add."""
    descriptors: int
    shared_kb: int
    """Shared memory behind its descriptors."""

    @classmethod
    def at(cls, pid: int) -> "ProcessUsage | None":
        """Read the usage of a process, or return None if it has just ended."""
        try:
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
            sizes = {line.split(":")[0]: int(line.split()[1]) for line in lines}
            private_kb = sizes["Private_Clean"] + sizes["Private_Dirty"]
            descriptors = list(Path(f"/proc/{pid}/fd").iterdir())
            shared_kb = sum(map(_shared_kb, descriptors))
        except (OSError, LookupError):
            return None
        return cls(sizes["Rss"], private_kb, len(descriptors), shared_kb)

    @classmethod
    def in_passing(cls, pid: int) -> "ProcessUsage | None":
        """Read size and descriptors only, which does not stall a process in real time.

        The kernel locks a process's memory map while it writes the full account of it: a loop that
        allocates memory then waits for all readers of that account.
        """
        try:
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            descriptors = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
        except (OSError, LookupError):
            return None
        return cls(pages * _PAGE_KB, 0, descriptors, 0)

    @classmethod
    def least(cls, usages: "list[ProcessUsage]") -> "ProcessUsage":
        """Return the minimum of each field: temporary use does not count."""
        return cls(*map(min, zip(*map(astuple, usages), strict=True)))


@dataclass(frozen=True)
class Growth:
    """Growth of a number since the first minute."""

    first: float
    """Median of the first fifth after that minute."""
    last: float
    """Median of the last fifth."""

    @classmethod
    def of(cls, times_s: list[float], values: list[int]) -> "Growth | None":
        """Compare the beginning and the end of a series; None if it is too short for that."""
        steady = [v for t_s, v in zip(times_s, values, strict=True) if t_s >= STEADY_AFTER_S]
        fifth = len(steady) // 5
        if not fifth:
            return None
        return cls(statistics.median(steady[:fifth]), statistics.median(steady[-fifth:]))

    @property
    def fraction(self) -> float:
        """Growth relative to the first value."""
        return self.last / self.first - 1.0 if self.first else float(self.last > 0.0)

    @property
    def too_much(self) -> bool:
        """Whether it has grown."""
        return self.fraction >= MOST_GROWTH


def growth_table(series: dict[str, list[tuple[float, ProcessUsage]]], complaints: list[str]) -> str:
    """Return a table of the growth of processes, and add a complaint for each that is too large.

    Parameters
    ----------
    series
        By process: times of the readings, in s since the start, and the readings.
    complaints
        List to which complaints are added.
    """
    lines = [f"{'since the first minute':24} {'at first':>10} {'at last':>10} {'growth':>8}"]
    for name, usages in series.items():
        for label, field in (("resident, kB", "resident_kb"), ("descriptors", "descriptors")):
            values = [getattr(usage, field) for _, usage in usages]
            growth = Growth.of([t_s for t_s, _ in usages], values)
            if growth is None:
                complaints.append(f"{name}: too few looks to say whether it grows")
                break
            row = f"{name} {label}"
            lines.append(
                f"{row:24} {growth.first:10.0f} {growth.last:10.0f} {100 * growth.fraction:+7.2f} %"
            )
            if growth.too_much:
                complaints.append(f"{row} grew by {100 * growth.fraction:.1f} %")
    return "\n".join(lines)


def _shared_kb(descriptor: Path) -> int:
    """Return the size of the shared memory of a descriptor in /proc."""
    try:
        is_shared = str(descriptor.readlink()).startswith("/dev/shm/")
        return descriptor.stat().st_blocks // 2 if is_shared else 0
    except OSError:
        return 0  # closed meanwhile


def processes(supervisor: int) -> dict[str, int]:
    """Return the processes of a rig by their names."""
    found = {"supervisor": supervisor}
    children = Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text().split()
    for child in children:
        try:
            command = Path(f"/proc/{child}/cmdline").read_text().split("\0")
        except OSError:
            continue
        for module, name in MODULES.items():
            if module in command:
                found[name] = int(child)
    return found


def check(path: Path, *, ended: bool = False) -> tuple[int, str]:
    """Return the ticks of a session file, and its error or an empty text.

    If the campaign was `ended`, the session may have been stopped.
    """
    session = read_session(path)
    outcome, ticks = session.outcome or {}, session.samples["tick"].astype(np.int64)
    counts = {key: int(outcome[key]) for key in ("scheduled", "recorded", "missed", "lost")}
    if outcome["outcome"] not in (("complete", "stopped") if ended else ("complete",)):
        return len(ticks), f"{outcome['outcome']}: {outcome.get('reason')}"
    if counts["scheduled"] != counts["recorded"] + counts["missed"] + counts["lost"]:
        return len(ticks), f"the counts do not add up: {counts}"
    if counts["recorded"] != len(ticks) or not np.array_equal(ticks, np.arange(len(ticks))):
        return len(ticks), f"{len(ticks)} samples of {counts}"
    return len(ticks), ""


@dataclass(frozen=True)
class Trend:
    """Trend of a series of numbers, one per session, after the warm-up."""

    first: float
    """Median of the first third."""
    last: float
    """Median of the last third."""
    slope: float
    """Slope per session of the straight line through the medians of blocks."""
    uncertainty: float
    """Uncertainty of the slope, one standard deviation."""

    @classmethod
    def of(cls, values: list[int]) -> "Trend":
        """Fit a line to the medians of ten blocks: single readings in mid-session scatter."""
        after_warm_up = values[round(WARM_UP * len(values)) :]
        third = max(1, len(after_warm_up) // 3)
        blocks = [b for b in np.array_split(np.array(after_warm_up, float), 10) if len(b)]
        medians = np.array([np.median(block) for block in blocks])
        positions = np.cumsum([len(block) for block in blocks]) - len(blocks[0]) / 2
        slope, uncertainty = 0.0, float("inf")
        if len(medians) > 2:
            centred = positions - positions.mean()
            slope = float(centred @ medians / (centred @ centred))
            residual = medians - medians.mean() - slope * centred
            uncertainty = float(
                np.sqrt(residual @ residual / (len(residual) - 2) / (centred @ centred))
            )
        first, last = (
            statistics.median(after_warm_up[:third]),
            statistics.median(after_warm_up[-third:]),
        )
        return cls(first, last, slope, uncertainty)

    def grows(self, sessions: int, flat: float) -> bool:
        """Whether it grows by more than noise: beyond three deviations, and by more than `flat`."""
        growth = self.slope * sessions
        return sessions >= ENOUGH and growth > flat and self.slope > 3 * self.uncertainty


class Campaign:
    """One `rigd run --repeat`, and its readings.

    With `minutes` it is ended after that time, before its last session.
    """

    def __init__(
        self, sessions: int, duration_s: float, folder: Path, minutes: float | None = None
    ) -> None:
        self.sessions = sessions
        self.usage_over_time: dict[str, list[tuple[float, ProcessUsage]]] = {
            "supervisor": [],
            "control": [],
        }
        """Times in s since the start and readings of each lasting process."""
        self._began_s = time.monotonic()
        self._end_s = None if minutes is None else self._began_s + 60.0 * minutes
        self._ended = False
        self.usages: dict[str, list[ProcessUsage]] = {
            "supervisor": [],
            "control": [],
            "recorder": [],
        }
        """The minimum reading of each process in each session."""
        self._fresh: dict[str, list[ProcessUsage]] = {name: [] for name in self.usages}
        self.complaints: list[str] = []
        self.ticks = 0
        self.files = 0
        self._folder = folder
        arguments = ["chirp", "--profile", "sim", "--fast", "--duration", duration_s, "--json"]
        self._stderr = (folder / "said.txt").open("w+", encoding="utf-8")
        self._process = subprocess.Popen(
            [
                *(BIN / "rigd", "run", *map(str, arguments), "--no-look"),
                *("--repeat", str(sessions), "--output", str(folder / "sessions")),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._stderr,
            env={**os.environ, "XDG_RUNTIME_DIR": str(folder)},
        )

    def follow(self) -> Iterator[int]:
        """Process the files as they come; yield their number."""
        while True:
            ended = self._process.poll() is not None
            if self._end_s is not None and not self._ended and time.monotonic() > self._end_s:
                self._ended = True
                self._process.send_signal(signal.SIGINT)
            if not ended:
                self._read_usages()
            for path in sorted((self._folder / "sessions").glob("*.mcap")):
                self._store_usage()
                self._check_file(path)
                yield self.files
            if ended:
                break
            time.sleep(_POLL_S)
        if self._process.returncode != (130 if self._ended else 0):
            last_line = Path(self._stderr.name).read_text("utf-8").strip().rsplit("\n", 1)[-1]
            self.complaints.append(f"exit code {self._process.returncode}: {last_line}")
        if self.files != self.sessions and not self._ended:
            self.complaints.append(f"{self.files} files of {self.sessions}")

    def close(self) -> None:
        """End the process if it still runs."""
        self._process.terminate()
        self._process.wait()
        self._stderr.close()

    def _read_usages(self) -> None:
        for name, pid in processes(self._process.pid).items():
            usage = ProcessUsage.at(pid)
            if usage is not None:
                self._fresh[name].append(usage)

    def _store_usage(self) -> None:
        for name, usages in self._fresh.items():
            if usages and self.files < self.sessions - 1:  # the processes end in the last one
                self.usages[name].append(ProcessUsage.least(usages))
                if name in self.usage_over_time:
                    passed_s = time.monotonic() - self._began_s
                    self.usage_over_time[name].append((passed_s, self.usages[name][-1]))
            usages.clear()

    def _check_file(self, path: Path) -> None:
        ticks, wrong = check(path, ended=self._ended)
        if wrong:
            self.complaints.append(f"{path.name}: {wrong}")
        self.ticks += ticks
        self.files += 1
        path.unlink()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=12.0, help="Of rig time.")
    parser.add_argument("--minutes", type=float, help="Of the clock, instead of --hours.")
    parser.add_argument("--duration", type=float, default=120.0, help="Of a sweep, s.")
    given = parser.parse_args()
    hours = given.hours if given.minutes is None else _ENDLESS_HOURS
    sessions = round(hours * 3600 / (given.duration + 16.0))
    folder = Path(tempfile.mkdtemp(prefix="rigd-endure-"))
    started_s = time.monotonic()
    campaign = Campaign(sessions, given.duration, folder, given.minutes)
    every = max(1, sessions // 12) if given.minutes is None else 10
    try:
        for number in campaign.follow():
            if number % every == 0:
                print(_progress(campaign, time.monotonic() - started_s), flush=True)  # noqa: T201
    finally:
        campaign.close()
        shutil.rmtree(folder, ignore_errors=True)
    print(report(campaign))  # noqa: T201
    if time.monotonic() - started_s > 2 * STEADY_AFTER_S:
        print(growth_table(campaign.usage_over_time, campaign.complaints))  # noqa: T201
    for complaint in campaign.complaints:
        print(f"WRONG {complaint}")  # noqa: T201
    hours = campaign.ticks / RATE_HZ / 3600
    took_s = time.monotonic() - started_s
    print(f"{campaign.files} files, {hours:.2f} h of record in {took_s:.0f} s")  # noqa: T201
    return 1 if campaign.complaints else 0


def _progress(campaign: Campaign, passed_s: float) -> str:
    latest = {name: usages[-1] for name, usages in campaign.usages.items() if usages}
    sizes = ", ".join(
        f"{name} {usage.private_kb / 1024:.1f} MB {usage.descriptors} fds"
        for name, usage in latest.items()
    )
    return f"{passed_s:5.0f} s  {campaign.files:4} sessions  {sizes}"


def report(campaign: Campaign) -> str:
    """Return the table of the usage of each process, and add complaints of growth."""
    lines = [f"{'':22}  first third  last third  slope a session    a campaign"]
    series = {
        f"{name} {label}": [getattr(usage, field) for usage in usages]
        for name, usages in campaign.usages.items()
        for label, field in (
            ("private, kB", "private_kb"),
            ("resident, kB", "resident_kb"),
            ("shared, kB", "shared_kb"),
            ("descriptors", "descriptors"),
        )
    }
    for name, values in series.items():
        trend = Trend.of(values)
        lines.append(
            f"{name:22}  {trend.first:11.0f} {trend.last:11.0f}  {trend.slope:7.3f} ± "
            f"{trend.uncertainty:5.3f}  {trend.slope * len(values):+10.1f}"
        )
        flat = FLAT_DESCRIPTORS if name.endswith("descriptors") else FLAT_KB
        if trend.grows(campaign.files, flat):
            campaign.complaints.append(f"{name} grows by {trend.slope:.3f} a session")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
