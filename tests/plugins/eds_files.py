"""EDS files for tests: those that state the facts of public ones, and others from a short table."""

from pathlib import Path

FILES = Path(__file__).parents[1] / "data" / "eds"
WITH_TORQUE = ("elmo_gold", "epos4_0110", "epos4_0170", "e35")
"""Drives that have cyclic synchronous torque mode; elmo_gold and epos4_0170 do not tell it."""
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
        place, kind, access, default, *mappable = line.split()
        index, colon, sub = place.partition(":")
        title = f"{index}sub{sub}" if colon else index
        if colon and index not in seen:
            parts.append(f"[{index}]\nParameterName=Object {index}\nObjectType=0x9")
        seen.add(index)
        lines = [
            f"[{title}]\nParameterName=Object {place}\nObjectType=0x7",
            f"DataType=0x{TYPES[kind]:04X}\nAccessType={access}\nPDOMapping={len(mappable)}",
        ]
        if default != "-":
            lines.append(f"DefaultValue={default}")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"
