"""Forces that are not linear: their columns against the equation of motion solved in time."""

import numpy as np
import pytest

from analysis.identify import Comparison, Measurement
from analysis.identify._nonlinear import NonlinearForceSpectra, NonlinearTerm
from rigd.beam import Plant

pytestmark = pytest.mark.fit

MODE_1 = NonlinearTerm("cubic stiffness", 1)


@pytest.fixture(scope="module")
def forces(sessions, plants, link):
    comparison = Comparison.from_measurement(sessions("III").measured(), (0.0, 50.0))
    return comparison, NonlinearForceSpectra(comparison, Plant(link, plants["III"]))


def spectrum(comparison, torque_nm):
    return comparison.spectrum(comparison.decimation.apply(torque_nm)[comparison.retained_samples])


def deviation(one, other):
    return np.linalg.norm(one - other) / np.linalg.norm(other)


def test_a_rise_of_two_percent_is_found_by_substitution(forces, stiffening):
    comparison, modal = forces
    truth = spectrum(comparison, stiffening("III", 0.02)) / 0.02
    assert deviation(modal.torque_spectrum(MODE_1, 0.02), truth) < 0.03
    assert deviation(modal.torque_spectrum(MODE_1), truth) > 0.1


def test_a_delay_delays_the_column(forces, plants, link):
    comparison, modal = forces
    late = NonlinearForceSpectra(
        comparison, Plant(link, plants["III"], delay_s=2e-3)
    ).torque_spectrum(MODE_1)
    turn = np.exp(-2j * np.pi * comparison.frequency_hz * 2e-3)
    assert deviation(late, modal.torque_spectrum(MODE_1) * turn) < 1e-3


@pytest.mark.parametrize(
    ("kind", "multiples"),
    [("cubic stiffness", {1, 3}), ("quadratic stiffness", {2}), ("quadratic drag", {1, 3})],
)
def test_harmonics_of_a_force(link, plants, kind, multiples):
    """Driven at 2 Hz: the response after the start has rung down."""
    t = np.arange(60_000) / 1000
    rise = 1 - np.exp(-((t / 2) ** 2))
    angle = 0.05 * np.sin(4 * np.pi * t) * rise
    known = np.ones(t.size, dtype=bool)
    measurement = Measurement("m", angle, np.zeros(t.size), 1000.0, link, known, known, 0.0)
    comparison = Comparison.from_measurement(measurement, (0.0, 50.0))
    column = NonlinearForceSpectra(comparison, Plant(link, plants["III"])).torque_spectrum(
        NonlinearTerm(kind, 1)
    )
    samples = np.zeros(comparison.sample_count // 2 + 1, dtype=complex)
    samples[comparison.band_bins] = column
    last = round(40 * comparison.decimation.rate_hz)  # samples of 40 s: 80 periods
    late = np.fft.irfft(samples, comparison.sample_count)[-last:]
    power = np.abs(np.fft.rfft(late * np.hanning(late.size))) ** 2
    at = {m: power[m * 80 - 2 : m * 80 + 3].sum() for m in (1, 2, 3)}
    made = {m for m, value in at.items() if value > 1e-4 * max(at.values())}
    assert made == multiples


def test_too_large_force_has_no_column(forces):
    """Without a warning: they are errors here."""
    _, modal = forces
    column = modal.torque_spectrum(MODE_1, 1e3)
    assert column.shape == modal.torque_spectrum(MODE_1).shape
    assert np.isnan(column).all()
    assert np.isfinite(modal.torque_spectrum(MODE_1)).all()


def test_a_filter_of_the_torque_filters_the_column(forces, plants, link):
    comparison, modal = forces
    plant = Plant(link, plants["III"], filter_time_constant_s=3e-3)
    filtered = NonlinearForceSpectra(comparison, plant).torque_spectrum(MODE_1)
    divisor = 1 + 2j * np.pi * comparison.frequency_hz * 3e-3
    assert deviation(filtered, modal.torque_spectrum(MODE_1) / divisor) < 1e-3
