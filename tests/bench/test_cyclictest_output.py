"""What cyclictest prints, as figures; and what becomes of one that cannot be run."""

import subprocess

import numpy as np
import pytest

from rigd.bench import _cyclictest as cyclictest

OUTPUT = """\
# /dev/cpu_dma_latency set to 2us
# Histogram
000000 000000
000017 000300
000018 000200
000950 000001
002100 000002

# Min Latencies: 00017
# Avg Latencies: 00024
# Max Latencies: 61234
# Histogram Overflows: 00001
# Histogram Overflow at cycle number:
# Thread 0: 00417

# Total: 000000504
"""


def test_every_wake_up_of_the_histogram_counts():
    found = cyclictest.measured(OUTPUT, 1000.0)
    delays_us, counts = np.unique(found.lateness_us, return_counts=True)
    assert dict(zip(delays_us, counts, strict=True)) == {
        17.0: 300,
        18.0: 200,
        950.0: 1,
        2100.0: 2,
        61234.0: 1,
    }
    assert found.work_us.size == 0


def test_whole_periods_of_delay_are_ticks_that_a_loop_would_have_missed():
    found = cyclictest.measured(OUTPUT, 1000.0)
    assert found.missed == 2 * 2 + 61
    assert found.scheduled == 504 + found.missed
    assert cyclictest.measured(OUTPUT, 2000.0).missed == 1 + 2 * 4 + 122


@pytest.mark.parametrize("output", ["", "# Histogram\n", "FATAL: no\n"])
def test_output_without_a_histogram_is_an_error(output):
    with pytest.raises(cyclictest.CyclictestError, match="no histogram"):
        cyclictest.measured(output, 1000.0)


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """A program of that name that does what the test says."""

    def make(script):
        file = tmp_path / "cyclictest"
        file.write_text(f"#!/bin/sh\n{script}\n")
        file.chmod(0o755)
        monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
        return tmp_path

    return make


def test_it_runs_as_the_loop_does(stand_in):
    folder = stand_in('echo "$@" > "$(dirname "$0")/asked"; echo "000005 000010"')
    found = cyclictest.run(2000.0, 3.0, cpu=1, priority=80)
    assert found.scheduled == 10
    asked = (folder / "asked").read_text().split()
    assert {"--affinity=1", "--priority=80", "--policy=fifo", "--interval=500"} <= set(asked)
    assert "--loops=6000" in asked


def test_without_a_priority_it_is_an_ordinary_process(stand_in):
    folder = stand_in('echo "$@" > "$(dirname "$0")/asked"; echo "000005 000010"')
    cyclictest.run(1000.0, 1.0, cpu=0, priority=0)
    assert "--policy=other" in (folder / "asked").read_text().split()


def test_what_it_complains_of_is_told(stand_in):
    stand_in("echo first >&2; echo 'FATAL: not permitted' >&2; exit 1")
    with pytest.raises(cyclictest.CyclictestError, match=r"^FATAL: not permitted$"):
        cyclictest.run(1000.0, 1.0, cpu=0, priority=80)


def test_one_that_hangs_is_given_up(stand_in, monkeypatch):
    stand_in("exec sleep 60")
    monkeypatch.setattr("rigd.bench._cyclictest._MARGIN_S", -0.9)
    with pytest.raises(cyclictest.CyclictestError) as told:
        cyclictest.run(1000.0, 1.0, cpu=0, priority=80)
    assert isinstance(told.value.__cause__, subprocess.TimeoutExpired)


def test_whether_it_is_installed_is_seen(stand_in, monkeypatch):
    stand_in("exit 0")
    assert cyclictest.installed()
    monkeypatch.setenv("PATH", "/nowhere")
    assert not cyclictest.installed()
