"""EDS files for tests: those that state the facts of public ones, and others from a short table."""

from pathlib import Path

FILES = Path(__file__).parents[1] / "data" / "eds"
WITH_TORQUE = ("elmo_gold", "epos4_0110", "epos4_0170", "e35")
"""Drives that have cyclic synchronous torque mode; elmo_gold and epos4_0170 do not state it."""
WITHOUT_TORQUE = ("elmo_simpliq", "pilz_prbt", "schunk", "ros_slave", "ipos")

TYPES = {"b": 1, "i8": 2, "i16": 3, "i32": 4, "u8": 5, "u16": 6, "u32": 7, "text": 9}


def eds_path(name: str) -> Path:
    """Path of a file of tests/data/eds, by the name of its drive."""
    return FILES / f"{name}.eds"


def eds_text(table: str, device: str = "VendorName=A vendor\nBaudRate_1000=1") -> str:
    """Text of an EDS file from lines of index[:sub], type, access, default and, if mappable, *.

    A default of - is none. Sub-indices become a record.
    """
    parts = [f"[DeviceInfo]\n{device}"]
    seen = set()
    for line in filter(None, map(str.strip, table.splitlines())):
        address, kind, access, default, *mappable = line.split()
        index, colon, sub = address.partition(":")
        title = f"{index}sub{sub}" if colon else index
        if colon and index not in seen:
            parts.append(f"[{index}]\nParameterName=Object {index}\nObjectType=0x9")
        seen.add(index)
        lines = [
            f"[{title}]\nParameterName=Object {address}\nObjectType=0x7",
            f"DataType=0x{TYPES[kind]:04X}\nAccessType={access}\nPDOMapping={len(mappable)}",
        ]
        if default != "-":
            lines.append(f"DefaultValue={default}")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


COMPLETE = """
    1000 u32 ro 0x20192
    1005 u32 rw 0x80
    1006 u32 rw 0
    1008 text const Drive
    1014 u32 rw $NODEID+0x80
    1016:0 u8 ro 1
    1016:1 u32 rw 0
    1017 u16 rw 0
    1018:0 u8 ro 2
    1018:1 u32 ro 0x9A
    1018:2 u32 ro 7
    1029:0 u8 ro 1
    1029:1 u8 rw 0
    1400:0 u8 ro 2
    1400:1 u32 rw $NODEID+0x200
    1400:2 u8 rw 255
    1600:0 u8 rw 1
    1600:1 u32 rw 0x60400010
    1600:2 u32 rw 0
    1800:0 u8 ro 3
    1800:1 u32 rw $NODEID+0x40000180
    1800:2 u8 rw 255
    1800:3 u16 rw 0
    1A00:0 u8 rw 1
    1A00:1 u32 rw 0x60410010
    1A00:2 u32 rw 0
    1A00:3 u32 rw 0
    6007 i16 rw 1
    603F u16 ro 0
    6040 u16 rww 0 *
    6041 u16 ro 0 *
    6060 i8 rww 0 *
    6061 i8 ro 0 *
    6064 i32 ro 0 *
    6071 i16 rww 0 *
    6072 u16 rw 1000
    6076 u32 rw 5
    6077 i16 ro 0 *
    6080 u32 rw 3000
    60B2 i16 rww 0 *
    60C2:0 u8 ro 2
    60C2:1 u8 rw 1
    60C2:2 i8 rw -3
    6502 u32 ro 0x200
"""
"""A drive that has all that rigd works with."""


def without(*addresses: str) -> str:
    """The complete table without some objects, given as in the table."""
    lines = COMPLETE.splitlines()
    remaining = [
        line for line in lines if not line.strip().startswith(tuple(p + " " for p in addresses))
    ]
    assert len(remaining) == len(lines) - len(addresses)
    return "\n".join(remaining)


def changed(address: str, line: str) -> str:
    """The complete table with another line for an object: type, access, default and *."""
    return f"{without(address)}\n{address} {line}"
