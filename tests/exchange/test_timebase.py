"""Rates and gaps from time stamps as programs write them."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.exchange import ExchangeError
from analysis.exchange._channels import timebase_from_stamps, uniform_timebase

PATH = Path("record.csv")


def found(time_s):
    return timebase_from_stamps(PATH, "t", np.asarray(time_s, dtype=float))


@given(
    rate_hz=st.floats(1.0, 1e5),
    start_s=st.floats(-1e3, 1e3),
    samples=st.integers(2, 3000),
    gap=st.integers(0, 50),
    data=st.data(),
)
def test_rate_and_ticks_are_recovered_from_times(rate_hz, start_s, samples, gap, data):
    ticks = np.arange(samples)
    if samples > 25:
        ticks[data.draw(st.integers(1, samples - 1)) :] += gap
    base = found(start_s + ticks / rate_hz)
    np.testing.assert_array_equal(base.ticks, ticks)
    # The stamps are rounded to 1e-13 s by the start; over a short record that is all there is.
    assert base.rate_hz == pytest.approx(rate_hz, rel=1e-8 + 1e-12 * rate_hz)
    assert base.missing_ticks == ticks[-1] + 1 - samples


@pytest.mark.parametrize(("rate_hz", "digits"), [(1000, 3), (1000, 4), (600, 4), (1024, 6)])
def test_times_of_few_digits_do_not_bias_the_rate(rate_hz, digits):
    ticks = np.arange(100_000)
    base = found(np.round(ticks / rate_hz, digits))
    np.testing.assert_array_equal(base.ticks, ticks)
    assert base.rate_hz == pytest.approx(rate_hz, rel=1e-8)
    assert base.jitter <= 0.5 * 10**-digits * rate_hz + 1e-4


def test_a_round_rate_is_found_exactly():
    assert found(17.3 + np.arange(136_000) * 1e-3).rate_hz == 1000.0


def test_inaccurate_clock_is_not_rounded_to_its_nominal_rate():
    assert found(np.arange(10_000) * (1e-3 * (1 + 3e-5))).rate_hz == pytest.approx(999.97, abs=1e-3)


@pytest.mark.parametrize(
    ("times", "words"),
    [
        ([0, 1e-3, np.nan, 3e-3], ("sample 3", "nan", "--rate-hz")),
        ([0, 1e-3, 1e-3, 2e-3], ("sample 2", "does not increase", "--rate-hz")),
        ([0, 2e-3, 1e-3, 3e-3], ("sample 2 (0.002 s)", "sample 3 (0.001 s)")),
        (np.round(np.arange(1000) / 700, 3), ("unevenly", "0.001", "more digits")),
        (np.round(np.arange(9000) / 999, 3), ("too few digits", "--rate-hz 999 instead")),
        (3.7 + np.floor(np.arange(20_000) / 0.9983) / 10, ("more digits", "--rate-hz 9.983 ")),
        (np.round(np.arange(3000) / 1024, 3), ("does not increase",)),
        (np.cumsum(1e-3 + 4e-4 * np.sin(np.arange(500.0) / 20)), ("not equidistant", "Resample")),
        (np.arange(100) * 1e-7, ("1e+07 Hz", "unit of the time")),
        (np.arange(100) * 60.0, ("0.0166667 Hz",)),
        ([0, 1e-3, 2e-3, *(1e-3 * np.arange(5000, 5040))], ("span 5040 periods",)),
    ],
)
def test_invalid_time_base_is_refused(times, words):
    with pytest.raises(ExchangeError) as refusal:
        found(times)
    for word in ("record.csv", *words):
        assert word in str(refusal.value)


def test_stated_rate_is_used_unchanged():
    base = uniform_timebase(PATH, 5, 512.5)
    assert (base.ticks.tolist(), base.rate_hz, base.missing_ticks) == ([0, 1, 2, 3, 4], 512.5, 0)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, np.nan, np.inf, 1e9])
def test_invalid_rate_is_refused(rate_hz):
    with pytest.raises(ExchangeError, match="outside the range of sessions"):
        uniform_timebase(PATH, 5, rate_hz)
