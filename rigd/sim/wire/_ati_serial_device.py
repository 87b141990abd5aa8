"""The simulated ATI Digital F/T sensor on a serial line: Modbus RTU for set-up, then a stream.

Behaviour that is not documented for the sensor is defined here:

* frames for another address, with a wrong checksum, or of other bytes get no answer;
* a request is whole as soon as its length is reached and its checksum holds; one that is still
  incomplete after 50 ms of silence is forgotten (a real line forgets after 3.5 characters, which
  no pseudo-terminal can be held to);
* starting the stream, or the lock, with another parameter than the documented ones is answered with
  0 instead of 1;
* polled gauges (input registers 0 to 5) come in their natural order;
* gains and offsets are zero after power-up; writing them while locked is an illegal address.

While it streams the sensor answers nothing; bytes sent to it are only counted, and 14 of them end
the stream. A gauge whose gain or offset is not the one of its calibration reads the end of its
range, -32768, whatever the load.
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
    PART_NUMBER,
    SERIAL_NUMBER,
    UNIT_NEWTON,
    UNIT_NEWTON_METRE,
    WIRE_ORDER,
    AtiGauges,
)

_ADDRESS = 0x0A
_READ_HOLDING, _READ_INPUT, _WRITE = 0x03, 0x04, 0x10
_STREAM, _LOCK = 0x46, 0x6A
_START_STREAM, _UNLOCKED, _LOCKED = 0x55, 0xAA, 0x18
_ILLEGAL_FUNCTION, _ILLEGAL_ADDRESS, _ILLEGAL_VALUE = 1, 2, 3
_EXCEPTION = 0x80
_MOST_READ, _MOST_WRITTEN = 125, 123

_GAINS, _OFFSETS = range(0x06), range(0x06, 0x0C)
_SESSION_ID, _STATUS, _BAUD_IS_STORED, _BAUD = 0x0C, 0x1D, 0x1E, 0x1F
_BAUDS = (1_250_000, 19_200, 115_200)
_POLLED_GAUGES = 6
_DIAGNOSTICS = 0x27
_DIAGNOSTIC_VALUES = (32768, 21450, 43690, 32771, 12, 30102)
_CALIBRATIONS, _CALIBRATION_SIZE, _CALIBRATION_COUNT = 0x00E3, 192, 16
_ERASED = 0xFFFF

_CALIBRATION_TIME = "2019/06/21 14:05:37"
_GAUGE_GAINS = (553, 561, 547, 572, 558, 543)
_GAUGE_OFFSETS = (32411, 33107, 31996, 34210, 32788, 33545)
_CALIBRATION = Struct(">8s32s4s20s36f2B6f2i6H6H")

_JAM_LENGTH = 14
_SILENCE_S = 0.05
_LONGEST_FRAME = 256
_RECORD_SIZE = 13
_UNSET_GAUGE = -32768
_RECORD_ERROR = 0x80

_REGISTERS = Struct(">2H").unpack


class AtiSerialDevice:
    """A Digital F/T sensor at the far end of a line of bytes.

    Parameters
    ----------
    rig
        With a section ``ati_serial``: serial number (FT12345 if empty), the calibration block that
        is filled (the fifteen others read 0xFFFF), and the baud register after power-up.
    simulated
        What is measured. A streamed period is the newest records its sensor has taken; none are
        drawn for the stream.
    write
        Takes the bytes of an answer, or of one period's records.
    log
        Called ``log("sensor", what, **values)`` when the sensor is set, starts or stops.

    Attributes
    ----------
    gauges : AtiGauges
        The calibration that is served.
    streaming : bool
        Whether `emit` writes records.
    frozen : bool
        Whether the sensor neither writes nor receives.
    saturate : int or None
        This gauge reads ±32767.
    status_bits : int
        The status word; if any is set, so is the error bit of every record.

    Raises
    ------
    DeviceError
        If the profile has no section ``ati_serial``.
    """

    def __init__(
        self,
        rig: RigParameters,
        simulated: SimulatedRig,
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
        self._sensor = simulated.sensor
        self._records_per_period = simulated.records_per_period
        self._write = write
        self._log = log
        self._unlocked = False
        self._at_power_up = _power_up(settings, self.gauges, rig.sensor.range)
        self._holding = dict(self._at_power_up)
        self._unset = list(range(6))
        """Gauges whose gain or offset is not the calibration's."""
        self._partial = b""
        self._received = False
        self._silent_since_s = math.inf
        self._jam = 0

    def receive(self, data: bytes) -> None:
        """Receive bytes from the line, in chunks of any length; answer at once."""
        if self.frozen:
            return
        self._received = True
        received = self._partial + data
        while received and not self.streaming:
            request, rest = _next_request(received)
            if request is None:
                self._partial = rest
                return
            self._answer(request)
            received = rest
        self._partial = b""
        if not self.streaming:
            return
        self._jam += len(received)
        if self._jam >= _JAM_LENGTH:
            self.streaming = False
            self._log("sensor", "stream stopped")

    def reset(self) -> None:
        """Restart by itself: it streams no more, and remembers no set-up."""
        self.streaming = self._unlocked = False
        self._holding = dict(self._at_power_up)
        self._unset = list(range(6))
        self._partial = b""
        self._jam = 0
        self._log("sensor", "restart")

    def power_cycle(self) -> None:
        """Simulate a power cycle, which equals a reset here."""
        self.reset()

    def tick(self, now_s: float) -> None:
        """Forget an incomplete request when the line has been silent for long."""
        if self._received:
            self._received = False
            self._silent_since_s = now_s
        elif now_s - self._silent_since_s > _SILENCE_S:
            self._partial = b""

    def emit(self) -> None:
        """Write the records of the past period in one block."""
        if not self.streaming or self.frozen:
            return
        wrenches = self._newest()
        if not wrenches:
            return
        gauges = self._read(wrenches).take(WIRE_ORDER, axis=1)
        records = np.empty((len(wrenches), _RECORD_SIZE), dtype=np.uint8)
        records[:, :12] = gauges.astype(">i2").view(np.uint8)
        checksums = records[:, :12].sum(axis=1, dtype=np.uint8) & 0x7F
        records[:, 12] = checksums | _RECORD_ERROR if self.status_bits else checksums
        self._write(records.tobytes())

    def _newest(self) -> list[Wrench]:
        if self._records_per_period == 1:
            return [self._sensor.measure()]
        return list(self._sensor.records)[-self._records_per_period :]

    def _read(self, wrenches: list[Wrench]) -> NDArray[np.int16]:
        gauges = self.gauges.read(wrenches, self.saturate)
        if self._unset:
            gauges[:, self._unset] = _UNSET_GAUGE
        return gauges

    def _answer(self, request: bytes) -> None:
        function, body = request[1], request[2:-2]
        handle = {
            _READ_HOLDING: self._read_holding,
            _READ_INPUT: self._read_input,
            _WRITE: self._write_registers,
            _STREAM: self._start_stream,
            _LOCK: self._set_lock,
        }.get(function)
        answer = _ILLEGAL_FUNCTION if handle is None else handle(body)
        if isinstance(answer, int):
            function, answer = function | _EXCEPTION, bytes((answer,))
        frame = bytes((_ADDRESS, function)) + answer
        self._write(frame + _checksum(frame).to_bytes(2, "little"))

    def _read_holding(self, body: bytes) -> bytes | int:
        self._holding[_STATUS] = self.status_bits & 0xFFFF
        return _select(self._holding, body)

    def _read_input(self, body: bytes) -> bytes | int:
        inputs = dict(enumerate(_DIAGNOSTIC_VALUES, start=_DIAGNOSTICS))
        first, _ = _REGISTERS(body)
        if first < _POLLED_GAUGES:
            newest = self._newest()[-1:] or [self._sensor.measure()]
            inputs.update(enumerate(self._read(newest)[0].astype(np.uint16).tolist()))
        return _select(inputs, body)

    def _write_registers(self, body: bytes) -> bytes | int:
        first, count = _REGISTERS(body[:4])
        data = body[5:]
        if not 1 <= count <= _MOST_WRITTEN or len(data) != 2 * count:
            return _ILLEGAL_VALUE
        values = dict(enumerate(np.frombuffer(data, ">u2").tolist(), start=first))
        writable = {_SESSION_ID, _BAUD_IS_STORED, _BAUD}
        if self._unlocked:
            writable.update(_GAINS, _OFFSETS)
        if not values.keys() <= writable:
            return _ILLEGAL_ADDRESS
        if values.get(_BAUD, 0) >= len(_BAUDS) or values.get(_BAUD_IS_STORED, 0) > 1:
            return _ILLEGAL_VALUE
        self._holding.update(values)
        self._unset = [
            gauge
            for gauge in range(6)
            if self._holding[_GAINS[gauge]] != _GAUGE_GAINS[gauge]
            or self._holding[_OFFSETS[gauge]] != _GAUGE_OFFSETS[gauge]
        ]
        self._log("sensor", "registers written", first=first, values=list(values.values()))
        return body[:4]

    def _start_stream(self, body: bytes) -> bytes | int:
        if body[0] != _START_STREAM:
            return b"\x00"
        self.streaming = True
        self._jam = 0
        self._log("sensor", "stream started")
        if self._unset:
            self._log("sensor", "gains and offsets not loaded", gauges=self._unset)
        return b"\x01"

    def _set_lock(self, body: bytes) -> bytes | int:
        if body[0] not in (_UNLOCKED, _LOCKED):
            return b"\x00"
        self._unlocked = body[0] == _UNLOCKED
        self._log("sensor", "storage unlocked" if self._unlocked else "storage locked")
        return b"\x01"


