"""Time of `rigd stop` in different situations, from the call to the report that sessions ended.

Peer: `rigd --version`, the shortest command. It needs root, for namespaces in which no sessions of
other users can be stopped. ``--count 100`` repeats each situation as often as the documents state.
"""

import argparse
import json
import subprocess
import sys
from statistics import median

from gate import Gate, Row, impossible_here, percent
from stop_scenarios import RIGD, SITUATIONS, can_isolate, isolated
from timing import least_s

MOST_S = 1.0
ROWS = tuple(
    row
    for name in SITUATIONS
    for row in (
        Row(f"{name}: stopped and reported", least=100, unit="%"),
        # Measured 0.6 to 3.3 with other programs running.
        Row(f"{name}: median", most=6, unit="times rigd --version"),
    )
)


def main() -> None:
    """Print a row for each situation, and fail if a stop was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10, help="Stops in each situation.")
    gate = Gate(ROWS, parser)
    count = gate.given.count
    if not can_isolate():
        impossible_here("rigd stop is not measured: that needs root and namespaces (unshare).")
    bare = [str(RIGD), "--version"]
    for name in SITUATIONS:
        bare_s = least_s(lambda: subprocess.run(bare, capture_output=True, check=True), 3)
        script = sys.path[0] + "/stop_scenarios.py"
        done = subprocess.run(
            isolated(sys.executable, script, name, count),
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
        stops = [json.loads(line) for line in done.stdout.splitlines()]
        times = [stop["s"] for stop in stops]
        right = sum(not stop["wrong"] for stop in stops)
        quick = sum(time_s <= MOST_S for time_s in times)
        print(
            f"{name}: {right} of {count} stopped and reported, {quick} within {MOST_S:g} s; "
            f"median {median(times):.2f} s, longest {max(times):.2f} s, "
            f"{median(times) / bare_s:.1f} times rigd --version"
        )
        for stop in stops:
            if stop["wrong"]:
                print(json.dumps(stop))
        gate.measured(f"{name}: stopped and reported", percent(right, count))
        gate.measured(f"{name}: median", median(times) / bare_s)
    gate.finish()


if __name__ == "__main__":
    main()
