"""Fake measurements, and a benchmark with a fake loop and a fake cyclictest."""

from types import SimpleNamespace

import numpy as np
import pytest

from rigd.bench import Bench
from rigd.bench.measure import LoopMeasurement
from rigd.profile import load_profile


@pytest.fixture
def measured():
    def make(name="a loop", *, rate_hz=1000.0, held=1.0, late_us=(30.0,), works=True, cpu=5.0):
        lateness_us = np.resize(np.array(late_us, dtype=float), 1000)
        missed = round(lateness_us.size * (1.0 / held - 1.0))
        work_us = np.full(1000, 20.0) if works else np.empty(0)
        scheduled = lateness_us.size + missed
        return LoopMeasurement(name, rate_hz, lateness_us, work_us, scheduled, missed, cpu, 0)

    return make


GRANTED = {"memory": "locked", "cpu": "0", "scheduling": "SCHED_FIFO 80"}


CYCLICTEST = """#!/bin/sh
echo "$@" >> "$0.calls"
cat "$0.errors" >&2 && exit 1
cat "$0.output"
"""
"""Prints the output or fails with the errors that the test has written next to it."""


@pytest.fixture
def cyclictest(tmp_path, monkeypatch):
    """A fake cyclictest, which measures 10 µs at each of 1000 wake-ups."""
    program = tmp_path / "cyclictest"
    program.write_text(CYCLICTEST)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    paths = {name: program.with_suffix(f".{name}") for name in ("calls", "errors", "output")}
    made = SimpleNamespace(program=program, **paths)
    made.output.write_text("000010 001000\n")
    return made


@pytest.fixture
def computer(monkeypatch, measured, cyclictest):
    """A fake loop, which holds rates up to a limit and records its calls."""

    class Computer:
        holds_hz = 4000.0
        unlucky = 0

        def __init__(self):
            self.granted = dict(GRANTED)
            self.ran = []
            self.profiles = []

        def loop(self, name, profile, seconds, poll, *, with_live_view=False):
            rate_hz = profile.rig.rate_hz
            self.ran.append((name, rate_hz, with_live_view))
            self.profiles.append(profile)
            poll()
            holds = rate_hz <= self.holds_hz
            if holds and self.unlucky:
                self.unlucky -= 1
                holds = False
            return measured(name, rate_hz=rate_hz, held=1.0 if holds else 0.9)

    made = Computer()
    monkeypatch.setattr("rigd.bench._program.loops.run_without_recorder", made.loop)
    monkeypatch.setattr("rigd.bench._program.loops.run_session", made.loop)
    monkeypatch.setattr("rigd.bench._program.granted_realtime_settings", lambda _: made.granted)
    return made


@pytest.fixture
def bench(computer):
    progress = []

    def run(rate_hz=1000.0):
        program = Bench(
            load_profile("sim"),
            rate_hz=rate_hz,
            measurement_duration_s=10.0,
            spin_us=0.0,
            on_progress=lambda step, left_s: progress.append((step, left_s)),
        )
        return program.run()

    run.progress = progress
    return run
