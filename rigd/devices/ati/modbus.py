"""The Modbus RTU frames of a Digital F/T sensor: requests, and checking of replies."""

from collections.abc import Sequence
from struct import pack, unpack

ADDRESS = 0x0A
"""Of every such sensor."""
MAX_REGISTERS = 64
"""Most that are asked for at once."""

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
    """A reply is missing, cut, disturbed or not the one to the request: asking again may help."""


class Refused(ValueError):
    """The sensor understood and declined: asking again will not help."""


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
    """Return how many bytes the reply to a request has, unless it is a refusal."""
    function = request[1]
    if function == _READ:
        (count,) = unpack(">H", request[4:6])
        return 5 + 2 * int(count)
    return 8 if function == _WRITE else 5


REFUSAL_LENGTH = 5


def is_refusal(reply: bytes) -> bool:
    """Say whether what has come so far begins a refusal."""
    return len(reply) > 1 and bool(reply[1] & _EXCEPTION_FLAG)


def content_of(request: bytes, reply: bytes) -> bytes:
    """Return what a reply holds, once address, function, length, checksum and echo agree.

    Raises
    ------
    BadReply
        If it is not a sound reply to this request.
    Refused
        If it is sound and declines.
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
        raise Refused(_EXCEPTIONS.get(code, f"it declined with code {code}"))
    function = request[1]
    if function == _READ and content[0] != wanted - 5:
        raise BadReply(f"{content[0]} bytes of registers came instead of {wanted - 5}")
    if function == _WRITE and content != request[2:6]:
        raise BadReply("it confirmed other registers than were written")
    if function in (_LOCK, _START) and content[0] != _ACCEPTED:
        raise Refused(f"it declined with code {content[0]}")
    return content[1:] if function == _READ else content


def registers_of(content: bytes) -> tuple[int, ...]:
    """Return the values of registers that were read."""
    return unpack(f">{len(content) // 2}H", content)
