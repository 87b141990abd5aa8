"""Situations in which a session runs and `rigd stop` is called from elsewhere.

Each is set up in separate namespaces (processes, mounts, network), where no sessions of other
users can be stopped: run as root, ``python benchmarks/stop_scenarios.py SITUATION COUNT``. It
prints a JSON document for each stop: seconds, exit code, output, and errors.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from rigd.daemon.client import Client, DaemonUnreachableError, RefusedByDaemonError
from rigd.engine import IDLE_NAME, SESSION_NAME, supervisor_of_control
from rigd.runtime.processes import read_process, read_processes
from rigd.testing import write_profile

RIGD = Path(sys.executable).with_name("rigd")
ADA, BOB = 12345, 23456
"""Two users, by number."""
_PATIENCE_S = 60.0
_PATIENT = {
    "limits.angle_rad": 100.0,
    "limits.stop_angle_rad": 200.0,
    "limits.velocity_rad_s": 100.0,
    "limits.acceleration_rad_s2": 4.0e4,
    "limits.tracking_error_rad": 100.0,
    "limits.sensor_range_percent": 200.0,
    "limits.missed_ticks_in_a_row": 1_000_000,
    "limits.missed_percent": 99.9,
    "limits.tare_drift_nm": 10.0,
}
"""Limits that a busy computer does not exceed."""
_HOLD = ("hold", "--duration", "100", "--rest", "0.2", "--no-look")
_PREPARE = (
    "set -e; mount -t tmpfs tmpfs /tmp; chmod 1777 /tmp; mount -t tmpfs tmpfs /run; "
    'chmod 755 /run; mkdir -m 1777 /run/lock; exec "$@"'
)

Environment = Mapping[str, str]


def isolated(*command: object) -> list[str]:
    """Return a command line that runs a command in new namespaces, with an empty /tmp."""
    spaces = ("--pid", "--fork", "--kill-child", "--mount", "--net", "--mount-proc")
    return ["unshare", *spaces, "sh", "-c", _PREPARE, "sh", *map(str, command)]


def can_isolate() -> bool:
    """Whether this user may make such namespaces, and run programs as other users."""
    if os.getuid():
        return False
    command = isolated(sys.executable, __file__, "--check")
    with suppress(OSError):
        return not subprocess.run(command, capture_output=True, check=False).returncode
    return False


def open_to_all(*needed: Path) -> None:
    """Make folders accessible to all users, also those in the private home of this one.

    The home is replaced by an empty folder that contains them, in this namespace only.
    """
    closed = {
        parent for path in needed for parent in path.parents if not parent.stat().st_mode & 0o001
    }
    for home in sorted(closed, key=lambda path: len(path.parts)):
        if not os.path.ismount(home):
            inside = [path for path in needed if home in path.parents]
            spare = [Path(f"/run/spare-{number}") for number in range(len(inside))]
            for path, mount_point in zip(inside, spare, strict=True):
                mount_point.mkdir()
                _mount("--bind", path, mount_point)
            _mount("-t", "tmpfs", "-o", "mode=755", "tmpfs", home)
            for path, mount_point in zip(inside, spare, strict=True):
                path.mkdir(parents=True)
                _mount("--move", mount_point, path)


def _mount(*arguments: object) -> None:
    subprocess.run(["mount", *map(str, arguments)], check=True)


class Rigs:
    """Daemons and sessions in the foreground, which end with their context."""

    def __init__(self) -> None:
        self._started: list[subprocess.Popen[bytes]] = []
        self._folder = Path("/tmp/rigs")
        self._folder.mkdir(exist_ok=True)
        self._folder.chmod(0o755)

    def __enter__(self) -> "Rigs":
        return self

    def __exit__(self, *_: object) -> None:
        for process in reversed(self._started):
            process.send_signal(signal.SIGCONT)
            process.terminate()
        for process in reversed(self._started):
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def profile(self, name: str) -> Path:
        """Write a profile of a simulated rig with limits for a busy computer."""
        values = {"name": name, "session.tare_s": 0.5, "session.return_s": 0.3} | _PATIENT
        path = self._folder / f"{name}.toml"
        return path if path.exists() else write_profile(self._folder, values)

    def start(self, uid: int, environment: Environment, *arguments: object) -> subprocess.Popen:
        """Start `rigd` as a user."""
        output = self._folder / f"of-{uid}"
        output.mkdir(exist_ok=True)
        os.chown(output, uid, uid)
        with (self._folder / f"log-{len(self._started)}.txt").open("wb") as log:
            process = subprocess.Popen(
                as_user(uid, RIGD, *arguments, "--output", output),
                env={"PATH": "/usr/bin:/bin", **environment},
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd="/",
            )
        self._started.append(process)
        return process

    def serve(self, uid: int, environment: Environment, rig: str = "sim") -> subprocess.Popen:
        """Start a daemon as a user."""
        return self.start(uid, environment, "serve", "--profile", self.profile(rig), "--no-look")

    def run(self, uid: int, environment: Environment, rig: str = "sim") -> subprocess.Popen:
        """Start a session in the foreground as a user, and wait until it runs."""
        process = self.start(uid, environment, "run", *_HOLD, "--profile", self.profile(rig))
        until(lambda: control_of(process.pid) == SESSION_NAME)
        return process


def as_user(uid: int, *command: object) -> list[str]:
    """Return a command line that runs a command as a user."""
    change = [] if uid == 0 else ["setpriv", f"--reuid={uid}", f"--regid={uid}", "--clear-groups"]
    return [*change, *map(str, command)]


def until(condition: Callable[[], object]) -> None:
    """Wait for a condition.

    Raises
    ------
    TimeoutError
        If it does not come true.
    """
    deadline = time.monotonic() + _PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            logs = "\n".join(path.read_text() for path in Path("/tmp/rigs").glob("log-*"))
            raise TimeoutError(logs)
        time.sleep(0.02)


def control_of(pid: int) -> str:
    """Return the short name of the control process of a supervisor; empty if there is none."""
    for process in read_processes():
        if supervisor_of_control(process.command) == pid:
            return process.name
    return ""


def sessions() -> list[int]:
    """Return the control processes that run a session, or may."""
    return [
        process.pid
        for process in read_processes()
        if supervisor_of_control(process.command) is not None and process.name != IDLE_NAME
    ]


def begin(socket: Path) -> None:
    """Start a session in a daemon; return when it records.

    A session that ends because the computer is busy is restarted.
    """
    parameters = {"duration_s": 100.0, "rest_s": 0.2, "ring_down_s": 0.0}

    def recording() -> bool:
        with suppress(DaemonUnreachableError, RefusedByDaemonError), Client(socket) as client:
            status = client.ask("status")
            if status["state"] == "fault":
                client.ask("reset")
            elif status["state"] == "ready":
                client.ask("start", excitation="hold", parameters=parameters)
            progress = status["progress"]
            return (
                progress is not None
                and progress["phase"] == "running"
                and control_of(client.pid) == SESSION_NAME
            )
        return False

    until(recording)


def folder(path: str, uid: int = 0) -> Path:
    """Make a folder that only its user can enter."""
    made = Path(path)
    made.mkdir(mode=0o700, parents=True, exist_ok=True)
    os.chown(made, uid, uid)
    return made


# Situations: each starts sessions repeatedly, and yields the call that stops them

Call = tuple[int, Environment, Sequence[subprocess.Popen]]
"""User and environment of `rigd stop`, and the daemons that must continue."""
SUDO = {"SUDO_UID": str(ADA), "SUDO_USER": "ada", "HOME": "/root", "PATH": "/usr/bin:/bin"}


def other_folder(rigs: Rigs) -> Iterator[Call]:
    """Call from another XDG_RUNTIME_DIR."""
    here, there = folder("/tmp/here"), folder("/tmp/there")
    daemon = rigs.serve(0, {"XDG_RUNTIME_DIR": str(there)})
    while True:
        begin(there / "rigd" / "sim.daemon")
        yield 0, {"XDG_RUNTIME_DIR": str(here)}, [daemon]


def no_environment(rigs: Rigs) -> Iterator[Call]:
    """Call from an empty environment, as `env -i` does."""
    for uid, environment, daemons in other_folder(rigs):
        del environment
        yield uid, {}, daemons


def root_by_sudo(rigs: Rigs) -> Iterator[Call]:
    """Call as root while another user's daemon runs the session."""
    there = folder(f"/run/user/{ADA}", ADA)
    daemon = rigs.serve(ADA, {"XDG_RUNTIME_DIR": str(there)})
    while True:
        begin(there / "rigd" / "sim.daemon")
        yield 0, SUDO, [daemon]


