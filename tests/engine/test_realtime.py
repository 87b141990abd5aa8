"""Real-time settings: tried one by one, and reported as granted or refused."""

import functools
import json
import os
import resource
import struct
import subprocess
import sys
from dataclasses import replace

import pytest
from cases import further

from rigd.engine.realtime import (
    MAX_WAKE_UP_US,
    SUPERVISION_NICENESS,
    isolated_cores,
    lock_memory,
    page_faults,
    parse_core_list,
)
from rigd.profile import load_profile

pytestmark = pytest.mark.process

CODE = """
import json, os, resource, sys
from pathlib import Path
from rigd.engine.realtime import apply_realtime
{before}
obtained = apply_realtime(priority={priority}, cpu={cpu}, root_folder=Path({root!r}))
print(json.dumps([obtained, sorted(os.sched_getaffinity(0)), os.sched_getscheduler(0)]))
"""
NO_RIGHTS = """
resource.setrlimit(resource.RLIMIT_MEMLOCK, (4096, 4096))
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
if os.geteuid() == 0:
    os.setuid(65534)
"""


def obtained_by_a_process(*, priority=0, cpu=-1, root="/", before=""):
    code = CODE.format(priority=priority, cpu=cpu, root=str(root), before=before)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    return json.loads(done.stdout)


@pytest.fixture
def machine(tmp_path):
    """A file system with the properties of a computer that the test sets."""

    def write(path, text):
        file = tmp_path / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        return tmp_path

    return write


def test_the_report_is_what_was_obtained():
    report, affinity, policy = obtained_by_a_process(priority=10)
    assert report["garbage_collector"] == "off"
    if not isolated_cores():
        assert affinity == [max(os.sched_getaffinity(0))]
    assert report["cpu"].split(",")[0] == str(affinity[0])
    if policy == os.SCHED_FIFO:
        assert report["scheduling"] == "SCHED_FIFO 10"
    else:
        assert report["scheduling"].startswith("refused: ")


def test_a_missing_core_is_refused_and_the_rest_is_tried():
    report, affinity, _ = obtained_by_a_process(cpu=4000)
    assert report["cpu"].startswith("refused: ")
    assert set(affinity) == os.sched_getaffinity(0)
    assert "scheduling" not in report
    assert "memory" in report


def test_refusals_are_reported_and_the_rest_is_applied():
    report, affinity, policy = obtained_by_a_process(priority=80, before=NO_RIGHTS)
    assert policy == os.SCHED_OTHER
    assert report["scheduling"].startswith("refused: ")
    assert report["memory"].startswith("refused: ")
    assert (report["garbage_collector"], report["timer_slack"]) == ("off", "1 ns")
    assert len(affinity) == 1


class Libc:
    """Grants everything and records the flags requested."""

    flags = 0

    def mlockall(self, flags):
        self.flags = flags
        return 0


@pytest.mark.parametrize(
    ("limit", "flags", "report"),
    [(resource.RLIM_INFINITY, 3, "locked"), (200_000_000, 1, "limit of 200 MB")],
)
def test_memory_under_a_limit_is_not_locked_for_the_future(monkeypatch, limit, flags, report):
    # Otherwise an allocation beyond the limit would fail in mid-session.
    monkeypatch.setattr("rigd.engine.realtime.resource.getrlimit", lambda _: (limit, limit))
    monkeypatch.setattr("rigd.engine.realtime.os.geteuid", lambda: 1000)
    libc = Libc()
    assert report in lock_memory(libc)
    assert libc.flags == flags


def test_an_isolated_core_is_preferred(machine):
    first = min(os.sched_getaffinity(0))
    root = machine("sys/devices/system/cpu/isolated", f"{first}\n")
    report, affinity, _ = obtained_by_a_process(root=root)
    assert report["cpu"] == f"{first}, isolated"
    assert affinity == [first]


def test_a_forbidden_isolated_core_is_not_used(machine):
    root = machine("sys/devices/system/cpu/isolated", "4000\n")
    report, affinity, _ = obtained_by_a_process(root=root)
    assert report["cpu"] == str(max(os.sched_getaffinity(0)))
    assert affinity == [max(os.sched_getaffinity(0))]


def test_deep_idle_states_are_prevented(machine):
    machine("sys/devices/system/cpu/cpu0/cpuidle/state0/latency", "0\n")
    root = machine("sys/devices/system/cpu/cpu0/cpuidle/state1/latency", "133\n")
    assert obtained_by_a_process(root=root)[0]["idle_states"].startswith("refused: ")
    bound = machine("dev/cpu_dma_latency", "") / "dev/cpu_dma_latency"
    assert "remaining ones within" in obtained_by_a_process(root=root)[0]["idle_states"]
    assert struct.unpack("=i", bound.read_bytes()) == (MAX_WAKE_UP_US,)


def test_shallow_idle_states_are_not_bounded(machine):
    root = machine("sys/devices/system/cpu/cpu0/cpuidle/state0/latency", "1\n")
    assert "refused" not in obtained_by_a_process(root=root)[0]["idle_states"]


@pytest.mark.parametrize(
    ("text", "cores"),
    [("\n", set()), ("3\n", {3}), ("0-2,5", {0, 1, 2, 5}), ("2-3,6-7", {2, 3, 6, 7})],
)
def test_lists_of_cores_of_the_kernel_are_read(text, cores):
    assert parse_core_list(text) == cores


def test_an_unreadable_list_isolates_nothing(machine, tmp_path):
    assert isolated_cores(tmp_path) == frozenset()
    assert isolated_cores(machine("sys/devices/system/cpu/isolated", "(null)")) == frozenset()


