"""Electronic data sheets (EDS and DCF files, CiA 306): what a drive has, as its vendor's file says.

Real files have what the canopen library refuses: byte order marks, keys in lower case, sections
given twice or out of order, empty values, octal numbers, missing names. :func:`_put_right` corrects
all of it. A file that the library accepts is read with the same result, but without importing the
library, which takes longer than reading a file.
"""

import re
import stat
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rigd.errors import FailureError
from rigd.printable import printable

MAX_BYTES: Final = 4_000_000
"""Largest file: the largest that vendors publish have a quarter of it."""
MAX_ENTRIES: Final = 20_000
"""Most objects and sub-indices: five times what the largest drives have."""

_MOST_SHOWN: Final = 80
"""Characters of a text of the file."""

_BIT_RATES_KBIT_S: Final = (10, 20, 50, 125, 250, 500, 800, 1000)
_ARRAY, _RECORD = 0x8, 0x9
_BITS: Final = {
    0x01: 1, 0x02: 8, 0x03: 16, 0x04: 32, 0x05: 8, 0x06: 16, 0x07: 32, 0x08: 32,
    0x10: 24, 0x11: 64, 0x12: 40, 0x13: 48, 0x14: 56, 0x15: 64,
    0x16: 24, 0x18: 40, 0x19: 48, 0x1A: 56, 0x1B: 64,
}  # fmt: skip
"""Lengths of the basic data types (CiA 301)."""
_SIGNED: Final = frozenset((0x02, 0x03, 0x04, 0x10, 0x12, 0x13, 0x14, 0x15))
_TEXTS: Final = (0x09, 0x0B)
_OCTETS, _DOMAIN = 0x0A, 0x0F
_FRACTIONS: Final = {0x08: "<f", 0x11: "<d"}
_LAST_BASIC_TYPE: Final = 0x1B
_ACCESS: Final = ("ro", "rw", "wo", "const", "rwr", "rww")

_OBJECT = re.compile(r"[0-9A-F]{4}", re.IGNORECASE)
_MEMBER = re.compile(r"([0-9A-F]{4})sub([0-9A-F]{1,2})", re.IGNORECASE)
_QUOTED = re.compile(r"""(?s)^(["'])(.*)\1$""")
"""Some editors quote every value."""
_YES: Final = ("true", "yes", "on")
_NODE_ID = re.compile(r"\+?\$NODEID\+?", re.IGNORECASE)
_NUMBER = re.compile(r"[+-]?(0x[0-9a-f]{1,32}|[0-9]{1,32})", re.IGNORECASE)

Sections = dict[str, dict[str, str]]
"""Keys and values of a file, by the names of its sections; both in lower case."""


class EdsError(FailureError, ValueError):
    """A file cannot be used as an EDS; the message is one sentence that names it."""


@dataclass(frozen=True, slots=True)
class EdsEntry:
    """One object, or one sub-index of one, as the file describes it."""

    index: int
    """Index of the object."""
    sub: int
    """Sub-index; 0 for a plain variable."""
    name: str
    """As the file has it."""
    data_type: int
    """Data type by CiA 301: 0x0006 is UNSIGNED16; 0: not stated."""
    access: str
    """``ro``, ``rw``, ``wo``, ``const``, ``rwr`` or ``rww``."""
    mappable: bool
    """Into a PDO."""
    default: int | None
    """Value after power-up, or the one that a DCF sets; None: not stated, or no integer."""
    low: int | None
    """Least value; None: not stated."""
    high: int | None
    """Largest value; None: not stated."""
    content: bytes = b""
    """The default where it is a text, a block or a fraction, as the drive holds it; empty: not
    stated."""

    @property
    def writable(self) -> bool:
        """Whether the drive takes a value."""
        return "w" in self.access

    @property
    def bits(self) -> int | None:
        """Length of the value; None for a text or block, or if no type is stated."""
        return _BITS.get(self.data_type)