def two_daemons(rigs: Rigs) -> Iterator[Call]:
    """Call while one or both of two daemons run a session."""
    there = folder("/tmp/there")
    environment = {"XDG_RUNTIME_DIR": str(there)}
    daemons = [rigs.serve(0, environment, rig) for rig in ("one", "two")]
    both = False
    while True:
        begin(there / "rigd" / "two.daemon")
        if both:
            begin(there / "rigd" / "one.daemon")
        yield 0, environment, daemons
        both = not both


def squatted_fallback(rigs: Rigs) -> Iterator[Call]:
    """Call after another user has taken the name of the folder in /tmp, and given it up."""
    taken = folder(f"/tmp/rigd-{ADA}", BOB)
    daemon = rigs.serve(ADA, {})
    socket = Path(f"/tmp/rigd-{ADA}-1/sim.daemon")
    until(socket.exists)
    while True:
        begin(socket)
        if taken.exists():
            taken.rmdir()
        else:
            folder(str(taken), BOB)
        yield ADA, {}, [daemon]


def foreground(rigs: Rigs) -> Iterator[Call]:
    """Call from another folder while a session runs in the foreground."""
    there, here = folder("/tmp/there", ADA), folder("/tmp/here", ADA)
    while True:
        rigs.run(ADA, {"XDG_RUNTIME_DIR": str(there)})
        yield ADA, {"XDG_RUNTIME_DIR": str(here)}, []


