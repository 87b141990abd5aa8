"""A node made from an EDS file, a profile for it, and rigd's commands run against it."""

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import seqpacket_bus  # noqa: E402

RIGD = Path(sys.executable).parent / "rigd"
SHIPPED = HERE.parents[1] / "hw_profiles" / "antenna_can.toml"
NAME = f"independent-{os.getpid()}"
"""One of its own for each process that runs trials: a rig of hardware is in use on all of the
computer."""
NODE_ID = 5
HEARTBEAT_TIMEOUT_S = 0.2
TIMES = ("polls", "turnaround median", "turnaround 99 %", "both replies after")
"""Rows of `rigd check` that a computer busy with other things spoils."""
_STARTED_S = 60.0
_COMMAND_S = 90.0

# A computer that is busy with other things misses ticks, and a reply comes late: a slow loop with
# wide limits is to run all the same. Torque off in time is checked by the node's own log.
VALUES: dict[str, object] = {
    "name": NAME,
    "rig.rate_hz": 250.0,
    "control.pole_rad_s": 15.0,
    "control.feedforward_gain": 0.8,
    "actuation.delay_s": 4.0e-3,
    "acquisition.deadline_us": 3500.0,
    "can.interface": "seqpacket",
    "cia402.rated_torque_unit_nm": 1.0e-6,
    "cia402.heartbeat_timeout_s": HEARTBEAT_TIMEOUT_S,
    "cia402.drive_heartbeat_timeout_s": 2.0,
    "limits.stale_ticks_in_a_row": 100,
    "limits.missed_ticks_in_a_row": 100,
    "limits.missed_percent": 50.0,
    "limits.stale_percent": 50.0,
    "limits.acceleration_rad_s2": 10000.0,
    "limits.tracking_error_rad": 0.5,
    # So many ticks without an angle are a long way, and nothing is in the way of this shaft.
    "limits.stop_angle_rad": 100.0,
    "session.tare_s": 0.5,
    "session.return_s": 0.3,
    "session.rest_timeout_s": 20.0,
}
CHIRP = ("--amplitude", 0.02, "--start-hz", 0.5, "--stop-hz", 4.0, "--rest", 0.2)
CHIRP = (*CHIRP, "--duration", 2.0, "--ring-down", 0.3)


def with_values(text: str, values: dict[str, object]) -> str:
    """Return a profile with other values; a key that it does not have is added to its section."""
    lines, section, left = [], "", dict(values)

    def shown(value: object) -> str:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        plain = json.dumps(value, ensure_ascii=False)
        return f'{{ value = {plain}, source = "assumed" }}' if number else plain

    def close() -> None:
        new = [key for key in left if key.rpartition(".")[0] == section]
        lines.extend(f"{key.rpartition('.')[2]} = {shown(left.pop(key))}" for key in new)

    for line in text.splitlines():
        if line.startswith("["):
            close()
            section = line.strip("[] ")
        key = f"{section}.{line.partition('=')[0].strip()}".lstrip(".")
        if "=" in line and not line.startswith("#") and key in left:
            lines.append(f"{line.partition('=')[0]}= {shown(left.pop(key))}")
        else:
            lines.append(line)
    close()
    if left:
        raise KeyError(f"no such section: {sorted(left)}")
    return "\n".join(lines) + "\n"


def commissioned(eds: Path) -> int:
    """Return the node id of a DCF file, which its values are of; of an EDS file, any."""
    text = eds.read_text("utf-8", errors="replace")
    line = r"^\s*NodeID\s*=\s*(0x[0-9a-f]+|\d+)\s*$"
    found = re.search(line, text, re.MULTILINE | re.IGNORECASE)
    return int(found[1], 0) if found and int(found[1], 0) in range(1, 127) else NODE_ID


@dataclass(frozen=True)
class Done:
    """Result of a command."""

    code: int
    printed: str
    seconds: float

    @property
    def last(self) -> str:
        """Last message in one line."""
        lines = [line.strip() for line in self.printed.splitlines() if line.strip()]
        errors = [line for line in lines if line.startswith(("Error", "fault", "Traceback"))]
        return (errors or lines or ["nothing"])[-1]


