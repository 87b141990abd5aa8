"""The table of requirements on a drive."""

import subprocess
import sys

import pytest

from rigd.devices.cia402.requirements import (
    ACCEPTABLE_MISSING_FUNCTIONS,
    CORE_REQUIREMENTS,
    OPTIONAL_REQUIREMENTS,
    REQUIREMENTS,
    AllowedValue,
    ObjectAccess,
    requirement,
)


def test_each_object_occurs_once():
    addresses = [(each.index, each.subindex) for each in REQUIREMENTS]
    assert len(addresses) == len(set(addresses))


def test_a_missing_core_object_is_refused_with_a_reason():
    for each in CORE_REQUIREMENTS:
        assert each.is_core
        assert each.address in each.refusal_reason(ACCEPTABLE_MISSING_FUNCTIONS)
        assert each.consequence.endswith(".")


def test_optional_objects_have_a_substitute_or_need_acceptance():
    for each in OPTIONAL_REQUIREMENTS:
        assert not each.is_core
        assert each.replacement or each.acceptance_name, each.address
        assert each.acceptance_name in ("", *ACCEPTABLE_MISSING_FUNCTIONS)
        assert each.refusal_reason(ACCEPTABLE_MISSING_FUNCTIONS) == ""
        assert bool(each.refusal_reason()) == bool(each.acceptance_name)


def test_every_acceptable_name_belongs_to_an_object():
    assert {each.acceptance_name for each in OPTIONAL_REQUIREMENTS} - {""} == set(
        ACCEPTABLE_MISSING_FUNCTIONS
    )


@pytest.mark.parametrize("name", ACCEPTABLE_MISSING_FUNCTIONS)
def test_a_refusal_names_the_way_to_accept_it(name):
    row = next(each for each in OPTIONAL_REQUIREMENTS if each.acceptance_name == name)
    reason = row.refusal_reason([other for other in ACCEPTABLE_MISSING_FUNCTIONS if other != name])
    assert f'cia402.accept_without = ["{name}"]' in reason
    assert row.name in reason


def test_accepted_values_of_a_read_only_object():
    assert AllowedValue.AT_LEAST.allows(50_000, 1800)
    assert not AllowedValue.AT_LEAST.allows(1799, 1800)
    assert not AllowedValue.EQUAL.allows(50_000, 1800)
    assert AllowedValue.ANY.allows(0, 1)


@pytest.mark.process
def test_the_table_loads_no_library():
    code = (
        "import sys, rigd.devices.cia402.requirements as r;"
        "print([m for m in ('can', 'canopen', 'numpy', 'pydantic') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_mapped_objects_are_those_of_the_pdos():
    from rigd.devices.cia402 import objects

    sent = {each.index for each in REQUIREMENTS if ObjectAccess.SENT_IN_TPDO in each.access}
    received = {each.index for each in REQUIREMENTS if ObjectAccess.RECEIVED_IN_RPDO in each.access}
    assert sent == {entry >> 16 for entry in objects.TPDO_ENTRIES}
    assert received == {entry >> 16 for entry in objects.RPDO_ENTRIES}
    assert requirement(0x6072).acceptance_name == "torque_limit"
