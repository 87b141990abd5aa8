"""What a CANopen device has, as the manufacturer's EDS or DCF file says (CiA 306).

Only what a simulated node needs of it: which objects there are, of which types, and what may be
done with them.
"""

import io
import logging
import re
import warnings
from collections.abc import Iterator, Mapping
from configparser import RawConfigParser
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from struct import calcsize, pack

import canopen
from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

from rigd.devices.contracts import DeviceError
from rigd.sim.wire.canopen_objects import Description

_MOST_BYTES = 8_000_000
_FIRST_INDEX = 0x1000
"""Below it stand types and dummies, which nobody can read."""
_IDENTITY = 0x1018

_KINDS = {
    datatypes.BOOLEAN: "B",
    datatypes.INTEGER8: "b",
    datatypes.INTEGER16: "h",
    datatypes.INTEGER32: "i",
    datatypes.INTEGER64: "q",
    datatypes.UNSIGNED8: "B",
    datatypes.UNSIGNED16: "H",
    datatypes.UNSIGNED32: "I",
    datatypes.UNSIGNED64: "Q",
}
# Kept as bytes: nobody computes with them here.
_SIZES = {
    datatypes.REAL32: 4,
    datatypes.REAL64: 8,
    datatypes.INTEGER24: 3,
    datatypes.INTEGER40: 5,
    datatypes.INTEGER48: 6,
    datatypes.INTEGER56: 7,
    datatypes.UNSIGNED24: 3,
    datatypes.UNSIGNED40: 5,
    datatypes.UNSIGNED48: 6,
    datatypes.UNSIGNED56: 7,
    datatypes.TIME_OF_DAY: 6,
    datatypes.TIME_DIFFERENCE: 6,
}
_SDO_ACCESS = {"const": "ro", "rwr": "rw", "rww": "rw"}
_PDO_DIRECTIONS = {"ro": "t", "const": "t", "wo": "r", "rwr": "t", "rww": "r"}
_OBJECT = re.compile(r"[0-9A-F]{4}(sub[0-9A-F]{1,2}|Name|Value)?", re.IGNORECASE)
_NUMBER = re.compile(r"0x[0-9a-f]{1,16}|[0-9]{1,16}")


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


def read_eds(path: Path, node_id: int) -> DeviceFile:
    """Read a file for a device that is to have this node id.

    Raises
    ------
    DeviceError
        If it cannot be read, or is no such file.
    """
    text = _text_of(path)
    try:
        parser = RawConfigParser(strict=False, inline_comment_prefixes=(";",))
        parser.optionxform = str  # type: ignore[assignment,method-assign]
        parser.read_string(text)
        identity = list(_numbers_of_the_device(parser))
        dictionary = _imported(parser, node_id)
        entries = {
            (variable.index, variable.subindex): _described(variable)
            for variable in _variables(dictionary, parser)
            if variable.index >= _FIRST_INDEX
        }
    except Exception as error:  # the library lets through whatever a file makes it stumble over
        told = " ".join(str(error).split())[:200]
        raise DeviceError(
            f"The EDS file {path} cannot be used ({type(error).__name__}: {told}); take the file "
            "from the drive's manufacturer as it is, or have it checked by an EDS editor."
        ) from None
    if not entries:
        raise DeviceError(
            f"The EDS file {path} describes no object; take the one from the drive's manufacturer."
        )
    for sub, number in enumerate(identity, 1):
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


def _text_of(path: Path) -> str:
    try:
        if not path.is_file():
            raise DeviceError(f"There is no EDS file {path}; check the name.")
        with path.open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise DeviceError(
            f"The EDS file {path} cannot be read ({error.strerror}); check the name."
        ) from None
    if len(data) > _MOST_BYTES:
        raise DeviceError(
            f"The EDS file {path} has more than {_MOST_BYTES // 1_000_000} MB; this is no "
            "description of a drive."
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")  # as many tools on Windows write


def _imported(parser: RawConfigParser, node_id: int) -> ObjectDictionary:
    """Have the library read the objects alone: it stumbles over what is odd in all the rest."""
    for section in parser.sections():
        if not _OBJECT.fullmatch(section):
            parser.remove_section(section)
    source = io.StringIO()
    parser.write(source)
    source.seek(0)
    source.name = "file.eds"  # by which the library tells the format
    logging.getLogger("canopen").addHandler(logging.NullHandler())  # what is odd is used as it is
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return canopen.import_od(source, node_id)


def _numbers_of_the_device(parser: RawConfigParser) -> Iterator[int]:
    """Yield vendor, product and revision as the head of the file has them, 0 where it does not."""
    for key in ("VendorNumber", "ProductNumber", "RevisionNumber"):
        told = parser.get("DeviceInfo", key, fallback="").strip().lower()
        number = int(told, 16 if told.startswith("0x") else 10) if _NUMBER.fullmatch(told) else 0
        yield number & 0xFFFF_FFFF


def _variables(dictionary: ObjectDictionary, parser: RawConfigParser) -> Iterator[ODVariable]:
    compact = {
        int(section, 16): int(parser.get(section, "CompactSubObj"), 0)
        for section in parser.sections()
        if len(section) == 4 and parser.has_option(section, "CompactSubObj")
    }
    for index, thing in dictionary.items():
        if isinstance(thing, ODVariable):
            yield thing
            continue
        yield from thing.values()
        for sub in range(1, min(compact.get(index, 0), 254) + 1):
            if sub not in thing.subindices:
                like = copy(thing[1])
                like.subindex = sub
                yield like


def _described(variable: ODVariable) -> Description:
    """Return what the library read, in the terms of a simulated node."""
    data_type = variable.data_type or datatypes.UNSIGNED32
    access = _SDO_ACCESS.get(variable.access_type, variable.access_type)
    if access not in ("ro", "wo"):
        access = "rw"
    value = variable.default if variable.value is None else variable.value
    kind = _KINDS.get(data_type)
    if kind is None:
        size = _SIZES.get(data_type)
        return Description("s", access, "", text=_bytes(value, size), fixed=size is not None)
    directions = _PDO_DIRECTIONS.get(variable.access_type, "rt")
    if not variable.pdo_mappable or data_type == datatypes.BOOLEAN:  # of one bit in a PDO
        directions = ""
    low, high = variable.min, 1 if data_type == datatypes.BOOLEAN else variable.max
    if low is not None and high is not None and low >= high:  # as tools write that know none
        low = high = None
    default = _fitted(value, kind) if isinstance(value, int) else None
    return Description(kind, access, directions, default, low, high)


def _fitted(value: int, kind: str) -> int:
    """Return a value as its type holds it: files write negative ones as unsigned, too."""
    bits = 8 * calcsize("<" + kind)
    value &= (1 << bits) - 1
    return value - (1 << bits) if kind.islower() and value >> (bits - 1) else value


def _bytes(value: object, size: int | None) -> bytes:
    """Return the default of what is kept as bytes, or as many zeros."""
    if isinstance(value, float) and size in (4, 8):
        return pack("<f" if size == 4 else "<d", value)
    if isinstance(value, int) and size is not None:
        return (value & (1 << 8 * size) - 1).to_bytes(size, "little")
    data = value.encode("utf-8") if isinstance(value, str) else value
    data = data if isinstance(data, bytes) else b""
    return data if size is None else data[:size].ljust(size, b"\0")
