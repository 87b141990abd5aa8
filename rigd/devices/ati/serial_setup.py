"""What a Digital F/T sensor is asked and told over Modbus, while it does not stream."""

import time
from itertools import chain

from rigd.devices.ati import modbus
from rigd.devices.ati.calibration import same_serial_number
from rigd.devices.ati.calibration_block import (
    BLOCK_REGISTERS,
    CalibrationBlock,
    first_register,
    parse_block,
)
from rigd.devices.ati.serial_line import SerialLine
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import AtiSerial

SILENCE_S = 0.002
"""Modbus: a frame is over when the line has been silent for this long."""

# Anything sent while the sensor streams stops it; other drivers send 14 bytes.
_JAM = bytes(range(1, 15))
_JAM_TRIES = 3
_QUIET_S = 0.05
_DRAIN_LIMIT_S = 0.5
_REPLY_TIMEOUT_S = 0.3
_TRIES = 3
# What was asked for again may be answered twice, and no reply says which registers it holds.
_LATE_REPLY_S = 0.5


class SerialSetup:
    """The sensor, as it is spoken to before and after the stream.

    Every method raises `DeviceError` if the line is gone, or if the sensor does not answer, or not
    as it should.

    Parameters
    ----------
    line
        Open.
    settings
        Of the sensor.
    name
        Of the sensor, for messages.
    """

    def __init__(self, line: SerialLine, settings: AtiSerial, name: str) -> None:
        self._line = line
        self._settings = settings
        self._name = name

    def stop_streaming(self) -> None:
        """Silence the sensor, whatever it was doing."""
        for _ in range(_JAM_TRIES):
            self._line.write(_JAM)
            if self._line.drain(_QUIET_S, _DRAIN_LIMIT_S):
                return
        raise DeviceError(
            f"{self._name}: it goes on sending although it was told to stop; switch it off and on, "
            "and check that no other device is on this line."
        )

    def read_status(self) -> int:
        """Return its status word."""
        return self._read(modbus.STATUS_WORD, 1, "tell its status")[0]

    def read_block(self) -> CalibrationBlock:
        """Return the calibration that the profile chooses, of the sensor that it names."""
        number, wanted = self._settings.calibration, self._settings.serial_number
        what = f"read out calibration {number}"
        registers = self._read(first_register(number), BLOCK_REGISTERS, what)
        try:
            block = parse_block(registers)
        except ValueError as error:
            raise DeviceError(f"{self._name}, ati_serial.calibration {number}: {error}") from None
        found = block.calibration.serial_number
        if not same_serial_number(wanted, found):
            raise DeviceError(
                f"{self._name}: its serial number is {found or 'empty'}, where the profile asks "
                f"for {wanted} (ati_serial.serial_number). Check which sensor is on the rig."
            )
        return block

    def load_amplifiers(self, block: CalibrationBlock) -> None:
        """Make the amplifiers' settings those that the calibration was done with."""
        self._ask(modbus.UNLOCK, "unlock its memory")
        try:
            for first, values in (
                (modbus.ACTIVE_GAINS, block.gains),
                (modbus.ACTIVE_OFFSETS, block.offsets),
            ):
                self._ask(modbus.write_registers(first, values), "load gains and offsets")
        finally:
            self._ask(modbus.LOCK, "lock its memory")
        written = tuple(chain(block.gains, block.offsets))
        active = self._read(modbus.ACTIVE_GAINS, len(written), "tell its gains and offsets")
        if active != written:
            raise DeviceError(
                f"{self._name}: gains and offsets read back as {active}, where {written} were "
                "written. Switch it off and on; without them its calibration does not hold."
            )

    def start_streaming(self) -> bytes:
        """Have it stream; return what has come behind its reply already."""
        request = modbus.START_STREAMING
        time.sleep(SILENCE_S)
        length = modbus.reply_length(request)
        reply = self._line.transact(request, length, _REPLY_TIMEOUT_S)
        try:
            modbus.content_of(request, reply[:length])
        except ValueError as error:
            raise DeviceError(f"{self._name}: it does not start streaming: {error}.") from None
        return reply[length:]

    def _ask(self, request: bytes, what: str) -> bytes:
        """Return what the reply to a request holds; disturbed ones are asked for again."""
        problem = ""
        for tries in range(_TRIES):
            time.sleep(SILENCE_S)
            length = modbus.reply_length(request)
            reply = self._line.transact(request, length, _REPLY_TIMEOUT_S)
            if tries:
                self._line.drain(_LATE_REPLY_S, 2 * _LATE_REPLY_S)
            try:
                return modbus.content_of(request, reply)
            except modbus.Refused as error:
                raise DeviceError(
                    f"{self._name}: asked to {what}, it refused: {error}. Check that it is a "
                    "Digital F/T sensor, and ati_serial.calibration."
                ) from None
            except modbus.BadReply as error:
                problem = str(error)
        raise DeviceError(
            f"{self._name}: asked to {what}, it gave no usable reply in {_TRIES} tries: {problem}. "
            "Check power, cable (A and B swapped?), ati_serial.port and ati_serial.baud."
        )

    def _read(self, first: int, count: int, what: str) -> tuple[int, ...]:
        registers: tuple[int, ...] = ()
        while len(registers) < count:
            piece = min(modbus.MAX_REGISTERS, count - len(registers))
            request = modbus.read_registers(first + len(registers), piece)
            registers += modbus.registers_of(self._ask(request, what))
        return registers
