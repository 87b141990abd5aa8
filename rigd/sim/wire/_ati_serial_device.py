"""Simulated ATI Digital F/T sensor on a serial line: Modbus RTU for set-up, then a stream.

The following behaviour, which is not documented for the sensor, is defined here:

* frames for another address, with a wrong checksum, or of other bytes get no answer;
* a request is complete as soon as its length is reached and its checksum is right; a request that
  is still incomplete after 50 ms of silence is discarded (a real sensor discards it after 3.5
  characters, which a pseudo-terminal cannot reproduce);
* a request to start the stream or to lock, with an undocumented parameter, is answered with 0
  instead of 1;
* polled gauges (input registers 0 to 5) are in their natural order;
* gains and offsets are zero after power-up; writing them while locked is an illegal address.

While the sensor streams it answers nothing. Bytes sent to it are only counted, and 14 bytes end the
stream. A gauge whose gain or offset differs from its calibration reads the end of its range,
-32768, whatever the load.
"""

import math
from collections.abc import Callable
from struct import Struct
from struct import pack as pack_struct

import numpy as np
from numpy.typing import NDArray

from rigd.devices.contracts import DeviceError, Wrench
from rigd.devices.parameters import AtiSerial, RigParameters
from rigd.sim import SimulatedRig
from rigd.sim.wire._ati_gauges import (
    GAUGE_ORDER_ON_WIRE,
    PART_NUMBER,
    SERIAL_NUMBER,
    UNIT_NEWTON,
    UNIT_NEWTON_METRE,
    AtiGauges,
)

_MODBUS_ADDRESS = 0x0A
"""Modbus address of the sensor."""
_READ_HOLDING_FUNCTION, _READ_INPUT_FUNCTION, _WRITE_FUNCTION = 0x03, 0x04, 0x10
"""Modbus functions: read holding registers, read input registers, write registers."""
_STREAM_FUNCTION, _LOCK_FUNCTION = 0x46, 0x6A
"""Functions of the sensor that start the stream, and lock or unlock its memory."""
_START_STREAM_PARAMETER, _UNLOCK_PARAMETER, _LOCK_PARAMETER = 0x55, 0xAA, 0x18
"""Documented parameters of the functions for stream and lock."""
_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE = 1, 2, 3
"""Modbus exception codes."""
_EXCEPTION_BIT = 0x80
"""Bit in the function code of a Modbus exception response."""
_MAX_REGISTERS_READ, _MAX_REGISTERS_WRITTEN = 125, 123
"""Largest number of registers in one request to read, and in one to write."""

_GAIN_REGISTERS, _OFFSET_REGISTERS = range(0x06), range(0x06, 0x0C)
"""Addresses of the registers with the gauges' gains, and with their offsets."""
_SESSION_ID_REGISTER, _STATUS_REGISTER, _BAUD_IS_STORED_REGISTER, _BAUD_REGISTER = (
    0x0C,
    0x1D,
    0x1E,
    0x1F,
)
"""Addresses of further holding registers."""
_BAUD_RATES_BIT_S = (1_250_000, 19_200, 115_200)
"""Bit rates in bit/s by the value of the baud register."""
_POLLED_GAUGE_COUNT = 6
"""Number of input registers with polled gauges, from address 0 on."""
_FIRST_DIAGNOSTIC_REGISTER = 0x27
"""Address of the first input register with a diagnostic value."""
_DIAGNOSTIC_VALUES = (32768, 21450, 43690, 32771, 12, 30102)
"""Values of the diagnostic input registers."""
_FIRST_CALIBRATION_REGISTER, _CALIBRATION_SIZE, _CALIBRATION_COUNT = 0x00E3, 192, 16
"""Address of the first calibration block, registers per block, and number of blocks."""
_ERASED_REGISTER = 0xFFFF
"""Value of a register of an empty calibration block."""

