"""Manufacturer-specific objects that a profile sets: ``cia402.set_objects``.

Each assignment is one text, ``"3001:2 u32 2500"``: index and sub-index in hexadecimal as manuals
print them, the integer type, and the value in decimal or as 0x…. The objects are written in
pre-operational and read back.
"""

import re
from dataclasses import dataclass
from typing import Final

from rigd.devices.cia402.requirements import REQUIREMENTS, ObjectAccess

INTEGER_RANGES: Final = {
    "u8": (0, 0xFF),
    "u16": (0, 0xFFFF),
    "u32": (0, 0xFFFF_FFFF),
    "i8": (-0x80, 0x7F),
    "i16": (-0x8000, 0x7FFF),
    "i32": (-0x8000_0000, 0x7FFF_FFFF),
}
"""Lowest and highest value of each integer type that an assignment may name."""

_ASSIGNMENT_PATTERN: Final = re.compile(
    r"(?:0[xX])?([0-9a-fA-F]{4})(?::(?:0[xX])?([0-9a-fA-F]{1,2}))?\s+(\w+)\s+([+-]?\w+)"
)
"""Pattern of an assignment: index, optional sub-index, integer type, value."""
_PDO_INDICES: Final = range(0x1400, 0x1C00)
"""Indices of PDO parameters and mappings, which a profile may not set."""
_STORAGE_INDICES: Final = (0x1010, 0x1011, *range(0x1F50, 0x1F58))
"""Indices of objects that store or restore parameters or load firmware."""
_OBJECTS_SET_BY_RIGD: Final = {
    (each.index, each.subindex)
    for each in REQUIREMENTS
    if each.access & (ObjectAccess.WRITTEN_BY_SDO | ObjectAccess.RECEIVED_IN_RPDO)
}
"""Index and sub-index of each object that the driver itself writes."""


@dataclass(frozen=True, slots=True)
class Assignment:
    """Object of the drive that the profile sets, and the value to write to it."""

    index: int
    """Index of the object."""
    subindex: int
    """Sub-index of the object."""
    integer_type: str
    """Integer type of the value, one of :data:`INTEGER_RANGES`."""
    object_value: int
    """Value to write."""

    @property
    def address(self) -> str:
        """Index and sub-index of the object for messages, such as "6040:0"."""
        return f"{self.index:04X}:{self.subindex:X}"


def parse_assignment(assignment_text: str) -> Assignment:
    """Parse one text of ``cia402.set_objects`` into an assignment.

    Parameters
    ----------
    assignment_text
        ``index:sub type value``; index and sub-index in hexadecimal digits.

    Raises
    ------
    ValueError
        If the text is invalid; the message is the end of a sentence with error and remedy.

    Examples
    --------
    >>> parse_assignment("3001:2 u32 2500")
    Assignment(index=12289, subindex=2, integer_type='u32', object_value=2500)
    """
    pattern_match = _ASSIGNMENT_PATTERN.fullmatch(assignment_text.strip())
    if pattern_match is None:
        raise ValueError('must be index:sub, type and value, such as "3001:2 u32 2500"')
    index, subindex = int(pattern_match[1], 16), int(pattern_match[2] or "0", 16)
    integer_type = pattern_match[3]
    if integer_type not in INTEGER_RANGES:
        raise ValueError(
            f"has the unknown type {integer_type!r}; choose {', '.join(INTEGER_RANGES)}"
        )
    try:
        object_value = int(pattern_match[4], 0)
    except ValueError:
        raise ValueError(
            f"has a value that is not a whole number ({pattern_match[4]}); write 2500, -3 or 0x9C4"
        ) from None
    low, high = INTEGER_RANGES[integer_type]
    if not low <= object_value <= high:
        raise ValueError(f"has a value that {integer_type} does not hold ({low} to {high})")
    if (index, subindex) in _OBJECTS_SET_BY_RIGD or index in _PDO_INDICES:
        raise ValueError("is an object that rigd sets itself; remove it")
    if index in _STORAGE_INDICES:
        raise ValueError(
            "would have the drive store or restore its memory at every start; do that once with "
            "the drive's own tool"
        )
    return Assignment(index, subindex, integer_type, object_value)
