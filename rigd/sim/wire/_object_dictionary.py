"""Object dictionary of a simulated CANopen node: typed entries, its SDO server, and EDS files."""

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

NUMBERS = "bBhHiIqQ"
_FORMATS = {kind: Struct("<" + kind) for kind in NUMBERS}
_LONGEST_TEXT = 1024


class AbortCode(IntEnum):
    """SDO abort codes: why an access failed."""

    TOGGLE = 0x0503_0000
    COMMAND = 0x0504_0001
    WRITE_ONLY = 0x0601_0001
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    PDO_LENGTH = 0x0604_0042
    INCOMPATIBLE = 0x0604_0043
    LENGTH = 0x0607_0010
    NO_SUB_INDEX = 0x0609_0011
    VALUE = 0x0609_0030
    STATE = 0x0800_0022
    NO_DATA = 0x0800_0024


class Abort(Exception):
    """An access that the dictionary refuses.

    Attributes
    ----------
    code : AbortCode
        SDO abort code for the client.
    """

    def __init__(self, code: AbortCode) -> None:
        super().__init__(f"{code.name} {code:#010x}")
        self.code = code


@dataclass(frozen=True, slots=True)
class Description:
    """Description of one sub-index in a device's file."""

    kind: str
    """Type, as in `Entry`."""
    access: str
    mapping: str
    default: int | None = None
    """Value at power-on; None where the file does not state it."""
    low: int | None = None
    high: int | None = None
    text: bytes = b""
    fixed: bool = False

    def entry(self) -> "Entry":
        """Return an entry that stores what is written to it, and has no other function."""
        return Entry(
            self.kind,
            self.default or 0,
            self.access,
            self.mapping,
            self.low,
            self.high,
            self.text,
            fixed=self.fixed,
        )


@dataclass(slots=True)
class Entry:
    """One sub-index: a number, or bytes.

    Parameters
    ----------
    kind
        Letter of :mod:`struct` for the number ("b", "B", "h", "H", "i", "I", "q", "Q"), or "s" for
        bytes: a text, or a value that is not used in computations here.
    value
        Value at power-on.
    access
        "rw", "ro" or "wo", as seen by SDO.
    mapping
        Into which PDOs it may go: "r", "t", "rt" or none.
    low, high
        Range of values that may be written; by default that of the type.
    text
        The bytes at power-on.
    fixed
        Bytes: only as many as there are may be written.
    live
        Gives the value where it is not stored.
    check
        Called with a value to be written; raises `Abort` if it cannot be.
    wrote
        Called after the value has been written.
    """

    kind: str
    value: int = 0
    access: str = "rw"
    mapping: str = ""
    low: int | None = None
    high: int | None = None
    text: bytes = b""
    fixed: bool = False
    live: Callable[[], int] | None = None
    check: Callable[[int], None] | None = None
    wrote: Callable[[], None] | None = None
    default: int = field(init=False)
    default_text: bytes = field(init=False)
    bits: int = field(init=False)
    """Bits of a number; 0 for bytes, which no PDO carries."""
    _low: int = field(init=False)
    _high: int = field(init=False)

    def __post_init__(self) -> None:
        self.default = self.value
        self.default_text = self.text
        self._set_range(self.low, self.high)

    def become(self, described: Description, default: int | None) -> None:
        """Adopt type, access, mapping and limits of a file; the function stays.

        Parameters
        ----------
        described
            Entry of the file, a number as this one is.
        default
            Value at power-on from now on; None leaves it as it is.
        """
        if self.live is not None and described.kind != self.kind:
            self.live = partial(_within, self.live, *_range_of(described.kind))
        self.kind, self.access, self.mapping = described.kind, described.access, described.mapping
        # What the drive here can do bounds it as well.
        low = max((x for x in (self.low, described.low) if x is not None), default=None)
        high = min((x for x in (self.high, described.high) if x is not None), default=None)
        self._set_range(low, high)
        if default is not None:
            self.default = default
        least, most = _range_of(self.kind)
        self.value = self.default = min(max(self.default, least), most)

    def _set_range(self, low: int | None, high: int | None) -> None:
        self.bits = 0 if self.kind == "s" else 8 * _FORMATS[self.kind].size
        least, most = _range_of(self.kind)
        self._low = least if low is None else low
        self._high = most if high is None else high

    def fits(self, size: int) -> bool:
        """Whether so many bytes may be written."""
        if self.kind != "s":
            return 8 * size == self.bits
        return size == len(self.text) if self.fixed else size <= _LONGEST_TEXT

    @property
    def most_bytes(self) -> int:
        """Largest number of bytes that may be written."""
        if self.kind != "s":
            return self.bits // 8
        return len(self.text) if self.fixed else _LONGEST_TEXT

    def get(self) -> int:
        """Return the value as it is now."""
        return self.value if self.live is None else self.live()

    def put(self, value: int) -> None:
        """Store a value that was received; `wrote` is left to the caller.

        Raises
        ------
        Abort
            If the value is not allowed, or not now.
        """
        if not self._low <= value <= self._high:
            raise Abort(AbortCode.VALUE)
        if self.check is not None:
            self.check(value)
        self.value = value

    def reset(self) -> None:
        """Restore the value at power-on."""
        self.value = self.default
        self.text = self.default_text

    def encode(self) -> bytes:
        """Return the bytes an SDO upload gives."""
        return self.text if self.kind == "s" else _FORMATS[self.kind].pack(self.get())

    def take(self, data: bytes) -> int | str:
        """Store the bytes of an SDO download, and return them as a number or in hexadecimal.

        Raises
        ------
        Abort
            If they are too many or too few, or the value is not allowed.
        """
        if not self.fits(len(data)):
            raise Abort(AbortCode.LENGTH)
        if self.kind == "s":
            self.text = data
            return data.hex()
        number: int = _FORMATS[self.kind].unpack(data)[0]
        self.put(number)
        return number


