"""A serial port as the loop uses it: opened and configured by pyserial, then read without blocking.

Configuration is pyserial's work; its own reading costs several system calls for what is one here.
"""

import os
import select
import termios
import time
from contextlib import suppress

import serial

from rigd.devices.contracts import DeviceError

_READ_SIZE = 65_536


class SerialLine:
    """An open port: 8 data bits, even parity, one stop bit; nobody else may open it meanwhile.

    Parameters
    ----------
    port
        Its file name.
    baud
        Bits a second; any that the adapter can make.
    device
        At its other end, for messages.

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
            # vmin = 1 (by inter_byte_timeout): an empty line is then told from a dead one.
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
        while True:  # a short piece need not be the last: the kernel moves bytes on as it is asked
            try:
                piece = os.read(self._fd, _READ_SIZE)
            except BlockingIOError:
                return data
            except OSError as error:
                raise self._gone(error.strerror) from None
            if not piece:
                raise self._gone("hung up")
            data = data + piece if data else piece

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
        """Send a request and return what comes: `length` bytes or more, or fewer if no more come.

        What arrived before it is dropped.
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
        """Drop what comes until nothing has come for a while.

        Returns
        -------
        bool
            Whether it fell silent within the limit.
        """
        now = time.monotonic()
        heard, end = now, now + limit_s
        while now < end:
            if self.read():
                heard = now
            elif now - heard >= quiet_s:
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
            f"{self._device}: the serial port {self._serial.port} has failed ({why}); look at "
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
        return "another program has it open: end that first"
    if isinstance(error, ValueError):
        return "check ati_serial.baud, and whether the adapter can make it"
    return (
        "check ati_serial.port, whether the adapter is plugged in and whether you may use it "
        "(group dialout), or start the simulated rig: rigd simulate --profile PROFILE"
    )
