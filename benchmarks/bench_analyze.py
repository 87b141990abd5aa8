"""Cost of `analyze SESSION` with its full report: processor time, wall time and memory.

Usage: python benchmarks/bench_analyze.py [SESSION.mcap]

Without a file, a full session is first recorded on the simulated rig. A record of 30 minutes is
always made (``--minutes``). The peers are processes that only start the interpreter, or only import
the packages that figures need: the least possible time for `--help` and for a report. The limits
are on processor time, which other programs on the computer hardly change. The best of several runs
counts; the long record is analysed once. The limit of a campaign is in `bench_campaign.py`.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from gate import Gate, Row

from rigd.runtime.background import use_one_thread

RUNS = 3
REST_S = 16
"""Rest and ring-down of a record."""
ROWS = (
    # Limits of wall time on an idle computer, where a report takes 4 s; with other programs its
    # processor time was 6 s. "whole record" is the full verdict of one session, with all rivals.
    Row("quick look", most=10, unit="s of processor"),
    Row("analyze, full report", most=8, unit="s of processor"),
    Row("analyze, long record", most=40, unit="s of processor"),
    Row("whole record", most=4, unit="s of processor"),
    Row("memory", most=1000, unit="MB"),
    # Measured 9.7 and 11.
    Row("analyze --help", most=20, unit="times the interpreter alone"),
    Row("full report", most=20, unit="times numpy and matplotlib alone"),
    # Measured 0.7: a report after a quick look, whose fits it uses.
    Row("report with stored fits", most=0.85, unit="times the full report"),
)
ANALYZE = [sys.executable, "-m", "analysis"]
STEPS = """
import resource, sys, time
from pathlib import Path
marks = [("", 0.0)]
mark = lambda name: marks.append((name, time.process_time()))
mark("interpreter")
import analysis.cli.app, analysis.record, analysis.identify, analysis.paper, rich.progress
from analysis.models import WelchSettings
from analysis.identify import BAND_HZ, Measurement
mark("imports of the analysis")
record = analysis.record.load_record(Path(sys.argv[1]))
mark("reading")
welch = analysis.paper.welch_analysis.analyse(record, WelchSettings())
mark("the paper's route")
selection = analysis.identify.select(Measurement.from_record(record))
mark("whole record")
from analysis.results import RecordResult, WholeRecord
from analysis.report.record_report import write_report
mark("imports of matplotlib")
result = RecordResult(record, WholeRecord(record, selection, BAND_HZ), welch)
write_report(result, Path(sys.argv[2]), mark)
mark("page, tables and JSON")
for (name, end), (_, start) in zip(marks[1:], marks):
    print(name, end - start, sep="\\t")
"""


@dataclass(frozen=True)
class Cost:
    """Time and memory of a process, its children included."""

    processor_s: float
    wall_s: float
    megabytes: float


def cost(command: list[str]) -> Cost:
    """Run a process, wait for its end and return its cost."""
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    wall_s = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return Cost(usage.ru_utime + usage.ru_stime, wall_s, usage.ru_maxrss / 1024)


def best_of(runs: Iterable[Cost]) -> Cost:
    """Return the least processor and wall time of several runs and their largest memory."""
    found = list(runs)
    return Cost(
        min(each.processor_s for each in found),
        min(each.wall_s for each in found),
        max(each.megabytes for each in found),
    )


def best(command: list[str]) -> Cost:
    """Return the best cost of a few runs of a process."""
    return best_of(cost(command) for _ in range(RUNS))


def recorded_session(folder: Path, sweep_s: float = 120) -> Path:
    """Record the paper's session, or a longer one, on the simulated rig under the virtual clock."""
    rigd = Path(sys.executable).with_name("rigd")
    command = [rigd, "run", "chirp", "--fast", "--no-look", "--seed", "1"]
    subprocess.run(
        [*command, "--duration", str(sweep_s), "--output", folder],
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    (session,) = folder.glob("*.mcap")
    return session


def steps(session: Path, folder: Path) -> dict[str, float]:
    """Return the processor time of each step in one process; a step includes its first imports."""
    command = [sys.executable, "-c", STEPS, str(session), str(folder)]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return {
        name: float(seconds) for name, seconds in (ln.split("\t") for ln in output.splitlines())
    }


def main() -> None:
    """Print costs, their ratios to the peers and the steps, and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("session", type=Path, nargs="?")
    parser.add_argument("--minutes", type=float, default=30, help="of the long record")
    gate = Gate(ROWS, parser)
    use_one_thread()  # as the command does
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
        if gate.given.session:  # a copy: the quick look is written next to it
            session = Path(shutil.copy(gate.given.session, folder))
        else:
            session = recorded_session(folder)
        long = recorded_session(folder / "long", 60 * gate.given.minutes - REST_S)
        interpreter = best([sys.executable, "-c", "pass"])
        floor = best([sys.executable, "-c", "import numpy, matplotlib.figure"])
        usage = best([*ANALYZE, "--help"])
        whole = best_of(
            cost([*ANALYZE, str(session), "--report", str(folder / f"report{run}")])
            for run in range(RUNS)
        )
        quick_look = best([sys.executable, "-m", "analysis.quick_look", str(session)])
        del os.environ["RIGD_NO_CACHE"]
        cost([sys.executable, "-m", "analysis.quick_look", str(session)])
        stored = best_of(
            cost([*ANALYZE, str(session), "--report", str(folder / f"stored{run}")])
            for run in range(RUNS)
        )
        longest = cost([*ANALYZE, str(long), "--report", str(folder / "report of long")])
        print(f"best of {RUNS} processes, {session.name}, load {os.getloadavg()[0]:.1f}")
        print(f"  {'':28}  processor      wall   memory")
        for what, found in (
            ("interpreter alone", interpreter),
            ("analyze --help", usage),
            ("import numpy and matplotlib", floor),
            ("quick look", quick_look),
            ("analyze, full report", whole),
            ("analyze, stored fits", stored),
            ("analyze, long record", longest),
        ):
            print(
                f"  {what:28}  {found.processor_s:7.3f} s {found.wall_s:7.3f} s "
                f"{found.megabytes:5.0f} MB"
            )
        for what, found in (
            ("quick look", quick_look),
            ("analyze, full report", whole),
            ("analyze, long record", longest),
        ):
            gate.measured(what, found.processor_s)
        gate.measured("memory", max(each.megabytes for each in (quick_look, whole, longest)))
        gate.measured("analyze --help", usage.processor_s / interpreter.processor_s)
        gate.measured("full report", whole.processor_s / floor.processor_s)
        gate.measured("report with stored fits", stored.processor_s / whole.processor_s)
        print("steps of one process, processor time, best of each")
        of_steps: dict[str, list[float]] = {}
        for run in range(RUNS):
            target = folder / f"steps{run}"
            target.mkdir()
            for step, seconds in steps(session, target).items():
                of_steps.setdefault(step, []).append(seconds)
        for step, times_s in of_steps.items():
            print(f"  {step:28}  {min(times_s):7.3f} s")
        gate.measured("whole record", min(of_steps["whole record"]))
    gate.finish()


if __name__ == "__main__":
    main()
