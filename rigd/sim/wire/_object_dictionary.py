"""Object dictionary of a simulated CANopen node: typed entries, SDO server, and EDS files."""

from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import partial
from pathlib import Path
from struct import Struct, calcsize
from typing import Final

from rigd.devices.contracts import DeviceError
from rigd.devices.eds import EdsEntry, EdsError, read_eds

# Objects

INTEGER_TYPE_LETTERS = "bBhHiIqQ"
"""Letters of :mod:`struct` for the integer types."""
_INTEGER_LAYOUTS = {type_letter: Struct("<" + type_letter) for type_letter in INTEGER_TYPE_LETTERS}
"""Binary layout of each integer type, by its letter."""
_MAX_TEXT_BYTES = 1024
"""Largest number of bytes that can be written to a text of variable length."""


class AbortCode(IntEnum):
    """SDO abort code, which states why an access failed."""

    WRONG_TOGGLE = 0x0503_0000
    UNKNOWN_COMMAND = 0x0504_0001
    WRITE_ONLY = 0x0601_0001
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    PDO_TOO_LONG = 0x0604_0042
    INCOMPATIBLE_PARAMETERS = 0x0604_0043
    WRONG_LENGTH = 0x0607_0010
    NO_SUB_INDEX = 0x0609_0011
    INVALID_VALUE = 0x0609_0030
    WRONG_STATE = 0x0800_0022
    NO_DATA = 0x0800_0024


class Abort(Exception):
    """Error: the dictionary refuses an access.

    Attributes
    ----------
    code : AbortCode
        SDO abort code for the client.
    """

    def __init__(self, code: AbortCode) -> None:
        super().__init__(f"{code.name} {code:#010x}")
        self.code = code


@dataclass(frozen=True, slots=True)
class EntryDescription:
    """Description of one sub-index in a device's file."""

    type_letter: str
    """Type letter, as in `Entry`."""
    access: str
    """Access right by SDO: "rw", "ro" or "wo"."""
    pdo_directions: str
    """Kinds of PDO into which the object can be mapped: "r", "t", "rt" or none."""
    default: int | None = None
    """Value at power-on; None if the file does not state it."""
    low: int | None = None
    """Lower limit of the value; None if not stated."""
    high: int | None = None
    """Upper limit of the value; None if not stated."""
    text: bytes = b""
    """Bytes at power-on of an entry that is no number."""
    has_fixed_length: bool = False
    """Whether bytes can be written only with the length of `text`."""

    def make_entry(self) -> "Entry":
        """Return an entry that stores what is written to it, and has no other function."""
        return Entry(
            self.type_letter,
            self.default or 0,
            self.access,
            self.pdo_directions,
            self.low,
            self.high,
            self.text,
            has_fixed_length=self.has_fixed_length,
        )


