"""The bus that several drivers share: opened by the first of them, closed by the last."""

from rigd.devices.canbus.exchange import CanExchange
from rigd.devices.canbus.lock import BusLock
from rigd.devices.canbus.port import open_port
from rigd.devices.contracts import DeviceError
from rigd.devices.parameters import CanBus
from rigd.devices.simulator import SimulatorAddress


class CanLink:
    """One bus and its users.

    Parameters
    ----------
    settings
        Which bus.
    simulator
        Of the simulated rig that stands in for it, or None.
    """

    def __init__(self, settings: CanBus, simulator: SimulatorAddress | None) -> None:
        self._settings = settings
        self._simulator = simulator
        self._exchange: CanExchange | None = None
        self._users = 0
        simulated = "" if simulator is None else simulator.can_socket
        self._lock = BusLock(simulated or settings.channel, simulated=bool(simulated))

    @property
    def exchange(self) -> CanExchange:
        """The cyclic exchange on the open bus.

        Raises
        ------
        DeviceError
            If the bus is not open.
        """
        if self._exchange is None:
            raise DeviceError(f"CAN bus {self._settings.channel}: it is not open.")
        return self._exchange

    def open(self) -> CanExchange:
        """Open the bus if nobody has yet.

        Raises
        ------
        DeviceError
            If that fails, or another program uses it.
        """
        if self._exchange is None:
            self._lock.acquire()
            try:
                self._exchange = CanExchange(open_port(self._settings, self._simulator))
            except BaseException:
                self._lock.release()
                raise
        self._users += 1
        return self._exchange

    def close(self) -> None:
        """Give the bus up; the last of its users closes it."""
        self._users = max(0, self._users - 1)
        if self._users == 0 and self._exchange is not None:
            self._exchange.port.close()
            self._exchange = None
            self._lock.release()
