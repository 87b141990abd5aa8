"""Quick looks as processes, with a program in place of the real one that does as it is named."""

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
    """Give the children that came since: one that serves a whole worker may be there already."""
    before = set(children(os.getpid()))
    return lambda: [pid for pid in children(os.getpid()) if pid not in before]


@pytest.fixture
def looks(tmp_path, monkeypatch, started):
    (tmp_path / "look_program.py").write_text(PROGRAM)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    program = replace(QUICK_LOOK, module="look_program", niceness=0)
    monkeypatch.setattr(quick_looks, "QUICK_LOOK", program)
    told = []
    looks = QuickLookQueue(told.append)
    looks.told = told
    yield looks
    looks.close()
    assert not looks.busy
    assert not started()


def done(looks):
    def idle():
        looks.poll()
        return not looks.busy

    assert eventually(idle)
    return looks.told


def run_time_s(looks):
    looks.poll()
    return looks.run_time_s


def test_sessions_are_looked_at_one_after_the_other(looks, tmp_path, started):
    paths = [tmp_path / f"{name}.mcap" for name in ("a", "b")]
    for path in paths:
        looks.begin(path)
        assert len(started()) == 1
    first, second = done(looks)
    assert [first.session, second.session] == paths
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
def test_a_look_that_fails_says_why(looks, tmp_path, name, error):
    looks.begin(tmp_path / f"{name}.mcap")
    (told,) = done(looks)
    assert (told.path, told.content) == (None, None)
    assert told.error.endswith(error)
    assert told.lines == [f"No quick look at {name}.mcap: {told.error}"]


def test_none_runs_beside_a_session(looks, tmp_path, started):
    looks.begin(tmp_path / "waits.mcap")
    (pid,) = started()
    with looks.suspended():
        assert eventually(lambda: state_of(Path(f"/proc/{pid}")) == "T")
        (tmp_path / "waits.go").touch()
        looks.begin(tmp_path / "next.mcap")
        time.sleep(0.1)
        looks.poll()
        assert started() == [pid]
        assert state_of(Path(f"/proc/{pid}")) == "T"
        assert looks.told == []
    assert [each.session.stem for each in done(looks)] == ["waits", "next"]


def test_one_that_hangs_is_killed_and_not_for_the_time_of_a_session(looks, tmp_path, monkeypatch):
    monkeypatch.setattr(quick_looks, "_MAX_RUN_TIME_S", 0.2)
    looks.begin(tmp_path / "hangs.mcap")
    with looks.suspended():
        time.sleep(0.25)
    looks.poll()
    assert looks.told == []
    (told,) = done(looks)
    assert told.error == "it took longer than 0.2 s."


def test_the_wait_for_a_processor_does_not_count(looks, tmp_path, monkeypatch):
    monkeypatch.setattr(quick_looks, "_MAX_RUN_TIME_S", 0.05)
    used_s = 0.0
    monkeypatch.setattr(quick_looks, "processor_use", lambda _: (True, used_s))
    looks.begin(tmp_path / "waits.mcap")
    for _ in range(3):
        time.sleep(0.05)
        looks.poll()
    assert (looks.busy, looks.told, looks.run_time_s) == (True, [], 0.0)
    used_s = 0.06
    time.sleep(0.06)
    looks.poll()
    (told,) = done(looks)
    assert told.error == "it took longer than 0.05 s."


def test_what_a_process_does_with_the_processors():
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as busy:
        assert eventually(lambda: processor_use(busy.pid)[1] > 0.02)
        assert processor_use(busy.pid)[0]
        busy.kill()
    assert processor_use(busy.pid) is None
    with subprocess.Popen(["sleep", "600"]) as idle:
        assert eventually(lambda: not processor_use(idle.pid)[0])
        idle.kill()


def test_nobody_waits_for_the_end_of_one_that_is_killed(looks, tmp_path, monkeypatch):
    monkeypatch.setattr(quick_looks, "_MAX_RUN_TIME_S", 0.05)
    # As on a busy computer, it has no time to end in; at last it is killed, lest a failure hang.
    monkeypatch.setattr(ChildProcess, "kill", lambda _: None)
    for end in (looks.poll, looks.close):
        looks.begin(tmp_path / "hangs.mcap")
        process = looks._process
        late = threading.Timer(5.0, os.kill, (process.pid, signal.SIGKILL))
        late.start()
        assert eventually(lambda: run_time_s(looks) >= 0.05)
        end()
        assert looks.told == []
        assert process.running
        late.cancel()
        os.kill(process.pid, signal.SIGKILL)
        if end == looks.poll:
            with looks.suspended():  # nor does a session
                looks.poll()
            (told,) = done(looks)
            assert told.error == "it took longer than 0.05 s."
            looks.told.clear()
    assert eventually(lambda: not process.running)


def test_of_too_many_the_oldest_are_left_out(looks, tmp_path):
    names = ("waits", "a", "b", "c", "d", "e")
    for name in names:
        looks.begin(tmp_path / f"{name}.mcap")
    assert [(each.session.stem, each.error) for each in looks.told] == [
        ("a", "skipped in favour of later sessions."),
        ("b", "skipped in favour of later sessions."),
    ]
    (tmp_path / "waits.go").touch()
    assert [each.session.stem for each in done(looks)] == ["a", "b", "waits", "c", "d", "e"]


def test_closing_ends_one_that_is_suspended(looks, tmp_path, started):
    looks.begin(tmp_path / "hangs.mcap")
    os.kill(started()[0], signal.SIGSTOP)
    looks.begin(tmp_path / "a.mcap")
    looks.close()
    assert started() == []
    assert looks.told == []


def test_a_look_is_noted_and_told_as_an_event():
    path = Path("out/a.mcap")
    look = QuickLook(path, quick_look_path(path), {"text": ["Look\x1b[2J"]}, "")
    result = SessionResult(path, "complete", "", 1, 1, 0, 0, 0, fault=False)
    other = replace(result, path=Path("out/b.mcap"))
    results = [other, result]
    look.add_path_to_results(results)
    assert results == [other, replace(result, quick_look=look.path)]
    assert results[1].as_dict()["look"] == "out/a.look.json"
    assert other.as_dict()["look"] is None
    event = json.loads(json.dumps({"event": "quick_look", **look.as_dict()}))
    assert QuickLook.from_event(event) == look
    assert look.lines == ["Look?[2J"]
    none = QuickLook(path, None, None, "why.")
    assert QuickLook.from_event(none.as_dict()) == none
