"""EDS files of vendors and others: values read, and refusals."""

import io
import os
import subprocess
import sys
import time

import canopen
import pytest
from eds_files import WITH_TORQUE, WITHOUT_TORQUE, eds_path, eds_text
from hypothesis import example, given
from hypothesis import strategies as st

from rigd.devices import eds
from rigd.devices.eds import EdsError, read_eds

TABLE = """
    1000 u32 ro 0x00020192
    1018:0 u8 ro 2
    1018:1 u32 ro 0x9A
    1018:2 u32 ro 0x30923
    1400:0 u8 ro 2
    1400:1 u32 rw $NODEID+0x200
    1400:2 u8 rw 255
    6040 u16 rww 0 *
    6060 i8 rw 0xFD
    6064 i32 ro - *
    6071 i16 rwr 0xFC18 *
    6502 u32 const 01007
"""


@pytest.fixture
def read(tmp_path):
    def read(text, node_id=1):
        path = tmp_path / "drive.eds"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return read_eds(path, node_id)

    return read


def test_objects_and_identity_of_a_file(read):
    found = read(eds_text(TABLE, "VendorName=Ä vendor\nProductName=One\nBaudRate_500=1"), node_id=5)
    assert (found.vendor_name, found.product_name) == ("Ä vendor", "One")
    assert (found.vendor_id, found.product_code) == (0x9A, 0x30923)
    assert found.bit_rates_bit_s == (500_000,)
    assert found.get(0x1400, 1).default_value == 0x205
    assert found.get(0x6502).default_value == 0o1007
    torque = found.get(0x6071)
    assert (torque.default_value, torque.length_bit, torque.is_mappable, torque.is_writable) == (
        -1000,
        16,
        True,
        True,
    )
    assert found.get(0x6060).default_value == -3
    assert found.get(0x6064).default_value is None
    assert not found.get(0x6064).is_writable
    assert not found.get(0x6502).is_writable
    assert not found.get(0x6502).is_mappable
    assert found.get(0x6072) is None
    assert found.has_object(0x1400)
    assert found.get(0x1400, 3) is None
    assert not found.has_object(0x1401)


def test_the_head_has_the_identity_if_the_object_does_not(read):
    head = "VendorNumber=0x1A3\nProductNumber=7"
    found = read(eds_text("1018:1 u32 ro 0\n6040 u16 rw 0", head))
    assert (found.vendor_id, found.product_code) == (0x1A3, 7)


AS_OTHERS_WRITE = {
    "byte order mark": lambda text: "\ufeff" + text,
    "line ends of Windows": lambda text: text.replace("\n", "\r\n"),
    "line ends of old": lambda text: text.replace("\n", "\r"),
    "UTF-16": lambda text: text.encode("utf-16"),
    "keys in lower case": lambda text: "\n".join(
        line.partition("=")[0].lower() + "=" + line.partition("=")[2] if "=" in line else line
        for line in text.split("\n")
    ),
    "all in lower case": str.lower,
    "spaces everywhere": lambda text: text.replace("=", " = ").replace("\n", "  \n\t")
    .replace("[", "[ ").replace("]", " ]"),
    "comments": lambda text: "; one\n# two\n"
    + text.replace("AccessType=ro", "AccessType=ro ; yes"),
    "a section twice": lambda text: text + "\n[6040]\nDataType=0x2\n",
    "a key twice": lambda text: text
    + "\n[ManufacturerObjects]\n1=0x2000\n1=0x2001\n",
    "neither section nor key": lambda text: text + "\nnonsense\n=\n]x[\n[\n",
    "comments that lack lines": lambda text: text + "\n[Comments]\nLines=99\nLine1=x\n",
    "flags as words": lambda text: text.replace("PDOMapping=1", "PDOMapping=TRUE")
    .replace("PDOMapping=0", "PDOMapping=FALSE").replace("BaudRate_1000=1", "BaudRate_1000=TRUE"),
    "values in quotes": lambda text: "\n".join(
        "{}={}{}{}".format(*(key, mark, value, mark)) if value else line
        for line in text.split("\n")
        for key, _, value in [line.partition("=")]
        for mark in ["\"" if len(line) % 2 else "'"]
    ),
    "dummies without values": lambda text: text + "\n[DummyUsage]\nDummy0001=\n",
    "empty values": lambda text: text.replace(
        "PDOMapping=0", "PDOMapping=\nLowLimit=\nHighLimit=\nParameterValue=\nObjFlags="
    ),
    "no names": lambda text: "\n".join(
        line for line in text.split("\n") if not line.startswith("ParameterName")
    ),
    "no kinds": lambda text: "\n".join(
        line for line in text.split("\n") if not line.startswith("ObjectType")
    ),
    "a vendor's number with zeros": lambda text: text.replace(
        "[DeviceInfo]", "[DeviceInfo]\nVendorNumber=001"
    ),
    "sub-indices before their objects": lambda text: text.split("\n\n")[0] + "\n\n"
    + "\n\n".join(reversed(text.split("\n\n")[1:])),
    "sub-indices without their objects": lambda text: text.replace("[1018]", "[x]")
    .replace("[1400]", "[y]"),
    "no head": lambda text: text.replace("[DeviceInfo]", "[Nothing]"),
}  # fmt: skip