@dataclass(slots=True)
class Entry:
    """One sub-index of an object: an integer, or bytes.

    Attributes
    ----------
    type_letter
        Letter of :mod:`struct` for the number ("b", "B", "h", "H", "i", "I", "q", "Q"), or "s" for
        bytes: a text, or a value that the simulation does not use.
    value
        Value at power-on.
    access
        "rw", "ro" or "wo", as seen by SDO.
    pdo_directions
        Kinds of PDO into which it can be mapped: "r" (received), "t" (transmitted), "rt" or none.
    low, high
        Range of values that can be written; by default that of the type.
    text
        Bytes at power-on.
    has_fixed_length
        Whether bytes can be written only with the length of `text`.
    read_value
        Function that returns the value if it is not stored; None if it is stored.
    check_value
        Function that raises `Abort` if a value cannot be written now.
    after_write
        Function that is called after a value has been written.
    """

    type_letter: str
    value: int = 0
    access: str = "rw"
    pdo_directions: str = ""
    low: int | None = None
    high: int | None = None
    text: bytes = b""
    has_fixed_length: bool = False
    read_value: Callable[[], int] | None = None
    check_value: Callable[[int], None] | None = None
    after_write: Callable[[], None] | None = None
    default: int = field(init=False)
    default_text: bytes = field(init=False)
    bit_length: int = field(init=False)
    """Length of the integer in bits; 0 for bytes, which no PDO carries."""
    _low: int = field(init=False)
    _high: int = field(init=False)

    def __post_init__(self) -> None:
        """Store the values at power-on, and set the range."""
        self.default = self.value
        self.default_text = self.text
        self._set_range(self.low, self.high)

    def adopt_description(self, description: EntryDescription, default: int | None) -> None:
        """Take over type, access, mapping and limits from a device's file.

        The entry must be an integer's, like its description in the file. The functions that read
        the value, check it and react to it remain. `default` is the new value at power-on; None
        leaves it unchanged.
        """
        if self.read_value is not None and description.type_letter != self.type_letter:
            self.read_value = partial(
                _clamped_value, self.read_value, *_type_range(description.type_letter)
            )
        self.type_letter, self.access, self.pdo_directions = (
            description.type_letter,
            description.access,
            description.pdo_directions,
        )
        # The capabilities of the simulated drive limit the range, too.
        lower_limit = max((x for x in (self.low, description.low) if x is not None), default=None)
        upper_limit = min((x for x in (self.high, description.high) if x is not None), default=None)
        self._set_range(lower_limit, upper_limit)
        if default is not None:
            self.default = default
        type_minimum, type_maximum = _type_range(self.type_letter)
        self.value = self.default = min(max(self.default, type_minimum), type_maximum)

    def _set_range(self, low: int | None, high: int | None) -> None:
        """Set the length in bits, and the range of values, by default that of the type."""
        self.bit_length = (
            0 if self.type_letter == "s" else 8 * _INTEGER_LAYOUTS[self.type_letter].size
        )
        type_minimum, type_maximum = _type_range(self.type_letter)
        self._low = type_minimum if low is None else low
        self._high = type_maximum if high is None else high

    def accepts_length(self, byte_count: int) -> bool:
        """Return whether a value of `byte_count` bytes can be written to the entry."""
        if self.type_letter != "s":
            return 8 * byte_count == self.bit_length
        return (
            byte_count == len(self.text) if self.has_fixed_length else byte_count <= _MAX_TEXT_BYTES
        )

    @property
    def max_bytes(self) -> int:
        """Largest number of bytes that can be written to the entry."""
        if self.type_letter != "s":
            return self.bit_length // 8
        return len(self.text) if self.has_fixed_length else _MAX_TEXT_BYTES

    def read_integer(self) -> int:
        """Return the present value of an integer entry."""
        return self.value if self.read_value is None else self.read_value()

    def store_integer(self, received_integer: int) -> None:
        """Store a received integer; the caller then has to call `after_write`.

        Raise `Abort` if the value is outside the range, or not allowed now.
        """
        if not self._low <= received_integer <= self._high:
            raise Abort(AbortCode.INVALID_VALUE)
        if self.check_value is not None:
            self.check_value(received_integer)
        self.value = received_integer

    def reset(self) -> None:
        """Restore the entry's value at power-on."""
        self.value = self.default
        self.text = self.default_text

    def encode(self) -> bytes:
        """Return the value as bytes for an SDO upload."""
        return (
            self.text
            if self.type_letter == "s"
            else _INTEGER_LAYOUTS[self.type_letter].pack(self.read_integer())
        )

    def store_bytes(self, data: bytes) -> int | str:
        """Store the bytes of an SDO download; return them as an integer, or in hexadecimal.

        Raise `Abort` if the number of bytes is wrong, or the value is not allowed.
        """
        if not self.accepts_length(len(data)):
            raise Abort(AbortCode.WRONG_LENGTH)
        if self.type_letter == "s":
            self.text = data
            return data.hex()
        stored_integer: int = _INTEGER_LAYOUTS[self.type_letter].unpack(data)[0]
        self.store_integer(stored_integer)
        return stored_integer


def _type_range(integer_type_letter: str) -> tuple[int, int]:
    """Return the smallest and the largest value of a type."""
    bit_length = 0 if integer_type_letter == "s" else 8 * _INTEGER_LAYOUTS[integer_type_letter].size
    if integer_type_letter == "s" or integer_type_letter.isupper():
        return 0, (1 << bit_length) - 1
    return -(1 << (bit_length - 1)), (1 << (bit_length - 1)) - 1


def _clamped_value(read_value: Callable[[], int], lowest: int, largest: int) -> int:
    """Call `read_value`, and return its result limited to the range `lowest` to `largest`."""
    return min(max(read_value(), lowest), largest)


