"""Electronic data sheets of drives (EDS and DCF files, CiA 306): their objects and identity.

Real files contain what the canopen library refuses: byte order marks, keys in lower case, sections
given twice or out of order, empty values, octal numbers, missing names. :func:`_correct_sections`
corrects them. A file that the library accepts is read with the same result, but without importing
the library, which takes longer than reading a file.
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

MAX_FILE_BYTES: Final = 4_000_000
"""Largest size of a file in bytes: four times the size of the largest that vendors publish."""
MAX_EDS_ENTRIES: Final = 20_000
"""Largest number of objects and sub-indices in a file: five times that of the largest drives."""

_MAX_SHOWN_CHARACTERS: Final = 80
"""Largest number of characters of a text from a file that messages show."""

_BIT_RATES_KBIT_S: Final = (10, 20, 50, 125, 250, 500, 800, 1000)
"""Bit rates of CANopen in kbit/s, for which an EDS file states whether the drive supports them."""
_ARRAY_OBJECT, _RECORD_OBJECT = 0x8, 0x9
"""Object types (CiA 301) of an array and of a record."""
_LENGTH_BIT_BY_TYPE: Final = {
    0x01: 1, 0x02: 8, 0x03: 16, 0x04: 32, 0x05: 8, 0x06: 16, 0x07: 32, 0x08: 32,
    0x10: 24, 0x11: 64, 0x12: 40, 0x13: 48, 0x14: 56, 0x15: 64,
    0x16: 24, 0x18: 40, 0x19: 48, 0x1A: 56, 0x1B: 64,
}  # fmt: skip
"""Length in bits of the basic data types (CiA 301)."""
_SIGNED_TYPES: Final = frozenset((0x02, 0x03, 0x04, 0x10, 0x12, 0x13, 0x14, 0x15))
"""Data types (CiA 301) of signed integers."""
_TEXT_TYPES: Final = (0x09, 0x0B)
"""Data types (CiA 301) of texts."""
_OCTET_STRING_TYPE, _DOMAIN_TYPE = 0x0A, 0x0F
"""Data types (CiA 301) of a string of bytes and of a block of data."""
_FLOAT_LAYOUT_BY_TYPE: Final = {0x08: "<f", 0x11: "<d"}
"""Layouts for :mod:`struct` of floating-point numbers, by data type (CiA 301)."""
_LAST_BASIC_TYPE: Final = 0x1B
"""Largest number of a basic data type (CiA 301); larger numbers are types defined in the file."""
_ACCESS_RIGHTS: Final = ("ro", "rw", "wo", "const", "rwr", "rww")
"""Access rights that an object can have."""

_OBJECT_TITLE_PATTERN = re.compile(r"[0-9A-F]{4}", re.IGNORECASE)
"""Pattern of the title of an object's section: its index."""
_SUB_INDEX_TITLE_PATTERN = re.compile(r"([0-9A-F]{4})sub([0-9A-F]{1,2})", re.IGNORECASE)
"""Pattern of the title of a sub-index's section: index and sub-index."""
_QUOTED_VALUE_PATTERN = re.compile(r"""(?s)^(["'])(.*)\1$""")
"""Pattern of a value in quotation marks, which some editors write around every value."""
_WORDS_FOR_TRUE: Final = ("true", "yes", "on")
"""Words that some tools write for a flag that is set."""
_NODE_ID_PLACEHOLDER_PATTERN = re.compile(r"\+?\$NODEID\+?", re.IGNORECASE)
"""Pattern of the placeholder for the node number in a value, with its plus sign."""
_INTEGER_PATTERN = re.compile(r"[+-]?(0x[0-9a-f]{1,32}|[0-9]{1,32})", re.IGNORECASE)
"""Pattern of an integer in CiA 306's notation."""

Sections = dict[str, dict[str, str]]
"""Keys and values of a file by section title; titles and keys in lower case."""


class EdsError(FailureError, ValueError):
    """Error: a file cannot be used as an EDS; the message is one sentence that names the file."""


