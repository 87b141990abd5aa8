"""The descent: known minima, bounds, large residuals, and scipy's answer on the same problems."""

import numpy as np
import pytest
import scipy  # whose parts come on first use

from analysis.optimizer import ConstantBounds, NormalEquations, descend

T = np.linspace(0.0, 4.0, 200)


def equations(residual, jacobian):
    r, j = residual, jacobian
    return NormalEquations(float(np.vdot(r, r).real), (j.conj() @ r).real, (j.conj() @ j.T).real)


def decay(x):
    """A damped rotation exp(-(a + j b) t) and its derivatives."""
    model = np.exp(-(x[0] + 1j * x[1]) * T)
    return model, np.array([-T * model, -1j * T * model])


def decay_problem(measured):
    def problem(x):
        model, jacobian = decay(x)
        return equations(model - measured, jacobian)

    return problem


FREE = ConstantBounds(np.array([-50.0, -50.0]), np.array([50.0, 50.0]))


def test_finds_true_parameters():
    measured = decay([0.7, 2.0])[0]
    found = descend(decay_problem(measured), np.array([0.3, 1.5]), FREE, relative_tolerance=1e-12)
    np.testing.assert_allclose(found.x, [0.7, 2.0], rtol=1e-9)
    assert found.cost < 1e-18


@pytest.mark.parametrize("seed", [3, 44, 505, 6066])
def test_agrees_with_scipy_with_residuals_left(seed):
    rng = np.random.default_rng(seed)
    measured = decay([0.7, 2.0])[0] + 0.3 * (rng.normal(size=200) + 1j * rng.normal(size=200))
    found = descend(decay_problem(measured), np.array([0.5, 1.8]), FREE, relative_tolerance=1e-14)

    def stacked(x):
        r = decay(x)[0] - measured
        return np.concatenate((r.real, r.imag))

    peer = scipy.optimize.least_squares(stacked, [0.5, 1.8], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(found.x, peer.x, rtol=1e-5)
    assert found.cost == pytest.approx(2 * peer.cost, rel=1e-10)


def rosenbrock(x):
    return equations(
        np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]),
        np.array([[-20 * x[0], -1.0], [10.0, 0.0]]),
    )


def test_follows_a_curved_minimum():
    found = descend(rosenbrock, np.array([-1.2, 1.0]), FREE, relative_tolerance=1e-14)
    np.testing.assert_allclose(found.x, 1.0, atol=1e-8)


@pytest.mark.parametrize(("low", "high", "rest"), [(-2.0, 0.5, 0.5), (1.5, 3.0, 1.5)])
def test_rests_on_a_bound_and_moves_along_it(low, high, rest):
    found = descend(
        rosenbrock,
        np.array([1.0, -3.0]),
        ConstantBounds(np.array([low, -4.0]), np.array([high, 4.0])),
        relative_tolerance=1e-14,
    )
    np.testing.assert_allclose(found.x, [rest, rest**2], atol=1e-8)
    assert found.x[0] == rest
    # Once the bound is known to hold, the other unknown is a linear problem.
    assert found.evaluations < 12


def test_start_outside_is_brought_inside():
    box = ConstantBounds(np.array([0.0, 0.0]), np.array([3.0, 3.0]))
    found = descend(rosenbrock, np.array([9.0, -9.0]), box, relative_tolerance=1e-14)
    np.testing.assert_allclose(found.x, 1.0, atol=1e-7)


def test_unknown_without_effect_stays():
    def problem(x):
        return equations(np.array([x[0] - 3.0]), np.array([[1.0], [0.0]]))

    found = descend(problem, np.array([0.0, 1.25]), FREE, relative_tolerance=1e-12)
    np.testing.assert_allclose(found.x, [3.0, 1.25], rtol=1e-12)


def test_never_climbs_and_stops_on_request():
    costs = []

    def problem(x):
        costs.append(rosenbrock(x).cost)
        return rosenbrock(x)

    found = descend(
        problem, np.array([-1.2, 1.0]), FREE, relative_tolerance=1e-14, max_evaluations=7
    )
    assert found.evaluations == len(costs) == 7
    assert found.cost == min(costs)


misfit = decay_problem(decay([0.3, 2.0])[0] + decay([0.3, 3.0])[0])
"""One rotation cannot follow two: most of the residual stays."""


def test_large_residuals_are_descended_in_fewer_steps_than_gauss_newtons():
    measured = decay([0.3, 2.0])[0] + decay([0.3, 3.0])[0]

    def stacked(x):
        r = decay(x)[0] - measured
        return np.concatenate((r.real, r.imag))

    def slopes_of(x):
        j = decay(x)[1]
        return np.concatenate((j.real, j.imag), axis=1).T

    rough = descend(misfit, np.array([0.4, 2.3]), FREE, relative_tolerance=1e-3)
    plain = scipy.optimize.least_squares(
        stacked, rough.x, slopes_of, xtol=1e-15, ftol=1e-14, gtol=1e-15
    )
    near = descend(
        misfit, rough.x, FREE, relative_tolerance=1e-14, second_order_part=np.zeros((2, 2))
    )
    assert near.cost > 1.0
    assert near.cost <= 2 * plain.cost * (1 + 1e-13)
    np.testing.assert_allclose(near.x, plain.x, rtol=1e-6)
    assert near.evaluations <= plain.nfev / 2
    again = descend(
        misfit, rough.x, FREE, relative_tolerance=1e-14, second_order_part=near.second_order_part
    )
    np.testing.assert_allclose(again.x, near.x, rtol=1e-6)
    assert again.evaluations < near.evaluations


