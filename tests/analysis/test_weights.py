"""Weights: Eq. (27), and Appendix A's general form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from analysis.models import WeightingError, weighting_name, weights

OMEGA = 2 * np.pi * np.arange(94, 8001) / 160


def test_both_weightings_of_equation_27():
    np.testing.assert_array_equal(weights(OMEGA, "const"), np.full(7907, 1 / 7907))
    np.testing.assert_allclose(weights(OMEGA, "omega"), 1 / OMEGA / np.sum(1 / OMEGA), rtol=1e-12)


def test_omega_weights_are_a_mean_over_a_logarithmic_axis():
    """Appendix A derives them from the integral of e(omega) over d log10 omega."""
    e = np.sin(np.log(OMEGA)) ** 2
    x = np.log10(OMEGA)
    mean = np.trapezoid(e, x) / (x[-1] - x[0])
    assert weights(OMEGA, "omega") @ e == pytest.approx(mean, rel=1e-3)


@given(power=st.floats(-10, 10))
def test_any_power(power):
    w = weights(OMEGA, f"omega^{power!r}")
    assert w.sum() == pytest.approx(1.0)
    assert (w >= 0).all()
    # The ratio of neighbours in the middle of the band gives the power, whatever the size.
    ratio = np.log(w[4001] / w[4000]) / np.log(OMEGA[4001] / OMEGA[4000])
    assert ratio == pytest.approx(power, rel=1e-6, abs=1e-6)


def test_omega_is_the_power_minus_one():
    np.testing.assert_array_equal(weights(OMEGA, "omega"), weights(OMEGA, "omega^-1"))


def test_function_of_the_user():
    def near_the_second_mode(omega):
        return np.exp(-(((omega - 100.0) / 20.0) ** 2))

    w = weights(OMEGA, near_the_second_mode)
    assert w.sum() == pytest.approx(1.0)
    assert OMEGA[np.argmax(w)] == pytest.approx(100.0, abs=0.04)
    np.testing.assert_allclose(w, weights(OMEGA, lambda o: 7.5 * near_the_second_mode(o)))
    assert weighting_name(near_the_second_mode) == "near_the_second_mode"


@pytest.mark.parametrize(
    "name", ["", "const2", "omega^", "omega^x", "omega^nan", "omega^inf", "w^2"]
)
def test_unknown_names_are_refused(name):
    with pytest.raises(WeightingError, match=r"no weighting .*const, omega"):
        weights(OMEGA, name)
    with pytest.raises(WeightingError):
        weighting_name(name)


@pytest.mark.parametrize(
    "function",
    [
        lambda omega: -np.ones_like(omega),
        np.zeros_like,
        lambda omega: np.full_like(omega, np.nan),
        lambda omega: np.where(omega < 100, -1.0, 5.0),
    ],
)
def test_nonpositive_weights_are_refused(function):
    with pytest.raises(WeightingError, match="not negative"):
        weights(OMEGA, function)


def test_wrong_shape_is_refused():
    with pytest.raises(WeightingError, match="shape"):
        weights(OMEGA, lambda _omega: np.array(1.0))


@pytest.mark.parametrize("power", ["1e6", "-1e6", "10.1", "-11", "nan", "inf"])
def test_extreme_power_is_refused(power):
    with pytest.raises(WeightingError, match=r"from -10 to 10"):
        weights(OMEGA, f"omega^{power}")
