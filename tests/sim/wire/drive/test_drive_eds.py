"""A drive made from an EDS file has exactly its objects and access rights."""

import struct
from configparser import RawConfigParser

import pytest
from eds_files import FILES, WITH_TORQUE, WITHOUT_TORQUE, eds_path, eds_text

from rigd.devices.contracts import DeviceError

ABSENT, NO_SUB = 0x06020000, 0x06090011
READ_ONLY, WRITE_ONLY, VALUE = 0x06010002, 0x06010001, 0x06090030
NOT_MAPPABLE, PDO_LENGTH = 0x06040041, 0x06040042
NODE = 5
SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 1, 6: 2, 7: 4}
"""Bytes of the data types that fit in one frame."""


@pytest.fixture
def made_of(eds_bench, tmp_path):
    """A drive of a short table of objects."""

    def make(table, **device):
        path = tmp_path / "made.eds"
        path.write_text(eds_text(table, **device))
        return eds_bench(path)

    return make


def sections(path):
    """Return the objects of a file, read without the library that the drive uses."""
    parser = RawConfigParser(strict=False, inline_comment_prefixes=(";",))
    parser.read_string(path.read_text("latin-1"))
    found = {}
    for name in parser.sections():
        index, _, sub = name.lower().partition("sub")
        if len(index) == 4 and parser.has_option(name, "accesstype"):
            section = dict(parser[name])
            found[int(index, 16), int(sub or "0", 16)] = (
                int(section.get("datatype", "7"), 0),
                section["accesstype"].lower(),
                int(section.get("pdomapping") or "0", 0),
            )
    return found


def abort(bench, index, sub):
    """Abort code of an upload, or 0."""
    reply = bytes.fromhex(bench.request(struct.pack("<BHBI", 0x40, index, sub, 0).hex()))
    bench.node._sdo.reset()  # only the beginning of a text is requested
    return int.from_bytes(reply[4:], "little") if reply[0] == 0x80 else 0


@pytest.mark.parametrize("name", sorted(path.stem for path in FILES.glob("*.eds")))
def test_the_drive_has_exactly_the_objects_of_its_file(eds_bench, name):
    bench, objects = eds_bench(eds_path(name)), sections(eds_path(name))
    assert len(objects) > 10
    indices = {index for index, _ in objects}
    for index in (*range(0x1000, 0x1030), *range(0x1400, 0x1C00), *range(0x6000, 0x6600)):
        if index not in indices:
            assert abort(bench, index, 0) == ABSENT, f"{index:04X}"
            assert bench.write(index, 0, 0, 2) == ABSENT
    for (index, sub), (data_type, access, _) in objects.items():
        code = abort(bench, index, sub)
        empty_history = index == 0x1003 and sub > 0
        assert code == (WRITE_ONLY if access == "wo" else code if empty_history else 0), (
            f"{index:04X}:{sub}"
        )
        if access in ("ro", "const"):
            assert bench.write(index, sub, 0, SIZES.get(data_type, 4)) == READ_ONLY
        assert abort(bench, index, 0xFE) == NO_SUB
        if access == "rw" and 0x2000 <= index < 0x6000 and data_type in (5, 6, 7):
            value = bench.read(index, sub)
            assert bench.write(index, sub, value, SIZES[data_type]) in (0, VALUE)
            assert bench.read(index, sub) == value


@pytest.mark.parametrize("name", WITH_TORQUE)
def test_only_mappable_objects_are_mapped(eds_bench, name):
    bench, objects = eds_bench(eds_path(name)), sections(eds_path(name))
    assert bench.write(0x1A00, 0, 0, 1) in (0, 0x08000022)
    cob_id = bench.read(0x1800, 1)
    assert bench.write(0x1800, 1, cob_id | 0x8000_0000, 4) == 0
    assert bench.write(0x1A00, 0, 0, 1) == 0
    tried = set()
    for (index, sub), (data_type, access, mappable) in objects.items():
        if index >= 0x6000 and data_type in (2, 3, 4, 5, 6, 7):
            entry = index << 16 | sub << 8 | 8 * SIZES[data_type]
            may = bool(mappable) and access in ("ro", "rw", "rwr", "const")
            assert bench.write(0x1A00, 1, entry, 4) == (0 if may else NOT_MAPPABLE), f"{index:04X}"
            tried.add(may)
    assert tried == {True, False}


@pytest.mark.parametrize("name", WITH_TORQUE)
def test_a_drive_with_torque_mode_turns(eds_bench, name):
    bench = eds_bench(eds_path(name))
    assert bench.read(0x6502) & 0x200
    # The mapping of the file, in the order of a good master: off, count, entries, count, type, on.
    for com, mapping, cob_id, entries in (
        (0x1400, 0x1600, 0x205, (0x60400010, 0x60710010)),
        (0x1800, 0x1A00, 0x4000_0185, (0x60410010, 0x60640020, 0x60770010)),
    ):
        for later in range(com + 1, com + 4):
            bench.write(later, 1, 0x8000_0000 | cob_id + 0x100 * (later - com), 4)
        assert bench.write(com, 1, 0x8000_0000 | cob_id, 4) == 0
        assert bench.write(mapping, 0, 0, 1) == 0
        for sub, entry in enumerate(entries, 1):
            assert bench.write(mapping, sub, entry, 4) == 0
        assert bench.write(mapping, 0, len(entries), 1) == 0
        assert bench.write(com, 2, 1, 1) == 0
        if com == 0x1800:
            bench.write(com, 3, 0, 2)
        assert bench.write(com, 1, cob_id, 4) == 0
    assert bench.write(0x6060, 0, 10, 1) == 0
    bench.nmt(1)
    bench.enable()
    bench.drive(300)
    assert bench.drive(300)[2] == 300
    assert bench.logged_torque() == (pytest.approx(0.15), True)