class ObjectDictionary:
    """Object dictionary: entries by index and sub-index, which SDO clients can access."""

    def __init__(self) -> None:
        self._entries: dict[tuple[int, int], Entry] = {}
        self._indices: set[int] = set()

    def __getitem__(self, index_and_sub_index: tuple[int, int]) -> Entry:
        return self._entries[index_and_sub_index]

    def add(self, index: int, entry: Entry, sub_index: int = 0) -> Entry:
        """Add an entry to the dictionary, and return the entry."""
        self._entries[index, sub_index] = entry
        self._indices.add(index)
        return entry

    def add_record(self, index: int, entries: dict[int, Entry]) -> None:
        """Add entries from sub-index 1 on, and the highest sub-index as sub-index 0."""
        self.add(index, Entry("B", max(entries), access="ro"))
        for sub_index, sub_entry in entries.items():
            self.add(index, sub_entry, sub_index)

    def adopt_file_entries(
        self,
        description_by_index: Mapping[tuple[int, int], EntryDescription],
        unchanged_indices: Container[int],
    ) -> None:
        """Restrict the dictionary to the entries in a device's file, with the file's descriptions.

        Entries that are integers in dictionary and file retain their functions. All other entries
        of the file only store values. The entries of `description_by_index` are by index and
        sub-index. Objects with an index in `unchanged_indices` retain their values at power-on.
        """
        previous_entries, self._entries = self._entries, {}
        self._indices.clear()
        for (index, sub_index), entry_description in description_by_index.items():
            adopted_entry = previous_entries.get((index, sub_index))
            if adopted_entry is None or "s" in (
                adopted_entry.type_letter,
                entry_description.type_letter,
            ):
                adopted_entry = entry_description.make_entry()
            else:
                adopted_entry.adopt_description(
                    entry_description,
                    None if index in unchanged_indices else entry_description.default,
                )
            self.add(index, adopted_entry, sub_index)

    def override_entry(self, index: int, sub_index: int, value: int | None) -> None:
        """Set the present value and the power-on value of an entry; None removes the entry.

        An entry that does not exist is added.
        """
        if value is None:
            self._entries.pop((index, sub_index), None)
            return
        overridden_entry = self._entries.get((index, sub_index))
        if overridden_entry is None:
            overridden_entry = self.add(index, Entry("I"), sub_index)
        overridden_entry.value = overridden_entry.default = value

    def find(self, index: int, sub_index: int) -> Entry:
        """Return the entry of the dictionary at an index and sub-index.

        Raise `Abort` if there is no such entry.
        """
        found_entry = self._entries.get((index, sub_index))
        if found_entry is not None:
            return found_entry
        raise Abort(AbortCode.NO_SUB_INDEX if index in self._indices else AbortCode.NO_OBJECT)

    def read(self, index: int, sub_index: int) -> bytes:
        """Return the value of an entry as bytes, as an SDO client reads it.

        Raise `Abort` if the entry does not exist or is write-only.
        """
        read_entry = self.find(index, sub_index)
        if read_entry.access == "wo":
            raise Abort(AbortCode.WRITE_ONLY)
        return read_entry.encode()

    def find_writable(self, index: int, sub_index: int) -> Entry:
        """Return the entry that an SDO client is about to write.

        Raise `Abort` if the entry does not exist or is read-only.
        """
        writable_entry = self.find(index, sub_index)
        if writable_entry.access == "ro":
            raise Abort(AbortCode.READ_ONLY)
        return writable_entry

    def write(self, index: int, sub_index: int, value_bytes: bytes) -> int | str:
        """Write the bytes of an SDO client, and return them as an integer or in hexadecimal.

        Raise `Abort` if the entry cannot be written, or the value is not allowed.
        """
        written_entry = self.find_writable(index, sub_index)
        written_value = written_entry.store_bytes(value_bytes)
        if written_entry.after_write is not None:
            written_entry.after_write()
        return written_value

    def reset(self, last_index: int) -> None:
        """Restore the values at power-on of all entries up to and including index `last_index`."""
        for (index, _), reset_entry in self._entries.items():
            if index <= last_index:
                reset_entry.reset()


# SDO server

