"""Serial port of a Digital F/T sensor, and its set-up by Modbus while it does not stream.

Pyserial opens and configures the port. The loop then reads the port without blocking and without
pyserial, which needs several system calls per read instead of one.
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
    BLOCK_REGISTER_COUNT,
    CalibrationBlock,
    calibration_block_address,
    parse_block,
    same_serial_number,
)
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import AtiSerial

_MAX_READ_BYTES = 65_536
"""Largest number of bytes in one read from the port."""


def describe_adapter_delay(block_interval_s: float, port: str) -> str:
    """Return the message that a USB adapter delays records, with the remedy.

    `block_interval_s` is the time between two blocks of records.
    """
    adapter_name = Path(os.path.realpath(port)).name
    if not adapter_name.startswith("ttyUSB"):
        adapter_name = "ttyUSB…"
    return (
        f"The records arrive in blocks every {1e3 * block_interval_s:.2g} ms: the latency timer of "
        "the USB adapter holds them back. Set it to 1 ms (setserial low_latency, or write 1 to "
        f"/sys/bus/usb-serial/devices/{adapter_name}/latency_timer), or use an adapter without one."
    )


class SerialLine:
    """Open serial port: 8 data bits, even parity, one stop bit; locked against other processes.

    `port` is a file name, and `baud` any bit rate in bit/s that the adapter supports. `device_name`
    is the name of the device at the other end, for messages. The constructor raises `DeviceError`
    if the port cannot be opened; the message states the remedy.

    Attributes
    ----------
    low_latency : bool
        Whether the adapter's driver delivers received bytes at once. Without this mode a USB
        adapter may delay records by 16 ms.
    """

    def __init__(self, port: str, baud: int, device_name: str) -> None:
        self._device = device_name
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
                f"{device_name}: the serial port {port} cannot be opened at {baud} baud "
                f"({_port_error_reason(error)}); {_opening_remedy(error)}."
            ) from None
        self._fd = self._serial.fileno()
        self._descriptors = [self._fd]
        self.low_latency = False
        # Not every adapter's driver supports it; pyserial then raises an error.
        with suppress(ValueError, OSError, termios.error):
            self._serial.set_low_latency_mode(True)
            self.low_latency = True

    def read(self) -> bytes:
        """Return all bytes that have arrived on the serial line; empty if there are none.

        Raise `DeviceError` if the line is gone.
        """
        arrived_bytes = b""
        while True:  # a short chunk need not be the last: the kernel moves bytes on with each read
            try:
                read_bytes = os.read(self._fd, _MAX_READ_BYTES)
            except BlockingIOError:
                return arrived_bytes
            except OSError as error:
                raise self._failure_error(error.strerror) from None
            if not read_bytes:
                raise self._failure_error("hung up")
            arrived_bytes = arrived_bytes + read_bytes if arrived_bytes else read_bytes

    def write(self, data: bytes) -> None:
        """Send a few bytes, which always fit into the kernel's buffer.

        Raise `DeviceError` if the line has failed or does not accept the bytes.
        """
        try:
            os.write(self._fd, data)
        except OSError as error:
            raise self._failure_error(error.strerror) from None

    def wait(self, timeout_s: float) -> None:
        """Wait until bytes may have arrived on the serial line, at most for `timeout_s`.

        Raise `DeviceError` if the line is gone.
        """
        try:
            select.select(self._descriptors, (), (), timeout_s)
        except OSError as error:
            raise self._failure_error(error.strerror) from None
        except ValueError as error:  # a file descriptor too large for select
            raise self._failure_error(str(error)) from None

    def transact(self, request: bytes, min_reply_length: int, timeout_s: float) -> bytes:
        """Send a request; return the received bytes.

        They are at least `min_reply_length` bytes, unless `timeout_s` passes.
        Bytes that arrived before the request are discarded.
        """
        self.read()
        self.write(request)
        received_bytes = b""
        end_ns = time.monotonic_ns() + int(timeout_s * 1e9)
        while (
            len(received_bytes) < min_reply_length
            and (remaining_ns := end_ns - time.monotonic_ns()) > 0
        ):
            self.wait(remaining_ns * 1e-9)
            received_bytes += self.read()
        return received_bytes

    def discard_until_silent(self, silence_s: float, time_limit_s: float) -> bool:
        """Discard received bytes until the line has been silent for `silence_s`.

        Return whether the line became silent before `time_limit_s` had passed.
        """
        now_s = time.monotonic()
        last_received_s, end_s = now_s, now_s + time_limit_s
        while now_s < end_s:
            if self.read():
                last_received_s = now_s
            elif now_s - last_received_s >= silence_s:
                return True
            self.wait(silence_s)
            now_s = time.monotonic()
        return False

    def close(self) -> None:
        """Close the serial port; harmless when repeated."""
        with suppress(OSError, termios.error):
            self._serial.close()

    def _failure_error(self, reason: str | None) -> DeviceError:
        """Return the error for a port that has failed."""
        return DeviceError(
            f"{self._device}: the serial port {self._serial.port} has failed ({reason}); check "
            "adapter and cable, then connect again."
        )


def _parity(port: str) -> str:
    """Return the parity of a serial port: even, but none for a pseudo-terminal.

    A pseudo-terminal refuses even parity.
    """
    is_pseudo_terminal = os.path.realpath(port).startswith("/dev/pts/")
    return str(serial.PARITY_NONE if is_pseudo_terminal else serial.PARITY_EVEN)


def _port_error_reason(error: Exception) -> str:
    """Return the reason of a serial port's error in words."""
    error_number = error.args[0] if error.args else None
    return os.strerror(error_number) if isinstance(error_number, int) else str(error)


