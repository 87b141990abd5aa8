"""Measurements made up by the tests."""

import numpy as np
import pytest

from rigd.bench.measure import Measurement


@pytest.fixture
def measured():
    def make(name="a loop", *, rate_hz=1000.0, held=1.0, late_us=(30.0,), works=True, cpu=5.0):
        lateness_us = np.resize(np.array(late_us, dtype=float), 1000)
        missed = round(lateness_us.size * (1.0 / held - 1.0))
        work_us = np.full(1000, 20.0) if works else np.empty(0)
        scheduled = lateness_us.size + missed
        return Measurement(name, rate_hz, lateness_us, work_us, scheduled, missed, cpu, 0)

    return make