@dataclass(frozen=True, slots=True)
class EdsEntry:
    """One object of a drive, or one sub-index of an object, as an EDS file describes it."""

    index: int
    """Index of the object."""
    subindex: int
    """Sub-index; 0 for a plain variable."""
    name: str
    """Name of the object or sub-index in the file."""
    data_type: int
    """Number of the data type by CiA 301, such as 0x0006 for UNSIGNED16; 0: not stated."""
    access_right: str
    """Access right: ``ro``, ``rw``, ``wo``, ``const``, ``rwr`` or ``rww``."""
    is_mappable: bool
    """Whether the object can be mapped into a PDO."""
    default_value: int | None
    """Value after power-up, or value that a DCF sets; None: not stated, or not an integer."""
    lower_limit: int | None
    """Lower limit of the value; None: not stated."""
    upper_limit: int | None
    """Upper limit of the value; None: not stated."""
    default_bytes: bytes = b""
    """Default value as the drive's bytes if it is a text, block or fraction; empty: not stated."""

    @property
    def is_writable(self) -> bool:
        """Whether the object can be written."""
        return "w" in self.access_right

    @property
    def length_bit(self) -> int | None:
        """Length of the object's value in bits; None for a text or block, or if untyped."""
        return _LENGTH_BIT_BY_TYPE.get(self.data_type)


@dataclass(frozen=True, slots=True)
class Eds:
    """Content of a drive's EDS or DCF file."""

    path: Path
    """Path of the file."""
    node_id: int
    """Node number for which the file was read."""
    vendor_name: str
    """Name of the vendor in the file."""
    vendor_id: int
    """Vendor number (object 1018:1); 0: not stated."""
    product_name: str
    """Name of the product in the file."""
    product_code: int
    """Product code (object 1018:2); 0: not stated."""
    revision: int
    """Revision number (object 1018:3); 0: not stated."""
    bit_rates_bit_s: tuple[int, ...]
    """Bit rates in bit/s that the drive supports; empty: not stated."""
    commissioned_node_id: int
    """Node number of the drive that a DCF file configures; 0: not stated."""
    entries: Mapping[tuple[int, int], EdsEntry]
    """Entries by index and sub-index; a plain variable has the sub-index 0."""

    def get(self, index: int, subindex: int = 0) -> EdsEntry | None:
        """Return the entry of an object or sub-index, or None if the file does not contain it.

        Parameters
        ----------
        index, subindex
            Index and sub-index of the object.
        """
        return self.entries.get((index, subindex))

    def has_object(self, index: int) -> bool:
        """Return whether the file contains an object, or any sub-index of it."""
        return any((index, subindex) in self.entries for subindex in range(256))


def read_eds(path: Path, node_id: int = 1) -> Eds:
    """Read a drive's EDS or DCF file.

    Parameters
    ----------
    path
        Path of the EDS or DCF file.
    node_id
        Node number of the drive: the value of ``$NODEID`` in the file.

    Returns
    -------
    Eds
        Objects, identity and bit rates of the drive.

    Raises
    ------
    EdsError
        If the file does not exist, is too large, or is not an EDS.
    """
    sections = _parse_sections(_read_text(path), path)
    device_keys = sections.get("deviceinfo", {})
    eds_entries = {
        (e.index, e.subindex): e
        for e in _parse_entries(_correct_sections(sections, path), sections, node_id)
    }
    if not eds_entries:
        raise EdsError(f"{path}: is not an EDS file: it describes no object of a drive.")
    return Eds(
        path=path,
        node_id=node_id,
        vendor_name=_printable_line(device_keys.get("vendorname", "")),
        vendor_id=_identity_number(eds_entries, 1, device_keys.get("vendornumber", "")),
        product_name=_printable_line(device_keys.get("productname", "")),
        product_code=_identity_number(eds_entries, 2, device_keys.get("productnumber", "")),
        revision=_identity_number(eds_entries, 3, device_keys.get("revisionnumber", "")),
        bit_rates_bit_s=tuple(
            1000 * rate_kbit_s
            for rate_kbit_s in _BIT_RATES_KBIT_S
            if _is_flag_set(device_keys.get(f"baudrate_{rate_kbit_s}", ""))
        ),
        commissioned_node_id=_commissioned_node_id(sections),
        entries=eds_entries,
    )


