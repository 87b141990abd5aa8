"""The structures are the paper's Table 2."""

import pytest

from analysis.models import STRUCTURES
from rigd.beam import DAMPING_PARAMETERS, Damping

TABLE_2 = {
    "I": {"alpha": 1, "lambda": 0, "gamma": 0},
    "II": {"alpha": 0, "zeta": 0, "lambda": 1},
    "III": {"alpha": 1, "lambda": 1},
    "IV": {"lambda": 0, "gamma": 0},
    "V": {"alpha": 0, "zeta": 0},
    "VI": {},
    "VII": {"alpha": 1},
}


def test_all_types_are_listed_in_order():
    assert list(STRUCTURES) == list(TABLE_2)


@pytest.mark.parametrize("name", TABLE_2)
def test_fixed_and_free(name):
    structure = STRUCTURES[name]
    assert structure.name == name
    assert dict(structure.fixed) == TABLE_2[name]
    assert structure.free == tuple(p for p in DAMPING_PARAMETERS if p not in TABLE_2[name])
    assert structure.has_internal_damping == (name not in ("II", "V"))
    assert structure.has_external_damping == (name not in ("I", "IV"))


def test_damping_ignores_values_of_fixed_parameters():
    values = {"zeta": 2e-4, "alpha": 0.7, "gamma": 0.3, "lambda": 1.2}
    assert STRUCTURES["VI"].damping(values) == Damping(2e-4, 0.7, 0.3, 1.2)
    assert STRUCTURES["VII"].damping(values) == Damping(2e-4, 1.0, 0.3, 1.2)
    assert STRUCTURES["V"].damping(values) == Damping(0.0, 0.0, 0.3, 1.2)
    assert STRUCTURES["I"].damping({"zeta": 1e-5}) == Damping(1e-5, 1.0, 0.0, 0.0)
