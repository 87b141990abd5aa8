import numpy as np
import pytest

from analysis.identify import SETTINGS, Comparison, Objective
from analysis.identify._refit import Refit
from analysis.identify._search import Descent
from analysis.identify.noise import NoiseSpectrum
from analysis.identify.parametrization import VANISHING_LOSS_FACTOR, StepRule, Unknowns
from analysis.models import STRUCTURES
from rigd.beam import Beam, Damping, Plant

pytestmark = pytest.mark.fit

NOMINAL = Plant(Beam(0.98, 4.7e-3, 0.090275), Damping())


@pytest.fixture(scope="module")
def objective(sessions):
    measurement = sessions("VI", shaken=True).cut(5000).measured(noise_nm=1e-2)
    comparison = Comparison.from_measurement(measurement, (0.0, 50.0))
    return Objective(comparison, Unknowns.for_structure(STRUCTURES["VI"], NOMINAL, SETTINGS))


def test_gradient_is_that_of_the_cost(objective):
    weight = np.linspace(1.0, 2.0, objective.comparison.frequency_hz.size)
    x = objective.unknowns.start(np.array([-4.6, 1.1, -3.0, 0.8]))
    x[-1] = 0.01
    here = objective.normal_equations(x, weight)
    for k, step in enumerate(1e-6 * np.eye(x.size)):
        after, before = (objective.normal_equations(x + s, weight).cost for s in (step, -step))
        assert 2 * here.gradient[k] == pytest.approx((after - before) / 2e-6, rel=2e-4)


def test_continued_descent_needs_one_evaluation_less(objective, monkeypatch):
    comparison, unknowns = objective.comparison, objective.unknowns
    bins = comparison.frequency_hz.size
    noise = NoiseSpectrum(np.full(bins, 1e-2), np.ones(bins, dtype=bool), ())
    evaluated = []
    linearise = Objective._linearise
    monkeypatch.setattr(
        Objective, "_linearise", lambda self, x: evaluated.append(x) or linearise(self, x)
    )
    start = unknowns.start(np.array([-4.6, 1.1, -3.0, 0.8]))
    first = Refit.descend(comparison, unknowns, start, noise, max_evaluations=1)
    evaluated.clear()
    on = first.continue_descent(4)
    going_on = len(evaluated)
    evaluated.clear()
    restarted = Refit.descend(comparison, unknowns, first.x, noise, max_evaluations=4)
    assert (on.x == restarted.x).all()
    assert on.cost == restarted.cost < first.cost
    assert going_on == len(evaluated) - 1 == 3


def test_final_cost_is_that_of_its_noise(objective):
    bins = objective.comparison.frequency_hz.size
    noise, louder = (
        NoiseSpectrum(np.full(bins, power), np.ones(bins, dtype=bool), ()) for power in (1e-2, 4e-2)
    )
    x = objective.unknowns.start(np.array([-4.6, 1.1, -3.0, 0.8]))
    end = Descent(objective, x).descend_to_minimum(noise, 1e-2)
    restarted = Descent(end.objective, end.x)
    assert end.cost(noise) == restarted.cost(noise)
    assert end.cost(louder) == restarted.cost(louder) == pytest.approx(end.cost(noise) / 4)


@pytest.mark.parametrize(
    ("most", "hopeless", "again"), [(5, None, False), (60, (5, 0.0), False), (60, None, True)]
)
def test_torques_are_replaced_after_a_descent(sessions, monkeypatch, most, hopeless, again):
    lost = np.arange(2000, 2100, 7)
    measurement = sessions("VI", shaken=True).cut(5000).measured(noise_nm=1e-2, unknown_torque=lost)
    comparison = Comparison.from_measurement(measurement, (0.0, 50.0))
    unknowns = Unknowns.for_structure(STRUCTURES["VI"], NOMINAL, SETTINGS)
    evaluated = []
    evaluate = Objective.normal_equations
    monkeypatch.setattr(
        Objective,
        "normal_equations",
        lambda *args, **k: evaluated.append(1) or evaluate(*args, **k),
    )
    _, found = Objective(comparison, unknowns).find_minimum(
        unknowns.start(np.array([-4.6, 1.1, -3.0, 0.8])),
        np.ones(comparison.frequency_hz.size),
        StepRule.for_unknowns(unknowns, VANISHING_LOSS_FACTOR),
        relative_tolerance=1e-8,
        max_evaluations=most,
        give_up_condition=hopeless,
    )
    assert (len(evaluated) > found.evaluations) == again
    assert again or found.evaluations == 5


def test_free_decay_and_drifting_zero_do_not_count(objective):
    x = objective.unknowns.start(np.array([-4.6, 1.1, -3.0, 0.8]))
    at = objective.linearise(x)
    projected = objective.project(at, 2.0)
    ringing = np.array([0.3, -0.2, 0.1, 0.2, 0.0, 0.4, 0.05])  # of three modes, then the drift
    torques = objective.unknown_torque_spectra(at)
    with_more = type(at)(at.residual + ringing @ torques, at.jacobian, at.poles)
    again = objective.project(with_more, 2.0)
    assert again.residual == pytest.approx(projected.residual, abs=1e-6)
    assert again.amplitudes == pytest.approx(projected.amplitudes - ringing, abs=1e-8)
    columns = torques * 2
    assert np.abs((columns.conj() @ again.residual).real).max() < 1e-6 * np.abs(columns).max() ** 2


def test_recent_point_is_not_evaluated_again(objective):
    x = objective.unknowns.start(np.array([-4.6, 1.0, -3.0, 0.8]))
    assert objective.linearise(x) is objective.linearise(x.copy())
