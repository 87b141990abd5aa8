"""Packing of messages against google.protobuf's decoder and encoder."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from session_schemas import message_class

from rigd.session.layout import (
    CONTROL_FIELD_TYPES,
    CONTROL_SIZE,
    SAMPLE_DTYPE,
    SAMPLE_FIELD_TYPES,
    SAMPLE_FIELDS,
    SAMPLE_SIZE,
    SAMPLE_WIRE_DTYPE,
    TIMING_FIELD_TYPES,
    TIMING_SIZE,
    TOUCH_FIELD_TYPES,
    TOUCH_KINDS,
    TOUCH_SIZE,
    Status,
    decode_controls,
    decode_samples,
    decode_timings,
    decode_touches,
    is_fixed_layout,
    pack_control_into,
    pack_sample_into,
    pack_timing_into,
    pack_touch,
)

INT64 = st.integers(-(2**63), 2**63 - 1)
UINT32 = st.integers(0, 2**32 - 1)
DOUBLE = st.floats()
SAMPLES = st.tuples(INT64, UINT32, *[DOUBLE] * 10, UINT32, UINT32, UINT32)
CONTROLS = st.tuples(INT64, UINT32, *[DOUBLE] * 6)
TIMINGS = st.tuples(INT64, UINT32, DOUBLE, DOUBLE)
TOUCHES = st.tuples(INT64, UINT32, *[DOUBLE] * 6, st.sampled_from(TOUCH_KINDS))


def same(left, right):
    return left == right or (left != left and right != right)


def protobuf_fields(schema_name, data, names):
    message = message_class(schema_name).FromString(data)
    return [getattr(message, name) for name in names]


def pack(pack_into, size, values):
    buffer = bytearray(size)
    pack_into(buffer, 0, *values)
    return bytes(buffer)


def test_sizes_and_fields_of_the_format():
    assert (SAMPLE_SIZE, CONTROL_SIZE, TIMING_SIZE) == (119, 68, 32)
    assert SAMPLE_FIELDS == (
        "t_ns", "tick", "angle_reference_rad", "angle_rad", "torque_command_nm",
        "coupling_torque_nm", "fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm", "status",
        "lateness_ns", "work_ns",
    )  # fmt: skip
    assert SAMPLE_DTYPE.names == SAMPLE_FIELDS
    assert [flag.value for flag in Status] == [1 << bit for bit in range(len(Status))]
    assert TOUCH_SIZE == 73


@given(TOUCHES)
def test_a_packed_touch_is_decoded_by_protobuf_and_by_numpy(values):
    data = pack_touch(*values)
    expected = (*values[:-1], TOUCH_KINDS.index(values[-1]))
    assert len(data) == TOUCH_SIZE
    assert all(map(same, protobuf_fields("rigd.Touch", data, TOUCH_FIELD_TYPES), expected))
    assert all(map(same, decode_touches(data)[0].item(), expected))


def test_a_touch_of_a_new_kind_is_unknown():
    assert decode_touches(pack_touch(1, 2, *[0.0] * 6, "bite"))["kind"] == 0


@given(SAMPLES)
def test_a_packed_sample_is_decoded_by_protobuf_and_by_numpy(values):
    data = pack(pack_sample_into, SAMPLE_SIZE, values)
    assert all(map(same, protobuf_fields("rigd.Sample", data, SAMPLE_FIELDS), values))
    assert all(map(same, decode_samples(data)[0].item(), values))


@given(CONTROLS)
def test_a_packed_control_message_is_decoded_by_protobuf_and_by_numpy(values):
    data = pack(pack_control_into, CONTROL_SIZE, values)
    assert all(map(same, protobuf_fields("rigd.Control", data, CONTROL_FIELD_TYPES), values))
    assert all(map(same, decode_controls(data)[0].item(), values))


@given(TIMINGS)
def test_a_packed_timing_message_is_decoded_by_protobuf_and_by_numpy(values):
    data = pack(pack_timing_into, TIMING_SIZE, values)
    assert all(map(same, protobuf_fields("rigd.Timing", data, TIMING_FIELD_TYPES), values))
    assert all(map(same, decode_timings(data)[0].item(), values))


@given(st.lists(SAMPLES, max_size=5), st.integers(0, 7))
def test_samples_are_packed_only_at_their_offset(rows, offset):
    buffer = bytearray(b"\xa5" * (offset + len(rows) * SAMPLE_SIZE + 3))
    for i, values in enumerate(rows):
        pack_sample_into(memoryview(buffer), offset + i * SAMPLE_SIZE, *values)
    assert buffer[:offset] == b"\xa5" * offset
    assert buffer[-3:] == b"\xa5" * 3
    decoded = decode_samples(memoryview(buffer)[offset:-3])
    assert all(same(a, b) for row, values in zip(decoded, rows, strict=True)
               for a, b in zip(row.item(), values, strict=True))  # fmt: skip


@given(st.integers(-(2**70), 2**70), st.integers(-(2**70), 2**70))
def test_lateness_and_work_are_clamped_to_their_type(lateness_ns, work_ns):
    values = (0, 0, *[0.0] * 10, 0, lateness_ns, work_ns)
    sample = decode_samples(pack(pack_sample_into, SAMPLE_SIZE, values))[0]
    assert sample["lateness_ns"] == min(max(lateness_ns, 0), 2**32 - 1)
    assert sample["work_ns"] == min(max(work_ns, 0), 2**32 - 1)


def test_a_status_of_flags_is_packed():
    values = (0, 0, *[0.0] * 10, Status.TORQUE_OFF | Status.LATE, 0, 0)
    assert decode_samples(pack(pack_sample_into, SAMPLE_SIZE, values))[0]["status"] == 384


@given(SAMPLES, st.integers(1, 15), st.integers(1, 255))
def test_a_wrong_tag_is_refused(values, number, difference):
    data = bytearray(pack(pack_sample_into, SAMPLE_SIZE, values))
    data[SAMPLE_WIRE_DTYPE.fields[f"tag_{SAMPLE_FIELDS[number - 1]}"][1]] ^= difference
    assert not is_fixed_layout(np.frombuffer(data, SAMPLE_WIRE_DTYPE), SAMPLE_FIELD_TYPES).any()
    with pytest.raises(ValueError, match="message 0 of the block"):
        decode_samples(data)


def test_a_block_with_a_partial_sample_is_refused():
    with pytest.raises(ValueError, match="not a whole number of 119-byte"):
        decode_samples(bytes(120))


@pytest.mark.process
def test_the_control_process_imports_neither_container_nor_protobuf():
    heavy = ("mcap", "google.protobuf", "zstandard", "lz4", "scipy")
    code = (
        "import sys, rigd.session, rigd.session.layout\n"
        f"print([name for name in {heavy!r} if name in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


def test_unknown_names_of_the_package_are_attribute_errors():
    import rigd.session

    assert all(getattr(rigd.session, name) is not None for name in rigd.session.__all__)
    with pytest.raises(AttributeError, match="nothing"):
        _ = rigd.session.nothing
