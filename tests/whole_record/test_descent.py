"""Descents on sums of squares whose minimum is known or found by another."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from analysis.levenberg_marquardt import NormalEquations, minimise
from analysis.whole_record.descent import descend
from analysis.whole_record.steps import Steps


def free(k):
    return Steps(np.full(k, -10.0), np.full(k, 10.0), ())


class Counted:
    """Normal equations of real residuals; says how often it was asked."""

    def __init__(self, residual, jacobian):
        self.residual, self.jacobian, self.asked = residual, jacobian, 0

    def __call__(self, x):
        self.asked += 1
        r, j = self.residual(x), self.jacobian(x)
        return NormalEquations(float(r @ r), j.T @ r, j.T @ j)


T = np.linspace(0.0, 3.0, 60)


def decays(x):
    """Two exponentials where the data hold none of that kind: the residual stays large."""
    data = 1.5 * np.exp(-2.0 * T) + 0.8 * np.sin(4 * T) + 0.6
    return x[0] * np.exp(-x[1] * T) + np.exp(-x[2] * T) - data


def slopes(x):
    first, second = np.exp(-x[1] * T), np.exp(-x[2] * T)
    return np.stack([first, -x[0] * T * first, -T * second], axis=1)


def test_a_large_residual_costs_few_evaluations_more():
    start = np.array([1.0, 1.5, 0.5])
    ours, theirs = Counted(decays, slopes), Counted(decays, slopes)
    found = descend(ours, start, free(3), relative_tolerance=1e-12)
    plain = minimise(theirs, start, *np.array([[-10.0] * 3, [10.0] * 3]), relative_tolerance=1e-12)
    other = least_squares(decays, start, slopes, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert 2 * other.cost > 5
    assert found.cost == pytest.approx(2 * other.cost, rel=1e-10)
    assert found.cost <= plain.cost * (1 + 1e-11)
    assert found.evaluations == ours.asked
    assert ours.asked <= 0.6 * theirs.asked


def test_an_exact_fit_is_found_as_well():
    def residual(x):
        return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])

    def jacobian(x):
        return np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])

    found = descend(
        Counted(residual, jacobian), np.array([-1.2, 1.0]), free(2), relative_tolerance=1e-12
    )
    assert found.x == pytest.approx([1.0, 1.0], abs=1e-6)


def test_on_a_bound_the_others_make_the_best_of_it():
    matrix = np.array([[2.0, 1.9], [1.9, 2.0], [0.3, 0.1]])
    target = np.array([1.0, -2.0, 0.5])
    problem = Counted(lambda x: matrix @ x - target, lambda x: matrix)
    bounded = Steps(np.array([-10.0, -0.5]), np.array([1.2, 10.0]), ())
    found = descend(problem, np.array([0.0, 0.0]), bounded, relative_tolerance=1e-13)
    other = least_squares(
        lambda x: matrix @ x - target, [0.0, 0.0], bounds=(bounded.lower, bounded.upper), xtol=1e-14
    )
    assert found.x == pytest.approx(other.x, abs=1e-6)
    assert found.x[1] == -0.5 or found.x[0] == 1.2
    assert problem.asked < 12


def test_it_ends_where_it_is_told_to():
    problem = Counted(decays, slopes)
    start = np.array([1.0, 1.5, 0.5])
    found = descend(problem, start, free(3), relative_tolerance=1e-12, max_evaluations=4)
    assert problem.asked == found.evaluations == 4
    assert found.cost < problem(start).cost
    nothing = Counted(lambda x: np.ones(3), lambda x: np.zeros((3, 2)))
    assert descend(nothing, np.zeros(2), free(2), relative_tolerance=1e-9).evaluations == 1
