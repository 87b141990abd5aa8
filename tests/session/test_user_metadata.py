"""Metadata that users add: typed by the unit in its name, and refused by its name."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.session.user_metadata import MetadataError, added_metadata, metadata_keys


def test_a_name_with_a_unit_is_a_number():
    given = {"temperature_c": "21.40", "humidity_percent": 40, "clamp_torque_nm": "1e-1"}
    keys = metadata_keys(given | {"batch": "7", "series": 3})
    assert keys == {"meta_temperature_c": "21.4", "meta_humidity_percent": "40.0",
                    "meta_clamp_torque_nm": "0.1", "meta_batch": "7",
                    "meta_series": "3"}  # fmt: skip
    assert added_metadata(keys | {"specimen": "a"}) == {
        "temperature_c": 21.4, "humidity_percent": 40.0, "clamp_torque_nm": 0.1,
        "batch": "7", "series": "3",
    }  # fmt: skip


def test_third_party_files_may_have_any_metadata():
    assert added_metadata({"meta_temperature_c": "warm", "meta_": "x", "meta_mass_kg": "nan"}) == {
        "temperature_c": "warm", "": "x", "mass_kg": "nan"
    }  # fmt: skip


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"temperature_c": "21,4"}, "temperature_c = '21,4' .* °C"),
        ({"temperature_c": float("inf")}, "finite"),
        ({"temperature_c": True}, "finite"),
        ({"temperature_c": "9" * 5000}, "finite"),
        ({"temperature_c": [1.0]}, "finite"),
        ({"Temperature_c": 1.0}, "lower-case"),
        ({"": "x"}, "lower-case"),
        ({"a" * 41: "x"}, "40 characters"),
        ({"operator": "Ada"}, "give it as operator"),
        ({"batch": "two\nlines"}, "one line"),
        ({"batch": " "}, "one line"),
        ({"batch": None}, "one line"),
        ({"batch": False}, "one line"),
        ({"batch": "x" * 201}, "201 characters"),
        ({f"n{i}": "x" for i in range(33)}, "33 names"),
    ],
)
def test_violations_of_a_rule_are_refused_by_name(given, named):
    with pytest.raises(MetadataError, match=named) as refusal:
        metadata_keys(given)
    assert len(str(refusal.value)) < 300


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_retain_all_their_digits(value):
    assert added_metadata(metadata_keys({"force_n": value})) == {"force_n": value}