@dataclass(frozen=True, slots=True)
class Eds:
    """Content of a drive's EDS or DCF file."""

    path: Path
    """The file."""
    node_id: int
    """Node number for which the file was read."""
    vendor_name: str
    """As the file has it."""
    vendor_id: int
    """Value of object 1018:1; 0: not stated."""
    product_name: str
    """As the file has it."""
    product_code: int
    """Value of object 1018:2; 0: not stated."""
    revision: int
    """Value of object 1018:3; 0: not stated."""
    bit_rates_bit_s: tuple[int, ...]
    """Bit rates that the drive supports; empty: not stated."""
    commissioned_node_id: int
    """Node number of the one drive that a DCF configures; 0: not stated."""
    entries: Mapping[tuple[int, int], EdsEntry]
    """By index and sub-index; a plain variable has the sub-index 0."""

    def get(self, index: int, sub: int = 0) -> EdsEntry | None:
        """Return an object, or None where the file has none.

        Parameters
        ----------
        index, sub
            Index and sub-index of the object.
        """
        return self.entries.get((index, sub))

    def has(self, index: int) -> bool:
        """Whether the file has an object, or any sub-index of it."""
        return any((index, sub) in self.entries for sub in range(256))


def read_eds(path: Path, node_id: int = 1) -> Eds:
    """Read an EDS or DCF file.

    Parameters
    ----------
    path
        Path of the EDS or DCF file.
    node_id
        Node number of the drive: the value of ``$NODEID`` in the file.

    Returns
    -------
    Eds

    Raises
    ------
    EdsError
        If there is no such file, it is too large, or no EDS.
    """
    sections = _sections(_text(path), path)
    device = sections.get("deviceinfo", {})
    entries = {(e.index, e.sub): e for e in _entries(_put_right(sections, path), sections, node_id)}
    if not entries:
        raise EdsError(f"{path}: is not an EDS file: it describes no object of a drive.")
    return Eds(
        path=path,
        node_id=node_id,
        vendor_name=_shown(device.get("vendorname", "")),
        vendor_id=_identity(entries, 1, device.get("vendornumber", "")),
        product_name=_shown(device.get("productname", "")),
        product_code=_identity(entries, 2, device.get("productnumber", "")),
        revision=_identity(entries, 3, device.get("revisionnumber", "")),
        bit_rates_bit_s=tuple(
            1000 * rate for rate in _BIT_RATES_KBIT_S if _is_set(device.get(f"baudrate_{rate}", ""))
        ),
        commissioned_node_id=_commissioned(sections),
        entries=entries,
    )


def _commissioned(sections: Sections) -> int:
    # The first spelling is CiA 306's.
    for title in ("devicecomissioning", "devicecommissioning"):
        node_id = _integer(sections.get(title, {}).get("nodeid", ""))
        if 1 <= node_id <= 127:
            return node_id
    return 0


def _text(path: Path) -> str:
    """Return the text of a file of reasonable size, whatever its encoding."""
    try:
        # Opened before its kind is known, a pipe would be waited for.
        found = path.stat()
        if stat.S_ISDIR(found.st_mode):
            raise EdsError(f"{path}: is a folder; name the EDS file in it.")
        if not stat.S_ISREG(found.st_mode):
            raise EdsError(f"{path}: is not an ordinary file; name the drive's EDS file.")
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except EdsError:  # a ValueError too
        raise
    except OSError as error:
        raise EdsError(f"{path}: cannot be read ({error.strerror}).") from error
    except ValueError as error:  # a NUL in the name
        raise EdsError(f"{str(path)!r}: cannot be read ({error}).") from error
    if len(data) > MAX_BYTES:
        raise EdsError(
            f"{path}: has more than {MAX_BYTES / 1e6:g} MB, which no EDS file of a drive has."
        )
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        text = data.decode("utf-16", errors="replace")
    else:
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = data.decode("cp1252", errors="replace")
    if "\0" in text:
        raise EdsError(f"{path}: is not an EDS file: it is not text.")
    if text.lstrip().startswith("<"):
        raise EdsError(
            f"{path}: is XML (an XDD file, or ESI of EtherCAT), not an EDS file; "
            "ask the vendor for the drive's EDS of CANopen."
        )
    return text


