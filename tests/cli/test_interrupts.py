"""Ctrl-C ends `rigd` with 130 wherever in Python's own doings it arrives."""

import subprocess
import sys

import pytest

DURING = {
    # What defines a dataclass or a named tuple is an `exec` of text.
    "code made from text": (
        "import rigd.cli.replay\n"
        "rigd.cli.replay.has_screen = lambda: exec(\n"
        "    'import os, signal, time; os.kill(os.getpid(), signal.SIGINT); time.sleep(10)')\n"
    ),
    # What is raised there is dropped, and objects end anywhere.
    "an object that ends": (
        "import os, signal, time, weakref\n"
        "import rigd.cli.replay\n"
        "class Ending: pass\n"
        "def ended(_): os.kill(os.getpid(), signal.SIGINT); time.sleep(0)\n"
        "def has_screen():\n"
        "    ending = Ending()\n"
        "    observed = weakref.ref(ending, ended)\n"
        "    del ending\n"
        "    time.sleep(10)\n"
        "rigd.cli.replay.has_screen = has_screen\n"
    ),
    "the clean-up after its end": (
        "import os, signal, sys\n"
        "import rigd.cli.replay\n"
        "from rigd.interruption import interrupt\n"
        "class Late:\n"
        "    def __del__(self, kill=os.kill, pid=os.getpid(), number=signal.SIGINT):\n"
        "        kill(pid, number)\n"
        "sys.late = Late()\n"
        "rigd.cli.replay.has_screen = lambda: interrupt(signal.SIGINT, None)\n"
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


@pytest.mark.parametrize("before", DURING.values(), ids=DURING.keys())
def test_ctrl_c_ends_with_130(tmp_path, before):
    (tmp_path / "stopped.py").write_text(before + "from rigd.__main__ import main\nmain()\n")
    done = subprocess.run(
        [sys.executable, "-m", "stopped", "replay", "seen.rrd"],
        cwd=tmp_path,
        check=False,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stdout) == (130, "")
    assert "Traceback" not in done.stderr
