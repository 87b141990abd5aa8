"""The daemon's service on a rig whose processes are threads; `rigd stop` in this process."""

import os
from dataclasses import replace

import pytest
from operated_daemons import Operated, run_processes_as_threads

from rigd.daemon import _stop as stop_module
from rigd.daemon import background
from rigd.profile import load_profile
from rigd.runtime.processes import read_processes


@pytest.fixture
def profile(write_profile):
    """A rig whose sessions take little time before and after the record.

    In 0.2 s the tare's mean has a deviation of 3.5e-4 N·m: its warning is at four of a difference.
    """
    loaded = load_profile(write_profile("sim", {"session.return_s": "0.1"}))
    return replace(loaded, session=replace(loaded.session, tare_s=0.2))


@pytest.fixture
def operate(profile, tmp_path, monkeypatch, children_copied):
    """Make a service on a rig of threads, not connected yet; its jobs are copies of this process.

    The copies have no memory limit, which this process exceeds, and normal priority.
    """
    run_processes_as_threads(monkeypatch)
    monkeypatch.setattr("rigd.engine._session_sequence._SETTLING_S", 0.1)
    for job in (background.PredictionJob, background.PlanJob, background.CheckJob):
        monkeypatch.setattr(job, "worker", replace(job.worker, memory=None, niceness=0))
    made = []

    def make():
        made.append(Operated(profile, tmp_path / "out"))
        return made[-1]

    yield make
    for operated in made:
        if operated.loop.is_closed():
            continue
        if operated.state in ("running", "stopping"):
            operated.rig._group.control.kill()  # after a failed test, which left it running
        operated.close()


@pytest.fixture
def operated(operate):
    """A service whose rig is connected."""
    return operate().open()


@pytest.fixture
def stop_here(runtime_folder, rigd_here, monkeypatch):
    """Run `rigd stop` in this process; it finds only processes of this test.

    `table` replaces the process table.
    """

    def own_processes():
        rows = {process.pid: process for process in read_processes()}

        def is_own(process):
            while process is not None and process.pid != os.getpid():
                process = rows.get(process.parent)
            return process is not None

        return [process for process in rows.values() if is_own(process)]

    own_daemon_sockets = stop_module.own_daemon_sockets

    def sockets():
        return [path for path in own_daemon_sockets() if runtime_folder in path.parents]

    monkeypatch.setattr(stop_module, "own_daemon_sockets", sockets)
    monkeypatch.setattr(stop_module, "known_folders", lambda _: [runtime_folder / "rigd"])
    monkeypatch.setattr(stop_module, "GROUP_FOLDER", runtime_folder / "common")

    def run(*arguments, table=own_processes):
        monkeypatch.setattr(stop_module, "read_processes", table)
        done = rigd_here("stop", *arguments)
        return done.returncode, done.stdout, done.stderr

    return run
