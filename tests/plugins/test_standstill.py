import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.process

TESTS = """
import ctypes

runs = {}

def fails(name, times, standstill_s):
    ctypes.PyDLL(None).usleep(int(standstill_s * 1e6))  # nothing else of this process runs
    runs[name] = runs.get(name, 0) + 1
    assert runs[name] > times

def test_disturbed(tmp_path):
    fails("disturbed", 1, 0.3)

def test_wrong_whatever_the_machine_does():
    fails("wrong", 2, 0.3)

def test_right_but_disturbed():
    fails("right", 0, 0.3)
    assert runs["right"] == 1
"""


def test_only_what_failed_during_a_standstill_is_run_once_more(tmp_path):
    file = tmp_path / "test_it.py"
    file.write_text(TESTS)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "standstill", "--rootdir", tmp_path, file],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "1 failed, 2 passed, 2 repeated" in done.stdout, done.stdout
    assert done.stdout.count("REPEATED") == 2
    assert "_ test_wrong_whatever_the_machine_does _" in done.stdout  # the heading of its report
    assert done.stdout.count("The machine stood still for 0.") == 2