@pytest.mark.parametrize("name", WITHOUT_TORQUE)
def test_a_drive_without_torque_mode_ignores_torque(eds_bench, name):
    bench = eds_bench(eds_path(name))
    assert not bench.read(0x6502) & 0x200
    assert bench.write(0x6060, 0, 10, 1) == VALUE


TORQUE = """
1000 u32 ro 0x20192
1018:0 u8 ro 2
1018:1 u32 ro 0xABC
1018:2 u32 ro 0
6040 u16 rww - *
6041 u16 ro - *
6060 i8 rw 0
6071 i16 rww - *
6502 u32 ro -
"""


def test_values_of_the_file_are_used(made_of):
    bench = made_of(
        TORQUE + "6072 u16 rw 0\n6076 u32 ro 999\n6080 u32 rw 1234\n3000:0 u8 ro -\n"
        "3000:1 i16 rw 0xFFFE\n3000:2 u8 rw 7\n3001 text ro\tCrane\n"
    )
    assert bench.read(0x1018, 1) == 0xABC
    assert bench.read(0x1018, 2) == 0
    assert bench.read(0x6502) == 0x200  # not in the file, which has a target torque
    assert bench.read(0x6072) == bench.node._peak_per_mille  # zero means no limit
    assert bench.read(0x6080) == 1234
    assert bench.read(0x6076) == 500  # of the profile's motor
    assert bench.read(0x3000) == 2
    assert bench.read(0x3000, 1, signed=True) == -2
    assert bench.write(0x3000, 1, 5, 2) == 0
    assert bench.write(0x3000, 1, 5, 4) == 0x06070010
    assert bench.read(0x3000, 1) == 5
    bench.nmt(129)
    assert bench.read(0x3000, 1, signed=True) == -2


def test_limits_of_the_file_apply(eds_bench, tmp_path):
    text = eds_text(TORQUE + "6072 u16 rw 100\n607E u8 rw 0\n")
    text = text.replace("DefaultValue=100", "DefaultValue=100\nLowLimit=10\nHighLimit=1000")
    (tmp_path / "a.eds").write_text(text)
    bench = eds_bench(tmp_path / "a.eds")
    assert [bench.write(0x6072, 0, value, 2) for value in (9, 10, 1000, 1001)] == [
        VALUE,
        0,
        0,
        VALUE,
    ]


def test_a_limit_too_small_for_a_node_is_ignored(eds_bench):
    bench = eds_bench(eds_path("elmo_gold"))
    assert bench.write(0x1016, 1, 100 << 16 | 50, 4) == 0
    assert bench.read(0x1016, 1) == 100 << 16 | 50


PDOS = """
1400:0 u8 ro 2
1400:1 u32 rw $NODEID+0x200
1400:2 u8 rw 255
1600:0 u8 rw 1
1600:1 u32 rw 0x60400010
1600:2 u32 rw 0
1800:0 u8 ro 3
1800:1 u32 rw $NODEID+0x180
1800:2 u8 rw 1
1800:3 u16 rw 15
1A00:0 u8 ro 1
1A00:1 u32 ro 0x60410010
"""


def test_pdos_are_those_of_the_file(made_of):
    bench = made_of(TORQUE + PDOS)
    assert bench.read(0x1400, 1) == 0x200 + NODE
    assert abort(bench, 0x1401, 1) == ABSENT
    assert abort(bench, 0x1400, 5) == NO_SUB
    assert bench.write(0x1A00, 0, 0, 1) == READ_ONLY
    assert bench.write(0x1400, 1, 0x8000_0205, 4) == 0
    assert bench.write(0x1600, 0, 3, 1) == PDO_LENGTH  # at most two


def test_the_inhibit_time_delays_synchronous_pdos(made_of):
    bench = made_of(TORQUE + PDOS)

    def sent(count):
        bench.sent.clear()
        bench.wait(count, sync=True)
        return sum(can_id == 0x185 for can_id, _ in bench.sent)

    bench.nmt(1)
    assert sent(20) == 10  # 1.5 ms at 1 ms between two SYNCs
    bench.nmt(128)
    assert bench.write(0x1800, 1, 0x8000_0185, 4) == 0
    assert bench.write(0x1800, 3, 0, 2) == 0
    assert bench.write(0x1800, 1, 0x185, 4) == 0
    bench.nmt(1)
    assert sent(20) == 20


def test_objects_declared_at_once_exist(eds_bench, tmp_path):
    path = tmp_path / "compact.eds"
    path.write_text(
        eds_text(TORQUE)
        + "\n[1016]\nParameterName=Watched\nObjectType=8\nDataType=7\nAccessType=rw\n"
        "CompactSubObj=3\n"
    )
    bench = eds_bench(path)
    assert bench.read(0x1016) == 3
    assert [bench.write(0x1016, sub, (50 + sub) << 16 | 50, 4) for sub in (1, 2, 3)] == [0, 0, 0]
    assert abort(bench, 0x1016, 4) == NO_SUB


def test_identity_may_be_in_the_head_of_a_file(made_of):
    bench = made_of(
        TORQUE.replace("0xABC", "0"), device="VendorNumber=007\nProductNumber=0x1B\nBaudRate_10=1"
    )
    assert (bench.read(0x1018, 1), bench.read(0x1018, 2)) == (7, 0x1B)


def test_an_unreadable_file_is_refused_with_a_sentence(eds_bench, tmp_path):
    with pytest.raises(DeviceError, match=r"none\.eds: cannot be read"):
        eds_bench(tmp_path / "none.eds")
