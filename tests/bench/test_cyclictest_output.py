"""Statistics of cyclictest's output, and failures of cyclictest."""

import numpy as np
import pytest

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


def measure(bench, cyclictest, output, rate_hz=1000.0):
    """Return the measurement of the first round with this output of cyclictest."""
    cyclictest.output.write_text(output)
    return bench(rate_hz).rounds[0][1]


def test_every_wake_up_of_the_histogram_counts(bench, cyclictest):
    found = measure(bench, cyclictest, OUTPUT)
    delays_us, counts = np.unique(found.latencies_us, return_counts=True)
    assert dict(zip(delays_us, counts, strict=True)) == {
        17.0: 300,
        18.0: 200,
        950.0: 1,
        2100.0: 2,
        61234.0: 1,
    }
    assert found.execution_times_us.size == 0


def test_delays_of_whole_periods_count_as_missed_ticks(bench, cyclictest):
    found = measure(bench, cyclictest, OUTPUT)
    assert found.missed_ticks == 2 * 2 + 61
    assert found.scheduled_ticks == 504 + found.missed_ticks
    assert measure(bench, cyclictest, OUTPUT, 2000.0).missed_ticks == 1 + 2 * 4 + 122


@pytest.mark.parametrize("output", ["", "# Histogram\n", "FATAL: no\n"])
def test_output_without_a_histogram_is_an_error(bench, cyclictest, output):
    cyclictest.output.write_text(output)
    results = bench()
    assert results.cyclictest_measurement is None
    assert "no histogram" in results.missing_cyclictest_reason


def test_options_equal_those_of_the_loop(bench, cyclictest):
    found = measure(bench, cyclictest, "000005 000010\n", 2000.0)
    assert found.scheduled_ticks == 10
    options = cyclictest.calls.read_text().split()
    assert {"--affinity=0", "--priority=80", "--policy=fifo", "--interval=500"} <= set(options)
    assert "--loops=20000" in options


def test_ordinary_scheduling_without_a_priority(bench, computer, cyclictest):
    del computer.granted["scheduling"]
    bench()
    assert {"--policy=other", "--priority=0"} <= set(cyclictest.calls.read_text().split())


def test_error_of_cyclictest_is_reported(bench, cyclictest):
    cyclictest.errors.write_text("first\nFATAL: not permitted\n")
    assert bench().missing_cyclictest_reason == "FATAL: not permitted"


def test_timeout_of_cyclictest(bench, cyclictest, monkeypatch):
    cyclictest.program.write_text("#!/bin/sh\nexec sleep 60\n")
    monkeypatch.setattr(
        "rigd.bench._cyclictest._TIMEOUT_MARGIN_S", -9.9
    )  # the measurement takes 10 s
    assert "timed out" in bench().missing_cyclictest_reason
