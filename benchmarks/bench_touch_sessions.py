"""Touches in sessions, with a model identified from one session of the same rig.

Each simulated rig has a beam whose density and stiffness differ from the profile's by up to a
tenth. One ``rigd run until --damping 1%`` and ``analyze`` identify its model; then ``rigd run
touch`` meets obstacles at positions of 0.05 to 0.97 m, of 100 to 100 000 N/m, at speeds of 0.3 to
2 rad/s, all with the commands of an operator, in fast mode. The report on each touch is compared
with the truth.

    python benchmarks/bench_touch_sessions.py --touches 60 --rigs 6 --jsonl results.jsonl
    python benchmarks/bench_touch_sessions.py --table results.jsonl
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench_until import Rig, profile_of
from gate import Gate, Row, percent
from numpy.typing import NDArray

BIN = Path(sys.executable).parent
NOISE_NM = 5e-3
"""Torque noise of the profile."""
ROWS = (
    # Measured 0 of 600, 1 and 4 of 600, 0.54 mm, 96.3 %, 0: docs/validation/touch.md.
    Row("touches that failed", most=0, unit="%"),
    Row("touches with a point", least=80, unit="%"),
    Row("median error", most=1.5, unit="mm"),
    Row("95 % intervals that hold the point", least=70, unit="%"),
    Row("beyond 4 standard deviations", most=0, unit="%"),
)


@dataclass(frozen=True, slots=True)
class Meeting:
    """A slew and its obstacle."""

    x_m: float
    angle_rad: float
    stiffness_n_per_m: float
    speed_rad_s: float


def draw_rig(number: int, noise: float) -> Rig:
    """Draw a beam near the profile's."""
    rng = np.random.default_rng([2, number])
    density, stiffness = 1 + 0.1 * rng.uniform(-1, 1, 2)
    return Rig(number + 1, "VI", density, stiffness, 7.1e-5, 0.996, 5.5e-2, 0.594, noise * NOISE_NM)


def draw_meeting(rig: int, number: int) -> Meeting:
    """Draw an obstacle at rest, met in the middle of a slew."""
    rng = np.random.default_rng([3, rig, number])
    speed = rng.uniform(0.3, 2.0)
    return Meeting(
        x_m=round(rng.uniform(0.05, 0.97), 4),
        angle_rad=round(speed * rng.uniform(0.38, 0.55), 4),
        stiffness_n_per_m=round(float(np.exp(rng.uniform(np.log(1e2), np.log(1e5)))), 1),
        speed_rad_s=round(speed, 4),
    )


