"""Whether the drive exerts what it is told, as its actual torque (object 6077) says."""

from math import exp

from rigd.devices.contracts import DeviceError

_TICKS = 10
"""In a row; a single lost command is repeated by the next."""


class TorqueFollowing:
    """Compares actual torques with commands, in 1/1000 of the rated torque.

    A TPDO may be made before or after the drive takes over the command of the tick before, so it is
    compared with the last two. Where the drive measures its torque, that follows the command with a
    lag of first order; the commands are then filtered alike before they are compared.

    Parameters
    ----------
    name
        Of the drive, for messages.
    tolerance_percent
        Of the rated torque; 0 compares nothing.
    response_s
        Time constant of that lag; 0 for a drive that tells what it was told.
    period_s
        Between two commands.

    Attributes
    ----------
    compares : bool
        The drive tells its torque at all.
    """

    def __init__(
        self, name: str, tolerance_percent: float, response_s: float = 0.0, period_s: float = 1e-3
    ) -> None:
        self._name = name
        self._tolerance = 10.0 * tolerance_percent
        # Of a command that has stood for a period.
        self._share = 1.0 - exp(-period_s / response_s) if response_s else 1.0
        self.compares = True
        self.start()

    def start(self) -> None:
        """Begin with a drive that has been told to exert nothing."""
        self._commanded = 0
        self._last = 0.0
        self._before = 0.0
        self._departed = 0

    def command(self, per_mille: int) -> None:
        """Note what the drive is told."""
        self._commanded = per_mille
        before = self._before = self._last
        self._last = before + self._share * (per_mille - before)

    def compare(self, actual_per_mille: int) -> None:
        """Compare the drive's torque with the last commands.

        Raises
        ------
        DeviceError
            If they have differed for too many ticks in a row.
        """
        tolerance = self._tolerance
        if (
            abs(actual_per_mille - self._last) <= tolerance
            or abs(actual_per_mille - self._before) <= tolerance
            or not tolerance
            or not self.compares
        ):
            self._departed = 0
            return
        self._departed += 1
        if self._departed >= _TICKS:
            raise DeviceError(
                f"{self._name}: it exerts {actual_per_mille / 10:g} % of the rated torque (object "
                f"6077) where {self._commanded / 10:g} % were commanded, for {_TICKS} ticks; "
                "commands are lost, or the drive limits them. Look at its own diagnosis, and at "
                "cia402.torque_tolerance_percent; where it measures this torque, at "
                "cia402.torque_response_s."
            )
