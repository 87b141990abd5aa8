"""Hours of rig time under the virtual clock: what grows, and is every tick accounted for?

`rigd run chirp --fast --repeat N` is one supervisor with one control process. Whenever a session
file is finished it is checked and deleted, and the memory and the descriptors of every process are
noted. After the first minute none of them may grow by 2 % or more.

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

_LOOK_S = 0.05
_ENDLESS_HOURS = 500.0
"""Rig time: more than any hour of the clock comes to."""
WARM_UP = 0.2
"""Part of the sessions that is left out: what is imported late, and what a heap settles to."""
ENOUGH = 100
"""Sessions from which on a trend is judged."""
FLAT_KB = 2048
"""Growth over the whole campaign that is accepted: `rigd run` remembers what came of its
sessions, some 3 kB each, to tell it at its end."""
FLAT_DESCRIPTORS = 1
"""Likewise: between two sessions one or two are open that a look in mid-session does not see."""


_PAGE_KB = os.sysconf("SC_PAGE_SIZE") // 1024

SETTLED_S = 60.0
"""After which no process may grow any more."""
MOST_GROWTH = 0.02


@dataclass(frozen=True)
class Look:
    """What a process holds."""

    resident_kb: int
    """Its own and what it shares."""
    private_kb: int
    """Its own alone: what a leak would add to."""
    descriptors: int
    shared_kb: int
    """Shared memory behind its descriptors."""

    @classmethod
    def at(cls, pid: int) -> "Look | None":
        """Look at a process, or return None if it has just ended."""
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
    def in_passing(cls, pid: int) -> "Look | None":
        """Look at size and descriptors only, which does not stall a process in real time.

        The kernel holds a process's memory map while it writes the whole account of it: a loop that
        asks for memory then waits for whoever reads that account, and for who is before them.
        """
        try:
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            descriptors = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
        except (OSError, LookupError):
            return None
        return cls(pages * _PAGE_KB, 0, descriptors, 0)

    @classmethod
    def least(cls, looks: "list[Look]") -> "Look":
        """Return the least of each: what is taken for a while only does not count."""
        return cls(*map(min, zip(*map(astuple, looks), strict=True)))


@dataclass(frozen=True)
class Growth:
    """How far a number has grown since the first minute."""

    first: float
    """Median of the first fifth of what came after it."""
    last: float
    """Median of the last fifth."""

    @classmethod
    def of(cls, times_s: list[float], values: list[int]) -> "Growth | None":
        """Compare the beginning and the end of a series; None if it is too short for that."""
        settled = [v for t_s, v in zip(times_s, values, strict=True) if t_s >= SETTLED_S]
        fifth = len(settled) // 5
        if not fifth:
            return None
        return cls(statistics.median(settled[:fifth]), statistics.median(settled[-fifth:]))

    @property
    def share(self) -> float:
        """Growth over what it was."""
        return self.last / self.first - 1.0 if self.first else float(self.last > 0.0)

    @property
    def too_much(self) -> bool:
        """Whether it has grown."""
        return self.share >= MOST_GROWTH


def growth_table(series: dict[str, list[tuple[float, Look]]], complaints: list[str]) -> str:
    """Return how memory and descriptors of processes have grown, and complain of what has.

    Parameters
    ----------
    series
        By process: when it was looked at, in s since the start, and what was seen.
    complaints
        To be added to.
    """
    lines = [f"{'since the first minute':24} {'at first':>10} {'at last':>10} {'growth':>8}"]
    for name, looks in series.items():
        for what, field in (("resident, kB", "resident_kb"), ("descriptors", "descriptors")):
            values = [getattr(look, field) for _, look in looks]
            growth = Growth.of([t_s for t_s, _ in looks], values)
            if growth is None:
                complaints.append(f"{name}: too few looks to say whether it grows")
                break
            label = f"{name} {what}"
            lines.append(
                f"{label:24} {growth.first:10.0f} {growth.last:10.0f} {100 * growth.share:+7.2f} %"
            )
            if growth.too_much:
                complaints.append(f"{label} grew by {100 * growth.share:.1f} %")
    return "\n".join(lines)


def _shared_kb(descriptor: Path) -> int:
    """Return what lies in shared memory behind a descriptor in /proc."""
    try:
        shared = str(descriptor.readlink()).startswith("/dev/shm/")
        return descriptor.stat().st_blocks // 2 if shared else 0
    except OSError:
        return 0  # closed meanwhile, as the one with which it was found


def processes(supervisor: int) -> dict[str, int]:
    """Return the processes of a rig by what they are."""
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
    """Return the ticks of a session file, and what is wrong with it, or nothing.

    One in which the campaign was `ended` may have been stopped.
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
    """How a series of numbers, one per session, develops after the warm-up."""

    first: float
    """Median of the first third."""
    last: float
    """Median of the last third."""
    slope: float
    """Per session, of the straight line through the medians of blocks."""
    uncertainty: float
    """Uncertainty of the slope, one standard deviation."""

    @classmethod
    def of(cls, values: list[int]) -> "Trend":
        """Fit a line to the medians of ten blocks: single looks in mid-session scatter."""
        kept = values[round(WARM_UP * len(values)) :]
        third = max(1, len(kept) // 3)
        blocks = [b for b in np.array_split(np.array(kept, float), 10) if len(b)]
        medians = np.array([np.median(block) for block in blocks])
        places = np.cumsum([len(block) for block in blocks]) - len(blocks[0]) / 2
        slope, uncertainty = 0.0, float("inf")
        if len(medians) > 2:
            away = places - places.mean()
            slope = float(away @ medians / (away @ away))
            rest = medians - medians.mean() - slope * away
            uncertainty = float(np.sqrt(rest @ rest / (len(rest) - 2) / (away @ away)))
        first, last = statistics.median(kept[:third]), statistics.median(kept[-third:])
        return cls(first, last, slope, uncertainty)

    def grows(self, sessions: int, flat: float) -> bool:
        """Whether it grows by more than noise: beyond three deviations, and by more than `flat`."""
        growth = self.slope * sessions
        return sessions >= ENOUGH and growth > flat and self.slope > 3 * self.uncertainty


class Campaign:
    """One `rigd run --repeat`, and what was seen of it.

    With `minutes` it is ended after that time, and has more sessions than it comes to.
    """

    def __init__(
        self, sessions: int, duration_s: float, folder: Path, minutes: float | None = None
    ) -> None:
        self.sessions = sessions
        self.seen: dict[str, list[tuple[float, Look]]] = {"supervisor": [], "control": []}
        """When, in s since the start, each process that lasts held how much."""
        self._began_s = time.monotonic()
        self._end_s = None if minutes is None else self._began_s + 60.0 * minutes
        self._ended = False
        self.looks: dict[str, list[Look]] = {"supervisor": [], "control": [], "recorder": []}
        """The least that each process held in the course of each session."""
        self._fresh: dict[str, list[Look]] = {name: [] for name in self.looks}
        self.complaints: list[str] = []
        self.ticks = 0
        self.files = 0
        self._folder = folder
        arguments = ["chirp", "--profile", "sim", "--fast", "--duration", duration_s, "--json"]
        self._said = (folder / "said.txt").open("w+", encoding="utf-8")
        self._process = subprocess.Popen(
            [
                *(BIN / "rigd", "run", *map(str, arguments), "--no-look"),
                *("--repeat", str(sessions), "--output", str(folder / "sessions")),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._said,
            env={**os.environ, "XDG_RUNTIME_DIR": str(folder)},
        )

    def follow(self) -> Iterator[int]:
        """Attend to the files as they come; yields their number."""
        while True:
            ended = self._process.poll() is not None
            if self._end_s is not None and not self._ended and time.monotonic() > self._end_s:
                self._ended = True
                self._process.send_signal(signal.SIGINT)
            if not ended:
                self._look()
            for path in sorted((self._folder / "sessions").glob("*.mcap")):
                self._note()
                self._take(path)
                yield self.files
            if ended:
                break
            time.sleep(_LOOK_S)
        if self._process.returncode != (130 if self._ended else 0):
            said = Path(self._said.name).read_text("utf-8").strip().rsplit("\n", 1)[-1]
            self.complaints.append(f"exit code {self._process.returncode}: {said}")
        if self.files != self.sessions and not self._ended:
            self.complaints.append(f"{self.files} files of {self.sessions}")

    def close(self) -> None:
        """End it, if it has not ended."""
        self._process.terminate()
        self._process.wait()
        self._said.close()

    def _look(self) -> None:
        for name, pid in processes(self._process.pid).items():
            look = Look.at(pid)
            if look is not None:
                self._fresh[name].append(look)

    def _note(self) -> None:
        for name, looks in self._fresh.items():
            if looks and self.files < self.sessions - 1:  # in the last one they end
                self.looks[name].append(Look.least(looks))
                if name in self.seen:
                    passed_s = time.monotonic() - self._began_s
                    self.seen[name].append((passed_s, self.looks[name][-1]))
            looks.clear()

    def _take(self, path: Path) -> None:
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
    if time.monotonic() - started_s > 2 * SETTLED_S:
        print(growth_table(campaign.seen, campaign.complaints))  # noqa: T201
    for complaint in campaign.complaints:
        print(f"WRONG {complaint}")  # noqa: T201
    hours = campaign.ticks / RATE_HZ / 3600
    took_s = time.monotonic() - started_s
    print(f"{campaign.files} files, {hours:.2f} h of record in {took_s:.0f} s")  # noqa: T201
    return 1 if campaign.complaints else 0


def _progress(campaign: Campaign, passed_s: float) -> str:
    latest = {name: looks[-1] for name, looks in campaign.looks.items() if looks}
    sizes = ", ".join(
        f"{name} {look.private_kb / 1024:.1f} MB {look.descriptors} fds"
        for name, look in latest.items()
    )
    return f"{passed_s:5.0f} s  {campaign.files:4} sessions  {sizes}"


def report(campaign: Campaign) -> str:
    """Return the table of what each process holds, and note what grows."""
    lines = [f"{'':22}  first third  last third  slope a session    a campaign"]
    series = {
        f"{name} {what}": [getattr(look, field) for look in looks]
        for name, looks in campaign.looks.items()
        for what, field in (
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
