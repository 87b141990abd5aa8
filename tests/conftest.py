"""Settings that must stand before numpy is imported, and the simulated rig as a process."""

import atexit
import contextlib
import fcntl
import gc
import io
import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
import warm_start
from hypothesis import settings
from PIL import Image

from rigd import testing
from rigd.runtime.background import use_one_thread

pytest_plugins = [
    "browsers", "library_folders", "paper_sweeps", "patient_drives",
    "rewritten_once", "shared_memory_closed", "shipped_profile", "standstill", "synthetic_sessions",
    "touch_sessions", "web_daemon",
]  # fmt: skip

# Collecting makes no garbage: see `pytest_collection_finish`.
gc.disable()

# As in the commands, before anything here imports numpy; threads would fight each other.
assert "numpy" not in sys.modules
use_one_thread()

# A shell that starts a command in the background has it, and all that it starts, ignore these.
for _number, _default in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGQUIT, signal.SIG_DFL),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _default)

# No test meets a rig that somebody simulates on this computer, nor one of another worker.
_RUNTIME = tempfile.mkdtemp(prefix="rigd-tests-")
os.environ["XDG_RUNTIME_DIR"] = _RUNTIME
# Nor a profile of the user's own that hides a shipped one.
os.environ["XDG_CONFIG_HOME"] = f"{_RUNTIME}/config"
# Nor fits of an earlier run: records are fitted anew, except where the cache is tested.
os.environ["XDG_CACHE_HOME"] = f"{_RUNTIME}/cache"
os.environ["RIGD_NO_CACHE"] = "1"
# Sessions make no quick look, except where that is tested.
os.environ["RIGD_NO_LOOK"] = "1"
atexit.register(shutil.rmtree, _RUNTIME, ignore_errors=True)

# The same examples each time, without a time limit: a failure is due to a change. Others,
# and more, are searched for by `make fuzz`.
settings.register_profile("same", settings.get_profile("ci"), max_examples=40)
settings.register_profile("others", settings.get_profile("ci"), derandomize=False)
settings.load_profile("same")


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """One more than processors, for the time in which tests wait for processes and real time."""
    return (os.cpu_count() or 1) + 1


def pytest_collection_finish(session: pytest.Session) -> None:
    """Seven thousand tests stay to the end: no garbage collection needs to visit them."""
    gc.freeze()
    gc.enable()


RIGD = Path(sys.executable).parent / "rigd"
HW_PROFILES = Path(__file__).parents[1] / "hw_profiles"

# A machine at a standstill, or a slow one, meets no deadlines: ticks are missed, replies come late,
# and the torque held meanwhile swings the motor out. It ends no session in real time here; the
# effect of limits and time-outs is tested with simulated time.
PATIENT = {
    "motor.thermal_time_constant_s": "1.0e3",
    "limits.angle_rad": "100.0",
    "limits.stop_angle_rad": "200.0",
    "limits.velocity_rad_s": "100.0",
    "limits.acceleration_rad_s2": "4.0e4",
    "limits.tracking_error_rad": "100.0",
    "limits.torque_command_nm": "1.0e4",
    "limits.sensor_range_percent": "200.0",
    "limits.saturated_ticks_in_a_row": "1000000",
    "limits.stale_ticks_in_a_row": "1000000",
    "limits.missed_ticks_in_a_row": "1000000",
    "limits.missed_percent": "99.9",
    "limits.stale_percent": "99.9",
    "limits.tare_drift_nm": "10.0",
    "cia402.heartbeat_timeout_s": "5.0",
    "cia402.max_speed_rad_s": "0.0",
    "cia402.drive_heartbeat_timeout_s": "5.0",
    "cia402.enable_timeout_s": "10.0",
    "cia402.torque_tolerance_percent": "0.0",
}
BRIEF = {"session.tare_s": "0.5", "session.return_s": "0.3"}
SEEDED = {"simulation.seed": "1"}


@pytest.fixture(scope="session")
def write_profile_in():
    """Write a shipped profile into a folder, as `write_profile` does."""

    def write(folder, name, values=None, *, patient=False) -> Path:
        base = HW_PROFILES / f"{name}.toml"
        sections = tomllib.loads(base.read_text("utf-8"))
        borne = {key: PATIENT[key] for key in PATIENT if key.split(".")[0] in sections}
        texts = BRIEF | SEEDED | (borne if patient else {}) | (values or {})
        other = {key: tomllib.loads(f"value = {text}")["value"] for key, text in texts.items()}
        return testing.write_profile(folder, other, base_profile=str(base))

    return write