def test_second_order_term_matches_second_derivatives():
    near = descend(
        misfit, np.array([0.3, 2.4]), FREE, relative_tolerance=1e-16,
        second_order_part=np.zeros((2, 2)),
    )  # fmt: skip
    gradients = [
        (misfit(near.x + h).gradient - misfit(near.x - h).gradient) / 2e-5 for h in 1e-5 * np.eye(2)
    ]
    beyond = np.array(gradients) - misfit(near.x).hessian
    assert np.abs(beyond).max() > 0.05 * np.abs(misfit(near.x).hessian).max()
    np.testing.assert_allclose(near.second_order_part, beyond, atol=0.1 * np.abs(beyond).max())


def test_wrong_second_order_term_does_no_harm():
    found = descend(
        rosenbrock, np.array([1.2, 1.3]), FREE, relative_tolerance=1e-14,
        second_order_part=np.array([[-900.0, 0.0], [0.0, 300.0]]),
    )  # fmt: skip
    np.testing.assert_allclose(found.x, 1.0, atol=1e-6)


def free(k):
    return ConstantBounds(np.full(k, -10.0), np.full(k, 10.0))


class Counted:
    """Normal equations of real residuals; counts its evaluations."""

    def __init__(self, residual, jacobian):
        self.residual, self.jacobian, self.calls = residual, jacobian, 0

    def __call__(self, x):
        self.calls += 1
        r, j = self.residual(x), self.jacobian(x)
        return NormalEquations(float(r @ r), j.T @ r, j.T @ j)


TIME = np.linspace(0.0, 3.0, 60)


def decays(x):
    """Two exponentials where the data hold none of that kind: the residual stays large."""
    data = 1.5 * np.exp(-2.0 * TIME) + 0.8 * np.sin(4 * TIME) + 0.6
    return x[0] * np.exp(-x[1] * TIME) + np.exp(-x[2] * TIME) - data


def slopes(x):
    first, second = np.exp(-x[1] * TIME), np.exp(-x[2] * TIME)
    return np.stack([first, -x[0] * TIME * first, -TIME * second], axis=1)


def test_a_large_residual_costs_few_evaluations_more():
    start = np.array([1.0, 1.5, 0.5])
    ours = Counted(decays, slopes)
    found = descend(ours, start, free(3), relative_tolerance=1e-12)
    other = scipy.optimize.least_squares(decays, start, slopes, xtol=1e-15, ftol=1e-12, gtol=1e-15)
    assert 2 * other.cost > 5
    assert found.cost == pytest.approx(2 * other.cost, rel=1e-10)
    assert found.evaluations == ours.calls
    assert ours.calls <= 0.6 * other.nfev


def test_an_exact_fit_is_found_as_well():
    def residual(x):
        return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])

    def jacobian(x):
        return np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])

    found = descend(
        Counted(residual, jacobian), np.array([-1.2, 1.0]), free(2), relative_tolerance=1e-12
    )
    assert found.x == pytest.approx([1.0, 1.0], abs=1e-6)


def test_other_unknowns_are_optimal_on_a_bound():
    matrix = np.array([[2.0, 1.9], [1.9, 2.0], [0.3, 0.1]])
    target = np.array([1.0, -2.0, 0.5])
    problem = Counted(lambda x: matrix @ x - target, lambda x: matrix)
    bounded = ConstantBounds(np.array([-10.0, -0.5]), np.array([1.2, 10.0]))
    found = descend(problem, np.array([0.0, 0.0]), bounded, relative_tolerance=1e-13)
    other = scipy.optimize.least_squares(
        lambda x: matrix @ x - target, [0.0, 0.0], bounds=(bounded.lower, bounded.upper), xtol=1e-14
    )
    assert found.x == pytest.approx(other.x, abs=1e-6)
    assert found.x[1] == -0.5 or found.x[0] == 1.2
    assert problem.calls < 12


def test_only_hopeless_descents_are_stopped_early():
    start, tight = np.array([1.0, 1.5, 0.5]), 1e-12
    whole = descend(Counted(decays, slopes), start, free(3), relative_tolerance=tight)
    assert whole.evaluations > 4
    above, below = whole.cost * 0.99, whole.cost * 1.01
    given_up = descend(
        Counted(decays, slopes),
        start,
        free(3),
        relative_tolerance=tight,
        early_stop_limits=(4, above),
    )
    assert given_up.evaluations == 4
    assert given_up.cost > whole.cost
    followed = descend(
        Counted(decays, slopes),
        start,
        free(3),
        relative_tolerance=tight,
        early_stop_limits=(40, below),
    )
    assert followed.evaluations == whole.evaluations
    assert followed.x == pytest.approx(whole.x, abs=1e-12)


def test_ends_at_the_given_limit():
    problem = Counted(decays, slopes)
    start = np.array([1.0, 1.5, 0.5])
    found = descend(problem, start, free(3), relative_tolerance=1e-12, max_evaluations=4)
    assert problem.calls == found.evaluations == 4
    assert found.cost < problem(start).cost
    nothing = Counted(lambda x: np.ones(3), lambda x: np.zeros((3, 2)))
    assert descend(nothing, np.zeros(2), free(2), relative_tolerance=1e-9).evaluations == 1
