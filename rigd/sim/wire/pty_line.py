"""A pseudo-terminal in place of the sensor's serial line."""

import os
import tty
from collections.abc import Callable
from contextlib import suppress

from rigd.sim.wire.hub import Handlers

_READ_BYTES = 4096


class PtyLine:
    """The sensor's end of a serial line.

    While nobody has the other end open, what is sent is lost, as on a real line. A terminal with
    a closed end is always "readable", so it is looked at from time to time instead.

    Parameters
    ----------
    handlers
        Of the event loop; kept up to date.
    on_bytes
        Gets what the host sends.
    on_open
        Told when the host opens the port, and when it closes it.

    Attributes
    ----------
    port : str
        What the host opens.
    lost : int
        Bytes that the host did not take.
    """

    def __init__(
        self,
        handlers: Handlers,
        on_bytes: Callable[[bytes], None],
        on_open: Callable[[bool], None],
    ) -> None:
        self._handlers = handlers
        self._on_bytes = on_bytes
        self._on_open = on_open
        self.lost = 0
        self.open()

    def open(self) -> None:
        """Make the line, at first and after `close`; its port may get another name."""
        self._ours, theirs = os.openpty()
        tty.setraw(theirs)
        self.port = os.ttyname(theirs)
        os.close(theirs)
        os.set_blocking(self._ours, False)
        self._open = False

    def write(self, data: bytes) -> None:
        """Send bytes; those that the host does not take are gone."""
        sent = 0
        if self._open:
            with suppress(OSError):
                sent = os.write(self._ours, data)
            self.lost += len(data) - sent

    def look(self) -> None:
        """Find out whether the host has opened the port meanwhile."""
        if not self._open and self._ours >= 0:
            self._receive()

    def close(self) -> None:
        """Cut the line."""
        if self._ours >= 0:
            self._handlers.pop(self._ours, None)
            os.close(self._ours)
            self._ours = -1
            self._open = False

    def _receive(self) -> None:
        data = b""
        try:
            data = os.read(self._ours, _READ_BYTES)
            is_open = True
        except BlockingIOError:
            is_open = True
        except OSError:
            is_open = False
        if is_open and not self._open:
            self._handlers[self._ours] = self._receive
        elif self._open and not is_open:
            del self._handlers[self._ours]
        if is_open != self._open:
            self._open = is_open
            self._on_open(is_open)
        if data:
            self._on_bytes(data)
