"""Interfaces between the 1 kHz loop and its devices: a drive and a force-torque sensor.

Real and simulated devices implement the same two interfaces, and one conformance suite tests every
implementation. Constructors access no hardware; ``connect`` does.

In every tick the loop calls, in this order: ``drive.latch``, ``sensor.request``,
``drive.read_angle``, ``sensor.read_wrench``, ``drive.command``. A driver without a new value
returns the last value and sets ``angle_stale`` or ``wrench_stale``. It never blocks longer than the
deadline in its profile. ``due_ns`` is the tick's scheduled time on the engine's clock; it increases
by one period per tick, and by more if ticks were missed. The sensor is connected first, and the
drive right before the first tick, because an operational drive expects a tick in every period.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from rigd.errors import FailureError

Wrench = tuple[float, float, float, float, float, float]
"""Wrench as read, without tare: fx, fy, fz in N and tx, ty, tz in N·m, in the sensor's frame."""


class DeviceError(FailureError):
    """Error: a device did not act as requested; the message states device and reply."""


def wired_stop_dropped(device: str, explanation: str = "") -> DeviceError:
    """Return the error for a drive whose wired stop (STO) was dropped while it was enabled.

    Parameters
    ----------
    device
        Name of the drive.
    explanation
        How the drive reports the dropped stop, as the rest of a sentence.
    """
    return DeviceError(
        f"{device}: the wired stop (STO) was dropped{explanation}. Find out who pressed it and "
        "why, check that nobody is within reach of the beam, and release it; if a daemon runs the "
        "rig, then reset the rig."
    )


@dataclass(frozen=True, slots=True)
class LineHealth:
    """Errors and load of a device's communication line since it was connected; None: unknown.

    Attributes
    ----------
    bits
        Total number of bits of all frames sent and received, without stuff bits.
    bit_rate_bit_s
        Bit rate of the line in bit/s.
    errors
        Number of disturbed, damaged and missing messages.
    status
        Status word of the device; 0 means no error.
    doubt
        Reason why readings may be older than reported, for the operator. The text changes only if
        the reason changes; it is empty if there is no such doubt.
    doubt_count
        Sentence with the number of readings so far that may be older; empty if `doubt` is empty.
    cause
        Probable cause of missing readings, with its remedy; empty if unknown.
    """

    bits: int | None = None
    bit_rate_bit_s: float | None = None
    errors: int | None = None
    status: int | None = None
    doubt: str = ""
    doubt_count: str = ""
    cause: str = ""


class Drive(Protocol):
    """Torque-controlled drive with a position encoder, as seen at the output shaft of its gear."""

    angle_stale: bool
    """Whether the last angle read is older than the last call of `latch`."""
    angle_time_ns: int
    """Time in nanoseconds (``time.monotonic_ns``) at which the last angle read was sampled."""

    off_doubt: str
    """Reason why the drive may still exert torque after `disable`, for the operator; else empty."""

    def connect(self) -> None:
        """Connect to the drive, verify its identity and configuration; exert no torque.

        Raises
        ------
        DeviceError
            If the drive is absent or differs from the profile.
        """

    def enable(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Bring the drive to the state operation enabled, at zero torque.

        Parameters
        ----------
        stop
            Called repeatedly; if it returns True, the drive is disabled instead.

        Raises
        ------
        DeviceError
            If the drive does not reach the state.
        """

    def latch(self, due_ns: int) -> None:
        """Request the drive to sample its angle; `due_ns` is the time at which the tick was due."""

    def read_angle(self) -> float:
        """Return the last sampled angle of the output shaft in rad."""

    def command(self, torque_nm: float) -> float:
        """Command a torque in N·m at the output shaft, which acts until the next command.

        Returns
        -------
        float
            Torque as sent, in N·m: rounded to the drive's steps and limited; 0 while the drive is
            not enabled.
        """

    def health(self) -> LineHealth:
        """Return errors and load of the drive's communication line.

        The method is fast enough for an occasional call in the control loop.
        """

    def disable(self) -> None:
        """Zero the torque and disable the drive; works in every state and never raises."""

    def close(self) -> None:
        """Disable the drive, and close the connection to it."""


@runtime_checkable
class StatedDrive(Protocol):
    """Drive that describes its own safeguards, such as its watchdog, for the session file."""

    def statement(self) -> dict[str, str]:
        """Return the drive's safeguards as metadata of a session file, known after `connect`."""


class WrenchSensor(Protocol):
    """Six-axis force-torque sensor."""

    wrench_stale: bool
    """Whether the last wrench read is not the reply to the last request."""
    wrench_time_ns: int
    """Time in nanoseconds (``time.monotonic_ns``) at which the last wrench read was requested.

    If the sensor streams, it is the time at which the wrench arrived."""
    wrench_saturated: bool
    """Whether an axis or gauge of the last wrench read was at the end of its range."""

    def connect(self) -> None:
        """Connect to the sensor, and read its identity and calibration.

        Raises
        ------
        DeviceError
            If the sensor is absent or differs from the profile.
        """

    def calibration(self) -> dict[str, object]:
        """Return identity and calibration as read from the sensor, for the session file."""

    def request(self, due_ns: int) -> None:
        """Request the sensor to sample the wrench now; `due_ns` is when the tick was due."""

    def read_wrench(self) -> Wrench:
        """Return the requested wrench in N and N·m, or the last one if no new one has arrived."""

    def health(self) -> LineHealth:
        """Return errors of the sensor's communication line, and the sensor's status word.

        The method is fast enough for an occasional call in the control loop.
        """

    def close(self) -> None:
        """Close the connection to the sensor."""


@runtime_checkable
class GaugeSensor(Protocol):
    """Sensor that offers its raw gauge readings, so that a failed gauge can be detected."""

    gauges: tuple[int, ...]
    """Raw counts of each gauge at the last wrench read."""


@dataclass(frozen=True, slots=True)
class Devices:
    """Drive and sensor of one rig."""

    drive: Drive
    """Drive of the motor."""
    sensor: WrenchSensor
    """Force-torque sensor under the clamp."""
    simulated: bool
    """Whether the devices are simulated, so that no motor moves and the virtual clock is
    possible."""
    renew_noise: Callable[[int | None], int] | None = None
    """Function that restarts the noise of a simulated rig before a session and returns the seed.

    Its argument is the seed, or None for a random seed. The field is None if there is no noise to
    restart."""

    @property
    def uses_line(self) -> bool:
        """Whether the drive is connected by a bus or serial line, real or simulated."""
        return self.drive.health().bits is not None
