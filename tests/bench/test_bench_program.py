"""The order of the measurements, the search for the highest rate, and their report."""

import json
from dataclasses import replace
from itertools import pairwise

import pytest

from rigd.bench import Bench, as_json, cores_without_loop, report_lines
from rigd.engine.realtime import REFUSED_PREFIX
from rigd.profile import load_profile


def test_loop_and_cyclictest_alternate(bench, computer):
    results = bench()
    steps = [step for step, _ in bench.progress[:6]]
    assert steps == ["loop alone", "cyclictest"] * 3
    assert [name for name, *_ in computer.ran[:3]] == ["loop alone"] * 3
    assert len(results.rounds) == 3
    assert results.latency_ratios() == (3.0, 3.0)
    assert results.pooled_loop_measurement.scheduled_ticks == 3000


def test_order_of_the_sessions(bench):
    results = bench()
    names = [one.name for one in results.session_measurements]
    assert names == ["with recorder", "with recorder and live view", "… and load on other cores"]


@pytest.mark.parametrize("holds_hz", [1000.0, 4000.0])
def test_search_for_the_highest_rate_goes_upwards(bench, computer, holds_hz):
    computer.holds_hz = holds_hz
    results = bench()
    assert results.highest_rate_hz == holds_hz
    assert [one.rate_hz for one in results.search_measurements][-1] == 2 * holds_hz
    assert f"held {holds_hz:g} Hz" in "\n".join(report_lines(results))


def test_lower_rates_are_tried_if_the_first_fails(bench, computer):
    computer.holds_hz = 300.0
    results = bench()
    assert [one.rate_hz for one in results.search_measurements] == [1000.0, 500.0, 250.0]
    assert results.highest_rate_hz == 250.0


def test_failed_rate_is_tried_again(bench, computer):
    computer.unlucky = 4  # the rounds, and one session of the three
    assert bench().highest_rate_hz == 4000.0


def test_search_continues_after_stalls_and_reports_them(bench, computer, measured, monkeypatch):
    def stalling(name, profile, seconds, poll, *, with_live_view=False):
        rate_hz = profile.rig.rate_hz
        found = measured(name, rate_hz=rate_hz, held=1.0 if rate_hz <= 2000.0 else 0.9)
        found.latencies_us[0] = 30_010.0
        passed = int(0.03 * rate_hz)
        return replace(
            found,
            missed_ticks=found.missed_ticks + passed,
            scheduled_ticks=found.scheduled_ticks + passed,
        )

    monkeypatch.setattr("rigd.bench._program.loops.run_session", stalling)
    results = bench()
    assert results.highest_rate_hz is None
    assert results.highest_rate_between_stalls_hz == 2000.0
    assert "would have held 2000 Hz" in "\n".join(report_lines(results))


def test_search_ends_if_no_rate_holds(bench, computer):
    computer.holds_hz = 0.0
    results = bench()
    assert results.highest_rate_hz is None
    assert results.search_measurements[-1].rate_hz >= 100.0
    assert "held none" in "\n".join(report_lines(results))


def test_search_ends_if_every_rate_holds(bench, computer):
    computer.holds_hz = 1e9
    assert bench().highest_rate_hz == 16_000.0


def test_the_time_left_only_shrinks(bench, monkeypatch):
    monkeypatch.setattr("rigd.bench._program.time.monotonic", lambda: 5.0)
    bench()
    left = [left_s for _, left_s in bench.progress]
    assert all(later <= earlier for earlier, later in pairwise(left))
    assert left[0] > 100.0


@pytest.mark.parametrize("installed", [True, False])
def test_measurement_without_cyclictest(bench, cyclictest, monkeypatch, installed):
    cyclictest.errors.write_text("it is gone\n")
    if not installed:
        monkeypatch.setenv("PATH", "/nowhere")
    results = bench()
    assert results.cyclictest_measurement is None
    assert results.latency_ratios() is None
    text = "\n".join(report_lines(results))
    assert ("it is gone" if installed else "rt-tests") in text
    assert as_json(results)["ratio_to_cyclictest"] is None


def test_cyclictest_runs_with_the_rights_of_the_loop(bench, computer, cyclictest):
    computer.granted["scheduling"] = f"{REFUSED_PREFIX}not permitted"
    results = bench()
    calls = cyclictest.calls.read_text().splitlines()
    assert len(calls) == 3
    assert all({"--priority=0", "--interval=1000"} <= set(line.split()) for line in calls)
    assert "Not granted: scheduling" in "\n".join(report_lines(results))


def test_misses_of_the_computer_itself_are_reported(bench, computer, cyclictest):
    cyclictest.output.write_text("002500 000010\n000010 000990\n")
    computer.holds_hz = 500.0
    results = bench()
    assert "this is due to the computer itself" in "\n".join(report_lines(results))


def test_document_is_plain_json(bench):
    document = json.loads(json.dumps(as_json(bench())))
    assert document["highest_rate_hz"] == 4000.0
    assert document["ratio_to_cyclictest"] == {"p50": 3.0, "p99": 3.0}
    assert document["sessions"][0]["lateness_us"]["p99"] == 30.0
    assert document["rounds"][0]["cyclictest"]["work_us"] is None
    assert document["realtime"]["scheduling"] == "SCHED_FIFO 80"


def test_the_table_has_a_row_for_each(bench):
    text = "\n".join(report_lines(bench()))
    for name in (
        "loop alone",
        "cyclictest",
        "with recorder",
        "… and load on other cores",
        "20–50 µs",
    ):
        assert name in text


def test_cores_without_the_loop(monkeypatch):
    monkeypatch.setattr("rigd.bench._program.os.sched_getaffinity", lambda _: {0, 1, 2})
    assert cores_without_loop({"cpu": "2"}) == {0, 1}
    assert cores_without_loop({"cpu": "2, isolated"}) == {0, 1}
    monkeypatch.setattr("rigd.bench._program.os.sched_getaffinity", lambda _: {0})
    assert cores_without_loop({"cpu": f"{REFUSED_PREFIX}no"}) == {0}


@pytest.mark.parametrize("name", ["sim", "antenna_can", "antenna_serial"])
def test_no_profile_uses_its_hardware(computer, name):
    Bench(
        load_profile(name),
        rate_hz=2000.0,
        measurement_duration_s=10.0,
        spin_us=50.0,
        on_progress=lambda *_: None,
    ).run()
    assert computer.profiles[0].rig.rate_hz == 2000.0
    for profile in computer.profiles:
        rig = profile.rig
        assert (rig.devices.drive, rig.devices.sensor) == ("sim", "sim")
        assert rig.simulation is not None
        assert [rig.can, rig.cia402, rig.ati_can, rig.ati_serial] == [None] * 4
