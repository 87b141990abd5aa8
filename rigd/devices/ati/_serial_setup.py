"""The serial port of a Digital F/T sensor, and its set-up over Modbus while it does not stream.

Pyserial opens and configures the port; the loop then reads it without blocking and without
pyserial, whose own reading costs several system calls for what is one here.
"""

import os
import select
import termios
import time
from contextlib import suppress
from itertools import chain
from pathlib import Path

import serial

from rigd.devices.ati import _serial_protocol as modbus
from rigd.devices.ati._calibration import (
    BLOCK_REGISTERS,
    CalibrationBlock,
    first_register,
    parse_block,
    same_serial_number,
)
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import AtiSerial

_READ_SIZE = 65_536


def held_back(gap_s: float, port: str) -> str:
    """Describe that an adapter holds records back, and the remedy.

    Parameters
    ----------
    gap_s
        Time between two blocks of records.
    port
        File name of the port.
    """
    name = Path(os.path.realpath(port)).name
    if not name.startswith("ttyUSB"):
        name = "ttyUSB…"
    return (
        f"The records arrive in blocks every {1e3 * gap_s:.2g} ms: the latency timer of the USB "
        "adapter holds them back. Set it to 1 ms (setserial low_latency, or write 1 to "
        f"/sys/bus/usb-serial/devices/{name}/latency_timer), or use an adapter without one."
    )


class SerialLine:
    """An open port: 8 data bits, even parity, one stop bit; no other process may open it meanwhile.

    Parameters
    ----------
    port
        File name of the port.
    baud
        Bits a second; any that the adapter can make.
    device
        Device at the other end, for messages.

    Attributes
    ----------
    low_latency : bool
        The adapter's driver passes on at once what has arrived. A USB adapter without it may
        hold records for 16 ms.

    Raises
    ------
    DeviceError
        If it cannot be opened; the message says what to do.
    """

    def __init__(self, port: str, baud: int, device: str) -> None:
        self._device = device
        try:
            # vmin = 1 (by inter_byte_timeout): distinguishes an empty line from a dead one.
            self._serial = serial.Serial(
                port,
                baud,
                bytesize=serial.EIGHTBITS,
                parity=_parity(port),
                stopbits=serial.STOPBITS_ONE,
                timeout=0,
                inter_byte_timeout=0.0,
                exclusive=True,
            )
        except (serial.SerialException, termios.error, OSError, ValueError) as error:
            raise DeviceError(
                f"{device}: the serial port {port} cannot be opened at {baud} baud "
                f"({_reason(error)}); {_remedy(error)}."
            ) from None
        self._fd = self._serial.fileno()
        self._selectable = [self._fd]
        self.low_latency = False
        # Not every driver offers it; pyserial then reports a value it could not set.
        with suppress(ValueError, OSError, termios.error):
            self._serial.set_low_latency_mode(True)
            self.low_latency = True

    def read(self) -> bytes:
        """Return all that has arrived; nothing if nothing has.

        Raises
        ------
        DeviceError
            If the line is gone.
        """
        data = b""
        while True:  # a short chunk need not be the last: the kernel moves bytes on with each read
            try:
                chunk = os.read(self._fd, _READ_SIZE)
            except BlockingIOError:
                return data
            except OSError as error:
                raise self._gone(error.strerror) from None
            if not chunk:
                raise self._gone("hung up")
            data = data + chunk if data else chunk

    def write(self, data: bytes) -> None:
        """Send some bytes; so few that they always fit into the kernel's buffer.

        Raises
        ------
        DeviceError
            If the line is gone or does not take them.
        """
        try:
            os.write(self._fd, data)
        except OSError as error:
            raise self._gone(error.strerror) from None

    def wait(self, timeout_s: float) -> None:
        """Return as soon as something may have arrived, or after the timeout.

        Raises
        ------
        DeviceError
            If the line is gone.
        """
        try:
            select.select(self._selectable, (), (), timeout_s)
        except OSError as error:
            raise self._gone(error.strerror) from None
        except ValueError as error:  # a descriptor beyond what select knows
            raise self._gone(str(error)) from None

    def transact(self, request: bytes, length: int, timeout_s: float) -> bytes:
        """Send a request and return the reply: `length` bytes or more, fewer if no more arrive.

        Earlier bytes are discarded.
        """
        self.read()
        self.write(request)
        reply = b""
        end_ns = time.monotonic_ns() + int(timeout_s * 1e9)
        while len(reply) < length and (left_ns := end_ns - time.monotonic_ns()) > 0:
            self.wait(left_ns * 1e-9)
            reply += self.read()
        return reply

    def drain(self, quiet_s: float, limit_s: float) -> bool:
        """Discard received bytes until the line is silent.

        Returns
        -------
        bool
            Whether the line was silent within the limit.
        """
        now = time.monotonic()
        last_received_s, end = now, now + limit_s
        while now < end:
            if self.read():
                last_received_s = now
            elif now - last_received_s >= quiet_s:
                return True
            self.wait(quiet_s)
            now = time.monotonic()
        return False

    def close(self) -> None:
        """Release the port; harmless when repeated."""
        with suppress(OSError, termios.error):
            self._serial.close()

    def _gone(self, why: str | None) -> DeviceError:
        return DeviceError(
            f"{self._device}: the serial port {self._serial.port} has failed ({why}); check "
            "adapter and cable, then connect again."
        )