@pytest.mark.parametrize("change", AS_OTHERS_WRITE.values(), ids=AS_OTHERS_WRITE.keys())
def test_equal_content_in_different_notations(read, change):
    def facts(found):
        return {
            address: (e.length_bit, e.access_right, e.is_mappable, e.default_value)
            for address, e in found.entries.items()
        }

    text = eds_text(TABLE)
    changed = change(text)
    assert changed != text
    expected = facts(read(text, node_id=5))
    assert len(expected) == 12
    assert facts(read(changed, node_id=5)) == expected


def test_latin_letters(read):
    found = read(eds_text(TABLE, "VendorName=Müller").encode("latin-1"))
    assert found.vendor_name == "Müller"


def test_arrays_declared_at_once(read):
    found = read(
        "[1016]\nParameterName=Consumers\nObjectType=8\nDataType=7\nAccessType=rw\n"
        "DefaultValue=$NODEID+10\nCompactSubObj=3\n[1016Name]\nNrOfEntries=1\n2=The second\n"
        "[1016Value]\nNrOfEntries=1\n3=7\n",
        node_id=5,
    )
    assert sorted(found.entries) == [(0x1016, sub) for sub in range(4)]
    assert found.get(0x1016, 0).default_value == 3
    assert [found.get(0x1016, sub).default_value for sub in (1, 2, 3)] == [15, 15, 7]
    assert found.get(0x1016, 2).name == "The second"


def test_a_configured_drive_has_the_values_of_its_dcf(read):
    found = read("[6072]\nDataType=6\nAccessType=rw\nDefaultValue=5\nParameterValue=0x3E8\n")
    assert found.get(0x6072).default_value == 1000


def test_a_type_of_its_own_for_a_number_with_limits(read):
    found = read(
        "[A0]\n[A0sub1]\nDefaultValue=0x06\n[6072]\nDataType=0xA0\n[6073]\nDataType=0xA1\n"
    )
    assert found.get(0x6072).length_bit == 16
    assert found.get(0x6073).length_bit is None


@pytest.mark.parametrize("type_name", ["", "DataType=\n", "DataType=x\n", "DataType=0\n"])
def test_a_missing_type_is_none(read, type_name):
    entry = read(f"[6040]\n{type_name}AccessType=rw\nDefaultValue=0x10\nHighLimit=20\n").get(0x6040)
    assert (entry.data_type, entry.length_bit, entry.default_value, entry.upper_limit) == (
        0,
        None,
        16,
        20,
    )


