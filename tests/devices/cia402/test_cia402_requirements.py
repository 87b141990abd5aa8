"""The table of what rigd asks of a drive."""

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


def test_each_object_stands_there_once():
    places = [(each.index, each.sub) for each in REQUIREMENTS]
    assert len(places) == len(set(places))


def test_what_is_core_is_refused_and_says_why():
    for each in CORE_REQUIREMENTS:
        assert each.core
        assert each.address in each.refusal_reason(ACCEPTABLE)
        assert each.sentence.endswith(".")


def test_what_is_optional_has_a_stand_in_or_has_to_be_accepted_by_name():
    for each in OPTIONAL_REQUIREMENTS:
        assert not each.core
        assert each.stand_in or each.accept, each.address
        assert each.accept in ("", *ACCEPTABLE)
        assert each.refusal_reason(ACCEPTABLE) == ""
        assert bool(each.refusal_reason()) == bool(each.accept)


def test_every_name_that_can_be_accepted_belongs_to_an_object():
    assert {each.accept for each in OPTIONAL_REQUIREMENTS} - {""} == set(ACCEPTABLE)


@pytest.mark.parametrize("name", ACCEPTABLE)
def test_a_refusal_names_the_way_to_accept_it(name):
    row = next(each for each in OPTIONAL_REQUIREMENTS if each.accept == name)
    told = row.refusal_reason([other for other in ACCEPTABLE if other != name])
    assert f'cia402.accept_without = ["{name}"]' in told
    assert row.name in told


def test_what_an_object_may_hold_that_cannot_be_written():
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
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"


def test_what_is_mapped_is_what_the_pdos_carry():
    from rigd.devices.cia402 import objects

    sent = {each.index for each in REQUIREMENTS if ObjectAccess.SENT in each.access}
    received = {each.index for each in REQUIREMENTS if ObjectAccess.RECEIVED in each.access}
    assert sent == {entry >> 16 for entry in objects.TPDO_ENTRIES}
    assert received == {entry >> 16 for entry in objects.RPDO_ENTRIES}
    assert requirement(0x6072).accept == "torque_limit"
