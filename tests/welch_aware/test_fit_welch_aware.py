"""Exact data give exact parameters where a fit to the estimate itself is far off."""

import doctest

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import analysis.welch_aware.fit
from analysis.identify import SETTINGS
from analysis.models import STRUCTURES, WeightingError
from analysis.paper._fit import fit_frf
from rigd.beam import Beam, Damping

OFF = Beam(0.98, 4.7e-3 * 1.01 * 1.02, 0.090275 * 1.02)
TRUE_OFFSETS = (0.0, -0.001, -0.0189)


def assert_close(fit, damping, relative):
    for name in fit.structure.free:
        truth = getattr(damping, "lambda_" if name == "lambda" else name)
        assert fit.parameters[name] == pytest.approx(truth, rel=relative), name


@pytest.mark.parametrize("name", ["III", "IV", "VI"])
@pytest.mark.parametrize("weighting", ["omega", "const"])
def test_exact_data_give_exact_damping(session, plants, name, weighting):
    made = session(plants[name])
    fit = made.aware(made.h1(), STRUCTURES[name], weighting, fixed=SETTINGS)
    assert_close(fit, plants[name], 2e-4)
    assert fit.at_bounds == ()
    assert fit.weighting == weighting
    assert fit.cost < 1e-6


@settings(max_examples=6)
@given(
    internal_size=st.floats(-2.7, -1.7).map(lambda power: 10**power),
    external_size=st.floats(-2.5, -1.0).map(lambda power: 10**power),
)
def test_exact_data_give_any_exact_damping(session, internal_size, external_size):
    """Sizes relative to stiffness and inertia at a mode, twice its damping ratio."""
    damping = Damping(internal_size / 100.55, 1.0, external_size * 0.052063 * 16.045, 1.0)
    made = session(damping)
    fit = made.aware(made.h1(), STRUCTURES["III"], fixed=SETTINGS)
    assert_close(fit, damping, 2e-3)


def test_a_fit_to_the_estimate_itself_is_far_off_there(session, plants, link):
    h1 = session(plants["VI"]).h1()
    plain = fit_frf(h1.frequency_hz, h1.response, link, STRUCTURES["VI"], "omega")
    assert abs(plain.parameters["gamma"] / 0.055 - 1) > 0.10
    assert abs(plain.parameters["lambda"] / 0.594 - 1) > 0.10


@pytest.mark.parametrize("name", ["III", "IV", "VI"])
def test_what_the_file_does_not_state_is_found(session, plants, name):
    made = session(plants[name], OFF, 3e-4, 1e-5)
    fit = made.aware(made.h1(), STRUCTURES[name])
    assert_close(fit, plants[name], 2e-3)
    found = fit.parameters
    assert found["density_over_stiffness"] == pytest.approx(OFF.density_over_stiffness, rel=1e-5)
    assert found["bending_stiffness_n_m2"] == pytest.approx(OFF.bending_stiffness_n_m2, rel=1e-4)
    assert found["delay_s"] == pytest.approx(3e-4, abs=1e-6)  # torque older: positive
    assert found["tool_inertia_kg_m2"] == pytest.approx(1e-5, rel=1e-2)


def test_a_beam_that_is_not_uniform_keeps_its_integer_order(session):
    damping = Damping(zeta=7.1e-5, alpha=1.0, gamma=5.5e-2, lambda_=0.594)
    made = session(damping, offsets=TRUE_OFFSETS)
    free = made.aware(made.h1(), STRUCTURES["VI"], uniform=False, fixed=SETTINGS[2:])
    assert_close(free, damping, 5e-3)
    assert free.parameters["stiffness_offset_2"] == pytest.approx(-0.001, abs=2e-5)
    assert free.parameters["stiffness_offset_3"] == pytest.approx(-0.0189, abs=2e-5)


def test_a_mirrored_phase_is_not_fitted(session, plants):
    """The sign of the phase counts: with it wrong, no damping describes the response."""
    made = session(plants["III"])
    h1 = made.h1()
    (right, wrong) = (
        made.aware(type(h1)(h1.frequency_hz, response, None, 8, "h1"), STRUCTURES["III"],
                   fixed=SETTINGS)
        for response in (h1.response, h1.response.conj())
    )  # fmt: skip
    assert right.cost < 1e-6
    assert wrong.cost > 1.0


def test_response_is_the_model_as_the_estimator_sees_it(session, plants):
    made = session(plants["VI"])
    h1 = made.h1()
    fit = made.aware(h1, STRUCTURES["VI"], fixed=SETTINGS)
    assert np.abs(fit.response - h1.response).max() < 1e-3 * np.abs(h1.response).max()
    assert [mode.number for mode in fit.modes] == [1, 2, 3]
    assert fit.modes[0].damping_ratio == pytest.approx(0.009089, rel=1e-3)


def test_standard_deviations_are_those_of_repeated_sessions(session, plants):
    """Ten sessions: their mean is known to 0.32 of a standard deviation, their scatter to 24 %."""
    made = session(plants["III"], OFF, 3e-4)
    fixed = ("tool_inertia_kg_m2",)
    fits = [made.aware(made.h1(1e-2, k), STRUCTURES["III"], fixed=fixed) for k in range(10)]
    truth = {
        "zeta": 0.54e-4,
        "gamma": 0.02,
        "density_over_stiffness": OFF.density_over_stiffness,
        "bending_stiffness_n_m2": OFF.bending_stiffness_n_m2,
        "delay_s": 3e-4,
    }
    assert fits[0].determined == tuple(truth)
    for name, value in truth.items():
        error = np.array([fit.parameters[name] for fit in fits]) - value
        std = np.mean([fit.std[name] for fit in fits])
        assert abs(error.mean()) < 1.2 * std, name
        assert 0.4 < error.std() / std < 1.8, name
        low, high = np.array([fit.interval[name] for fit in fits]).T
        assert np.count_nonzero((low <= value) & (value <= high)) >= 7, name


def test_fixed_settings_stay_and_are_certain(session, plants):
    made = session(plants["III"])
    fit = made.aware(made.h1(1e-2), STRUCTURES["III"], fixed=("delay_s",), delay_s=2e-4)
    assert fit.parameters["delay_s"] == 2e-4
    assert fit.std["delay_s"] == fit.std["alpha"] == 0.0
    assert "delay_s" not in fit.interval
    assert fit.correlation == pytest.approx(fit.correlation.T)
    assert np.diag(fit.correlation) == pytest.approx(np.ones(len(fit.determined)))


def test_what_does_not_exist_is_refused(session, plants):
    made = session(plants["III"])
    with pytest.raises(ValueError, match="mass"):
        made.aware(made.h1(), STRUCTURES["III"], fixed=("mass",))
    with pytest.raises(WeightingError, match="const, omega"):
        made.aware(made.h1(), STRUCTURES["III"], "sigma")


def test_the_docstring_s_example_runs():
    failed, tried = doctest.testmod(analysis.welch_aware.fit)
    assert (failed, tried > 10) == (0, True)
