"""Kill, suspend and end the processes of a session at random moments, and check what remains.

Four kinds of rig: simulated in the session itself (direct), by `rigd simulate` on the wire, in
lock-step with it, and owned by `rigd serve`. The log of the simulated drive shows when it was
switched off, the file what was stored. Then the rig has to recover: the next session is run,
after `rigd reset` where a message requests it, and has to be complete.

    python tests/chaos/kill_rig.py --cases 200 --jobs 2
"""

import argparse
import contextlib
import fcntl
import itertools
import json
import os
import random
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rigd.devices.running_simulator import ask_simulator, find_simulator
from rigd.safety.limits import OVERLOADED_ADVICE
from rigd.session import read_session
from rigd.session.layout import Status

BIN = Path(sys.executable).parent
PROFILES = Path(__file__).parents[2] / "hw_profiles"
PROFILE = PROFILES / "antenna_can.toml"

HEARTBEAT_TIMEOUT_S = 0.3
RECORDER_LAG_S = 2.0
CHANGES = (
    # A virtual machine that is short of processor time pauses for 0.1 s at a time.
    ("stale_ticks_in_a_row = { value = 10", "stale_ticks_in_a_row = { value = 400"),
    ("missed_ticks_in_a_row = { value = 25", "missed_ticks_in_a_row = { value = 400"),
    ("missed_percent = { value = 2.0", "missed_percent = { value = 20.0"),
    ("stale_percent = { value = 1.0", "stale_percent = { value = 50.0"),
    # A late tick measures a later angle of the motor, which resembles a jump.
    ("acceleration_rad_s2 = { value = 1000.0", "acceleration_rad_s2 = { value = 10000.0"),
    # The motor goes on with the last torque while the loop is paused.
    ("\nvelocity_rad_s = { value = 4.0", "\nvelocity_rad_s = { value = 50.0"),
    ("tracking_error_rad = { value = 0.1", "tracking_error_rad = { value = 1.5"),
    ("max_speed_rad_s = { value = 5.0", "max_speed_rad_s = { value = 0.0"),
    ("drive_heartbeat_timeout_s = { value = 0.1", "drive_heartbeat_timeout_s = { value = 1.0"),
    ("\nheartbeat_timeout_s = { value = 0.05", "\nheartbeat_timeout_s = { value = 0.3"),
    # Soon enough for a short session to see it.
    ("recorder_lag_s = { value = 12.0", f"recorder_lag_s = {{ value = {RECORDER_LAG_S}"),
    ("\ntare_s = { value = 1.0", "\ntare_s = { value = 0.5"),
    ("return_s = { value = 0.8", "return_s = { value = 0.3"),
)
DIRECT_CHANGES = (
    *CHANGES,
    ("\nvelocity_rad_s = { value = 15.0", "\nvelocity_rad_s = { value = 50.0"),
    ("tracking_error_rad = { value = 0.5", "tracking_error_rad = { value = 1.5"),
)
"""Settings of the profiles; one without a bus has only some of them."""
REST_S, RING_DOWN_S = 0.2, 0.3

MODULES = {
    "control": b"rigd.engine.control_process",
    "recorder": b"rigd.engine.recorder",
    "publisher": b"rigd.live.publisher",
}
VICTIMS = ("control", "recorder", "publisher", "supervisor", "all", "simulate")
MODES = ("direct", "wire", "lock-step", "daemon")
SIGNALS = (signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM, signal.SIGINT)
_ASKING = (signal.SIGTERM, signal.SIGINT)

STORED_S = 0.3
"""No sample older than this at the moment of the kill may be lost."""
_TRANSPORT_S = 5e-3
"""The drive's log has a torque one tick after its sample, on a grid half a tick off."""
_STARTED_S = 180.0
"""For a process to be there, on a computer that runs several cases at a time."""
_ENDED_S = 15.0
_LONGEST_S = 60.0
_NEXT_S = 240.0
_FLUSHED_S = 0.3
"""After which the log of the simulated rig is on the disk."""
_COMMAND_S = 240.0
"""Within which `rigd recover` and `analyze` are done, on a busy computer, too."""

# Time after the signal within which the drive has to be off, by its watchdog or a process.
OFF_WITHIN_S = {
    ("control", signal.SIGKILL): HEARTBEAT_TIMEOUT_S,
    ("control", signal.SIGSTOP): HEARTBEAT_TIMEOUT_S,
    ("all", signal.SIGKILL): HEARTBEAT_TIMEOUT_S,
    ("all", signal.SIGSTOP): HEARTBEAT_TIMEOUT_S,
    ("supervisor", signal.SIGKILL): HEARTBEAT_TIMEOUT_S,
    ("supervisor", signal.SIGSTOP): 3.0,
    ("recorder", signal.SIGKILL): HEARTBEAT_TIMEOUT_S,
    ("recorder", signal.SIGSTOP): RECORDER_LAG_S + 1.0,
    # On a request to end, it stops by itself and disables the drive.
    **{(victim, how): 1.0 for victim in ("control", "supervisor", "all") for how in _ASKING},
}
LOST_S = 0.5
"""Time of a record that may be lost, if only its file shows it."""