def _sections(text: str, path: Path) -> Sections:
    """Parse a file into sections; lines that are neither section nor key are ignored.

    If a section or key is given twice, the first one counts.
    """
    sections: Sections = {}
    keys: dict[str, str] = {}
    for line in map(str.strip, text.splitlines()):
        if not line or line[0] in ";#":
            continue
        if line[0] == "[":
            title, bracket, _ = line[1:].partition("]")
            # Without its end it is not a section, and what follows belongs to none.
            keys = sections.setdefault(title.strip().lower(), {}) if bracket else {}
            if len(sections) > MAX_ENTRIES:
                raise _too_many(path)
            continue
        key, equals, value = line.partition("=")
        if equals:
            # A comment may follow after white space, as canopen has it.
            bare = _QUOTED.sub(r"\2", re.split(r"\s;", value, maxsplit=1)[0].strip())
            keys.setdefault(key.strip().lower(), bare.strip())
    return sections


def _too_many(path: Path) -> EdsError:
    return EdsError(
        f"{path}: describes more than {MAX_ENTRIES} objects, which no EDS file of a drive does."
    )


def _put_right(sections: Sections, path: Path) -> dict[tuple[int, int], Mapping[str, str]]:
    """Return the keys of each object, or sub-index of one, that holds a value.

    In the order of the indices, also those that an array declares together (``CompactSubObj``).
    Name, type and access rights are those of the whole object where a sub-index has none.
    """
    members: dict[int, dict[int, dict[str, str]]] = {}
    for title, keys in sections.items():
        if match := _MEMBER.fullmatch(title):
            members.setdefault(int(match[1], 16), {}).setdefault(int(match[2], 16), keys)
        elif _OBJECT.fullmatch(title):
            members.setdefault(int(title, 16), {})
    right: dict[tuple[int, int], Mapping[str, str]] = {}
    for index, subs in sorted(members.items()):
        title = f"{index:04x}"
        keys = _with_values(sections.get(title, {}))
        for sub, compact in _compact_members(title, sections):
            subs.setdefault(sub, compact)
        # Neither a kind that is missing nor a wrong one makes members disappear.
        kind = _integer(keys.get("objecttype", ""))
        if not subs and kind in (_ARRAY, _RECORD) and "datatype" not in keys:
            continue  # nothing of it is described
        name = keys.get("parametername") or title.upper()
        shared = {"parametername": name}
        if not subs:
            right[index, 0] = shared | keys
        shared |= {key: keys[key] for key in ("datatype", "accesstype") if key in keys}
        for sub in sorted(subs):
            right[index, sub] = shared | _with_values(subs[sub])
        if len(right) > MAX_ENTRIES:
            raise _too_many(path)
    return right


def _with_values(keys: Mapping[str, str]) -> dict[str, str]:
    return {key: value for key, value in keys.items() if value}