def test_limits(read):
    found = read("[6060]\nDataType=2\nLowLimit=0xFF\nHighLimit=0x0A\n")
    assert (found.get(0x6060).lower_limit, found.get(0x6060).upper_limit) == (-1, 10)


def test_numbers_in_a_text_stay_as_they_are(read):
    found = read("[1009]\nDataType=9\nDefaultValue=V0.00.010 0x0F\n")
    assert found.get(0x1009).default_bytes == b"V0.00.010 0x0F"


@pytest.mark.parametrize(
    ("type_name", "number"),
    [("$NODEID", 5), ("0x180 + $nodeid", 0x185), ("$NODEID+0600", 0x185), ("$NODEID+x", None)],
)
def test_an_identifier_relative_to_the_node_id(read, type_name, number):
    assert (
        read(f"[1014]\nDataType=7\nDefaultValue={type_name}\n", 5).get(0x1014).default_value
        == number
    )


@pytest.mark.parametrize("name", WITH_TORQUE + WITHOUT_TORQUE)
def test_values_agree_with_the_library(name):
    """If the library reads a file unaided, all its values are preserved."""
    path = eds_path(name)
    found = read_eds(path, 5)
    expected = {}
    for item in canopen.import_od(str(path), 5).values():
        variables = [item] if hasattr(item, "data_type") else item.subindices.values()
        for v in variables:
            expected[v.index, v.subindex] = (v.name, v.data_type, v.access_type, v.pdo_mappable,
                                             v.default, v.min, v.max)  # fmt: skip
    assert expected == {
        address: (
            e.name,
            e.data_type,
            e.access_right,
            e.is_mappable,
            e.default_value,
            e.lower_limit,
            e.upper_limit,
        )
        for address, e in found.entries.items()
    }


NO_EDS = {
    "empty": b"",
    "a picture": b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR",
    "a text": b"Dear customer,\nthank you.\n",
    "a profile": b'name = "x"\n[rig]\nrate_hz = 1\n',
    "XML": b'<?xml version="1.0"?><ISO15745ProfileContainer/>',
    "noise": bytes(range(256)) * 100,
    "one line": b"a" * 3_000_000,
    "a section without end": b"[" + b" " * 3_000_000 + b"x",
    "too large": b"[6040]\nDataType=6\n" + b";\n" * 2_000_001,
    "too many": b"".join(b"[%04X]\nDataType=8\nCompactSubObj=254\n" % n for n in range(1000, 2000)),
    "too many sections": b"".join(b"[x%d]\n" % n for n in range(300_000)),
}


@pytest.mark.parametrize("content", NO_EDS.values(), ids=NO_EDS.keys())
def test_invalid_text_is_refused_in_a_sentence(read, tmp_path, content):
    start = time.process_time()
    with pytest.raises(EdsError) as error:
        read(content)
    assert time.process_time() - start < 10.0
    message = str(error.value)
    assert message.startswith(f"{tmp_path / 'drive.eds'}: ")
    assert message.endswith(".")
    assert "\n" not in message
    assert len(message) < 300


def test_special_files_are_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "pipe.eds")
    (tmp_path / "loop.eds").symlink_to("loop.eds")
    for name, words in {
        "none.eds": "No such file", ".": "is a folder", "pipe.eds": "not an ordinary file",
        "loop.eds": "cannot be read", "a\0b": "cannot be read",
    }.items():  # fmt: skip
        with pytest.raises(EdsError, match=words) as refused:
            read_eds(tmp_path / name)
        assert str(refused.value).count(name) == 1 or name in (".", "a\0b")


KEYS = ("ParameterName", "ObjectType", "DataType", "AccessType", "PDOMapping", "LowLimit",
        "HighLimit", "DefaultValue", "ParameterValue", "SubNumber", "CompactSubObj", "NrOfEntries",
        "1", "x")  # fmt: skip