_GRACE_S = 0.2
"""Duration of occasional pauses of a virtual machine, which are no fault of the rig."""

_SIMULATORS_LOCK = "antenna_can.lock"

ARMED_S = 6.0
"""Before the record, for as long as the supervisor waits for the recorder, the motor is held."""


class HarnessError(Exception):
    """The case could not be staged, which says nothing about the rig."""


@dataclass(frozen=True)
class Case:
    """A victim, what is done to it, and when."""

    victim: str
    how: signal.Signals
    moment_s: float
    """After the first bytes of the record, or after the start of the command."""
    anywhere: bool = False
    """The moment counts from the start of the command."""
    mode: str = "wire"
    stopped_s: float | None = None
    """After which the suspension ends in any case; None: it lasts until the drive is off,
    or until somebody ends it."""
    sweep_s: float = 5.0
    analysed: bool = True
    """Whether to run `analyze` on the file."""
    grace_s: float = 0.0
    """Added to the limits where the computer may pause."""
    afterwards: signal.Signals = signal.SIGCONT
    """What ends the suspension of a supervisor and its children: they continue,
    or the supervisor is killed, and the others have to continue without it."""

    def __str__(self) -> str:
        where = "start" if self.anywhere else "record"
        then = f", then {self.afterwards.name}" if self._ends_suspended else ""
        what = f"{self.mode}: {self.how.name} of {self.victim}"
        if self.stopped_s is not None:
            what += f" for {self.stopped_s:.1f} s"
        return f"{what} {self.moment_s:.2f} s into the {where}{then}"

    @property
    def _ends_suspended(self) -> bool:
        return self.how == signal.SIGSTOP and self.victim in ("supervisor", "all")

    @property
    def daemon(self) -> bool:
        """`rigd serve` and `rigd start` in place of `rigd run`."""
        return self.mode == "daemon"

    @property
    def timed(self) -> bool:
        """Whether the simulated rig goes by the clock, so that its times can be compared."""
        return self.mode != "lock-step"

    @property
    def live(self) -> bool:
        return self.victim in ("publisher", "all")

    @property
    def killed(self) -> bool:
        """Whether the victim is killed in the end."""
        return signal.SIGKILL in (self.how, self._ends_suspended and self.afterwards)

    @property
    def ends_daemon(self) -> bool:
        """Whether the case ends the daemon, which then runs no further session."""
        return self.victim in ("supervisor", "all") and self.how in _ASKING

    @property
    def released(self) -> bool:
        """Whether the suspension has to be ended from outside."""
        return self._ends_suspended


@dataclass
class Verdict:
    """Result of a case."""

    case: Case
    complaints: list[str] = field(default_factory=list)
    exit_code: int | None = None
    stderr: str = ""
    outcome: str = "none"
    file_suffix: str = "-"
    off_s: float | None = None
    """Drive off, after the signal; None: it was off before, or the session went on."""
    behind_s: float | None = None
    """Age of the newest sample in the file at the moment of the signal."""
    gone_s: float = 0.0
    """From the signal (or its end) until the last process of the session was gone."""
    analysis: str = "-"
    missed: tuple[int, int] = (0, 0)
    """Missed ticks in the two seconds before and after the signal."""
    after: str = "-"
    """Steps up to the next session."""

    def row(self) -> str:
        def number(value: float | None) -> str:
            return "-" if value is None else f"{value:.3f}"

        return (
            f"{self.case!s:66} exit {self.exit_code!s:>3}  {self.outcome:9} {self.file_suffix:9} "
            f"off {number(self.off_s):>6}  behind {number(self.behind_s):>6}  "
            f"gone {self.gone_s:5.2f}  {self.analysis:9} missed {self.missed[0]}/{self.missed[1]}  "
            f"next {self.after:16}  "
            f"{'; '.join(self.complaints) or 'ok'}"
        )


