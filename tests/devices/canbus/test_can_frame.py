"""Frames of the kernel, sixteen bytes each."""

import sys

import pytest
from can import Message
from can.interfaces.socketcan.socketcan import build_can_frame, dissect_can_frame
from hypothesis import given
from hypothesis import strategies as st

from rigd.devices.canbus.port import FRAME_SIZE, pack_frame, unpack_frame

identifiers = st.integers(0, 0x7FF)
payloads = st.binary(max_size=8)


@pytest.mark.skipif(sys.byteorder != "little", reason="the bytes are those of such a machine")
@pytest.mark.parametrize(
    ("can_id", "data", "raw"),
    [
        (0x080, b"", "80 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00"),
        (0x201, b"\x0f\x00\x2c\x01", "01 02 00 00 04 00 00 00 0F 00 2C 01 00 00 00 00"),
        (0x7FF, b"abcdefgh", "FF 07 00 00 08 00 00 00 61 62 63 64 65 66 67 68"),
    ],
)
def test_bytes_of_a_frame(can_id, data, raw):
    assert pack_frame(can_id, data) == bytes.fromhex(raw)
    assert unpack_frame(bytes.fromhex(raw)) == (can_id, data)


@given(identifiers, payloads)
def test_frames_are_those_of_python_can(can_id, data):
    raw = pack_frame(can_id, data)
    assert len(raw) == FRAME_SIZE
    message = Message(arbitration_id=can_id, is_extended_id=False, data=data)
    theirs = build_can_frame(message)
    # The eighth byte is for lengths beyond eight, which the kernel ignores here.
    assert raw[:7] + raw[8:] == theirs[:7] + theirs[8:]
    assert dissect_can_frame(raw) == (can_id, len(data), 0, data)
    assert unpack_frame(raw) == (can_id, data)


@given(st.binary(min_size=16, max_size=16))
def test_any_sixteen_bytes_can_be_unpacked(raw):
    can_id, data = unpack_frame(raw)
    assert can_id == int.from_bytes(raw[:4], sys.byteorder)
    assert data == raw[8 : 8 + min(raw[4], 8)]


@pytest.mark.parametrize("can_id", [-1, 0x800, 0x2000_0000])
def test_longer_identifiers_are_refused(can_id):
    with pytest.raises(ValueError, match="not an 11-bit CAN identifier"):
        pack_frame(can_id)


def test_nine_bytes_are_refused():
    with pytest.raises(ValueError, match="9 bytes"):
        pack_frame(1, bytes(9))
