"""The oddities of the paper's results, on short sessions of beams whose parameters are known.

`benchmarks/bench_oddities.py` shows them on sessions as long as the paper's.
"""

import numpy as np
import pytest

from analysis.models import STRUCTURES
from analysis.paper._fit import fit_many
from rigd.beam import Damping, modes, transfer
from rigd.spectral import segment_count

INTEGER = Damping(zeta=7.1e-5, alpha=1.0, gamma=5.5e-2, lambda_=0.594)
NOT_UNIFORM = (0.006, 0.005, -0.013)


def paper_route(h1, link, names):
    """Parameters by type and weighting."""
    fits = fit_many(h1.frequency_hz, h1.response, link, [STRUCTURES[name] for name in names])
    return {(fit.structure.name, fit.weighting): fit.parameters for fit in fits}


@pytest.fixture(scope="module")
def found(session, link):
    """Of a beam whose internal damping is of order 1, and whose modes are not a uniform one's."""
    h1 = session(INTEGER, offsets=NOT_UNIFORM).h1(noise_nm=1e-2, seed=1)
    return paper_route(h1, link, ["I", "III", "IV", "VI"])


@pytest.mark.parametrize("name", ["I", "IV"])
def test_internal_damping_alone_is_many_times_larger_with_omega_weights(found, name):
    assert 4 < found[name, "omega"]["zeta"] / found[name, "const"]["zeta"] < 20


def test_type_iii_hardly_depends_on_the_weights(found):
    const, omega = found["III", "const"], found["III", "omega"]
    assert omega["zeta"] / const["zeta"] == pytest.approx(1.0, abs=0.2)
    assert omega["gamma"] / const["gamma"] == pytest.approx(1.0, abs=0.3)


def test_stiffness_offsets_are_read_as_a_fractional_order(found, session, link):
    assert found["VI", "const"]["alpha"] > 1.25
    assert found["VI", "const"]["zeta"] < INTEGER.zeta / 3
    uniform = paper_route(session(INTEGER).h1(noise_nm=1e-2, seed=1), link, ["VI"])
    assert uniform["VI", "const"]["alpha"] == pytest.approx(1.0, abs=0.08)


def test_the_first_peak_saturates(session, link):
    """However little the damping, Welch's peak is no higher and no narrower than the window's."""
    hz = np.linspace(2.2, 2.9, 14_001)
    true_db, welch_db, welch_hz = [], [], []
    for share in (0.05, 0.1, 0.2):
        damping = Damping(INTEGER.zeta, 1.0, INTEGER.gamma * share, INTEGER.lambda_)
        true_db.append(20 * np.log10(np.abs(transfer(2j * np.pi * hz, link, damping)).max()))
        h1 = session(damping).h1().band(2.2, 2.9)
        size = np.abs(h1.response)
        welch_db.append(20 * np.log10(size.max()))
        welch_hz.append(np.count_nonzero(size > size.max() / np.sqrt(2)) * 500 / 40_000)
    assert true_db[0] - true_db[2] > 6
    assert welch_db[0] - welch_db[2] < 1.5
    assert true_db[0] - welch_db[0] > 12
    assert min(welch_hz) > 0.9 * max(welch_hz)


def test_the_first_mode_s_damping_is_the_window_s_but_not_if_the_fit_knows_it(session, link):
    damping = Damping(INTEGER.zeta, 1.0, INTEGER.gamma * 0.1, INTEGER.lambda_)
    true = modes(link, damping, 1)[0].damping_ratio
    made = session(damping)
    h1 = made.h1(noise_nm=1e-3, seed=1)
    for parameters in paper_route(h1, link, ["VII"]).values():
        plain = STRUCTURES["VII"].damping(parameters)
        assert modes(link, plain, 1)[0].damping_ratio > 2 * true
    aware = made.aware(h1, STRUCTURES["VII"]).modes[0]
    assert aware.damping_ratio == pytest.approx(true, abs=5 * aware.damping_ratio_std)
    assert aware.damping_ratio == pytest.approx(true, rel=0.05)


def test_one_sample_less_of_overlap_loses_the_third_peak(session, link):
    """Sweep of 30 000 samples: eight segments of 4317 overlap by 648 or end after it."""
    assert segment_count(30_000, 4317, 648) == 8
    assert segment_count(30_000, 4317, 647) == 7
    made = session(INTEGER)
    lengths = {"segment_length": 4317}
    eight, seven = (made.h1(overlap=overlap, **lengths) for overlap in (648, 647))
    for h1, lost in ((eight, False), (seven, True)):
        third = np.abs(h1.band(44.0, 46.0).response).max()
        truth = np.abs(transfer(2j * np.pi * 44.83, link, INTEGER))
        assert (20 * np.log10(third / truth) < -3) == lost