class DriveLog:
    """The log of the simulated rig, read as it grows."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read = 0
        self.entries: list[dict[str, Any]] = []

    def update(self) -> None:
        with self._path.open("rb") as file:
            file.seek(self._read)
            fresh = file.read()
        whole = fresh[: fresh.rfind(b"\n") + 1]
        self._read += len(whole)
        self.entries += [json.loads(line) for line in whole.splitlines()]

    @property
    def torques(self) -> list[dict[str, Any]]:
        return [e for e in self.entries if e["device"] == "drive" and e["what"] == "torque"]

    @property
    def enabled(self) -> bool:
        return bool(self.torques and self.torques[-1]["enabled"])


class Scene:
    """A simulated rig and a session on it, in separate processes."""

    def __init__(self, folder: Path, *, live: bool, sweep_s: float, mode: str) -> None:
        self.folder = folder
        self.mode = mode
        self.sessions = folder / "sessions"
        self._runtime = Path(tempfile.mkdtemp(prefix="rigd-kill-"))
        self._mark = f"XDG_RUNTIME_DIR={self._runtime}".encode()
        self._environment = {**os.environ, "XDG_RUNTIME_DIR": str(self._runtime)}
        self._stderr = (folder / "said.txt").open("w+", encoding="utf-8")
        self._json = (folder / "out.json").open("w+", encoding="utf-8")
        self._profile = folder / "rig.toml"
        direct = mode == "direct"
        source, changes = (PROFILES / "sim.toml", DIRECT_CHANGES) if direct else (PROFILE, CHANGES)
        text = changed(source.read_text("utf-8"), changes, all_there=not direct)
        self._profile.write_text(text, "utf-8")
        self.simulator: subprocess.Popen[str] | None = None
        self.log: DriveLog | None = None
        self._origin_s = 0.0
        self._started: list[subprocess.Popen[str]] = []
        self._live = ["--live"] if live else []
        self._sweep_s = sweep_s

    def begin(self) -> None:
        """Start rig and session.

        Raises
        ------
        HarnessError
            If they are not there in time.
        """
        mode = self.mode
        if mode != "direct":
            self.start_simulator()
        options = ["--rest", REST_S, "--duration", self._sweep_s, "--ring-down", RING_DOWN_S]
        options += ["--stop-hz", 10, "--json", *self._accepted]
        if mode == "daemon":
            self.supervisor = self._serve()
            wait_for(lambda: self.state == "ready", _STARTED_S, "daemon that is ready")
            self.session = self._start("start", "chirp", *options)
        else:
            self.session = self.supervisor = self._start(
                "run", "chirp", "--no-look", *self._where, *options
            )

    @property
    def _accepted(self) -> list[str]:
        """The limits of CHANGES let the shaft of a wired rig turn beyond its stop."""
        if self.mode == "direct":
            return []
        ways = "loop_fails", "no_angle", "encoder_fails", "missed_ticks"
        return [word for way in ways for word in ("--accept", f"travel_{way}")]

    @property
    def _where(self) -> list[object]:
        fast = ["--fast"] if self.mode == "lock-step" else []
        return ["--profile", self._profile, "--output", self.sessions, *self._live, *fast]

    def _serve(self) -> subprocess.Popen[str]:
        return self._start("serve", "--no-look", *self._where)

    def start_simulator(self) -> None:
        """Start `rigd simulate`, with its own log."""
        path = self.folder / f"drive-{time.monotonic_ns()}.jsonl"
        options = ["--lock-step"] if self.mode == "lock-step" else []
        self.simulator = self._start(
            "simulate", "--profile", self._profile, "--log", path, *options
        )
        self._origin_s = self._await_simulator()
        self.log = DriveLog(path)

    def _start(self, *arguments: object) -> subprocess.Popen[str]:
        with_output = "simulate" not in arguments
        process = subprocess.Popen(
            [BIN / "rigd", *map(str, arguments)],
            cwd=self.folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=self._json if with_output else subprocess.DEVNULL,
            stderr=self._stderr if with_output else subprocess.DEVNULL,
            text=True,
            start_new_session=True,
        )
        self._started.append(process)
        return process

    @property
    def state(self) -> str:
        """State that the daemon reports."""
        try:
            done = subprocess.run(
                [BIN / "rigd", "status", "--json"],
                env=self._environment, capture_output=True, text=True, timeout=_NEXT_S, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return "no answer"
        return str(json.loads(done.stdout)["state"]) if done.returncode == 0 else ""

    def _await_simulator(self) -> float:
        """Wait until it can be found; return its time at the zero of the monotonic clock."""
        with _environ(XDG_RUNTIME_DIR=str(self._runtime)):
            wait_for(lambda: find_simulator("antenna_can"), _STARTED_S, "simulator")
            address = find_simulator("antenna_can")
        assert address is not None
        origins = []
        for _ in range(20):  # an idle one reads its clock every 10 ms
            there_s = ask_simulator(address, {"status": True})["time_s"]
            origins.append(there_s - time.monotonic())
            time.sleep(0.003)
        return max(origins)

    def time_of(self, monotonic_ns: int) -> float:
        """Return the simulated rig's time at a moment of the monotonic clock."""
        return self._origin_s + monotonic_ns * 1e-9

    @property
    def _simulators(self) -> list[int]:
        return [] if self.simulator is None else [self.simulator.pid]

    def processes(self) -> dict[int, bytes]:
        """Return the processes of the session and their command lines."""
        found = {}
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit() or int(entry.name) in self._simulators:
                continue
            with contextlib.suppress(OSError):
                if self._mark in (entry / "environ").read_bytes().split(b"\0"):
                    found[int(entry.name)] = (entry / "cmdline").read_bytes()
        return found

    def find(self, victim: str) -> list[int]:
        """Return the processes to be hit, the one with the torque first."""
        if victim == "supervisor":
            return [self.supervisor.pid]
        if victim == "simulate":
            return self._simulators
        processes = self.processes()
        names = MODULES if victim == "all" else {victim: MODULES[victim]}
        found = [
            pid
            for module in names.values()
            for pid, command in processes.items()
            if module in command.split(b"\0")
        ]
        return [*found, self.supervisor.pid] if victim == "all" else found

    def recording(self) -> bool:
        with contextlib.suppress(FileNotFoundError):  # it has got its name meanwhile
            return any(part.stat().st_size > 0 for part in self.sessions.glob("*.part"))
        return False

    @property
    def stderr(self) -> str:
        self._stderr.flush()
        return Path(self._stderr.name).read_text("utf-8")

    @property
    def result(self) -> dict[str, Any] | None:
        text = Path(self._json.name).read_text("utf-8").strip()
        return json.loads(text)["sessions"][0] if text and json.loads(text)["sessions"] else None

    @property
    def files(self) -> list[Path]:
        return sorted(self.sessions.glob("*.mcap*"))

    @property
    def locks_held(self) -> list[str]:
        """Return the locks that are held after the end of the session."""
        held = []
        for path in (self._runtime / "rigd").glob("*.lock"):
            if path.name == _SIMULATORS_LOCK and self.simulator and self.simulator.poll() is None:
                continue
            with path.open("a") as file:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except OSError:
                    held.append(path.name)
        return held

    def next_session(self) -> str:
        """Run a short session as the operator would, and return the steps it took."""
        steps = []
        if self.simulator is not None and self.simulator.poll() is not None:
            self.start_simulator()
        if self.mode == "daemon":
            if self.supervisor.poll() is not None:
                self.supervisor = self._serve()
            wait_for(lambda: self.state in ("ready", "fault"), _STARTED_S, "running daemon")
            if self.state == "fault":
                steps += self._reset()
        for _ in range(3):
            code, stderr = self._short_session()
            if code == 0:
                return ", ".join([*steps, "complete"])
            if OVERLOADED_ADVICE in stderr and "stalled" not in steps:
                steps.append("stalled")  # a message on the computer, not on the rig
            elif "rigd reset" not in stderr or "reset" in steps:
                return ", ".join([*steps, f"exit {code}: {_line(stderr)}"])
            if self.mode != "daemon" or self.state == "fault":
                steps += self._reset() if "rigd reset" in stderr or self.mode == "daemon" else []
        return ", ".join([*steps, f"exit {code}: {_line(stderr)}"])

    def _reset(self) -> list[str]:
        done = self._command("reset", *([] if self.mode == "daemon" else self._where[:2]))
        return ["reset"] if done.returncode == 0 else [f"reset refused ({_line(done.stderr)})"]

    def _short_session(self) -> tuple[int, str]:
        """Return its exit code and its messages."""
        hold = ["hold", "--duration", 0.5, "--rest", 0.1, "--ring-down", 0.1, "--json"]
        hold += self._accepted
        if self.mode == "daemon":
            done = self._command("start", *hold)
        else:
            # This session has no viewer.
            where = [word for word in self._where if word != "--live"]
            where[3] = self.folder / "next"
            done = self._command("run", *hold, "--no-look", *where)
        (self.folder / "next.txt").write_text(done.stderr, encoding="utf-8")
        if done.returncode == 0:
            (session,) = json.loads(done.stdout)["sessions"]
            if session["outcome"] != "complete" or session["reason"]:
                return 0 if session["outcome"] == "complete" else 1, str(session["reason"])
            if session["scheduled"] != sum(session[k] for k in ("recorded", "missed", "lost")):
                return 1, f"counts: {session}"
        return done.returncode, done.stderr

    def _command(self, *arguments: object) -> subprocess.CompletedProcess[str]:
        command = [BIN / "rigd", *map(str, arguments)]
        try:
            return subprocess.run(
                command, cwd=self.folder, env=self._environment, stdin=subprocess.DEVNULL,
                capture_output=True, text=True, timeout=_NEXT_S, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return subprocess.CompletedProcess(command, 1, "", f"not done after {_NEXT_S:g} s")

    def end_simulator(self) -> None:
        if self.simulator is None or self.log is None:
            return
        self.simulator.send_signal(signal.SIGTERM)
        self.simulator.wait(_ENDED_S)
        self.log.update()

    def close(self) -> None:
        for pid in (*self.processes(), *self._simulators):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        for process in self._started:
            process.wait()
        self._stderr.close()
        self._json.close()
        shutil.rmtree(self._runtime, ignore_errors=True)


def run_case(case: Case, folder: Path) -> Verdict:
    """Stage a case and check its result.

    Raises
    ------
    HarnessError
        If the case could not be staged.
    """
    scene = Scene(folder, live=case.live, sweep_s=case.sweep_s, mode=case.mode)
    try:
        scene.begin()
        return _run_case(case, scene)
    finally:
        scene.close()


def _run_case(case: Case, scene: Scene) -> Verdict:
    verdict = Verdict(case)
    if not case.anywhere:
        wait_for(scene.recording, _STARTED_S, "record")
    time.sleep(case.moment_s)
    wait_for(lambda: scene.find(case.victim) or _ended(scene), 10.0, case.victim)
    if _ended(scene):
        raise HarnessError(f"The session had ended by itself:\n{scene.stderr}")
    log = scene.log
    if log is not None:
        log.update()
    was_on = log is not None and log.enabled
    wall_ns = time.time_ns() - time.monotonic_ns()
    hit = scene.find(case.victim)
    before_ns = time.monotonic_ns()
    _send(hit, case.how)
    hit_ns = time.monotonic_ns()
    from_s = time.monotonic()
    if case.stopped_s is not None:
        time.sleep(case.stopped_s)
    elif case.released:
        _await_off(log, OFF_WITHIN_S[case.victim, case.how] + 3.0)
    if case.stopped_s is not None or case.released:
        ends_by = case.afterwards if case.released else signal.SIGCONT
        _send(hit if ends_by == signal.SIGCONT else [scene.supervisor.pid], ends_by)
        from_s = time.monotonic()
    longest_s = _LONGEST_S + (0.0 if case.timed else 6.0 * case.sweep_s)
    try:
        verdict.exit_code = scene.session.wait(longest_s)
    except subprocess.TimeoutExpired:
        verdict.complaints.append(f"the session goes on after {longest_s:g} s")
    if case.daemon and scene.supervisor.poll() is None and case.ends_daemon:
        with contextlib.suppress(subprocess.TimeoutExpired):
            scene.supervisor.wait(_ENDED_S)
    if case.daemon and scene.supervisor.poll() is None:
        _check_daemon(verdict, scene)
    else:
        _await_end(verdict, scene, from_s)
    _await_off(log, HEARTBEAT_TIMEOUT_S + 2.0)
    if log is not None:
        time.sleep(_FLUSHED_S)
        log.update()
    verdict.stderr = scene.stderr
    _check_end(verdict, scene)
    if log is not None and case.victim != "simulate":
        hit_s = scene.time_of(hit_ns)
        _check_drive(verdict, log, scene.time_of(before_ns), hit_s, was_on=was_on)
    _check_file(verdict, scene, hit_ns, wall_ns)
    verdict.after = scene.next_session()
    if not verdict.after.endswith("complete"):
        verdict.complaints.append(f"the next session: {verdict.after}")
        verdict.after = "failed"
    if case.daemon and scene.supervisor.poll() is None:
        _end_daemon(verdict, scene)
    _await_end(verdict, scene, from_s)
    scene.end_simulator()
    if scene.log is not None and scene.log.torques and scene.log.enabled:
        verdict.complaints.append("the drive is on after the next session")
    return verdict


def _await_end(verdict: Verdict, scene: Scene, from_s: float) -> None:
    """Wait until the last process of the session is gone, and check what it leaves."""
    ended_s = time.monotonic()
    # A killed process disappears before the last of its threads releases its locks.
    while (left := scene.processes()) or scene.locks_held:
        if time.monotonic() - ended_s > _ENDED_S:
            break
        time.sleep(0.02)
    verdict.gone_s = verdict.gone_s or time.monotonic() - from_s
    for command in left.values():
        verdict.complaints.append(f"left behind: {command.replace(bytes(1), b' ').decode()}")
    if not left and scene.locks_held:
        verdict.complaints.append(f"locked: {', '.join(scene.locks_held)}")


def _check_daemon(verdict: Verdict, scene: Scene) -> None:
    """Check the state of the daemon."""
    expected = {"ready"} if verdict.exit_code == 0 else {"ready", "fault"}
    if verdict.case.victim in ("control", "simulate"):
        expected = {"ready", "fault"}  # which notices it after the session's end, too
    state = scene.state
    if state not in expected:
        verdict.complaints.append(f"the daemon is in the state {state!r}")


def _end_daemon(verdict: Verdict, scene: Scene) -> None:
    """End the daemon."""
    scene.supervisor.send_signal(signal.SIGTERM)
    with contextlib.suppress(subprocess.TimeoutExpired):
        scene.supervisor.wait(_ENDED_S)
    if scene.supervisor.returncode != 0:
        verdict.complaints.append(f"rigd serve ended with {scene.supervisor.returncode}")


def _ended(scene: Scene) -> bool:
    return scene.session.poll() is not None


def _send(processes: list[int], number: signal.Signals) -> None:
    for pid in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)


