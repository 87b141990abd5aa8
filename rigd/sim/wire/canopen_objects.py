"""Object dictionary of a simulated CANopen node: typed entries, access rights, ranges."""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
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


_FORMATS = {kind: Struct("<" + kind) for kind in "bBhHiI"}


@dataclass(slots=True)
class Entry:
    """One sub-index: a number, or a text that can only be read.

    Parameters
    ----------
    kind
        Letter of :mod:`struct` for the number ("b", "B", "h", "H", "i", "I"), or "s" for a text.
    value
        At power-on.
    access
        "rw", "ro" or "wo", as seen by SDO.
    mapping
        Into which PDOs it may go: "r", "t", "rt" or none.
    low, high
        What may be written; by default all that the type holds.
    text
        The bytes of a text.
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
    live: Callable[[], int] | None = None
    check: Callable[[int], None] | None = None
    wrote: Callable[[], None] | None = None
    default: int = field(init=False)
    bits: int = field(init=False)
    _low: int = field(init=False)
    _high: int = field(init=False)

    def __post_init__(self) -> None:
        self.default = self.value
        self.bits = 8 * (len(self.text) if self.kind == "s" else _FORMATS[self.kind].size)
        if self.kind.islower():
            low, high = -(1 << (self.bits - 1)), (1 << (self.bits - 1)) - 1
        else:
            low, high = 0, (1 << self.bits) - 1
        self._low = low if self.low is None else self.low
        self._high = high if self.high is None else self.high

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

    def encode(self) -> bytes:
        """Return the bytes an SDO upload gives."""
        return self.text if self.kind == "s" else _FORMATS[self.kind].pack(self.get())

    def decode(self, data: bytes) -> int:
        """Return the number in the bytes of an SDO download, of the right length."""
        number: int = _FORMATS[self.kind].unpack(data)[0]
        return number


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

    def write(self, index: int, sub: int, data: bytes) -> int:
        """Take what a client writes, and return it as a number.

        Raises
        ------
        Abort
            If it may not, or not this.
        """
        entry = self.find_writable(index, sub)
        if 8 * len(data) != entry.bits:
            raise Abort(AbortCode.LENGTH)
        value = entry.decode(data)
        entry.put(value)
        if entry.wrote is not None:
            entry.wrote()
        return value

    def reset(self, last: int) -> None:
        """Put the entries up to an index, which is included, back to their power-on values."""
        for (index, _), entry in self._entries.items():
            if index <= last:
                entry.value = entry.default
