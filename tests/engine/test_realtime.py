"""Real-time settings: tried one by one, and reported as granted or refused."""

import os
import subprocess
import sys

CODE = """
import json, os
from rigd.engine.realtime import obtain
obtained = obtain(priority={priority}, cpu={cpu})
print(json.dumps([obtained, sorted(os.sched_getaffinity(0)), os.sched_getscheduler(0)]))
"""


def obtained_by_a_process(**settings):
    import json

    done = subprocess.run(
        [sys.executable, "-c", CODE.format(**settings)], capture_output=True, check=True
    )
    return json.loads(done.stdout)


def test_what_is_reported_is_what_was_obtained():
    report, affinity, policy = obtained_by_a_process(priority=10, cpu=-1)
    assert report["garbage_collector"] == "off"
    assert affinity == [max(os.sched_getaffinity(0))]
    assert report["cpu"] == str(affinity[0])
    if policy == os.SCHED_FIFO:
        assert report["scheduling"] == "SCHED_FIFO 10"
    else:
        assert report["scheduling"].startswith("refused: ")


def test_a_core_that_does_not_exist_is_refused_and_the_rest_is_tried():
    report, affinity, _ = obtained_by_a_process(priority=0, cpu=4000)
    assert report["cpu"].startswith("refused: ")
    assert set(affinity) == os.sched_getaffinity(0)
    assert "scheduling" not in report
    assert "memory" in report