@pytest.fixture
def write_profile(tmp_path, write_profile_in):
    """Write a shipped profile with other values (by `section.key`) and short ways from and to rest.

    One that is `patient` tolerates a standstill of the machine.
    """
    return partial(write_profile_in, tmp_path)


@pytest.fixture
def runtime_folder(monkeypatch):
    """A folder of this test's own for the sockets of simulated rigs; their paths must be short."""
    folder = Path(tempfile.mkdtemp(prefix="rigd-test-"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


BRIEF_QUICK_LOOK = """
import json, pathlib, sys

session = pathlib.Path(sys.argv[1])
text = [f"Quick look at {session.stem}", "  mode 1"]
look = {"version": 1, "file": session.name, "text": text}
session.with_suffix(".look.json").write_text(json.dumps(look))
"""


@pytest.fixture
def brief_quick_looks(tmp_path_factory, monkeypatch):
    """Have quick looks made, by a program that takes no time; returns its file, to be changed."""
    folder = tmp_path_factory.mktemp("brief") / "analysis"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "quick_look.py").write_text(BRIEF_QUICK_LOOK)
    monkeypatch.setenv("PYTHONPATH", str(folder.parent))
    monkeypatch.delenv("RIGD_NO_LOOK")
    return folder / "quick_look.py"


@pytest.fixture
def rigd(tmp_path):
    """Run `rigd` in an empty folder; returns the completed process."""

    def run(*arguments, timeout=300):
        return warm_start.run(
            [RIGD, *map(str, arguments)],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=timeout,
            check=False,
            env=os.environ | {"COLUMNS": "120"},
        )

    return run


@pytest.fixture
def start_rigd(tmp_path):
    """Start `rigd` in an empty folder; it is killed if a test leaves it running."""
    started = []

    def start(*arguments, folder=tmp_path, cold=False, packages=None):
        """A `cold` start is of a new interpreter, whose command line others may read.

        Packages in a folder `packages` are installed for any other.
        """
        started.append(
            (subprocess.Popen if cold else partial(warm_start.start, packages=packages))(
                [RIGD, *map(str, arguments)],
                cwd=folder,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,  # a process group of its own, as in a terminal
            )
        )
        return started[-1]

    yield start
    for process in started:
        process.kill()
        # Its output helps if a test failed without checking it.
        sys.stdout.write("\n".join(process.communicate()))


@dataclass(frozen=True)
class Done:
    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def rigd_here(tmp_path, monkeypatch):
    """Run `rigd` in this process, as far as it comes without any other."""
    from rigd.cli.app import app
    from rigd.runtime import StopRequest

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    no_group = StopRequest(), contextlib.nullcontext()
    for command in ("run", "identify"):
        monkeypatch.setattr(f"rigd.cli.{command}.start_processes", lambda **_: no_group)
    monkeypatch.setattr("rigd.runtime.ignore_end_signals", lambda **_: None)  # of the test runner

    return partial(run_here, app)


@pytest.fixture
def analyze_here(tmp_path, monkeypatch):
    """Run `analyze` in this process, which has the slow imports already."""
    from analysis.cli.app import app

    monkeypatch.chdir(tmp_path)
    return partial(run_here, app)


@pytest.fixture(scope="session")
def without_drawing():
    """A context in which reports have blank pictures: drawing takes longer than all the rest."""
    picture = io.BytesIO()
    Image.new("L", (1, 1)).save(picture, "png")
    blank = {"png": picture.getvalue(), "svg": b'<svg xmlns="http://www.w3.org/2000/svg"/>'}

    def savefig(_figure, stream, *, format, **_options):  # noqa: A002
        stream.write(blank[format])

    @contextlib.contextmanager
    def entered():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("matplotlib.figure.Figure.savefig", savefig)
            yield

    return entered


def run_here(app, *arguments) -> Done:
    from typer.testing import CliRunner

    done = CliRunner().invoke(app, list(map(str, arguments)))
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return Done(done.exit_code, done.stdout, done.stderr)


@pytest.fixture
def children_copied():
    """Have the processes of a rig that this process starts be spared their imports."""
    import rigd.engine.control_process
    import rigd.engine.recorder  # noqa: F401

    with warm_start.children_copied():
        yield


@pytest.fixture
def start_simulator(runtime_folder, tmp_path):
    """Start `rigd simulate` for a profile and wait until it can be found."""
    from rigd.devices.running_simulator import find_simulator
    from rigd.profile import load_profile

    started = []

    def start(profile, *options) -> subprocess.Popen:
        with (tmp_path / f"simulator-{len(started)}.txt").open("w") as log:
            process = warm_start.start(
                [RIGD, "simulate", "--profile", str(profile), *map(str, options)],
                cwd=tmp_path,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        started.append(process)
        name = load_profile(profile).name
        deadline = time.monotonic() + 300.0
        while find_simulator(name) is None:
            assert process.poll() is None, Path(log.name).read_text()
            assert time.monotonic() < deadline, "the simulator does not answer"
            time.sleep(0.02)
        return process

    yield start
    for process in started:
        process.terminate()
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@pytest.fixture(scope="session")
def made_once(tmp_path_factory, request):
    """Fill a folder once for all workers, by the first of them; nothing changes it later."""
    base = tmp_path_factory.getbasetemp()
    if hasattr(request.config, "workerinput"):
        base = base.parent

    def made(name, make) -> Path:
        folder, complete = base / name, base / f"{name}.complete"
        with (base / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not complete.exists():
                shutil.rmtree(folder, ignore_errors=True)  # of one who failed
                folder.mkdir()
                make(folder)
                complete.touch()
        return folder

    return made


@pytest.fixture(scope="session")
def computed_once(made_once):
    """Have a result that can be pickled computed once for all workers."""

    def result(name, compute):
        def make(folder):
            (folder / "result.pickle").write_bytes(pickle.dumps(compute()))

        return pickle.loads((made_once(name, make) / "result.pickle").read_bytes())

    return result


@pytest.fixture(scope="session")
def paper_session(made_once):
    """The paper's session on the shipped simulated rig: its file, and the output of the command."""

    def make(folder):
        command = [RIGD, "run", "chirp", "--fast", "--seed", "1", "--json", "--output", folder]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        (folder / "session.json").write_text(done.stdout)

    report = (made_once("paper_session", make) / "session.json").read_text()
    (session,) = json.loads(report)["sessions"]
    return Path(session["path"]), session


@pytest.fixture(scope="session")
def short_chirps(made_once):
    """Two chirps of the simulated rig: 0.5 s of rest, 20 s to 50 Hz, 1 s of ring-down."""

    def make(folder):
        command = [RIGD, "run", "chirp", "--profile", HW_PROFILES / "sim.toml", "--fast"]
        command += ["--duration", "20", "--rest", "0.5", "--ring-down", "1", "--seed", "3"]
        command += ["--repeat", "2", "--output", folder]
        warm_start.run(command, check=True, capture_output=True, timeout=300)

    return sorted(made_once("short_chirps", make).glob("*.mcap"))


@pytest.fixture
def analysed(tmp_path):
    """Write the document of an analysis that found the profile's beam, or something else."""

    from rigd.profile import load_profile

    def write(**other):
        rig = load_profile("sim").rig
        beam, damping = rig.beam, rig.damping
        values = {
            "zeta": damping.zeta,
            "alpha": damping.alpha,
            "gamma": damping.gamma,
            "lambda": damping.lambda_,
            "density_over_stiffness": beam.density_over_stiffness,
            "bending_stiffness_n_m2": beam.bending_stiffness_n_m2,
        }
        parameters = {name: {"value": value, "std": 2e-4 * value} for name, value in values.items()}
        parameters |= other
        parameters = {name: entry for name, entry in parameters.items() if entry is not None}
        path = tmp_path / "model.json"
        path.write_text(json.dumps({"headlines": [{"parameters": parameters}]}))
        return path

    return write


@pytest.fixture
def make_samples():
    """Make samples (n,) at 1 kHz from a tick on, at rest but for the fields given."""
    import numpy as np

    from rigd.session.layout import SAMPLE_DTYPE

    def make(n: int, first_tick: int = 0, **fields) -> np.ndarray:
        samples = np.zeros(n, SAMPLE_DTYPE)
        samples["tick"] = np.arange(first_tick, first_tick + n)
        samples["t_ns"] = samples["tick"].astype(np.int64) * 1_000_000
        for name, values in fields.items():
            samples[name] = values
        return samples

    return make