_CALIBRATION_TIME = "2019/06/21 14:05:37"
"""Time of calibration in the calibration block."""
_GAUGE_GAINS = (553, 561, 547, 572, 558, 543)
"""Gains of the gauges in the calibration block."""
_GAUGE_OFFSETS = (32411, 33107, 31996, 34210, 32788, 33545)
"""Offsets of the gauges in the calibration block."""
_CALIBRATION_LAYOUT = Struct(">8s32s4s20s36f2B6f2i6H6H")
"""Layout of a calibration block."""

_STOP_BYTE_COUNT = 14
"""Number of received bytes that end the stream."""
_REQUEST_TIMEOUT_S = 0.05
"""Silence in seconds after which an incomplete request is discarded."""
_MAX_FRAME_BYTES = 256
"""Longest Modbus frame in bytes."""
_STREAM_RECORD_BYTES = 13
"""Size of a record of the stream in bytes."""
_UNCONFIGURED_GAUGE_COUNTS = -32768
"""Reading of a gauge whose gain or offset differs from the calibration."""
_RECORD_ERROR_BIT = 0x80
"""Error bit in the last byte of a record."""

_unpack_register_range = Struct(">2H").unpack
"""Unpack address of the first register and number of registers from a request."""


class AtiSerialDevice:
    """Simulated Digital F/T sensor at the end of a serial line.

    The profile needs a section ``ati_serial``: serial number (FT12345 if empty), number of the
    filled calibration block (the fifteen others read 0xFFFF), and the baud register after power-up.
    The stream sends the readings that the sensor of the simulated rig has taken in a period, and
    takes none itself. `write` sends the bytes of an answer, or the records of one period.
    ``log("sensor", what, **values)`` is called when the sensor is configured, starts or stops. The
    constructor raises `DeviceError` if the profile has no section ``ati_serial``.

    Attributes
    ----------
    gauges : AtiGauges
        Gauges of the sensor, with its calibration matrix.
    streaming : bool
        Whether the sensor streams, so that `emit` writes records.
    frozen : bool
        Whether the sensor neither receives nor writes.
    saturate : int or None
        Number of a gauge that reads ±32767; None: none.
    status_bits : int
        Status word; if any bit is set, so is the error bit of every record.
    """

    def __init__(
        self,
        rig: RigParameters,
        simulated_rig: SimulatedRig,
        write: Callable[[bytes], None],
        log: Callable[..., None],
    ) -> None:
        settings = rig.ati_serial
        if settings is None:
            raise DeviceError(
                "The profile has no section [ati_serial], which the simulated sensor on a serial "
                "line needs; copy it from a profile that has one."
            )
        self.gauges = AtiGauges(rig.sensor)
        self.streaming = False
        self.frozen = False
        self.saturate: int | None = None
        self.status_bits = 0
        self._sensor = simulated_rig.sensor
        self._records_per_period = simulated_rig.records_per_period
        self._write = write
        self._log = log
        self._unlocked = False
        self._power_up_registers = _holding_registers_at_power_up(
            settings, self.gauges, rig.sensor.range
        )
        self._holding_registers = dict(self._power_up_registers)
        self._unconfigured_gauges = list(range(6))
        """Numbers of the gauges whose gain or offset differs from the calibration."""
        self._incomplete_request = b""
        self._has_received = False
        self._silent_since_s = math.inf
        self._bytes_while_streaming = 0

    def receive(self, data: bytes) -> None:
        """Process received bytes, in chunks of any length; answer complete requests at once."""
        if self.frozen:
            return
        self._has_received = True
        received_bytes = self._incomplete_request + data
        while received_bytes and not self.streaming:
            modbus_request, remaining_bytes = _next_request(received_bytes)
            if modbus_request is None:
                self._incomplete_request = remaining_bytes
                return
            self._answer(modbus_request)
            received_bytes = remaining_bytes
        self._incomplete_request = b""
        if not self.streaming:
            return
        self._bytes_while_streaming += len(received_bytes)
        if self._bytes_while_streaming >= _STOP_BYTE_COUNT:
            self.streaming = False
            self._log("sensor", "stream stopped")

    def reset(self) -> None:
        """Restart the sensor as by its own watchdog: it stops streaming and loses its set-up."""
        self.streaming = self._unlocked = False
        self._holding_registers = dict(self._power_up_registers)
        self._unconfigured_gauges = list(range(6))
        self._incomplete_request = b""
        self._bytes_while_streaming = 0
        self._log("sensor", "restart")

    def power_cycle(self) -> None:
        """Restart the sensor as after a loss of power; it equals `reset` here."""
        self.reset()

    def tick(self, now_s: float) -> None:
        """Discard an incomplete request when the line has been silent for long enough."""
        if self._has_received:
            self._has_received = False
            self._silent_since_s = now_s
        elif now_s - self._silent_since_s > _REQUEST_TIMEOUT_S:
            self._incomplete_request = b""

    def emit(self) -> None:
        """Write the gauge records of the past period to the serial line, if the sensor streams."""
        if not self.streaming or self.frozen:
            return
        wrenches = self._newest_wrenches()
        if not wrenches:
            return
        gauge_counts = self._read_gauges(wrenches).take(GAUGE_ORDER_ON_WIRE, axis=1)
        stream_records = np.empty((len(wrenches), _STREAM_RECORD_BYTES), dtype=np.uint8)
        stream_records[:, :12] = gauge_counts.astype(">i2").view(np.uint8)
        checksums = stream_records[:, :12].sum(axis=1, dtype=np.uint8) & 0x7F
        stream_records[:, 12] = checksums | _RECORD_ERROR_BIT if self.status_bits else checksums
        self._write(stream_records.tobytes())

    def _newest_wrenches(self) -> list[Wrench]:
        """Return the wrenches of the past period, in N and N·m.

        They are the newest readings of a streaming sensor, or one new reading.
        """
        if self._records_per_period == 1:
            return [self._sensor.measure()]
        return list(self._sensor.records)[-self._records_per_period :]

    def _read_gauges(self, wrenches: list[Wrench]) -> NDArray[np.int16]:
        """Return the gauge counts under wrenches.

        Gauges whose gain or offset differs from the calibration read the end of their range.
        """
        gauge_counts = self.gauges.read_counts(wrenches, self.saturate)
        if self._unconfigured_gauges:
            gauge_counts[:, self._unconfigured_gauges] = _UNCONFIGURED_GAUGE_COUNTS
        return gauge_counts

    def _answer(self, request: bytes) -> None:
        """Answer a complete request, by the requested data or an exception response."""
        function_code, request_content = request[1], request[2:-2]
        request_handler = {
            _READ_HOLDING_FUNCTION: self._read_holding_registers,
            _READ_INPUT_FUNCTION: self._read_input_registers,
            _WRITE_FUNCTION: self._write_registers,
            _STREAM_FUNCTION: self._start_stream,
            _LOCK_FUNCTION: self._set_storage_lock,
        }.get(function_code)
        reply_content = (
            _ILLEGAL_FUNCTION if request_handler is None else request_handler(request_content)
        )
        if isinstance(reply_content, int):
            function_code, reply_content = function_code | _EXCEPTION_BIT, bytes((reply_content,))
        reply_frame = bytes((_MODBUS_ADDRESS, function_code)) + reply_content
        self._write(reply_frame + _checksum(reply_frame).to_bytes(2, "little"))

    def _read_holding_registers(self, request_content: bytes) -> bytes | int:
        """Return the reply content to a request for holding registers, or an exception code."""
        self._holding_registers[_STATUS_REGISTER] = self.status_bits & 0xFFFF
        return _answer_with_registers(self._holding_registers, request_content)

    def _read_input_registers(self, request_content: bytes) -> bytes | int:
        """Return the reply content to a request for input registers, or an exception code."""
        input_registers = dict(enumerate(_DIAGNOSTIC_VALUES, start=_FIRST_DIAGNOSTIC_REGISTER))
        first_register, _ = _unpack_register_range(request_content)
        if first_register < _POLLED_GAUGE_COUNT:
            newest_wrenches = self._newest_wrenches()[-1:] or [self._sensor.measure()]
            input_registers.update(
                enumerate(self._read_gauges(newest_wrenches)[0].astype(np.uint16).tolist())
            )
        return _answer_with_registers(input_registers, request_content)

    def _write_registers(self, request_content: bytes) -> bytes | int:
        """Write registers; return the content of the answer, or an exception code."""
        first_register, register_count = _unpack_register_range(request_content[:4])
        register_bytes = request_content[5:]
        if (
            not 1 <= register_count <= _MAX_REGISTERS_WRITTEN
            or len(register_bytes) != 2 * register_count
        ):
            return _ILLEGAL_VALUE
        written_values = dict(
            enumerate(np.frombuffer(register_bytes, ">u2").tolist(), start=first_register)
        )
        writable_registers = {_SESSION_ID_REGISTER, _BAUD_IS_STORED_REGISTER, _BAUD_REGISTER}
        if self._unlocked:
            writable_registers.update(_GAIN_REGISTERS, _OFFSET_REGISTERS)
        if not written_values.keys() <= writable_registers:
            return _ILLEGAL_ADDRESS
        if (
            written_values.get(_BAUD_REGISTER, 0) >= len(_BAUD_RATES_BIT_S)
            or written_values.get(_BAUD_IS_STORED_REGISTER, 0) > 1
        ):
            return _ILLEGAL_VALUE
        self._holding_registers.update(written_values)
        self._unconfigured_gauges = [
            gauge
            for gauge in range(6)
            if self._holding_registers[_GAIN_REGISTERS[gauge]] != _GAUGE_GAINS[gauge]
            or self._holding_registers[_OFFSET_REGISTERS[gauge]] != _GAUGE_OFFSETS[gauge]
        ]
        self._log(
            "sensor",
            "registers written",
            first=first_register,
            values=list(written_values.values()),
        )
        return request_content[:4]

    def _start_stream(self, request_content: bytes) -> bytes | int:
        """Start the stream of records; return the content of the answer."""
        if request_content[0] != _START_STREAM_PARAMETER:
            return b"\x00"
        self.streaming = True
        self._bytes_while_streaming = 0
        self._log("sensor", "stream started")
        if self._unconfigured_gauges:
            self._log("sensor", "gains and offsets not loaded", gauges=self._unconfigured_gauges)
        return b"\x01"

    def _set_storage_lock(self, request_content: bytes) -> bytes | int:
        """Lock or unlock the sensor's storage; return the content of the answer."""
        if request_content[0] not in (_UNLOCK_PARAMETER, _LOCK_PARAMETER):
            return b"\x00"
        self._unlocked = request_content[0] == _UNLOCK_PARAMETER
        self._log("sensor", "storage unlocked" if self._unlocked else "storage locked")
        return b"\x01"