_SDO_HEADER_LAYOUT = Struct("<BHB")
"""Layout of the beginning of an SDO frame: command, index, sub-index."""
_SDO_ABORT_LAYOUT = Struct("<BHBI")
"""Layout of an SDO abort: command, index, sub-index, abort code."""

# Client command specifiers, in the three upper bits of the first byte.
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORTED = range(5)

_EXPEDITED_BIT = 0x02
"""Bit of an SDO command: the frame contains the whole value."""
_SIZE_STATED_BIT = 0x01
"""Bit of an SDO command: the frame states the size of the value."""
_LAST_SEGMENT_BIT = 0x01
"""Bit of a segment's SDO command: it is the last segment."""
_TOGGLE_BIT = 0x10
"""Bit of a segment's SDO command that alternates between segments."""
_EXPEDITED_SIZE = 4
"""Largest number of value bytes in an expedited SDO transfer."""
_SEGMENT_SIZE = 7
"""Largest number of value bytes in a segment of an SDO transfer."""


class SdoServer:
    """SDO server of a node, for one client.

    `send_reply` sends the eight bytes of a reply. `after_write` is called after each write with
    index, sub-index and the value: an integer, or bytes in hexadecimal.
    """

    def __init__(
        self,
        objects: ObjectDictionary,
        send_reply: Callable[[bytes], None],
        after_write: Callable[[int, int, int | str], None],
    ) -> None:
        self._objects = objects
        self._reply = send_reply
        self._after_write = after_write
        self.reset()

    def reset(self) -> None:
        """Discard an unfinished SDO transfer."""
        self._index = self._sub = 0
        self._expected_specifier: int | None = None  # command specifier of the expected segments
        self._buffer = b""
        self._toggle = 0

    def receive(self, request_frame: bytes) -> None:
        """Process an SDO request; ignore a frame that does not have eight bytes."""
        if len(request_frame) != 8:
            return
        command_specifier = request_frame[0] >> 5
        is_segment = command_specifier in (_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT)
        if not is_segment:
            self.reset()
            _, self._index, self._sub = _SDO_HEADER_LAYOUT.unpack_from(request_frame)
        try:
            if is_segment:
                self._process_segment(command_specifier, request_frame)
            elif command_specifier == _DOWNLOAD:
                self._start_download(request_frame)
            elif command_specifier == _UPLOAD:
                self._start_upload()
            elif command_specifier != _ABORTED:  # block transfers and invalid specifiers
                raise Abort(AbortCode.UNKNOWN_COMMAND)
        except Abort as abort:
            self._reply(_SDO_ABORT_LAYOUT.pack(0x80, self._index, self._sub, abort.code))
            self.reset()

    def _start_download(self, request_frame: bytes) -> None:
        """Process a write request: write an expedited value, or expect segments."""
        command_byte = request_frame[0]
        target_entry = self._objects.find_writable(self._index, self._sub)
        if command_byte & _EXPEDITED_BIT:
            data_size = min(target_entry.max_bytes, _EXPEDITED_SIZE)
            if command_byte & _SIZE_STATED_BIT:
                data_size = _EXPEDITED_SIZE - (command_byte >> 2 & 0x03)
            self._write(request_frame[4 : 4 + data_size])
        else:
            # An integer has one length, so the segments need not be compared with this length.
            stated_size = int.from_bytes(request_frame[4:8], "little")
            if command_byte & _SIZE_STATED_BIT and not target_entry.accepts_length(stated_size):
                raise Abort(AbortCode.WRONG_LENGTH)
            self._expected_specifier = _DOWNLOAD_SEGMENT
        self._reply(_SDO_HEADER_LAYOUT.pack(0x60, self._index, self._sub).ljust(8, b"\0"))

    def _start_upload(self) -> None:
        """Process a read request: reply with an expedited value, or offer segments."""
        value_bytes = self._objects.read(self._index, self._sub)
        value_size = len(value_bytes)
        if 0 < value_size <= _EXPEDITED_SIZE:
            reply_header = _SDO_HEADER_LAYOUT.pack(
                0x43 | (_EXPEDITED_SIZE - value_size) << 2, self._index, self._sub
            )
            self._reply(reply_header + value_bytes.ljust(_EXPEDITED_SIZE, b"\0"))
            return
        self._expected_specifier = _UPLOAD_SEGMENT
        self._buffer = value_bytes
        self._reply(
            _SDO_HEADER_LAYOUT.pack(0x41, self._index, self._sub) + value_size.to_bytes(4, "little")
        )

    def _process_segment(self, command_specifier: int, request_frame: bytes) -> None:
        """Process the request for the next segment: store or send it."""
        command_byte = request_frame[0]
        if command_specifier != self._expected_specifier:
            raise Abort(AbortCode.UNKNOWN_COMMAND)
        if command_byte & _TOGGLE_BIT != self._toggle:
            raise Abort(AbortCode.WRONG_TOGGLE)
        toggle_bit, self._toggle = self._toggle, self._toggle ^ _TOGGLE_BIT
        if command_specifier == _UPLOAD_SEGMENT:
            segment_bytes, self._buffer = self._buffer[:_SEGMENT_SIZE], self._buffer[_SEGMENT_SIZE:]
            is_last_segment = not self._buffer
            reply_header = (
                toggle_bit
                | (_SEGMENT_SIZE - len(segment_bytes)) << 1
                | (_LAST_SEGMENT_BIT if is_last_segment else 0)
            )
            self._reply(bytes([reply_header]) + segment_bytes.ljust(_SEGMENT_SIZE, b"\0"))
        else:
            self._buffer += request_frame[1 : 1 + _SEGMENT_SIZE - (command_byte >> 1 & 0x07)]
            # No writable entry is longer. Without this check a client could fill the memory.
            if len(self._buffer) > self._objects.find_writable(self._index, self._sub).max_bytes:
                raise Abort(AbortCode.WRONG_LENGTH)
            is_last_segment = bool(command_byte & _LAST_SEGMENT_BIT)
            if is_last_segment:
                self._write(self._buffer)
            self._reply(bytes([0x20 | toggle_bit]).ljust(8, b"\0"))
        if is_last_segment:
            self.reset()

    def _write(self, value_bytes: bytes) -> None:
        """Write a completely received value to the object dictionary, and report the write."""
        self._after_write(
            self._index, self._sub, self._objects.write(self._index, self._sub, value_bytes)
        )


