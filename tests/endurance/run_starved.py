"""Sessions in real time with programs that use all processor time: does a session end for it?

The requested number of busy programs runs at the ordinary priority. Meanwhile chirps run one after
the other, alternately without a live view and with one that is read. A session may miss ticks, and
end by them: then they are counted, and named as the reason. No session may end because its
supervisor was too late.

    python tests/endurance/run_starved.py --minutes 10 --busy 4
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from run_viewers import Reading

from rigd.live.address import running
from rigd.safety.limits import OVERLOADED_ADVICE
from rigd.session import read_session

RIGD = Path(sys.executable).parent / "rigd"
RIG = "sim"
OPTIONS = ("--rest", "0.2", "--ring-down", "0.2", "--amplitude", "0.01", "--json")
_POLL_S = 0.2
_OVERHEAD_S = 300.0
"""Time of a session in addition to its record, on a computer as busy as this one."""


@dataclass(frozen=True)
class Outcome:
    """Result of one session."""

    live: bool
    outcome: str
    reason: str
    scheduled: int
    recorded: int
    missed: int
    late: int
    granted: str
    """Priority of the supervisor."""
    complaints: tuple[str, ...] = ()

    def __str__(self) -> str:
        return (
            f"{'live' if self.live else '-':4}  {self.outcome:8}  {self.scheduled:6} scheduled = "
            f"{self.recorded:6} recorded + {self.missed:5} missed, {self.late:5} late  "
            f"supervisor {self.granted}  {self.reason}{'; '.join(('', *self.complaints))}"
        )


def evaluate(result: dict[str, object], stderr: str, *, live: bool) -> Outcome:
    """Return the result of a session, from the command's output and its file.

    Parameters
    ----------
    result
        Result of the session, from the command's JSON.
    stderr
        Messages of the command to the operator.
    live
        Whether it had a live view.
    """
    complaints = []
    outcome, reason = str(result["outcome"]), str(result["reason"])
    granted = "unknown"
    if "upervis" in reason or "Traceback" in stderr:
        complaints.append("ended for the supervisor's sake")
    elif outcome != "complete" and not ("missed ticks" in reason or OVERLOADED_ADVICE in reason):
        complaints.append("what ended it does not name the computer")
    if result["path"]:
        session = read_session(str(result["path"]))
        granted = session.metadata.get("realtime_supervisor_scheduling", "ordinary")
        ticks, file_outcome = session.samples["tick"].astype(np.int64), session.outcome or {}
        counts = {
            key: int(file_outcome[key]) for key in ("scheduled", "recorded", "missed", "lost")
        }
        gaps = counts["scheduled"] - len(ticks)
        if counts["recorded"] != len(ticks) or gaps != counts["missed"] + counts["lost"]:
            complaints.append(f"{len(ticks)} samples of {counts}")
        if counts["lost"]:
            complaints.append(f"{counts['lost']} samples lost")
        if any(result[key] != counts[key] for key in counts):
            complaints.append(f"the file has {counts}")
    elif outcome == "complete":
        complaints.append("no file")

    def number(name: str) -> int:
        return int(str(result[name] or 0))

    return Outcome(
        live,
        outcome,
        reason,
        number("scheduled"),
        number("recorded"),
        number("missed"),
        number("late"),
        granted,
        tuple(complaints),
    )


@contextmanager
def busy(programs: int) -> Iterator[None]:
    """Run a number of busy programs at the ordinary priority."""
    command = [sys.executable, "-c", "while True: pass"]
    running = [subprocess.Popen(command) for _ in range(programs)]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def run(seconds: float, folder: Path, *, live: bool) -> Outcome:
    """Run one session, and read its live view if it has one."""
    viewer = Reading()
    arguments = ["chirp", "--profile", RIG, "--duration", f"{seconds:g}", *OPTIONS]
    arguments += ["--output", str(folder / "sessions"), *(("--live",) if live else ())]
    out, stderr_path = folder / "out.json", folder / "said.txt"
    with out.open("w") as stdout, stderr_path.open("w") as stderr:
        process = subprocess.Popen(
            [RIGD, "run", *arguments, "--no-look"], stdout=stdout, stderr=stderr
        )
        deadline = time.monotonic() + seconds + _OVERHEAD_S
        try:
            while process.poll() is None and time.monotonic() < deadline:
                time.sleep(_POLL_S)
                views = [each for each in running() if each.rig == RIG] if live else []
                if views:
                    viewer.update(views[0], time.monotonic())
        finally:
            viewer.close()
            if process.poll() is None:
                process.terminate()
                process.wait()
    text = stderr_path.read_text("utf-8")
    sessions = json.loads(out.read_text("utf-8") or "{}").get("sessions")
    if not sessions:
        last = text.strip().rsplit("\n", 1)[-1]
        return Outcome(live, "none", last, 0, 0, 0, 0, "unknown", ("no session",))
    outcome = evaluate(sessions[0], text, live=live)
    for path in (folder / "sessions").iterdir():
        path.unlink()
    return outcome


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--busy", type=int, default=4, help="Programs that compute.")
    parser.add_argument("--seconds", type=float, default=20.0, help="Of each sweep.")
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="rigd-starved-"))
    os.environ["XDG_RUNTIME_DIR"] = str(folder)
    end_s = time.monotonic() + 60.0 * given.minutes
    outcomes: list[Outcome] = []
    try:
        with busy(given.busy):
            while time.monotonic() < end_s:
                outcomes.append(run(given.seconds, folder, live=len(outcomes) % 2 == 1))
                print(outcomes[-1], flush=True)  # noqa: T201
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    print(summary(outcomes))  # noqa: T201
    return 1 if any(outcome.complaints for outcome in outcomes) else 0


def summary(outcomes: list[Outcome]) -> str:
    """Return a summary of all sessions."""
    scheduled = sum(outcome.scheduled for outcome in outcomes)
    missed = sum(outcome.missed for outcome in outcomes)
    return (
        f"{len(outcomes)} sessions, {sum(o.outcome == 'complete' for o in outcomes)} complete, "
        f"{sum(bool(o.complaints) for o in outcomes)} with complaints; {missed} of {scheduled} "
        f"ticks missed ({100.0 * missed / max(1, scheduled):.2f} %)"
    )


if __name__ == "__main__":
    sys.exit(main())
