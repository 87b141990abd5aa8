"""The daemon's log never delays the daemon."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.process

FLOOD = """
import logging
from rigd.daemon._log import LOGGER_NAME, DaemonLog

with DaemonLog():
    for number in range(3000):  # more than the log and a pipe take
        logging.getLogger(LOGGER_NAME).info("line %d %s", number, "x" * 100)
print("through")
"""
A_FEW = """
import logging
from rigd.daemon import _log as log
from rigd.daemon._log import LOGGER_NAME, DaemonLog

log._FLUSH_TIMEOUT_S = 60.0  # the machine may stand still for longer than a daemon would wait
with DaemonLog():
    for number in range(5):
        logging.getLogger(LOGGER_NAME).warning("line %d", number)
"""


def start(program):
    return subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_no_wait_for_an_unread_terminal():
    process = start(FLOOD)
    assert process.stdout.read() == "through\n"  # although the log is not read
    assert process.wait(300.0) == 0
    process.communicate()


def test_every_line_is_written_at_the_end():
    process = start(A_FEW)
    _, stderr = process.communicate(timeout=300.0)
    lines = stderr.splitlines()
    assert [line.rsplit("WARNING ")[1] for line in lines] == [f"line {n}" for n in range(5)]