def _holding_registers_at_power_up(
    settings: AtiSerial, gauges: AtiGauges, axis_ranges: tuple[float, ...]
) -> dict[int, int]:
    """Return the values of the holding registers after power-up, by address."""
    holding_registers = dict.fromkeys(
        (
            *_GAIN_REGISTERS,
            *_OFFSET_REGISTERS,
            _SESSION_ID_REGISTER,
            _STATUS_REGISTER,
            _BAUD_IS_STORED_REGISTER,
        ),
        0,
    )
    holding_registers[_BAUD_REGISTER] = (
        _BAUD_RATES_BIT_S.index(settings.baud) if settings.baud in _BAUD_RATES_BIT_S else 0
    )
    register_count = _CALIBRATION_SIZE * _CALIBRATION_COUNT
    holding_registers.update(
        dict.fromkeys(
            range(_FIRST_CALIBRATION_REGISTER, _FIRST_CALIBRATION_REGISTER + register_count),
            _ERASED_REGISTER,
        )
    )
    calibration_bytes = _CALIBRATION_LAYOUT.pack(
        (settings.serial_number or SERIAL_NUMBER).encode("ascii", "replace"),
        PART_NUMBER.encode("ascii"),
        b"",
        _CALIBRATION_TIME.encode("ascii"),
        *gauges.matrix.ravel().tolist(),
        UNIT_NEWTON,
        UNIT_NEWTON_METRE,
        *axis_ranges,
        *gauges.counts_per_unit,
        *_GAUGE_GAINS,
        *_GAUGE_OFFSETS,
    ).ljust(2 * _CALIBRATION_SIZE, b"\0")
    calibration_block_register = (
        _FIRST_CALIBRATION_REGISTER + (settings.calibration - 1) * _CALIBRATION_SIZE
    )
    holding_registers.update(
        enumerate(
            np.frombuffer(calibration_bytes, ">u2").tolist(), start=calibration_block_register
        )
    )
    return holding_registers