def _opening_remedy(error: Exception) -> str:
    """Return the remedy for a serial port that cannot be opened, chosen by the error."""
    if isinstance(error, BlockingIOError) or "exclusively lock" in str(error):
        return "another program has it open: close that first"
    if isinstance(error, ValueError):
        return "check ati_serial.baud, and whether the adapter supports it"
    return (
        "check ati_serial.port, whether the adapter is plugged in and whether you may use it "
        "(group dialout), or start the simulated rig: rigd simulate --profile PROFILE"
    )


# Set-up over Modbus

FRAME_SILENCE_S = 0.002
"""Silence in seconds that ends a Modbus frame."""

_STOP_BYTES = bytes(range(1, 15))
"""Bytes sent to stop the stream; any bytes stop it, and other drivers send 14."""
_STOP_ATTEMPTS = 3
"""Number of attempts to stop the stream."""
_STREAM_STOPPED_SILENCE_S = 0.05
"""Silence in seconds after which the stream counts as stopped."""
_DRAIN_TIME_LIMIT_S = 0.5
"""Time in seconds to wait for silence after one attempt to stop the stream."""
_REPLY_TIMEOUT_S = 0.3
"""Time in seconds to wait for the reply to one request."""
_REQUEST_ATTEMPTS = 3
"""Number of attempts of one request."""
_LATE_REPLY_WAIT_S = 0.5
"""Silence in seconds to wait for after a repeated request.

A repeated request may be answered twice, and no reply states which registers it holds."""