def _await_off(log: DriveLog | None, patience_s: float) -> None:
    """Wait until the drive is off, or for a time; `_check_drive` reports a drive that is on."""
    if log is None:  # it ends with the control process
        time.sleep(HEARTBEAT_TIMEOUT_S)
        return
    deadline = time.monotonic() + patience_s
    log.update()
    while log.enabled and time.monotonic() < deadline:
        time.sleep(0.05)
        log.update()


def _check_end(verdict: Verdict, scene: Scene) -> None:
    case, result = verdict.case, scene.result
    if result is not None:
        verdict.outcome = result["outcome"]
    complete = result is not None and result["outcome"] == "complete" and not result["reason"]
    ends_by_itself = {0} if complete else {130} if verdict.outcome == "stopped" else {1}
    passing = case.how in _ASKING and case.victim in ("recorder", "publisher")
    if case.victim == "publisher" or passing:
        expected = {0}
        if not complete:
            verdict.complaints.append(f"the session did not go on: {verdict.outcome}")
        lost = not passing and case.stopped_s is None and case.timed and not case.anywhere
        if lost and "It is restarted" not in verdict.stderr:
            verdict.complaints.append("the publisher was not restarted")
    elif case.killed and case.victim in ("supervisor", "all"):
        # Unless it had ended before.
        expected = {1} if case.daemon else {-signal.SIGKILL, *({0} if complete else ())}
    elif case.how in _ASKING and case.victim in ("supervisor", "all", "control"):
        # Exit code 130 of rigd run is a requested stop.
        unasked = case.daemon or case.anywhere or case.victim == "control"
        expected = {0} if complete else {130, 1} if unasked else {130}
        if case.anywhere and not verdict.stderr:
            expected.add(-case.how)  # so early that the interpreter did not handle signals yet
    elif case.anywhere or case.how == signal.SIGSTOP:
        expected = ends_by_itself
        if case.victim == "simulate" and case.mode == "lock-step" and result is None:
            expected.add(2)  # gone before the search for it: there is nothing to be fast with
    else:
        expected = {1}
    if verdict.exit_code not in expected:
        verdict.complaints.append(f"exit code {verdict.exit_code} instead of {sorted(expected)}")
    if "Traceback" in verdict.stderr:
        verdict.complaints.append("a traceback")
    words = ("Error: ", "Fault: ", "Stopped: ", "After the record: ")
    if verdict.exit_code == 1 and not any(word in verdict.stderr for word in words):
        verdict.complaints.append("no message")