def test_touching_new_memory_is_counted():
    before = page_faults()
    block = bytearray(64 << 20)
    block[:: 1 << 12] = bytes(len(block) >> 12)
    assert page_faults() > before


PRECEDENCE = """
import json, os, resource, sys, threading
from pathlib import Path
from rigd.engine.processes import ChildProcess
from rigd.engine.realtime import RaisedPriority
from rigd.engine.workers import RECORDER
{before}

def state(thread=0):
    return [
        os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK,
        os.getpriority(os.PRIO_PROCESS, thread),
        sorted(os.sched_getaffinity(thread)),
    ]

def as_child():
    there, here = os.pipe()
    if os.fork() == 0:
        os.write(here, json.dumps(state()[:2]).encode())
        os._exit(0)
    return json.loads(os.read(there, 1000))

told = dict(before=state())
raised_priority = RaisedPriority({priority}, {cpu}, root_folder=Path("{root}"))
told["obtained"], told["with"] = raised_priority.request_priority(), state()
wait = threading.Event()
thread = threading.Thread(target=wait.wait, daemon=True)
thread.start()
raised_priority.raise_priority_of_new_threads()
told["thread"] = state(thread.native_id)
told["child"] = as_child()
if {with_child}:
    rig_child = ChildProcess(RECORDER, cores=raised_priority.cores_before)
    told["cores of a process of the rig"] = sorted(os.sched_getaffinity(rig_child.pid))
    rig_child.stop()
raised_priority.restore_priority()
told["after"], told["thread after"] = state(), state(thread.native_id)
wait.set()
print(json.dumps(told))
"""
NICE_ONLY = """
set_scheduler = os.sched_setscheduler

def without_realtime(thread, policy, parameters):
    if policy & os.SCHED_RR:
        raise PermissionError(1, "not permitted")
    set_scheduler(thread, policy, parameters)

os.sched_setscheduler = without_realtime
"""
ROOT = pytest.mark.skipif(os.geteuid() != 0, reason="needs rights that only root is sure to have")


@functools.cache
def precedence_of_a_process(*, priority=20, cpu=-1, before="", root="/", with_child=False):
    """Return the precedence that a process and its child report before and after."""
    code = PRECEDENCE.format(
        priority=priority, cpu=cpu, before=before, root=root, with_child=with_child
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    return json.loads(done.stdout)


def granted_realtime():
    precedence = precedence_of_a_process(with_child=True)
    if not precedence["obtained"]["scheduling"].startswith("SCHED_RR"):
        pytest.skip(f"no real-time priority here: {precedence['obtained']}")
    return precedence


def test_priority_and_cores_of_supervisor_and_recorder():
    precedence = granted_realtime()
    _, nice, all_cores = precedence["before"]
    cores = all_cores[:-1] or all_cores
    assert precedence["obtained"] == {
        "scheduling": "SCHED_RR 20",
        "cores": ",".join(map(str, cores)),
    }
    assert precedence["with"] == precedence["thread"] == [os.SCHED_RR, nice, cores]


def test_child_processes_are_ordinary_on_every_core():
    precedence = granted_realtime()
    assert precedence["child"] == [os.SCHED_OTHER, 0]
    assert precedence["cores of a process of the rig"] == precedence["before"][2]


def test_release_restores_the_precedence():
    precedence = precedence_of_a_process(with_child=True)
    assert precedence["after"] == precedence["thread after"] == precedence["before"]


def test_supervision_avoids_the_core_of_the_loop():
    granted_realtime()
    first = min(os.sched_getaffinity(0))
    others = sorted(os.sched_getaffinity(0) - {first}) or [first]
    precedence = precedence_of_a_process(cpu=first)
    assert precedence["with"][2] == others


@pytest.mark.parametrize("isolated", [further("4000"), ""])
def test_the_avoided_core_is_the_one_of_the_loop(machine, isolated):
    granted_realtime()
    first = str(min(os.sched_getaffinity(0)))
    root = machine("sys/devices/system/cpu/isolated", f"{isolated or first}\n")
    (loop,) = obtained_by_a_process(root=root)[1]
    others = sorted(os.sched_getaffinity(0) - {loop}) or [loop]
    assert precedence_of_a_process(root=root)["with"][2] == others


def test_refusal_is_reported_without_rights():
    precedence = precedence_of_a_process(before=NO_RIGHTS)
    assert precedence["obtained"]["scheduling"].startswith("refused: ")
    assert precedence["with"] == precedence["after"] == precedence["before"]


@ROOT
def test_a_nice_value_is_tried_without_realtime_priority():
    precedence = precedence_of_a_process(before=NICE_ONLY)
    assert precedence["obtained"]["scheduling"].startswith(
        f"nice {SUPERVISION_NICENESS} (SCHED_RR refused: "
    )
    assert (
        precedence["with"][:2] == precedence["thread"][:2] == [os.SCHED_OTHER, SUPERVISION_NICENESS]
    )
    assert precedence["child"] == [os.SCHED_OTHER, 0]
    assert precedence["after"] == precedence["before"]


def test_no_priority_without_request():
    precedence = precedence_of_a_process(priority=0)
    assert precedence["obtained"] == {}
    assert precedence["with"] == precedence["before"]


@pytest.mark.parametrize(("loop", "supervision"), [(80, 20), (4, 1), (3, 0), (0, 0), (99, 24)])
def test_supervision_stays_below_the_loop(loop, supervision):
    settings = replace(load_profile("sim").realtime, priority=loop)
    assert settings.supervision_priority == supervision