SITUATIONS = {
    each.__name__: each
    for each in (
        no_environment,
        other_folder,
        root_by_sudo,
        two_daemons,
        squatted_fallback,
        foreground,
    )
}


def stop(uid: int, environment: Environment) -> dict[str, object]:
    """Call `rigd stop`."""
    began_s = time.perf_counter()
    done = subprocess.run(
        as_user(uid, RIGD, "stop"),
        env=dict(environment),
        capture_output=True,
        text=True,
        check=False,
        cwd="/",
    )
    took_s = time.perf_counter() - began_s
    return {"s": took_s, "code": done.returncode, "out": done.stdout, "err": done.stderr}


@contextmanager
def called(name: str) -> Iterator[Callable[[], dict[str, object]]]:
    """Set up a situation, and yield a function that starts the sessions and stops them."""
    with Rigs() as rigs:
        calls = SITUATIONS[name](rigs)

        def call() -> dict[str, object]:
            uid, environment, daemons = next(calls)
            assert sessions()
            result = stop(uid, environment)
            wrong = []
            if sessions():
                wrong.append("a session runs on")
            if result["code"] != 0 or "the torque is off" not in str(result["out"]):
                wrong.append("not reported as stopped")
            if any(read_process(daemon.pid) is None for daemon in daemons):
                wrong.append("a daemon has ended")
            return result | {"wrong": wrong}

        yield call


def main() -> None:
    """Print the result of each stop of a situation."""
    open_to_all(Path(sys.base_prefix).resolve(), Path(__file__).resolve().parents[1])
    if sys.argv[1] == "--check":
        subprocess.run(as_user(ADA, sys.executable, RIGD, "--version"), check=True)
        return
    name, count = sys.argv[1], int(sys.argv[2])
    with called(name) as call:
        for _ in range(count):
            print(json.dumps(call()), flush=True)


if __name__ == "__main__":
    main()
