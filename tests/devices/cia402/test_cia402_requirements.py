"""The table of requirements on a drive."""

import subprocess
import sys

import pytest

from rigd.devices.cia402.requirements import (
    ACCEPTABLE,
    CORE_REQUIREMENTS,
    OPTIONAL_REQUIREMENTS,
    REQUIREMENTS,
    AllowedValue,
    ObjectAccess,
    requirement,
)


def test_each_object_occurs_once():
    addresses = [(each.index, each.sub) for each in REQUIREMENTS]
    assert len(addresses) == len(set(addresses))


def test_a_missing_core_object_is_refused_with_a_reason():
    for each in CORE_REQUIREMENTS:
        assert each.core
        assert each.address in each.refusal_reason(ACCEPTABLE)
        assert each.sentence.endswith(".")


def test_optional_objects_have_a_substitute_or_need_acceptance():
    for each in OPTIONAL_REQUIREMENTS:
        assert not each.core
        assert each.stand_in or each.accept, each.address
        assert each.accept in ("", *ACCEPTABLE)
        assert each.refusal_reason(ACCEPTABLE) == ""
        assert bool(each.refusal_reason()) == bool(each.accept)


def test_every_acceptable_name_belongs_to_an_object():
    assert {each.accept for each in OPTIONAL_REQUIREMENTS} - {""} == set(ACCEPTABLE)


@pytest.mark.parametrize("name", ACCEPTABLE)
def test_a_refusal_names_the_way_to_accept_it(name):
    row = next(each for each in OPTIONAL_REQUIREMENTS if each.accept == name)
    reason = row.refusal_reason([other for other in ACCEPTABLE if other != name])
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

    sent = {each.index for each in REQUIREMENTS if ObjectAccess.SENT in each.access}
    received = {each.index for each in REQUIREMENTS if ObjectAccess.RECEIVED in each.access}
    assert sent == {entry >> 16 for entry in objects.TPDO_ENTRIES}
    assert received == {entry >> 16 for entry in objects.RPDO_ENTRIES}
    assert requirement(0x6072).accept == "torque_limit"