def _parity(port: str) -> str:
    """Return even parity; but none for a pseudo-terminal, which refuses to be set to it twice."""
    is_pseudo = os.path.realpath(port).startswith("/dev/pts/")
    return str(serial.PARITY_NONE if is_pseudo else serial.PARITY_EVEN)


def _reason(error: Exception) -> str:
    number = error.args[0] if error.args else None
    return os.strerror(number) if isinstance(number, int) else str(error)


def _remedy(error: Exception) -> str:
    if isinstance(error, BlockingIOError) or "exclusively lock" in str(error):
        return "another program has it open: close that first"
    if isinstance(error, ValueError):
        return "check ati_serial.baud, and whether the adapter supports it"
    return (
        "check ati_serial.port, whether the adapter is plugged in and whether you may use it "
        "(group dialout), or start the simulated rig: rigd simulate --profile PROFILE"
    )


# Set-up over Modbus

SILENCE_S = 0.002
"""Modbus: a frame is over when the line has been silent for this long."""

# Anything sent while the sensor streams stops it; other drivers send 14 bytes.
_JAM = bytes(range(1, 15))
_JAM_TRIES = 3
_QUIET_S = 0.05
_DRAIN_LIMIT_S = 0.5
_REPLY_TIMEOUT_S = 0.3
_TRIES = 3
# A repeated request may be answered twice, and no reply states which registers it holds.
_LATE_REPLY_S = 0.5


class SerialSetup:
    """Requests to the sensor before and after the stream.

    Every method raises `DeviceError` if the line is gone, or the sensor does not answer or answers
    wrongly.

    Parameters
    ----------
    line
        Open line.
    settings
        Settings of the sensor.
    name
        Name of the sensor, for messages.
    """

    def __init__(self, line: SerialLine, settings: AtiSerial, name: str) -> None:
        self._line = line
        self._settings = settings
        self._name = name

    def stop_streaming(self) -> None:
        """Stop the stream, in whatever state the sensor is."""
        for _ in range(_JAM_TRIES):
            self._line.write(_JAM)
            if self._line.drain(_QUIET_S, _DRAIN_LIMIT_S):
                return
        raise DeviceError(
            f"{self._name}: it continues to send although it was commanded to stop; switch it off "
            "and on, and check that no other device is on this line."
        )

    def read_status(self) -> int:
        """Return the status word."""
        return self._read(modbus.STATUS_WORD, 1, "report its status")[0]

    def read_block(self) -> CalibrationBlock:
        """Return the calibration that the profile selects; verify the serial number."""
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
        """Set the amplifiers as for the calibration."""
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
        active = self._read(modbus.ACTIVE_GAINS, len(written), "report its gains and offsets")
        if active != written:
            raise DeviceError(
                f"{self._name}: gains and offsets read back as {active}, where {written} were "
                "written. Switch it off and on; without them its calibration does not hold."
            )

    def start_streaming(self) -> bytes:
        """Start the stream; return the bytes that arrived after the reply."""
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
        """Return the content of the reply to a request; repeat a request that failed."""
        problem = ""
        for tries in range(_TRIES):
            time.sleep(SILENCE_S)
            length = modbus.reply_length(request)
            reply = self._line.transact(request, length, _REPLY_TIMEOUT_S)
            if tries:
                self._line.drain(_LATE_REPLY_S, 2 * _LATE_REPLY_S)
            try:
                return modbus.content_of(request, reply)
            except modbus.ExceptionResponse as error:
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
            chunk = min(modbus.MAX_REGISTERS, count - len(registers))
            request = modbus.read_registers(first + len(registers), chunk)
            registers += modbus.registers_of(self._ask(request, what))
        return registers
