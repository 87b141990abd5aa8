"""One program at a time on a bus: a second one would reconfigure a drive that moves."""

from rigd.devices.contracts import DeviceError
from rigd.devices.held_file import HeldError, HeldFile


class BusLock:
    """Held from the opening of a bus to its closing.

    Parameters
    ----------
    bus
        Where the bus is: a channel, or the socket of a simulated one.
    simulated
        It is a simulated one: other users have others.
    """

    def __init__(self, bus: str, *, simulated: bool) -> None:
        self._bus = bus
        self._file = HeldFile(f"bus-{bus}", everybody=not simulated)

    def acquire(self) -> None:
        """Take the bus.

        Raises
        ------
        DeviceError
            If another program has it; the message says which process.
        """
        try:
            self._file.acquire("rigd")
        except HeldError as holder:
            raise DeviceError(
                f"CAN bus {self._bus}: another rigd is using it ({holder}); wait for it, or stop "
                "it."
            ) from None
        except OSError as error:
            raise DeviceError(
                f"CAN bus {self._bus}: it cannot be reserved in {self._file.path.parent} "
                f"({error.strerror}); set XDG_RUNTIME_DIR to a folder that is yours."
            ) from None

    def release(self) -> None:
        """Give the bus up; harmless when repeated."""
        self._file.release()