def _check_drive(
    verdict: Verdict, log: DriveLog, before_s: float, hit_s: float, *, was_on: bool
) -> None:
    case, torques = verdict.case, log.torques
    if not case.timed:
        _check_lock_step(verdict, torques)
        return
    if torques and (torques[-1]["enabled"] or torques[-1]["torque_nm"]):
        verdict.complaints.append(f"the drive is on in the end: {torques[-1]}")
        return
    offs = [e["t_s"] for e in torques if not e["enabled"] and e["t_s"] > before_s - _TRANSPORT_S]
    if case.victim == "publisher" or not (was_on and offs):
        return
    verdict.off_s = offs[0] - hit_s
    if verdict.outcome == "complete":
        return  # hit too late, or with too little effect, to end the session
    within_s = OFF_WITHIN_S[case.victim, case.how] + case.grace_s
    if (case.victim, case.how, case.anywhere) == ("recorder", signal.SIGSTOP, True):
        within_s = max(within_s, ARMED_S)
    if verdict.off_s > within_s + _TRANSPORT_S:
        verdict.complaints.append(f"the drive was off after {verdict.off_s:.3f} s, not {within_s}")


def _check_lock_step(verdict: Verdict, torques: list[dict[str, Any]]) -> None:
    """Check by simulated time, which follows the clock once no SYNC comes."""
    if torques and (torques[-1]["enabled"] or torques[-1]["torque_nm"]):
        verdict.complaints.append(f"the drive is on in the end: {torques[-1]}")
        return
    on_s = [entry["t_s"] for entry in torques if entry["enabled"]]
    if on_s:
        verdict.off_s = torques[-1]["t_s"] - on_s[-1]
        if verdict.off_s > HEARTBEAT_TIMEOUT_S + _TRANSPORT_S:
            verdict.complaints.append(
                f"the drive was off {verdict.off_s:.3f} s after the last SYNC"
            )


