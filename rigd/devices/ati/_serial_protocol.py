"""Protocol of a Digital F/T sensor: Modbus RTU frames for set-up, then a stream of records.

A record has 13 bytes: gauges 0, 2, 4, 1, 3, 5 as big-endian int16, then a checksum of seven bits
(the sum of these bytes) with the sensor's error bit above. Records have neither a start mark nor a
counter, and the checksum also fits at one of 128 wrong offsets. Moreover, the records of a constant
load are nearly equal, so that a wrong offset that fits once may well fit again. Hence
`RecordStream` has these rules:

* after a disturbance an offset is accepted only if several consecutive records fit; these records
  are then delivered, too;
* the offset before the disturbance (or after the sensor's last message) has precedence, since most
  disturbances damage bytes and lose none;
* any other offset must be the only one that fits.
"""

from collections.abc import Sequence
from struct import pack, unpack

MODBUS_ADDRESS = 0x0A
"""Modbus address of every Digital F/T sensor."""
MAX_REGISTERS_PER_REQUEST = 64
"""Largest number of registers in one read request."""

STATUS_REGISTER = 0x001D
"""Address of the register with the status word."""
GAINS_REGISTER = 0x0000
"""Address of the first of six registers with the active amplifier gains."""
OFFSETS_REGISTER = 0x0006
"""Address of the first of six registers with the active amplifier offsets."""

_READ_FUNCTION_CODE = 0x03
"""Modbus function that reads registers."""
_WRITE_FUNCTION_CODE = 0x10
"""Modbus function that writes registers."""
_START_STREAM_FUNCTION_CODE = 0x46
"""Modbus function that starts the stream."""
_LOCK_FUNCTION_CODE = 0x6A
"""Modbus function that locks or unlocks the sensor's memory."""
_STREAM_PARAMETER = 0x55
"""Parameter of the function that starts the stream."""
_UNLOCK_CODE = 0xAA
"""Parameter that unlocks the sensor's memory."""
_LOCK_CODE = 0x18
"""Parameter that locks the sensor's memory."""
_ACCEPTED_CODE = 1
"""Code in a reply that confirms the request."""
_EXCEPTION_FLAG = 0x80
"""Bit in the function code of a Modbus exception response."""
_EXCEPTION_MEANINGS = {
    1: "it does not know this function",
    2: "it has no such register",
    3: "it does not accept this value",
    4: "it failed while carrying it out",
    5: "it needs more time",
    6: "it is busy",
}
"""Meanings of Modbus exception codes."""


class InvalidReplyError(ValueError):
    """Error: the reply is missing, damaged or for another request; repeating it may help."""


class ModbusExceptionError(ValueError):
    """Error: the sensor refuses the request (Modbus exception); repeating it does not help."""


# Modbus RTU frames


def _crc_of_byte(crc_register: int) -> int:
    """Return the Modbus checksum of a single byte, for the table of checksums."""
    for _ in range(8):
        crc_register = crc_register >> 1 ^ 0xA001 if crc_register & 1 else crc_register >> 1
    return crc_register


_CRC_TABLE = tuple(map(_crc_of_byte, range(256)))
"""Modbus checksums of all bytes."""


def crc16(data: bytes) -> int:
    """Return the Modbus checksum of data (polynomial 0xA001 reflected, start 0xFFFF)."""
    crc = 0xFFFF
    for data_byte in data:
        crc = crc >> 8 ^ _CRC_TABLE[(crc ^ data_byte) & 0xFF]
    return crc


def request_frame(function_code: int, request_content: bytes) -> bytes:
    """Return the bytes of a Modbus request to the sensor, from function code and content.

    Address and checksum are added.
    """
    address_and_content = bytes((MODBUS_ADDRESS, function_code)) + request_content
    return address_and_content + crc16(address_and_content).to_bytes(2, "little")


START_STREAM_REQUEST = request_frame(_START_STREAM_FUNCTION_CODE, bytes((_STREAM_PARAMETER,)))
"""Request that starts the stream."""
UNLOCK_REQUEST = request_frame(_LOCK_FUNCTION_CODE, bytes((_UNLOCK_CODE,)))
"""Request that unlocks the sensor's memory."""
LOCK_REQUEST = request_frame(_LOCK_FUNCTION_CODE, bytes((_LOCK_CODE,)))
"""Request that locks the sensor's memory."""