class SerialSetup:
    """Set-up of a Digital F/T sensor by Modbus requests, before and after the stream.

    Every method raises `DeviceError` if the line has failed, or the sensor does not answer or
    answers wrongly.
    """

    def __init__(self, line: SerialLine, settings: AtiSerial, device_name: str) -> None:
        self._line = line
        self._settings = settings
        self._name = device_name

    def stop_streaming(self) -> None:
        """Stop the sensor's stream of records; harmless if the sensor does not stream."""
        for _ in range(_STOP_ATTEMPTS):
            self._line.write(_STOP_BYTES)
            if self._line.discard_until_silent(_STREAM_STOPPED_SILENCE_S, _DRAIN_TIME_LIMIT_S):
                return
        raise DeviceError(
            f"{self._name}: it continues to send although it was commanded to stop; switch it off "
            "and on, and check that no other device is on this line."
        )

    def read_status(self) -> int:
        """Read the status word of the Digital F/T sensor by Modbus, and return it."""
        return self._read_register_values(modbus.STATUS_REGISTER, 1, "report its status")[0]

    def read_calibration_block(self) -> CalibrationBlock:
        """Read the calibration block that the profile selects, and check its serial number."""
        calibration_number, profile_number = (
            self._settings.calibration,
            self._settings.serial_number,
        )
        action_text = f"read out calibration {calibration_number}"
        registers = self._read_register_values(
            calibration_block_address(calibration_number), BLOCK_REGISTER_COUNT, action_text
        )
        try:
            calibration_block = parse_block(registers)
        except ValueError as error:
            raise DeviceError(
                f"{self._name}, ati_serial.calibration {calibration_number}: {error}"
            ) from None
        sensor_number = calibration_block.calibration.serial_number
        if not same_serial_number(profile_number, sensor_number):
            raise DeviceError(
                f"{self._name}: its serial number is {sensor_number or 'empty'}, but the profile "
                f"requires {profile_number} (ati_serial.serial_number). Check which sensor is on "
                "the rig."
            )
        return calibration_block

    def load_amplifier_settings(self, calibration_block: CalibrationBlock) -> None:
        """Write the calibration's amplifier gains and offsets, and read them back."""
        self._request_content(modbus.UNLOCK_REQUEST, "unlock its memory")
        try:
            for first_register, register_values in (
                (modbus.GAINS_REGISTER, calibration_block.amplifier_gains),
                (modbus.OFFSETS_REGISTER, calibration_block.amplifier_offsets),
            ):
                self._request_content(
                    modbus.write_registers(first_register, register_values),
                    "load gains and offsets",
                )
        finally:
            self._request_content(modbus.LOCK_REQUEST, "lock its memory")
        written_amplifier_values = tuple(
            chain(calibration_block.amplifier_gains, calibration_block.amplifier_offsets)
        )
        active_amplifier_values = self._read_register_values(
            modbus.GAINS_REGISTER, len(written_amplifier_values), "report its gains and offsets"
        )
        if active_amplifier_values != written_amplifier_values:
            raise DeviceError(
                f"{self._name}: gains and offsets read back as {active_amplifier_values}, where "
                f"{written_amplifier_values} were written. Switch it off and on; without them its "
                "calibration is not valid."
            )

    def start_streaming(self) -> bytes:
        """Start the sensor's stream of records; return the bytes received after the reply."""
        request = modbus.START_STREAM_REQUEST
        time.sleep(FRAME_SILENCE_S)
        reply_size = modbus.reply_length(request)
        reply = self._line.transact(request, reply_size, _REPLY_TIMEOUT_S)
        try:
            modbus.reply_content(request, reply[:reply_size])
        except ValueError as error:
            raise DeviceError(f"{self._name}: it does not start streaming: {error}.") from None
        return reply[reply_size:]

    def _request_content(self, request: bytes, action_text: str) -> bytes:
        """Send a request and return the content of its reply; repeat a request that failed."""
        last_error = ""
        for attempt_number in range(_REQUEST_ATTEMPTS):
            time.sleep(FRAME_SILENCE_S)
            reply_size = modbus.reply_length(request)
            reply = self._line.transact(request, reply_size, _REPLY_TIMEOUT_S)
            if attempt_number:
                self._line.discard_until_silent(_LATE_REPLY_WAIT_S, 2 * _LATE_REPLY_WAIT_S)
            try:
                return modbus.reply_content(request, reply)
            except modbus.ModbusExceptionError as error:
                raise DeviceError(
                    f"{self._name}: asked to {action_text}, it refused: {error}. Check that it is "
                    "a Digital F/T sensor, and ati_serial.calibration."
                ) from None
            except modbus.InvalidReplyError as error:
                last_error = str(error)
        raise DeviceError(
            f"{self._name}: asked to {action_text}, it gave no usable reply in {_REQUEST_ATTEMPTS} "
            f"tries: {last_error}. Check power, cable (A and B swapped?), ati_serial.port and "
            "ati_serial.baud."
        )

    def _read_register_values(
        self, first_register: int, register_count: int, action_text: str
    ) -> tuple[int, ...]:
        """Read consecutive registers, with several Modbus requests if necessary."""
        register_values: tuple[int, ...] = ()
        while len(register_values) < register_count:
            chunk_size = min(
                modbus.MAX_REGISTERS_PER_REQUEST, register_count - len(register_values)
            )
            request = modbus.read_registers(first_register + len(register_values), chunk_size)
            register_values += modbus.unpack_registers(self._request_content(request, action_text))
        return register_values
