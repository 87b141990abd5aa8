"""Protocol of a Digital F/T sensor: Modbus RTU frames for set-up, then a stream of records.

A record has 13 bytes: gauges 0, 2, 4, 1, 3, 5 as big-endian int16, then the sum of these bytes in
seven bits, with the sensor's error bit above. Nothing marks where a record begins and nothing
counts them, and the sum also fits one of 128 false beginnings. Worse, the records of a load at
rest are nearly alike, so that a false beginning that fits once may well fit again. Hence
`RecordStream` has these rules:

* after a disturbance a beginning counts only once several records in a row fit it, and these are
  then delivered, too;
* the beginning that held before the disturbance (or that the sensor's last message gives) has
  precedence: most disturbances damage bytes and lose none;
* any other beginning must be the only one that fits.
"""

from collections.abc import Sequence
from struct import pack, unpack

ADDRESS = 0x0A
"""Modbus address of every such sensor."""
MAX_REGISTERS = 64
"""Largest number of registers in one request."""

STATUS_WORD = 0x001D
ACTIVE_GAINS = 0x0000
ACTIVE_OFFSETS = 0x0006

_READ = 0x03
_WRITE = 0x10
_START = 0x46
_LOCK = 0x6A
_STREAM_PARAMETER = 0x55
_UNLOCK_CODE = 0xAA
_LOCK_CODE = 0x18
_ACCEPTED = 1
_EXCEPTION_FLAG = 0x80
_EXCEPTIONS = {
    1: "it does not know this function",
    2: "it has no such register",
    3: "it does not accept this value",
    4: "it failed while carrying it out",
    5: "it needs more time",
    6: "it is busy",
}


class BadReply(ValueError):
    """The reply is missing, damaged or that to another request; repeat it."""


class ExceptionResponse(ValueError):
    """Modbus exception response: the sensor declines the request; a repetition does not help."""


# Modbus RTU frames


def _crc_of_byte(value: int) -> int:
    for _ in range(8):
        value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return value


_CRC_TABLE = tuple(map(_crc_of_byte, range(256)))


def crc16(data: bytes) -> int:
    """Return Modbus' checksum (polynomial 0xA001 reflected, start 0xFFFF)."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC_TABLE[(crc ^ byte) & 0xFF]
    return crc


def frame(function: int, content: bytes) -> bytes:
    """Return a whole request to the sensor, with address and checksum."""
    body = bytes((ADDRESS, function)) + content
    return body + crc16(body).to_bytes(2, "little")


START_STREAMING = frame(_START, bytes((_STREAM_PARAMETER,)))
UNLOCK = frame(_LOCK, bytes((_UNLOCK_CODE,)))
LOCK = frame(_LOCK, bytes((_LOCK_CODE,)))


def read_registers(first: int, count: int) -> bytes:
    """Return the request for some registers, at most MAX_REGISTERS."""
    return frame(_READ, pack(">HH", first, count))


def write_registers(first: int, values: Sequence[int]) -> bytes:
    """Return the request that sets some registers."""
    content = pack(f">{len(values)}H", *values)
    return frame(_WRITE, pack(">HHB", first, len(values), len(content)) + content)


def reply_length(request: bytes) -> int:
    """Return the length of the reply to a request in bytes, unless it is an exception response."""
    function = request[1]
    if function == _READ:
        (count,) = unpack(">H", request[4:6])
        return 5 + 2 * int(count)
    return 8 if function == _WRITE else 5


REFUSAL_LENGTH = 5


def is_refusal(reply: bytes) -> bool:
    """Return whether the bytes received so far begin an exception response."""
    return len(reply) > 1 and bool(reply[1] & _EXCEPTION_FLAG)


def content_of(request: bytes, reply: bytes) -> bytes:
    """Return the content of a reply; verify address, function, length, checksum and echo.

    Raises
    ------
    BadReply
        If it is not a valid reply to this request.
    ExceptionResponse
        If it is valid and declines the request.
    """
    if not reply:
        raise BadReply("no reply came")
    wanted = REFUSAL_LENGTH if is_refusal(reply) else reply_length(request)
    if len(reply) != wanted:
        raise BadReply(f"{len(reply)} bytes came instead of {wanted} ({reply[:16].hex(' ')})")
    if crc16(reply):
        raise BadReply(f"the checksum of the reply is wrong ({reply[:16].hex(' ')})")
    if reply[0] != ADDRESS or reply[1] & ~_EXCEPTION_FLAG != request[1]:
        raise BadReply(f"the reply belongs to another request ({reply[:16].hex(' ')})")
    content = reply[2:-2]
    if is_refusal(reply):
        code = content[0]
        raise ExceptionResponse(_EXCEPTIONS.get(code, f"it declined with code {code}"))
    function = request[1]
    if function == _READ and content[0] != wanted - 5:
        raise BadReply(f"{content[0]} bytes of registers came instead of {wanted - 5}")
    if function == _WRITE and content != request[2:6]:
        raise BadReply("it confirmed other registers than were written")
    if function in (_LOCK, _START) and content[0] != _ACCEPTED:
        raise ExceptionResponse(f"it declined with code {content[0]}")
    return content[1:] if function == _READ else content


def registers_of(content: bytes) -> tuple[int, ...]:
    """Return the values of registers that were read."""
    return unpack(f">{len(content) // 2}H", content)


# Record stream

RECORD_SIZE = 13
RECORD_BITS = RECORD_SIZE * 11
"""On the line: each byte with start, parity and stop bit."""
SYNC_RECORDS = 6
"""Records in a row that must fit. Less than come in a tick of 1 ms, so that one damaged record
makes no tick go without any."""
ERROR_BIT = 0x80
"""Bit in the last byte of a record: the sensor's status word reports something."""