def read_registers(first_register: int, register_count: int) -> bytes:
    """Return the request that reads registers, at most `MAX_REGISTERS_PER_REQUEST`."""
    return request_frame(_READ_FUNCTION_CODE, pack(">HH", first_register, register_count))


def write_registers(first_register: int, register_values: Sequence[int]) -> bytes:
    """Return the request that writes consecutive registers."""
    packed_values = pack(f">{len(register_values)}H", *register_values)
    return request_frame(
        _WRITE_FUNCTION_CODE,
        pack(">HHB", first_register, len(register_values), len(packed_values)) + packed_values,
    )


def reply_length(request: bytes) -> int:
    """Return the length in bytes of the reply to a request, unless it is an exception response."""
    function_code = request[1]
    if function_code == _READ_FUNCTION_CODE:
        (register_count,) = unpack(">H", request[4:6])
        return 5 + 2 * int(register_count)
    return 8 if function_code == _WRITE_FUNCTION_CODE else 5


REFUSAL_LENGTH = 5
"""Length in bytes of a Modbus exception response."""


def is_refusal(reply: bytes) -> bool:
    """Return whether the bytes received so far begin a Modbus exception response."""
    return len(reply) > 1 and bool(reply[1] & _EXCEPTION_FLAG)


def reply_content(request: bytes, reply: bytes) -> bytes:
    """Return the content of a Modbus reply, without address, function and checksum.

    The reply is checked against its request. Raise `InvalidReplyError` if the reply is not a valid
    reply to this request. Raise `ModbusExceptionError` if the reply is valid and refuses the
    request.
    """
    if not reply:
        raise InvalidReplyError("no reply came")
    expected_length = REFUSAL_LENGTH if is_refusal(reply) else reply_length(request)
    if len(reply) != expected_length:
        raise InvalidReplyError(
            f"{len(reply)} bytes came instead of {expected_length} ({reply[:16].hex(' ')})"
        )
    if crc16(reply):
        raise InvalidReplyError(f"the checksum of the reply is wrong ({reply[:16].hex(' ')})")
    if reply[0] != MODBUS_ADDRESS or reply[1] & ~_EXCEPTION_FLAG != request[1]:
        raise InvalidReplyError(f"the reply belongs to another request ({reply[:16].hex(' ')})")
    reply_data = reply[2:-2]
    if is_refusal(reply):
        exception_code = reply_data[0]
        raise ModbusExceptionError(
            _EXCEPTION_MEANINGS.get(exception_code, f"it declined with code {exception_code}")
        )
    function_code = request[1]
    if function_code == _READ_FUNCTION_CODE and reply_data[0] != expected_length - 5:
        raise InvalidReplyError(
            f"{reply_data[0]} bytes of registers came instead of {expected_length - 5}"
        )
    if function_code == _WRITE_FUNCTION_CODE and reply_data != request[2:6]:
        raise InvalidReplyError("it confirmed other registers than were written")
    if (
        function_code in (_LOCK_FUNCTION_CODE, _START_STREAM_FUNCTION_CODE)
        and reply_data[0] != _ACCEPTED_CODE
    ):
        raise ModbusExceptionError(f"it declined with code {reply_data[0]}")
    return reply_data[1:] if function_code == _READ_FUNCTION_CODE else reply_data


def unpack_registers(reply_data: bytes) -> tuple[int, ...]:
    """Unpack the register values from the content of a reply."""
    return unpack(f">{len(reply_data) // 2}H", reply_data)


# Record stream

RECORD_SIZE = 13
"""Size of a record in bytes."""
RECORD_BITS = RECORD_SIZE * 11
"""Number of bits of a record on the line: each byte has a start, a parity and a stop bit."""
RECORDS_TO_SYNCHRONISE = 6
"""Number of consecutive records that must fit after a disturbance.

It is less than the number of records in a tick of 1 ms, so that no tick is without a record because
of one damaged record."""
RECORD_ERROR_BIT = 0x80
"""Bit in the last byte of a record: the sensor's status word reports an error."""

_CHECKSUM_OFFSET = RECORD_SIZE - 1
"""Offset of the checksum in a record."""
_CHECKSUM_MASK = 0x7F
"""Mask of the checksum in the last byte of a record."""
_BYTES_TO_SYNCHRONISE = RECORDS_TO_SYNCHRONISE * RECORD_SIZE
"""Number of bytes that must fit after a disturbance."""


