"""Every EDS file of a folder on paper and, as an independent node, in sessions; prints a table.

    python tests/independent/run_public_eds.py FOLDER [--only NAME ...] [--ignore-timing]

A drive with cyclic synchronous torque mode has to pass `rigd check`, a chirp, a fault in
mid-session, `rigd reset` and the next chirp; left on by a killed host it has to be off within 0.2 s
of the first frame of `rigd reset`, or that has to fail and report it. Any other drive has to be
refused by the name of the object, on paper within a second and on the bus.

Every row of `rigd check` counts; `--ignore-timing` leaves out those on times, which a computer that
is busy with other things spoils, and the summary reports it.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from scene import RIGD, TIMES, Done, Scene

OFF_WITHIN_S = 0.2
TIMELY_S = 1.0
FAULT = 0x2310
_OBJECT = re.compile(r"\b(?:object )?[1-6][0-9A-F]{3}(?::\d+)?\b")
_ACCEPT = re.compile(r'accept_without = \["(\w+)"\]')
LEFT_ON = ("keeps on", "ignored")
"""How a drive may take NMT pre-operational that does not switch off by it."""


@dataclass
class Paper:
    """Verdict of `rigd check --eds`."""

    usable: bool
    seconds: float
    cpu_s: float
    """Processor time, independent of other load."""
    why: str
    accept: list[str]
    absent: set[str]


@dataclass
class Verdict:
    """Result of one file."""

    name: str
    paper: Paper
    steps: dict[str, str] = field(default_factory=dict)
    """Step to "ok" or to its error; a text that begins with "(" states why it was left out."""

    @property
    def errors(self) -> list[str]:
        return [f"{k}: {v}" for k, v in self.steps.items() if not v.startswith(("ok", "("))]

    @property
    def outcome(self) -> str:
        """Category in the summary."""
        if self.errors:
            return "with complaints"
        if any(result.startswith("(") for result in self.steps.values()):
            return "not put to the test"
        return "passed in sessions" if self.paper.usable else "refused as it has to be"


def on_paper(eds: Path) -> Paper:
    """Run `rigd check --eds`, which connects to nothing."""
    began_s, before = time.monotonic(), os.times()
    done = subprocess.run(
        [RIGD, "check", "--eds", eds, "--json"],
        capture_output=True, text=True, timeout=60.0, check=False,
    )  # fmt: skip
    seconds, after = time.monotonic() - began_s, os.times()
    cpu_s = after.children_user + after.children_system
    cpu_s -= before.children_user + before.children_system
    if not done.stdout.startswith("{"):
        return Paper(False, seconds, cpu_s, done.stderr.strip() or "no answer", [], set())
    document = json.loads(done.stdout)
    rows = document["rows"]
    text = json.dumps(rows)
    failed = [" ".join(str(v) for v in row.values()) for row in rows if row["verdict"] == "failed"]
    why = "; ".join(dict.fromkeys(m for row in failed for m in _OBJECT.findall(row)))
    accept = sorted(set(_ACCEPT.findall(text.replace('\\"', '"'))))
    absent = set(re.findall(r"no object ([0-9A-F]{4})", text))
    return Paper(document["verdict"] != "failed", seconds, cpu_s, why, accept, absent)


def profile_for(paper: Paper, eds: Path) -> dict[str, object]:
    """Return the settings that an operator takes from `rigd check --eds`."""
    values: dict[str, object] = {"cia402.eds": str(eds)}
    if paper.accept:
        values["cia402.accept_without"] = paper.accept
    sections = eds.read_text("utf-8", errors="replace").upper()
    if "[6076]" not in sections:
        values["cia402.rated_torque_unit_nm"] = 0.0
    if "[6080]" not in sections:
        values["cia402.max_speed_rad_s"] = 0.0
    return values


def complete(done: Done) -> str:
    return "ok" if done.code == 0 and "Complete: " in done.printed else f"{done.code}: {done.last}"


def play_session_with_fault(scene: Scene) -> str:
    """Let the drive fail in mid-session; return "ok" or the error."""
    process = scene.start_chirp()
    try:
        scene.await_torque()
    except RuntimeError as error:
        return f"{error}: {scene.finish(process).last}"
    state = scene.order(do="fault", code=FAULT)
    done = scene.finish(process)
    if state["per_mille"] or scene.state()["per_mille"]:
        return "the node has a torque in fault"
    if done.code != 1 or f"0x{FAULT:04X}" not in done.printed or "Traceback" in done.printed:
        return f"{done.code}: {done.last}"
    return "ok"


def play(
    name: str,
    eds: Path,
    node: dict[str, object] | None = None,
    left_on: tuple[str, ...] = LEFT_ON,
    *,
    ignore_timing: bool = False,
) -> Verdict:
    """Put one file to the test."""
    paper = on_paper(eds)
    verdict = Verdict(name, paper)
    steps = verdict.steps
    profile = profile_for(paper, eds)
    try:
        scene = Scene(eds, node=node, profile=profile)
    except RuntimeError as error:
        steps["node"] = f"({error})"
        return verdict
    with scene:
        if not paper.usable:
            steps["named on paper"] = _named(paper, ignore_timing=ignore_timing)
            steps["refused"] = _refused(scene)
            return verdict
        steps["check"] = "; ".join(scene.check(ignore_timing=ignore_timing)) or "ok"
        steps["chirp"] = complete(scene.chirp())
        if steps["chirp"] != "ok":
            return verdict
        steps["fault"] = play_session_with_fault(scene)
        done = scene.reset()
        off = scene.state()["state"] == "switch-on disabled"
        steps["reset"] = "ok" if done.code == 0 and off else f"{done.code}: {done.last}"
        steps["chirp again"] = complete(scene.chirp())
    for how in left_on:
        steps[f"left on, pre-op {how}"] = play_left_on(eds, how, node, profile)
    return verdict


def _named(paper: Paper, *, ignore_timing: bool) -> str:
    if not _OBJECT.search(paper.why):
        return paper.why
    took_s = paper.cpu_s if ignore_timing else paper.seconds
    if took_s > TIMELY_S:
        return f"only after {took_s:.2f} s"
    return f"ok: {paper.why}"


def _refused(scene: Scene) -> str:
    done = scene.chirp()
    enabled = [e for e in scene.log("state") if e["state"] == "operation enabled"]
    if enabled:
        return "it was enabled"
    if done.code != 1 or "Traceback" in done.printed or not _OBJECT.search(done.last):
        return f"{done.code}: {done.last}"
    frames = [e["t_s"] for e in scene.log("sdo", "nmt")]
    took_s = frames[-1] - frames[0] if frames else 0.0
    if took_s > TIMELY_S:
        return f"only after {took_s:.2f} s on the bus"
    return f"ok: {_OBJECT.findall(done.last)[0]}, {took_s:.2f} s"


def play_left_on(
    eds: Path, how: str, node: dict[str, object] | None, profile: dict[str, object] | None = None
) -> str:
    """Run `rigd reset` on a drive that a killed host left turning."""
    given = {"pre_operational": how} | (node or {})
    with Scene(eds, node=given, profile=profile) as scene:
        scene.order(do="leave on", per_mille=150)
        done = scene.reset()
        received_s = [e["t_s"] for e in scene.log("sdo", "nmt")]
        off = [e["t_s"] for e in scene.log("torque") if not e["enabled"]]
        if "Traceback" in done.printed:
            return done.last
        if not off:
            warned = done.code != 0 and re.search(r"turn|torque|enabled|may be on", done.last)
            return f"ok: warned: {done.last}" if warned else f"{done.code}, still on: {done.last}"
        after_s = off[0] - received_s[0]
        if after_s > OFF_WITHIN_S:
            return f"off after {after_s:.3f} s: {done.last}"
        return f"ok: off {after_s:.3f} s, exit {done.code}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", default=[""], help="Files whose name contains one.")
    parser.add_argument(
        "--ignore-timing",
        action="store_true",
        help="Leave out the times that a busy computer spoils.",
    )
    given = parser.parse_args()
    files = sorted(
        path
        for path in given.folder.iterdir()
        if path.suffix.lower() in (".eds", ".dcf") and any(part in path.name for part in given.only)
    )
    outcomes: dict[str, list[str]] = {}
    for path in files:
        verdict = play(path.stem, path, ignore_timing=given.ignore_timing)
        usable = "usable" if verdict.paper.usable else f"refused ({verdict.paper.why})"
        paper = verdict.paper
        took = f"{paper.seconds:.2f} s, {paper.cpu_s:.2f} s of the processor"
        say(f"{verdict.name:22} paper {took}: {usable}")
        if paper.usable and paper.accept:
            say(f"    profile accepts it without: {', '.join(paper.accept)}")
        for step, result in verdict.steps.items():
            say(f"    {step:24} {result}")
        outcomes.setdefault(verdict.outcome, []).append(verdict.name)
    say(f"{len(files)} files")
    for outcome, names in outcomes.items():
        say(f"    {len(names)} {outcome}: {', '.join(names)}")
    if given.ignore_timing:
        say(
            f"Not judged (--ignore-timing): {', '.join(TIMES)}. A refusal on paper within "
            f"{TIMELY_S:g} s: by the time of the processor."
        )
    return 0 if files and "with complaints" not in outcomes else 1


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
