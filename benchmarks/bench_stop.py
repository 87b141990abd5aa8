"""`rigd stop` from wherever it may be called: from the call to the report that all has ended.

Peer: `rigd --version`, the least that the command line can do. It needs root, for namespaces in
which no session of anybody else can be stopped. ``--count 100`` repeats each situation as often as
is asked for in the documents.
"""

import argparse
import json
import subprocess
import sys
from statistics import median

from stop_scenarios import RIGD, SITUATIONS, can_isolate, isolated
from timing import least_s

MOST_S = 1.0


def main() -> None:
    """Print a row a situation, and fail if a stop was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10, help="Stops in each situation.")
    count = parser.parse_args().count
    if not can_isolate():
        print("rigd stop: not measured; it needs root, and namespaces of its own (unshare)")
        return
    bare = [str(RIGD), "--version"]
    bare_s = least_s(lambda: subprocess.run(bare, capture_output=True, check=True), 5)
    print(f"rigd --version: {bare_s:.2f} s")
    failed = False
    for name in SITUATIONS:
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
        failed |= right < count
        print(
            f"{name}: {right} of {count} stopped and reported, {quick} within {MOST_S:g} s; "
            f"median {median(times):.2f} s, longest {max(times):.2f} s, "
            f"{median(times) / bare_s:.1f} times rigd --version"
        )
        for stop in stops:
            if stop["wrong"]:
                print(json.dumps(stop))
    if failed:
        sys.exit(1)


if __name__ == "__main__":
    main()
