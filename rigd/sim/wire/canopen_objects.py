"""Object dictionary of a simulated CANopen node: typed entries, access rights, ranges."""

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial
from struct import Struct


class AbortCode(IntEnum):
    """Why an SDO access failed, as the node tells its client."""

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
        What the client is told.
    """

    def __init__(self, code: AbortCode) -> None:
        super().__init__(f"{code.name} {code:#010x}")
        self.code = code


NUMBERS = "bBhHiIqQ"
_FORMATS = {kind: Struct("<" + kind) for kind in NUMBERS}
_LONGEST_TEXT = 1024


@dataclass(frozen=True, slots=True)
class Description:
    """What a device's file says of one sub-index."""

    kind: str
    """As of an `Entry`."""
    access: str
    mapping: str
    default: int | None = None
    """None where the file does not tell."""
    low: int | None = None
    high: int | None = None
    text: bytes = b""
    fixed: bool = False

    def entry(self) -> "Entry":
        """Return an entry that keeps what is written to it, and has no other meaning."""
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
        bytes: a text, or a value that nobody here computes with.
    value
        At power-on.
    access
        "rw", "ro" or "wo", as seen by SDO.
    mapping
        Into which PDOs it may go: "r", "t", "rt" or none.
    low, high
        What may be written; by default all that the type holds.
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
    """Of a number; 0 for bytes, which no PDO carries."""
    _low: int = field(init=False)
    _high: int = field(init=False)

    def __post_init__(self) -> None:
        self.default = self.value
        self.default_text = self.text
        self._set_range(self.low, self.high)

    def become(self, said: Description, default: int | None) -> None:
        """Take type, access, mapping and limits that a file states; the meaning stays.

        Parameters
        ----------
        said
            Of the file, a number as this one is.
        default
            Value at power-on from now on; None leaves it as it is.
        """
        if self.live is not None and said.kind != self.kind:
            self.live = partial(_within, self.live, *_range_of(said.kind))
        self.kind, self.access, self.mapping = said.kind, said.access, said.mapping
        # What the drive here can do bounds it as well.
        low = max((x for x in (self.low, said.low) if x is not None), default=None)
        high = min((x for x in (self.high, said.high) if x is not None), default=None)
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
        """How many bytes may be written at most."""
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
        """Go back to what stands here at power-on."""
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
        """Have what a device's file has, and nothing else.

        Entries keep their meaning where the file has them as numbers of any type; the others of
        the file are storage.

        Parameters
        ----------
        file
            What it says, by index and sub-index.
        own
            Indices whose values at power-on are not the file's.
        """
        before, self._entries = self._entries, {}
        self._indices.clear()
        for (index, sub), said in file.items():
            entry = before.get((index, sub))
            if entry is None or "s" in (entry.kind, said.kind):
                entry = said.entry()
            else:
                entry.become(said, None if index in own else said.default)
            self.add(index, entry, sub)

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
        """Return what a client reads.

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
        """Take what a client writes, and return it as a number or, bytes, in hexadecimal.

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