def _range_of(kind: str) -> tuple[int, int]:
    """Return the least and the greatest value of a type."""
    bits = 0 if kind == "s" else 8 * _FORMATS[kind].size
    if kind == "s" or kind.isupper():
        return 0, (1 << bits) - 1
    return -(1 << (bits - 1)), (1 << (bits - 1)) - 1


def _within(live: Callable[[], int], least: int, most: int) -> int:
    return min(max(live(), least), most)


class ObjectDictionary:
    """Entries by index and sub-index, with the access that SDO clients have."""

    def __init__(self) -> None:
        self._entries: dict[tuple[int, int], Entry] = {}
        self._indices: set[int] = set()

    def __getitem__(self, key: tuple[int, int]) -> Entry:
        return self._entries[key]

    def add(self, index: int, entry: Entry, sub: int = 0) -> Entry:
        """Add an entry and return it."""
        self._entries[index, sub] = entry
        self._indices.add(index)
        return entry

    def add_record(self, index: int, entries: dict[int, Entry]) -> None:
        """Add entries from sub-index 1 on, and the highest sub-index as sub-index 0."""
        self.add(index, Entry("B", max(entries), access="ro"))
        for sub, entry in entries.items():
            self.add(index, entry, sub)

    def follow(self, file: Mapping[tuple[int, int], Description], own: Container[int]) -> None:
        """Adopt the entries of a device's file, and no others.

        Entries keep their meaning where the file has them as numbers of any type; the others of
        the file are storage.

        Parameters
        ----------
        file
            Descriptions in the file, by index and sub-index.
        own
            Indices whose values at power-on are not the file's.
        """
        before, self._entries = self._entries, {}
        self._indices.clear()
        for (index, sub), described in file.items():
            entry = before.get((index, sub))
            if entry is None or "s" in (entry.kind, described.kind):
                entry = described.entry()
            else:
                entry.become(described, None if index in own else described.default)
            self.add(index, entry, sub)

    def override(self, index: int, sub: int, value: int | None) -> None:
        """Override the value of an entry, or make it absent; add it if it is missing."""
        if value is None:
            self._entries.pop((index, sub), None)
            return
        entry = self._entries.get((index, sub))
        if entry is None:
            entry = self.add(index, Entry("I"), sub)
        entry.value = entry.default = value

    def find(self, index: int, sub: int) -> Entry:
        """Return an entry.

        Raises
        ------
        Abort
            If there is none.
        """
        entry = self._entries.get((index, sub))
        if entry is not None:
            return entry
        raise Abort(AbortCode.NO_SUB_INDEX if index in self._indices else AbortCode.NO_OBJECT)

    def read(self, index: int, sub: int) -> bytes:
        """Return the value that a client reads.

        Raises
        ------
        Abort
            If it may not.
        """
        entry = self.find(index, sub)
        if entry.access == "wo":
            raise Abort(AbortCode.WRITE_ONLY)
        return entry.encode()

    def find_writable(self, index: int, sub: int) -> Entry:
        """Return the entry that a client is about to write.

        Raises
        ------
        Abort
            If it may not.
        """
        entry = self.find(index, sub)
        if entry.access == "ro":
            raise Abort(AbortCode.READ_ONLY)
        return entry

    def write(self, index: int, sub: int, data: bytes) -> int | str:
        """Write a client's value, and return it as a number or, if bytes, in hexadecimal.

        Raises
        ------
        Abort
            If it may not, or not this.
        """
        entry = self.find_writable(index, sub)
        value = entry.take(data)
        if entry.wrote is not None:
            entry.wrote()
        return value

    def reset(self, last: int) -> None:
        """Put the entries up to an index, which is included, back to their power-on values."""
        for (index, _), entry in self._entries.items():
            if index <= last:
                entry.reset()


