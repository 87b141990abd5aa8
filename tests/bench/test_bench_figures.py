"""Statistics and a histogram from samples and the kernel's accounting."""

import mmap
import os
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.bench import BenchResults, as_json, report_lines
from rigd.bench.measure import (
    LoopMeasurement,
    UsageMeter,
    measurement_from_samples,
    percentiles,
    pool_measurements,
    process_usage,
    wake_up_latencies_us,
)
from rigd.engine.shared_state import Phase
from rigd.session.layout import SAMPLE_DTYPE


def samples(ticks, lateness_ns, work_ns=1000):
    made = np.zeros(len(ticks), SAMPLE_DTYPE)
    made["tick"], made["lateness_ns"], made["work_ns"] = ticks, lateness_ns, work_ns
    return made


def test_latency_of_a_wake_up_includes_missed_ticks():
    late_us = wake_up_latencies_us(samples([0, 1, 5, 6], [10_000, 20_000, 300_000, 0]), 1000.0)
    np.testing.assert_allclose(late_us, [10.0, 20.0, 3300.0, 0.0])


def test_ticks_missed_at_the_start_count():
    np.testing.assert_allclose(wake_up_latencies_us(samples([2], [5000]), 2000.0), [1005.0])


def test_scheduled_ticks_are_recorded_or_missed():
    found = measurement_from_samples(
        "a", 1000.0, samples([0, 1, 5], 0), scheduled_ticks=10, cpu_percent=None, page_faults=None
    )
    assert (found.missed_ticks, found.held_fraction) == (7, pytest.approx(0.3))


def test_ticks_missed_in_a_stall_are_counted_separately():
    ticks = [0, 1, 32, 33, 35, 36]
    found = measurement_from_samples(
        "a",
        1000.0,
        samples(ticks, [0, 0, 500_000, 0, 900_000, 0]),
        scheduled_ticks=37,
        cpu_percent=None,
        page_faults=None,
    )
    assert (found.missed_ticks, found.stall_count) == (31, 1)
    assert found.held_fraction == pytest.approx(6 / 37)
    # The stall swallowed 30 ticks, the wake-up that was 1.9 ms late another one.
    assert found.held_fraction_between_stalls == pytest.approx(6 / 7)


def test_percentiles_are_numpys():
    found = percentiles(np.arange(1001.0))
    assert astuple(found) == pytest.approx((500.0, 900.0, 990.0, 999.0, 1000.0))


def test_pooled_rounds_count_every_tick(measured):
    both = pool_measurements("both", [measured(held=0.5, cpu=4.0), measured(cpu=6.0)])
    assert (both.scheduled_ticks, both.missed_ticks) == (3000, 1000)
    assert both.latencies_us.size == 2000
    assert both.cpu_percent == 5.0


def results_of(*measurements):
    """Return results with one round for each measurement, which is also its cyclictest."""
    rounds = [(one, replace(one, name="cyclictest")) for one in measurements]
    first = measurements[0]
    made = BenchResults("sim", 1000.0, 1.0, 0.0, {"cpu": "0"}, (0.5, 0.4, 0.3), rounds=rounds)
    made.session_measurements.append(first)
    made.search_measurements.append(first)
    return made


def loop_of(delays_us, name="loop"):
    delays_us = np.array(delays_us, dtype=float)
    return LoopMeasurement(name, 1000.0, delays_us, np.full(1, 20.0), delays_us.size, 0)


@settings(max_examples=25)
@given(st.lists(st.floats(0.0, 1e7), min_size=1, max_size=50))
def test_every_delay_is_in_one_bin(delays_us):
    document = as_json(results_of(loop_of(delays_us)))
    histogram = document["rounds"][0]["loop"]["histogram_us"]
    edges = [*map(float, histogram), np.inf]
    assert edges[:4] == [0.0, 1.0, 2.0, 5.0]
    for count, low, high in zip(histogram.values(), edges[:-1], edges[1:], strict=True):
        assert count == sum(low <= delay < high for delay in delays_us)


def test_histogram_shows_rare_delays_and_omits_empty_bins():
    ours, theirs = loop_of([30.0] * 9999 + [700.0]), loop_of([12.0] * 100, "cyclictest")
    results = results_of(ours)
    results.rounds = [(ours, theirs)]
    lines = list(report_lines(results))
    begins = lines.index("Wake-up latency:") + 1
    lines = lines[begins : lines.index("", begins)]
    assert "loop alone" in lines[0]
    assert "cyclictest" in lines[0]
    assert lines[1].split()[0] == "10–20"
    assert lines[-1].split()[0] == "500–1000"
    assert "█" in lines[-1]
    assert len(lines) == 1 + 6


def test_process_usage_with_special_characters_in_the_name(tmp_path):
    folder = tmp_path / "42"
    folder.mkdir()
    (folder / "stat").write_text("42 (a) b (c) S 1 2 3 4 5 6 700 8 11 10 1 2 3\n")
    (folder / "schedstat").write_text("2500000000 12 13\n")
    usage = process_usage(42, tmp_path)
    assert (usage.cpu_s, usage.page_faults) == (2.5, 711)


def test_usage_is_that_of_the_running_record():
    meter = UsageMeter(os.getpid())
    meter.sample_usage(Phase.TARING)
    assert meter.cpu_percent is None
    meter.sample_usage(Phase.RUNNING)
    assert (meter.cpu_percent, meter.page_faults) == (None, None)
    with mmap.mmap(-1, 16 << 20) as fresh:  # from the system, not from what was freed before
        fresh[:: 1 << 12] = bytes(len(fresh) >> 12)
    meter.sample_usage(Phase.RUNNING)
    faults = meter.page_faults
    assert meter.cpu_percent is not None
    assert meter.cpu_percent > 0.0
    assert faults > 0
    meter.sample_usage(Phase.RETURNING)
    assert meter.page_faults == faults


def test_no_usage_of_an_ended_process(monkeypatch):
    monkeypatch.setattr(
        "rigd.bench.measure.process_usage", lambda pid: process_usage(pid, Path("/nowhere"))
    )
    meter = UsageMeter(1)
    meter.sample_usage(Phase.RUNNING)
    assert meter.cpu_percent is None
