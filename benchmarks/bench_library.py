"""Library of a thousand sessions: time to rebuild and update its index, and to list it again.

There are twenty files as long as the paper's session, each under fifty names and with a quick look.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from gate import Gate, Row
from timing import cpu_s

from rigd.library import list_sessions
from rigd.testing import Signals, write_session

SESSIONS = 1000
DISTINCT = 20
TICKS = 136_000
RIGD = Path(sys.executable).parent / "rigd"
ROWS = (
    # Required by the operator on an idle computer.
    Row("rigd list, warm", most=1.0, unit="s of processor"),
    Row("index rebuilt", most=60.0, unit="s of processor"),
    # Measured 0.08 to 0.11.
    Row("index with one more session", most=0.3, unit="times rebuilt"),
    Row("rebuilt index equal to the updated one", least=1, unit="(1: yes)"),
)


def write(path: Path, number: int) -> None:
    """Write a session of the paper's length, at rest."""
    still = np.zeros(TICKS)
    signals = Signals(still, still, still, {}, metadata={"specimen": f"antenna {number}"})
    write_session(path, signals)


def fill(folder: Path) -> None:
    """Write the sessions into a folder."""
    modes = [
        {key: {"value": 1.0 + mode, "std": 0.01, "interval_95": [0.9, 1.1]} for key in
         ("frequency_hz", "damping_ratio")} for mode in range(3)
    ]  # fmt: skip
    for number in range(SESSIONS):
        path = folder / f"session-{number:04d}.mcap"
        if number < DISTINCT:
            write(path, number)
        else:
            os.link(folder / f"session-{number % DISTINCT:04d}.mcap", path)
        path.with_suffix(".look.json").write_text(json.dumps({"modes": modes}))


def main() -> None:
    """Measure and print the times, and check the limits."""
    gate = Gate(ROWS, argparse.ArgumentParser(description=__doc__))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fill(folder)
        rebuild_s = cpu_s(lambda: list_sessions(folder))
        warm_s = cpu_s(lambda: list_sessions(folder))
        write(folder / "one-more.mcap", SESSIONS)
        one_more_s = cpu_s(lambda: list_sessions(folder))
        grown = list_sessions(folder)
        command = [RIGD, "list", folder]
        command_s = min(
            cpu_s(lambda: subprocess.run(command, check=True, capture_output=True))
            for _ in range(3)
        )
        (folder / "library.sqlite").unlink()
        same = list_sessions(folder) == grown and len(grown) == SESSIONS + 1
    print(f"library of {SESSIONS} sessions, {TICKS} samples each; warm {warm_s:.3f} s")
    gate.measured("rigd list, warm", command_s)
    gate.measured("index rebuilt", rebuild_s)
    gate.measured("index with one more session", one_more_s / rebuild_s)
    gate.measured("rebuilt index equal to the updated one", same)
    gate.finish()


if __name__ == "__main__":
    main()
