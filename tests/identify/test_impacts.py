"""An impact on the beam is reported with its time, without bias; forces by the exact model."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from cases import further

from analysis.identify import fit_freest_alone, select
from analysis.identify._impacts import find_impact
from rigd.beam import PointForceGrid, modes

RATE_HZ = 1000.0
NOISE_NM = 5e-3
BAND_HZ = (0.0, 50.0)


def struck(session, plants, link, force_n, at_s, duration_s=0.02, x_m=0.6):
    """Add the response of the root torque to half a sine of force."""
    n = session.torque_nm.size
    t = np.arange(n) / RATE_HZ
    decay = np.exp(-5.0 * np.arange(n) / n)
    s = 5.0 * RATE_HZ / n + 2j * np.pi * np.fft.rfftfreq(4 * n, 1 / RATE_HZ)
    during = (t >= at_s) & (t < at_s + duration_s)
    force = np.where(during, force_n * np.sin(np.pi * (t - at_s) / duration_s), 0.0)
    torque = np.fft.rfft(force * decay, 4 * n)
    torque *= PointForceGrid(s, link, plants["III"]).torque_per_force(x_m)
    torque_nm = session.torque_nm + np.fft.irfft(torque, 4 * n)[:n] / decay
    return replace(session, torque_nm=torque_nm)


@pytest.fixture(scope="module")
def plain(sessions):
    return sessions("III")


@pytest.fixture(scope="module")
def struck_session(sessions, plants, link):
    def make(force_n, at_s, sweep_s=30, **more):
        return struck(sessions("III", sweep_s=sweep_s), plants, link, force_n, at_s, **more)

    return make


@pytest.fixture(scope="module")
def analysed(struck_session):
    @cache
    def of(force_n, at_s, duration_s, sweep_s):
        made = struck_session(force_n, at_s, sweep_s, duration_s=duration_s)
        measurement = made.measured(NOISE_NM, 1)
        return fit_freest_alone(measurement, BAND_HZ)

    return of


def largest_deviation(headline, plants, link):
    """Largest deviation of modes from the truth, in their own standard deviations."""
    true = modes(link, plants["III"], 3)
    return max(
        abs(quantity.value - value) / quantity.std
        for mode, own in zip(headline.modes, true, strict=True)
        for quantity, value in (
            (mode.frequency_hz, own.frequency_hz),
            (mode.damping_ratio, own.damping_ratio),
        )
    )


@pytest.mark.parametrize(
    ("force_n", "at_s", "duration_s", "sweep_s"),
    [
        further(0.3, 30.0, 0.02, 60),
        further(3.0, 45.0, 0.02, 60),
        (1.0, 12.3456, 0.005, 30),
        further(0.3, 40.0, 0.3, 60),
    ],
)
def test_impact_is_reported_with_its_time(
    analysed, plants, link, force_n, at_s, duration_s, sweep_s
):
    headline, (finding,), analysis = analysed(force_n, at_s, duration_s, sweep_s)
    assert finding.kind == "knock"
    low, high = finding.interval
    assert low < at_s + 0.01
    assert high > at_s - 0.01
    assert high - low < 0.04 + 2 * duration_s
    assert headline.flags.keys() <= {"lambda", "gamma", "alpha", "zeta"}
    assert all(mode.damping_ratio.flag is None for mode in headline.modes)
    assert largest_deviation(headline, plants, link) < 4
    assert len(analysis.comparison.measurement.impacts) == 1


@pytest.mark.further
def test_impact_with_missing_torque(struck_session, plants, link):
    missing = np.random.default_rng(2).choice(40_000, 250, replace=False)
    measurement = struck_session(1.0, 20.0).measured(NOISE_NM, 1, unknown_torque=missing)
    headline, found, _ = fit_freest_alone(measurement, BAND_HZ)
    assert [each.kind for each in found] == ["knock"]
    assert largest_deviation(headline, plants, link) < 4


@pytest.mark.fit
def test_full_analysis_reports_the_impact(analysed):
    """With the impact already found: it is searched for as above."""
    _, _, analysis = analysed(1.0, 12.3456, 0.005, 30)
    assert_impact_is_reported(select(analysis.comparison.measurement).verdict, 12.3)


@pytest.mark.fit
@pytest.mark.further  # as the search above
def test_full_analysis_finds_the_impact(struck_session):
    verdict = select(struck_session(1.0, 30.0, 60).cut(0, 40_000).measured(NOISE_NM, 1)).verdict
    assert_impact_is_reported(verdict, 30.0)


def assert_impact_is_reported(verdict, at_s):
    assert verdict.adequate
    assert verdict.structure == "III"
    (finding,) = verdict.findings
    assert finding.sentence.startswith(f"The beam was struck at {at_s:.1f}")
    assert finding.sentence in verdict.sentences


@pytest.mark.fit
def test_impact_on_a_ringing_mode_causes_no_bias(struck_session, plants, link):
    """Mode 1 was passed two seconds before: its first poles are those of a biased fit."""
    measured = struck_session(0.6, 5.0, sweep_s=60, x_m=0.5).measured(2e-3, 2)
    selection = select(measured)
    assert [finding.kind for finding in selection.verdict.findings] == ["knock"]
    assert selection.headline.uniform_beam.status == "passed"
    assert largest_deviation(selection.headline, plants, link) < 4


@pytest.mark.fit
def test_noise_is_no_impact(plain, freest_of):
    assert find_impact(freest_of(plain.measured(NOISE_NM, 0))) is None


@pytest.mark.fit
def test_disturbed_sensor_is_no_impact(plain):
    measurement = plain.measured(NOISE_NM, 1)
    measurement.torque_nm[15_000:15_020] += 5.0
    _, found, _ = fit_freest_alone(measurement, BAND_HZ)
    assert found
    assert "knock" not in {each.kind for each in found}
