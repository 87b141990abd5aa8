"""The covariance is that of Gauss-Newton's steps under noise of the torque, of any colour."""

import numpy as np
import pytest

from analysis.identify import SETTINGS, Plant
from analysis.identify._parametrization import Unknowns
from analysis.models import STRUCTURES
from analysis.welch_aware.comparison import Measured
from analysis.welch_aware.objective import Objective
from analysis.welch_aware.uncertainty import covariance_of_unknowns, noise_power
from rigd.beam import Damping
from rigd.spectral import Segmentation

DRAWS = 300
RATE_HZ, SAMPLES, STD_NM = 125.0, 7500, 1e-2


@pytest.fixture(scope="module")
def objective(link):
    t = np.arange(SAMPLES) / RATE_HZ
    hz = np.arange(47, 3001) / 64
    measured = Measured(
        angle_rad=0.025 * np.sin(2 * np.pi * (0.05 + 49.95 * t / 120) * t),
        rate_hz=RATE_HZ,
        frequency_hz=hz,
        response=np.zeros(hz.size, dtype=complex),
        segmentation=Segmentation(1079, 162, 8000),
        window="hamming",
        estimated_from=slice(None),
    )
    unknowns = Unknowns.of(STRUCTURES["VI"], Plant(link, Damping()), SETTINGS[:2])
    return Objective(measured.comparison("omega"), unknowns)


@pytest.fixture(scope="module", params=[0.0, 0.9], ids=["white", "red"])
def noises(request):
    """Torques; the red ones of a first-order filter, with 361 times the power at low frequency."""
    white = np.random.default_rng(11).normal(scale=STD_NM, size=(DRAWS, SAMPLES + 200))
    red = white.copy()
    for k in range(1, red.shape[1]):
        red[:, k] += request.param * red[:, k - 1]
    return red[:, 200:]


def test_covariance(objective, noises):
    comparison, unknowns = objective.comparison, objective.unknowns
    x = unknowns.start(np.log([0.007, np.e, 0.02, np.exp(0.6)]))
    _, jacobian = objective.linearise(x)
    deviations = comparison.estimator.response(noises)
    nothing = np.zeros(x.size, dtype=bool)
    covariance, determined = covariance_of_unknowns(comparison, deviations[0], jacobian, nothing)
    assert determined.all()
    weighted = jacobian.conj() * comparison.weights
    hessian = (weighted @ jacobian.T).real
    steps = np.linalg.solve(hessian, (weighted @ deviations.T).real)
    ratio = steps.std(axis=1) / np.sqrt(np.diag(covariance))
    assert ratio == pytest.approx(np.ones(x.size), abs=0.3)  # the noise is known to 15 %


def test_noise_power(objective, noises):
    comparison = objective.comparison
    deviations = comparison.estimator.response(noises)
    found = np.mean([noise_power(comparison, d, 4)[1] for d in deviations], axis=0)
    hz = comparison.frequency_hz
    power = np.abs(np.fft.rfft(noises)) ** 2 / SAMPLES
    true_hz = np.fft.rfftfreq(SAMPLES, 1 / RATE_HZ)
    expected = [power[:, np.abs(true_hz - f) < 2.5].mean() for f in hz]
    middle = (hz > 4) & (hz < 44)
    assert found[middle] == pytest.approx(np.array(expected)[middle], rel=0.15)


def test_what_rests_on_a_bound_has_none(objective, noises):
    x = objective.unknowns.start(np.log([0.007, np.e, 0.02, np.exp(0.6)]))
    deviation = objective.comparison.estimator.response(noises[0])
    _, jacobian = objective.linearise(x)
    held = np.array([False, True, False, False, False, False])
    covariance, determined = covariance_of_unknowns(objective.comparison, deviation, jacobian, held)
    np.testing.assert_array_equal(determined, ~held)
    assert not covariance[1].any()
    assert not covariance[:, 1].any()
    jacobian = jacobian.copy()
    jacobian[2] = 0
    assert not covariance_of_unknowns(objective.comparison, deviation, jacobian, held)[1][2]