def run_command(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder, with its own runtime folder."""
    environment = os.environ | {"XDG_RUNTIME_DIR": str(folder), "RIGD_NO_LOOK": "1"}
    command = [str(BIN / arguments[0]), *arguments[1:]]
    return subprocess.run(
        command, capture_output=True, text=True, env=environment, cwd=folder, check=False
    )


def model_of(profile: Path, folder: Path) -> Path:
    """Identify a rig by one session."""
    until = [
        "--fast",
        "--seed",
        "1",
        "--damping",
        "1%",
        "--profile",
        str(profile),
        "--output",
        "identification",
    ]
    run_command(folder, "rigd", "run", "until", *until)
    [file] = (folder / "identification").glob("*.mcap")
    path = folder / "model.json"
    analysis = ["--method", "record", "--json", str(path), "--report", str(folder / "report")]
    done = run_command(folder, "analyze", str(file), *analysis)
    assert path.exists(), done.stderr
    return path


def meet(rig: Rig, number: int, profile: Path, model: Path, folder: Path) -> dict[str, Any]:
    """Run one touch and return its result."""
    meeting = draw_meeting(rig.number, number)
    obstacle = f"x={meeting.x_m},angle={meeting.angle_rad},stiffness={meeting.stiffness_n_per_m}"
    done = run_command(
        folder, "rigd", "run", "touch", str(round(meeting.angle_rad + 0.4, 4)),
        "--speed", str(meeting.speed_rad_s), "--fast", "--json", "--model", str(model),
        "--seed", str(1000 * rig.number + number), "--profile", str(profile),
        "--obstacle", obstacle, "--output", "touches",
    )  # fmt: skip
    result = {"rig": rig.number, "noise_nm": rig.noise_nm, **asdict(meeting)}
    try:
        [session] = json.loads(done.stdout)["sessions"]
    except (ValueError, KeyError):
        return {**result, "failed": done.stderr[-2000:]}
    return {**result, "outcome": session["outcome"], "touches": session["touches"]}


def points(results: list[dict[str, Any]]) -> NDArray[np.float64]:
    """Return rows of position, error, standard deviation, and whether the interval contains it."""
    rows = []
    for each in results:
        if not each.get("touches"):
            continue
        first = each["touches"][0]
        position = first.get("x_m")
        # A touch of unknown kind has an approximate position at most.
        if first.get("kind") == "unknown" or position is None or position["std"] is None:
            continue
        low, high = position["interval_95"]
        error = position["value"] - each["x_m"]
        rows.append((each["x_m"], error, position["std"], low <= each["x_m"] <= high))
    return np.array(rows, dtype=np.float64).reshape(-1, 4)


def table(results: list[dict[str, Any]]) -> Iterator[str]:
    """Yield lines of errors, coverage and kinds, at all positions and between 0.1 and 0.95 m."""
    failed = [each for each in results if "failed" in each]
    missed = [each for each in results if "failed" not in each and not each["touches"]]
    detected = [each for each in results if each.get("touches")]
    yield f"{len(results)} touches: {len(failed)} failed, {len(missed)} not detected"
    kinds = Counter(each["touches"][0].get("kind", "not estimated") for each in detected)
    found = points(results)
    inner = (found[:, 0] > 0.1) & (found[:, 0] < 0.95)
    for name, chosen in (("0.05 to 0.97 m", found), ("0.1 to 0.95 m", found[inner])):
        if not len(chosen):
            continue
        error_mm = 1e3 * np.abs(chosen[:, 1])
        beyond = np.abs(chosen[:, 1]) > 4 * chosen[:, 2]
        yield (
            f"{name}: {len(chosen)}, median {np.median(error_mm):.2f} mm, rms "
            f"{np.sqrt(np.mean(error_mm**2)):.2f}, 90 % {np.percentile(error_mm, 90):.2f}, largest "
            f"{error_mm.max():.1f}; within the 95 % interval {chosen[:, 3].mean():.1%}, beyond 4 "
            f"std {beyond.mean():.1%}"
        )
    yield f"kinds: {dict(kinds)}"


def main() -> None:
    """Run the touches, or read them, print the results and check the limits."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--touches", type=int, default=10, help="with each rig")
    parser.add_argument("--rigs", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first rig")
    parser.add_argument("--noise", type=float, default=1.0, help="times that of the profile")
    parser.add_argument("--jsonl", type=Path, help="where each result is added")
    parser.add_argument("--table", type=Path, help="show what is there, run nothing")
    gate = Gate(ROWS, parser)
    given = gate.given
    results = []
    if given.table:
        results = [json.loads(line) for line in given.table.read_text("utf-8").splitlines()]
    else:
        for i in range(given.first, given.first + given.rigs):
            rig = draw_rig(i, given.noise)
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                profile = profile_of(rig, folder)
                model = model_of(profile, folder)
                for number in range(given.touches):
                    result = meet(rig, number, profile, model, folder)
                    results.append(result)
                    if given.jsonl:
                        with given.jsonl.open("a", encoding="utf-8") as file:
                            file.write(json.dumps(result) + "\n")
    print("\n".join(table(results)))
    found = points(results)
    error_m = np.abs(found[:, 1])
    failed = sum("failed" in each for each in results)
    gate.measured("touches that failed", percent(failed, len(results)))
    gate.measured("touches with a point", percent(len(found), len(results)))
    gate.measured("median error", 1e3 * np.median(error_m) if len(found) else np.nan)
    held = percent(found[:, 3].sum(), len(found))
    gate.measured("95 % intervals that hold the point", held)
    far = percent(np.sum(error_m > 4 * found[:, 2]), len(found))
    gate.measured("beyond 4 standard deviations", far)
    gate.finish()


if __name__ == "__main__":
    main()