def _answer_with_registers(
    registers_by_address: dict[int, int], request_content: bytes
) -> bytes | int:
    """Return the content of the reply to a Modbus read request, or an exception code."""
    first_register, register_count = _unpack_register_range(request_content)
    if not 1 <= register_count <= _MAX_REGISTERS_READ:
        return _ILLEGAL_VALUE
    register_addresses = range(first_register, first_register + register_count)
    if not all(map(registers_by_address.__contains__, register_addresses)):
        return _ILLEGAL_ADDRESS
    return pack_struct(
        f">B{register_count}H",
        2 * register_count,
        *map(registers_by_address.__getitem__, register_addresses),
    )


def _next_request(received_bytes: bytes) -> tuple[bytes | None, bytes]:
    """Return the first complete request in received bytes, and the remaining bytes.

    Every byte that could be the address is tried. So noise before a request is skipped without
    loss, even noise that resembles the start of another request.

    The request includes its checksum and is None if there is none. The remaining bytes are those
    after the request, or from the first position at which a request may have begun.
    """
    possible_request_start = len(received_bytes)
    request_start = received_bytes.find(_MODBUS_ADDRESS)
    while request_start >= 0:
        available_bytes = len(received_bytes) - request_start
        request_length = _request_length(received_bytes, request_start)
        if request_length <= available_bytes:
            if _checksum(received_bytes[request_start : request_start + request_length]) == 0:
                return received_bytes[
                    request_start : request_start + request_length
                ], received_bytes[request_start + request_length :]
        elif available_bytes < _MAX_FRAME_BYTES:
            possible_request_start = min(possible_request_start, request_start)
        request_start = received_bytes.find(_MODBUS_ADDRESS, request_start + 1)
    return None, received_bytes[possible_request_start:]


