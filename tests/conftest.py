"""Settings that must stand before numpy is imported, and the simulated rig as a process."""

import atexit
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

# Threads gain nothing on small matrices, and fight each other where tests run in parallel.
os.environ.update(
    dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
)

# No test meets a rig that somebody simulates on this computer, nor one of another worker.
_RUNTIME = tempfile.mkdtemp(prefix="rigd-tests-")
os.environ["XDG_RUNTIME_DIR"] = _RUNTIME
atexit.register(shutil.rmtree, _RUNTIME, ignore_errors=True)

RIGD = Path(sys.executable).parent / "rigd"


@pytest.fixture
def runtime_folder(monkeypatch):
    """A folder of this test's own for the sockets of simulated rigs; their paths must be short."""
    folder = Path(tempfile.mkdtemp(prefix="rigd-test-"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def start_simulator(runtime_folder, tmp_path):
    """Start `rigd simulate` for a profile and wait until it can be found."""
    from rigd.devices.simulator import find_simulator
    from rigd.profile import load_profile

    started = []

    def start(profile, *options) -> subprocess.Popen:
        with (tmp_path / f"simulator-{len(started)}.txt").open("w") as said:
            process = subprocess.Popen(
                [RIGD, "simulate", "--profile", str(profile), *map(str, options)],
                cwd=tmp_path,
                stdout=said,
                stderr=subprocess.STDOUT,
                env=os.environ,
            )
        started.append(process)
        name = load_profile(profile).name
        deadline = time.monotonic() + 20.0
        while find_simulator(name) is None:
            assert process.poll() is None, Path(said.name).read_text()
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