# EDS files

_FIRST_OBJECT_INDEX = 0x1000
"""Lowest index of objects; below it are types and dummies, which cannot be read."""
_IDENTITY_INDEX = 0x1018
"""Index of the identity object."""
_HEARTBEAT_CONSUMER_INDEX, _NODE_ID_UNIT = 0x1016, 0x1_0000
"""Index of the consumer heartbeat time, and value in its entries per unit of the node number."""

_BOOLEAN_TYPE: Final = 0x01
"""Data type (CiA 301) of a boolean."""
_TYPE_LETTERS: Final = {
    0x00: "I",  # if no type is stated
    _BOOLEAN_TYPE: "B",
    0x02: "b",
    0x03: "h",
    0x04: "i",
    0x05: "B",
    0x06: "H",
    0x07: "I",
    0x15: "q",
    0x1B: "Q",
}
"""Letters of :mod:`struct` for the integer types of CiA 301; other types are stored as bytes."""
_TIME_TYPE_LENGTHS: Final = {0x0C: 6, 0x0D: 6}
"""Lengths in bytes of the data types (CiA 301) for time of day and time difference."""
_SDO_ACCESS_BY_FILE_ACCESS: Final = {"const": "ro", "rwr": "rw", "rww": "rw"}
"""Access right by SDO for an access right in a file that also concerns PDOs."""
_PDO_DIRECTIONS_BY_ACCESS: Final = {"ro": "t", "const": "t", "wo": "r", "rwr": "t", "rww": "r"}
"""Kinds of PDO into which an object can be mapped, by its access right."""


@dataclass(frozen=True, slots=True)
class DeviceFile:
    """Content of a drive's EDS or DCF file, for the simulated drive."""

    name: str
    """Name of the file."""
    entries: Mapping[tuple[int, int], EntryDescription]
    """Descriptions by index and sub-index."""

    def present_offsets(self, first_index: int, last_index: int) -> Iterator[int]:
        """Yield the existing indices in a range, as offsets from `first_index`."""
        for index in range(first_index, last_index + 1):
            if any(key in self.entries for key in ((index, 0), (index, 1))):
                yield index - first_index

    def sub_index_count(self, index: int) -> int:
        """Return the number of sub-indices of an object, counted from 1 on without a gap."""
        sub_index = 0
        while (index, sub_index + 1) in self.entries:
            sub_index += 1
        return sub_index