def _commissioned_node_id(sections: Sections) -> int:
    """Return the node number that a DCF file configures for the drive, or 0 if it has none."""
    # The first spelling is CiA 306's.
    for section_title in ("devicecomissioning", "devicecommissioning"):
        node_id = _parse_integer_or_zero(sections.get(section_title, {}).get("nodeid", ""))
        if 1 <= node_id <= 127:
            return node_id
    return 0


def _read_text(path: Path) -> str:
    """Return the decoded text of an EDS file (UTF-8, UTF-16 or cp1252), or raise."""
    try:
        # Check the kind of file first, since opening a pipe would wait for its other end.
        file_status = path.stat()
        if stat.S_ISDIR(file_status.st_mode):
            raise EdsError(f"{path}: is a folder; name the EDS file in it.")
        if not stat.S_ISREG(file_status.st_mode):
            raise EdsError(f"{path}: is not an ordinary file; name the drive's EDS file.")
        with path.open("rb") as eds_file:
            file_bytes = eds_file.read(MAX_FILE_BYTES + 1)
    except EdsError:  # a ValueError too
        raise
    except OSError as error:
        raise EdsError(f"{path}: cannot be read ({error.strerror}).") from error
    except ValueError as error:  # a NUL in the name
        raise EdsError(f"{str(path)!r}: cannot be read ({error}).") from error
    if len(file_bytes) > MAX_FILE_BYTES:
        raise EdsError(
            f"{path}: has more than {MAX_FILE_BYTES / 1e6:g} MB, which no EDS file of a drive has."
        )
    if file_bytes.startswith((b"\xff\xfe", b"\xfe\xff")):
        decoded_text = file_bytes.decode("utf-16", errors="replace")
    else:
        try:
            decoded_text = file_bytes.decode("utf-8-sig")
        except UnicodeDecodeError:
            decoded_text = file_bytes.decode("cp1252", errors="replace")
    if "\0" in decoded_text:
        raise EdsError(f"{path}: is not an EDS file: it is not text.")
    if decoded_text.lstrip().startswith("<"):
        raise EdsError(
            f"{path}: is XML (an XDD file, or ESI of EtherCAT), not an EDS file; "
            "ask the vendor for the drive's EDS of CANopen."
        )
    return decoded_text


def _parse_sections(file_text: str, path: Path) -> Sections:
    """Parse the text of a file into sections; ignore lines that are neither title nor key.

    If a section or key occurs twice, the first occurrence is used.
    """
    sections: Sections = {}
    section_keys: dict[str, str] = {}
    for text_line in map(str.strip, file_text.splitlines()):
        if not text_line or text_line[0] in ";#":
            continue
        if text_line[0] == "[":
            section_title, closing_bracket, _ = text_line[1:].partition("]")
            # Without a closing bracket it is no section title; the next keys belong to no section.
            section_keys = (
                sections.setdefault(section_title.strip().lower(), {}) if closing_bracket else {}
            )
            if len(sections) > MAX_EDS_ENTRIES:
                raise _too_many_entries_error(path)
            continue
        key, equals_sign, value_text = text_line.partition("=")
        if equals_sign:
            # As in canopen, a comment may follow the value after white space.
            unquoted_text = _QUOTED_VALUE_PATTERN.sub(
                r"\2", re.split(r"\s;", value_text, maxsplit=1)[0].strip()
            )
            section_keys.setdefault(key.strip().lower(), unquoted_text.strip())
    return sections


def _too_many_entries_error(path: Path) -> EdsError:
    """Return the error for a file with more than `MAX_EDS_ENTRIES` sections or objects."""
    return EdsError(
        f"{path}: describes more than {MAX_EDS_ENTRIES} objects, which no EDS file of a drive does."
    )