def _check_file(verdict: Verdict, scene: Scene, hit_ns: int, wall_ns: int) -> None:
    path = _only_file(verdict, scene)
    if path is None:
        return
    if path.suffix == ".part":
        path = _recovered(verdict, path, scene)
        if path is None:
            return
    session = read_session(path)
    samples, outcome = session.samples, session.outcome
    if outcome is None:
        verdict.complaints.append("a file without outcome")
        return
    if verdict.outcome == "none":
        verdict.outcome = outcome["outcome"]
    counts = {key: int(outcome[key]) for key in ("scheduled", "recorded", "missed", "lost")}
    if counts["scheduled"] != counts["recorded"] + counts["missed"] + counts["lost"]:
        verdict.complaints.append(f"counts: {counts}")
    if counts["recorded"] != len(samples):
        verdict.complaints.append(f"{len(samples)} samples, {counts['recorded']} recorded")
    if not len(samples):
        return
    if not verdict.case.timed:
        return
    # In the simulated rig's time.
    due_s = (session.start_utc_ns - wall_ns + samples["t_ns"].astype(np.int64)) * 1e-9
    due_s += scene.time_of(0)
    hit_s = scene.time_of(hit_ns)
    ticks = samples["tick"].astype(np.int64)
    if due_s[0] < hit_s < due_s[0] + REST_S + verdict.case.sweep_s + RING_DOWN_S:
        verdict.behind_s = float(hit_s - due_s[-1])
        stored_before_s = STORED_S + verdict.case.grace_s
        gone = [
            e["t_s"]
            for e in ([] if scene.log is None else scene.log.torques)
            if due_s[-1] + _TRANSPORT_S < e["t_s"] < hit_s - stored_before_s and e["enabled"]
        ]
        if gone:
            verdict.complaints.append(f"lost {len(gone)} ticks from {hit_s - gone[0]:.3f} s before")
        if scene.log is None and verdict.behind_s > LOST_S + verdict.case.grace_s:
            verdict.complaints.append(f"the file ends {verdict.behind_s:.3f} s before")
        gaps = np.diff(ticks) - 1
        before = gaps[(due_s[1:] > hit_s - 2.0) & (due_s[1:] <= hit_s)].sum()
        after = gaps[(due_s[1:] > hit_s) & (due_s[1:] <= hit_s + 2.0)].sum()
        verdict.missed = int(before), int(after)
    if outcome["outcome"] != "complete" and verdict.case.victim == "supervisor":
        last = samples[-1]
        off = last["torque_command_nm"] == 0.0 and last["status"] & Status.TORQUE_OFF
        if not off and counts["scheduled"] == ticks[-1] + 1:
            verdict.complaints.append("the last sample has a torque")
    if verdict.case.analysed and outcome["outcome"] != "complete":
        verdict.analysis = _analysed(verdict, path, len(samples))