# SDO server

_HEAD = Struct("<BHB")
_ABORT = Struct("<BHBI")

# Client command specifiers, in the three upper bits of the first byte.
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORTED = range(5)

_EXPEDITED = 0x02
_SIZE_GIVEN = 0x01
_LAST_SEGMENT = 0x01
_TOGGLE = 0x10
_EXPEDITED_SIZE = 4
_SEGMENT_SIZE = 7


class SdoServer:
    """Answers one client.

    Parameters
    ----------
    objects
        Objects that are read and written.
    reply
        Takes the eight bytes of an answer.
    wrote
        Called after each successful write with index, sub-index, and what was written: a number, or
        bytes in hexadecimal.
    """

    def __init__(
        self,
        objects: ObjectDictionary,
        reply: Callable[[bytes], None],
        wrote: Callable[[int, int, int | str], None],
    ) -> None:
        self._objects = objects
        self._reply = reply
        self._wrote = wrote
        self.reset()

    def reset(self) -> None:
        """Forget a transfer that has not ended."""
        self._index = self._sub = 0
        self._awaited: int | None = None  # specifier of the segments of a transfer under way
        self._buffer = b""
        self._toggle = 0

    def receive(self, data: bytes) -> None:
        """Process a request; ignore one that does not have eight bytes."""
        if len(data) != 8:
            return
        specifier = data[0] >> 5
        is_segment = specifier in (_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT)
        if not is_segment:
            self.reset()
            _, self._index, self._sub = _HEAD.unpack_from(data)
        try:
            if is_segment:
                self._go_on(specifier, data)
            elif specifier == _DOWNLOAD:
                self._start_download(data)
            elif specifier == _UPLOAD:
                self._start_upload()
            elif specifier != _ABORTED:  # block transfers, and what is not a request at all
                raise Abort(AbortCode.COMMAND)
        except Abort as abort:
            self._reply(_ABORT.pack(0x80, self._index, self._sub, abort.code))
            self.reset()

    def _start_download(self, data: bytes) -> None:
        command = data[0]
        entry = self._objects.find_writable(self._index, self._sub)
        if command & _EXPEDITED:
            size = min(entry.most_bytes, _EXPEDITED_SIZE)
            if command & _SIZE_GIVEN:
                size = _EXPEDITED_SIZE - (command >> 2 & 0x03)
            self._write(data[4 : 4 + size])
        else:
            # A number has one length, so that the segments need not be held against this one.
            stated = int.from_bytes(data[4:8], "little")
            if command & _SIZE_GIVEN and not entry.fits(stated):
                raise Abort(AbortCode.LENGTH)
            self._awaited = _DOWNLOAD_SEGMENT
        self._reply(_HEAD.pack(0x60, self._index, self._sub).ljust(8, b"\0"))

    def _start_upload(self) -> None:
        value = self._objects.read(self._index, self._sub)
        size = len(value)
        if 0 < size <= _EXPEDITED_SIZE:
            head = _HEAD.pack(0x43 | (_EXPEDITED_SIZE - size) << 2, self._index, self._sub)
            self._reply(head + value.ljust(_EXPEDITED_SIZE, b"\0"))
            return
        self._awaited = _UPLOAD_SEGMENT
        self._buffer = value
        self._reply(_HEAD.pack(0x41, self._index, self._sub) + size.to_bytes(4, "little"))

    def _go_on(self, specifier: int, data: bytes) -> None:
        """Receive or send the next segment."""
        command = data[0]
        if specifier != self._awaited:
            raise Abort(AbortCode.COMMAND)
        if command & _TOGGLE != self._toggle:
            raise Abort(AbortCode.TOGGLE)
        toggle, self._toggle = self._toggle, self._toggle ^ _TOGGLE
        if specifier == _UPLOAD_SEGMENT:
            segment, self._buffer = self._buffer[:_SEGMENT_SIZE], self._buffer[_SEGMENT_SIZE:]
            is_last = not self._buffer
            head = toggle | (_SEGMENT_SIZE - len(segment)) << 1 | (_LAST_SEGMENT if is_last else 0)
            self._reply(bytes([head]) + segment.ljust(_SEGMENT_SIZE, b"\0"))
        else:
            self._buffer += data[1 : 1 + _SEGMENT_SIZE - (command >> 1 & 0x07)]
            # No entry that can be written is longer: else a client could fill the memory.
            if len(self._buffer) > self._objects.find_writable(self._index, self._sub).most_bytes:
                raise Abort(AbortCode.LENGTH)
            is_last = bool(command & _LAST_SEGMENT)
            if is_last:
                self._write(self._buffer)
            self._reply(bytes([0x20 | toggle]).ljust(8, b"\0"))
        if is_last:
            self.reset()

    def _write(self, data: bytes) -> None:
        self._wrote(self._index, self._sub, self._objects.write(self._index, self._sub, data))