def _correct_sections(sections: Sections, path: Path) -> dict[tuple[int, int], Mapping[str, str]]:
    """Return the corrected keys of each object or sub-index that has a value, sorted by index.

    Sub-indices that an array declares together (``CompactSubObj``) are included. A sub-index
    without name, type or access right gets that of the whole object.
    """
    subsections_by_index: dict[int, dict[int, dict[str, str]]] = {}
    for section_title, section_keys in sections.items():
        if title_match := _SUB_INDEX_TITLE_PATTERN.fullmatch(section_title):
            subsections_by_index.setdefault(int(title_match[1], 16), {}).setdefault(
                int(title_match[2], 16), section_keys
            )
        elif _OBJECT_TITLE_PATTERN.fullmatch(section_title):
            subsections_by_index.setdefault(int(section_title, 16), {})
    corrected_keys_by_address: dict[tuple[int, int], Mapping[str, str]] = {}
    for index, sub_sections in sorted(subsections_by_index.items()):
        section_title = f"{index:04x}"
        section_keys = _keys_with_values(sections.get(section_title, {}))
        for subindex, compact_keys in _compact_sub_indices(section_title, sections):
            sub_sections.setdefault(subindex, compact_keys)
        # Sub-indices are kept even if the object's type is missing or wrong.
        object_kind = _parse_integer_or_zero(section_keys.get("objecttype", ""))
        if (
            not sub_sections
            and object_kind in (_ARRAY_OBJECT, _RECORD_OBJECT)
            and "datatype" not in section_keys
        ):
            continue  # the file describes no sub-index of the object
        parameter_name = section_keys.get("parametername") or section_title.upper()
        shared_keys = {"parametername": parameter_name}
        if not sub_sections:
            corrected_keys_by_address[index, 0] = shared_keys | section_keys
        shared_keys |= {
            key: section_keys[key] for key in ("datatype", "accesstype") if key in section_keys
        }
        for subindex in sorted(sub_sections):
            corrected_keys_by_address[index, subindex] = shared_keys | _keys_with_values(
                sub_sections[subindex]
            )
        if len(corrected_keys_by_address) > MAX_EDS_ENTRIES:
            raise _too_many_entries_error(path)
    return corrected_keys_by_address


def _keys_with_values(section_keys: Mapping[str, str]) -> dict[str, str]:
    """Return the keys of a section that have a value."""
    return {key: value_text for key, value_text in section_keys.items() if value_text}


