"""Golden bytes of every frame, written by hand from CiA 301 and 402, and tables in full."""

from collections import Counter
from pathlib import Path

import canopen
import pytest
from canopen.emcy import EmcyError
from canopen.objectdictionary import datatypes
from hypothesis import given
from hypothesis import strategies as st

import rigd.devices.cia402 as package
from rigd.devices.canbus.port import unpack_frame
from rigd.devices.cia402 import _protocol as protocol
from rigd.devices.cia402 import objects

FRAMES = protocol.NodeFrames(5, 100)
EDS = Path(package.__file__).with_name("drive.eds")


@pytest.mark.parametrize(
    ("frame", "can_id", "data"),
    [
        (FRAMES.sync, 0x080, ""),
        (FRAMES.heartbeat, 0x764, "05"),
        (FRAMES.start, 0x000, "01 05"),
        (FRAMES.stop, 0x000, "02 05"),
        (FRAMES.pre_operational, 0x000, "80 05"),
        (FRAMES.disable_voltage, 0x605, "2B 40 60 00 00 00 00 00"),
        (FRAMES.end_heartbeat_monitoring, 0x605, "23 16 10 01 00 00 00 00"),
        (FRAMES.read_mode_request, 0x605, "40 61 60 00 00 00 00 00"),
        (FRAMES.rpdo_frame(0x00, 0), 0x205, "00 00 00 00"),
        (FRAMES.rpdo_frame(0x06, 0), 0x205, "06 00 00 00"),
        (FRAMES.rpdo_frame(0x0F, 1000), 0x205, "0F 00 E8 03"),
        (FRAMES.rpdo_frame(0x0F, -1), 0x205, "0F 00 FF FF"),
        (FRAMES.rpdo_frame(0x0F, 32767), 0x205, "0F 00 FF 7F"),
        (FRAMES.rpdo_frame(0x80, -32768), 0x205, "80 00 00 80"),
    ],
)
def test_frames_sent(frame, can_id, data):
    assert len(frame) == 16
    assert unpack_frame(frame) == (can_id, bytes.fromhex(data))


def test_identifiers_of_the_drives_frames():
    last = protocol.NodeFrames(127, 1)
    assert (last.tpdo_id, last.emergency_id, last.heartbeat_id, last.reply_id, last.rpdo_id) == (
        0x1FF, 0x0FF, 0x77F, 0x5FF, 0x27F,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("data", "fields"),
    [
        ("37 12 00 00 00 00 00 00", (0x1237, 0, 0)),
        ("50 02 01 00 00 00 F4 01", (0x0250, 1, 500)),
        ("37 12 FF FF FF FF 0C FE", (0x1237, -1, -500)),
        ("18 02 00 00 00 80 00 80", (0x0218, -(2**31), -32768)),
        ("27 00 FF FF FF 7F FF 7F", (0x0027, 2**31 - 1, 32767)),
    ],
)
def test_tpdo(data, fields):
    assert protocol.unpack_tpdo(bytes.fromhex(data)) == fields


@given(
    word=st.integers(0, 0xFFFF),
    position=st.integers(-(2**31), 2**31 - 1),
    torque=st.integers(-(2**15), 2**15 - 1),
)
def test_tpdo_and_rpdo_round_trip(word, position, torque):
    def little(value, size):
        return (value % 256**size).to_bytes(size, "little")

    assert protocol.unpack_tpdo(little(word, 2) + little(position, 4) + little(torque, 2)) == (
        word,
        position,
        torque,
    )
    assert unpack_frame(FRAMES.rpdo_frame(word, torque)) == (
        0x205,
        little(word, 2) + little(torque, 2),
    )


def test_emergency():
    assert protocol.read_emergency(bytes.fromhex("11 86 20 02 00 00 00 00")) == (
        0x8611,
        0x20,
        bytes.fromhex("02 00 00 00 00"),
    )
    assert protocol.read_emergency(bytes.fromhex("30 81 11")) == (0x8130, 0x11, b"")
    assert protocol.read_emergency(b"\x30\x81") is None


@pytest.mark.parametrize(
    ("data", "mode"),
    [
        ("4F 61 60 00 0A 00 00 00", 10),
        ("4F 61 60 00 FF 00 00 00", -1),
        ("43 61 60 00 0A 00 00 00", 10),
        ("42 61 60 00 0A 00 00 00", 10),
        ("4F 60 60 00 0A 00 00 00", None),
        ("4F 61 60 01 0A 00 00 00", None),
        ("80 61 60 00 00 00 02 06", None),
        ("60 61 60 00 00 00 00 00", None),
        ("4F 61 60 00 0A 00 00", None),
        ("", None),
    ],
)
def test_reply_to_the_request_of_the_mode(data, mode):
    assert protocol.read_mode(bytes.fromhex(data)) == mode


def test_confirmation_of_a_write():
    assert protocol.confirms_write(bytes.fromhex("60 40 60 00 00 00 00 00"), 0x6040, 0)
    assert protocol.confirms_write(bytes.fromhex("60 16 10 01 00 00 00 00"), 0x1016, 1)
    assert not protocol.confirms_write(bytes.fromhex("80 40 60 00 22 00 00 08"), 0x6040, 0)
    assert not protocol.confirms_write(bytes.fromhex("60 40 60 00"), 0x6040, 0)
    assert not protocol.confirms_write(bytes.fromhex("60 41 60 00 00 00 00 00"), 0x6040, 0)


