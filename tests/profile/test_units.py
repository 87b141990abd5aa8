"""Units by the endings of keys."""

import pytest

from rigd.units import UNITS, decimals, suffix_of, unit_of


def test_no_ending_hides_a_longer_one():
    assert [suffix_of(f"key{suffix}") for suffix in UNITS] == list(UNITS)


@pytest.mark.parametrize(
    ("key", "unit"),
    [("beam_bending_stiffness_n_m2", "N·m²"), ("control.kd_nm_s_per_rad", "N·m·s/rad"),
     ("fx_n", "N"), ("range_n_nm", "N, N·m"), ("seed", ""), ("nm", "")],
)  # fmt: skip
def test_the_ending_of_a_key_is_its_unit(key, unit):
    assert unit_of(key) == unit


def test_rounding_to_the_second_digit_of_the_uncertainty():
    assert [decimals(each) for each in (250.0, 2.5, 0.25, 0.1, 0.001)] == [0, 1, 2, 2, 4]