# EDS files

_FIRST_INDEX = 0x1000
"""Lowest index of objects; below it are types and dummies, which cannot be read."""
_IDENTITY = 0x1018
_WATCHED, _ONE_NODE = 0x1016, 0x1_0000

_BOOLEAN: Final = 0x01
_KINDS: Final = {
    0x00: "I",  # if no type is stated
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
"""Letters of :mod:`struct` for the numbers of CiA 301; the rest is stored as bytes."""
_TIMES: Final = {0x0C: 6, 0x0D: 6}
"""Bytes of time of day and of time difference."""
_SDO_ACCESS: Final = {"const": "ro", "rwr": "rw", "rww": "rw"}
_PDO_DIRECTIONS: Final = {"ro": "t", "const": "t", "wo": "r", "rwr": "t", "rww": "r"}


@dataclass(frozen=True, slots=True)
class DeviceFile:
    """Content of an EDS or DCF file."""

    name: str
    entries: Mapping[tuple[int, int], Description]
    """Entries by index and sub-index."""

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
        If it cannot be read, or is not of that kind.
    """
    try:
        eds = read_eds(path, node_id)
    except EdsError as error:
        raise DeviceError(f"The simulated drive cannot be made: {error}") from None
    entries = {
        key: _described(entry) for key, entry in eds.entries.items() if key[0] >= _FIRST_INDEX
    }
    for sub, number in enumerate((eds.vendor_id, eds.product_code, eds.revision), 1):
        described = entries.get((_IDENTITY, sub))
        if described is not None and not described.default:
            entries[_IDENTITY, sub] = replace(described, default=number)
    highest: dict[int, int] = {}
    for index, sub in entries:
        highest[index] = max(sub, highest.get(index, 0))
    for index, last in highest.items():
        described = entries.get((index, 0))
        if last and described is not None and described.default is None and described.kind == "B":
            entries[index, 0] = replace(described, default=last)
    return DeviceFile(path.name, entries)


def _described(entry: EdsEntry) -> Description:
    """Return the file's description of an object, in the terms of a simulated node."""
    access = _SDO_ACCESS.get(entry.access, entry.access)
    kind = _KINDS.get(entry.data_type)
    if kind is None:
        size = _TIMES.get(entry.data_type) or (entry.bits or 0) // 8
        return Description("s", access, "", text=_bytes(entry, size), fixed=size > 0)
    boolean = entry.data_type == _BOOLEAN
    # A boolean takes one bit in a PDO, which is not needed here.
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
    """Return the default of an entry stored as bytes, of a given size or, for 0, of its own."""
    data = entry.content
    if entry.default is not None and size:
        data = (entry.default & (1 << 8 * size) - 1).to_bytes(size, "little")
    return data[:size].ljust(size, b"\0") if size else data