def test_the_state_of_every_statusword():
    """CiA 402: bits 0 to 3 and 6, with bit 5 where it separates a quick stop from others."""
    words = {
        0b000_0000: protocol.DriveState.NOT_READY,
        0b100_0000: protocol.DriveState.SWITCH_ON_DISABLED,
        0b000_1111: protocol.DriveState.FAULT_REACTION,
        0b000_1000: protocol.DriveState.FAULT,
    }
    with_bit_5 = {
        0b010_0001: protocol.DriveState.READY,
        0b010_0011: protocol.DriveState.SWITCHED_ON,
        0b010_0111: protocol.DriveState.OPERATION_ENABLED,
        0b000_0111: protocol.DriveState.QUICK_STOP,
    }
    seen = Counter()
    for word in range(0x10000):
        expected = words.get(word & 0b100_1111, with_bit_5.get(word & 0b110_1111))
        state = protocol.drive_state(word)
        assert state is (expected or protocol.DriveState.UNKNOWN), f"{word:#06x}"
        seen[state] += 1
    assert set(seen) == set(protocol.DriveState)


def test_every_state_has_its_own_statusword():
    for word in range(0x80):
        assert sum(word & mask == value for mask, value, _ in protocol._STATE_CODES) <= 1


def test_every_error_code_has_a_text_of_its_class():
    """Compared with canopen's table of the classes of CiA 301."""
    ours = {
        "Error Reset / No Error": "no error",
        "Generic Error": "generic",
        "Current": "current",
        "Voltage": "voltage",
        "Temperature": ("temperature", "hot"),
        "Device Hardware": "hardware",
        "Device Software": ("software", "parameters"),
        "Additional Modules": "module",
        "External Error": "external",
        "Additional Functions": "additional function",
        "Device Specific": "see its manual",
    }
    for code in range(0, 0x10000, 0x11):  # of each class, with every low byte
        theirs = EmcyError(code, 0, b"", 0).get_desc()
        words = protocol.describe_error(code)
        assert f"0x{code:04X}" in words
        if theirs in ours and code >> 12 != 0xF:
            wanted = ours[theirs]
            wanted = (wanted,) if isinstance(wanted, str) else wanted
            assert any(word in words for word in wanted), words
    assert "see its manual" in protocol.describe_error(0xFF03)
    assert "additional function" in protocol.describe_error(0xF001)
    assert "heartbeat" in protocol.describe_error(0x8130)
    assert "communication" in protocol.describe_error(0x8150)
    assert "protocol" in protocol.describe_error(0x8250)
    assert "encoder" in protocol.describe_error(0x7305)
    assert protocol.describe_error(0xB000) == "error code 0xB000"


def test_the_shipped_dictionary_has_the_types_of_cia_301_and_402():
    dictionary = canopen.import_od(str(EDS), 5)
    types = {
        datatypes.UNSIGNED8: [(0x1001, 0), (0x1029, 1), (0x1400, 2), (0x1800, 2), (0x1600, 0),
                              (0x1A00, 0), (0x60C2, 1), (0x1019, 0), (0x607E, 0)],
        datatypes.INTEGER8: [(0x6060, 0), (0x6061, 0), (0x60C2, 2)],
        datatypes.UNSIGNED16: [(0x1017, 0), (0x603F, 0), (0x6040, 0), (0x6041, 0), (0x6072, 0)],
        datatypes.INTEGER16: [(0x6007, 0), (0x6071, 0), (0x6077, 0), (0x605A, 0), (0x605E, 0)],
        datatypes.UNSIGNED32: [(0x1000, 0), (0x1005, 0), (0x1006, 0), (0x1016, 1), (0x1018, 1),
                               (0x1007, 0), (0x1014, 0),
                               (0x1018, 2), (0x1018, 3), (0x1018, 4), (0x6076, 0), (0x6080, 0),
                               (0x6502, 0),
                               *((0x1400 + n, 1) for n in range(4)),
                               *((0x1800 + n, 1) for n in range(4)),
                               *((0x1600, sub) for sub in (1, 2)),
                               *((0x1A00, sub) for sub in (1, 2, 3))],
        datatypes.INTEGER32: [(0x6064, 0)],
        datatypes.VISIBLE_STRING: [(0x1008, 0), (0x100A, 0)],
    }  # fmt: skip
    for kind, addresses in types.items():
        for index, sub in addresses:
            assert dictionary.get_variable(index, sub).data_type == kind, f"{index:04X}:{sub}"
    named = {
        value
        for key, value in vars(objects).items()
        if key.isupper() and isinstance(value, int) and 0x1000 <= value <= 0x6FFF
    }
    assert named <= set(dictionary), "an object that set-up may need is not in the dictionary"


def test_the_mapping_of_the_pdos():
    assert objects.TPDO_ENTRIES == (0x60410010, 0x60640020, 0x60770010)
    assert objects.RPDO_ENTRIES == (0x60400010, 0x60710010)