def _power_up(settings: AtiSerial, gauges: AtiGauges, ratings: tuple[float, ...]) -> dict[int, int]:
    """Return the holding registers as they are after power-up."""
    holding = dict.fromkeys((*_GAINS, *_OFFSETS, _SESSION_ID, _STATUS, _BAUD_IS_STORED), 0)
    holding[_BAUD] = _BAUDS.index(settings.baud) if settings.baud in _BAUDS else 0
    size = _CALIBRATION_SIZE * _CALIBRATION_COUNT
    holding.update(dict.fromkeys(range(_CALIBRATIONS, _CALIBRATIONS + size), _ERASED))
    content = _CALIBRATION.pack(
        (settings.serial_number or SERIAL_NUMBER).encode("ascii", "replace"),
        PART_NUMBER.encode("ascii"),
        b"",
        _CALIBRATION_TIME.encode("ascii"),
        *gauges.matrix.ravel().tolist(),
        UNIT_NEWTON,
        UNIT_NEWTON_METRE,
        *ratings,
        *gauges.counts_per_unit,
        *_GAUGE_GAINS,
        *_GAUGE_OFFSETS,
    ).ljust(2 * _CALIBRATION_SIZE, b"\0")
    block = _CALIBRATIONS + (settings.calibration - 1) * _CALIBRATION_SIZE
    holding.update(enumerate(np.frombuffer(content, ">u2").tolist(), start=block))
    return holding