VALUES = st.one_of(
    st.sampled_from(
        ("", "0", "1", "7", "8", "9", "0x8", "0xFFFFFFFFFF", "-1", "010", "08", "$NODEID+0x180",
         "$NODEID", "+$NODEID", "rw", "ro", "1e999", "9" * 5000, "0x" + "f" * 5000, "%(x)s", ";",
         "a ; b")
    ),
    st.integers().map(str),
    st.integers(0, 1 << 70).map(hex),
    st.text(max_size=8),
)  # fmt: skip
SECTIONS = st.one_of(
    st.sampled_from(
        ("6040", "1018", "1018sub1", "1018Sub0", "1018SUB1", "1018Name", "1018Value", "6040sub0",
         "A0", "A0sub1", "1000sub1", "DeviceInfo", "DeviceComissioning", "Comments", "DummyUsage",
         "FileInfo", "FFFF", "FFFFsubFF", "DEFAULT")
    ),
    st.text(max_size=8),
)  # fmt: skip


@given(
    st.lists(
        st.one_of(
            SECTIONS.map("[{}]".format),
            st.tuples(st.sampled_from(KEYS), VALUES).map("=".join),
            st.tuples(st.sampled_from(KEYS), VALUES).map("=".join),
            st.text(max_size=12),
        ),
        max_size=40,
    ),
    st.sampled_from(("utf-8", "utf-16", "utf-8-sig")),
)
@example(["[6040]", "DataType=0x1000", "[1000sub1]", "x=1"], "utf-8")
@example(["[6040]", "DataType=0xA0", "[A0sub1]", "DefaultValue=0xA0"], "utf-8")
@example(["[1000]", "CompactSubObj=9", "[1000Name]", "1="], "utf-8")
def test_garbage_is_read_or_refused(tmp_path_factory, lines, encoding):
    path = tmp_path_factory.getbasetemp() / "garbage.eds"
    path.write_bytes("\n".join(lines).encode(encoding, "surrogatepass"))
    try:
        found = read_eds(path, 127)
    except EdsError as error:
        assert str(path) in str(error)
        return
    for (index, sub), entry in found.entries.items():
        assert (entry.index, entry.subindex) == (index, sub)
        assert entry.access_right in ("ro", "rw", "wo", "const", "rwr", "rww")
        assert entry.name.isprintable()
        assert all(
            type(v) is int or v is None
            for v in (entry.default_value, entry.lower_limit, entry.upper_limit)
        )
    assert 0 <= found.vendor_id <= 0xFFFF_FFFF


@given(st.binary(max_size=200), st.integers(0, 3000), st.integers(0, 3000))
def test_a_damaged_file_is_read_or_refused(tmp_path_factory, noise, start, length):
    path = tmp_path_factory.getbasetemp() / "damaged.eds"
    data = eds_path("elmo_gold").read_bytes()
    path.write_bytes(data[:start] + noise + data[start + length :])
    try:
        read_eds(path)
    except EdsError as error:
        assert str(path) in str(error)


@pytest.mark.process
def test_no_output_and_no_wait_for_the_library(tmp_path):
    """Neither warnings on the terminal nor an import that takes longer than the file."""
    path = tmp_path / "bare.eds"
    path.write_text("[6040]\nDataType=0x99\nDefaultValue=x\n")
    code = (
        "import sys; from pathlib import Path; from rigd.devices.eds import read_eds; "
        f"assert read_eds(Path({str(path)!r})).get(0x6040); "
        "assert not {'canopen', 'can', 'numpy', 'pydantic'} & set(sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_real_files_refused_by_the_library(read):
    """Why files are corrected before: not needed once the library accepts them."""
    for text, error in (
        ("[6040]\nDataType=6\nParameterName=a\n", Exception),
        ("[DeviceInfo]\nVendorNumber=001\n", ValueError),
        ("[1]\na=1\na=2\n", Exception),
    ):
        file = io.StringIO(text)
        file.name = "x.eds"
        with pytest.raises(error):
            canopen.import_od(file)
    assert eds.MAX_FILE_BYTES > 1_000_000