def _compact_sub_indices(
    section_title: str, sections: Sections
) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the sub-indices that an object declares together, with their keys."""
    shared_keys = dict(sections.get(section_title, {}))
    subindex_count = _parse_integer_or_zero(shared_keys.pop("compactsubobj", ""))
    if not 0 < subindex_count < 255:
        return
    names_by_sub, values_by_sub = (
        sections.get(section_title + section_suffix, {}) for section_suffix in ("name", "value")
    )
    yield (
        0,
        {
            "parametername": "Number of entries",
            "datatype": "0x0005",
            "accesstype": "ro",
            "defaultvalue": str(subindex_count),
        },
    )
    for subindex in range(1, subindex_count + 1):
        subindex_keys = {
            "parametername": names_by_sub.get(str(subindex), ""),
            "parametervalue": values_by_sub.get(str(subindex), ""),
        }
        yield (
            subindex,
            shared_keys
            | {key: value_text for key, value_text in subindex_keys.items() if value_text},
        )


def _parse_entries(
    corrected_keys_by_address: Mapping[tuple[int, int], Mapping[str, str]],
    sections: Sections,
    node_id: int,
) -> Iterator[EdsEntry]:
    """Yield the entries that corrected sections describe."""
    for (index, subindex), section_keys in corrected_keys_by_address.items():
        data_type = _basic_data_type(section_keys, sections)
        entry_value: int | bytes | None = None
        # A valid value that a DCF sets takes precedence over the default.
        for key in ("parametervalue", "defaultvalue"):
            if entry_value is None and key in section_keys:
                entry_value = _parse_value(section_keys[key], data_type, node_id)
        stated_access_right = section_keys.get("accesstype", "").lower()
        yield EdsEntry(
            index=index,
            subindex=subindex,
            name=_printable_line(section_keys["parametername"]),
            data_type=data_type,
            access_right=stated_access_right if stated_access_right in _ACCESS_RIGHTS else "rw",
            is_mappable=_is_flag_set(section_keys.get("pdomapping", "")),
            default_value=entry_value if isinstance(entry_value, int) else None,
            lower_limit=_to_signed(_parse_integer(section_keys.get("lowlimit", "")), data_type),
            upper_limit=_to_signed(_parse_integer(section_keys.get("highlimit", "")), data_type),
            default_bytes=entry_value if isinstance(entry_value, bytes) else b"",
        )


def _basic_data_type(section_keys: Mapping[str, str], sections: Sections) -> int:
    """Return the basic data type of an object; a type defined in the file is resolved."""
    data_type = _parse_integer_or_zero(section_keys.get("datatype", ""))
    if data_type > _LAST_BASIC_TYPE:
        # Tools define their own type for a number with limits, as an object whose sub-index 1
        # names the basic type.
        basic_type_text = sections.get(f"{data_type:x}sub1", {}).get("defaultvalue", "")
        data_type = _parse_integer_or_zero(basic_type_text)
        if not 0 < data_type <= _LAST_BASIC_TYPE:
            data_type = _DOMAIN_TYPE
    return max(data_type, 0)


def _parse_value(value_text: str, data_type: int, node_id: int) -> int | bytes | None:
    """Return a default value of an EDS file, or None if it is invalid.

    Integers are returned as int, other types as the bytes that the drive would send.
    """
    try:
        if data_type in _TEXT_TYPES:
            return value_text.encode("utf-8", errors="replace")
        if data_type in (_OCTET_STRING_TYPE, _DOMAIN_TYPE):
            return bytes.fromhex(value_text)
        if data_type in _FLOAT_LAYOUT_BY_TYPE:
            return struct.pack(_FLOAT_LAYOUT_BY_TYPE[data_type], float(value_text))
    except (ValueError, OverflowError):
        return None
    # A CAN identifier may be written as $NODEID+0x180.
    number_text, placeholder_count = _NODE_ID_PLACEHOLDER_PATTERN.subn(
        "", value_text.replace(" ", "")
    )
    integer_value = 0 if placeholder_count and not number_text else _parse_integer(number_text)
    if integer_value is None:
        return None
    return _to_signed(integer_value + node_id if placeholder_count else integer_value, data_type)


def _to_signed(integer_value: int | None, data_type: int) -> int | None:
    """Convert a positive number that encodes a negative one (two's complement) of a data type."""
    if (
        integer_value is not None
        and data_type in _SIGNED_TYPES
        and integer_value >> _LENGTH_BIT_BY_TYPE[data_type] - 1 == 1
    ):
        return integer_value - (1 << _LENGTH_BIT_BY_TYPE[data_type])
    return integer_value


def _identity_number(
    entries: Mapping[tuple[int, int], EdsEntry], subindex: int, header_text: str
) -> int:
    """Return one of the drive's identity numbers: from object 1018, or else `header_text`."""
    identity_entry = entries.get((0x1018, subindex))
    identity_value = (
        identity_entry.default_value if identity_entry else None
    ) or _parse_integer_or_zero(header_text)
    return (
        identity_value if 0 <= identity_value < 0xFFFF_FFFF else 0
    )  # in some files, all bits set: not stated


def _parse_integer_or_zero(number_text: str) -> int:
    """Parse an integer in CiA 306's notation; return 0 if the text is not an integer."""
    return _parse_integer(number_text) or 0


def _is_flag_set(flag_text: str) -> bool:
    """Return whether a flag is set: 1 in CiA 306's notation, TRUE in that of some tools."""
    return flag_text.lower() in _WORDS_FOR_TRUE or _parse_integer_or_zero(flag_text) != 0


def _parse_integer(number_text: str) -> int | None:
    """Parse an integer in CiA 306's notation: 0x1F, 31, or octal 037; return None if invalid."""
    integer_match = _INTEGER_PATTERN.fullmatch(number_text.strip())
    if integer_match is None:
        return None
    digit_text = integer_match[0].lower()
    octal_match = re.fullmatch(r"([+-]?)0([0-7]+)", digit_text)
    if octal_match:
        return int(octal_match[1] + octal_match[2], 8)
    return int(digit_text, 16) if "x" in digit_text else int(digit_text)


def _printable_line(file_text: str) -> str:
    """Return a text of the file as messages may show it: one line, printable, not too long."""
    return printable(" ".join(file_text.split()), _MAX_SHOWN_CHARACTERS)