def _request_length(received_bytes: bytes, request_start: int) -> int:
    """Return the length in bytes of the request at `request_start`.

    If the length is unknown, a length is returned that exceeds the data.
    """
    available_bytes = len(received_bytes) - request_start
    length_if_incomplete = available_bytes + 1
    if available_bytes < 4:
        return length_if_incomplete
    function_code = received_bytes[request_start + 1]
    if function_code in (_READ_HOLDING_FUNCTION, _READ_INPUT_FUNCTION):
        return 8
    if function_code in (_STREAM_FUNCTION, _LOCK_FUNCTION):
        return 5
    if function_code == _WRITE_FUNCTION:
        return (
            9 + received_bytes[request_start + 6] if available_bytes > 6 else length_if_incomplete
        )
    # A request with an unknown function ends where its checksum holds.
    return (
        length_if_incomplete
        if available_bytes > _MAX_FRAME_BYTES or _checksum(received_bytes[request_start:])
        else available_bytes
    )


def _checksum_table() -> tuple[int, ...]:
    """Return the Modbus checksums of all bytes."""
    checksum_table = []
    for byte_value in range(256):
        crc = byte_value
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
        checksum_table.append(crc)
    return tuple(checksum_table)


_CHECKSUM_TABLE = _checksum_table()
"""Modbus checksums of all bytes."""


def _checksum(frame: bytes) -> int:
    """Return the Modbus RTU checksum of a frame; it is 0 for a frame with a valid checksum."""
    crc = 0xFFFF
    for data_byte in frame:
        crc = crc >> 8 ^ _CHECKSUM_TABLE[(crc ^ data_byte) & 0xFF]
    return crc