def read_device(path: Path, node_id: int) -> DeviceFile:
    """Read the EDS or DCF file of the drive to simulate, for its node number.

    Raise `DeviceError` if the file cannot be read, or is no EDS or DCF file.
    """
    try:
        eds = read_eds(path, node_id)
    except EdsError as error:
        raise DeviceError(f"The simulated drive cannot be made: {error}") from None
    description_by_key = {
        key: _to_description(eds_entry)
        for key, eds_entry in eds.entries.items()
        if key[0] >= _FIRST_OBJECT_INDEX
    }
    for sub, identity_number in enumerate((eds.vendor_id, eds.product_code, eds.revision), 1):
        description = description_by_key.get((_IDENTITY_INDEX, sub))
        if description is not None and not description.default:
            description_by_key[_IDENTITY_INDEX, sub] = replace(description, default=identity_number)
    highest_sub_by_index: dict[int, int] = {}
    for index, sub in description_by_key:
        highest_sub_by_index[index] = max(sub, highest_sub_by_index.get(index, 0))
    for index, last_sub in highest_sub_by_index.items():
        description = description_by_key.get((index, 0))
        if (
            last_sub
            and description is not None
            and description.default is None
            and description.type_letter == "B"
        ):
            description_by_key[index, 0] = replace(description, default=last_sub)
    return DeviceFile(path.name, description_by_key)


def _to_description(eds_entry: EdsEntry) -> EntryDescription:
    """Convert the entry of an EDS file to a description for a simulated node."""
    sdo_access = _SDO_ACCESS_BY_FILE_ACCESS.get(eds_entry.access_right, eds_entry.access_right)
    type_letter = _TYPE_LETTERS.get(eds_entry.data_type)
    if type_letter is None:
        byte_count = _TIME_TYPE_LENGTHS.get(eds_entry.data_type) or (eds_entry.length_bit or 0) // 8
        return EntryDescription(
            "s",
            sdo_access,
            "",
            text=_default_bytes(eds_entry, byte_count),
            has_fixed_length=byte_count > 0,
        )
    is_boolean = eds_entry.data_type == _BOOLEAN_TYPE
    # A boolean takes one bit in a PDO, which is not needed here.
    is_mappable = eds_entry.is_mappable and not is_boolean
    pdo_directions = (
        _PDO_DIRECTIONS_BY_ACCESS.get(eds_entry.access_right, "rt") if is_mappable else ""
    )
    lower_limit, upper_limit = eds_entry.lower_limit, 1 if is_boolean else eds_entry.upper_limit
    if (
        lower_limit is not None and upper_limit is not None and lower_limit >= upper_limit
    ):  # written by tools without limits
        lower_limit = upper_limit = None
    if (
        eds_entry.index == _HEARTBEAT_CONSUMER_INDEX
        and upper_limit is not None
        and upper_limit < _NODE_ID_UNIT
    ):
        lower_limit = upper_limit = (
            None  # some files limit only the time in the lower half, without the node
        )
    default_value = (
        None
        if eds_entry.default_value is None
        else _to_type_range(eds_entry.default_value, type_letter)
    )
    return EntryDescription(
        type_letter, sdo_access, pdo_directions, default_value, lower_limit, upper_limit
    )


def _to_type_range(file_value: int, type_letter: str) -> int:
    """Convert a value to the range of its type; files may state negative values as unsigned."""
    bit_length = 8 * calcsize("<" + type_letter)
    file_value &= (1 << bit_length) - 1
    return (
        file_value - (1 << bit_length)
        if type_letter.islower() and file_value >> (bit_length - 1)
        else file_value
    )


def _default_bytes(eds_entry: EdsEntry, byte_count: int) -> bytes:
    """Return the default of an entry as `byte_count` bytes or, if that is 0, as its own bytes."""
    default_bytes = eds_entry.default_bytes
    if eds_entry.default_value is not None and byte_count:
        default_bytes = (eds_entry.default_value & (1 << 8 * byte_count) - 1).to_bytes(
            byte_count, "little"
        )
    return default_bytes[:byte_count].ljust(byte_count, b"\0") if byte_count else default_bytes
