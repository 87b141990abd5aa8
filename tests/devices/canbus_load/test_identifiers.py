"""Identifiers that meet are found, with the numbers of the protocol notes."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rigd.devices.canbus import check_identifiers
from rigd.profile import load_profile

RIG = load_profile("antenna_can").rig


def rig(*, base=0x68, node=1, host=127):
    return replace(
        RIG,
        ati_can=replace(RIG.ati_can, base_id=base),
        cia402=replace(RIG.cia402, node_id=node, host_node_id=host),
    )


def test_the_shipped_profiles_have_no_collision():
    assert check_identifiers(RIG) == []
    assert check_identifiers(load_profile("antenna_serial").rig) == []
    assert check_identifiers(load_profile("sim").rig) == []


@pytest.mark.parametrize("node", [1, 2, 12, 15])
def test_usual_base_of_the_sensor_collides_with_torque_commands(node):
    (found,) = check_identifiers(rig(base=0x20, node=node))
    assert f"0x{0x200 + node:03x} (RPDO1)" in found
    assert "ati_can.base_id = 0x20 takes the identifiers 0x200 to 0x20f" in found
    assert f"cia402.node_id = {node}" in found
    assert "0x68" in found


def test_usual_base_of_the_sensor_fits_other_nodes():
    assert check_identifiers(rig(base=0x20, node=16)) == []


@pytest.mark.parametrize(
    ("base", "node", "service"),
    [
        (0x00, 1, "0x000 (NMT)"),
        (0x08, 1, "0x080 (SYNC), 0x081 (EMCY)"),
        (0x10, 1, "0x100 (TIME)"),
        (0x18, 3, "0x183 (TPDO1)"),
        (0x1B, 48, "0x1b0 (TPDO1)"),
        (0x28, 3, "0x283 (TPDO2)"),
        (0x30, 3, "0x303 (RPDO2)"),
        (0x38, 3, "0x383 (TPDO3)"),
        (0x40, 3, "0x403 (RPDO3)"),
        (0x48, 3, "0x483 (TPDO4)"),
        (0x50, 3, "0x503 (RPDO4)"),
        (0x58, 3, "0x583 (SDO reply)"),
        (0x60, 3, "0x603 (SDO request)"),
        (0x70, 3, "0x703 (heartbeat)"),
        (0x77, 3, "0x77f (host's heartbeat)"),
        (0x7E, 3, "0x7e4 (LSS), 0x7e5 (LSS)"),
    ],
)
def test_every_service_of_the_predefined_set(base, node, service):
    (found,) = check_identifiers(rig(base=base, node=node))
    assert service in found


def test_two_heartbeats_of_one_node():
    (found,) = check_identifiers(rig(node=5, host=5))
    assert "0x705" in found
    assert "host_node_id" in found


@given(st.integers(0, 0x7F), st.integers(1, 127), st.integers(1, 127))
def test_collisions_are_found_and_no_others(base, node, host):
    used = {0x000, 0x080, 0x100, 0x7E4, 0x7E5, 0x700 + host}
    used |= {0x80 + node, 0x580 + node, 0x600 + node, 0x700 + node}
    used |= {pdo + node for pdo in range(0x180, 0x580, 0x80)}
    meets = any(can_id >> 4 == base for can_id in used)
    assert bool(check_identifiers(rig(base=base, node=node, host=host))) == (meets or node == host)


@given(st.integers(1, 127), st.integers(1, 127))
def test_the_advised_base_is_free(node, host):
    assert node == host or check_identifiers(rig(base=0x68, node=node, host=host)) == []
