"""On the simulated rig's own session, whose beam is a rational model and not this module's."""

import pytest

from analysis.models import WelchSettings
from analysis.paper._estimate import SettingsError
from analysis.record import load_record
from analysis.welch_aware import fit_record_welch_aware

TRUTH = {"zeta": 7.1e-5, "alpha": 0.996, "gamma": 5.5e-2, "lambda": 0.594}


@pytest.fixture(scope="module")
def record(paper_session):
    return load_record(paper_session[0])


def test_the_rig_s_damping_is_found(record):
    settings = WelchSettings(types=("III", "VI"), weightings=("omega",))
    three, six = fit_record_welch_aware(record, settings)
    assert (three.structure.name, six.structure.name) == ("III", "VI")
    for name, value in TRUTH.items():
        assert abs(six.parameters[name] - value) < 4 * six.std[name], name
        assert six.std[name] < 0.06 * value, name
    assert six.cost < three.cost / 2


def test_only_h1_and_hiv_are_known(record):
    with pytest.raises(SettingsError, match="'h2'; choose --frf h1 or iv"):
        fit_record_welch_aware(record, WelchSettings(estimator="h2"))


def test_hiv_of_the_rig_s_session_has_the_same_damping(record):
    settings = WelchSettings(estimator="iv", types=("VI",), weightings=("omega",))
    (six,) = fit_record_welch_aware(record, settings)
    for name, value in TRUTH.items():
        assert abs(six.parameters[name] - value) < 4 * six.std[name], name