class Scene:
    """A node as a process, with its sensor box; close it, or use it as a context."""

    def __init__(
        self,
        eds: Path,
        *,
        node: dict[str, object] | None = None,
        profile: dict[str, object] | None = None,
        text: str | None = None,
    ) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="rigd-eds-"))
        (self.folder / "run").mkdir(mode=0o700)
        self._log = self.folder / "node.jsonl"
        self._sessions = 0
        channel = str(self.folder / "bus")
        node_id = commissioned(eds)
        settings = {"eds": str(eds), "socket": channel, "log": str(self._log), "node_id": node_id}
        (self.folder / "node.json").write_text(json.dumps(settings | (node or {})))
        python_path = seqpacket_bus.announce(self.folder / "interface")
        self.environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(
                filter(None, (python_path, os.environ.get("PYTHONPATH")))
            ),
            "XDG_RUNTIME_DIR": str(self.folder / "run"),
            "COLUMNS": "400",
        }
        self._node = subprocess.Popen(
            [sys.executable, HERE / "cia402_local_node.py", self.folder / "node.json"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            if "ended" in (answer := self._answer()):
                raise RuntimeError(answer["ended"])
            values = VALUES | {"can.channel": channel, "cia402.node_id": node_id}
            values |= profile or {}
            self.profile = self.folder / f"{NAME}.toml"
            self.profile.write_text(with_values(text or SHIPPED.read_text("utf-8"), values))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "Scene":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _answer(self) -> dict[str, Any]:
        assert self._node.stdout is not None
        line = self._node.stdout.readline()
        if not line:
            assert self._node.stderr is not None
            errors = self._node.stderr.read().strip().splitlines()
            raise RuntimeError(f"the node ended: {errors[-1] if errors else 'nothing said'}")
        return dict(json.loads(line))

    def order(self, **what: object) -> dict[str, Any]:
        """Cause an event in the node; return its state."""
        assert self._node.stdin is not None
        self._node.stdin.write(json.dumps(what) + "\n")
        self._node.stdin.flush()
        return self._answer()

    def state(self) -> dict[str, Any]:
        return self.order(do="nothing")

    def log(self, *kinds: str) -> list[dict[str, Any]]:
        """Return the log of the node so far."""
        self.state()
        lines = self._log.read_text("utf-8").splitlines()
        entries = [json.loads(line) for line in lines]
        return [e for e in entries if not kinds or e["what"] in kinds]

    def start(self, *arguments: object) -> subprocess.Popen[str]:
        """Start a command of rigd with this scene's profile."""
        return subprocess.Popen(
            [RIGD, *map(str, arguments)],
            cwd=self.folder, env=self.environment, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip

    def run(self, *arguments: object) -> Done:
        return self.finish(self.start(*arguments))

    def finish(self, process: subprocess.Popen[str], started_s: float | None = None) -> Done:
        began_s = time.monotonic() if started_s is None else started_s
        try:
            printed, _ = process.communicate(timeout=_COMMAND_S)
        except subprocess.TimeoutExpired:
            process.kill()
            printed, _ = process.communicate()
            printed += f"\nError: not done after {_COMMAND_S:g} s"
        return Done(process.returncode, printed, time.monotonic() - began_s)

    def check(self, *, ignore_timing: bool = False) -> list[str]:
        """Return the errors of `rigd check`; without TIMES if those are to be ignored."""
        done = self.run("check", "--profile", self.profile, "--json")
        found = [line for line in done.printed.splitlines() if line.startswith("{")]
        if not found:
            return [done.last]
        return [
            f"{row['what']}: {row['found']} ({row['detail']})"
            for row in json.loads(found[0])["rows"]
            if row["verdict"] == "failed" and not (ignore_timing and row["what"] in TIMES)
        ]

    def reset(self) -> Done:
        return self.run("reset", "--profile", self.profile)

    def start_chirp(self) -> subprocess.Popen[str]:
        self._sessions += 1
        where = ("--profile", self.profile, "--output", self.folder / f"{self._sessions}")
        return self.start("run", "chirp", *where, *CHIRP)

    def chirp(self) -> Done:
        """Run a session; start it again, as the message advises, if late ticks hide the motor."""
        for _ in range(3):
            done = self.finish(self.start_chirp())
            if "could not be determined" not in done.last:
                break
        return done

    def await_torque(self, patience_s: float = _STARTED_S) -> None:
        """Wait until the motor is moved."""
        deadline = time.monotonic() + patience_s
        while abs(self.state()["per_mille"]) < 30:
            if time.monotonic() > deadline:
                raise RuntimeError(f"no torque within {patience_s:g} s")
            time.sleep(0.01)

    def close(self) -> None:
        assert self._node.stdin is not None
        with contextlib.suppress(OSError):
            self._node.stdin.close()
        try:
            self._node.wait(10.0)
        except subprocess.TimeoutExpired:
            self._node.kill()
            self._node.wait()
        for stream in (self._node.stdout, self._node.stderr):
            if stream is not None:
                stream.close()
        shutil.rmtree(self.folder, ignore_errors=True)
