"""One structure for all sessions: different selections due to noise do not separate them."""

from dataclasses import replace

import numpy as np
import pytest

pytestmark = pytest.mark.fit

FREE = {"zeta": 7.1e-5, "alpha": 0.996, "gamma": 0.055, "lambda": 0.594}
FREQUENCY_HZ = 44.8132
STD_HZ = 3e-4
SHIFT_HZ = 26e-4
"""Mode 3 of type VII where alpha is 0.996: nine standard deviations from type VI."""


def moved_mode(mode, by_hz):
    return replace(mode, frequency_hz=mode.frequency_hz + by_hz)


@pytest.fixture
def sessions(make_estimate, make_session):
    """Forty of one beam: seven select type VI, the others type VII, whose mode 3 is elsewhere."""
    rng = np.random.default_rng(7)

    def estimate(structure, names, frequency_hz, bic):
        values = {name: FREE[name] for name in names}
        std = np.diag([(0.01 * FREE[name]) ** 2 for name in names])
        found = make_estimate(structure, values, std, names, cost=bic, bic=bic)
        (mode,) = found.fit.modes
        mode = replace(mode, frequency_hz=frequency_hz, frequency_std_hz=STD_HZ)
        return replace(found, fit=replace(found.fit, modes=(mode,)))

    def make(number):
        noise_hz = rng.normal(scale=STD_HZ)
        six = estimate("VI", list(FREE), FREQUENCY_HZ + noise_hz, 100.0)
        of_seven = [name for name in FREE if name != "alpha"]
        lower = 103.0 if number % 6 == 0 else 94.0
        seven = estimate("VII", of_seven, FREQUENCY_HZ - SHIFT_HZ + noise_hz, lower)
        return make_session(f"{number}.mcap", estimates=(six, seven))

    return [make(number) for number in range(40)]


def test_forty_sessions_with_different_noise_are_of_one_specimen(sessions, campaign_of):
    selected = {min(each.record_estimates, key=lambda one: one.bic).name for each in sessions}
    assert selected == {"VI", "VII"}
    found = campaign_of(sessions).homogeneity
    assert (found.structure, found.is_mixture) == ("VI", False)
    assert found.scatter_of("frequency_hz_1").p_value > 0.01


def test_another_beam_is_still_distinguished(sessions, campaign_of):
    moved = []
    for number, session in enumerate(sessions):
        by = 5e-4 * FREQUENCY_HZ if number >= 20 else 0.0
        estimates = tuple(
            replace(each, fit=replace(each.fit, modes=(moved_mode(each.fit.modes[0], by),)))
            for each in session.record_estimates
        )
        moved.append(replace(session, record_estimates=estimates))
    found = campaign_of(moved).homogeneity
    assert found.is_mixture
    assert sorted(map(len, found.leading_scatter.session_groups)) == [20, 20]


def test_structure_missing_from_some_sessions_is_not_compared(sessions, make_session, campaign_of):
    first, *others = sessions
    without_six = replace(first, record_estimates=first.record_estimates[1:])
    assert campaign_of([without_six, *others]).homogeneity.structure == "VII"
    assert campaign_of([make_session("a.mcap")]).homogeneity.structure is None
