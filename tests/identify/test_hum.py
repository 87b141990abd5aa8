"""Hum on a sharp mode: distinguished from the beam's motion by its duration, and removed.

Over 12 other seeds, with 3 mN·m on the mode and 50 mN·m 0.1 Hz from it, the largest errors were
6.6e-4 Hz (2e-3 allowed), 0.26 mN·m (0.3), 0.63 standard deviations of a parameter (1), and 0.047 of
the cost over its degrees of freedom (0.1).
"""

import numpy as np
import pytest
from cases import further

from analysis.identify import Comparison, fit_record
from analysis.identify._hum import find_hum_near_modes
from analysis.identify.noise import estimate_noise
from analysis.models import STRUCTURES
from rigd.beam import Damping, Plant, Pole

pytestmark = pytest.mark.fit

MODE_2_HZ = 16.011
NOISE_NM = 1e-2


def with_torque(session, torque_nm):
    return type(session)(session.angle_rad, session.torque_nm + torque_nm)


def humming(session, hz, amplitude_nm):
    t = np.arange(session.torque_nm.size) / 1000
    return with_torque(session, amplitude_nm * np.sin(2 * np.pi * hz * t + 0.4))


def analysed(session, structure="VI", seed=21, **options):
    return fit_record(
        session.measured(noise_nm=NOISE_NM, seed=seed, **options), [STRUCTURES[structure]]
    )


@pytest.fixture(scope="module")
def quiet(sessions):
    return analysed(sessions("VI")).fits[0]


@pytest.mark.parametrize("offset_hz", [0.0, further(0.1), further(0.4)])
@pytest.mark.parametrize("amplitude_nm", [3e-3, further(5e-2)])
def test_hum_on_a_mode_is_found_without_bias(sessions, quiet, offset_hz, amplitude_nm):
    hz = MODE_2_HZ + offset_hz
    analysis = analysed(humming(sessions("VI"), hz, amplitude_nm))
    (found,), (line,) = analysis.fits, analysis.lines
    assert line.frequency_hz == pytest.approx(hz, abs=2e-3)
    assert line.amplitude_nm == pytest.approx(amplitude_nm, abs=3e-4)
    assert analysis.is_compared.all()  # nothing of the resonance is left out
    assert found.cost / found.degrees_of_freedom == pytest.approx(1.0, abs=0.1)
    assert not found.ringing.is_significant
    for name in quiet.determined:
        assert abs(found.parameters[name] - quiet.parameters[name]) < quiet.std[name], name


def test_the_hum_s_amplitude_counts_as_unknown(sessions, quiet):
    """Standard deviations grow by the part of the resonance that the hum hides, and by no more."""
    found = analysed(humming(sessions("VI"), MODE_2_HZ, 0.01)).fits[0]
    assert found.degrees_of_freedom == quiet.degrees_of_freedom - 4
    ratio = found.std["density_over_stiffness"] / quiet.std["density_over_stiffness"]
    assert 1.0 < ratio < 1.2


def test_a_hum_where_torque_was_lost(sessions):
    session = humming(sessions("VI"), MODE_2_HZ + 0.05, 0.02)
    lost = (np.array([9000, 14_000, 25_000])[:, None] + np.arange(500)).ravel()
    (line,) = analysed(session, unknown_torque=lost).lines
    assert line.amplitude_nm == pytest.approx(0.02, abs=4e-4)


def test_a_hum_while_the_beam_rings(sessions):
    session = humming(sessions("IV", shaken=True).cut(5000), 16.03, 0.01)
    analysis = analysed(session, "IV")
    (line,), (found,) = analysis.lines, analysis.fits
    assert line.amplitude_nm == pytest.approx(0.01, abs=4e-4)
    assert found.ringing.is_significant
    assert found.cost / found.degrees_of_freedom == pytest.approx(1.0, abs=0.1)


def test_fitted_mode_beyond_the_band(sessions):
    comparison = Comparison.from_measurement(
        sessions("VI").measured(noise_nm=NOISE_NM, seed=21), (0.0, 50.0)
    )
    pole = Pole(3, complex(-2.0, 2 * np.pi * 80), np.zeros(0))
    plant, nothing = (
        Plant(comparison.measurement.beam, Damping()),
        np.zeros(comparison.sample_count),
    )
    noise = estimate_noise(
        comparison.spectrum(nothing) + 1.0, comparison.frequency_hz, nothing.size
    )
    assert find_hum_near_modes(comparison, plant, (pole,), noise, nothing) == ()


@pytest.mark.parametrize("structure", ["II", further("VI")])
@pytest.mark.parametrize("plant", ["VI", further("III"), further("IV")])
def test_residual_of_a_multisine_is_no_hum(sessions, plant, structure):
    """The beam is driven all the time: the residual of a wrong model is as steady as a hum."""
    assert analysed(sessions(plant, multisine=True), structure).lines == ()


def test_multisine_of_many_periods(sessions, plants):
    """Between its lines, which are 25 bins apart here, a record shows no response of the beam."""
    found = analysed(sessions("VI", multisine=True, sweep_s=250)).fits[0]
    assert found.cost / found.degrees_of_freedom == pytest.approx(1.0, abs=0.1)
    for name, true_value in (("alpha", plants["VI"].alpha), ("lambda", plants["VI"].lambda_)):
        assert abs(found.parameters[name] - true_value) < 4 * found.std[name], name


def test_residual_of_a_beam_that_is_not_uniform_is_no_hum(sessions):
    beam = sessions("VI", multisine=True, sweep_s=120, offsets=(0.02, -0.01))
    assert fit_record(beam.measured(noise_nm=3e-4, seed=21), [STRUCTURES["VI"]]).lines == ()


def test_a_burst_at_a_mode_is_no_hum(sessions):
    session = sessions("VI")
    t = np.arange(session.torque_nm.size) / 1000
    burst = 0.02 * np.sin(2 * np.pi * MODE_2_HZ * t) * ((t > 20) & (t < 31))
    assert analysed(with_torque(session, burst)).comparison.hum == ()


def test_slow_ring_down_is_no_hum(sessions):
    """As mode 1 of plant IV does, in 57 s, for a model that has it ring down in 2."""
    session = sessions("VI")
    t = np.arange(session.torque_nm.size) / 1000
    slow = 0.02 * np.sin(2 * np.pi * MODE_2_HZ * t) * np.exp(-t / 57)
    assert analysed(with_torque(session, slow)).comparison.hum == ()
