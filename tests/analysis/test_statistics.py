"""p-values and quantiles, each against closed forms or printed tables."""

import math

import pytest

from analysis.statistics import (
    NORMAL_95,
    chi_square_deviate,
    chi_square_p_value,
    kolmogorov_p_value,
    student_t_quantile,
)


def normal_p_value(deviate):
    return math.erfc(deviate / math.sqrt(2)) / 2


def even_p_value(value, freedom):
    """Chi-square of an even number of degrees of freedom: a sum of Poisson probabilities."""
    half = value / 2
    terms = (math.exp(-half + k * math.log(half) - math.lgamma(k + 1)) for k in range(freedom // 2))
    return math.fsum(terms)


def test_the_normal_point_leaves_one_in_forty_on_each_side():
    assert normal_p_value(NORMAL_95) == pytest.approx(0.025, rel=1e-14)


@pytest.mark.parametrize(
    ("value", "freedom", "p_value"),
    [  # Abramowitz and Stegun, Handbook of Mathematical Functions, table 26.8
        (3.84146, 1, 0.05),
        (10.8276, 1, 0.001),
        (11.0705, 5, 0.05),
        (18.3070, 10, 0.05),
        (15.9871, 10, 0.1),
        (40.2560, 30, 0.1),
        (135.807, 100, 0.01),
    ],
)
def test_chi_square_matches_tables(value, freedom, p_value):
    assert chi_square_p_value(value, freedom) == pytest.approx(p_value, rel=1e-4)


def test_chi_square_accepts_arrays():
    values = [1.0, 8.0, 60.0]
    expected = [even_p_value(value, 6) for value in values]
    assert chi_square_p_value(values, 6) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("deviate", [-30.0, -5.0, -0.1, 0.0, 2.0, 5.0, 20.0, 36.0, 37.5])
def test_deviate_has_the_tail_of_its_chi_square(deviate):
    """With two degrees of freedom the probability is exp(-value / 2), also beyond 1e-290."""
    value = -2 * math.log1p(-normal_p_value(-deviate)) if deviate < 0 else 0.0
    if deviate >= 0:
        value = -2 * math.log(normal_p_value(deviate))
    assert chi_square_deviate(value, 2) == pytest.approx(deviate, abs=1e-9)


@pytest.mark.parametrize("freedom", [16, 64, 888])
def test_deviate_is_continuous_where_the_expansion_begins(freedom):
    """At 1e-290, where a normal deviate is 36.4260 and rises by a third of a hundredth a decade."""
    below, above = _where(freedom, 1e-289), _where(freedom, 1e-291)
    first, last = chi_square_deviate(below, freedom), chi_square_deviate(above, freedom)
    assert normal_p_value(first) == pytest.approx(1e-289, rel=1e-6)
    assert normal_p_value(last) == pytest.approx(1e-291, rel=2e-3)


def _where(freedom, p_value):
    """Chi-square of that probability, by bisection in the closed form."""
    low, high = float(freedom), 100.0 * freedom + 2000.0
    for _ in range(100):
        middle = (low + high) / 2
        if even_p_value(middle, freedom) > p_value:
            low = middle
        else:
            high = middle
    return low


@pytest.mark.parametrize("freedom", [2, 16, 888])
@pytest.mark.parametrize("value", [0.0, 1e-300, 1e9])
def test_deviate_is_finite_far_out(value, freedom):
    deviate = chi_square_deviate(value, freedom)
    assert math.isfinite(deviate)
    assert (deviate > 0) == (value > freedom)


def test_deviate_far_out_is_near_the_asymptotic_root():
    """-2 ln p of a normal deviate z is z² + ln(2 pi z²) to 1 / z², and value of two degrees."""
    value = 1e6
    z = chi_square_deviate(value, 2)
    assert z**2 + math.log(2 * math.pi * z**2) == pytest.approx(value, abs=1e-4)


@pytest.mark.parametrize(
    ("statistic", "p_value"),
    [(0.2, 1.0), (1.2239, 0.10), (1.3581, 0.05), (1.6276, 0.01), (1.9495, 0.001)],
)  # N. Smirnov, Ann. Math. Stat. 19 (1948) 279-281
def test_kolmogorov_matches_tables(statistic, p_value):
    assert kolmogorov_p_value(statistic) == pytest.approx(p_value, rel=1e-3)


@pytest.mark.parametrize("level", [0.5, 0.95, 0.999, 1 - 1e-9])
def test_student_s_t_of_one_and_two_degrees_of_freedom(level):
    assert student_t_quantile(level, 1) == pytest.approx(math.tan(math.pi * level / 2), rel=1e-6)
    of_two = level * math.sqrt(2 / (1 - level**2))
    assert student_t_quantile(level, 2) == pytest.approx(of_two, rel=1e-6)


@pytest.mark.parametrize(
    ("freedom", "point"), [(4, 2.776), (9, 2.262), (19, 2.093), (30, 2.042), (120, 1.980)]
)  # Abramowitz and Stegun, table 26.10
def test_student_s_t_matches_tables(freedom, point):
    assert student_t_quantile(0.95, freedom) == pytest.approx(point, abs=5e-4)
