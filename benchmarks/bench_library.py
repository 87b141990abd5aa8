"""Library of a thousand sessions: time to rebuild its index, to update it, and to list it warm.

Files are as long as the paper's session, twenty of them under fifty names each; every one has a
quick look. What must hold: `rigd list` below 1 s warm, the index rebuilt below 60 s.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rigd.library import list_sessions
from rigd.testing import Signals, write_session

SESSIONS = 1000
DISTINCT = 20
TICKS = 136_000
RIGD = Path(sys.executable).parent / "rigd"


def write(path: Path, number: int) -> None:
    """Write a session of the paper's length, at rest."""
    still = np.zeros(TICKS)
    signals = Signals(still, still, still, {}, metadata={"specimen": f"antenna {number}"})
    write_session(path, signals)


def fill(folder: Path) -> None:
    """Make the folder of sessions."""
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


def timed(action: Callable[[], object]) -> float:
    """Return the seconds that an action takes."""
    started = time.perf_counter()
    action()
    return time.perf_counter() - started


def main() -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fill(folder)
        anew_s = timed(lambda: list_sessions(folder))
        warm_s = min(timed(lambda: list_sessions(folder)) for _ in range(5))
        write(folder / "one-more.mcap", SESSIONS)
        one_more_s = timed(lambda: list_sessions(folder))
        grown = list_sessions(folder)
        command_s = min(
            timed(lambda: subprocess.run([RIGD, "list", folder], check=True, capture_output=True))
            for _ in range(5)
        )
        (folder / "library.sqlite").unlink()
        same = list_sessions(folder) == grown
    print(f"library of {SESSIONS} sessions, {TICKS} samples each")
    print(f"  index rebuilt      {anew_s:7.2f} s (must be below 60)")
    print(f"  warm              {warm_s:7.3f} s")
    print(f"  one more session  {one_more_s:7.3f} s")
    print(f"  rigd list, warm   {command_s:7.3f} s (must be below 1)")
    print(f"  rebuilt index equal to the updated one: {same}")


if __name__ == "__main__":
    main()
