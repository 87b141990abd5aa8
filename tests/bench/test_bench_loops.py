"""The loop is measured in the processes of a real session, as short as possible."""

import os
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from rigd.bench import _loops as loops
from rigd.profile import load_profile
from rigd.runner.session import SessionResult

pytestmark = pytest.mark.process

SECONDS = 0.3


@pytest.fixture
def profile():
    return loops.simulated_profile(load_profile("antenna_serial"), 500.0, 0.0)


def assert_accounted(found):
    assert found.scheduled_ticks == 150
    assert found.scheduled_ticks == found.latencies_us.size + found.missed_ticks
    assert found.execution_times_us.size == found.latencies_us.size
    assert (found.latencies_us >= 0.0).all()
    assert (found.execution_times_us > 0.0).all()


def raised_priority():
    policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK  # which cannot be reset
    return policy, os.getpriority(os.PRIO_PROCESS, 0), os.sched_getaffinity(0)


@pytest.mark.further  # as one with a file
def test_loop_alone_is_measured_without_a_file(profile):
    polls = []
    before = raised_priority()
    assert_accounted(loops.run_without_recorder("alone", profile, SECONDS, lambda: polls.append(1)))
    assert polls
    assert raised_priority() == before


def test_session_is_measured_and_its_file_removed(profile, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert_accounted(loops.run_session("session", profile, SECONDS, lambda: None))
    assert not list(tmp_path.glob("rigd-bench-*"))


def test_failure_of_a_loop_is_reported(profile, monkeypatch):
    def no_memory(**_):
        raise OSError("no shared memory")

    monkeypatch.setattr("rigd.bench._loops.ProcessGroup", no_memory)
    with pytest.raises(loops.LoopError, match="no shared memory"):
        loops.run_without_recorder("alone", profile, SECONDS, lambda: None)


def test_incomplete_session_is_no_measurement(profile, monkeypatch):
    reason = "The drive does not answer."
    result = SessionResult(None, "fault", reason, 150, 10, 0, 0, 0, fault=True)
    rig = SimpleNamespace(run=lambda *_: result)
    processes = SimpleNamespace(control=SimpleNamespace(pid=os.getpid()))
    monkeypatch.setattr(
        "rigd.bench._loops.connected_rig", lambda *_, **__: nullcontext((rig, processes))
    )
    with pytest.raises(loops.LoopError, match=reason):
        loops.run_session("session", profile, SECONDS, lambda: None)


def test_busy_program_is_ended():
    with loops.busy_program(os.sched_getaffinity(0)) as pid:
        assert Path(f"/proc/{pid}").exists()
    assert not Path(f"/proc/{pid}").exists()
