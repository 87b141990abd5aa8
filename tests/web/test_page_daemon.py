"""The operator's page on the real daemon with the simulated rig, as a new operator uses it."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import expect
from processes import child_running, eventually

from rigd import testing
from rigd.daemon import page_address
from tests.conftest import BRIEF, PATIENT

RIGD = Path(sys.executable).parent / "rigd"
TELL_S = 1.0
END_MS = 60_000
"""For what the rig or the analysis does; the tests fail earlier at what the page is to do."""


@dataclass
class Served:
    """A daemon with its page."""

    process: subprocess.Popen
    address: str
    folder: Path


@contextlib.contextmanager
def served(folder, name, *options):
    profile = testing.write_profile(folder, BRIEF_AND_PATIENT | {"name": name}, base="sim")
    command = [RIGD, "serve", "--profile", profile, "--output", folder / "out", "--web", *options]
    with (folder / "serve.txt").open("w") as said:
        process = subprocess.Popen(command, stdout=said, stderr=said, start_new_session=True)
    try:
        address = eventually(lambda: page_address(name), within_s=60.0)
        assert address, (folder / "serve.txt").read_text()
        yield Served(process, address, folder / "out")
    finally:
        process.send_signal(signal.SIGCONT)
        process.terminate()
        try:
            process.wait(20.0)
        finally:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def fast(tmp_path_factory):
    with served(tmp_path_factory.mktemp("fast"), "page-fast", "--fast") as daemon:
        yield daemon


@pytest.fixture
def in_real_time(tmp_path):
    with served(tmp_path, f"page-{os.getpid()}") as daemon:
        yield daemon
