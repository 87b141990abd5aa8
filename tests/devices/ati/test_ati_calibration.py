"""Calibrations, status words and registers, against numbers worked out by hand."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigd.devices.ati._calibration import (
    CRITICAL_CAN_STATUS_BITS,
    CRITICAL_SERIAL_STATUS_BITS,
    WIRE_ORDER,
    Calibration,
    calibration_block_address,
    describe_can_status,
    describe_serial_status,
    parse_block,
    printable_text,
    same_serial_number,
    wrench_from_counts_function,
)

ONES = tuple(tuple(1.0 if axis == gauge else 0.0 for gauge in range(6)) for axis in range(6))


def calibration(**changes):
    fields = {
        "serial_number": "FT1",
        "force_unit": 2,
        "torque_unit": 3,
        "counts_per_force": 1,
        "counts_per_torque": 1,
        "matrix": ONES,
    } | changes
    return Calibration(**fields)


@pytest.mark.parametrize(
    ("code", "newton"),
    [(1, 4.4482216), (2, 1.0), (3, 4448.2216), (4, 1000.0), (5, 9.80665), (6, 9.80665e-3)],
)
def test_force_units(code, newton):
    rows = calibration(force_unit=code, counts_per_force=1000).wrench_per_count()
    assert rows[2][2] == pytest.approx(1e-3 * newton, rel=1e-8)
    assert rows[3][3] == 1.0


@pytest.mark.parametrize(
    ("code", "newton_metre"),
    [(1, 0.112984829), (2, 1.35581795), (3, 1.0), (4, 1e-3), (5, 0.0980665), (6, 1000.0)],
)
def test_torque_units(code, newton_metre):
    rows = calibration(torque_unit=code, counts_per_torque=1000).wrench_per_count()
    assert rows[5][5] == pytest.approx(1e-3 * newton_metre, rel=1e-8)
    assert rows[0][0] == 1.0


def test_forces_and_torques_have_separate_counts():
    rows = calibration(counts_per_force=4, counts_per_torque=5).wrench_per_count()
    assert rows[1][1] == 0.25
    assert rows[4][4] == 0.2


@pytest.mark.parametrize("code", [0, 7, 255])
def test_unknown_units_are_refused(code):
    with pytest.raises(ValueError, match="unit codes"):
        calibration(force_unit=code)
    with pytest.raises(ValueError, match="unit codes"):
        calibration(torque_unit=code)


@pytest.mark.parametrize("counts", [0, -1])
def test_counts_below_one_are_refused(counts):
    with pytest.raises(ValueError, match="counts"):
        calibration(counts_per_force=counts)
    with pytest.raises(ValueError, match="counts"):
        calibration(counts_per_torque=counts)


@pytest.mark.parametrize("entry", [math.nan, math.inf, -math.inf])
def test_a_matrix_with_nan_entries_is_refused(entry):
    rows = [list(row) for row in ONES]
    rows[4][1] = entry
    with pytest.raises(ValueError, match=r"entry Ty, gauge 1 .* not a number"):
        calibration(matrix=tuple(map(tuple, rows)))


def test_a_matrix_with_an_empty_row_is_refused():
    with pytest.raises(ValueError, match=r"row Fx .* zero"):
        calibration(matrix=((0.0,) * 6,) * 6)
    with pytest.raises(ValueError, match=r"row Tz .* zero"):
        calibration(matrix=(*ONES[:5], (0.0,) * 6))


@pytest.mark.parametrize(
    ("axis", "entry", "message"),
    [
        (0, 1e35, r"entry Fx, gauge 2 .* 1e\+35 .*more than any sensor has \(1e\+06 N\)"),
        (5, -1e35, r"entry Tz, gauge 2 .* -1e\+35 .*more than any sensor has \(1e\+06 N·m\)"),
        (3, 31.0, r"entry Tx, gauge 2 .* 31 "),
    ],
)
def test_an_impossible_entry_is_named(axis, entry, message):
    rows = [list(row) for row in ONES]
    rows[axis][2] = entry
    with pytest.raises(ValueError, match=message):
        calibration(matrix=tuple(map(tuple, rows)))


def test_an_entry_just_within_the_limits_is_accepted():
    rows = [list(row) for row in ONES]
    rows[3][2] = 30.0
    calibration(matrix=tuple(map(tuple, rows)))


def test_a_row_of_tiny_entries_is_named():
    tiny = tuple(1e-30 * entry for entry in ONES[1])
    with pytest.raises(ValueError, match=r"row Fy .* beyond 1e-30 "):
        calibration(matrix=(ONES[0], tiny, *ONES[2:]))


@pytest.mark.parametrize("scale", [1.0, 1e-3, -25.0])
def test_a_singular_matrix_is_refused(scale):
    copied = tuple(scale * entry for entry in ONES[2])
    with pytest.raises(ValueError, match="is singular"):
        calibration(matrix=(*ONES[:3], copied, *ONES[4:]))
    with pytest.raises(ValueError, match="is singular"):  # a gauge that counts for nothing
        calibration(matrix=(*ONES[:5], ONES[0]))


@given(st.lists(st.floats(1e-4, 1e4), min_size=6, max_size=6), st.permutations(range(6)))
def test_axes_and_gauges_of_any_scale_and_order_are_accepted(sizes, order):
    rows = [
        [size * 1e-3 * entry for entry in ONES[k]] for size, k in zip(sizes, order, strict=True)
    ]
    calibration(matrix=tuple(map(tuple, rows)))


def test_the_range_is_given_in_newtons():
    found = calibration(force_unit=1, torque_unit=4, rated_loads=(5.0, 5.0, 15.0, 1e3, 1e3, 1e3))
    document = found.as_dict()
    assert document["range_n_nm"] == pytest.approx(
        [22.2411, 22.2411, 66.7233, 1.0, 1.0, 1.0], rel=1e-5
    )
    assert document["force_unit"] == "lbf"
    assert json.loads(json.dumps(document, allow_nan=False)) == document


def test_an_unknown_range_is_reported_as_unknown():
    assert calibration().as_dict()["range_n_nm"] == "not stated by the sensor"
    unwritten = calibration(rated_loads=(math.nan,) * 6)
    assert unwritten.as_dict()["range_n_nm"] == "not stated by the sensor"


entries = st.floats(-1e4, 1e4, width=32)
gauges = st.integers(-32768, 32767)


@settings(max_examples=30)
@given(
    matrix=st.lists(st.lists(entries, min_size=6, max_size=6), min_size=6, max_size=6),
    counts=st.tuples(st.integers(10**5, 2**31 - 1), st.integers(10**5, 2**31 - 1)),
    readings=st.lists(gauges, min_size=6, max_size=6),
)
def test_the_wrench_is_matrix_times_gauges_over_counts(matrix, counts, readings):
    for axis, row in enumerate(matrix):
        row[axis] = 3e5  # none of them is a combination of the others
    found = calibration(
        matrix=tuple(map(tuple, matrix)), counts_per_force=counts[0], counts_per_torque=counts[1]
    )
    expected = np.array(matrix) @ np.array(readings) / np.repeat(counts, 3)
    scale = np.abs(matrix) @ np.abs(readings) / np.repeat(counts, 3) + 1e-300
    natural = wrench_from_counts_function(found.wrench_per_count())(*readings)
    wired = wrench_from_counts_function(found.wrench_per_wire_count())(
        *(readings[j] for j in WIRE_ORDER)
    )
    assert np.all(np.abs(np.array(natural) - expected) <= 1e-13 * scale)
    assert np.all(np.abs(np.array(wired) - expected) <= 1e-13 * scale)


def test_serial_numbers():
    assert same_serial_number("", "FT12345")
    assert same_serial_number("ft12345 ", "FT12345")
    assert not same_serial_number("FT12345", "FT12346")
    assert not same_serial_number("FT12345", "")


def test_text():
    assert printable_text(b"SI-20-1\0\0\0") == "SI-20-1"
    assert printable_text(b"FT1\xff\xff") == "FT1"
    assert printable_text(b"\0" * 8) == ""
    assert printable_text(b"\x00\x07") == "00 07"
    assert printable_text(b"A\xb0B") == "41 b0 42"


@settings(max_examples=30)
@given(st.binary(max_size=32))
def test_text_is_always_printable(raw):
    assert printable_text(raw).isprintable()


def test_addresses_of_calibration_blocks():
    assert calibration_block_address(1) == 0x00E3
    assert calibration_block_address(2) == 0x01A3
    assert calibration_block_address(16) == 0x0C23


def test_a_calibration_block(fakes):
    block = parse_block(fakes.calibration_registers()[:133])
    found = block.calibration
    assert (found.serial_number, found.part_number) == ("FT12345", "SI-20-1")
    assert (found.family, found.date) == ("DIG", "2021/03/04 12:00")
    assert (found.force_unit, found.torque_unit) == (2, 3)
    assert (found.counts_per_force, found.counts_per_torque) == (1_000_000, 2_000_000)
    assert found.rated_loads == (20.0, 20.0, 60.0, 1.0, 1.0, 1.0)
    assert found.matrix == fakes.MATRIX
    assert block.amplifier_gains == (541, 550, 560, 570, 575, 579)
    assert block.amplifier_offsets == (31842, 32000, 32768, 33000, 34000, 34927)


@pytest.mark.parametrize("fill", [0x0000, 0xFFFF])
def test_an_empty_calibration_block_is_refused(fill):
    with pytest.raises(ValueError, match="Choose another calibration"):
        parse_block([fill] * 133)


@settings(max_examples=30)
@given(st.lists(st.integers(0, 0xFFFF), min_size=133, max_size=133), st.booleans())
def test_any_calibration_block_is_read_or_refused(registers, sound_units):
    if sound_units:
        registers[104] = 0x0203
    try:
        block = parse_block(registers)
    except ValueError as error:
        assert str(error).endswith(("calibration.", "sensor repaired."))
    else:
        assert all(map(math.isfinite, sum(block.calibration.wrench_per_count(), ())))
        json.dumps(replace(block.calibration).as_dict(), allow_nan=False)


@given(damage=st.dictionaries(st.integers(0, 132), st.integers(0, 0xFFFF), max_size=5))
def test_a_damaged_calibration_block_is_read_or_refused(fakes, damage):
    registers = fakes.calibration_registers()[:133]
    for at, word in damage.items():
        registers[at] = word
    try:
        json.dumps(parse_block(registers).calibration.as_dict(), allow_nan=False)
    except ValueError as error:
        assert str(error).endswith(("calibration.", "sensor repaired."))


def test_status_words():
    assert describe_can_status(0) == describe_serial_status(0) == []
    assert describe_can_status(0x8001) == ["its watchdog has reset the board"]
    assert describe_can_status(0x0040) == ["the active calibration is bad"]
    assert describe_serial_status(0x0040) == ["status bit 6, which has no known meaning, is set"]
    assert describe_can_status(0x0800) == ["the sensor is too hot"]
    assert describe_serial_status(0x0800) == ["the reading of its thermistor is too high"]
    assert "too much current" in describe_serial_status(0x0200)[0]
    assert "no known meaning" in describe_can_status(0x0200)[0]
    assert len(describe_can_status(0x7FFF)) == 15


def test_critical_bits_are_those_of_the_table():
    critical_on_can = {1, 2, 3, 4, 5, 6, 7, 11, 12}
    critical_on_serial = {1, 2, 3, 4, 5, 7, 9, 10, 11, 12, 13}
    assert sum(1 << bit for bit in critical_on_can) == CRITICAL_CAN_STATUS_BITS
    assert sum(1 << bit for bit in critical_on_serial) == CRITICAL_SERIAL_STATUS_BITS
