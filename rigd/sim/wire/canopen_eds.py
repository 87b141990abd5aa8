"""A simulated node's objects as the maker's EDS or DCF file describes them."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from struct import calcsize
from typing import Final

from rigd.devices.contracts import DeviceError
from rigd.devices.eds import EdsEntry, EdsError, read_eds
from rigd.sim.wire.canopen_objects import Description

_FIRST_INDEX = 0x1000
"""Below it stand types and dummies, which nobody can read."""
_IDENTITY = 0x1018
_WATCHED, _ONE_NODE = 0x1016, 0x1_0000

_BOOLEAN: Final = 0x01
_KINDS: Final = {
    0x00: "I",  # where no type is told
    _BOOLEAN: "B",
    0x02: "b",
    0x03: "h",
    0x04: "i",
    0x05: "B",
    0x06: "H",
    0x07: "I",
    0x15: "q",
    0x1B: "Q",
}
"""Letters of :mod:`struct` for the numbers of CiA 301; the rest is kept as bytes."""
_TIMES: Final = {0x0C: 6, 0x0D: 6}
"""Bytes of time of day and of time difference."""
_SDO_ACCESS: Final = {"const": "ro", "rwr": "rw", "rww": "rw"}
_PDO_DIRECTIONS: Final = {"ro": "t", "const": "t", "wo": "r", "rwr": "t", "rww": "r"}


@dataclass(frozen=True, slots=True)
class DeviceFile:
    """What stands in such a file."""

    name: str
    entries: Mapping[tuple[int, int], Description]
    """By index and sub-index."""

    def numbers(self, first: int, last: int) -> Iterator[int]:
        """Yield how far behind the first one the indices of this range are that there are."""
        for index in range(first, last + 1):
            if any(key in self.entries for key in ((index, 0), (index, 1))):
                yield index - first

    def subs(self, index: int) -> int:
        """Return how many sub-indices an object has, from 1 on without a gap."""
        sub = 0
        while (index, sub + 1) in self.entries:
            sub += 1
        return sub


def read_device(path: Path, node_id: int) -> DeviceFile:
    """Read a file for a device that is to have this node id.

    Raises
    ------
    DeviceError
        If it cannot be read, or is no such file.
    """
    try:
        eds = read_eds(path, node_id)
    except EdsError as error:
        raise DeviceError(f"The simulated drive cannot be made: {error}") from None
    entries = {
        key: _described(entry) for key, entry in eds.entries.items() if key[0] >= _FIRST_INDEX
    }
    for sub, number in enumerate((eds.vendor_id, eds.product_code, eds.revision), 1):
        said = entries.get((_IDENTITY, sub))
        if said is not None and not said.default:
            entries[_IDENTITY, sub] = replace(said, default=number)
    highest: dict[int, int] = {}
    for index, sub in entries:
        highest[index] = max(sub, highest.get(index, 0))
    for index, last in highest.items():
        said = entries.get((index, 0))
        if last and said is not None and said.default is None and said.kind == "B":
            entries[index, 0] = replace(said, default=last)
    return DeviceFile(path.name, entries)


def _described(entry: EdsEntry) -> Description:
    """Return what the file says of an object, in the terms of a simulated node."""
    access = _SDO_ACCESS.get(entry.access, entry.access)
    kind = _KINDS.get(entry.data_type)
    if kind is None:
        size = _TIMES.get(entry.data_type) or (entry.bits or 0) // 8
        return Description("s", access, "", text=_bytes(entry, size), fixed=size > 0)
    boolean = entry.data_type == _BOOLEAN
    # A boolean takes one bit in a PDO, which nobody needs here.
    mappable = entry.mappable and not boolean
    directions = _PDO_DIRECTIONS.get(entry.access, "rt") if mappable else ""
    low, high = entry.low, 1 if boolean else entry.high
    if low is not None and high is not None and low >= high:  # as tools write that know none
        low = high = None
    if entry.index == _WATCHED and high is not None and high < _ONE_NODE:
        low = high = None  # some files limit the time in its lower half and forget the node above
    default = None if entry.default is None else _fitted(entry.default, kind)
    return Description(kind, access, directions, default, low, high)


def _fitted(value: int, kind: str) -> int:
    """Return a value as its type holds it: files write negative ones as unsigned, too."""
    bits = 8 * calcsize("<" + kind)
    value &= (1 << bits) - 1
    return value - (1 << bits) if kind.islower() and value >> (bits - 1) else value


def _bytes(entry: EdsEntry, size: int) -> bytes:
    """Return the default of what is kept as bytes, of a given size or, for 0, of its own."""
    data = entry.content
    if entry.default is not None and size:
        data = (entry.default & (1 << 8 * size) - 1).to_bytes(size, "little")
    return data[:size].ljust(size, b"\0") if size else data
