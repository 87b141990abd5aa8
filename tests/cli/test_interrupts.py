"""Ctrl-C ends `rigd` with 130 wherever in Python's own code it arrives."""

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rigd.runner import ProcessGroup
from rigd.runtime import StopRequest

DURING = {
    # Dataclasses and named tuples are defined by an `exec` of text.
    "code made from text": (
        "import rigd.cli.live\n"
        "rigd.cli.live.has_screen = lambda: exec(\n"
        "    'import os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(10)')\n"
    ),
    # Exceptions raised there are dropped, and objects end anywhere.
    "an object that ends": (
        "import os, signal, time, weakref\n"
        "import rigd.cli.live\n"
        "class Ending: pass\n"
        "def ended(_): os.kill(os.getpid(), signal.SIGINT); time.sleep(0)\n"
        "def has_screen():\n"
        "    ending = Ending()\n"
        "    observed = weakref.ref(ending, ended)\n"
        "    del ending\n"
        "    time.sleep(10)\n"
        "rigd.cli.live.has_screen = has_screen\n"
    ),
    "the clean-up after its end": (
        "import os, signal, sys\n"
        "import rigd.cli.live\n"
        "from rigd.runtime._stop_signals import interrupt\n"
        "class Late:\n"
        "    def __del__(self, kill=os.kill, pid=os.getpid(), number=signal.SIGINT):\n"
        "        kill(pid, number)\n"
        "sys.late = Late()\n"
        "rigd.cli.live.has_screen = lambda: interrupt(signal.SIGINT, None)\n"
    ),
    "imports": (
        "import sys\n"
        "class Finder:\n"
        "    def find_spec(name, *_):\n"
        "        if name == 'rigd.cli.app':\n"
        "            import os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(10)\n"
        "sys.meta_path.insert(0, Finder)\n"
    ),
}


@pytest.fixture
def run_interrupted(tmp_path):
    """Run a command that is interrupted during an operation; return the completed process."""

    def run(before, *command, **options):
        (tmp_path / "stopped.py").write_text(before + "from rigd.__main__ import main\nmain()\n")
        return subprocess.run(
            [sys.executable, "-m", "stopped", *command],
            cwd=tmp_path,
            check=False,
            stdout=subprocess.PIPE,
            text=True,
            timeout=300,
            **options,
        )

    return run


@pytest.mark.process
@pytest.mark.parametrize("before", DURING.values(), ids=DURING.keys())
def test_ctrl_c_ends_with_130(run_interrupted, before):
    done = run_interrupted(before, "replay", "seen.rrd", stderr=subprocess.PIPE)
    assert (done.returncode, done.stdout) == (130, "")
    assert "Traceback" not in done.stderr


@pytest.mark.process
def test_stop_before_anything_began(run_interrupted):
    done = run_interrupted(DURING["imports"], "run", "hold", stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (130, "Stopped before anything began.\n")


@pytest.mark.process
def test_no_wait_for_a_reader_of_standard_error(run_interrupted):
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    try:
        while os.write(write_end, bytes(4096)):
            pass
    except BlockingIOError:
        os.set_blocking(write_end, True)
    assert run_interrupted(DURING["imports"], "run", "hold", stderr=write_end).returncode == 130
    os.close(read_end)
    assert run_interrupted(DURING["imports"], "run", "hold", stderr=write_end).returncode == 130
    os.close(write_end)


def interrupt(**_):
    raise KeyboardInterrupt


@pytest.mark.parametrize("command", [("run", "hold"), ("identify", "motor")])
def test_stop_before_the_processes_of_a_session(rigd_here, monkeypatch, command):
    monkeypatch.setattr(f"rigd.cli.{command[0]}.start_processes", interrupt)
    done = rigd_here(*command)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "Stopped before anything began.\n"


@pytest.fixture
def run_stopped_early(monkeypatch, rigd_here):
    """Run a command whose stop is requested before it connects anything."""
    request = StopRequest()
    request.requested = True
    for command in ("run", "identify"):
        monkeypatch.setattr(
            f"rigd.cli.{command}.start_processes", lambda **_: (request, contextlib.nullcontext())
        )
    return rigd_here


def test_stop_before_the_devices_are_connected(run_stopped_early, tmp_path):
    done = run_stopped_early("run", "hold", "--fast", "--json")
    assert done.returncode == 130
    assert json.loads(done.stdout) == {"sessions": []}
    *_, last = done.stderr.splitlines()
    assert last == "Stopped: no record. Stopped by the operator before the session began."
    assert not list(tmp_path.glob("sessions/*"))


def test_stop_of_identify_before_the_devices_are_connected(run_stopped_early):
    done = run_stopped_early("identify", "motor", "--fast")
    assert done.returncode == 130
    assert done.stderr.count("Stopped: no record. Stopped by the operator") == 1


class StopAfterOne(StopRequest):
    """A stop that comes as soon as the file of a session exists."""

    requested = property(
        lambda _: any(Path("sessions").glob("*.mcap")), lambda *_: None, doc="Whether it came."
    )


@pytest.mark.process
@pytest.mark.usefixtures("children_copied")
@pytest.mark.parametrize("repeat", [1, 3])
def test_stop_between_two_sessions_is_reported(rigd_here, monkeypatch, repeat):
    monkeypatch.setattr(
        "rigd.cli.run.start_processes",
        lambda **_: (StopAfterOne(), ProcessGroup(with_live_view=False)),
    )
    brief = ("--duration", "0.3", "--rest", "0", "--ring-down", "0", "--fast", "--no-look")
    done = rigd_here("run", "hold", *brief, "--repeat", str(repeat), "--json")
    assert [each["outcome"] for each in json.loads(done.stdout)["sessions"]] == ["complete"]
    if repeat == 1:
        assert "Stopped" not in done.stderr
    else:
        assert done.returncode == 130
        assert "Stopped: no record after 1 of 3 sessions." in done.stderr