def _only_file(verdict: Verdict, scene: Scene) -> Path | None:
    files = scene.files
    if not files:
        if not verdict.case.anywhere:
            verdict.complaints.append("no file")
        return None
    if len(files) > 1:
        verdict.complaints.append(f"files: {[path.name for path in files]}")
    verdict.file_suffix = files[0].suffix[1:]
    return files[0]


def _recovered(verdict: Verdict, part: Path, scene: Scene) -> Path | None:
    """Recover the file that the recorder left."""
    done = _finished(verdict, [BIN / "rigd", "recover", part], scene.folder)
    if done is None:
        return None
    path = part.with_suffix("")
    if "Traceback" in done.stderr:
        verdict.complaints.append("a traceback of rigd recover")
    if done.returncode != 0 or not path.exists():
        if part.stat().st_size and not verdict.case.anywhere:
            verdict.complaints.append(f"rigd recover: {done.returncode}, {_line(done.stderr)}")
        return None
    return path


def _analysed(verdict: Verdict, path: Path, samples: int) -> str:
    options = ["--frf", "fft", "--types", "VI", "--weights", "omega", "--json", "-"]
    done = _finished(verdict, [BIN / "analyze", path, *options], path.parent)
    if done is None:
        return "too slow"
    if done.returncode == 0:
        return "accepted"
    if "Traceback" in done.stderr or not done.stderr.startswith("Error: "):
        verdict.complaints.append(f"analyze: {_line(done.stderr)}")
        return "refused"
    if "missing or flagged" in done.stderr:
        return "gaps"  # for as long as the loop was suspended, or the computer busy with others
    if samples > 1000 * (REST_S + 1.5):
        verdict.complaints.append(f"analyze on {samples} samples: {_line(done.stderr)}")
    return "too short"


def _finished(
    verdict: Verdict, command: list[str | Path], folder: Path
) -> subprocess.CompletedProcess[str] | None:
    """Run a command on the file; one that takes too long is a complaint, and None."""
    try:
        return subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=_COMMAND_S, check=False
        )
    except subprocess.TimeoutExpired:
        name = " ".join(Path(each).name for each in command[:2])
        verdict.complaints.append(f"{name}: not done after {_COMMAND_S:g} s")
        return None


def _line(text: str) -> str:
    return text.strip().rsplit("\n", 1)[-1][:200]


def changed(text: str, changes: tuple[tuple[str, str], ...], *, all_there: bool = True) -> str:
    """Return a profile with other numbers."""
    for old, new in changes:
        if old not in text and all_there:
            raise HarnessError(f"{PROFILE} has no {old!r}")
        text = text.replace(old, new, 1)
    return text


def wait_for(condition: Callable[[], object], patience_s: float, what: str) -> None:
    deadline = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > deadline:
            raise HarnessError(f"No {what} within {patience_s:g} s.")
        time.sleep(0.01)