def _select(registers: dict[int, int], body: bytes) -> bytes | int:
    """Return the answer to a request to read registers, or the exception."""
    first, count = _REGISTERS(body)
    if not 1 <= count <= _MOST_READ:
        return _ILLEGAL_VALUE
    addresses = range(first, first + count)
    if not all(map(registers.__contains__, addresses)):
        return _ILLEGAL_ADDRESS
    return pack_struct(f">B{count}H", 2 * count, *map(registers.__getitem__, addresses))


def _next_request(received: bytes) -> tuple[bytes | None, bytes]:
    """Find the first whole request in what came in.

    Every byte that could be the address is tried, so that noise before a request, even one that
    resembles the start of another, is skipped without loss.

    Returns
    -------
    request, rest
        The request with its checksum, or None; and what is left: behind the request, or from where
        one may have begun.
    """
    begun = len(received)
    start = received.find(_ADDRESS)
    while start >= 0:
        there = len(received) - start
        length = _request_length(received, start)
        if length <= there:
            if _checksum(received[start : start + length]) == 0:
                return received[start : start + length], received[start + length :]
        elif there < _LONGEST_FRAME:
            begun = min(begun, start)
        start = received.find(_ADDRESS, start + 1)
    return None, received[begun:]


def _request_length(received: bytes, start: int) -> int:
    """Return how long the request from `start` is: more than there is if that is not known yet."""
    there = len(received) - start
    unknown = there + 1
    if there < 4:
        return unknown
    function = received[start + 1]
    if function in (_READ_HOLDING, _READ_INPUT):
        return 8
    if function in (_STREAM, _LOCK):
        return 5
    if function == _WRITE:
        return 9 + received[start + 6] if there > 6 else unknown
    # A request with an unknown function ends where its checksum holds.
    return unknown if there > _LONGEST_FRAME or _checksum(received[start:]) else there


def _checksum_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
        table.append(crc)
    return tuple(table)


_TABLE = _checksum_table()


def _checksum(frame: bytes) -> int:
    """Return the checksum of Modbus RTU; of a frame that ends with its own it is zero."""
    crc = 0xFFFF
    for byte in frame:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 0xFF]
    return crc