_SUM_AT = RECORD_SIZE - 1
_SUM_MASK = 0x7F
_SYNC_SIZE = SYNC_RECORDS * RECORD_SIZE


class RecordStream:
    """Splits the received bytes, in chunks of any length, into records.

    Attributes
    ----------
    synchronised : bool
        Whether the beginning of the next record is known.
    records : int
        Delivered so far.
    checksum_errors : int
        Number of times that a record did not fit where one had to begin.
    dropped_bytes : int
        Number of bytes that belonged to no record.
    pending : int
        Bytes that are held until it is clear which record they belong to.
    """

    __slots__ = ("_held", "_phase", "checksum_errors", "dropped_bytes", "records", "synchronised")

    def __init__(self) -> None:
        self.records = 0
        self.checksum_errors = 0
        self.dropped_bytes = 0
        self.start(aligned=False)

    def start(self, *, aligned: bool) -> None:
        """Restart the stream.

        Parameters
        ----------
        aligned
            Whether the next byte is probably the first of a record.
        """
        self._held = b""
        self._phase = 0 if aligned else None
        self.synchronised = False

    @property
    def pending(self) -> int:
        """Bytes held back."""
        return len(self._held)

    def feed(self, chunk: bytes) -> bytes:
        """Return the records in the received bytes, concatenated, oldest first."""
        data = self._held + chunk if self._held else chunk
        found = b""
        while True:
            if not self.synchronised:
                begin = self._search(data)
                if begin is None:
                    break
                self.dropped_bytes += begin
                data = data[begin:]
                self.synchronised = True
            whole = len(data) - len(data) % RECORD_SIZE
            good = _length_of_good(data, whole)
            found = found + data[:good] if found else data[:good]
            data = data[good:]
            if good == whole:
                self._held = data
                break
            self.checksum_errors += 1
            self.synchronised = False
            self._phase = 0
        self.records += len(found) // RECORD_SIZE
        return found

    def _search(self, data: bytes) -> int | None:
        """Return the offset of the first record; None if more bytes are needed to find it."""
        last = len(data) - _SYNC_SIZE
        undecided = max(0, last + 1)
        for begin in range(last + 1):
            if not _fits(data, begin):
                continue
            if self._phase is not None and (begin - self._phase) % RECORD_SIZE == 0:
                return begin
            if begin + _SUM_AT > last:
                # Not all candidate offsets have arrived yet.
                undecided = min(undecided, begin)
            elif not any(_fits(data, begin + shift) for shift in range(1, RECORD_SIZE)):
                return begin
        self.dropped_bytes += undecided
        self._held = data[undecided:]
        if self._phase is not None:
            self._phase = (self._phase - undecided) % RECORD_SIZE
        return None


def _length_of_good(data: bytes, whole: int) -> int:
    """Return how many bytes of ``data[:whole]`` are valid records, up to the first invalid one."""
    for begin in range(0, whole, RECORD_SIZE):
        if (sum(data[begin : begin + _SUM_AT]) ^ data[begin + _SUM_AT]) & _SUM_MASK:
            return begin
    return whole


def _fits(data: bytes, begin: int) -> bool:
    part = data[begin : begin + _SYNC_SIZE]
    return _length_of_good(part, _SYNC_SIZE) == _SYNC_SIZE
