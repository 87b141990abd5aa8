"""Whole-process time of `analyze`, from interpreter start to the last figure, and where it goes.

Usage: python benchmarks/bench_analyze.py [SESSION.mcap]

Without a file a full session is recorded on the simulated rig first. The peers are processes that
only start the interpreter, or only import what figures cannot do without: the floor for `--help`
and for a report.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

RUNS = 5
ANALYZE = [sys.executable, "-m", "analysis.cli"]


def best_s(command: list[str], runs: int = RUNS) -> float:
    """Shortest wall time of a process in seconds."""
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        times.append(time.perf_counter() - start)
    return min(times)


def recorded_session(folder: Path) -> Path:
    """Record the paper's session on the simulated rig under the virtual clock."""
    rigd = Path(sys.executable).with_name("rigd")
    subprocess.run(
        [rigd, "run", "chirp", "--fast", "--output", folder],
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    (session,) = folder.glob("*.mcap")
    return session


def steps(session: Path, folder: Path) -> dict[str, float]:
    """Seconds of each step in one process, imports included where they first occur."""
    code = f"""
import time
from pathlib import Path
marks = [("", time.perf_counter())]
mark = lambda name: marks.append((name, time.perf_counter()))
from analysis.record import load_record
from analysis.settings import WelchSettings
from analysis.welch_route import analyse
mark("import analysis")
record = load_record(Path({str(session)!r})); mark("read file")
on_step = lambda done: mark("estimate" if "response" in done else "fits")
analysis = analyse(record, WelchSettings(), on_step)
from analysis.report import style, frf_figure, signals_figure, torque_figure
mark("import matplotlib")
from analysis.report.write import write_report
write_report(analysis, Path({str(folder)!r}), lambda done: mark(done))
mark("tables and JSON")
for (name, end), (_, start) in zip(marks[1:], marks):
    print(name, end - start, sep="\\t")
"""
    output = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout
    found: dict[str, float] = {}
    for line in output.splitlines():
        name, seconds = line.split("\t")
        found[name] = found.get(name, 0.0) + float(seconds)
    return found


def main() -> None:
    """Print the times and their ratios to the peers."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        session = Path(sys.argv[1]) if len(sys.argv) > 1 else recorded_session(folder)
        interpreter_s = best_s([sys.executable, "-c", "pass"])
        floor_s = best_s([sys.executable, "-c", "import numpy, matplotlib.figure"])
        help_s = best_s([*ANALYZE, "--help"])
        runs = iter(range(RUNS))
        whole_s = min(
            best_s([*ANALYZE, str(session), "--report", str(folder / f"report{run}")], runs=1)
            for run in runs
        )
        print(f"best of {RUNS} processes, {session.name}")
        print(f"  interpreter alone             {interpreter_s:6.3f} s")
        print(f"  analyze --help                {help_s:6.3f} s  {help_s / interpreter_s:5.1f} x")
        print(f"  import numpy and matplotlib   {floor_s:6.3f} s")
        print(f"  analyze, twelve fits, report  {whole_s:6.3f} s  {whole_s / floor_s:5.1f} x")
        steps_folder = folder / "steps"
        steps_folder.mkdir()
        print("steps of one process")
        for step, seconds in steps(session, steps_folder).items():
            print(f"  {step:28}  {seconds:6.3f} s")


if __name__ == "__main__":
    main()
