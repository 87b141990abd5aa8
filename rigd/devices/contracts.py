"""Contracts between the 1 kHz cycle and its devices: a drive and a force-torque sensor.

Real and simulated devices implement the same two contracts, and one conformance suite runs on every
implementation. Constructors touch no hardware; ``connect`` does.

In every tick the cycle calls, in this order: ``drive.latch``, ``sensor.request``,
``drive.read_angle``, ``sensor.read_wrench``, ``drive.command``. A driver that has no fresh value
returns the last one and says so in ``angle_stale`` or ``wrench_stale``; it never blocks longer
than the deadline its profile gives. ``due_ns`` is the tick's scheduled time on the engine's clock;
it grows by one period a tick, and by more where ticks were missed. The sensor is connected first,
and the drive right before the first tick: once it is operational it expects one every period.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from rigd.errors import FailureError

Wrench = tuple[float, float, float, float, float, float]
"""fx, fy, fz in N and tx, ty, tz in N·m, in the sensor's frame, as read (not tared)."""


class DeviceError(FailureError):
    """A device did not act as requested: the message states device, expectation and reply."""


def wired_stop_dropped(device: str, shown: str = "") -> DeviceError:
    """Return the error of a drive whose wired stop (STO) was dropped while it was enabled.

    Parameters
    ----------
    device
        Name of the drive.
    shown
        How the drive shows it, as the rest of a sentence.
    """
    return DeviceError(
        f"{device}: the wired stop (STO) was dropped{shown}. Find out who pressed it and why, "
        "check that nobody is within reach of the beam, release it, then reset the rig."
    )


@dataclass(frozen=True, slots=True)
class LineHealth:
    """Health of a device's line since it was connected; None: not known.

    Attributes
    ----------
    bits
        Bits of all frames sent and received, without stuff bits.
    bit_rate_bit_s
        Bit rate of the line.
    errors
        Disturbed, damaged and missing messages.
    status
        Status word of the device; 0: all is well.
    doubt
        Why its readings may be older than reported, for the operator, in the same words as long as
        the reason is the same; empty: no doubt.
    doubt_count
        How much of it there has been so far, a sentence; empty without a doubt.
    cause
        Probable cause of missing readings, with its remedy; empty: not known.
    """

    bits: int | None = None
    bit_rate_bit_s: float | None = None
    errors: int | None = None
    status: int | None = None
    doubt: str = ""
    doubt_count: str = ""
    cause: str = ""


class Drive(Protocol):
    """A torque-controlled drive with a position encoder, at the output shaft of its gear."""

    angle_stale: bool
    """The last angle read is not the one of the last latch."""
    angle_time_ns: int
    """When the last angle read was latched, as far as the host knows; ``time.monotonic_ns``."""

    off_doubt: str
    """Why the drive may still exert torque after `disable`, for the operator; empty if not."""

    def connect(self) -> None:
        """Open the line and verify identity and configuration; no torque.

        Raises
        ------
        DeviceError
            If the drive is absent or not what the profile says.
        """

    def enable(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Bring the drive to operation enabled, at zero torque.

        Parameters
        ----------
        stop
            Called repeatedly; if it returns True, the drive is disabled instead.

        Raises
        ------
        DeviceError
            If the drive does not reach that state.
        """

    def latch(self, due_ns: int) -> None:
        """Ask for the angle as it is now; ``due_ns`` is when the tick was due."""

    def read_angle(self) -> float:
        """Return the latched angle in rad, at the output shaft."""

    def command(self, torque_nm: float) -> float:
        """Set the torque in N·m at the output shaft, held until the next command.

        Returns
        -------
        float
            The torque as it was sent: what the drive's steps and limits make of it; 0 while it is
            not enabled.
        """

    def health(self) -> LineHealth:
        """Return the health of its line; quick enough for an occasional call in the loop."""

    def disable(self) -> None:
        """Zero the torque and disable the drive. Works in every state and never raises."""

    def close(self) -> None:
        """Release the line; disables first."""


@runtime_checkable
class StatedDrive(Protocol):
    """Safeguards of the drive itself, which a session's file has to state."""

    def statement(self) -> dict[str, str]:
        """Return them as keys of the file's metadata; known once it is connected."""


class WrenchSensor(Protocol):
    """A six-axis force-torque sensor."""

    wrench_stale: bool
    """The last wrench read is not the answer to the last request."""
    wrench_time_ns: int
    """When the last wrench read was requested, or arrived if it is streamed; as for the angle."""
    wrench_saturated: bool
    """An axis of the last wrench is at the end of its range."""

    def connect(self) -> None:
        """Open the line and read identity and calibration.

        Raises
        ------
        DeviceError
            If the sensor is absent or not what the profile says.
        """

    def calibration(self) -> dict[str, object]:
        """Return identity and calibration as read from the sensor, for the session file."""

    def request(self, due_ns: int) -> None:
        """Ask for the wrench as it is now; ``due_ns`` is when the tick was due."""

    def read_wrench(self) -> Wrench:
        """Return the requested wrench."""

    def health(self) -> LineHealth:
        """Return the health of line and sensor; quick enough for an occasional call in the loop."""

    def close(self) -> None:
        """Release the line."""


@runtime_checkable
class GaugeSensor(Protocol):
    """A sensor that shows its raw channels, so that a single one that fails is detected."""

    gauges: tuple[int, ...]
    """Raw counts of each gauge, as of the last wrench read."""


@dataclass(frozen=True, slots=True)
class Devices:
    """The devices of one rig."""

    drive: Drive
    """Drive of the motor."""
    sensor: WrenchSensor
    """Force-torque sensor under the clamp."""
    simulated: bool
    """No motor moves: the rig may run under the virtual clock."""
    renew_noise: Callable[[int | None], int] | None = None
    """Restarts the noise of a simulated rig before a session, from a given seed or (None) one of
    its own, and returns the seed; None: there is no noise to restart."""

    @property
    def on_lines(self) -> bool:
        """Whether the drive is at the other end of a line, simulated or not."""
        return self.drive.health().bits is not None