class RecordStream:
    """Splitter that cuts the received bytes, in chunks of any length, into valid records.

    Attributes
    ----------
    synchronised : bool
        Whether the offset of the next record is known.
    records : int
        Number of records delivered so far.
    checksum_errors : int
        Number of records that did not fit at the expected offset.
    dropped_bytes : int
        Number of discarded bytes that belonged to no record.
    pending_byte_count : int
        Number of bytes that wait for more bytes to complete a record.
    """

    __slots__ = (
        "_expected_offset",
        "_stored_bytes",
        "checksum_errors",
        "dropped_bytes",
        "records",
        "synchronised",
    )

    def __init__(self) -> None:
        self.records = 0
        self.checksum_errors = 0
        self.dropped_bytes = 0
        self.start(starts_at_record=False)

    def start(self, *, starts_at_record: bool) -> None:
        """Discard the stored bytes and search for the first record; the counts continue.

        With `starts_at_record`, the next byte is probably the first byte of a record.
        """
        self._stored_bytes = b""
        self._expected_offset = 0 if starts_at_record else None
        self.synchronised = False

    @property
    def pending_byte_count(self) -> int:
        """Number of bytes that wait for more bytes to complete a record."""
        return len(self._stored_bytes)

    def feed(self, chunk: bytes) -> bytes:
        """Process received bytes; return the complete valid records, concatenated, oldest first."""
        pending_bytes = self._stored_bytes + chunk if self._stored_bytes else chunk
        valid_records = b""
        while True:
            if not self.synchronised:
                record_offset = self._find_first_record(pending_bytes)
                if record_offset is None:
                    break
                self.dropped_bytes += record_offset
                pending_bytes = pending_bytes[record_offset:]
                self.synchronised = True
            complete_records_length = len(pending_bytes) - len(pending_bytes) % RECORD_SIZE
            valid_records_length = _length_of_valid_records(pending_bytes, complete_records_length)
            valid_records = (
                valid_records + pending_bytes[:valid_records_length]
                if valid_records
                else pending_bytes[:valid_records_length]
            )
            pending_bytes = pending_bytes[valid_records_length:]
            if valid_records_length == complete_records_length:
                self._stored_bytes = pending_bytes
                break
            self.checksum_errors += 1
            self.synchronised = False
            self._expected_offset = 0
        self.records += len(valid_records) // RECORD_SIZE
        return valid_records

    def _find_first_record(self, pending_bytes: bytes) -> int | None:
        """Return the offset in bytes of the first record, or None if more bytes are needed."""
        last_searched_offset = len(pending_bytes) - _BYTES_TO_SYNCHRONISE
        first_undecided_offset = max(0, last_searched_offset + 1)
        for record_offset in range(last_searched_offset + 1):
            if not _are_next_records_valid(pending_bytes, record_offset):
                continue
            if (
                self._expected_offset is not None
                and (record_offset - self._expected_offset) % RECORD_SIZE == 0
            ):
                return record_offset
            if record_offset + _CHECKSUM_OFFSET > last_searched_offset:
                # Not all candidate offsets have arrived yet.
                first_undecided_offset = min(first_undecided_offset, record_offset)
            elif not any(
                _are_next_records_valid(pending_bytes, record_offset + byte_shift)
                for byte_shift in range(1, RECORD_SIZE)
            ):
                return record_offset
        self.dropped_bytes += first_undecided_offset
        self._stored_bytes = pending_bytes[first_undecided_offset:]
        if self._expected_offset is not None:
            self._expected_offset = (self._expected_offset - first_undecided_offset) % RECORD_SIZE
        return None


def _length_of_valid_records(record_bytes: bytes, complete_records_length: int) -> int:
    """Return the number of bytes before the first invalid record.

    Only the first `complete_records_length` bytes are checked.
    """
    for record_offset in range(0, complete_records_length, RECORD_SIZE):
        if (
            sum(record_bytes[record_offset : record_offset + _CHECKSUM_OFFSET])
            ^ record_bytes[record_offset + _CHECKSUM_OFFSET]
        ) & _CHECKSUM_MASK:
            return record_offset
    return complete_records_length


def _are_next_records_valid(pending_bytes: bytes, record_offset: int) -> bool:
    """Return whether `RECORDS_TO_SYNCHRONISE` valid records begin at `record_offset`."""
    searched_bytes = pending_bytes[record_offset : record_offset + _BYTES_TO_SYNCHRONISE]
    return _length_of_valid_records(searched_bytes, _BYTES_TO_SYNCHRONISE) == _BYTES_TO_SYNCHRONISE
