"""Quick looks as processes, by a fake program whose behaviour depends on the session's name."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from processes import children, eventually, state_of

from rigd.engine.processes import ChildProcess
from rigd.engine.workers import QUICK_LOOK
from rigd.runner import quick_looks
from rigd.runner.quick_looks import QuickLook, QuickLookQueue
from rigd.runner.session import SessionResult
from rigd.runtime.background import processor_use
from rigd.session.quick_look import quick_look_path

pytestmark = pytest.mark.process

PROGRAM = """
import json, pathlib, sys, time

session = pathlib.Path(sys.argv[1])
name = session.stem
if name == "fails":
    sys.exit("a hint\\nError: The record is too short.")
if name == "silent":
    sys.exit(3)
if name == "hangs":
    time.sleep(600)
if name == "waits":
    while not session.with_suffix(".go").exists():
        time.sleep(0.005)
text = "{" if name == "torn" else json.dumps({"version": 1, "text": [f"Look at {name}"]})
session.with_suffix(".look.json").write_text(text)
"""


@pytest.fixture
def started():
    """Return the children started since; one for the whole test worker may exist before."""
    before = set(children(os.getpid()))
    return lambda: [pid for pid in children(os.getpid()) if pid not in before]


@pytest.fixture
def queue(tmp_path, monkeypatch, started):
    (tmp_path / "look_program.py").write_text(PROGRAM)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    program = replace(QUICK_LOOK, module="look_program", niceness=0)
    monkeypatch.setattr(quick_looks, "QUICK_LOOK", program)
    results = []
    queue = QuickLookQueue(results.append)
    queue.results = results
    yield queue
    queue.close()
    assert not queue.is_busy
    assert not started()


def await_results(queue):
    def idle():
        queue.poll()
        return not queue.is_busy

    assert eventually(idle)
    return queue.results


def run_time_s(queue):
    queue.poll()
    return queue.run_time_s


def test_quick_looks_run_one_after_the_other(queue, tmp_path, started):
    paths = [tmp_path / f"{name}.mcap" for name in ("a", "b")]
    for path in paths:
        queue.add_session(path)
        assert len(started()) == 1
    first, second = await_results(queue)
    assert [first.session_path, second.session_path] == paths
    assert first.path == quick_look_path(paths[0])
    assert first.lines == ["Look at a"]
    assert first.error == ""


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("fails", "The record is too short."),
        ("silent", "its program ended with exit code 3."),
        ("torn", "torn.look.json cannot be read."),
    ],
)
def test_failed_quick_look_states_its_reason(queue, tmp_path, name, error):
    queue.add_session(tmp_path / f"{name}.mcap")
    (result,) = await_results(queue)
    assert (result.path, result.report_content) == (None, None)
    assert result.error.endswith(error)
    assert result.lines == [f"No quick look at {name}.mcap: {result.error}"]


def test_close_reports_quick_looks_that_are_not_made(queue, tmp_path):
    paths = [tmp_path / f"{name}.mcap" for name in ("waits", "b")]
    for path in paths:
        queue.add_session(path)
    queue.close("the daemon ended.")
    assert [result.session_path for result in queue.results] == paths
    assert queue.results[1].lines == ["No quick look at b.mcap: the daemon ended."]


def test_no_quick_look_runs_during_a_session(queue, tmp_path, started):
    queue.add_session(tmp_path / "waits.mcap")
    (pid,) = started()
    with queue.suspended():
        assert eventually(lambda: state_of(Path(f"/proc/{pid}")) == "T")
        (tmp_path / "waits.go").touch()
        queue.add_session(tmp_path / "next.mcap")
        time.sleep(0.1)
        queue.poll()
        assert started() == [pid]
        assert state_of(Path(f"/proc/{pid}")) == "T"
        assert queue.results == []
    assert [each.session_path.stem for each in await_results(queue)] == ["waits", "next"]


def test_hanging_quick_look_is_killed_except_for_session_time(queue, tmp_path, monkeypatch):
    monkeypatch.setattr(quick_looks, "_MAX_RUN_TIME_S", 0.2)
    queue.add_session(tmp_path / "hangs.mcap")
    with queue.suspended():
        time.sleep(0.25)
    queue.poll()
    assert queue.results == []
    (result,) = await_results(queue)
    assert result.error == "it took longer than 0.2 s."


def test_run_time_excludes_the_wait_for_a_processor(queue, tmp_path, monkeypatch):
    monkeypatch.setattr(quick_looks, "_MAX_RUN_TIME_S", 0.05)
    used_s = 0.0
    monkeypatch.setattr(quick_looks, "processor_use", lambda _: (True, used_s))
    queue.add_session(tmp_path / "waits.mcap")
    for _ in range(3):
        time.sleep(0.05)
        queue.poll()
    assert (queue.is_busy, queue.results, queue.run_time_s) == (True, [], 0.0)
    used_s = 0.06
    time.sleep(0.06)
    queue.poll()
    (result,) = await_results(queue)
    assert result.error == "it took longer than 0.05 s."


def test_processor_use_of_a_process():
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as busy:
        assert eventually(lambda: processor_use(busy.pid)[1] > 0.02)
        assert processor_use(busy.pid)[0]
        busy.kill()
    assert processor_use(busy.pid) is None
    with subprocess.Popen(["sleep", "600"]) as idle:
        assert eventually(lambda: not processor_use(idle.pid)[0])
        idle.kill()


def test_no_wait_for_a_killed_quick_look(queue, tmp_path, monkeypatch):
    monkeypatch.setattr(quick_looks, "_MAX_RUN_TIME_S", 0.05)
    # As on a busy computer, it does not end in time; the timer kills it if the test fails.
    monkeypatch.setattr(ChildProcess, "kill", lambda _: None)
    for end in (queue.poll, queue.close):
        queue.add_session(tmp_path / "hangs.mcap")
        process = queue._process
        late = threading.Timer(5.0, os.kill, (process.pid, signal.SIGKILL))
        late.start()
        assert eventually(lambda: run_time_s(queue) >= 0.05)
        end()
        assert queue.results == []
        assert process.running
        late.cancel()
        os.kill(process.pid, signal.SIGKILL)
        if end == queue.poll:
            with queue.suspended():  # no session waits either
                queue.poll()
            (result,) = await_results(queue)
            assert result.error == "it took longer than 0.05 s."
            queue.results.clear()
    assert eventually(lambda: not process.running)


def test_oldest_of_too_many_quick_looks_are_skipped(queue, tmp_path):
    names = ("waits", "a", "b", "c", "d", "e")
    for name in names:
        queue.add_session(tmp_path / f"{name}.mcap")
    assert [(each.session_path.stem, each.error) for each in queue.results] == [
        ("a", "skipped in favour of later sessions."),
        ("b", "skipped in favour of later sessions."),
    ]
    (tmp_path / "waits.go").touch()
    assert [each.session_path.stem for each in await_results(queue)] == [
        "a",
        "b",
        "waits",
        "c",
        "d",
        "e",
    ]


def test_close_ends_a_suspended_quick_look(queue, tmp_path, started):
    queue.add_session(tmp_path / "hangs.mcap")
    os.kill(started()[0], signal.SIGSTOP)
    queue.add_session(tmp_path / "a.mcap")
    queue.close()
    assert started() == []
    assert queue.results == []


def test_quick_look_in_results_and_events():
    path = Path("out/a.mcap")
    quick_look = QuickLook(path, quick_look_path(path), {"text": ["Look\x1b[2J"]}, "")
    result = SessionResult(path, "complete", "", 1, 1, 0, 0, 0, fault=False)
    other = replace(result, path=Path("out/b.mcap"))
    results = [other, result]
    quick_look.add_path_to_results(results)
    assert results == [other, replace(result, quick_look=quick_look.path)]
    assert results[1].as_dict()["look"] == "out/a.look.json"
    assert other.as_dict()["look"] is None
    event = json.loads(json.dumps({"event": "quick_look", **quick_look.as_dict()}))
    assert QuickLook.from_event(event) == quick_look
    assert quick_look.lines == ["Look?[2J"]
    none = QuickLook(path, None, None, "why.")
    assert QuickLook.from_event(none.as_dict()) == none