def _compact_members(title: str, sections: Sections) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the sub-indices that an object declares together, with their own names and values."""
    shared = dict(sections.get(title, {}))
    count = _integer(shared.pop("compactsubobj", ""))
    if not 0 < count < 255:
        return
    names, values = (sections.get(title + end, {}) for end in ("name", "value"))
    yield (
        0,
        {
            "parametername": "Number of entries",
            "datatype": "0x0005",
            "accesstype": "ro",
            "defaultvalue": str(count),
        },
    )
    for sub in range(1, count + 1):
        own = {"parametername": names.get(str(sub), ""), "parametervalue": values.get(str(sub), "")}
        yield sub, shared | {key: value for key, value in own.items() if value}


def _entries(
    right: Mapping[tuple[int, int], Mapping[str, str]], sections: Sections, node_id: int
) -> Iterator[EdsEntry]:
    """Interpret the objects of a file that has been put right."""
    for (index, sub), keys in right.items():
        data_type = _data_type(keys, sections)
        value: int | bytes | None = None
        # The value that a DCF sets comes before the default, unless it is none.
        for key in ("parametervalue", "defaultvalue"):
            if value is None and key in keys:
                value = _value(keys[key], data_type, node_id)
        access = keys.get("accesstype", "").lower()
        yield EdsEntry(
            index=index,
            sub=sub,
            name=_shown(keys["parametername"]),
            data_type=data_type,
            access=access if access in _ACCESS else "rw",
            mappable=_is_set(keys.get("pdomapping", "")),
            default=value if isinstance(value, int) else None,
            low=_signed(_whole(keys.get("lowlimit", "")), data_type),
            high=_signed(_whole(keys.get("highlimit", "")), data_type),
            content=value if isinstance(value, bytes) else b"",
        )


def _data_type(keys: Mapping[str, str], sections: Sections) -> int:
    data_type = _integer(keys.get("datatype", ""))
    if data_type > _LAST_BASIC_TYPE:
        # Tools define their own type for a number with limits, as an object whose sub-index 1
        # names the basic type.
        basic = sections.get(f"{data_type:x}sub1", {}).get("defaultvalue", "")
        data_type = _integer(basic)
        if not 0 < data_type <= _LAST_BASIC_TYPE:
            data_type = _DOMAIN
    return max(data_type, 0)


def _value(text: str, data_type: int, node_id: int) -> int | bytes | None:
    """Return a number, or what else the drive holds as its bytes; None of what is neither."""
    try:
        if data_type in _TEXTS:
            return text.encode("utf-8", errors="replace")
        if data_type in (_OCTETS, _DOMAIN):
            return bytes.fromhex(text)
        if data_type in _FRACTIONS:
            return struct.pack(_FRACTIONS[data_type], float(text))
    except (ValueError, OverflowError):
        return None
    # An identifier may stand as $NODEID+0x180.
    rest, relative = _NODE_ID.subn("", text.replace(" ", ""))
    number = 0 if relative and not rest else _whole(rest)
    if number is None:
        return None
    return _signed(number + node_id if relative else number, data_type)


def _signed(number: int | None, data_type: int) -> int | None:
    """Return a number below zero that is written as a positive hexadecimal one."""
    if number is not None and data_type in _SIGNED and number >> _BITS[data_type] - 1 == 1:
        return number - (1 << _BITS[data_type])
    return number


def _identity(entries: Mapping[tuple[int, int], EdsEntry], sub: int, stated: str) -> int:
    """Return what 1018 shows of itself: as the object says, else as the head of the file does."""
    entry = entries.get((0x1018, sub))
    value = (entry.default if entry else None) or _integer(stated)
    return value if 0 <= value < 0xFFFF_FFFF else 0  # all bits set is how some say nothing


def _integer(text: str) -> int:
    """Return a number as :func:`_whole` does; 0 of anything else."""
    return _whole(text) or 0


def _is_set(text: str) -> bool:
    """Whether a flag is set: 1 in CiA 306's notation, TRUE in that of some tools."""
    return text.lower() in _YES or _integer(text) != 0


def _whole(text: str) -> int | None:
    """Return a number in CiA 306's notation: 0x1F, 31, or octal 037; None of anything else."""
    match = _NUMBER.fullmatch(text.strip())
    if match is None:
        return None
    digits = match[0].lower()
    octal = re.fullmatch(r"([+-]?)0([0-7]+)", digits)
    if octal:
        return int(octal[1] + octal[2], 8)
    return int(digits, 16) if "x" in digits else int(digits)


def _shown(text: str) -> str:
    """Return a text of the file as messages may show it: one line, printable, not too long."""
    return printable(" ".join(text.split()), _MOST_SHOWN)
