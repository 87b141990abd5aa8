"""Steps preserve what a record determines: phase of stiffness and inertia with their damping."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.identify import SETTINGS
from analysis.identify.parametrization import VANISHING_LOSS_FACTOR, StepRule, Unknowns
from analysis.models import STRUCTURES
from rigd.beam import Beam, Damping, Plant

NOMINAL = Plant(Beam(0.98, 4.7e-3, 0.090275), Damping())
UNKNOWNS = Unknowns.for_structure(STRUCTURES["VI"], NOMINAL, SETTINGS)
STEPS = StepRule.for_unknowns(UNKNOWNS)
REST = [0.01, -0.02, 0.1, 0.001]

losses = st.floats(-15.0, 6.0)
orders = st.floats(0.01, 1.99)


def phases(x):
    """Phases of the stiffness with its damping, and of the inertia with its own."""
    found = []
    for loss, order, turn in ((x[0], x[1], 1), (x[2], x[3], -1)):
        angle = math.pi / 2 * order
        size = math.exp(loss) / math.sin(angle)
        factor = 1 + turn * size * complex(math.cos(angle), math.sin(angle))
        found.append(abs(math.atan2(factor.imag, factor.real)))
    return found


@given(losses, orders, losses, orders, st.lists(st.floats(-1.0, 1.0), min_size=8, max_size=8))
def test_short_step_is_straight(zeta, alpha, gamma, lambda_, direction):
    x = np.array([zeta, alpha, gamma, lambda_, *REST])
    away = [abs(phase - math.pi / 2 * o) for phase, o in zip(phases(x), x[[1, 3]], strict=True)]
    sizes = [math.exp(x[i]) / math.sin(math.pi / 2 * x[j]) for i, j in ((0, 1), (2, 3))]
    step = 1e-7 * np.array(direction) * np.array([1, 0.01, 1, 0.01, 1, 1, 1, 1e-3])
    if min(away) > 1e-3 and max(sizes) < 1e3:
        assert STEPS.end_point(x, step) == pytest.approx(x + step, abs=1e-9)


@given(
    losses,
    orders,
    losses,
    orders,
    st.lists(st.floats(-1e3, 1e3), min_size=8, max_size=8),
)
def test_no_step_leaves_the_bounds(zeta, alpha, gamma, lambda_, step):
    x = np.array([zeta, alpha, gamma, lambda_, *REST])
    least, most = STEPS.step_limits(x)
    assert (least <= 0).all()
    assert (most >= 0).all()
    end = STEPS.end_point(x, np.clip(step, least, most))
    assert ((STEPS.lower <= end) & (end <= STEPS.upper)).all()


@pytest.mark.parametrize(("i", "j", "before", "after"), [(0, 1, 0.02, 0.3), (2, 3, 1.98, 1.7)])
def test_large_order_step_preserves_the_phase(i, j, before, after):
    x = np.array([-4.5, 1.0, -4.0, 1.0, *REST])
    x[i], x[j] = -3.5, before
    size = math.exp(x[i]) / math.sin(math.pi / 2 * before)
    step = np.zeros(8)
    step[j] = after - before
    # ln tan(theta/2) stays where the loss changes by size / sin(turn) times the turn's change.
    turned = math.pi / 2 * (after - before) * (1 if i == 0 else -1)
    step[i] = -size / math.sin(math.pi / 2 * before) * turned
    end = STEPS.end_point(x, step)
    assert end[j] == pytest.approx(after)
    assert phases(end) == pytest.approx(phases(x), rel=1e-9)
    assert abs(end[i] - x[i]) > 0.5
    assert abs(x[i] + step[i] - end[i]) > 10  # a straight step would have lost it


def test_order_is_limited_by_the_largest_loss():
    x = np.array([-4.0, 1.9, -4.0, 1.95, *REST])
    step = np.zeros(8)
    step[2] = 3.0
    step[3] = 0.03
    end = STEPS.end_point(x, step)
    assert end[2] == STEPS.upper[2]
    assert STEPS.lower[3] < end[3] < x[3] + step[3]
    most = math.pi / 2 * (2 - (x[3] + step[3]))
    assert phases(end)[1] > most > phases(x)[1]  # no loss is so visible at the requested order


def test_almost_absent_damping_may_vanish_at_constant_order():
    x = np.array([-12.0, 0.5, -4.0, 1.0, *REST])
    step = np.zeros(8)
    step[0] = -1.5
    end = STEPS.end_point(x, step)
    assert end[0] == STEPS.lower[0]
    least, most = STEPS.step_limits(end)
    assert least[1] == most[1] == 0
    assert least[3] < 0 < most[3]
    large = x.copy()
    large[0] = -5.0
    assert STEPS.end_point(large, step)[0] == pytest.approx(-6.5, abs=0.01)


def test_steps_without_a_free_order_are_straight():
    steps = StepRule.for_unknowns(Unknowns.for_structure(STRUCTURES["III"], NOMINAL, SETTINGS))
    x, step = np.array([1.0, 1.0, *REST]), np.array([2.0, -3.0, 0.1, 0.1, 0.1, 0.1])
    assert steps.damping_indices == ()
    assert steps.loss_indices == (0, 1)
    assert steps.end_point(x, step) == pytest.approx(x + step)


@pytest.mark.parametrize("structure", ["VI", "III"])
def test_tiny_loss_grows_by_the_requested_step(structure):
    unknowns = Unknowns.for_structure(STRUCTURES[structure], NOMINAL, SETTINGS)
    steps = StepRule.for_unknowns(unknowns, VANISHING_LOSS_FACTOR)
    index = unknowns.names.index("zeta")
    x, step = unknowns.vector(NOMINAL), np.zeros(len(unknowns.names))
    # A loss of 1e-8 is to become 1e-5: a step of its logarithm by 999 would end at the upper bound.
    x[index], step[index] = math.log(1e-8), 999.0
    assert math.exp(steps.end_point(x, step)[index]) == pytest.approx(1e-5, rel=1e-3)
    assert StepRule.for_unknowns(unknowns).end_point(x, step)[index] == steps.upper[index]
    x[index], step[index] = math.log(1e-2), 0.5
    assert steps.end_point(x, step) == pytest.approx(
        StepRule.for_unknowns(unknowns).end_point(x, step), abs=1e-12
    )
