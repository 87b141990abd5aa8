"""The unknowns: their derivatives, bounds and definition."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.models import STRUCTURES, DampingUnknowns
from rigd.beam import undamped_frequencies_rad_s


@pytest.mark.parametrize("name", STRUCTURES)
@given(fractions=st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4))
def test_derivatives_of_the_parameters(link, name, fractions):
    unknowns = DampingUnknowns.for_beam(STRUCTURES[name], link)
    low, high = unknowns.bounds
    x = low + np.array(fractions[: low.size]) * (high - low)
    parameters = unknowns.parameters(x)
    derivative = unknowns.derivative_of_parameters(x)
    step = 1e-6
    for column in range(x.size):
        away = step * np.eye(x.size)[column]
        above, below = unknowns.parameters(x + away), unknowns.parameters(x - away)
        for row, parameter in enumerate(STRUCTURES[name].free):
            slope = (above[parameter] - below[parameter]) / (2 * step)
            assert derivative[row, column] == pytest.approx(
                slope, rel=1e-6, abs=1e-8 * abs(parameters[parameter])
            )


def test_loss_factors_are_relative_to_stiffness_and_inertia(link):
    unknowns = DampingUnknowns.for_beam(STRUCTURES["VI"], link)
    x = np.array([np.log(0.03), 0.8, np.log(0.2), 1.3])
    damping = unknowns.damping(x)
    first, second, third = undamped_frequencies_rad_s(link, 3)
    np.testing.assert_allclose([first, second, third], [16.045, 100.55, 281.55], rtol=5e-5)
    assert damping.zeta * second**0.8 == pytest.approx(0.03)
    inertia = link.density_kg_per_m / link.bending_stiffness_n_m2 * first**2
    assert damping.gamma * first**1.3 == pytest.approx(0.2 * inertia)
    assert (damping.alpha, damping.lambda_) == (0.8, 1.3)


def test_bounds_include_all_results_of_the_paper(link, paper_dampings):
    """The range of zeta that the paper states does not."""
    first, second = undamped_frequencies_rad_s(link, 2)
    inertia = link.density_kg_per_m / link.bending_stiffness_n_m2 * first**2
    for (name, _), damping in paper_dampings.items():
        structure = STRUCTURES[name]
        point = {
            "zeta": np.log(max(damping.zeta, 1e-300) * second**damping.alpha),
            "alpha": damping.alpha,
            "gamma": np.log(max(damping.gamma, 1e-300) * first**damping.lambda_ / inertia),
            "lambda": damping.lambda_,
        }
        low, high = DampingUnknowns.for_beam(structure, link).bounds
        x = np.array([point[parameter] for parameter in structure.free])
        assert (low < x).all()
        assert (x < high).all()
        assert DampingUnknowns.for_beam(structure, link).damping(x).zeta == pytest.approx(
            damping.zeta
        )
        assert DampingUnknowns.for_beam(structure, link).damping(x).gamma == pytest.approx(
            damping.gamma
        )
