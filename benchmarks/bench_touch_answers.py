"""Time from a touch to the report of its position, in real time on this computer.

Runs ``rigd run touch`` into obstacles at 0.05 to 0.97 m, of 100 to 100 000 N/m, at 0.3 to 2 rad/s,
as an operator does, with all processes of a session: loop, recorder, touch process, supervisor. It
prints for each touch the time from the touch (as stated by the last answer) to the line that the
operator reads, then the number of answers in time. Run it on an idle computer.

    python benchmarks/bench_touch_answers.py --touches 40

The default is 8 touches, in a minute.
"""

import argparse
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from bench_touch_sessions import BIN, Meeting, draw_meeting
from gate import Gate, Row, percent

from rigd.session import read_session
from rigd.session.layout import Status

WANTED_S = {"first": 0.3, "last": 1.0}
ROWS = (
    # Measured 0.24 to 0.27 and 0.55 to 0.57 s, 90 and 93 % in time: docs/validation/touch.md.
    Row("first answer, median", most=0.4, unit="s"),
    Row("last answer, median", most=1.0, unit="s"),
    Row("touches with an answer", least=85, unit="%"),
)
RIG = 9000
"""Number of the rig, from which the obstacles are drawn."""


def answers(meeting: Meeting, folder: Path) -> dict[str, Any] | None:
    """Run one session; return the times of the answers to its first touch, None without one."""
    obstacle = f"x={meeting.x_m},angle={meeting.angle_rad},stiffness={meeting.stiffness_n_per_m}"
    command = [
        str(BIN / "rigd"), "run", "touch", str(round(meeting.angle_rad + 0.4, 4)),
        "--speed", str(meeting.speed_rad_s), "--json", "--no-look",
        "--obstacle", obstacle, "--output", "touches",
    ]  # fmt: skip
    environment = os.environ | {"XDG_RUNTIME_DIR": str(folder)}
    answered_s: dict[str, float] = {}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        cwd=folder,
    ) as process:  # fmt: skip
        assert process.stderr is not None and process.stdout is not None
        for line in process.stderr:
            if line.startswith("Touch 1"):
                answered_s["first" if "first estimate" in line else "last"] = time.time()
        [session] = json.loads(process.stdout.read())["sessions"]
    if not session["touches"] or not answered_s:
        return None
    touch = session["touches"][0]
    read = read_session(folder / session["path"])
    noticed = int(np.argmax((read.samples["status"] & Status.TOUCHED) != 0))
    # If the last answer does not state the time of the touch, the time of its detection counts.
    after_s = touch["time_s"]["value"] if touch["time_s"] else noticed / read.number("rate_hz")
    touch_s = read.start_utc_ns * 1e-9 + after_s
    return {name: at - touch_s for name, at in answered_s.items()} | {"kind": touch["kind"]}


def main() -> None:
    """Run the touches, print the times and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--touches", type=int, default=8)
    gate = Gate(ROWS, parser)
    given = gate.given
    seconds: dict[str, list[float]] = {name: [] for name in WANTED_S}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(given.touches):
            meeting = draw_meeting(RIG, number)
            answer = answers(meeting, Path(folder))
            print(
                f"{meeting.x_m:.3f} m, {meeting.stiffness_n_per_m:.0f} N/m, "
                f"{meeting.speed_rad_s:.2f} rad/s:",
                "no answer" if answer is None else answer,
                flush=True,
            )
            for name in WANTED_S:
                if answer and name in answer:
                    seconds[name].append(answer[name])
    for name, wanted_s in WANTED_S.items():
        found = np.array(seconds[name] or [np.nan])
        print(
            f"{name}: {len(found)} of {given.touches}, median {np.median(found):.3f} s, 90 % "
            f"{np.quantile(found, 0.9):.3f}, longest {found.max():.3f}; within {wanted_s} s "
            f"{np.mean(found <= wanted_s):.0%}"
        )
        gate.measured(f"{name} answer, median", np.median(found))
    gate.measured("touches with an answer", percent(len(seconds["last"]), given.touches))
    gate.finish()


if __name__ == "__main__":
    main()
