"""A clamp that slips while the motor sweeps: its score, its instant and its size."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from analysis.identify._modal_fit import fit_modes
from analysis.identify._step_in_time import best_stiffness_step
from rigd.beam import clamped_free_eigenvalues

pytestmark = pytest.mark.fit

PERIOD_S = 1e-3
AT_S, CHANGE = 11.0, -0.004


def responding(force, omega, ratio):
    """Mode of unit inertia under a force, from rest."""
    decay, turn = np.exp(-ratio * omega * PERIOD_S), omega * np.sqrt(1 - ratio**2)
    angle = turn * PERIOD_S
    numerator = [0.0, PERIOD_S * decay * np.sin(angle) / turn]
    return lfilter(numerator, [1, -2 * decay * np.cos(angle), decay**2], force)


def slipped_torque(angle_rad, beam, damping):
    """Torque that modes of another stiffness add from an instant on, for steps of any size."""
    assert damping.alpha == damping.lambda_ == 1
    later = np.arange(angle_rad.size) * PERIOD_S >= AT_S
    push = -np.gradient(np.gradient(angle_rad, PERIOD_S), PERIOD_S)
    total = np.zeros(angle_rad.size)
    for z in clamped_free_eigenvalues(3):
        k = (z / beam.length_m) ** 4
        omega = np.sqrt(k / beam.density_over_stiffness)
        ratio = (damping.gamma + damping.zeta * k) / (2 * beam.density_over_stiffness * omega)
        inertia = 4 * beam.density_kg_per_m * beam.length_m**3 / z**4
        force = -CHANGE * omega**2 * later * responding(push, omega, ratio)
        other = omega * np.sqrt(1 + CHANGE)
        more = responding(force, other, ratio * omega / other)
        total += inertia * np.gradient(np.gradient(more, PERIOD_S), PERIOD_S)
    return total


@pytest.fixture
def score_of(candidates_of):
    """Score a step of the stiffness in a session."""
    return lambda session: _score(candidates_of(session.measured(noise_nm=5e-3, seed=4)))


def _score(field):
    starts = [(m.number, m.frequency_hz, m.damping_ratio) for m in field.likeliest_fit.modes]
    fit = fit_modes(field.comparison, field.noise, starts, field.effect_spectra)
    assert fit.visible_mode_numbers == (1, 2, 3)
    return best_stiffness_step(field.comparison, fit)


def test_step_of_the_stiffness_is_found(score_of, sessions, plants, link):
    still = sessions("III")
    more = slipped_torque(still.angle_rad, link, plants["III"])
    step = score_of(replace(still, torque_nm=still.torque_nm + more))
    assert step.is_significant
    assert step.instant_s == pytest.approx(AT_S, abs=2)
    assert step.relative_change == pytest.approx(CHANGE, rel=0.5)


def test_no_step_is_reported_without_a_change(score_of, sessions):
    step = score_of(sessions("III"))
    assert not step.is_significant
    assert step.score < 13