@contextlib.contextmanager
def _environ(**values: str) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def random_cases(
    chooser: random.Random, count: int, modes: tuple[str, ...], victims: tuple[str, ...]
) -> Iterator[Case]:
    """Draw the cases: modes in turn, victims in turn in each of them, five of six in the record."""
    for number in range(count):
        mode = modes[number % len(modes)]
        there = [v for v in victims if v != "simulate" or mode != "direct"]
        victim = there[number // len(modes) % len(there)]
        how = chooser.choice((signal.SIGKILL, signal.SIGKILL, signal.SIGSTOP, *SIGNALS[1:]))
        anywhere = chooser.random() < 1 / 6
        if mode == "lock-step":  # sweeps as quickly as the two of them can
            moment_s, sweep_s = chooser.uniform(0.1, 1.5), 20.0
        else:
            moment_s, sweep_s = chooser.uniform(0.3, 4.5), 5.0
        yield Case(
            victim=victim,
            how=how,
            moment_s=chooser.uniform(0.3, 7.0) if anywhere and mode != "lock-step" else moment_s,
            anywhere=anywhere,
            mode=mode,
            stopped_s=chooser.uniform(0.5, 9.0) if how == signal.SIGSTOP else None,
            sweep_s=sweep_s,
            analysed=number % 4 == 0,
            grace_s=_GRACE_S,
            afterwards=chooser.choice((signal.SIGCONT, signal.SIGCONT, signal.SIGKILL)),
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2, help="Cases that are played at a time.")
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--modes", default=",".join(MODES))
    parser.add_argument("--victims", default=",".join(VICTIMS))
    parser.add_argument("--keep", type=Path, help="Folder for what a case with complaints left.")
    given = parser.parse_args()
    modes, victims = tuple(given.modes.split(",")), tuple(given.victims.split(","))
    cases = list(random_cases(random.Random(given.seed), given.cases, modes, victims))
    print(f"seed {given.seed}, {len(cases)} cases")  # noqa: T201
    started_s = time.monotonic()
    verdicts, skipped = [], 0
    with ProcessPoolExecutor(given.jobs) as pool:
        futures = {
            pool.submit(
                run_case_in_own_folder, case, given.keep and given.keep / f"{number:03}"
            ): number
            for number, case in enumerate(cases)
        }
        for future in as_completed(futures):
            number = futures[future]
            try:
                verdicts.append(future.result())
            except HarnessError as error:
                skipped += 1
                print(f"{number:3} {cases[number]}: not staged. {error}", flush=True)  # noqa: T201
                continue
            print(f"{number:3} {verdicts[-1].row()}", flush=True)  # noqa: T201
            if verdicts[-1].complaints:
                print(verdicts[-1].stderr)  # noqa: T201
    print(summary(verdicts))  # noqa: T201
    took_s = time.monotonic() - started_s
    bad = [verdict for verdict in verdicts if verdict.complaints]
    back = sum(verdict.after.endswith("complete") for verdict in verdicts)
    print(  # noqa: T201
        f"{len(verdicts)} cases, {len(bad)} with complaints, the next session complete in {back}; "
        f"{skipped} not staged; {took_s:.0f} s"
    )
    return 1 if bad else 0


def run_case_in_own_folder(case: Case, failures: Path | None) -> Verdict:
    """Run a case in its own folder, which is stored only if something is wrong.

    Raises
    ------
    HarnessError
        If the case could not be staged.
    """
    folder = Path(tempfile.mkdtemp(prefix="rigd-case-"))
    try:
        verdict = run_case(case, folder)
        if verdict.complaints and failures:
            shutil.copytree(folder, failures, dirs_exist_ok=True)
        return verdict
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def summary(verdicts: list[Verdict]) -> str:
    """Return a table: a line a mode, victim and signal."""
    lines = [
        f"{'mode':9} {'victim':10} {'signal':8} cases  bad  off p50/max s   behind p50/max s  "
        "gone max s  back  reset  stalled  missed before/after"
    ]
    for mode, victim, how in itertools.product(MODES, VICTIMS, SIGNALS):
        mine = [
            v for v in verdicts if (v.case.mode, v.case.victim, v.case.how) == (mode, victim, how)
        ]
        if not mine:
            continue
        off = [v.off_s for v in mine if v.off_s is not None]
        behind = [v.behind_s for v in mine if v.behind_s is not None]
        lines.append(
            f"{mode:9} {victim:10} {how.name:8} {len(mine):5} "
            f"{sum(bool(v.complaints) for v in mine):4}"
            f"  {_spread(off):>14}  {_spread(behind):>16}  {max(v.gone_s for v in mine):10.2f}"
            f"  {sum(v.after.endswith('complete') for v in mine):4}"
            f"  {sum('reset' in v.after for v in mine):5}"
            f"  {sum('stalled' in v.after for v in mine):7}"
            f"  {sum(v.missed[0] for v in mine)}/{sum(v.missed[1] for v in mine)}"
        )
    return "\n".join(lines)


def _spread(values: list[float]) -> str:
    return f"{statistics.median(values):.3f}/{max(values):.3f}" if values else "-"


if __name__ == "__main__":
    sys.exit(main())
