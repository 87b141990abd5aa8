"""Which modes a record shows: by the residual of a response without their resonance."""

from types import SimpleNamespace

import numpy as np
import pytest

from analysis.identify import Comparison, fit_record
from analysis.identify._visible_modes import is_excited, visible_modes
from analysis.identify.noise import NoiseSpectrum
from analysis.identify.sentences import experiments
from analysis.models import STRUCTURES

pytestmark = pytest.mark.fit

STRONG_NM = 0.05


@pytest.fixture(scope="module")
def seen(sessions):
    """Find the visible modes of a plant of type III, with its fit, in a noise."""

    def of(noise_nm, band_hz=(0.0, 50.0), torque_of=lambda torque: torque):
        made = sessions("III")
        made = type(made)(made.angle_rad, torque_of(made.torque_nm))
        measured = made.measured(noise_nm=noise_nm, seed=51)
        analysis = fit_record(measured, [STRUCTURES["III"]], band_hz=band_hz)
        comparison = analysis.comparison
        scale = comparison.sample_count * comparison.decimation.rate_hz / 2
        noise = NoiseSpectrum(
            analysis.noise_nm2_per_hz * scale, analysis.is_compared, analysis.lines
        )
        return visible_modes(comparison, noise, analysis.fits[0])

    return of


def test_sharp_mode_is_visible_in_strong_noise(seen):
    assert {1, 2} <= set(seen(STRONG_NM))


def test_mode_below_the_noise_is_invisible(seen):
    assert 2 not in seen(2.0)


def test_all_modes_are_visible_in_usual_noise(seen):
    assert seen(0.01) == (1, 2, 3)


def test_noise_alone_is_no_mode(seen):
    assert seen(0.01, torque_of=np.zeros_like) == ()


@pytest.mark.parametrize(
    ("highest_hz", "covered"),
    [(50.0, True), (10.0, False)],
)
def test_sweep_reached_the_second_mode_or_not(sessions, highest_hz, covered):
    made = sessions("III")
    n = made.angle_rad.size
    t = np.arange(n) / 1000 - 1
    phase = 2 * np.pi * (0.05 * t + (highest_hz - 0.05) * t**2 / 60)
    angle = np.where((t >= 0) & (t < 30), 0.025 * np.sin(phase), 0.0)
    measured = type(made)(angle, made.torque_nm).measured()
    assert is_excited(Comparison.from_measurement(measured, (0.0, 50.0)), 16.0, 2.55) is covered


def test_a_step_is_no_sweep_over_the_second_mode(sessions):
    made = sessions("III")
    t = np.arange(made.angle_rad.size) / 1000
    angle = 0.02 * (1 - np.exp(-80 * np.maximum(t - 1, 0)))
    measured = type(made)(angle, made.torque_nm).measured()
    assert not is_excited(Comparison.from_measurement(measured, (0.0, 50.0)), 16.0, 2.55)


def test_louder_sweep_is_advised_if_the_mode_was_covered(sessions):
    measured = sessions("III").measured(noise_nm=1.0, seed=52)
    analysis = fit_record(measured, [STRUCTURES["III"]])
    best = SimpleNamespace(fit=analysis.fits[0])
    field = SimpleNamespace(comparison=analysis.comparison, best=best)
    unknown = SimpleNamespace(order="alpha", status="not identifiable")
    (advice,) = experiments(field, (unknown,), (1,), (), ())
    assert "increase the amplitude" in advice
    assert "a wider band does not help" in advice
    assert "sweep up to" not in advice
